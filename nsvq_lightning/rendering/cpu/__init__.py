"""The CPU back-end: Numba kernels on explicit 16-lane vectors, compiled on the machine they run on."""
