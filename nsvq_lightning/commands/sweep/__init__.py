"""``nsvq sweep``: many runs that differ in scene, settings, codebooks and seed, and what they cost and bring."""
