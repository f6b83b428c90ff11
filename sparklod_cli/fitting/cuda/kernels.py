"""Kernels of a step on a card, besides those of `render.cuda`: differences of pictures, and Adam."""

from __future__ import annotations

import numpy as np
from numba import cuda

from ...render.kernels.backward import CENTER, LOD_OPACITY, LOG_SCALE, RGB, TURN
from ...render.kernels.shade import sh_gradient_of
from ...system.jit import f4, f8, i4, out, u2
from ...system.jit_cuda import cuda_kernel
from ..kernels.adam import Columns, FitBounds, Gradients, Moments, Rates, size_of, step_of
from ..kernels.view import by_pixel, differences

f32, f64 = np.float32, np.float64

#: Threads that add up the differences of a row of pixels. Chosen.
ROW_THREADS = 32


@cuda_kernel(f4[:, :, :], u2[:, :, :], out(f8[:, :]))
def squared_differences(image, full, sums):
    """Fill sums as `kernels.view.squared_differences` does, a block for each row of pixels."""
    parts = cuda.shared.array((ROW_THREADS, 2), np.float64)
    y, thread = cuda.blockIdx.x, cuda.threadIdx.x
    black, white = f64(0), f64(0)
    for x in range(thread, image.shape[1], ROW_THREADS):
        for c in range(3):
            on_black, on_white = differences(image, full, y, x, c)
            black += f64(on_black * on_black)
            white += f64(on_white * on_white)
    parts[thread, 0], parts[thread, 1] = black, white
    cuda.syncthreads()
    if thread < 2:
        total = f64(0)
        for each in range(ROW_THREADS):
            total += parts[each, thread]
        sums[y, thread] = total


@cuda_kernel(f8[:, :], f8, f8, out(f4[:]))
def weigh_backgrounds(sums, pixels, least_error, weights):
    """Fill (2,) weights of differences on black and on white, 1 / (`pixels` * mean squared error), on one thread."""
    background = cuda.grid(1)
    if background < 2:
        total = f64(0)
        for y in range(sums.shape[0]):
            total += sums[y, background]
        weights[background] = f32(f64(1) / (pixels * (total / pixels + least_error)))


@cuda_kernel(f4[:, :, :], u2[:, :, :], f4[:], out(f4[:, :, :]))
def by_image(image, full, weights, result):
    """Fill the derivatives of the loss by each pixel; see `kernels.view.by_image`."""
    at = cuda.grid(1)
    y, x = at // image.shape[1], at % image.shape[1]
    if y < image.shape[0]:
        by_pixel(image, full, y, x, weights[0], weights[1], result)


@cuda_kernel(f4[:, :], i4[:], f4[:], f4[:, :], f4[:, :], out(f4[:, :]), out(f4[:, :, :]))
def by_sh(center, index, eye, colors, gradients, by_color, by_coefficients):
    """Fill derivatives by a splat's own colour (M, 3), and by its SH (M, K, 3); see `render.gradients.by_sh`.

    `colors` (N, 3) are what the camera saw, `gradients` those of `carry_back`.
    """
    i = cuda.grid(1)
    if i >= index.shape[0]:
        return
    node = index[i]
    for c in range(3):
        by_color[i, c] = gradients[i, RGB + c] if colors[node, c] > f32(0) else f32(0)
    if by_coefficients.shape[1] > 0:
        sh_gradient_of(center, node, eye, by_color, by_coefficients, i)


_COLUMNS = f4[:, :], f4[:, :], f4[:, :], f4[:], f4[:, :], f4[:, :, :]


@cuda_kernel(
    *map(out, _COLUMNS),
    *_COLUMNS,
    *(i4[:], i4[:], f4[:, :], f4[:, :], f4[:, :, :], f4[:], f4, f4),
    *(out(f4[:, :]), out(f4[:, :, :]), out(f4[:, :]), out(i4[:]), out(f4[:, :])),
)
def step(
    center,
    scale,
    quat,
    lod_opacity,
    rgb,
    sh,
    old_center,
    old_scale,
    old_quat,
    old_lod_opacity,
    old_rgb,
    old_sh,
    index,
    slots,
    gradients,
    by_color,
    by_coefficients,
    rates,
    most_d,
    most_growth,
    first,
    first_sh,
    second,
    count,
    moved,
):
    """Move the merged splats that were drawn; see `kernels.adam.step`.

    Columns are of N nodes, as they are now and, `old_`, as they were at first; `gradients` are (M, GRADIENT_COLUMNS),
    `by_color` and `by_coefficients` of `by_sh`; then the numbers of `Rates`, `FitBounds` and `Moments`. `moved` (M, 4)
    is filled with centre and feature size of each node.
    """
    i = cuda.grid(1)
    if i >= index.shape[0]:
        return
    now = Columns(center, scale, quat, lod_opacity, rgb, sh)
    old = Columns(old_center, old_scale, old_quat, old_lod_opacity, old_rgb, old_sh)
    derivatives = Gradients(
        gradients[:, CENTER : CENTER + 3],
        gradients[:, LOG_SCALE : LOG_SCALE + 3],
        gradients[:, TURN : TURN + 3],
        gradients[:, LOD_OPACITY],
        by_color,
        by_coefficients,
    )
    steps = Rates(rates[0], rates[1], rates[2], rates[3], rates[4], rates[5])
    moments, bounds = Moments(first, first_sh, second, count), FitBounds(most_d, most_growth)
    step_of(i, now, old, index, slots, derivatives, steps, moments, bounds)
    node = index[i]
    for axis in range(3):
        moved[i, axis] = center[node, axis]
    moved[i, 3] = size_of(scale, lod_opacity, node) * f32(2) / f32(3)
