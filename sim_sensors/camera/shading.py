"""Deferred shading: the radiance of every pixel, from sky, ground or a surface, through haze and glass.

The rasterizer has found the visible surfaces, so each pixel is shaded once, and once more for a pane of glass.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from sim_sensors.camera.daylight import Light, Vector, daylight
from sim_sensors.camera.ground_shading import ground_level, ground_radiance
from sim_sensors.camera.ground_texture import GroundTexture
from sim_sensors.camera.light_maps import LightMaps
from sim_sensors.camera.materials import LINEAR, RESPONSE, Materials, surface_radiance, through_glass
from sim_sensors.camera.projection import ScreenTriangles
from sim_sensors.camera.rasterizer import BAND, Visibility, interleaved
from sim_sensors.camera.sky import sky_of_view
from sim_sensors.camera.textures import FAST, LEAF, Tile, cloud_tile, grain_tile, hash_unit
from sim_sensors.camera.weather import Weather
from sim_sensors.compilation import compiled

Float32Array = NDArray[np.float32]
FloatArray = NDArray[np.float64]


class _View(NamedTuple):
    """The camera: rotation (3, 3) camera to world, position (3,), intrinsics in px."""

    rotation: FloatArray
    position: FloatArray
    fx: float
    fy: float
    cx: float
    cy: float


def shade(
    triangles: ScreenTriangles,
    visibility: Visibility,
    pose: FloatArray,
    intrinsics: tuple[float, float, float, float],
    weather: Weather,
    ground: GroundTexture,
    maps: LightMaps,
) -> Float32Array:
    """Return the radiance of every pixel.

    Args:
        triangles: triangles on the screen.
        visibility: the visible triangle of each pixel.
        pose: (4, 4) camera to world.
        intrinsics: fx, fy, cx, cy, px.
        weather: the light.
        ground: texture of the ground.
        maps: shadow maps.

    Returns:
        (h, w, 3) float32, linear RGB, relative (see `Weather`).
    """
    height, width = visibility.triangle.shape
    view = _View(np.ascontiguousarray(pose[:3, :3]), np.ascontiguousarray(pose[:3, 3]), *intrinsics)
    light = daylight(weather, sky_of_view(weather, view.rotation, intrinsics, (width, height)))
    image = np.empty((height, width, 3), dtype=np.float32)
    order = interleaved((height + BAND - 1) // BAND)
    grain, cloud = grain_tile(), cloud_tile()
    _shade(triangles, visibility, view, light, ground, maps, grain, cloud, RESPONSE, LINEAR, order, image)
    return image


@compiled(parallel=True, fastmath=FAST, nogil=True)
def _shade(
    triangles: ScreenTriangles,
    visibility: Visibility,
    view: _View,
    light: Light,
    ground: GroundTexture,
    maps: LightMaps,
    grain: Tile,
    cloud: Tile,
    response: FloatArray,
    linear: FloatArray,
    order: NDArray[np.int64],
    image: Float32Array,
) -> None:
    for task in prange(order.shape[0]):
        # Assemble the tuple here: numba's parallel loops accept tuples from outside, but not nested ones.
        materials = Materials(grain, cloud, response, linear)
        top = order[task] * BAND
        for y in range(top, min(image.shape[0], top + BAND)):
            _shade_row(y, triangles, visibility, view, light, ground, maps, materials, image)


@compiled(**LEAF)
def _shade_row(
    y: int,
    triangles: ScreenTriangles,
    visibility: Visibility,
    view: _View,
    light: Light,
    ground: GroundTexture,
    maps: LightMaps,
    materials: Materials,
    image: Float32Array,
) -> None:
    width = image.shape[1]
    r = view.rotation
    v = (y + 0.5 - view.cy) / view.fy
    row_x = r[0, 1] * v + r[0, 2]
    row_y = r[1, 1] * v + r[1, 2]
    row_z = r[2, 1] * v + r[2, 2]
    level = ground_level(row_z, view.position[2], view.fx, ground.texel)
    grain_level = level + math.log2(ground.texel / (3.0 / 512))
    for x in range(width):
        inverse_depth = visibility.inverse_depth[y, x]
        pane = visibility.pane[y, x]
        if inverse_depth <= 0.0 and pane < 0:
            for channel in range(3):
                image[y, x, channel] = light.background[y, x, channel]
            continue
        u = (x + 0.5 - view.cx) / view.fx
        dx = r[0, 0] * u + row_x
        dy = r[1, 0] * u + row_y
        dz = r[2, 0] * u + row_z
        inverse_length = 1.0 / math.sqrt(u * u + v * v + 1.0)
        t = visibility.triangle[y, x]
        ray = (dx * inverse_length, dy * inverse_length, dz * inverse_length)
        red = float(light.background[y, x, 0])
        green = float(light.background[y, x, 1])
        blue = float(light.background[y, x, 2])
        if inverse_depth > 0.0:
            depth = 1.0 / inverse_depth
            point = _along(view, dx, dy, dz, depth)
            if t < 0:
                dither = hash_unit(x, y)
                levels = int(level + dither), int(grain_level + dither)
                red, green, blue = ground_radiance(
                    point[0], point[1], ray, levels[0], levels[1], light, ground, maps, materials.grain
                )
            else:
                normal = _normal(triangles.normal[t], u, v)
                red, green, blue = surface_radiance(
                    t, triangles, point, ray, normal, depth / view.fx, light, maps, materials
                )
            # 1 - exp(-k) to three decimals, for the k of usual road scenes.
            k = light.haze * depth / inverse_length
            fog = 1.0 - 1.0 / (1.0 + k * (1.0 + 0.5 * k))
            red += (light.horizon[0] - red) * fog
            green += (light.horizon[1] - green) * fog
            blue += (light.horizon[2] - blue) * fog
        if pane >= 0:
            normal = _normal(triangles.normal[pane], u, v)
            point = _along(view, dx, dy, dz, 1.0 / visibility.pane_inverse_depth[y, x])
            red, green, blue = through_glass(
                (red, green, blue), visibility.n_panes[y, x], point, ray, normal, light, maps
            )
        image[y, x, 0] = red
        image[y, x, 1] = green
        image[y, x, 2] = blue


@compiled(**LEAF)
def _along(view: _View, dx: float, dy: float, dz: float, depth: float) -> Vector:
    """Return the point, world frame, at a depth along a ray."""
    at = view.position
    return at[0] + dx * depth, at[1] + dy * depth, at[2] + dz * depth


@compiled(**LEAF)
def _normal(matrix: Float32Array, u: float, v: float) -> Vector:
    x = matrix[0] * u + matrix[1] * v + matrix[2]
    y = matrix[3] * u + matrix[4] * v + matrix[5]
    z = matrix[6] * u + matrix[7] * v + matrix[8]
    scale = 1.0 / math.sqrt(x * x + y * y + z * z + 1e-30)
    return x * scale, y * scale, z * scale
