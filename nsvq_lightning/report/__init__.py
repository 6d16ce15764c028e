"""The reports, figures and pictures that a run leaves."""
