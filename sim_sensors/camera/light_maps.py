"""Shadow maps around the camera: one for the sun, and one for the sky that vehicles hide from the ground."""

from __future__ import annotations

from collections import OrderedDict
from typing import NamedTuple
from weakref import WeakKeyDictionary

import cv2
import numpy as np
from numpy.typing import NDArray

from sim_sensors.camera.projection import ScreenTriangles, set_box
from sim_sensors.camera.rasterizer import rasterize
from sim_sensors.camera.textures import VECTOR_LEAF, Single, mix, mix_quad, quads
from sim_sensors.camera.weather import Weather
from sim_sensors.compilation import compiled
from sim_sensors.mesh import Instances, Material, MeshPool

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]

_WINDOW = 72.0  # m, side of the square that the maps cover
_STEP = 16.0  # m; the window moves in steps of this size, so a moving camera can reuse it
_SHADOW_TEXELS = 2048
_CONTACT_TEXELS = 1024
_CONTACT_CLEARANCE = 0.93  # scale of the footprints: bumpers are off the ground
_KEPT = 4  # windows kept per scene


class LightMaps(NamedTuple):
    """Occlusion of sun and sky.

    Attributes:
        shadow: (n, n) float32, m, height towards the sun of the nearest occluder; 0 if there is none.
        to_shadow: (3, 4) float64, maps a world point (x, y, z, 1) to column, row (texels) and that height.
        contact: (m, m) uint32, `quads` of the fraction of the sky that vehicles hide from the ground, 255 = all.
        x, y: m, corner of the contact map.
        texels_per_m: resolution of the contact map.
    """

    shadow: Float32Array
    to_shadow: FloatArray
    contact: NDArray[np.uint32]
    x: float
    y: float
    texels_per_m: float


_Key = tuple[Weather, int, int]
_CACHE: WeakKeyDictionary[Instances, OrderedDict[_Key, LightMaps]] = WeakKeyDictionary()


def light_maps(pool: MeshPool, instances: Instances, weather: Weather, x: float, y: float) -> LightMaps:
    """Return the maps around (x, y), m. Maps of static instances are cached as long as the instances exist."""
    still = instances if instances.still is None else instances.still
    column, row = round(x / _STEP), round(y / _STEP)
    x, y = column * _STEP, row * _STEP
    kept = _CACHE.setdefault(still, OrderedDict())
    key = (weather, column, row)
    if key not in kept:
        kept[key] = _draw(pool, still, weather, x, y)
        if len(kept) > _KEPT:
            kept.popitem(last=False)
    kept.move_to_end(key)
    moving = _near(pool, instances, x, y)
    moving = moving[moving >= len(still.mesh)]
    return _with_moving(kept[key], pool, instances, moving, x, y) if len(moving) else kept[key]


def _near(pool: MeshPool, instances: Instances, x: float, y: float) -> NDArray[np.int32]:
    """Return the instances that may cast a shadow into the window around (x, y)."""
    away = np.hypot(instances.pose[:, 0] - x, instances.pose[:, 1] - y)
    return np.flatnonzero(away < 0.75 * _WINDOW + pool.radius[instances.mesh]).astype(np.int32)


def _draw(pool: MeshPool, instances: Instances, weather: Weather, x: float, y: float) -> LightMaps:
    near = _near(pool, instances, x, y)
    to_shadow = _toward_the_sun(weather, x, y)
    if max(weather.sun) > 0.0:
        shadow = _shadow_map(pool, instances, near, to_shadow)
    else:
        shadow = np.zeros((2, 2), dtype=np.float32)
    contact, corner = _contact_map(pool, instances, near, x, y), (x - _WINDOW / 2, y - _WINDOW / 2)
    return LightMaps(shadow, to_shadow, contact, *corner, _CONTACT_TEXELS / _WINDOW)


