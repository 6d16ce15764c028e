"""The optional gsplat back-end: the CUDA kernels of the gsplat package behind the same interface."""
