"""Deferred shading: the radiance of every pixel, from sky, ground or a surface, through haze and glass.

The rasterizer has found the visible surfaces, so each pixel is shaded once, and once more for a pane of glass. Pixels
of a kind are collected and shaded together.
"""

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import Float32Array, FloatArray, Int32Array
from parkenv.compiled.jit import compiled
from sim_sensors.camera.batches import BATCH_FIELDS, Batch, Places, View, fade_into_haze, locate, read, write
from sim_sensors.camera.daylight import Light, daylight
from sim_sensors.camera.ground_shading import color_ground, ground_levels, light_ground, mirror_in_puddles
from sim_sensors.camera.ground_texture import GroundTexture
from sim_sensors.camera.light_maps import LightMaps
from sim_sensors.camera.materials import (
    LINEAR,
    RESPONSE,
    Materials,
    Surfaces,
    blotch_surfaces,
    color_surfaces,
    cover_with_glass,
    detail_leaves,
    light_lamps,
    light_surfaces,
    mirror_in_surfaces,
    orient,
    soil_surfaces,
)
from sim_sensors.camera.projection import ScreenTriangles
from sim_sensors.camera.rasterizer import BAND, Visibility, interleaved
from sim_sensors.camera.sky import sky_of_view
from sim_sensors.camera.textures import FAST, VECTOR_LOOP, Single, Tile, cloud_tile, grain_tile
from sim_sensors.camera.weather import Weather

_BATCH = 512  # pixels of a kind that are collected before they are shaded; their data stay in the first-level cache


