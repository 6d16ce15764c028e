"""The quantizers' CUDA kernels in Triton, compiled where they run; each mirrors a module of the folder above."""
