"""Run time against error: every fast part of the package measured beside its plain counterpart and a float64 oracle."""

from nsvq_lightning.commands.benchmark.cli import main

__all__ = ["main"]
