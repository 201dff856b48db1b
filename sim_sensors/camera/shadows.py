"""Draw the shadow maps around a camera, and keep them: when a car leaves or arrives, only its place is drawn again.

A texel of a map depends only on the instances above it, and on nothing that was drawn before. So a map that was kept
and changed is the map that is drawn anew, bit for bit.
"""

import math
from collections import OrderedDict
from collections.abc import Sequence
from threading import Lock
from typing import NamedTuple
from weakref import WeakKeyDictionary

import cv2
import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import Float32Array, FloatArray, Image, Int32Array
from parkenv.compiled.jit import compiled
from sim_sensors.camera.light_maps import LightMaps, bounding_boxes
from sim_sensors.camera.textures import quads
from sim_sensors.camera.weather import Weather
from sim_sensors.mesh import Instances, Material, MeshArrays, MeshPool

_WINDOW = 72.0  # m, side of the square that the maps cover
_STEP = 16.0  # m; the window moves in steps of this size, so a moving camera can reuse it
_SHADOW_TEXELS = 2048
_CONTACT_TEXELS = 1024
_CONTACT_SCALE = _CONTACT_TEXELS / _WINDOW  # texels per metre
_CONTACT_CLEARANCE = 0.93  # scale of the footprints: bumpers are off the ground
_WIDE, _TIGHT = 0.34 * _CONTACT_SCALE, 0.1 * _CONTACT_SCALE  # texels, the blurs of the contact shadow
_BLUR_REACH = 24  # texels; OpenCV cuts both blurs off before
_KEPT = 6  # windows kept for the meshes of one lot
_FEW = 12  # more changed instances than these, and the map is drawn anew
_GLASS = int(Material.GLASS)

_Box = Sequence[int]  # first and end row, first and end column, texels


class _Window(NamedTuple):
    rows: FloatArray  # (k, 6) float64: mesh, x, y, z, yaw, and whether it is a vehicle, of each instance
    footprints: Image  # the vehicles' footprints, before they are blurred
    maps: LightMaps


_Key = tuple[Weather, int, int]
_CACHE: WeakKeyDictionary[MeshPool, OrderedDict[_Key, _Window]] = WeakKeyDictionary()
_LOCK = Lock()


def light_maps(pool: MeshPool, instances: Instances, weather: Weather, x: float, y: float) -> LightMaps:
    """Return the maps around (x, y), m. Those of static instances are kept as long as the meshes exist."""
    column, row = round(x / _STEP), round(y / _STEP)
    x, y = column * _STEP, row * _STEP
    near = _near(pool, instances, x, y)
    n_still = len((instances if instances.still is None else instances.still).mesh)
    still, moving = near[near < n_still], near[near >= n_still]
    key = (weather, column, row)
    with _LOCK:
        kept = _CACHE.setdefault(pool, OrderedDict())
        kept[key] = window = _updated(kept.get(key), pool, _rows(instances, still), weather, x, y)
        kept.move_to_end(key)
        if len(kept) > _KEPT:
            kept.popitem(last=False)
    return _with_moving(window.maps, pool, _rows(instances, moving)) if len(moving) else window.maps


def _near(pool: MeshPool, instances: Instances, x: float, y: float) -> NDArray[np.int64]:
    away = np.hypot(instances.pose[:, 0] - x, instances.pose[:, 1] - y)
    return np.flatnonzero(away < 0.75 * _WINDOW + pool.radius[instances.mesh])


def _rows(instances: Instances, chosen: NDArray[np.int64]) -> FloatArray:
    return np.column_stack([instances.mesh[chosen], instances.pose[chosen], instances.ids[chosen] > 0])


