"""The ``nsvq`` command. Kept light: ``nsvq info`` must answer without importing torch."""

import atexit
import gc
import logging
import os
import re
import signal
import sys
import warnings
from _thread import interrupt_main
from argparse import ArgumentError, RawDescriptionHelpFormatter
from collections.abc import Sequence
from contextlib import suppress
from functools import cache
from importlib import import_module
from inspect import cleandoc
from io import TextIOWrapper
from threading import Timer
from traceback import walk_tb
from typing import Any, TextIO

from nsvq_lightning.commands import COMMANDS, OF_LIGHTNING, nearest, overview, say
from nsvq_lightning.commands.arguments import Parser
from nsvq_lightning.commands.settings import FIT_HELP, check_early, configs_among, expand
from nsvq_lightning.top_level import log
from nsvq_lightning.version import __version__

# Environment variable that makes errors show their traceback.
TRACEBACK = "NSVQ_TRACEBACK"

INTERRUPTED = 128 + signal.SIGINT


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``nsvq ARGUMENTS``.

    Args:
        argv: Arguments; those of the process if None.

    Returns:
        Exit status: 0, 1 after an error in the user's files, 130 after Ctrl-C, 143 after SIGTERM or a closed terminal.
        Wrong arguments end the process with status 2.
    """
    own_process = argv is None
    arguments = list(sys.argv[1:] if argv is None else argv)
    arguments = [text.replace("=~/", f"={os.path.expanduser('~')}/") for text in arguments]  # no shell does
    if "" not in sys.path:  # the current folder; last, unlike `python -m`: for the user's own quantizers and callbacks
        sys.path.append("")
    name = arguments[0] if arguments else ""
    if name in ("", "--help", "-h", "help"):
        sys.stdout.write(overview())
        return 0 if name else 2
    if name == "--version":
        say(f"nsvq {__version__}")
        return 0
    # Daemons close them.
    sys.stdout = sys.stdout or open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115
    sys.stderr = sys.stderr or open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115
    # A pipe, too, shows lines as they come; on Windows it accepts only the locale's characters.
    if isinstance(sys.stdout, TextIOWrapper):
        sys.stdout.reconfigure(errors="replace", line_buffering=True)
    if own_process:
        sys.unraisablehook = _once_more
        atexit.register(_hush)
        for number in (signal.SIGHUP, signal.SIGUSR1) if hasattr(signal, "SIGHUP") else ():
            if signal.getsignal(number) == signal.SIG_DFL:
                signal.signal(number, _hang_up)
    try:
        if name in OF_LIGHTNING or name.startswith("-"):
            return _run_lightning(arguments, own_process)
        if name in COMMANDS:
            if own_process:
                signal.signal(signal.SIGTERM, _end)
            return run_command(name, arguments[1:])
        return _failed(f"error: there is no command {name!r}{nearest(name, COMMANDS)}\nAll commands: nsvq --help", 2)
    except KeyboardInterrupt:
        sys.stderr.write("\n")  # below the ^C that the terminal shows
        return INTERRUPTED
    except (MemoryError, RuntimeError) as error:
        # Torch says so in words, on a CPU and on a GPU.
        lacks_memory = isinstance(error, MemoryError) or re.search("allocate memory|out of memory", str(error))
        if os.environ.get(TRACEBACK) or not lacks_memory:
            raise
        return _failed(
            "error: there is not enough memory: close other programs, take a smaller scene or picture, and for a fit "
            f"fewer splats (--splats) or smaller photos (--data.factor) ({TRACEBACK}=1 shows where)"
        )
    except ModuleNotFoundError as error:
        if error.name != "cv2":
            raise
        return _failed("error: OpenCV (cv2) is missing: pip install opencv-contrib-python-headless, or any other")


def _once_more(lost: Any) -> None:
    """Have Ctrl-C come again that was lost in a function that C calls, as LLVM does while kernels are compiled."""
    if lost.exc_type is KeyboardInterrupt:
        with suppress(RuntimeError):  # a process that ends begins no thread
            Timer(0.1, interrupt_main).start()  # not now: it would be lost in here, too
    else:
        sys.__unraisablehook__(lost)


def _hang_up(number: int, frame: Any) -> None:
    """Stop: a terminal was closed, which shell and system may both say, or the time of a SLURM job is nearly over."""
    signal.signal(number, signal.SIG_IGN)
    signal.raise_signal(signal.SIGTERM)


def _end(number: int, frame: Any) -> None:
    """Have a command remove what is unfinished, and then end the process as this signal does."""
    signal.signal(number, signal.SIG_DFL)
    atexit.register(signal.raise_signal, number)
    atexit.register(signal.signal, number, signal.SIG_DFL)  # before that: after a fit, Lightning puts this one back
    raise KeyboardInterrupt


def _words(error: Exception) -> str:
    """What an error says; where it is the system's, of which file."""
    if isinstance(error, OSError) and error.strerror is not None and error.filename is not None:
        return f"{error.filename}: {error.strerror}"
    return str(error)


