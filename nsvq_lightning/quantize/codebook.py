"""What callbacks expect of a quantizer, and the base of those here: a codebook from its placement to the file."""

from abc import ABC, abstractmethod
from typing import Any, Literal, Protocol, cast

import torch
from torch import Generator, Tensor, nn

from nsvq_lightning.compute.memory import check_inside
from nsvq_lightning.quantize.kmeans import draw_far_rows, kmeans, lookup, mean_by_code, shuffled
from nsvq_lightning.quantize.nearest import nearest
from nsvq_lightning.quantize.tracking import NearestTracker
from nsvq_lightning.random import generator as seeded
from nsvq_lightning.skips import is_on
from nsvq_lightning.top_level import log

# Rows as they are rendered ``[V, D]``, and their codes ``[V]``.
Quantized = tuple[Tensor, Tensor]
# What k-means starts from.
Start = Literal["sample", "spread"]


def copy_codes(active: Tensor, count: int, generator: Generator) -> Tensor:
    """New codes ``[count, D]`` by the paper's rule: random picks of the active codes ``[A, D]``, plus noise of 1e-12.

    None is picked twice before all have been picked once. In float32 the noise rarely changes a value, so a copy gets
    rows only once training has moved it.
    """
    order = [shuffled(active, generator) for _ in range(-(-count // len(active)))]
    noise = torch.randn(count, active.shape[1], generator=generator, device=generator.device)
    return active[torch.cat(order)[:count]] + 1e-12 * noise.to(active)


def split_codes(active: Tensor, rows: Tensor, count: int, jitter: float, generator: Generator) -> Tensor:
    """New codes next to the active ones with the largest distortion, each placed where it takes over rows at once.

    For each far row x that is drawn (:func:`~nsvq_lightning.quantize.kmeans.draw_far_rows`), its code c is split: the
    new code c + jitter · (x − c) lies that fraction of the way from c to x. So codes are split in proportion to their
    share of the distortion.

    Args:
        active: Active codes ``[A, D]``, A > 0.
        rows: Rows of the scene ``[N, D]``.
        count: Number of new codes wanted.
        jitter: In (0, 1]: near 0 a copy of the code, at 1 the row itself.
        generator: Source of the draw.

    Returns:
        New codes ``[count, D]``; fewer if fewer rows differ from their code.
    """
    far = rows[draw_far_rows(rows, active, count, generator)]
    return active[nearest(far, active)].lerp(far, jitter)


class CodebookQuantizer(nn.Module, ABC):
    """Base of the quantizers with one codebook; a subclass defines what training renders in place of the codes.

    Args:
        num_codes: Codes K, at least 1; :meth:`fit` may leave fewer.
        dim: Dimension D of a row.
        kmeans_steps: Lloyd steps of :meth:`fit`.
        start: What :meth:`fit` starts from: ``sample`` is random rows, as in the paper; ``spread`` is rows far apart,
            which reaches the sparse ends of the data: on 187 k splats and 4096 codes it reduced the squared error of
            scales by a quarter and gained 0.2 dB of test PSNR right after k-means.

    Attributes:
        max_codes: Codes that :meth:`fit` may place.
        codebook: Codes ``[K, D]`` in the raw space of the attribute, 0 until :meth:`fit`.
        usage: Iterations of the window in which each code was hit at least once, ``[K]`` int64.
        window: Iterations in the window, scalar int64.
        codes: Frozen codes ``[N]`` int64, empty until :meth:`freeze`.
        held: Codes ``[N]`` int64 that rows have in training in place of the nearest ones, see :meth:`hold`; or empty.
        fitted: Whether the codebook has been placed, scalar bool.

    Raises:
        ValueError: An argument is out of range.
    """

    codebook: nn.Parameter
    usage: Tensor
    window: Tensor
    codes: Tensor
    held: Tensor
    fitted: Tensor

    def __init__(self, num_codes: int, dim: int, *, kmeans_steps: int = 10, start: Start = "sample") -> None:
        super().__init__()
        for name, value, bound in (("num_codes", num_codes, 1), ("dim", dim, 1), ("kmeans_steps", kmeans_steps, 0)):
            if value < bound:
                raise ValueError(f"{name} must be at least {bound}, got {value}")
        if start not in ("sample", "spread"):
            raise ValueError(f"start must be 'sample' or 'spread', got {start!r}")
        self.kmeans_steps = kmeans_steps
        self.start = start
        self.max_codes = num_codes
        self._tracker = NearestTracker()
        self.codebook = nn.Parameter(torch.zeros(num_codes, dim))
        for name, shape in {"usage": (num_codes,), "window": (), "codes": (0,), "held": (0,)}.items():
            self.register_buffer(name, torch.zeros(shape, dtype=torch.int64))
        self.register_buffer("fitted", torch.zeros((), dtype=torch.bool))

    @abstractmethod
    def approximate(self, x: Tensor, codes: Tensor, generator: Generator, rows: Tensor | None) -> Tensor:
        """Differentiable stand-in ``[V, D]`` in training for rows ``[V]`` of ``x [N, D]`` with codes ``[V]``.

        ``rows`` is ascending; without it, all rows of ``x`` in order.
        """

    @property
    def num_codes(self) -> int:
        """Number of codes, K."""
        return len(self.codebook)

    @property
    def dim(self) -> int:
        """Dimension of a row, D."""
        return self.codebook.shape[1]

    @property
    def frozen(self) -> bool:
        """Whether :meth:`freeze` has fixed the codes."""
        return self.codes.numel() > 0

    def fit(self, x: Tensor, weight: Tensor | None = None, generator: Generator | None = None) -> None:
        """Place the codebook on rows by k-means; K becomes at most the number of distinct rows, whatever it was before.

        The parameter stays the same object, since an optimiser group refers to it; fit before its first optimiser step.

        Args:
            x: Rows ``[N, D]``.
            weight: Weight of each row, ``[N]``, not negative.
            generator: Source of the random start; by default a fixed one.

        Raises:
            ValueError: ``x`` does not have D columns, has no rows, or is not finite.
        """
        if x.dim() != 2 or x.shape[1] != self.dim:
            raise ValueError(f"rows must have shape [N, {self.dim}], got {list(x.shape)}")
        spread = self.start == "spread"
        centroids = kmeans(x, self.max_codes, generator or seeded(0), weight, self.kmeans_steps, spread=spread)
        self._resize(len(centroids))
        with torch.no_grad():
            self.codebook.copy_(centroids)
        self.fitted.fill_(True)
        self.reset_usage()

    def limit(self, codes: int) -> None:
        """Have at most ``codes`` codes from the next :meth:`fit` on; those there are now are lost if they are more.

        Raises:
            ValueError: ``codes`` is below 1.
        """
        if codes < 1:
            raise ValueError(f"a codebook needs at least 1 code, got {codes}")
        self.max_codes = min(codes, self.max_codes)
        self._resize(min(codes, self.num_codes))

    def forward(self, x: Tensor, generator: Generator | None = None, rows: Tensor | None = None) -> Quantized:
        """Quantize rows; in training this also counts the codes that are hit.

        Args:
            x: Rows of the scene ``[N, D]``.
            generator: Source of the noise, needed in training.
            rows: Which rows to quantize, ``[V]`` int64, ascending, distinct; all of them by default.

        Returns:
            ``x_q [V, D]``, differentiable, and the codes ``[V]`` int64.

        Raises:
            ValueError: In training no generator is given, or codes are frozen for another number of rows.
        """
        if self.frozen:
            codes = self._frozen_codes(len(x), rows)
            return self.decode(codes), codes
        held = held_codes(self, len(x))
        if held is not None and rows is not None:
            held = held[rows]
        codes = self._search(x, rows) if held is None else held
        if not self.training:
            return self.decode(codes), codes
        if generator is None:
            raise ValueError("training needs a generator: pass nsvq_lightning.random.generator(seed, step)")
        self.count(codes)
        return self.approximate(x, codes, generator, rows), codes

    def encode(self, x: Tensor) -> Tensor:
        """Nearest codes ``[N]`` int64 of ``x [N, D]``."""
        return nearest(x, self.codebook)

    def decode(self, codes: Tensor) -> Tensor:
        """Codebook rows ``[N, D]`` of ``codes [N]``, differentiable in the codebook."""
        return lookup(self.codebook, codes)

    @torch.no_grad()
    def count(self, codes: Tensor) -> None:
        """Count one iteration in which ``codes [N]`` were hit."""
        self.usage += torch.zeros_like(self.usage).index_fill_(0, codes, 1)
        self.window += 1

    def reset_usage(self) -> None:
        """Start a new window."""
        self.usage.zero_()
        self.window.zero_()

    @torch.no_grad()
    def replace_unused(self, generator: Generator, rows: Tensor | None = None, jitter: float = 0.5) -> Tensor:
        """Replace inactive codes by active ones and start a new window (paper, section 3.1).

        A code is inactive if it was hit in fewer than 1 % of the window's iterations. By the paper's rule the new codes
        are copies of randomly chosen active codes, plus noise of 1e-12. With ``rows``, the codes with the largest
        distortion are split instead (:func:`~nsvq_lightning.quantize.codebook.split_codes`). The optimiser's state is
        not touched.

        Args:
            generator: Source of the choice and of the noise.
            rows: Rows of the scene ``[N, D]``, or None for the paper's rule.
            jitter: With ``rows``: where a new code lies between the code that is split and one of its rows, in (0, 1].

        Returns:
            The replaced codes ``[R]`` int64; none, with a warning, where no code was active.
        """
        # A non-finite code must not be copied; it is left to `mend`, because its moments are not finite either.
        finite = torch.isfinite(self.codebook).all(1)
        inactive = self.usage < 0.01 * self.window
        replaced = (inactive & finite).nonzero()[:, 0]
        active = self.codebook[~inactive & finite]
        if len(active) == 0 < len(replaced):
            log.warning(f"no code was active in {int(self.window)} iterations; the codebook is left as it is")
            replaced = replaced[:0]
        if len(replaced) > 0:
            if rows is None:
                new = copy_codes(active, len(replaced), generator)
            else:
                new = split_codes(active, rows, len(replaced), jitter, generator)
            replaced = replaced[: len(new)]
            self._tracker.forget()
            self.codebook[replaced] = new
        self.reset_usage()
        return replaced

    @torch.no_grad()
    def mend(self, broken: Tensor, rows: Tensor, generator: Generator) -> None:
        """Repair codes that have become non-finite; at least one other code must be finite.

        A frozen code becomes the mean of the rows that have it; any other becomes a copy of a random finite code, like
        an inactive one.

        Args:
            broken: The codes ``[B]`` int64.
            rows: Rows of the scene ``[N, D]``.
            generator: Source of the choice.

        Raises:
            ValueError: Codes are frozen for another number of rows.
        """
        finite = self.codebook[torch.isfinite(self.codebook).all(1)]
        self.codebook[broken] = copy_codes(finite, len(broken), generator)
        if self.frozen:
            means = mean_by_code(rows, self._frozen_codes(len(rows), None), self.codebook)
            self.codebook[broken] = means[broken]
        self._tracker.forget()

    def freeze(self, codes: Tensor) -> None:
        """Fix the codes ``[N]`` int64; from now on only the codebook is trained.

        Raises:
            ValueError: There is no code, or one is not in [0, K).
            TypeError: The codes are not int64.
        """
        self._check_codes(codes)
        self.codes = codes.to(self.codebook.device, copy=True)
        self.held = self.held.new_zeros(0)

    def hold(self, codes: Tensor) -> None:
        """Give rows the codes ``[N]`` int64 in training and in files, as long as there are N rows; empty ends that.

        Raises:
            ValueError: A code is not in [0, K).
            TypeError: The codes are not int64.
        """
        if codes.numel() > 0:
            self._check_codes(codes)
        self.held = codes.to(self.codebook.device, copy=True)

    def _check_codes(self, codes: Tensor) -> None:
        if codes.dtype != torch.int64:
            raise TypeError(f"codes must be int64, got {codes.dtype}")
        if codes.dim() != 1 or codes.numel() == 0:
            raise ValueError(f"codes must have shape [N] with N > 0, got {list(codes.shape)}")
        check_inside("codes", codes, self.num_codes)

    def _search(self, x: Tensor, rows: Tensor | None) -> Tensor:
        """Nearest codes ``[V]`` of the rows ``rows [V]`` of ``x [N, D]``."""
        if is_on("distance_bounds"):
            return self._tracker.search(x, self.codebook, rows)
        return self.encode(x if rows is None else x.index_select(0, rows))

    def _frozen_codes(self, count: int, rows: Tensor | None) -> Tensor:
        if count != len(self.codes):
            raise ValueError(f"codes are frozen for {len(self.codes)} rows, got {count}; pass all; `rows` chooses")
        return self.codes if rows is None else self.codes[rows]

    def _resize(self, num_codes: int) -> None:
        if num_codes != self.num_codes:
            self.codebook.data = self.codebook.data.new_zeros(num_codes, self.dim)
            self.usage = self.usage.new_zeros(num_codes)
        self.codebook.grad = None

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any) -> None:
        """Resize to the stored number of codes and rows before the values are copied."""
        stored = state_dict.get(f"{prefix}codebook")
        if stored is not None and stored.dim() == 2 and stored.shape[1] == self.dim:
            self._resize(len(stored))
        for name in ("codes", "held"):
            if (rows := state_dict.get(f"{prefix}{name}")) is not None:
                setattr(self, name, self.codes.new_zeros(rows.shape))
        super()._load_from_state_dict(state_dict, prefix, *args)


class Quantizer(Protocol):
    """Vector quantizer of one attribute: maps rows ``[N, D]`` to codes ``[N]``, indices into a codebook ``[K, D]``.

    Implementations are ``nn.Module``s whose ``codebook`` is an ``nn.Parameter`` and whose usage counters and frozen
    codes are buffers, so that checkpoints and device moves carry them. Buffers whose length changes (``codes``, and
    what follows a codebook of which ``fit`` leaves fewer rows) need their new length in ``_load_from_state_dict``, as
    :class:`~nsvq_lightning.quantize.CodebookQuantizer` does it: otherwise no checkpoint can be loaded.

    Callbacks also use what they find of ``held`` and ``hold``, ``refit``, ``limit`` and ``mend`` of
    :class:`~nsvq_lightning.quantize.CodebookQuantizer`, and leave a quantizer without them alone.

    Attributes:
        codebook: Codebook ``[K, D]`` in the raw space of the attribute.
        codes: Frozen codes ``[N]`` int64, empty until :meth:`freeze`.
        usage: Iterations of the current window in which each code was hit at least once, ``[K]`` int64.
        window: Iterations in the current window, scalar int64.
    """

    codebook: Tensor
    codes: Tensor
    usage: Tensor
    window: Tensor

    def fit(self, x: Tensor, weight: Tensor | None = None, generator: Generator | None = None) -> None:
        """Place the codebook on the rows ``x [N, D]`` (k-means); ``K`` shrinks to the number of distinct rows."""

    def forward(self, x: Tensor, generator: Generator | None = None, rows: Tensor | None = None) -> Quantized:
        """Quantize rows of ``x [N, D]`` in training: differentiable ``x_q [V, D]``, codes ``[V]``; counts the usage.

        A quantizer that leaves training alone returns the rows themselves, -1 as their codes, and counts nothing.

        ``rows [V]`` int64, ascending and distinct, selects the rows; without it all rows are quantized. Gathering them
        (:func:`nsvq_lightning.compute.rows.take_rows`) is left to the quantizer, whose kernels may do it themselves.
        """

    def encode(self, x: Tensor) -> Tensor:
        """Nearest codes ``[N]`` int64 of ``x [N, D]``."""

    def decode(self, codes: Tensor) -> Tensor:
        """Codebook rows ``[N, D]`` of ``codes [N]``, differentiable in the codebook."""

    def replace_unused(self, generator: Generator, rows: Tensor | None = None, jitter: float = 0.5) -> Tensor:
        """Replace inactive codes by active ones and restart the window; returns the replaced codes ``[R]``.

        Callbacks pass ``rows [N, D]`` and ``jitter`` to split codes by the distortion of these rows, as they do by
        default; a quantizer that cannot do that may omit both, and needs ``CodebookReplacement(jitter=None)``.
        """

    def freeze(self, codes: Tensor) -> None:
        """Fix the codes ``[N]``; from now on only the codebook is trained."""


def as_quantizer(module: object) -> Quantizer:
    """The module as a quantizer.

    Raises:
        TypeError: It lacks a member of :class:`Quantizer`; the message says which.
    """
    # Not by isinstance: since Python 3.12 it misses parameters and buffers, which an nn.Module gives by `__getattr__`.
    members = {name for name in (*Quantizer.__annotations__, *vars(Quantizer)) if not name.startswith("_")}
    if lacks := sorted(name for name in members if not hasattr(module, name)):
        raise TypeError(
            f"{type(module).__name__} is not a quantizer; it lacks: {', '.join(lacks)}; derive it from "
            "nsvq_lightning.quantize.CodebookQuantizer, or offer the members of nsvq_lightning.quantize.Quantizer"
        )
    quantizer = cast(Quantizer, module)
    bare = getattr(quantizer.forward, "__func__", None) is nn.Module.forward  # which every module has
    if bare or not isinstance(module, nn.Module) or not isinstance(quantizer.codebook, nn.Parameter):
        raise TypeError(
            f"{type(module).__name__} is not a quantizer: it must be an nn.Module with a forward, whose codebook is an "
            "nn.Parameter, so that checkpoints carry it and the optimiser trains it"
        )
    others = [name for name, each in module.named_parameters() if each.requires_grad and each is not quantizer.codebook]
    if others:
        what = f"has parameters beside its codebook, {', '.join(others)}"
        raise TypeError(f"{type(module).__name__} {what}, which are neither trained nor stored: make them buffers")
    return quantizer


def held_codes(quantizer: object, count: int) -> Tensor | None:
    """The codes ``[count]`` that rows hold in training; None if they hold none, or are of another number."""
    held = getattr(quantizer, "held", None)
    return held if held is not None and len(held) == count > 0 else None