def _with_moving(
    maps: LightMaps, pool: MeshPool, instances: Instances, moving: NDArray[np.int32], x: float, y: float
) -> LightMaps:
    """Add the moving instances to the maps of the static ones."""
    shadow = maps.shadow
    if len(shadow) == _SHADOW_TEXELS:
        shadow = np.maximum(shadow, _shadow_map(pool, instances, moving, maps.to_shadow))
    added = _contact_map(pool, instances, moving, x, y)
    contact = np.maximum(maps.contact.view(np.uint8), added.view(np.uint8)).view(np.uint32)
    return maps._replace(shadow=shadow, contact=contact)


def _toward_the_sun(weather: Weather, x: float, y: float) -> FloatArray:
    """Return the matrix from a world point (x, y, z, 1) to column, row of the shadow map and height towards the sun."""
    sun = np.array(weather.sun_direction)
    across = np.cross([0.0, 0.0, 1.0], sun)
    across /= np.linalg.norm(across)
    up = np.cross(sun, across)
    n = _SHADOW_TEXELS
    to_shadow = np.zeros((3, 4))
    to_shadow[0, :3] = across * (n / _WINDOW)
    # Seen from a low sun the window is foreshortened: its texels can be finer in that direction.
    to_shadow[1, :3] = up * (n / _WINDOW) / max(0.3, sun[2])
    to_shadow[2, :3] = sun
    center = np.array([x, y, 0.0])
    to_shadow[:, 3] = [n / 2, n / 2, 500.0] - to_shadow[:, :3] @ center
    return to_shadow


def _shadow_map(
    pool: MeshPool, instances: Instances, drawn: NDArray[np.int32], to_shadow: FloatArray
) -> Float32Array:
    """Rasterize the scene from the sun, with height towards the sun instead of inverse depth."""
    n = _SHADOW_TEXELS
    triangles = _seen_from_the_sun(
        pool.vertices,
        pool.triangles,
        pool.material,
        pool.vertex_start,
        pool.triangle_start,
        drawn,
        instances.mesh if pool.coarse is None else pool.coarse[instances.mesh],
        instances.pose,
        to_shadow,
        int(Material.GLASS),
        n,
    )
    seen = rasterize(ScreenTriangles(*triangles), (n, n), np.zeros(3), 0.0, panes=False)
    return seen.inverse_depth


