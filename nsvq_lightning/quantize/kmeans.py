"""k-means as the paper initializes codebooks: distinct random rows, Lloyd steps, empty clusters keep their centroid.

Sums of rows by code, also the gradient of a codebook, have the same bits on any number of threads.
"""

from typing import Any

import torch
from torch import Generator, Tensor
from torch.autograd.function import once_differentiable

from nsvq_lightning.compute.devices import kernels_for
from nsvq_lightning.compute.jit import parallel, thread_count
from nsvq_lightning.compute.memory import check_fit, flat
from nsvq_lightning.compute.rows import put_rows, share
from nsvq_lightning.quantize.nearest import nearest
from nsvq_lightning.splats.splats import distinct_rows


@parallel
def _sum_rows(part, parts, values, codes, sums):
    """Each part owns a range of codes and scans all rows, so the order of the threads cannot change a sum."""
    first, last = share(sums.shape[0], part, parts)
    for i in range(codes.shape[0]):
        code = codes[i]
        if first <= code < last:
            for j in range(values.shape[1]):
                sums[code, j] += values[i, j]


def sum_by_code(values: Tensor, codes: Tensor, num_codes: int, dtype: torch.dtype | None = None) -> Tensor:
    """Sum the rows of each code, in the order of the rows.

    Args:
        values: Rows ``[N, D]``.
        codes: Codes ``[N]`` int64; a row whose code is not in [0, K) is ignored.
        num_codes: K.
        dtype: Dtype of the sums, that of ``values`` by default.

    Returns:
        Sums ``[K, D]``; 0 for a code without rows.

    Raises:
        ValueError: The values are not ``[N, D]``, or there is not one code per row.
        TypeError: The values are neither float32 nor float64, or the codes not int64.
    """
    if values.dim() != 2 or codes.shape != values.shape[:1]:
        raise ValueError(f"values must be [N, D] and codes [N], got {list(values.shape)} and {list(codes.shape)}")
    if values.dtype not in (torch.float32, torch.float64):
        raise TypeError(f"values must be float32 or float64, got {values.dtype}")
    values, dtype = values.detach(), dtype or values.dtype
    if kernels_for(values) == "cuda":
        from nsvq_lightning.quantize.cuda.substitution import sum_rows

        return sum_rows(values, codes, num_codes, dtype)
    check_fit("codes [N] int64", codes.contiguous())
    sums = torch.zeros(num_codes, values.shape[1], dtype=dtype)
    _sum_rows(thread_count(), values.cpu().contiguous().numpy(), flat(codes.cpu()), sums.numpy())
    return sums.to(values.device)


def lookup(codebook: Tensor, codes: Tensor, x: Tensor | None = None, rows: Tensor | None = None) -> Tensor:
    """Rows ``[V, D]`` of ``codebook [K, D]`` for the codes, with a gradient that is summed in a fixed order.

    With ``x [N, D]`` the gradient is also that of its rows ``rows [V]``, or of all of them: it passes straight through.
    """
    return _Lookup.apply(codebook, codes, x, rows)  # type: ignore[no-any-return]


class _Lookup(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, codebook: Tensor, codes: Tensor, x: Tensor | None, rows: Tensor | None) -> Tensor:
        ctx.save_for_backward(codes, rows)
        ctx.num_codes = len(codebook)
        ctx.count = 0 if x is None else len(x)
        return codebook.index_select(0, codes)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, None, Tensor | None, None]:
        codes, rows = ctx.saved_tensors
        by_code = by_row = None
        if ctx.needs_input_grad[0]:
            by_code = sum_by_code(grad, codes, ctx.num_codes)
        if ctx.needs_input_grad[2]:
            by_row = grad if rows is None else put_rows(grad, rows, ctx.count)
        return by_code, None, by_row, None


