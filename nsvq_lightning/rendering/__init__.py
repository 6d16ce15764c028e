"""Rendering of Gaussian splats: a plain torch oracle and fast back-ends behind one function."""
