"""``nsvq doctor``: check whether this machine and a scene folder are fit for training, and say what would help."""
