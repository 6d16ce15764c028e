"""``nsvq fit`` and its siblings: LightningCLI with this package's module, data, callbacks, defaults and run folder."""

import json
import math
import os
import sys
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from jsonargparse import set_parsing_settings
from lightning.pytorch import Callback, LightningModule, Trainer, loggers
from lightning.pytorch.callbacks import Checkpoint, ModelCheckpoint, ProgressBar
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI, SaveConfigCallback

from nsvq_lightning.callbacks import RunCheckpoint
from nsvq_lightning.callbacks.standard import OPTIONAL, STANDARD
from nsvq_lightning.commands import COMMANDS, OF_LIGHTNING, join
from nsvq_lightning.commands.parser import QuietParser, class_help, first_sentence
from nsvq_lightning.commands.settings import configs_among, find_config, settings_of
from nsvq_lightning.data.colmap import check_name
from nsvq_lightning.data.datamodule import ColmapDataModule, DemoDataModule
from nsvq_lightning.io.atomic import optional, write_text
from nsvq_lightning.io.errors import Json
from nsvq_lightning.training.module import SplatModule
from nsvq_lightning.training.resume import check_settings, read_checkpoint
from nsvq_lightning.training.run_folder import is_fast_dev_run, reserve, run_folder
from nsvq_lightning.training.trainer import TRAINER_DEFAULTS, SplatTrainer
from nsvq_lightning.version import check_replaced


class RunLogger(loggers.CSVLogger):
    """Lightning's, which a file that another program holds does not end the run."""

    def save(self) -> None:
        """Write what has been logged; what cannot be written now is written later."""
        with optional(Path(self.log_dir)):
            super().save()


def default_loggers(folder: Path) -> list[loggers.Logger]:
    """A CSV logger that writes into ``folder``, and a TensorBoard logger if that is installed."""
    place: dict[str, Any] = {"save_dir": folder.parent, "name": "", "version": folder.name}
    found: list[loggers.Logger] = [RunLogger(**place)]
    if find_spec("tensorboard") is not None:
        found.append(loggers.TensorBoardLogger(**place, default_hp_metric=False))
    return found


