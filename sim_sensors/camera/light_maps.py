"""Shadow maps around the camera: one for the sun, and one for the sky that vehicles hide from the ground."""

from __future__ import annotations

from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from sim_sensors.camera.textures import LEAF
from sim_sensors.compilation import compiled
from sim_sensors.mesh import MeshPool

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]


class LightMaps(NamedTuple):
    """Occlusion of sun and sky.

    Attributes:
        shadow: (n, n) float32, m, height towards the sun of the nearest occluder; 0 if there is none.
        to_shadow: (3, 4) float64, maps a world point (x, y, z, 1) to column, row (texels) and that height.
        contact: (m, m) uint8, fraction of the sky that vehicles hide from the ground, 255 = all.
        x, y: m, corner of the contact map.
        texels_per_m: resolution of the contact map.
    """

    shadow: Float32Array
    to_shadow: FloatArray
    contact: NDArray[np.uint8]
    x: float
    y: float
    texels_per_m: float


_BOXES: WeakKeyDictionary[MeshPool, FloatArray] = WeakKeyDictionary()


def bounding_boxes(pool: MeshPool) -> FloatArray:
    """Return the bounding box of each mesh, (n_meshes, 6) float64, m: minimum and maximum x, y, z in its own frame."""
    if pool not in _BOXES:
        start = pool.vertex_start[:-1]
        low = np.minimum.reduceat(pool.vertices, start, axis=0)
        high = np.maximum.reduceat(pool.vertices, start, axis=0)
        _BOXES[pool] = np.concatenate([low, high], axis=1).astype(np.float64)
    return _BOXES[pool]


@compiled(**LEAF)
def sunlit(maps: LightMaps, x: float, y: float, z: float, bias: float) -> float:
    """Return the fraction of the sun that reaches a point, 0 to 1; bilinear between four texels."""
    m = maps.to_shadow
    u = m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3] - 0.5
    v = m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3] - 0.5
    n = maps.shadow.shape[0]
    if u < 0.0 or v < 0.0 or u >= n - 1 or v >= n - 1:
        return 1.0
    height = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3] + bias
    left, right = np.uint64(int(u)), np.uint64(int(u) + 1)
    top, bottom = np.uint64(int(v)), np.uint64(int(v) + 1)
    a = u - int(u)
    b = v - int(v)
    s = maps.shadow
    s00 = 0.0 if s[top, left] > height else 1.0
    s01 = 0.0 if s[top, right] > height else 1.0
    s10 = 0.0 if s[bottom, left] > height else 1.0
    s11 = 0.0 if s[bottom, right] > height else 1.0
    above = s00 * (1 - a) + s01 * a
    below = s10 * (1 - a) + s11 * a
    return float(above + b * (below - above))


@compiled(**LEAF)
def open_sky(maps: LightMaps, x: float, y: float) -> float:
    """Return the fraction of the sky that is visible from the ground at (x, y) past the vehicles."""
    u = (x - maps.x) * maps.texels_per_m - 0.5
    v = (y - maps.y) * maps.texels_per_m - 0.5
    n = maps.contact.shape[0]
    if u < 0.0 or v < 0.0 or u >= n - 1 or v >= n - 1:
        return 1.0
    left, right = np.uint64(int(u)), np.uint64(int(u) + 1)
    top, bottom = np.uint64(int(v)), np.uint64(int(v) + 1)
    a = u - int(u)
    b = v - int(v)
    c = maps.contact
    above = c[top, left] * (1 - a) + c[top, right] * a
    below = c[bottom, left] * (1 - a) + c[bottom, right] * a
    return float(1.0 - (above * (1 - b) + below * b) / 255.0)
