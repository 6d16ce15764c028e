"""What callbacks share: the check of the module, acting once per step, the folder of the run, the search for NaN."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, dataclass_transform

import numpy as np
from lightning.pytorch import Callback, Trainer
from torch.utils._pytree import tree_map_only

from nsvq_lightning.quantize.codebook import held_codes
from nsvq_lightning.report.pictures import file_stem
from nsvq_lightning.training import row_ops
from nsvq_lightning.training.module import SplatModule
from nsvq_lightning.training.run_folder import hold, is_fast_dev_run, let_go, run_folder
from nsvq_lightning.training.run_scene import scene_of

from .settings import check_settings


def _with_settings(cls: type["SplatCallback"], /, **options: bool) -> None:
    """Make a subclass a dataclass, if it has settings of its own."""
    super(SplatCallback, cls).__init_subclass__()
    if options or {"__annotations__", "__annotate_func__"} & vars(cls).keys():  # whose names may be unknown yet
        dataclass(eq=False, **options)(cls)


@dataclass_transform(eq_default=False, field_specifiers=(field,))
class SplatCallback(Callback):
    """Base of the callbacks that train a :class:`nsvq_lightning.SplatModule`.

    A callback decides by the module's ``schedule`` and the trainer's step alone, so that each works without the others.
    What is to happen once per iteration goes into :meth:`before_step` and :meth:`after_step`; with gradient
    accumulation Lightning calls the hooks that they come from for every view of the iteration. A subclass that
    overrides ``setup``, or one of these hooks beside its method, calls it here first.

    Each subclass with annotations is made a dataclass; ``@dataclass`` above it would lose its ``field(…)``. Its fields
    are its settings: the types of :mod:`nsvq_lightning.callbacks.settings` say what they may be, the text below each is
    its help. What it has reached are attributes without an annotation, or with ``init=False``; :attr:`state` names
    those that checkpoints carry. One that overrides ``__post_init__`` calls it here, for the check of the settings.

    A callback that acts at certain iterations has a method ``is_due(module, iteration)``, and acts where that is true:
    a subclass changes when by overriding it.

    Attributes:
        state: Attributes that checkpoints carry, and that have the values of the class when a fit starts.
        passing: Attributes that have the values of the class when a fit starts, and that no checkpoint carries.

    Raises:
        ValueError: A setting is out of its bounds, or not finite.
    """

    state: ClassVar[tuple[str, ...]] = ()
    passing: ClassVar[tuple[str, ...]] = ()
    _acted: ClassVar[dict[str, int]] = {}
    __init_subclass__ = classmethod(_with_settings)

    def __post_init__(self) -> None:
        check_settings(self)

    def setup(self, trainer: Trainer, module: SplatModule, stage: str) -> None:
        """Check the module, and forget an earlier fit; a checkpoint's state is loaded after this.

        Raises:
            TypeError: It is no SplatModule.
        """
        if not isinstance(module, SplatModule):
            raise TypeError(f"{type(self).__name__} needs a SplatModule: derive {type(module).__name__} from it")
        if stage == "fit":
            for name in ("_acted", *self.state, *self.passing):
                vars(self).pop(name, None)
            # All of them: whichever comes first may need what the last one says.
            for each in trainer.callbacks:  # type: ignore[attr-defined]  # Lightning does not type it
                if isinstance(each, SplatCallback):
                    each.tell(module)
            self.before_fit(trainer, module)

    def tell(self, module: SplatModule) -> None:
        """Set on the module what other callbacks ask of this one, before any of them acts."""

    def before_fit(self, trainer: Trainer, module: SplatModule) -> None:
        """Act when a fit is set up, before its splats are made."""

    def state_dict(self) -> dict[str, Any]:
        """What :attr:`state` names, and the last iterations acted on."""
        state = {name: getattr(self, name) for name in ("_acted", *self.state)}
        return tree_map_only(np.generic, lambda number: number.item(), state)  # type: ignore[no-any-return]

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on from there: what was done before the checkpoint is not repeated."""
        vars(self).update(state_dict)

    def before_step(self, trainer: Trainer, module: SplatModule, iteration: int) -> None:
        """Act before an iteration, once, also where the run is resumed in between."""

    def after_step(self, trainer: Trainer, module: SplatModule, iteration: int) -> None:
        """Act after a complete iteration, once, also where the run is resumed in between."""

    def on_train_batch_start(self, trainer: Trainer, module: SplatModule, *args: Any) -> None:
        """Call :meth:`before_step`."""
        iteration = trainer.global_step + 1
        if first_time(self, "before", iteration):
            self.before_step(trainer, module, iteration)

    def on_train_batch_end(self, trainer: Trainer, module: SplatModule, outputs: Any, *args: Any) -> None:
        """Call :meth:`after_step`."""
        iteration = trainer.global_step
        if iteration and first_time(self, "after", iteration):
            self.after_step(trainer, module, iteration)


