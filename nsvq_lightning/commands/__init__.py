"""One entry for each word after ``nsvq``."""
