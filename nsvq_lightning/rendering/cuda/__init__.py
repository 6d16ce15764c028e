"""The CUDA back-end: Triton kernels, compiled on the machine they run on."""