class RunStart(SaveConfigCallback):
    """Opens the run: makes its folder and default loggers, and writes the settings to ``config.yaml`` atomically."""

    by_minutes = False

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Open it as soon as the scene has been loaded, before anything is logged."""
        folder = run_folder(trainer)  # a collective of all processes
        if self.already_saved or is_fast_dev_run(trainer):
            return
        self.already_saved = True
        if self.config.trainer.logger in (None, True):
            trainer.loggers = default_loggers(folder)
            for logger in trainer.loggers:
                _ = logger.experiment  # type: ignore[attr-defined]  # now, because the CSV logger warns about a folder with files
        for callback in trainer.checkpoint_callbacks:
            if isinstance(callback, ModelCheckpoint) and callback.dirpath is None:
                callback.dirpath = str(folder / "checkpoints")
        if trainer.is_global_zero:
            phases = self.config.get("callbacks.phases.init_args", {})
            self.by_minutes = phases.get("minutes") is not None
            if self.by_minutes:  # the iterations that were chosen, so that the run can be repeated
                self.config["trainer.max_steps"] = trainer.max_steps
                phases.minutes = phases.iterations_per_photo = None
            for option in ("data.init_args.root", "model.init_from"):
                if isinstance(given := self.config.get(option), str):  # so that it is found from any folder
                    self.config[option] = os.path.abspath(os.path.expanduser(given))
            for option in ("model.seed", "data.init_args.seed"):  # which follow it, also another one
                if self.config.get(option) == self.config.seed_everything:
                    self.config[option] = 0
            self.config["ckpt_path"] = None  # who repeats a run does not continue it
            self._write(folder)

    def on_train_end(self, trainer: Trainer, pl_module: SplatModule, *_: Any) -> None:  # type: ignore[override]
        """Note how many iterations the minutes have come to, also for those who continue the run."""
        if self.by_minutes and trainer.global_step:
            self.config["callbacks.phases.init_args.total"] = pl_module.schedule.total
            self.config["trainer.max_steps"] = trainer.max_steps + pl_module.schedule.saved
            self._write(run_folder(trainer))

    on_exception = on_train_end  # type: ignore[assignment]

    def _write(self, folder: Path) -> None:
        with optional(folder / self.config_filename) as path:
            write_text(path, self.parser.dump(self.config, skip_none=False))


PARSER_SETTINGS: dict[str, Any] = {name: {"description": COMMANDS[name]} for name in OF_LIGHTNING}
PARSER_SETTINGS["fit"]["default_config_files"] = [find_config("fast")]


# A gate that nobody passes would let a checkpoint import what it names.
OVERRIDDEN = ("_get", "_parse_ckpt_path", "_parser", "_prepare_subcommand_parser", "_run_subcommand", "_set_seed")
check_replaced("lightning", LightningCLI, *OVERRIDDEN)


class SplatCLI(LightningCLI):
    """``nsvq fit | validate | test | predict | export``.

    The callbacks of a run have options of their own: ``--callbacks.density.max_splats=200000`` changes one number
    without repeating a list; ``trainer.callbacks`` takes further callbacks.
    """

    def __init__(self, args: list[str]) -> None:
        self._arguments = args
        QuietParser.arguments = [*args, *settings_of(configs_among(args))]
        for argument in args:
            check_name(argument, "the command line", allow_outside=True)
        # Texts of settings stand below them; to read them takes seconds, which only this help is worth.
        asks = any(argument.partition("=")[0].endswith(".help") for argument in args)
        set_parsing_settings(docstring_parse_attribute_docstrings=asks)
        for name, kind in STANDARD.items():
            if f"--callbacks.{name}.help" in args:
                sys.stdout.write(class_help(f"callbacks.{name}", kind))
                raise SystemExit(0)
        super().__init__(
            SplatModule,
            ColmapDataModule,
            trainer_class=SplatTrainer,
            trainer_defaults=TRAINER_DEFAULTS,
            save_config_callback=RunStart,
            seed_everything_default=False,  # every draw has its own generator
            parser_class=QuietParser,
            parser_kwargs={"prog": "nsvq", **PARSER_SETTINGS},
            subclass_mode_data=True,
            auto_configure_optimizers=False,  # the module builds its groups
            args=args,
        )

    @staticmethod
    def subcommands() -> dict[str, set[str]]:
        """Lightning's subcommands and ours, each with the arguments that are not options."""
        return {**LightningCLI.subcommands(), "export": {"model", "datamodule"}}

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        """Add the callbacks."""
        for name, kind in STANDARD.items():
            key = f"callbacks.{name}"
            default = None if name in OPTIONAL else {"class_path": f"{kind.__module__}.{kind.__qualname__}"}
            # Settings alone mean the standard class; another one need not be derived from it.
            about = first_sentence(kind.__doc__)
            parser.add_argument(f"--{key}", type=kind | Callback | None, default=default, help=about, sub_configs=True)
            parser.callback_keys.append(key)

    def _prepare_subcommand_parser(self, klass: type, subcommand: str, **kwargs: Any) -> LightningArgumentParser:
        if self._arguments and subcommand not in self._arguments:  # to fill it takes a tenth of a second
            return self.init_parser(**kwargs)
        parser = super()._prepare_subcommand_parser(klass, subcommand, **kwargs)
        # Export reads no photos: any data module that can be built without options will do.
        data = DemoDataModule if subcommand == "export" else ColmapDataModule
        parser.set_defaults({"data": {"class_path": f"{data.__module__}.{data.__qualname__}"}})
        if subcommand == "predict":
            # RenderWriter writes them to disk; a list of all pictures would only fill the memory.
            parser.set_defaults({"return_predictions": False})
        return parser

    def _set_seed(self) -> None:
        """Hand ``--seed_everything`` on to the seeds that make a run: every draw has a generator of its own."""
        super()._set_seed()
        seed = self._get(self.config, "seed_everything")
        if seed is False:
            return
        for part in (self._get(self.config, "model"), self._get(self.config, "data").get("init_args", {})):
            if part.get("seed") == 0:  # the default: a seed that was asked for stays
                part["seed"] = seed

    def _parse_ckpt_path(self) -> None:
        """Take the model's settings from the checkpoint, except those on the command line; in ``fit``, take none.

        Raises:
            FormatError: The checkpoint cannot be used; it is better to fail now than after the scene has been loaded.
            FileNotFoundError: There is no such checkpoint.
        """
        subcommand = self.config.subcommand
        path = self.config[subcommand].get("ckpt_path")
        settings = {}
        if path is not None:
            # Words that Lightning accepts instead of a path; ``last`` and ``best`` refer to its own callback.
            remote = path.partition(":")[0] in ("hpc", "registry") or "://" in path
            if not remote or Path(path).is_file():
                settings = read_checkpoint(path).get("hyper_parameters", {})
        if subcommand == "fit":
            return
        check_settings(path, settings, [argument.partition("=")[2] or argument for argument in self._arguments])
        super()._parse_ckpt_path()
        own = [argument for argument in self._arguments if argument.startswith(("--model.", "--model="))]
        self.config = self.parser.parse_args([subcommand, *own], namespace=self.config, defaults=False)

    def instantiate_classes(self) -> None:
        """Make trainer, module and data.

        Raises:
            ValueError: One of them cannot be made from these settings; the message is that of the cause.
        """
        try:
            super().instantiate_classes()
        except Exception as error:
            cause: BaseException = error
            while cause.__cause__ is not None:  # the parser wraps the cause in what else it tried
                cause = cause.__cause__
            if isinstance(cause, LookupError | AttributeError | AssertionError | NameError):
                raise cause from None  # a bug, here or in a class of the user's
            raise ValueError(" ".join(str(cause).split())) from error

    def instantiate_trainer(self, **kwargs: Any) -> Trainer:
        """The trainer without the callbacks that are null, or disabled with the progress bar or checkpoints."""
        settings = self._get(self.config_init, "trainer")
        # Lightning refuses such a callback if the flag disables it, and the default callbacks include one of each.
        unwanted: tuple[type, ...] = (type(None),)
        if settings.barebones or settings.enable_progress_bar is False:
            unwanted += (ProgressBar,)
        if settings.barebones or settings.enable_checkpointing is False:
            unwanted += (Checkpoint,)
        parser = self._parser(self.subcommand)
        keys = parser.callback_keys
        parser.callback_keys = [key for key in keys if not isinstance(self._get(self.config_init, key), unwanted)]
        if settings.logger in (None, True):
            kwargs["logger"] = False  # until the run has a folder: see RunStart
        return super().instantiate_trainer(**kwargs)

    def _run_subcommand(self, subcommand: str) -> None:
        """Run a subcommand; say how to continue if training was stopped, for whatever reason."""
        fits = subcommand == "fit"
        if subcommand != "export":
            try:
                reserve(self.trainer, self.config[subcommand].get("ckpt_path") if fits else None)
            except (FileNotFoundError, NotADirectoryError, PermissionError) as error:
                raise OSError(
                    f"the folder of the run, {error.filename}, cannot be made ({error.strerror}): close what "
                    "holds it open, or name another one with --trainer.run_folder, or none for a new one in runs/"
                ) from error
        try:
            super()._run_subcommand(subcommand)
        except BaseException:
            for callback in self.trainer.checkpoint_callbacks if fits else ():
                path = callback.last_path if isinstance(callback, RunCheckpoint) else None
                if path and self.trainer.is_global_zero:
                    sys.stderr.write(f"continue with: {continuation(path)}\n")
            raise

    def after_fit(self) -> None:
        """Test the decoded file, and print a summary."""
        if not (is_fast_dev_run(self.trainer) or self.trainer.interrupted):
            self.trainer.test(self.model, datamodule=self.datamodule, verbose=False)
            self.after_test()

    def after_test(self) -> None:
        """Print a summary."""
        path = run_folder(self.trainer) / "metrics.json"
        if self.trainer.is_global_zero and path.is_file():
            with suppress(OSError):  # nobody may read it any more
                sys.stdout.write(summary(path.parent, json.loads(path.read_bytes())))


