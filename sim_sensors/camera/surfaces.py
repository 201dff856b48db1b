"""Triangle meshes from a few types of surfaces: curved grids, strips between curves, boxes, revolutions, prisms.

Every triangle has a *finish*, a small number; a palette gives it a material and a colour when the mesh is made. So one
shape serves cars of many colours.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.compiled.jit import compiled
from sim_sensors.mesh import Mesh

CREASE = np.cos(np.radians(42.0))  # surfaces whose faces meet at less than this angle are shaded as one
WELD_M = 1e-5

_BOX_FACES = {
    "x": (0, 4, 7, 3),
    "X": (1, 2, 6, 5),
    "y": (0, 1, 5, 4),
    "Y": (3, 7, 6, 2),
    "z": (0, 3, 2, 1),
    "Z": (4, 5, 6, 7),
}


@dataclass(frozen=True, eq=False)
class Shape:
    vertices: NDArray[np.float32]  # (v, 3) float32, m
    normals: NDArray[np.float32]  # (v, 3) float32, unit, outward
    triangles: NDArray[np.int32]  # (t, 3) int32, counter-clockwise seen from outside
    finish: NDArray[np.uint8]  # (t,) uint8, row of the palette

    def dyed(self, material: NDArray[np.uint8], color: NDArray[np.uint8]) -> Mesh:
        """Return the mesh with materials and sRGB colours, (n_finishes,) and (n_finishes, 3) uint8, from a palette."""
        return Mesh(self.vertices, self.normals, self.triangles, material[self.finish], color[self.finish])


class ShapeBuilder:
    def __init__(self) -> None:
        self._points: list[FloatArray] = []
        self._triangles: list[IntArray] = []
        self._finish: list[IntArray] = []
        self._smooth: list[bool] = []

    def grid(self, points: ArrayLike, finish: ArrayLike, *, flip: bool = False, smooth: bool = True) -> None:
        """Add a curved grid of quads, (a, b, 3) m, with ∂/∂a × ∂/∂b to the outside, or, with `flip`, to the inside.

        There is one `finish`, or one of each quad. A smooth sheet has common normals, also at its seams with other
        smooth sheets; another is faceted.
        """
        corner = np.asarray(points, dtype=np.float64)
        rows, columns = corner.shape[:2]
        index = np.arange(rows * columns).reshape(rows, columns)
        quads = np.stack([index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]], axis=-1).reshape(
            -1, 4
        )
        if flip:
            quads = quads[:, ::-1]
        flat = corner.reshape(-1, 3)
        # The shorter diagonal follows curved sheets better.
        first = np.sum((flat[quads[:, 0]] - flat[quads[:, 2]]) ** 2, axis=1)
        second = np.sum((flat[quads[:, 1]] - flat[quads[:, 3]]) ** 2, axis=1)
        quads = np.where((first <= second + 1e-12)[:, None], quads, np.roll(quads, -1, axis=1))
        triangles = quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
        per_quad = np.broadcast_to(np.asarray(finish), (rows - 1, columns - 1)).reshape(-1)
        self._add(flat, triangles, np.repeat(per_quad, 2), smooth)

    def both_sides(self, points: FloatArray, finish: ArrayLike, *, smooth: bool = True) -> None:
        """Add a grid on the left, seen from the left, and its mirror image on the right."""
        self.grid(points, finish, flip=True, smooth=smooth)
        self.grid(points * [1.0, -1.0, 1.0], finish, smooth=smooth)

    def fan(self, points: ArrayLike, finish: int, *, flip: bool = False) -> None:
        corner = np.asarray(points, dtype=np.float64)
        if flip:
            corner = corner[::-1]
        k = np.arange(1, len(corner) - 1)
        triangles = np.column_stack([np.zeros_like(k), k, k + 1])
        self._add(corner, triangles, np.full(len(triangles), finish), smooth=False)

    def quads(self, points: ArrayLike, finish: int) -> None:
        """Add flat quads of one finish, (n, 4, 3) m, each counter-clockwise seen from outside."""
        corner = np.asarray(points, dtype=np.float64)
        start: IntArray = 4 * np.arange(len(corner), dtype=np.int64)[:, None]
        triangles = (start + np.array([0, 1, 2, 0, 2, 3])).reshape(-1, 3)
        self._add(corner.reshape(-1, 3), triangles, np.full(len(triangles), int(finish)), smooth=False)

    def box(
        self,
        center: ArrayLike,
        size: ArrayLike,
        finish: int,
        *,
        taper: tuple[float, float] = (1.0, 1.0),
        lean: float = 0.0,
        faces: str = "xXyYzZ",
    ) -> None:
        """Add a box of a size, m, along x, y, z; its top is scaled by `taper` along x and y, shifted by `lean` along x.

        `faces` are those to keep, lower case for the low side of an axis.
        """
        x, y, z = np.asarray(size, dtype=np.float64) / 2
        bottom = np.array([[-x, -y, -z], [x, -y, -z], [x, y, -z], [-x, y, -z]])
        top = bottom * [taper[0], taper[1], -1.0] + np.array([lean, 0.0, 0.0])
        corner = np.vstack([bottom, top]) + np.asarray(center, dtype=np.float64)
        self.quads(corner[[_BOX_FACES[face] for face in faces]], finish)

    def turned(self, profile: ArrayLike, finish: ArrayLike, segments: int) -> None:
        """Add a surface of revolution about the z axis.

        `profile`, (k, 2), has radius and height, m; the outside lies to the right of its direction. There is one
        finish, or one of each band.
        """
        radius, height = np.asarray(profile, dtype=np.float64).T
        angle = np.linspace(0.0, 2 * np.pi, segments + 1)
        angle[-1] = angle[0]
        ring = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        points = np.empty((segments + 1, len(radius), 3))
        points[..., :2] = ring[:, None] * radius[None, :, None]
        points[..., 2] = height
        self.grid(points, np.broadcast_to(np.asarray(finish), (segments, len(radius) - 1)))

    def chords(
        self,
        edge: FloatArray,
        across: ArrayLike,
        crown: ArrayLike,
        finish: ArrayLike,
        *,
        flip: bool = False,
        smooth: bool = True,
    ) -> None:
        """Span a sheet between a curve on the left (y ≥ 0), (n, 3) m from rear to front, and its mirror image.

        `across` are (k,) fractions of the half width, from 1 on the left edge to -1 on the right; `crown`, () or (n,)
        m, is the height of the middle above the edge. It faces up, or down with `flip`.
        """
        a = np.asarray(across, dtype=np.float64)
        points = np.repeat(edge[:, None], len(a), axis=1)
        points[..., 1] *= a
        points[..., 2] += np.broadcast_to(np.asarray(crown), len(edge))[:, None] * (1.0 - a**2)
        self.grid(points, finish, flip=not flip, smooth=smooth)

    def put(
        self, shape: Shape, *, offset: ArrayLike = (0.0, 0.0, 0.0), turn: FloatArray | None = None
    ) -> None:
        """Add a built shape, rotated (or reflected) by a (3, 3) matrix, then shifted; it keeps its facets."""
        matrix = np.eye(3) if turn is None else turn
        triangles = shape.triangles.astype(np.int64)
        if np.linalg.det(matrix) < 0:
            triangles = triangles[:, ::-1]
        points = shape.vertices.astype(np.float64) @ matrix.T + np.asarray(offset, dtype=np.float64)
        self._add(points, triangles, shape.finish.astype(np.int64), smooth=True)

    def _add(self, points: FloatArray, triangles: IntArray, finish: IntArray, smooth: bool) -> None:
        self._points.append(points)
        self._triangles.append(triangles)
        self._finish.append(finish)
        self._smooth.append(smooth)

    def build(self) -> Shape:
        """Weld equal points, drop triangles without area, and compute the vertex normals.

        The corner of a smooth face gets the area-weighted mean normal of those smooth faces around the point that
        differ by less than the crease angle; faceted faces keep their own normal.
        """
        counts = np.cumsum([0, *(len(p) for p in self._points)])
        points = np.concatenate(self._points)
        triangles = np.concatenate([t + start for t, start in zip(self._triangles, counts, strict=False)])
        finish = np.concatenate(self._finish)
        smooth = np.repeat(self._smooth, [len(t) for t in self._triangles])
        cell = np.round(points / WELD_M).astype(np.int64)
        keys = (cell[:, 0] * 73856093) ^ (cell[:, 1] * 19349663 << 8) ^ (cell[:, 2] * 83492791 << 16)
        spot = np.unique(keys, return_inverse=True)[1]
        corner = spot[triangles]
        doubled = np.cross(
            points[triangles[:, 1]] - points[triangles[:, 0]],
            points[triangles[:, 2]] - points[triangles[:, 0]],
        )
        area = np.sqrt(np.sum(doubled**2, axis=1))
        distinct = (corner != np.roll(corner, 1, axis=1)).all(axis=1)
        kept = distinct & (area > 1e-9)
        triangles, finish, smooth = triangles[kept], finish[kept], smooth[kept]
        doubled, area, corner = doubled[kept], area[kept], corner[kept]
        normal = _corner_normals(corner, doubled / area[:, None], area, smooth)
        rows = points[triangles.ravel()]
        packed = np.round(np.hstack([spot[triangles.ravel()][:, None] * 1.0, normal * 2048.0]))
        _, first, inverse = np.unique(_as_keys(packed), return_index=True, return_inverse=True)
        return Shape(
            np.ascontiguousarray(rows[first], dtype=np.float32),
            np.ascontiguousarray(normal[first], dtype=np.float32),
            inverse.reshape(-1, 3).astype(np.int32),
            finish.astype(np.uint8),
        )


def _as_keys(rows: FloatArray) -> IntArray:
    columns = rows.astype(np.int64) + 4096
    keys = columns[:, 0]
    for column in columns[:, 1:].T:
        keys = keys * 8192 + column
    return np.asarray(keys)


@compiled
def _corner_normals(
    corner: IntArray, face: FloatArray, area: FloatArray, smooth: NDArray[np.bool_]
) -> FloatArray:
    spot = corner.ravel()
    order = np.argsort(spot, kind="mergesort")
    normal = np.empty((len(spot), 3))
    begin = 0
    while begin < len(order):
        end = begin + 1
        while end < len(order) and spot[order[end]] == spot[order[begin]]:
            end += 1
        for i in range(begin, end):
            own = order[i] // 3
            x, y, z = 0.0, 0.0, 0.0
            for j in range(begin, end):
                other = order[j] // 3
                alike = (
                    face[own, 0] * face[other, 0]
                    + face[own, 1] * face[other, 1]
                    + face[own, 2] * face[other, 2]
                )
                if own == other or (smooth[own] and smooth[other] and alike > CREASE):
                    x += area[other] * face[other, 0]
                    y += area[other] * face[other, 1]
                    z += area[other] * face[other, 2]
            length = np.sqrt(x * x + y * y + z * z)
            normal[order[i], 0], normal[order[i], 1], normal[order[i], 2] = x / length, y / length, z / length
        begin = end
    return normal
