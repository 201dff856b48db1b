"""Shadow maps around the camera: one for the sun, and one for the sky that vehicles hide from the ground."""

from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import Float32Array, FloatArray
from parkenv.compiled.jit import compiled
from sim_sensors.camera.textures import VECTOR_LEAF, Single, mix, mix_quad
from sim_sensors.mesh import MeshPool


class LightMaps(NamedTuple):
    shadow: Float32Array  # (n, n) m, height towards the sun of the nearest occluder; 0 if there is none
    to_shadow: FloatArray  # (3, 4) maps a world point (x, y, z, 1) to column, row (texels) and that height
    # (m, m) `quads` of the fraction of the sky that vehicles hide from the ground, 255 = all
    contact: NDArray[np.uint32]
    x: float  # m, and y: corner of the contact map
    y: float
    texels_per_m: float  # of the contact map


_BOXES: WeakKeyDictionary[MeshPool, FloatArray] = WeakKeyDictionary()


def bounding_boxes(pool: MeshPool) -> FloatArray:
    """Return the bounding box of each mesh, (n_meshes, 6) float64, m: minimum and maximum x, y, z in its own frame."""
    if pool not in _BOXES:
        start = pool.vertex_start[:-1]
        low = np.minimum.reduceat(pool.vertices, start, axis=0)
        high = np.maximum.reduceat(pool.vertices, start, axis=0)
        _BOXES[pool] = np.concatenate([low, high], axis=1).astype(np.float64)
    return _BOXES[pool]


@compiled(**VECTOR_LEAF)
def sunlit(maps: LightMaps, x: Single, y: Single, z: Single, bias: Single) -> Single:
    """Return the fraction of the sun that reaches a point, 0 to 1; bilinear between four texels."""
    m = maps.to_shadow
    u = m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3] - 0.5
    v = m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3] - 0.5
    height = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3] + bias
    left, top, a, b, covered = _place(u, v, maps.shadow.shape[0])
    one = np.uint64(1)
    s = maps.shadow
    s00 = _open(s[top, left], height)
    s01 = _open(s[top, left + one], height)
    s10 = _open(s[top + one, left], height)
    s11 = _open(s[top + one, left + one], height)
    lit = mix(mix(s00, s01, a), mix(s10, s11, a), b)
    return lit if covered else np.float32(1.0)


@compiled(**VECTOR_LEAF)
def _open(occluder: Single, height: Single) -> Single:
    return np.float32(0.0) if occluder > height else np.float32(1.0)


@compiled(**VECTOR_LEAF)
def open_sky(maps: LightMaps, x: Single, y: Single) -> Single:
    """Return the fraction of the sky that is visible from the ground at (x, y) past the vehicles."""
    u = (x - np.float32(maps.x)) * np.float32(maps.texels_per_m) - 0.5
    v = (y - np.float32(maps.y)) * np.float32(maps.texels_per_m) - 0.5
    left, top, a, b, covered = _place(u, v, maps.contact.shape[0])
    hidden = mix_quad(maps.contact[top, left], a, b)
    return 1.0 - hidden if covered else np.float32(1.0)


@compiled(**VECTOR_LEAF)
def _place(u: Single, v: Single, n: int) -> tuple[Single, Single, Single, Single, Single]:
    end = np.float32(n - 1)
    covered = (u >= 0.0) & (v >= 0.0) & (u < end) & (v < end)
    u = u if covered else np.float32(0.0)
    v = v if covered else np.float32(0.0)
    left = np.int32(u)
    top = np.int32(v)
    return np.uint64(left), np.uint64(top), u - np.float32(left), v - np.float32(top), covered
