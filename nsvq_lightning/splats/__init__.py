"""The six attributes of Gaussian splats and their geometry."""
