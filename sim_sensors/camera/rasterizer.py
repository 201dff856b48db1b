"""Rasterizer: a z-buffer in horizontal bands.

One thread writes each band of rows, with the triangles in a fixed order, so the result does not depend on the number of
threads. Most triangles are hidden: the far sides of cars, and cars behind cars. Front faces are therefore drawn first,
and a triangle that is farther than all that is drawn around it is skipped.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import Float32Array, FloatArray, Int32Array
from parkenv.compiled.jit import compiled
from sim_sensors.camera.projection import ScreenTriangles
from sim_sensors.camera.textures import FAST, LEAF
from sim_sensors.mesh import Material

FAR = 1000.0  # m, the ground ends there
BAND = 16  # rows

_GLASS = int(Material.GLASS)
_FRONT, _BACK, _PANE = range(3)  # what the triangles of a band are, in the order in which they are drawn
_KINDS = 3
_STRIP = 8  # rows of a band for which it is known what is hidden
_REFRESHED_AFTER = 128  # triangles drawn, until it is computed anew what they hide
_MARGIN = 1.0 + 1e-6  # between the inverse depth of a triangle's corners and that of its pixels, rounded


_Edges = tuple[float, float, float, float, float, float, float]  # x, y of the upper two corners, and slopes


class Visibility(NamedTuple):
    """The contents of the z-buffer, (h, w) each."""

    # float32, 1/m along the optical axis, of the first opaque surface; 0 for the sky
    inverse_depth: Float32Array
    triangle: Int32Array  # int32, of that surface; -1 for ground or sky
    # float32, 1/m, of the nearest pane of glass in front of it; 0 where there is none
    pane_inverse_depth: Float32Array
    pane: Int32Array  # int32, that pane's triangle; -1 where there is none
    n_panes: NDArray[np.uint8]  # uint8, number of panes in front of it


def rasterize(
    triangles: ScreenTriangles,
    size: tuple[int, int],
    floor: FloatArray,
    minimum: float = 1.0 / FAR,
) -> Visibility:
    """Find the nearest opaque surface of every pixel, and the glass in front of it.

    The inverse depth of the ground is a·x + b·y + c at (x, y) px, with `floor` = (a, b, c); below `minimum` it is sky.
    """
    width, height = size
    shape = (height, width)
    out = Visibility(
        np.empty(shape, dtype=np.float32),
        np.empty(shape, dtype=np.int32),
        np.empty(shape, dtype=np.float32),
        np.empty(shape, dtype=np.int32),
        np.empty(shape, dtype=np.uint8),
    )
    bands = (height + BAND - 1) // BAND
    start, members = _sort_into_bands(triangles.box, triangles.is_back, triangles.material, bands)
    _rasterize(
        triangles.corners,
        triangles.inverse_depth,
        triangles.box,
        triangles.nearest,
        start,
        members,
        interleaved(len(start) // _KINDS),
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
    box: Int32Array, is_back: NDArray[np.bool_], material: NDArray[np.uint8], n_bands: int
) -> tuple[NDArray[np.int64], Int32Array]:
    """Return the triangles of each band in their order, by kind.

    Those of kind k in band b are `members[start[3·b + k]:start[3·b + k + 1]]`.
    """
    n = box.shape[0]
    kinds = np.empty(n, dtype=np.uint8)
    start = np.zeros(_KINDS * n_bands + 1, dtype=np.int64)
    for t in range(n):
        kind = _PANE if material[t] == _GLASS else (_BACK if is_back[t] else _FRONT)
        kinds[t] = kind
        for band in range(box[t, 1] // BAND, (box[t, 3] - 1) // BAND + 1):
            start[_KINDS * band + kind + 1] += 1
    for place in range(_KINDS * n_bands):
        start[place + 1] += start[place]
    members = np.empty(start[_KINDS * n_bands], dtype=np.int32)
    fill = start[:-1].copy()
    for t in range(n):
        kind = kinds[t]
        for band in range(box[t, 1] // BAND, (box[t, 3] - 1) // BAND + 1):
            place = _KINDS * band + kind
            members[fill[place]] = t
            fill[place] += 1
    return start, members


@compiled(**LEAF)
def edge_slope(x0: float, y0: float, x1: float, y1: float) -> float:
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


@compiled(fastmath=FAST, nogil=True)
def _rasterize(
    corners: Float32Array,
    planes: FloatArray,
    box: Int32Array,
    nearest: Float32Array,
    start: NDArray[np.int64],
    members: Int32Array,
    order: NDArray[np.int64],
    floor: FloatArray,
    minimum: float,
    depth: Float32Array,
    triangle: Int32Array,
    pane_depth: Float32Array,
    pane: Int32Array,
    n_panes: NDArray[np.uint8],
) -> None:
    height, width = depth.shape
    for task in range(order.shape[0]):
        band = order[task]
        top = band * BAND
        bottom = min(height, top + BAND)
        for y in range(top, bottom):
            _clear(y, floor, minimum, depth[y], triangle[y])
            pane_depth[y] = 0.0
            pane[y] = -1
            n_panes[y] = 0
        hiding = np.zeros((BAND // _STRIP, width), dtype=np.float32)
        _refresh(depth[top:bottom], 0, width, hiding)
        # Draw glass last, since it is drawn only in front of opaque surfaces.
        for kind in range(_KINDS):
            drawn, first, end = 0, width, 0
            for member in range(start[_KINDS * band + kind], start[_KINDS * band + kind + 1]):
                t = members[member]
                if _is_hidden(box[t], nearest[t], top, bottom, hiding):
                    continue
                if kind == _PANE:
                    _draw_pane(t, corners[t], planes[t], top, bottom, depth, pane_depth, pane, n_panes)
                    continue
                _draw_opaque(t, corners[t], planes[t], top, bottom, depth, triangle)
                drawn += 1
                first, end = min(first, box[t, 0]), max(end, box[t, 2])
                if drawn % _REFRESHED_AFTER == 0:
                    _refresh(depth[top:bottom], first, end, hiding)
                    first, end = width, 0
            if kind != _PANE:
                _refresh(depth[top:bottom], first, end, hiding)


@compiled(**LEAF)
def _clear(y: int, floor: FloatArray, minimum: float, depth: Float32Array, triangle: Int32Array) -> None:
    # In double precision: towards the horizon most of the digits cancel.
    base = floor[1] * (y + 0.5) + floor[2] + 0.5 * floor[0]
    for x in range(depth.shape[0]):
        value = base + floor[0] * x
        depth[x] = value if value > minimum else 0.0
        triangle[x] = -1


@compiled(**LEAF)
def _refresh(depth: Float32Array, first: int, end: int, hiding: Float32Array) -> None:
    """Set the smallest inverse depth in each strip of the band, for some columns: whatever is farther is hidden."""
    rows = depth.shape[0]
    for strip in range((rows + _STRIP - 1) // _STRIP):
        least = hiding[strip]
        for x in range(first, end):
            least[x] = depth[strip * _STRIP, x]
        for y in range(strip * _STRIP + 1, min(rows, (strip + 1) * _STRIP)):
            row = depth[y]
            for x in range(first, end):
                least[x] = min(least[x], row[x])


@compiled(**LEAF)
def _is_hidden(box: Int32Array, nearest: float, top: int, bottom: int, hiding: Float32Array) -> bool:
    limit = np.float32(nearest * _MARGIN)
    for strip in range((max(box[1], top) - top) // _STRIP, (min(box[3], bottom) - 1 - top) // _STRIP + 1):
        least = hiding[strip]
        for x in range(box[0], box[2]):
            if least[x] < limit:
                return False
    return True


@compiled(**LEAF)
def _draw_opaque(
    t: int,
    corners: Float32Array,
    plane: FloatArray,
    top: int,
    bottom: int,
    depth: Float32Array,
    triangle: Int32Array,
) -> None:
    edges, first, end = _edges(corners, top, bottom)
    for y in range(first, end):
        x_first, x_end = _span(edges, y + 0.5, depth.shape[1])
        base = plane[0] * (x_first + 0.5) + plane[1] * (y + 0.5) + plane[2]
        row_depth, row_triangle = depth[y], triangle[y]
        for x in range(x_first, x_end):
            value = np.float32(base + plane[0] * (x - x_first))
            if value > row_depth[x]:
                row_depth[x] = value
                row_triangle[x] = t


@compiled(**LEAF)
def _draw_pane(
    t: int,
    corners: Float32Array,
    plane: FloatArray,
    top: int,
    bottom: int,
    depth: Float32Array,
    pane_depth: Float32Array,
    pane: Int32Array,
    n_panes: NDArray[np.uint8],
) -> None:
    edges, first, end = _edges(corners, top, bottom)
    for y in range(first, end):
        x_first, x_end = _span(edges, y + 0.5, depth.shape[1])
        base = plane[0] * (x_first + 0.5) + plane[1] * (y + 0.5) + plane[2]
        for x in range(x_first, x_end):
            value = np.float32(base + plane[0] * (x - x_first))
            if value > depth[y, x]:
                n_panes[y, x] = min(n_panes[y, x] + 1, 255)
                if value > pane_depth[y, x]:
                    pane_depth[y, x] = value
                    pane[y, x] = t


@compiled(**LEAF)
def _edges(corners: Float32Array, top: int, bottom: int) -> tuple[_Edges, int, int]:
    """Return the edges of a triangle, and the rows from `top` to `bottom` whose middles it meets, as a range."""
    ax, ay, bx, by, cx, cy = sorted_by_row(corners)
    slopes = edge_slope(ax, ay, cx, cy), edge_slope(ax, ay, bx, by), edge_slope(bx, by, cx, cy)
    first, end = max(top, math.ceil(ay - 0.5)), min(bottom, math.ceil(cy - 0.5))
    return (ax, ay, bx, by, slopes[0], slopes[1], slopes[2]), first, end


@compiled(**LEAF)
def _span(edges: _Edges, y: float, width: int) -> tuple[int, int]:
    """Return the first pixel whose centre lies between the edges of a triangle in a row, and the one after the last."""
    ax, ay, bx, by, slope_ac, slope_ab, slope_bc = edges
    long = ax + (y - ay) * slope_ac
    short = ax + (y - ay) * slope_ab if y < by else bx + (y - by) * slope_bc
    # Clamp before rounding: a clipped triangle can extend far beyond the image.
    first = math.ceil(max(min(long, short), 0.0) - 0.5)
    end = math.ceil(min(max(long, short), float(width)) - 0.5)
    return first, end