def _updated(
    before: _Window | None, pool: MeshPool, rows: FloatArray, weather: Weather, x: float, y: float
) -> _Window:
    if before is None:
        return _drawn(pool, rows, weather, x, y)
    if rows.shape == before.rows.shape and (rows == before.rows).all():
        return before
    now = {row.tobytes() for row in rows}
    then = {row.tobytes() for row in before.rows}
    gone = before.rows[[row.tobytes() not in now for row in before.rows]]
    new = rows[[row.tobytes() not in then for row in rows]]
    if len(gone) + len(new) > _FEW:
        return _drawn(pool, rows, weather, x, y)
    maps = before.maps
    # Pictures of the scene before may still be drawn from the old maps.
    shadow, contact, footprints = maps.shadow.copy(), maps.contact.copy(), before.footprints.copy()
    if len(shadow) == _SHADOW_TEXELS:
        for box in _shadow_boxes(pool, gone, maps.to_shadow).tolist():
            top, bottom, left, right = area = _within(box, _SHADOW_TEXELS)
            shadow[top:bottom, left:right] = 0.0
            _cast(pool, rows, maps.to_shadow, shadow, area)
        _cast(pool, new, maps.to_shadow, shadow)
    changed = np.concatenate([gone, new])
    boxes = _footprint_boxes(pool, changed[changed[:, 5] > 0], maps).tolist()
    for box in boxes:
        top, bottom, left, right = area = _within(box, _CONTACT_TEXELS)
        footprints[top:bottom, left:right] = 0
        _print_footprints(pool, rows[rows[:, 5] > 0], maps, footprints, area)
    for box in boxes:
        _blur_footprints(footprints, contact, box)
    return _Window(rows, footprints, maps._replace(shadow=shadow, contact=contact))


def _drawn(pool: MeshPool, rows: FloatArray, weather: Weather, x: float, y: float) -> _Window:
    if max(weather.sun) > 0.0:
        shadow = np.zeros((_SHADOW_TEXELS, _SHADOW_TEXELS), dtype=np.float32)
    else:
        shadow = np.zeros((2, 2), dtype=np.float32)
    contact, footprints = _no_contact()
    corner = (x - _WINDOW / 2, y - _WINDOW / 2)
    maps = LightMaps(shadow, _toward_the_sun(weather, x, y), contact, *corner, _CONTACT_SCALE)
    if len(shadow) == _SHADOW_TEXELS:
        _cast(pool, rows, maps.to_shadow, shadow)
    _print_footprints(pool, rows[rows[:, 5] > 0], maps, footprints)
    _blur_footprints(footprints, contact, (0, _CONTACT_TEXELS, 0, _CONTACT_TEXELS))
    return _Window(rows, footprints, maps)


def _with_moving(maps: LightMaps, pool: MeshPool, moving: FloatArray) -> LightMaps:
    shadow = maps.shadow
    if len(shadow) == _SHADOW_TEXELS:
        shadow = shadow.copy()
        _cast(pool, moving, maps.to_shadow, shadow)
    vehicles = moving[moving[:, 5] > 0]
    contact, footprints = _no_contact()
    _print_footprints(pool, vehicles, maps, footprints)
    for box in _footprint_boxes(pool, vehicles, maps).tolist():
        _blur_footprints(footprints, contact, box)
    contact = np.maximum(contact.view(np.uint8), maps.contact.view(np.uint8)).view(np.uint32)
    return maps._replace(shadow=shadow, contact=contact)


def _no_contact() -> tuple[NDArray[np.uint32], Image]:
    shape = (_CONTACT_TEXELS, _CONTACT_TEXELS)
    return np.zeros(shape, dtype=np.uint32), np.zeros(shape, dtype=np.uint8)


def _toward_the_sun(weather: Weather, x: float, y: float) -> FloatArray:
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
    to_shadow[:, 3] = [n / 2, n / 2, 500.0] - to_shadow[:, :3] @ np.array([x, y, 0.0])
    return to_shadow


def _within(box: _Box, n: int) -> _Box:
    top, bottom, left, right = box
    return max(top, 0), min(max(bottom, 0), n), max(left, 0), min(max(right, 0), n)


def _shadow_boxes(pool: MeshPool, rows: FloatArray, to_shadow: FloatArray) -> NDArray[np.int64]:
    low, high = np.split(bounding_boxes(pool)[_drawn_mesh(pool, rows)], 2, axis=1)
    corner = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1]), axis=-1).reshape(8, 3)
    local = np.where(corner, high[:, None], low[:, None])
    cosine, sine = np.cos(rows[:, 4, None]), np.sin(rows[:, 4, None])
    x = rows[:, 1, None] + cosine * local[..., 0] - sine * local[..., 1]
    y = rows[:, 2, None] + sine * local[..., 0] + cosine * local[..., 1]
    world = np.stack([x, y, rows[:, 3, None] + local[..., 2], np.ones_like(x)], axis=-1)
    column, row = (world @ to_shadow[i] for i in (0, 1))
    ends = [row.min(axis=1) - 1, row.max(axis=1) + 2, column.min(axis=1) - 1, column.max(axis=1) + 2]
    return np.asarray(np.floor(np.column_stack(ends)), dtype=np.int64)