@compiled
def _seen_from_the_sun(
    vertices: Float32Array,
    triangles: NDArray[np.int32],
    material: NDArray[np.uint8],
    vertex_start: NDArray[np.int64],
    triangle_start: NDArray[np.int64],
    near: NDArray[np.int32],
    mesh: NDArray[np.int32],
    poses: FloatArray,
    to_shadow: FloatArray,
    glass: int,
    n: int,
) -> tuple[
    Float32Array,
    FloatArray,
    NDArray[np.int16],
    Float32Array,
    NDArray[np.bool_],
    Float32Array,
    NDArray[np.uint8],
    NDArray[np.uint8],
    NDArray[np.int32],
]:
    """Return the fields of `ScreenTriangles`, those for shading empty."""
    capacity = 0
    for q in near:
        capacity += triangle_start[mesh[q] + 1] - triangle_start[mesh[q]]
    corners = np.empty((capacity, 6), dtype=np.float32)
    planes = np.empty((capacity, 3))
    box = np.empty((capacity, 4), dtype=np.int16)
    nearest = np.empty(capacity, dtype=np.float32)
    count = 0
    p = np.empty((3, 3))
    for q in near:
        first = vertex_start[mesh[q]]
        cosine = np.cos(poses[q, 3])
        sine = np.sin(poses[q, 3])
        for t in range(triangle_start[mesh[q]], triangle_start[mesh[q] + 1]):
            if material[t] == glass:
                continue
            for k in range(3):
                v = vertices[first + triangles[t, k]]
                x = poses[q, 0] + cosine * v[0] - sine * v[1]
                y = poses[q, 1] + sine * v[0] + cosine * v[1]
                z = poses[q, 2] + v[2]
                for i in range(3):
                    p[k, i] = (
                        to_shadow[i, 0] * x + to_shadow[i, 1] * y + to_shadow[i, 2] * z + to_shadow[i, 3]
                    )
            area = (p[1, 0] - p[0, 0]) * (p[2, 1] - p[0, 1]) - (p[2, 0] - p[0, 0]) * (p[1, 1] - p[0, 1])
            left, right = min(p[0, 0], p[1, 0], p[2, 0]), max(p[0, 0], p[1, 0], p[2, 0])
            top, bottom = min(p[0, 1], p[1, 1], p[2, 1]), max(p[0, 1], p[1, 1], p[2, 1])
            if abs(area) < 1e-6 or not set_box(left, top, right, bottom, n, n, box[count]):
                continue
            nearest[count] = max(p[0, 2], p[1, 2], p[2, 2])
            by_x = (p[1, 2] - p[0, 2]) * (p[2, 1] - p[0, 1]) - (p[2, 2] - p[0, 2]) * (p[1, 1] - p[0, 1])
            by_y = (p[2, 2] - p[0, 2]) * (p[1, 0] - p[0, 0]) - (p[1, 2] - p[0, 2]) * (p[2, 0] - p[0, 0])
            planes[count, 0] = by_x / area
            planes[count, 1] = by_y / area
            planes[count, 2] = p[0, 2] - planes[count, 0] * p[0, 0] - planes[count, 1] * p[0, 1]
            for k in range(3):
                corners[count, 2 * k] = p[k, 0]
                corners[count, 2 * k + 1] = p[k, 1]
            count += 1
    plain = np.zeros(count, dtype=np.uint8)
    none = (
        np.zeros((0, 9), dtype=np.float32),
        plain,
        np.zeros((0, 3), dtype=np.uint8),
        np.zeros(0, dtype=np.int32),
    )
    return corners[:count], planes[:count], box[:count], nearest[:count], plain == 1, *none


def _contact_map(
    pool: MeshPool, instances: Instances, near: NDArray[np.int32], x: float, y: float
) -> NDArray[np.uint32]:
    """Blur the footprints of the vehicles twice: for the dark area between the wheels and for its soft border."""
    image = np.zeros((_CONTACT_TEXELS, _CONTACT_TEXELS), dtype=np.uint8)
    boxes = bounding_boxes(pool)
    scale = _CONTACT_TEXELS / _WINDOW
    corner = np.array([x, y]) - _WINDOW / 2
    for q in near:
        if instances.ids[q] == 0:
            continue
        low_x, low_y, _, high_x, high_y, _ = boxes[instances.mesh[q]] * _CONTACT_CLEARANCE
        px, py, _, yaw = instances.pose[q]
        rotation = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
        outline = np.array([[low_x, low_y], [high_x, low_y], [high_x, high_y], [low_x, high_y]])
        texels = (outline @ rotation + (px, py) - corner) * scale - 0.5
        cv2.fillConvexPoly(image, np.round(texels * 16).astype(np.int32), 255, cv2.LINE_AA, 4)
    wide = cv2.GaussianBlur(image, (0, 0), 0.34 * scale)
    tight = cv2.GaussianBlur(image, (0, 0), 0.1 * scale)
    return np.asarray(quads(cv2.addWeighted(wide, 0.5, tight, 0.46, 0.0)))


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
    """Return the texel of a map n wide at or before (u, v), the fractions to the next, and whether there is one."""
    end = np.float32(n - 1)
    covered = (u >= 0.0) & (v >= 0.0) & (u < end) & (v < end)
    u = u if covered else np.float32(0.0)
    v = v if covered else np.float32(0.0)
    left = np.int32(u)
    top = np.int32(v)
    return np.uint64(left), np.uint64(top), u - np.float32(left), v - np.float32(top), covered
