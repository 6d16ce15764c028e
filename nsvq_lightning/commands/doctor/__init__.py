"""``nsvq doctor``: whether this machine and a scene folder are fit for training, and what would help."""
