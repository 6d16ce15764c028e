"""The backward pass of the projection, 16 splats at a time, to gradients of the attributes."""

import numpy as np

from nsvq_lightning.compute import simd
from nsvq_lightning.compute.jit import inline, parallel
from nsvq_lightning.compute.rows import clear, vector_share
from nsvq_lightning.compute.simd import get, integer, load, prefetch, put
from nsvq_lightning.rendering import formulas
from nsvq_lightning.rendering.cpu import records as rec
from nsvq_lightning.rendering.cpu.harmonics import AHEAD, coefficients_of, color_backward, prefetch_sh


@inline
def clear_rows(first, last, stride, gradients):
    """Zero the gradients of rows that are not in view."""
    widths = (3, 4, 3, 1, 3, stride)
    for k in range(6):
        clear(gradients[k], widths[k] * first, widths[k] * last)


@parallel
def project_backward(
    part, parts, camera, sampling, geometry, shN, bands, ids, count, records, integers, sums, g_means2d, gradients
):
    """Gradients of all raw attributes from the sums of the slots of the visible splats; 0 for the others.

    ``sums[16·slot]`` of a splat's first slot holds its total; ``g_means2d [N·2]`` the gradient of its projected centre.
    ``geometry`` are means, quaternions, log-scales and logits, ``bands`` as in ``add_colors``, ``sampling`` as in
    ``project_splats``.
    """
    means, quats, scales, logits = geometry
    g_means, g_quats, g_scales, g_logits, g_sh0, g_shN = gradients
    stride, coefficients = bands[0], coefficients_of(bands[1])
    work, slot = simd.scratch(32), simd.scratch(16).view(np.int32)
    # Between its first and last visible splat, every part clears the rows that it skips.
    begin, end = vector_share(count, part, parts)
    row = integer(ids, begin - 1) + 1 if begin > 0 else 0
    for i in range(begin, end):
        here = integer(ids, i)
        if here > row:
            clear_rows(row, here, stride, gradients)
        row = here + 1
    if part == parts - 1:
        clear_rows(row, logits.shape[0], stride, gradients)
    for start in range(begin, end, 16):
        prefetch_sh(shN, ids, start + AHEAD, end, stride, coefficients)
        prefetch_sh(g_shN, ids, start + AHEAD, end, stride, stride)
        if start + AHEAD < end:
            for lane in range(16):
                prefetch(sums, rec.record_of(integers, rec.record_of(ids, start + AHEAD + lane) + rec.SLOT))
        for lane in range(16):
            row = integer(ids, start + lane)
            put(slot, lane, get(integers, rec.RECORD * row + rec.SLOT))
            put(work, lane, get(g_means2d, 2 * row))
            put(work, 16 + lane, get(g_means2d, 2 * row + 1))
        g2x, g2y = load(work, 0), load(work, 16)
        total = simd.gather_columns(sums, slot, 0, rec.RECORD, 0)
        record = simd.gather_columns(records, ids, start, rec.RECORD, 0)
        mean = simd.gather_rows3(means, ids, start)
        quat, scale = simd.gather_rows4(quats, ids, start), simd.gather_rows3(scales, ids, start)
        view = rec.load_view(camera)
        factor = record[rec.A : rec.LOG2_OPACITY]
        moments = total[rec.SUM_UU : rec.SUM_DEPTH]
        trained_at = None
        if sampling is not None:
            nearest, farthest = simd.gather_rows1(sampling[0], ids, start), simd.gather_rows1(sampling[1], ids, start)
            trained_at = nearest[0], farthest[0], sampling[2]
        g_mean, g_quat, g_scale = formulas.geometry_backward(
            view, formulas.view_point(view, mean), quat, scale, factor, moments, total[rec.SUM_H], (g2x, g2y),
            total[rec.SUM_DEPTH], trained_at,
        )  # fmt: skip
        rgb = formulas.unclamped(record[rec.RED : rec.DEPTH], total[rec.SUM_RED : rec.SUM_H])
        through_color = color_backward(camera, bands, mean, shN, ids, start, rgb, g_sh0, g_shN)
        simd.scatter_rows3(g_means, ids, start, formulas.add3(g_mean, through_color))
        simd.scatter_rows4(g_quats, ids, start, g_quat)
        simd.scatter_rows3(g_scales, ids, start, g_scale)
        logit = simd.gather_rows1(logits, ids, start)[0]
        simd.scatter_rows1(g_logits, ids, start, (formulas.logit_gradient(logit, total[rec.SUM_H]),))
