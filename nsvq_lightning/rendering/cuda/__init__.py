"""The CUDA back-end: Triton kernels, compiled where they run."""
