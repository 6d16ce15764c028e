"""One entry for each command of ``nsvq``."""