@torch.no_grad()
def kmeans(
    x: Tensor,
    k: int,
    generator: Generator,
    weight: Tensor | None = None,
    steps: int = 10,
    start: Tensor | None = None,
    spread: bool = False,
) -> Tensor:
    """Centroids of the rows under the (weighted) squared distance.

    Sums are taken in float64 in the order of the rows, so the result is the same for any number of threads.

    Args:
        x: Rows ``[N, D]``, finite.
        k: Number of centroids wanted.
        generator: Source of the random start.
        weight: Weight of each row, ``[N]``, not negative; rows of weight 0 are left out.
        steps: Lloyd steps.
        start: Initial centroids ``[k, D]``; by default a random sample of the distinct rows.
        spread: Without ``start``: start from distinct rows far apart
            (:func:`~nsvq_lightning.quantize.kmeans.rows_far_apart`) instead.

    Returns:
        Centroids ``[k', D]`` with k' = min(k, number of distinct rows); if k is at least that number, the distinct rows
        themselves, in the order of their first occurrence.

    Raises:
        ValueError: A shape does not fit, there is no row, a value is not finite, or a weight is negative.
    """
    if x.dim() != 2 or len(x) == 0 or k < 1:
        raise ValueError(f"k-means needs rows [N, D] with N > 0 and k > 0, got shape {list(x.shape)} and k = {k}")
    if bad := int((~torch.isfinite(x).all(1)).sum()):
        raise ValueError(f"{bad} of {len(x)} rows are not finite; drop them before k-means")
    if weight is not None:
        if weight.shape != x.shape[:1] or not (weight >= 0).all() or not (weight > 0).any():
            raise ValueError(f"weight must have shape [{len(x)}], no negative and at least one positive value")
        used, weight = weight > 0, weight.double()
        if not used.all():
            x, weight = x[used], weight[used]
    if start is None:
        distinct = x[distinct_rows(x)]
        if len(distinct) <= k:
            return distinct
        start = rows_far_apart(distinct, k, generator) if spread else distinct[shuffled(distinct, generator)[:k]]
    centroids = start.clone()
    for _ in range(steps):
        centroids = mean_by_code(x, nearest(x, centroids), centroids, weight)
    return centroids


def shuffled(rows: Tensor, generator: Generator) -> Tensor:
    """The numbers ``[N]`` of the rows ``[N, D]`` in random order."""
    return torch.randperm(len(rows), generator=generator, device=generator.device).to(rows.device)


def mean_by_code(x: Tensor, codes: Tensor, codebook: Tensor, weight: Tensor | None = None) -> Tensor:
    """Mean of the rows ``x [N, D]`` of each code, taken in float64; a code without rows stays as in ``codebook``."""
    k = len(codebook)
    if weight is None:
        sums = sum_by_code(x, codes, k, torch.float64)
        mass = torch.bincount(codes, minlength=k).double()
    else:
        # A few columns at a time: in float64, all of them would take twice the memory of the rows.
        sums = torch.cat([sum_by_code(part * weight[:, None], codes, k) for part in x.split(8, dim=1)], dim=1)
        mass = sum_by_code(weight[:, None], codes, k)[:, 0]
    means = sums / mass.clamp_min(torch.finfo(torch.float64).tiny)[:, None]
    return torch.where(mass[:, None] > 0, means.to(codebook.dtype), codebook)


def draw_far_rows(rows: Tensor, codebook: Tensor, count: int, generator: Generator) -> Tensor:
    """Indices ``[count]`` of distinct rows, drawn with probabilities that grow with the squared distance to their code.

    This is the D² sampling of k-means++ (Arthur and Vassilvitskii 2007), many rows at a time and without replacement.

    Args:
        rows: Rows ``[N, D]``.
        codebook: Codes ``[K, D]``.
        count: Number of rows wanted; fewer are returned if fewer differ from their code.
        generator: Source of the draw.
    """
    squared = (rows - codebook[nearest(rows, codebook)]).square().sum(1).double().nan_to_num(0)
    # The largest w / e with e ~ Exp(1) are a draw without replacement with weights w (Efraimidis and Spirakis 2006).
    draws = torch.empty(len(rows), dtype=torch.float64, device=generator.device).exponential_(generator=generator)
    return (squared / draws.to(rows.device)).topk(min(count, int((squared > 0).sum()))).indices


def rows_far_apart(rows: Tensor, count: int, generator: Generator) -> Tensor:
    """``[count, D]`` of the distinct rows ``[N, D]``, N ≥ count, that reach into all corners: a start for k-means.

    An eighth is a random sample; then each of three rounds draws as many far rows as there already are. Rows so close
    to these that their squared distance is 0 come last.
    """
    order = shuffled(rows, generator)
    chosen = order[: -(-count // 8)]
    while len(chosen) < count:
        far = draw_far_rows(rows, rows[chosen], min(len(chosen), count - len(chosen)), generator)
        if len(far) == 0:
            return rows[torch.cat([chosen, order[~torch.isin(order, chosen)]])[:count]]
        chosen = torch.cat([chosen, far])
    return rows[chosen]
