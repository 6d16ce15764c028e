"""One suite a file; each has ``run(settings)``, which gives the rows of its tables."""