def continuation(checkpoint: Path) -> str:
    """The shell command that continues from a checkpoint, with the settings of the run that wrote it."""
    as_module = Path(sys.argv[0]).parts[-2:] == ("nsvq_lightning", "__main__.py")
    program = ["python", "-m", "nsvq_lightning"] if as_module else ["nsvq"]
    folder, path = Path(os.path.normpath(checkpoint / "../..")).as_posix(), checkpoint.as_posix()
    options = [f"--config={folder}/config.yaml", f"--ckpt_path={path}", f"--trainer.run_folder={folder}"]
    return join([*program, "fit", *options])


def summary(folder: Path, metrics: Json) -> str:
    """The results of a run, in a few lines."""
    page = folder / "viewer.html"
    way = f"open {page}, or " if page.is_file() else ""
    return (
        f"{folder}\n"
        f"  PSNR {metrics['psnr'] or math.inf:.2f} dB, SSIM {metrics['ssim'] or math.nan:.4f} "
        f"on {metrics['views']} test views, rendered from the decoded file\n"
        f"  {metrics['num_splats']} splats in {metrics['file_bytes']} bytes (scene.nsvq), "
        f"{metrics['ratio']:.1f} times smaller than the plain .ply\n"
        f"  {metrics['train_seconds']:.0f} s of training\n"
        f"look at it: {way}{join(['nsvq', 'view', folder.as_posix()])}\n"
    )
