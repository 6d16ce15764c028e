"""The project's own file format, ``.nsvq``."""