def _failed(message: str, status: int = 1) -> int:
    """Say why a command has failed; returns its exit status."""
    sys.stderr.write(f"{message}\n")
    return status


def lightning(argv: Sequence[str] | None = None) -> int:
    """Run ``lightning ARGUMENTS``: our commands, and what other distributions do under the same name.

    Lightning itself has shipped no ``lightning`` script since 2.5.1, but lightning-sdk and litserve do, and pip lets
    the distribution installed last own the name.

    Args:
        argv: Arguments; those of the process if None. No arguments, or an option first, is ours too.

    Returns:
        Exit status of our command; 2 if no distribution knows it. The script of another one ends the process.
    """
    from importlib.metadata import entry_points

    arguments = list(sys.argv[1:] if argv is None else argv)
    if not arguments or arguments[0].startswith("-") or arguments[0] in COMMANDS:
        return main(argv)
    points = entry_points(group="console_scripts", name="lightning")
    others = sorted(point for point in points if not point.value.startswith("nsvq_lightning."))
    if not others:
        return _failed(
            f"lightning: unknown command {arguments[0]!r}; nsvq-lightning has {', '.join(COMMANDS)}, "
            "and no other installed package has a lightning command",
            2,
        )
    sys.argv = ["lightning", *arguments]
    sys.exit(others[0].load()())


def run_command(name: str, arguments: Sequence[str]) -> int:
    """Run a command that is not Lightning's.

    The docstring of its module is what ``--help`` shows around the options; its ``add_arguments(parser)`` adds them.
    Its ``run(options)`` does the work. It raises :class:`ArgumentError` for options that do not go together,
    and :class:`ValueError` or :class:`OSError` for what is wrong with the user's files.

    Args:
        name: One of :data:`~nsvq_lightning.commands.COMMANDS` that is not Lightning's.
        arguments: What follows the name.

    Returns:
        Exit status: what ``run`` returns, 0 for nothing, or 1 after an error in the user's files.
    """
    command = import_module(f"{__package__}.{name}")
    about, _, more = cleandoc(command.__doc__ or "").partition("\n\n")
    parser = Parser(prog=f"nsvq {name}", description=about, epilog=more, formatter_class=RawDescriptionHelpFormatter)
    command.add_arguments(parser)
    options, further = parser.parse_known_args(arguments)
    if further:
        if "further" not in options:
            parser.error(f"unrecognized arguments: {' '.join(further)}")
        if not further[0].startswith("-"):
            parser.error(f"unknown argument {further[0]!r}; a list has commas between its entries, and no spaces")
        options.further = further  # for the commands that pass them on
    _show_log()
    try:
        return int(command.run(options) or 0)
    except ArgumentError as error:
        parser.error(str(error))
    except (ValueError, OSError) as error:
        return _failed(f"nsvq {name}: {_words(error)}")