def _drawn_mesh(pool: MeshPool, rows: FloatArray) -> Int32Array:
    mesh = rows[:, 0].astype(np.int32)
    return mesh if pool.coarse is None else pool.coarse[mesh]


def _cast(
    pool: MeshPool,
    rows: FloatArray,
    to_shadow: FloatArray,
    shadow: Float32Array,
    area: _Box = (0, _SHADOW_TEXELS, 0, _SHADOW_TEXELS),
) -> None:
    boxes = _shadow_boxes(pool, rows, to_shadow)
    top, bottom, left, right = area
    meets = (boxes[:, 0] < bottom) & (boxes[:, 1] > top) & (boxes[:, 2] < right) & (boxes[:, 3] > left)
    rows, boxes = rows[meets], boxes[meets]
    if not len(rows) or top >= bottom or left >= right:
        return
    mesh = _drawn_mesh(pool, rows)
    most_vertices = int((pool.vertex_start[mesh + 1] - pool.vertex_start[mesh]).max())
    _cast_parts(
        pool.arrays,
        mesh,
        np.ascontiguousarray(rows[:, 1:5]),
        boxes,
        to_shadow,
        np.array([top, bottom]),
        left,
        right,
        most_vertices,
        shadow,
    )


@compiled(nogil=True, error_model="numpy")
def _cast_parts(
    meshes: MeshArrays,
    mesh: Int32Array,
    poses: FloatArray,
    boxes: NDArray[np.int64],
    to_shadow: FloatArray,
    begin: NDArray[np.int64],
    left: int,
    right: int,
    most_vertices: int,
    shadow: Float32Array,
) -> None:
    """Cast the shadows on rows `begin[k]` to `begin[k + 1]` in one thread each; without `fastmath`, see the module."""
    for part in range(begin.shape[0] - 1):
        top, bottom = begin[part], begin[part + 1]
        p = np.empty((most_vertices, 3))
        for q in range(mesh.shape[0]):
            if boxes[q, 0] >= bottom or boxes[q, 1] <= top:
                continue
            first = meshes.vertex_start[mesh[q]]
            cosine, sine = math.cos(poses[q, 3]), math.sin(poses[q, 3])
            for k in range(meshes.vertex_start[mesh[q] + 1] - first):
                v = meshes.vertices[first + k]
                x = poses[q, 0] + cosine * v[0] - sine * v[1]
                y = poses[q, 1] + sine * v[0] + cosine * v[1]
                z = poses[q, 2] + v[2]
                for i in range(3):
                    p[k, i] = (
                        to_shadow[i, 0] * x + to_shadow[i, 1] * y + to_shadow[i, 2] * z + to_shadow[i, 3]
                    )
            for t in range(meshes.triangle_start[mesh[q]], meshes.triangle_start[mesh[q] + 1]):
                if meshes.material[t] != _GLASS:
                    a, b, c = meshes.triangles[t, 0], meshes.triangles[t, 1], meshes.triangles[t, 2]
                    _cast_triangle(p[a], p[b], p[c], top, bottom, left, right, shadow)