def first_time(callback: SplatCallback, hook: str, iteration: int) -> bool:
    """Whether a callback acts in an iteration for the first time; notes that it does."""
    if callback._acted.get(hook) == iteration:
        return False
    vars(callback)["_acted"] = callback._acted | {hook: iteration}
    return True


class WritingCallback(SplatCallback):
    """Callback that writes files: it takes the folder of the run when the run starts, not when the first file is due.

    A subclass that overrides these hooks calls them here first.

    Attributes:
        stages: Stages in which it writes: ``fit``, or ``test``, too.
    """

    stages: ClassVar[tuple[str, ...]] = ("fit",)

    def setup(self, trainer: Trainer, module: SplatModule, stage: str) -> None:
        """Check the module, and for a test take the folder.

        Raises:
            FileExistsError: It holds another run.
        """
        super().setup(trainer, module, stage)
        if stage != "fit" and stage in self.stages:
            take_folder(trainer)

    def on_fit_start(self, trainer: Trainer, module: SplatModule) -> None:
        """Take the folder, now that the trainer knows which checkpoint it continues from.

        Raises:
            FileExistsError: It holds another run.
        """
        take_folder(trainer)

    def teardown(self, trainer: Trainer, module: SplatModule, stage: str) -> None:
        """Let go of the folder: nothing is written after this."""
        if stage in self.stages:
            let_go(run_folder(trainer))


def take_folder(trainer: Trainer) -> None:
    """Take the folder of the run, again if an earlier stage of the run has ended.

    Raises:
        FileExistsError: It holds another run.
    """
    folder = run_folder(trainer)  # a collective of all processes
    if trainer.is_global_zero and not is_fast_dev_run(trainer):
        hold(folder)


def picture_file(trainer: Trainer, folder: Path, view: str) -> Path:
    """File for the picture of a view of the trainer's scene, by its name."""
    scene = scene_of(trainer)
    return folder / f"{file_stem(view, () if scene is None else scene.names)}.png"


def finite_search_is_due(trainer: Trainer, every: int) -> bool:
    """Whether to search for NaN and infinite values now, at the end of an iteration: at intervals, and if need be.

    After a step with a non-finite loss no parameter has a gradient, on any process
    (:class:`nsvq_lightning.SplatModule`, :class:`nsvq_lightning.training.distributed.ViewParallelStrategy`). So all
    processes decide alike without communication.

    Args:
        trainer: The trainer.
        every: Iterations between two searches; a step without an update always causes one.
    """
    return trainer.global_step % every == 0 or not has_gradients(trainer)


def has_gradients(trainer: Trainer) -> bool:
    """Whether any parameter has a gradient, which none has on any process if a loss of theirs was not finite."""
    groups = trainer.optimizers[0].param_groups
    return any(parameter.grad is not None for group in groups for parameter in group["params"])


def keep_finite_splats(module: SplatModule) -> None:
    """Drop non-finite splats, with their codes (:func:`nsvq_lightning.training.row_ops.drop_non_finite`).

    The replicas of several processes are equal, so all drop the same splats without communication. Dropping splats
    loses gradients: call it between an update and the next backward pass.

    Raises:
        FloatingPointError: No finite splat is left.
    """
    trainer = module.trainer
    kept = row_ops.drop_non_finite(module.splats, trainer.optimizers[0], trainer.global_step)
    if len(module.splats) == len(kept):
        return
    for quantizer in module.quantizers.values():
        if (held := held_codes(quantizer, len(kept))) is not None:
            quantizer.hold(held[kept])  # type: ignore[attr-defined]
        if len(quantizer.codes) > 0:
            quantizer.freeze(quantizer.codes[kept])
