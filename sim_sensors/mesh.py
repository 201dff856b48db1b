"""The geometry that the camera draws: triangle meshes, where copies of them stand, and the ground."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

Float32Array = NDArray[np.float32]


class Material(IntEnum):
    """How a surface takes the light; the camera's shading goes by it."""

    PAINT = 0  # clear-coated, glossy
    GLASS = 1  # seen through, with reflections
    TRIM = 2  # dark plastic
    RUBBER = 3
    RIM = 4
    LAMP = 5
    PLATE = 6
    INTERIOR = 7  # seats, dashboard, seen through glass
    CHROME = 8
    FACADE = 9
    FOLIAGE = 10
    BARK = 11
    STONE = 12  # kerbs, walls
    POST = 13
    CLOTH = 14  # pedestrians


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles of one thing in its own frame: x forward, y left, z up from the ground, m.

    Attributes:
        vertices: (v, 3) float32, m. Creases have a vertex for either side.
        normals: (v, 3) float32, unit, outward.
        triangles: (t, 3) int32, counter-clockwise seen from outside.
        material: (t,) uint8, a `Material` each.
        color: (t, 3) uint8, sRGB albedo.
    """

    vertices: Float32Array
    normals: Float32Array
    triangles: NDArray[np.int32]
    material: NDArray[np.uint8]
    color: NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class MeshPool:
    """Many meshes in one row of arrays, so that compiled code walks them without objects.

    Attributes:
        vertices, normals, triangles, material, color: as in `Mesh`, one mesh after the other; the indices
            in `triangles` count within their own mesh.
        vertex_start: (n_meshes + 1,) int64; mesh m has vertices `vertex_start[m]:vertex_start[m + 1]`.
        triangle_start: (n_meshes + 1,) int64, the same for triangles.
        radius: (n_meshes,) float32, m, of the sphere round the mesh's origin that holds it, for culling.
        coarse: (n_meshes,) int32, the mesh drawn in its place when it is far away; None: always itself.
    """

    vertices: Float32Array
    normals: Float32Array
    triangles: NDArray[np.int32]
    material: NDArray[np.uint8]
    color: NDArray[np.uint8]
    vertex_start: NDArray[np.int64]
    triangle_start: NDArray[np.int64]
    radius: Float32Array
    coarse: NDArray[np.int32] | None = None


@dataclass(frozen=True, eq=False)
class Instances:
    """Where copies of meshes stand.

    Attributes:
        mesh: (n,) int32, index into the pool.
        pose: (n, 4) float64, x, y, z in m and yaw in rad, world frame.
        ids: (n,) int32, what the camera writes into its instance image: 0 for scenery, above for vehicles.
        still: the first of these instances, where the others move: shadows of what stands still are kept for as
            long as this object lives. None: nothing moves.
    """

    mesh: NDArray[np.int32]
    pose: NDArray[np.float64]
    ids: NDArray[np.int32]
    still: Instances | None = None


@dataclass(frozen=True, eq=False)
class Ground:
    """The plane z = 0.

    Attributes:
        paved: polygons, (k, 2) float64 m each, of asphalt; grass or gravel elsewhere.
        markings: (n, 5) float64: x, y of both ends of a painted line and its width, m.
        seed: of the texture: stains, patches, worn paint.
    """

    paved: tuple[NDArray[np.float64], ...]
    markings: NDArray[np.float64]
    seed: int = 0
