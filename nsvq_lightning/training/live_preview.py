"""How a viewer asks a running fit for its splats: by two files in the folder of the run."""

from pathlib import Path

from nsvq_lightning.io.atomic import write_text

# The splats of a running fit, while somebody looks.
LIVE_SCENE = "live.nsvq"
# File whose time of modification says when a viewer last asked.
REQUEST = "live.request"


def ask(folder: Path) -> None:
    """Ask the fit that writes to a folder for its splats."""
    write_text(folder / REQUEST, "a viewer would like to see the splats of this run\n")


def asked(folder: Path) -> int:
    """When somebody last asked, as a number that changes with each time; 0 for never."""
    try:
        return (folder / REQUEST).stat().st_mtime_ns
    except OSError:
        return 0


def end(folder: Path) -> None:
    """Remove both files: the run has ended."""
    for name in (REQUEST, LIVE_SCENE):
        (folder / name).unlink(missing_ok=True)
