"""Geometry for the camera: triangle meshes, instances of them, and the ground."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum, IntFlag
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import Float32Array

# Materials, each with its own shading: clear-coated paint, glass, dark plastic (trim), rubber, ... the stone of kerbs
# and walls, and the cloth of pedestrians. An interior is seats and dashboard behind glass. A lamp that is lit is LIT.
Material = IntEnum(
    "Material",
    "PAINT GLASS TRIM RUBBER RIM LAMP TAIL_LAMP REVERSING_LAMP HEAD_LAMP PLATE INTERIOR CHROME FOLIAGE BARK STONE "
    "CLOTH LIT",
    start=0,
)


class Lamps(IntFlag):
    """Lamps of a vehicle that are lit."""

    TAIL = 1  # tail and brake lamps
    REVERSING = 2
    HEAD = 4


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles of one object in its own frame: x forward, y left, z up from the ground, m."""

    vertices: Float32Array  # (v, 3) float32, m. Vertices at creases are duplicated, one for each side.
    normals: Float32Array  # (v, 3) float32, unit, outward
    triangles: NDArray[np.int32]  # (t, 3) int32, counter-clockwise seen from outside
    material: NDArray[np.uint8]  # (t,) uint8, a `Material` each
    color: NDArray[np.uint8]  # (t, 3) uint8, sRGB albedo


class MeshArrays(NamedTuple):
    vertices: Float32Array
    normals: Float32Array
    triangles: NDArray[np.int32]
    material: NDArray[np.uint8]
    color: NDArray[np.uint8]
    vertex_start: NDArray[np.int64]
    triangle_start: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class MeshPool:
    """Many meshes in shared arrays: as in `Mesh`, one after the other."""

    vertices: Float32Array
    normals: Float32Array
    triangles: NDArray[np.int32]  # indices count from the start of their mesh
    material: NDArray[np.uint8]
    color: NDArray[np.uint8]
    # (n_meshes + 1,) mesh m has vertices `vertex_start[m]:vertex_start[m + 1]`, and triangles likewise
    vertex_start: NDArray[np.int64]
    triangle_start: NDArray[np.int64]
    radius: Float32Array  # (n_meshes,) m, of a sphere around the mesh's origin that contains it, for culling
    # (n_meshes,) the mesh drawn instead when it is far away; None: always itself
    coarse: NDArray[np.int32] | None = None

    @cached_property
    def arrays(self) -> MeshArrays:
        return MeshArrays(*(getattr(self, name) for name in MeshArrays._fields))


@dataclass(frozen=True, eq=False)
class Instances:
    mesh: NDArray[np.int32]  # (n,) int32, index into the pool
    pose: NDArray[np.float64]  # (n, 4) float64, x, y, z in m and yaw in rad, world frame
    # (n,) int32, value in the camera's instance image: 0 for scenery, above 0 for vehicles
    ids: NDArray[np.int32]
    # the static instances, which come first, if others move; their shadows are cached as long as this object exists.
    # None: nothing moves.
    still: Instances | None = None
    lamps: NDArray[np.uint8] | None = None  # (n,) uint8, the `Lamps` of each that are lit; None: none


@dataclass(frozen=True, eq=False)
class Ground:
    """The plane z = 0."""

    # polygons, (k, 2) float64 m each, of asphalt; grass or gravel elsewhere
    paved: tuple[NDArray[np.float64], ...]
    markings: NDArray[np.float64]  # (n, 5) float64: x, y of both ends of a painted line and its width, m
    seed: int = 0  # seed of the texture: stains, patches, worn paint