def shade(
    triangles: ScreenTriangles,
    visibility: Visibility,
    pose: FloatArray,
    intrinsics: tuple[float, float, float, float],
    weather: Weather,
    ground: GroundTexture,
    maps: LightMaps,
) -> Float32Array:
    """Return the radiance of every pixel, (h, w, 3) float32, relative linear RGB (see `Weather`).

    `pose`, (4, 4), is that of the camera in the world, `intrinsics` are fx, fy, cx, cy, px.
    """
    height, width = visibility.triangle.shape
    fx, fy, cx, cy = intrinsics
    rotation = np.ascontiguousarray(pose[:3, :3])
    light = daylight(weather, sky_of_view(weather, rotation, intrinsics, (width, height)))
    maps = maps._replace(to_shadow=maps.to_shadow.astype(np.float32))
    rays_down = rotation[2, 1] * (np.arange(height) + 0.5 - cy) / fy + rotation[2, 2]
    level, to_grain = ground_levels(rays_down, float(pose[2, 3]), fx, ground.texel)
    view = View(
        rotation.astype(np.float32),
        pose[:3, 3].astype(np.float32),
        np.float32(fx),
        np.float32(fy),
        np.float32(cx),
        np.float32(cy),
    )
    image = np.empty((height, width, 3), dtype=np.float32)
    order = interleaved((height + BAND - 1) // BAND)
    grain, cloud = grain_tile(), cloud_tile()
    _shade(
        triangles, visibility, view, light, level, to_grain, ground, maps, grain, cloud, RESPONSE, LINEAR, order, image
    )  # fmt: skip
    return image


@compiled(fastmath=FAST, nogil=True)
def _shade(
    triangles: ScreenTriangles,
    visibility: Visibility,
    view: View,
    light: Light,
    ground_level: Float32Array,
    to_grain: Single,
    ground: GroundTexture,
    maps: LightMaps,
    grain: Tile,
    cloud: Tile,
    response: Float32Array,
    linear: Float32Array,
    order: NDArray[np.int64],
    image: Float32Array,
) -> None:
    height, width, _ = image.shape
    for task in range(order.shape[0]):
        # Assemble the tuples here: numba's parallel loops accept tuples from outside, but not nested ones.
        materials = Materials(grain, cloud, response, linear)
        room = _BATCH + width
        on_ground, on_surface, on_pane = _new_places(room), _new_places(room), _new_places(room)
        batch, surfaces = _new_batch(room), _new_surfaces(room)
        grounds = others = panes = 0
        end = min(height, order[task] * BAND + BAND)
        for y in range(order[task] * BAND, end):
            if _draw_sky(visibility.inverse_depth[y], light.background[y], image[y]):
                old_grounds, old_others = grounds, others
                grounds, others = _split(
                    visibility.inverse_depth[y], visibility.triangle[y],
                    on_ground.column, grounds, on_surface.column, others,
                )  # fmt: skip
                _note_row(y, old_grounds, grounds, visibility.triangle[y], on_ground)
                _note_row(y, old_others, others, visibility.triangle[y], on_surface)
            old_panes = panes
            panes = _find_panes(visibility.pane[y], on_pane.column, panes)
            _note_row(y, old_panes, panes, visibility.pane[y], on_pane)
            if max(grounds, others, panes) < _BATCH and y < end - 1:
                continue
            if grounds > 0:
                _shade_ground(
                    grounds, on_ground, visibility, view, light,
                    ground_level, to_grain, ground, maps, grain, batch, image,
                )  # fmt: skip
            if others > 0:
                _shade_surfaces(
                    others, on_surface, triangles, visibility, view, light, maps, materials, batch, surfaces, image
                )  # fmt: skip
            if panes > 0:
                _shade_panes(panes, on_pane, triangles, visibility, view, light, maps, batch, surfaces, image)
            grounds = others = panes = 0


@compiled
def _new_places(n: int) -> Places:
    i = np.empty((3, n), dtype=np.int32)
    return Places(i[0], i[1], i[2])


@compiled
def _new_batch(n: int) -> Batch:
    f = np.empty((BATCH_FIELDS, n), dtype=np.float32)
    return Batch(
        f[0], f[1], f[2], f[3], f[4], f[5], f[6], f[7], f[8], f[9], f[10], f[11], f[12], f[13], f[14]
    )


@compiled
def _new_surfaces(n: int) -> Surfaces:
    f = np.empty((12, n), dtype=np.float32)
    material, inside = np.empty(n, dtype=np.int32), np.empty(n, dtype=np.bool_)
    return Surfaces(
        material, inside, f[0], f[1], f[2], f[3], f[4], f[5], f[6], f[7], f[8], f[9], f[10], f[11]
    )  # fmt: skip


@compiled(**VECTOR_LOOP)
def _draw_sky(inverse_depth: Float32Array, background: Float32Array, image: Float32Array) -> bool:
    width = inverse_depth.shape[0]
    covered = np.int32(0)
    for x in range(width):
        covered += np.int32(inverse_depth[x] > 0.0)
    if covered < width:
        for x in range(width):
            for channel in range(3):
                image[x, channel] = background[x, channel]
    return bool(covered > 0)


@compiled(**VECTOR_LOOP)
def _split(
    inverse_depth: Float32Array,
    triangle: Int32Array,
    on_ground: Int32Array,
    grounds: int,
    on_surface: Int32Array,
    others: int,
) -> tuple[int, int]:
    """Append the columns of a row that show the ground or a surface to two lists, and return the new lengths.

    Each column is written to the end of both lists, and stays where the list grows: there are no branches to predict.
    """
    g, s = np.uint64(grounds), np.uint64(others)
    for x in range(triangle.shape[0]):
        surface = triangle[x] >= 0
        on_ground[g] = x
        on_surface[s] = x
        g += np.uint64((inverse_depth[x] > 0.0) & (not surface))
        s += np.uint64(surface)
    return int(g), int(s)


@compiled(**VECTOR_LOOP)
def _find_panes(pane: Int32Array, on_pane: Int32Array, panes: int) -> int:
    nearest = np.int32(-1)
    for x in range(pane.shape[0]):
        nearest = max(nearest, pane[x])
    if nearest < 0:
        return panes
    p = np.uint64(panes)
    for x in range(pane.shape[0]):
        on_pane[p] = x
        p += np.uint64(pane[x] >= 0)
    return int(p)


@compiled(**VECTOR_LOOP)
def _note_row(y: int, begin: int, end: int, triangle: Int32Array, places: Places) -> None:
    for i in range(begin, end):
        places.row[i] = y
        places.triangle[i] = triangle[np.uint64(places.column[i])]


@compiled(fastmath=FAST, _nrt=False)
def _shade_ground(
    n: int,
    places: Places,
    visibility: Visibility,
    view: View,
    light: Light,
    ground_level: Float32Array,
    to_grain: Single,
    ground: GroundTexture,
    maps: LightMaps,
    grain: Tile,
    batch: Batch,
    image: Float32Array,
) -> None:
    locate(n, places, visibility.inverse_depth, view, batch)
    color_ground(n, places, ground_level, to_grain, light.wetness, ground, grain, batch)
    light_ground(n, light, maps, batch)
    if light.wetness > 0.0:
        mirror_in_puddles(n, light, batch)
    fade_into_haze(n, light, batch)
    write(n, places, batch, image)


@compiled(fastmath=FAST, _nrt=False)
def _shade_surfaces(
    n: int,
    places: Places,
    triangles: ScreenTriangles,
    visibility: Visibility,
    view: View,
    light: Light,
    maps: LightMaps,
    materials: Materials,
    batch: Batch,
    surfaces: Surfaces,
    image: Float32Array,
) -> None:
    locate(n, places, visibility.inverse_depth, view, batch)
    orient(n, places, triangles.normal, view, batch, surfaces)
    color_surfaces(n, places, triangles.material, triangles.color, materials, batch, surfaces)
    blotch_surfaces(n, materials.cloud, view.fx, batch, surfaces)
    detail_leaves(n, view.fx, materials.grain, batch, surfaces)
    soil_surfaces(n, materials.response, batch, surfaces)
    light_surfaces(n, light, maps, batch, surfaces)
    mirror_in_surfaces(n, light, maps, batch, surfaces)
    light_lamps(n, places, triangles.color, materials.linear, batch, surfaces)
    fade_into_haze(n, light, batch)
    write(n, places, batch, image)


@compiled(fastmath=FAST, _nrt=False)
def _shade_panes(
    n: int,
    places: Places,
    triangles: ScreenTriangles,
    visibility: Visibility,
    view: View,
    light: Light,
    maps: LightMaps,
    batch: Batch,
    surfaces: Surfaces,
    image: Float32Array,
) -> None:
    locate(n, places, visibility.pane_inverse_depth, view, batch)
    orient(n, places, triangles.normal, view, batch, surfaces)
    read(n, places, image, batch)
    cover_with_glass(n, places, visibility.n_panes, light, maps, batch, surfaces)
    write(n, places, batch, image)
