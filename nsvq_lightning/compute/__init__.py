"""How kernels are written, compiled, fed and chosen."""
