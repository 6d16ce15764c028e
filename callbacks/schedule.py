"""What follows the iteration alone: the phase, the degree of the spherical harmonics, falling learning rates."""

from dataclasses import field, fields
from typing import Any

from lightning.pytorch import Trainer

from nsvq_lightning.top_level import log
from nsvq_lightning.training import run_scene
from nsvq_lightning.training.module import SplatModule
from nsvq_lightning.training.schedule import Phase, Schedule

from .base import SplatCallback
from .forecast import iterations_within
from .settings import Count, Factor, Positive, Whole

# Below so many, every minute more, or smaller photos, makes a scene visibly better.
MIN_ITERATIONS = 1500


class PhaseSchedule(SplatCallback):
    """Gives the module its schedule, and the phase of each iteration.

    The ends of the phases are iterations of a reference run; a run of any other length is that run, scaled
    (:mod:`nsvq_lightning.training.schedule` says how). The defaults are those of the recipe (docs/recipe.md), for a run
    of 15 000 iterations; ``configs/paper.yaml`` has the paper's.

    Raises:
        ValueError: See :class:`~nsvq_lightning.training.schedule.Schedule`.

    Example:
        >>> from nsvq_lightning.callbacks import PhaseSchedule
        >>> PhaseSchedule().schedule(3000).ends  # --trainer.max_steps=3000
        (1600, 2120, 2520, 3000)
        >>> PhaseSchedule(warmup_end=10_000).schedule(3000).ends  # --callbacks.phases.warmup_end=10000
        (2000, 2120, 2520, 3000)
    """

    total: int | None = None
    """Iterations that the phases are laid out for; None takes ``trainer.max_steps``, which ends the run in any case:
    where it is larger, the last phase goes on."""
    reference_total: int | None = 15_000
    """Iterations of the run that the ends are given for; None means ``total``: nothing scales."""
    warmup_end: int = 8000
    """Last iteration of the warm-up phase in the reference run."""
    prune_end: int = 10_600
    """Last iteration of the prune phase in the reference run."""
    quantize_end: int = 12_600
    """Last iteration of the quantize phase in the reference run."""
    position_decay: int = 10_600
    """Iteration of the reference run from which the position's learning rate is constant."""
    min_density_interval: int = 100
    """Lower limit of the interval of density control in this run."""
    min_reset_interval: int = Schedule.min_reset_interval
    """Lower limit of the interval of opacity resets in this run."""
    min_replacement_interval: int = Schedule.min_replacement_interval
    """Lower limit of the window of code replacement and of the interval of refits."""
    min_finetune: int = Schedule.min_finetune
    """Lower limit of the length of the fine-tune phase, up to half of what follows the prune phase."""
    iterations_per_photo: Count | None = None
    """Most iterations for each train photo, as few are soon overfitted. None is ``trainer.max_steps`` whatever the
    photos; ``total`` goes before it."""
    least_iterations: Count = 1
    """What ``iterations_per_photo`` leaves in any case."""
    minutes: Positive | None = None
    """Time to train on this machine, instead of a number of iterations: as many are chosen as measured steps are likely
    to allow, and fine-tuning then ends when the time is over: not before half of it, and a quarter of the run later at
    most. ``config.yaml`` of the run has both numbers."""
    _steps = -1
    _asked = -1
    # What this callback has set in the trainer, which a next fit does not take for what was asked.
    _max_steps: int | None = field(default=None, init=False)
    passing = ("_tuned_since",)
    _tuned_since: float | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.total is not None or self.reference_total is not None:
            # Report wrong settings at once, not after the scene is loaded.
            self.schedule(self.total or self.reference_total or 1)

    def schedule(self, total: int) -> Schedule:
        """The schedule of a run of ``total`` iterations."""
        own = {each.name: getattr(self, each.name) for each in fields(Schedule) if hasattr(self, each.name)}
        return Schedule(**own | {"total": total, "reference_total": self.reference_total or total})

    def limited(self, max_steps: int, photos: int) -> int:
        """Iterations of a run of at most ``max_steps`` (negative for no limit) with so many train photos."""
        if self.iterations_per_photo is None:
            return max_steps
        limit = max(self.iterations_per_photo * photos, self.least_iterations)
        return max_steps if 0 <= max_steps <= limit else limit

    def _set_max_steps(self, trainer: Trainer, steps: int) -> None:
        trainer.fit_loop.epoch_loop.max_steps = self._max_steps = steps
        if trainer.max_steps != steps:
            raise RuntimeError(f"this version of Lightning keeps max_steps={trainer.max_steps}: set it to {steps}")

    def before_step(self, trainer: Trainer, module: SplatModule, iteration: int) -> None:
        """Once a fifth of fine-tuning has been timed, let the run end when its minutes are over."""
        first, end = module.schedule.first_of(Phase.FINETUNE), module.schedule.ends[-1]
        if self.minutes is None or first is None or iteration < first:
            return
        timed = (end - first) // 5
        module.stopwatch.lap()
        seconds = module.stopwatch.seconds
        if iteration == first:
            self._tuned_since = seconds
        elif iteration == first + timed and self._tuned_since is not None:
            pace = (seconds - self._tuned_since) / timed
            planned, left = end - iteration, round((60 * self.minutes - seconds) / pace)
            left = min(max(left, planned // 2), planned + module.schedule.part(4))
            self._steps = iteration + trainer.strategy.broadcast(left) + module.schedule.saved
            log.info(f"iterations: {self._steps}, as they take {1000 * pace:.0f} ms each now")

    def before_fit(self, trainer: Trainer, module: SplatModule) -> None:
        """Set the module's schedule.

        Raises:
            ValueError: ``trainer.max_steps`` is not set and neither is ``total``; or the limit for each photo needs a
                data module with a scene.
        """
        if self.minutes is not None:
            steps = iterations_within(self.minutes, trainer, module, self.schedule(self.reference_total or 1))
            self._set_max_steps(trainer, steps)
            log.info(f"iterations: {steps}, about {self.minutes:g} min of training; evaluations and test come on top")
            if steps < MIN_ITERATIONS:
                log.warning("that is few: a smaller --data.max_width, or a smaller --quality, helps")
        elif self.iterations_per_photo is not None and self.total is None:
            need = "a number of iterations for each photo needs the photos"
            photos = len(run_scene.needed_scene(trainer, need, "leave iterations_per_photo unset").train)
            asked = self._asked if trainer.max_steps == self._max_steps else trainer.max_steps
            self._asked, steps = asked, self.limited(asked, photos)
            if steps != trainer.max_steps:
                self._set_max_steps(trainer, steps)
                log.info(f"iterations: {steps} for {photos} photos; --callbacks.phases.iterations_per_photo changes it")
        # Beside minutes, a total is that of an earlier run's config: it holds where a checkpoint of that run goes on.
        total = trainer.max_steps if self.total is None or (self.minutes and not trainer.ckpt_path) else self.total
        if total < 1:
            raise ValueError(
                f"the run has no length: trainer.max_steps is {trainer.max_steps}; set trainer.max_steps (45000 in the "
                "paper) or PhaseSchedule.total"
            )
        self._steps = trainer.max_steps if trainer.max_steps >= 0 else total
        module.schedule = self.schedule(total)
        if trainer.max_steps > 1.25 * total:
            log.info(f"the phases are those of {total} iterations: --callbacks.phases.total=null scales them")
        if trainer.max_steps > 0 and module.schedule.phase_at(trainer.max_steps) < module.schedule.phase_at(total):
            log.warning(
                f"trainer.max_steps={trainer.max_steps} ends this run in its "
                f"{module.schedule.phase_at(trainer.max_steps).name.lower()} phase, the schedule has {total}: the "
                "scene will not be fine-tuned to its codebooks; leave PhaseSchedule.total unset to scale the phases"
            )

    def on_train_start(self, trainer: Trainer, module: SplatModule) -> None:
        """Check that a run continues in the phase that the module is in, to the end that its warm-up has decided.

        Raises:
            ValueError: In this schedule, the last trained iteration is in another phase.
        """
        self._set_max_steps(trainer, self._steps - module.schedule.saved)
        step = trainer.global_step
        expected = module.schedule.phase_at(step) if step else Phase.WARMUP
        # A checkpoint may have been written just after the next iteration began.
        if module.phase is expected or (step and module.phase is module.schedule.phase_at(step + 1)):
            return
        if step == 0:
            raise ValueError(
                f"module already trained into its {module.phase.name.lower()} phase; make a new one, or pass ckpt_path"
            )
        raise ValueError(
            f"the module is in its {module.phase.name.lower()} phase, but iteration {step} of a run of "
            f"{module.schedule.total} iterations is in the {expected.name.lower()} phase. A new module needs a new "
            "trainer. To continue a checkpoint, pass the trainer.max_steps it was started with, or that number as "
            "PhaseSchedule.total (--callbacks.phases.total) and a larger trainer.max_steps to continue its last phase"
        )

    on_fit_end = on_train_start  # also where no iteration was left to train, before files are written

    def on_train_batch_start(self, trainer: Trainer, module: SplatModule, *args: Any) -> None:
        """Write the phase of the iteration that starts; end the run earlier by what its warm-up has saved."""
        self._set_max_steps(trainer, self._steps - module.schedule.saved)
        module.phase = module.schedule.phase_at(trainer.global_step + 1)
        super().on_train_batch_start(trainer, module, *args)


class ShDegreeSchedule(SplatCallback):
    """Starts with SH degree 0 and adds one at intervals, up to the degree of the splats.

    Example:
        >>> from nsvq_lightning.callbacks import ShDegreeSchedule
        >>> from nsvq_lightning.training.schedule import Schedule
        >>> degrees = ShDegreeSchedule(every=2000)  # --callbacks.sh_degree.every=2000
        >>> [Schedule(total=4500).sh_degree_at(iteration, degrees.every, 3) for iteration in (1, 200, 400, 600, 800)]
        [0, 1, 2, 3, 3]
    """

    every: Count = 500
    """Iterations of the reference run between two degrees (1000 in the paper)."""

    def before_step(self, trainer: Trainer, module: SplatModule, iteration: int) -> None:
        """Set the degree of the iteration that starts."""
        degree = module.schedule.sh_degree_at(iteration, self.every, module.splats.sh_degree)
        # A run that starts from a trained scene keeps its degree.
        module.active_sh_degree = max(degree, module.active_sh_degree)


class LearningRateDecay(SplatCallback):
    """Lets all learning rates but that of the positions, which have their own, fall in the last iterations of a run.

    They fall from their value to ``final`` times it, linearly in the logarithm.
    """

    final: Factor = 0.1
    """Factor at the end of the run; 1 leaves the rates alone."""
    start: Whole | None = 10_600
    """Iteration of the reference run at which they begin to fall; None for the start of fine-tuning."""

    def on_train_batch_start(self, trainer: Trainer, module: SplatModule, *args: Any) -> None:
        """Scale the rates of this iteration."""
        super().on_train_batch_start(trainer, module, *args)
        schedule = module.schedule
        start = schedule.ends[Phase.QUANTIZE] if self.start is None else schedule.iteration(self.start)
        progress = min(max((trainer.global_step + 1 - start) / max(schedule.ends[Phase.FINETUNE] - start, 1), 0.0), 1.0)
        for group in trainer.optimizers[0].param_groups:
            if group["name"] != "means":
                module.scale_rate(group["name"], self.final**progress)
