"""The quantizers' CUDA kernels in Triton, compiled where they run; each module mirrors one in the folder above."""
