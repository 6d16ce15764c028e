"""Measure run time against error: each part beside its plain counterpart and a float64 oracle.

Suites:
  render     back-ends of the rasterizer and of the loss, forward and backward, against float64
  quantize   the search for the nearest code
  codec      writing and reading scene files
  train      whole runs, with switches on and off

Examples:
  nsvq benchmark all --quick
  nsvq benchmark render > render.md
  nsvq benchmark train --scene path/to/colmap/folder --switches all
  nsvq benchmark train --scene path/to/colmap/folder --emulate 8,16
  nsvq benchmark quantize,codec --scene scene.ply
"""

import sys
import time
from argparse import ArgumentError, ArgumentParser, Namespace
from importlib import import_module
from pathlib import Path

from nsvq_lightning.commands.arguments import integers, positive, some_of
from nsvq_lightning.skips import SKIPS
from nsvq_lightning.top_level import log

# Modules of this package; each has a function ``run(scope)``, which returns measurements.
SUITES = ("render", "quantize", "codec", "train")

# The synthetic scenes by name: splats, pixels across and down, and the median length of a splat's axes in scene units.
# Splats are smaller where there are more, as training leaves them.
SIZES = {
    "A20k": (20_000, 400, 300, 0.0175),
    "B100k": (100_000, 800, 533, 0.0100),
    "C500k": (500_000, 800, 533, 0.0056),
    "D1M": (1_000_000, 1600, 1060, 0.0044),
    "E3M": (3_000_000, 1600, 1060, 0.0031),
}


def add_arguments(parser: ArgumentParser) -> None:
    """Add what ``nsvq benchmark`` takes."""
    help_ = f"of {', '.join(SUITES)}: one, some with commas between them, or all"
    parser.add_argument("suites", type=some_of(SUITES), metavar="SUITE", help=help_)
    add = parser.add_argument_group("what is measured").add_argument
    help_ = f"synthetic scenes, some of {','.join(SIZES)} (A20k,B100k,C500k; quick A20k)"
    add("--workloads", type=some_of(SIZES), metavar="NAME,NAME", help=help_)
    add("--scene", type=Path, metavar="PATH", help="scene file or COLMAP folder, not synthetic ones")
    help_ = "scene file whose splats are used with the photos of the COLMAP folder, instead of its points"
    add("--init-from", type=Path, metavar="FILE", help=help_)
    add("--config", metavar="NAME", help="config of the runs of train (fast.yaml, without photos demo.yaml)")
    add("--steps", type=positive(int), metavar="N", help="iterations of each run of train (1000; quick 40)")
    add("--switches", type=some_of(SKIPS), metavar="NAME,NAME", help="switches that train inverts one by one, or all")
    add("--emulate", type=integers, metavar="N,N", help="cores: how long steps of train would take with so many")
    add = parser.add_argument_group("how much").add_argument
    add("--quick", action="store_true", help="small workloads, few repeats: all within a minute")
    add("--repeats", type=positive(int), metavar="N", help="timed calls of each case (15; quick 3)")


# What --quick changes of a scope.
QUICK = {"repeats": 3, "seconds": 0.5, "workloads": ("A20k",), "steps": 40}


def run(options: Namespace) -> None:
    """Measure, and print the tables.

    Raises:
        ArgumentError: Options do not go together, or a number is out of range.
        ValueError: The scene cannot be used.
        OSError: A file cannot be read.
    """
    steps, scene = options.steps, options.scene
    # Arguments are refused before torch is loaded.
    if steps is not None and steps < 4:
        raise ArgumentError(None, f"--steps must be at least 4, one for each phase, got {steps}")
    if options.emulate and (min(options.emulate) < 1 or options.suites != ("train",)):
        raise ArgumentError(None, "--emulate takes numbers of cores, and is for the suite train alone")
    if options.init_from and not (scene and scene.is_dir()):
        raise ArgumentError(None, "--init-from needs a COLMAP folder as --scene, whose cameras see its splats")
    from nsvq_lightning.commands.benchmark.timing import Scope, as_markdown, describe_machine

    given = {name: value for name, value in vars(options).items() if name != "suites" and value is not None}
    scope = Scope(**{**(QUICK if options.quick else {}), **given})
    log.setLevel("WARNING")
    about = describe_machine()  # as busy as the machine is before
    found = {}
    for name in options.suites:
        suite = import_module(f"{__package__}.{name}")
        start = time.perf_counter()
        found[name] = list(suite.run(scope))
        sys.stderr.write(f"{name}: {time.perf_counter() - start:.1f} s\n")
    sys.stdout.write(as_markdown(about, scope, found))
