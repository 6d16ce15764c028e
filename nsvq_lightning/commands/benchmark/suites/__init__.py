"""One suite a file; each has ``run(scope)``, which gives the rows of its tables."""
