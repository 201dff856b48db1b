"""From a scene to triangles on the screen: culling, level of detail, projection, clipping at the near plane.

A triangle's inverse depth and its normal (over depth) are linear in the pixel coordinates: both follow from the cross
products of its corners in the camera frame (Olano and Greer, *Triangle scan conversion using 2D homogeneous
coordinates*, 1997). Clipping at the near plane therefore only determines which pixels are covered, and depth is exact
even for triangles that extend behind the camera.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import Float32Array, FloatArray, Int32Array
from parkenv.compiled.jit import compiled
from sim_sensors.camera.textures import FAST, LEAF
from sim_sensors.mesh import Instances, Lamps, Material, MeshArrays, MeshPool

NEAR = 0.05  # m; nothing nearer is drawn

# Materials of closed objects, whose inside is never visible. A car's shell is not closed: its inside is visible through
# the windows.
_CLOSED = np.zeros(256, dtype=np.bool_)
_CLOSED[[Material.RUBBER, Material.BARK, Material.STONE]] = True

_LIT = {  # material of each lamp, and its light, sRGB
    Lamps.TAIL: (Material.TAIL_LAMP, (188, 24, 18)),
    Lamps.REVERSING: (Material.REVERSING_LAMP, (255, 255, 250)),
    Lamps.HEAD: (Material.HEAD_LAMP, (255, 252, 240)),
}


class ScreenTriangles(NamedTuple):
    # (n, 6) float32, px: x, y of the three corners; pixel (row, column) has its centre at (column + 0.5, row + 0.5)
    corners: Float32Array
    inverse_depth: FloatArray  # (n, 3) float64: 1/depth in 1/m at (x, y) px is a·x + b·y + c
    # (n, 4) int32, px: first column, first row, and those after the last, of the pixels whose centres it may cover
    box: Int32Array
    nearest: Float32Array  # (n,) float32, 1/m: no point has a greater inverse depth
    is_back: NDArray[np.bool_]  # (n,) bool, whether its inner side is seen
    # (n, 9) float32: row-major 3×3 matrix from the ray (u, v, 1) in the camera frame to the interpolated outward
    # normal in the world frame, times a positive factor
    normal: Float32Array
    material: NDArray[np.uint8]  # (n,) uint8
    color: NDArray[np.uint8]  # (n, 3) uint8, sRGB
    instance: Int32Array  # (n,) int32, index into the instances, the nearest first


class _Placed(NamedTuple):
    visible: Int32Array
    mesh: Int32Array
    poses: FloatArray


class _Camera(NamedTuple):
    pose: FloatArray
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int


class _Work(NamedTuple):
    moved: FloatArray  # (n, 5) vertices in the camera frame, m, and in the image, px
    to_camera: FloatArray  # (3, 4) instance to camera
    cross: FloatArray  # (3, 3) cross products of a triangle's corners
    polygon: FloatArray  # (4, 2) px, a triangle clipped at the near plane
    box: Int32Array  # (4,) pixels that it may cover


def project(
    pool: MeshPool,
    instances: Instances,
    pose: FloatArray,
    intrinsics: tuple[float, float, float, float],
    size: tuple[int, int],
    coarse_beyond: float = math.inf,
) -> ScreenTriangles:
    """Cull, transform and clip the triangles of a scene; omit those that cover no pixel centre.

    Instances farther than `coarse_beyond`, m, are drawn with the pool's coarse meshes, if it has any.
    """
    visible = _visible_instances(instances, pool.radius, pose, intrinsics, size)
    away = np.linalg.norm(instances.pose[visible, :3] - pose[:3, 3], axis=1)
    # The nearest first, since they hide others.
    by_distance = np.argsort(away, kind="stable")
    visible, away = visible[by_distance], away[by_distance]
    mesh = instances.mesh[visible]
    if pool.coarse is not None:
        mesh = np.where(away > coarse_beyond, pool.coarse[mesh], mesh)
    # A clipped triangle may become two.
    room = 2 * np.concatenate([[0], np.cumsum(pool.triangle_start[mesh + 1] - pool.triangle_start[mesh])])
    capacity = int(room[-1])
    most_vertices = int((pool.vertex_start[mesh + 1] - pool.vertex_start[mesh]).max(initial=0))
    out = ScreenTriangles(
        np.empty((capacity, 6), dtype=np.float32),
        np.empty((capacity, 3)),
        np.empty((capacity, 4), dtype=np.int32),
        np.empty(capacity, dtype=np.float32),
        np.empty(capacity, dtype=np.bool_),
        np.empty((capacity, 9), dtype=np.float32),
        np.empty(capacity, dtype=np.uint8),
        np.empty((capacity, 3), dtype=np.uint8),
        np.empty(capacity, dtype=np.int32),
    )
    begin, end = np.array([0, len(visible)]), np.zeros(1, np.int64)
    camera = _Camera(np.ascontiguousarray(pose, dtype=np.float64), *intrinsics, *size)
    _project_parts(
        pool.arrays, _Placed(visible, mesh, instances.pose), camera, begin, end, most_vertices, out
    )
    count = int(end[0])
    out = ScreenTriangles._make(column[:count] for column in out)
    if instances.lamps is not None:
        _light(out, instances.lamps[out.instance])
    return out


def _light(out: ScreenTriangles, lamps: NDArray[np.uint8]) -> None:
    for lamp, (material, light) in _LIT.items():
        on = (out.material == material) & (lamps & lamp != 0)
        out.material[on], out.color[on] = Material.LIT, light


def _visible_instances(
    instances: Instances,
    radius: Float32Array,
    pose: FloatArray,
    intrinsics: tuple[float, float, float, float],
    size: tuple[int, int],
) -> Int32Array:
    fx, fy, cx, cy = intrinsics
    center = (instances.pose[:, :3] - pose[:3, 3]) @ pose[:3, :3]
    reach = radius[instances.mesh].astype(np.float64)
    seen = center[:, 2] > NEAR - reach
    # The four side planes of the frustum pass through the camera; their normals point outwards.
    for plane in ((fx, 0.0, cx - size[0]), (-fx, 0.0, -cx), (0.0, fy, cy - size[1]), (0.0, -fy, -cy)):
        seen &= center @ (np.array(plane) / np.linalg.norm(plane)) < reach
    return np.flatnonzero(seen).astype(np.int32)


@compiled(fastmath=FAST, nogil=True)
def _project_parts(
    meshes: MeshArrays,
    placed: _Placed,
    camera: _Camera,
    begin: NDArray[np.int64],
    end: NDArray[np.int64],
    most_vertices: int,
    out: ScreenTriangles,
) -> None:
    """Project instances `begin[k]` to `begin[k + 1]` into `out` from row `end[k]` on, and set that to the next row."""
    for part in range(end.shape[0]):
        work = _Work(
            np.empty((most_vertices, 5)),
            np.empty((3, 4)),
            np.empty((3, 3)),
            np.empty((4, 2)),
            np.empty(4, dtype=np.int32),
        )
        count = end[part]
        for index in range(begin[part], begin[part + 1]):
            count = _project_instance(meshes, placed, camera, index, count, work, out)
        end[part] = count


@compiled(fastmath=FAST, _nrt=False)
def _project_instance(
    meshes: MeshArrays,
    placed: _Placed,
    camera: _Camera,
    index: int,
    count: int,
    work: _Work,
    out: ScreenTriangles,
) -> int:
    """Fill `out` from row `count` on with the triangles of one instance; return the row after the last."""
    q = placed.visible[index]
    mesh = placed.mesh[index]
    first_vertex = meshes.vertex_start[mesh]
    cosine = math.cos(placed.poses[q, 3])
    sine = math.sin(placed.poses[q, 3])
    _move_vertices(meshes, mesh, placed.poses[q], cosine, sine, camera, work)
    cross = work.cross
    for t in range(meshes.triangle_start[mesh], meshes.triangle_start[mesh + 1]):
        corner = meshes.triangles[t]
        a = work.moved[corner[0]]
        b = work.moved[corner[1]]
        c = work.moved[corner[2]]
        if a[2] < NEAR and b[2] < NEAR and c[2] < NEAR:
            continue
        corners = _clip(a, b, c, camera, work.polygon)
        if not _covers_pixels(work.polygon, corners, camera.width, camera.height, work.box):
            continue
        for i in range(3):
            j = (i + 1) % 3
            k = (i + 2) % 3
            cross[0, i] = b[j] * c[k] - b[k] * c[j]
            cross[1, i] = c[j] * a[k] - c[k] * a[j]
            cross[2, i] = a[j] * b[k] - a[k] * b[j]
        volume = a[0] * cross[0, 0] + a[1] * cross[0, 1] + a[2] * cross[0, 2]
        # Seen edge-on (or degenerate), or from behind.
        if abs(volume) < 1e-12 or (volume > 0.0 and _CLOSED[meshes.material[t]]):
            continue
        nearest = np.float32(1.0 / max(min(a[2], b[2], c[2]), NEAR))
        scale = 1.0 / volume
        inverse_x = (cross[0, 0] + cross[1, 0] + cross[2, 0]) * scale / camera.fx
        inverse_y = (cross[0, 1] + cross[1, 1] + cross[2, 1]) * scale / camera.fy
        inverse_c = (cross[0, 2] + cross[1, 2] + cross[2, 2]) * scale
        inverse_c -= inverse_x * camera.cx + inverse_y * camera.cy
        for part in range(corners - 2):
            for i in range(2):
                out.corners[count, i] = work.polygon[0, i]
                out.corners[count, 2 + i] = work.polygon[part + 1, i]
                out.corners[count, 4 + i] = work.polygon[part + 2, i]
            out.inverse_depth[count, 0] = inverse_x
            out.inverse_depth[count, 1] = inverse_y
            out.inverse_depth[count, 2] = inverse_c
            out.nearest[count] = nearest
            out.is_back[count] = volume > 0.0
            for i in range(4):
                out.box[count, i] = work.box[i]
            for i in range(3):
                in_x = 0.0
                in_y = 0.0
                in_z = 0.0
                for k in range(3):
                    vertex = first_vertex + corner[k]
                    in_x += meshes.normals[vertex, 0] * cross[k, i]
                    in_y += meshes.normals[vertex, 1] * cross[k, i]
                    in_z += meshes.normals[vertex, 2] * cross[k, i]
                out.normal[count, i] = (cosine * in_x - sine * in_y) * scale
                out.normal[count, 3 + i] = (sine * in_x + cosine * in_y) * scale
                out.normal[count, 6 + i] = in_z * scale
                out.color[count, i] = meshes.color[t, i]
            out.material[count] = meshes.material[t]
            out.instance[count] = q
            count += 1
    return count


@compiled(fastmath=FAST, _nrt=False)
def _move_vertices(
    meshes: MeshArrays, mesh: int, pose: FloatArray, cosine: float, sine: float, camera: _Camera, work: _Work
) -> None:
    """Set `work.moved` to the vertices of a mesh at a pose: in the camera frame, m, and in the image, px."""
    to_camera, moved = work.to_camera, work.moved
    for i in range(3):
        to_camera[i, 0] = camera.pose[0, i] * cosine + camera.pose[1, i] * sine
        to_camera[i, 1] = camera.pose[1, i] * cosine - camera.pose[0, i] * sine
        to_camera[i, 2] = camera.pose[2, i]
        to_camera[i, 3] = 0.0
        for j in range(3):
            to_camera[i, 3] += camera.pose[j, i] * (pose[j] - camera.pose[j, 3])
    first = meshes.vertex_start[mesh]
    for k in range(meshes.vertex_start[mesh + 1] - first):
        x = meshes.vertices[first + k, 0]
        y = meshes.vertices[first + k, 1]
        z = meshes.vertices[first + k, 2]
        for i in range(3):
            moved[k, i] = to_camera[i, 0] * x + to_camera[i, 1] * y + to_camera[i, 2] * z + to_camera[i, 3]
        # Where it is in the image, used if it is beyond the near plane.
        scale = 1.0 / max(moved[k, 2], NEAR)
        moved[k, 3] = camera.fx * moved[k, 0] * scale + camera.cx
        moved[k, 4] = camera.fy * moved[k, 1] * scale + camera.cy


@compiled(**LEAF)
def _clip(a: FloatArray, b: FloatArray, c: FloatArray, camera: _Camera, polygon: FloatArray) -> int:
    """Project the part of a triangle beyond the near plane into `polygon`, px; return its number of corners.

    A corner has its position in the camera frame, m, and in the image, px.
    """
    if a[2] >= NEAR and b[2] >= NEAR and c[2] >= NEAR:
        for i in range(2):
            polygon[0, i] = a[3 + i]
            polygon[1, i] = b[3 + i]
            polygon[2, i] = c[3 + i]
        return 3
    count = 0
    for i in range(3):
        p = a if i == 0 else (b if i == 1 else c)
        q = b if i == 0 else (c if i == 1 else a)
        if p[2] >= NEAR:
            polygon[count, 0] = p[3]
            polygon[count, 1] = p[4]
            count += 1
        if (p[2] >= NEAR) != (q[2] >= NEAR):
            along = (NEAR - p[2]) / (q[2] - p[2])
            polygon[count, 0] = camera.fx * (p[0] + along * (q[0] - p[0])) / NEAR + camera.cx
            polygon[count, 1] = camera.fy * (p[1] + along * (q[1] - p[1])) / NEAR + camera.cy
            count += 1
    return count


@compiled(**LEAF)
def _covers_pixels(polygon: FloatArray, corners: int, width: int, height: int, box: Int32Array) -> bool:
    """Set `box` to the pixels whose centres are in the polygon's bounding box, and return whether there are any."""
    left = right = polygon[0, 0]
    top = bottom = polygon[0, 1]
    for i in range(1, corners):
        left = min(left, polygon[i, 0])
        right = max(right, polygon[i, 0])
        top = min(top, polygon[i, 1])
        bottom = max(bottom, polygon[i, 1])
    # Corners are rounded to single precision, so the box is larger by a little.
    box[0] = math.ceil(max(left, 0.0) - 0.501)
    box[1] = math.ceil(max(top, 0.0) - 0.501)
    box[2] = math.floor(min(right, float(width)) - 0.499) + 1
    box[3] = math.floor(min(bottom, float(height)) - 0.499) + 1
    return bool(box[0] < box[2] and box[1] < box[3])
