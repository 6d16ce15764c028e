"""The optional gsplat back-end: the CUDA kernels of another package behind the same interface."""