def _run_lightning(arguments: list[str], own_process: bool) -> int:
    if arguments == ["fit", "--help"]:
        sys.stdout.write(FIT_HELP.read_text(encoding="utf-8"))
        return 0
    try:
        arguments = expand(arguments)
        check_early(arguments)
    except ArgumentError as error:
        sys.stderr.write(f"error: {error}\nAll options: nsvq {arguments[0]} --help\n")
        sys.exit(2)
    except (ValueError, OSError) as error:
        return _failed(f"error: {_words(error)}")
    # Fragments of Lightning's and torch's warnings that a user of this command can do nothing about.
    not_actionable = (
        "does not have many workers",  # views come from a cache in memory; each worker would hold a copy
        "args parameter is intended",  # we pass the arguments after looking up configs
        "dataloader.*no length",
        "(LeafSpec|GPU available but not used)",
        "(Checkpoint|Experiment logs) directory .* exists and is not empty",  # the marker of who writes there
        "`tensorboardX` has been removed",
        "Couldn't infer the batch indices",  # RenderWriter names pictures after their photos
    )
    for message in not_actionable:
        warnings.filterwarnings("ignore", f".*{message}.*")
    if arguments[0] == "fit":
        from nsvq_lightning.compute import ahead

        ahead.start()
    run_cli = _import_cli(own_process)
    from lightning.fabric.utilities.exceptions import MisconfigurationException
    from lightning.pytorch.utilities.exceptions import SIGTERMException

    _show_log()
    _quiet_lightning()
    configs = configs_among(arguments)
    try:
        run_cli(arguments)
    except SIGTERMException:  # a kind of SystemExit
        return 128 + signal.SIGTERM  # Lightning itself would exit with the status of success
    except SystemExit as end:
        if isinstance(end.__context__, KeyboardInterrupt):  # Lightning exits with 1
            return INTERRUPTED
        if end.code == 2 and configs:  # the parser's messages name the option, not the file it came from
            sys.stderr.write(f"Settings came from {', '.join(configs)} and the command line\n")
        raise
    except Exception as error:
        names_file = isinstance(error, FileNotFoundError) or (isinstance(error, OSError) and error.errno)
        speaks = names_file or isinstance(error, MisconfigurationException) or _is_ours(error)
        if os.environ.get(TRACEBACK) or not speaks:
            raise
        return _failed(f"error: {_words(error)}\n({TRACEBACK}=1 shows where)")
    return 0


@cache
def _import_cli(own_process: bool) -> Any:
    """Our :class:`LightningCLI`; to look for garbage among what it imports would take a second.

    A process that is not ours alone keeps the collector that it has.
    """
    if own_process:
        gc.disable()
    try:
        from nsvq_lightning.commands.fit import SplatCLI
    finally:
        if own_process:
            gc.freeze()
            gc.enable()
    return SplatCLI


def _hush() -> None:
    """Look for no garbage at the very end, which takes a second, and let nanobind's libraries not complain of it."""
    gc.freeze()
    sys.stderr.flush()
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)


def _is_ours(error: BaseException) -> bool:
    """Whether this package or Lightning raised the error: its message says what to do, a traceback would obscure it.

    Errors of other kinds are bugs of ours, for which the traceback matters.
    """
    if not isinstance(error, ValueError | TypeError | OSError | RuntimeError | ArithmeticError | ImportError):
        return False
    modules = [str(frame.f_globals.get("__name__")) for frame, _ in walk_tb(error.__traceback__)]
    # Lightning's own: other kinds come of calls of what is not its own.
    told = ("nsvq_lightning.", "lightning.") if isinstance(error, ValueError) else "nsvq_lightning."
    return modules[-1].startswith(told)


class BarHandler(logging.StreamHandler[TextIO]):
    """Writes to stderr, above a progress bar if there is one."""

    def emit(self, record: logging.LogRecord) -> None:
        """Write a record."""
        from tqdm import tqdm

        try:
            tqdm.write(self.format(record), file=self.stream)
        except Exception:
            self.handleError(record)


def _show_log() -> None:
    """Show our log messages."""
    logging.basicConfig(format="%(message)s", handlers=[BarHandler()])
    log.setLevel("INFO")


def _quiet_lightning() -> None:
    """Show messages once; of Lightning's, only those that are not advertisements."""
    from lightning.pytorch.utilities import rank_zero_only

    for handler in logging.getLogger().handlers:
        # With several processes, only the first logs below warnings; each logs its own warnings and errors.
        handler.addFilter(lambda record: record.levelno >= logging.WARNING or getattr(rank_zero_only, "rank", 0) == 0)

    # Fragments of Lightning's messages that advertise, or repeat the progress bar in the middle of its line.
    not_ours = ("Tip:", "PU available:", "litlogger", "litmodels", "`Trainer.fit` stopped")
    for name in ("lightning.pytorch.utilities.rank_zero", "lightning.fabric.utilities.rank_zero"):
        logging.getLogger(name).addFilter(lambda record: not any(part in record.getMessage() for part in not_ours))
