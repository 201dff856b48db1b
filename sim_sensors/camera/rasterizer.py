"""Rasterizer: a z-buffer in horizontal bands.

One thread writes each band of rows, with the triangles in a fixed order, so the result does not depend on the number of
threads.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from sim_sensors.camera.projection import ScreenTriangles
from sim_sensors.camera.textures import FAST, LEAF
from sim_sensors.compilation import compiled
from sim_sensors.mesh import Material

Float32Array = NDArray[np.float32]
FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int32]

FAR = 1000.0  # m, the ground ends there
BAND = 16  # rows

_GLASS = int(Material.GLASS)


class Visibility(NamedTuple):
    """The contents of the z-buffer, (h, w) each."""

    # float32, 1/m along the optical axis, of the first opaque surface; 0 for the sky
    inverse_depth: Float32Array
    triangle: IntArray  # int32, of that surface; -1 for ground or sky
    # float32, 1/m, of the nearest pane of glass in front of it; 0 where there is none
    pane_inverse_depth: Float32Array
    pane: IntArray  # int32, that pane's triangle; -1 where there is none
    n_panes: NDArray[np.uint8]  # uint8, number of panes in front of it


def rasterize(
    triangles: ScreenTriangles,
    size: tuple[int, int],
    floor: FloatArray,
    minimum: float = 1.0 / FAR,
    *,
    panes: bool = True,
) -> Visibility:
    """Find the nearest opaque surface of every pixel, and the glass in front of it.

    Args:
        triangles: from `project`.
        size: width, height, px.
        floor: (3,) inverse depth of the ground, a·x + b·y + c at (x, y) px.
        minimum: 1/m; ground with a smaller inverse depth is sky.
        panes: whether to draw glass; if not, its three arrays are (0, 0).
    """
    width, height = size
    glazed = (height, width) if panes else (0, 0)
    out = Visibility(
        np.empty((height, width), dtype=np.float32),
        np.empty((height, width), dtype=np.int32),
        np.empty(glazed, dtype=np.float32),
        np.empty(glazed, dtype=np.int32),
        np.empty(glazed, dtype=np.uint8),
    )
    start, members = _sort_into_bands(
        triangles.corners, triangles.material, (height + BAND - 1) // BAND, height, panes
    )
    _rasterize(
        triangles.corners,
        triangles.inverse_depth,
        start,
        members,
        interleaved(len(start) // 2),
        floor,
        minimum,
        out.inverse_depth,
        out.triangle,
        out.pane_inverse_depth,
        out.pane,
        out.n_panes,
    )
    return out


def interleaved(n: int) -> NDArray[np.int64]:
    """Return a permutation of 0 to n - 1 in which every long run covers the whole range evenly.

    Each thread gets a run of bands, and the top of an image (sky) is cheaper than its middle.
    """
    step = max(1, round(n * 0.382))
    while math.gcd(step, n) != 1:
        step += 1
    return np.arange(n, dtype=np.int64) * step % n


@compiled(nogil=True)
def _sort_into_bands(
    corners: Float32Array, material: NDArray[np.uint8], n_bands: int, height: int, panes: bool
) -> tuple[NDArray[np.int64], IntArray]:
    """Return the triangles of each band in their order: for band b, `members[start[2·b]:start[2·b + 1]]` are opaque.

    The panes of the band follow, up to `start[2·b + 2]`; without `panes` there are none.
    """
    n = corners.shape[0]
    first = np.empty(n, dtype=np.int32)
    last = np.empty(n, dtype=np.int32)
    start = np.zeros(2 * n_bands + 1, dtype=np.int64)
    for t in range(n):
        top = min(corners[t, 1], corners[t, 3], corners[t, 5])
        bottom = max(corners[t, 1], corners[t, 3], corners[t, 5])
        first[t] = int(min(max(top, 0.0), height - 1.0)) // BAND
        last[t] = int(min(max(bottom, 0.0), height - 1.0)) // BAND
        glass = material[t] == _GLASS
        if glass and not panes:
            last[t] = first[t] - 1
        for band in range(first[t], last[t] + 1):
            start[2 * band + glass + 1] += 1
    for place in range(2 * n_bands):
        start[place + 1] += start[place]
    members = np.empty(start[2 * n_bands], dtype=np.int32)
    fill = start[:-1].copy()
    for t in range(n):
        glass = material[t] == _GLASS
        for band in range(first[t], last[t] + 1):
            members[fill[2 * band + glass]] = t
            fill[2 * band + glass] += 1
    return start, members


@compiled(**LEAF)
def edge_slope(x0: float, y0: float, x1: float, y1: float) -> float:
    """Return the change of x per row along an edge; 0 for a horizontal edge, which no row crosses."""
    return (x1 - x0) / (y1 - y0) if y1 != y0 else 0.0


@compiled(**LEAF)
def sorted_by_row(corners: Float32Array) -> tuple[float, float, float, float, float, float]:
    """Return the corners (x, y) of a triangle from top to bottom.

    Neighbours traverse a shared edge from the same end, so no pixel between them is missed or drawn twice.
    """
    ax, ay, bx, by, cx, cy = (
        float(corners[0]), float(corners[1]), float(corners[2]),
        float(corners[3]), float(corners[4]), float(corners[5]),
    )  # fmt: skip
    if by < ay:
        ax, ay, bx, by = bx, by, ax, ay
    if cy < by:
        bx, by, cx, cy = cx, cy, bx, by
    if by < ay:
        ax, ay, bx, by = bx, by, ax, ay
    return ax, ay, bx, by, cx, cy


@compiled(parallel=True, fastmath=FAST, nogil=True)
def _rasterize(
    corners: Float32Array,
    planes: FloatArray,
    start: NDArray[np.int64],
    members: IntArray,
    order: NDArray[np.int64],
    floor: FloatArray,
    minimum: float,
    depth: Float32Array,
    triangle: IntArray,
    pane_depth: Float32Array,
    pane: IntArray,
    n_panes: NDArray[np.uint8],
) -> None:
    height, width = depth.shape
    for task in prange(order.shape[0]):
        band = order[task]
        top = band * BAND
        bottom = min(height, top + BAND)
        for y in range(top, bottom):
            # In double precision: towards the horizon most of the digits cancel.
            base = floor[1] * (y + 0.5) + floor[2] + 0.5 * floor[0]
            for x in range(width):
                value = base + floor[0] * x
                depth[y, x] = value if value > minimum else 0.0
            triangle[y] = -1
            if pane.shape[0] > 0:
                pane_depth[y] = 0.0
                pane[y] = -1
                n_panes[y] = 0
        # Draw glass second, since it is drawn only in front of opaque surfaces.
        for is_glass in range(2 if pane.shape[0] > 0 else 1):
            for member in range(start[2 * band + is_glass], start[2 * band + is_glass + 1]):
                t = members[member]
                ax, ay, bx, by, cx, cy = sorted_by_row(corners[t])
                slope_ac = edge_slope(ax, ay, cx, cy)
                slope_ab = edge_slope(ax, ay, bx, by)
                slope_bc = edge_slope(bx, by, cx, cy)
                step_x = planes[t, 0]
                row_first = max(top, math.ceil(ay - 0.5))
                row_end = min(bottom, math.ceil(cy - 0.5))
                for y in range(row_first, row_end):
                    py = y + 0.5
                    long = ax + (py - ay) * slope_ac
                    short = ax + (py - ay) * slope_ab if py < by else bx + (py - by) * slope_bc
                    # Clamp before rounding: a clipped triangle can extend far beyond the image.
                    x_first = math.ceil(max(min(long, short), 0.0) - 0.5)
                    x_end = math.ceil(min(max(long, short), float(width)) - 0.5)
                    base = planes[t, 0] * (x_first + 0.5) + planes[t, 1] * py + planes[t, 2]
                    row_depth = depth[y]
                    if is_glass == 0:
                        row_triangle = triangle[y]
                        for x in range(x_first, x_end):
                            value = np.float32(base + step_x * (x - x_first))
                            if value > row_depth[x]:
                                row_depth[x] = value
                                row_triangle[x] = t
                    else:
                        row_pane_depth = pane_depth[y]
                        for x in range(x_first, x_end):
                            value = np.float32(base + step_x * (x - x_first))
                            if value > row_depth[x]:
                                n_panes[y, x] = min(n_panes[y, x] + 1, 255)
                                if value > row_pane_depth[x]:
                                    row_pane_depth[x] = value
                                    pane[y, x] = t