@compiled(error_model="numpy")
def _cast_triangle(
    a: FloatArray,
    b: FloatArray,
    c: FloatArray,
    top: int,
    bottom: int,
    left: int,
    right: int,
    shadow: Float32Array,
) -> None:
    area = (b[0] - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (b[1] - a[1])
    if abs(area) < 1e-6:
        return
    by_x = ((b[2] - a[2]) * (c[1] - a[1]) - (c[2] - a[2]) * (b[1] - a[1])) / area
    by_y = ((c[2] - a[2]) * (b[0] - a[0]) - (b[2] - a[2]) * (c[0] - a[0])) / area
    start = a[2] - by_x * (a[0] - 0.5) - by_y * (a[1] - 0.5)
    if b[1] < a[1]:
        a, b = b, a
    if c[1] < b[1]:
        b, c = c, b
    if b[1] < a[1]:
        a, b = b, a
    slope_ac = (c[0] - a[0]) / (c[1] - a[1])
    slope_ab = (b[0] - a[0]) / (b[1] - a[1]) if b[1] > a[1] else 0.0
    slope_bc = (c[0] - b[0]) / (c[1] - b[1]) if c[1] > b[1] else 0.0
    for y in range(max(top, math.ceil(a[1] - 0.5)), min(bottom, math.ceil(c[1] - 0.5))):
        middle = y + 0.5
        long = a[0] + (middle - a[1]) * slope_ac
        short = a[0] + (middle - a[1]) * slope_ab if middle < b[1] else b[0] + (middle - b[1]) * slope_bc
        base = start + by_y * y
        line = shadow[y]
        for x in range(
            max(left, math.ceil(min(long, short) - 0.5)), min(right, math.ceil(max(long, short) - 0.5))
        ):
            line[x] = max(line[x], np.float32(base + by_x * x))


def _footprint_boxes(pool: MeshPool, vehicles: FloatArray, maps: LightMaps) -> NDArray[np.int64]:
    reach = pool.radius[vehicles[:, 0].astype(np.int64)] * _CONTACT_SCALE + 2.0
    column, row = (vehicles[:, 1] - maps.x) * _CONTACT_SCALE, (vehicles[:, 2] - maps.y) * _CONTACT_SCALE
    ends = np.column_stack([row - reach, row + reach, column - reach, column + reach])
    return np.asarray(np.floor(ends), dtype=np.int64)


def _print_footprints(
    pool: MeshPool,
    vehicles: FloatArray,
    maps: LightMaps,
    footprints: Image,
    area: _Box = (0, _CONTACT_TEXELS, 0, _CONTACT_TEXELS),
) -> None:
    boxes = _footprint_boxes(pool, vehicles, maps)
    corner = np.array([maps.x, maps.y])
    for vehicle, box in zip(vehicles, boxes.tolist(), strict=True):
        top, bottom = max(area[0], box[0]), min(area[1], box[1])
        left, right = max(area[2], box[2]), min(area[3], box[3])
        if top >= bottom or left >= right:
            continue
        low_x, low_y, _, high_x, high_y, _ = bounding_boxes(pool)[int(vehicle[0])] * _CONTACT_CLEARANCE
        _, px, py, _, yaw, _ = vehicle
        rotation = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
        outline = np.array([[low_x, low_y], [high_x, low_y], [high_x, high_y], [low_x, high_y]])
        texels = (outline @ rotation + (px, py) - corner) * _CONTACT_SCALE - 0.5 - (box[2], box[0])
        # Drawn whole and then cut: OpenCV draws a polygon that the border cuts slightly otherwise.
        stamp = np.zeros((box[1] - box[0], box[3] - box[2]), dtype=np.uint8)
        cv2.fillConvexPoly(stamp, np.round(texels * 16).astype(np.int32), 255, cv2.LINE_AA, 4)
        part = footprints[top:bottom, left:right]
        np.maximum(part, stamp[top - box[0] : bottom - box[0], left - box[2] : right - box[2]], out=part)


def _blur_footprints(footprints: Image, contact: NDArray[np.uint32], box: _Box) -> None:
    top, bottom, left, right = box
    reach = _BLUR_REACH
    top, bottom, left, right = _within(
        (top - reach, bottom + reach, left - reach, right + reach), _CONTACT_TEXELS
    )
    if top >= bottom or left >= right:
        return
    wider = _within((top - reach, bottom + reach, left - reach, right + reach), _CONTACT_TEXELS)
    part = footprints[wider[0] : wider[1], wider[2] : wider[3]]
    wide, tight = (cv2.GaussianBlur(part, (0, 0), sigma) for sigma in (_WIDE, _TIGHT))
    both = quads(cv2.addWeighted(wide, 0.5, tight, 0.46, 0.0), False)
    contact[top:bottom, left:right] = both[
        top - wider[0] : bottom - wider[0], left - wider[2] : right - wider[2]
    ]
