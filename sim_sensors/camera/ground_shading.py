"""Shading of the ground: asphalt and grass in sun and shadow, and puddles."""

import math

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import Float32Array
from parkenv.compiled.jit import compiled
from sim_sensors.camera.batches import Batch, Places
from sim_sensors.camera.daylight import SHADOW_BIAS, Light
from sim_sensors.camera.ground_texture import GroundTexture, sample_ground
from sim_sensors.camera.light_maps import LightMaps, open_sky, sunlit
from sim_sensors.camera.sky import look_up
from sim_sensors.camera.textures import VECTOR_LEAF, VECTOR_LOOP, Single, Tile, hash_unit, sample_tile

_GRAIN_M = 3.0  # m, period of the asphalt's grain
_GRAIN_PER_M = np.float32(1.0 / _GRAIN_M)


def ground_levels(
    rays_down: NDArray[np.float64], height: float, focal: float, texel: float
) -> tuple[Float32Array, Single]:
    """Return the pyramid level, (h,) float32, at which a ground texel is as large as a pixel, for every row.

    And the number to add for levels of the asphalt's grain. `rays_down`, (h,), is the world z of the ray at unit depth
    in the middle of each row, `height` that of the camera, m, `focal` in px, and `texel` the side of a texel of the
    finest level, m.
    """
    depth = -height / np.minimum(rays_down, -1e-3)
    # A pixel covers depth/f across and depth²/(f·h) along the ground: their geometric mean keeps edges sharp.
    footprint = depth / focal * np.sqrt(np.maximum(depth / height, 1.0))
    level = np.maximum(np.log2(footprint / texel) - 0.4, 0.0)
    return level.astype(np.float32), np.float32(math.log2(texel / (_GRAIN_M / 512)))


@compiled(**VECTOR_LOOP)
def color_ground(
    n: int,
    places: Places,
    row_level: Float32Array,
    to_grain: Single,
    wetness: Single,
    ground: GroundTexture,
    grain_of_asphalt: Tile,
    batch: Batch,
) -> None:
    """Set the albedo of the first n pixels, all of the ground, and how wet they are; levels are of `ground_levels`."""
    level = batch.depth  # which the ground no longer needs
    for i in range(n):
        # Rows change from one level to the next in a random pattern instead of a line.
        level[i] = row_level[np.uint64(places.row[i])] + hash_unit(places.column[i], places.row[i])
    for i in range(n):
        albedo, grass, wettable = sample_ground(ground, batch.x[i], batch.y[i], np.int32(level[i]))
        # Asphalt is a warm grey, grass a yellowish green.
        batch.red[i] = albedo * (1.03 - 0.08 * grass)
        batch.green[i] = albedo * (1.0 + 0.25 * grass)
        batch.blue[i] = albedo * (0.95 - 0.45 * grass)
        batch.wettable[i] = wettable
    for i in range(n):
        x, y = batch.x[i] * _GRAIN_PER_M, batch.y[i] * _GRAIN_PER_M
        grain = 0.55 + 0.9 * sample_tile(grain_of_asphalt, x, y, np.int32(level[i] + to_grain))
        grain *= 1.0 - 0.45 * _wet(wetness, batch.wettable[i])
        batch.grain[i] = grain
        batch.red[i] *= grain
        batch.green[i] *= grain
        batch.blue[i] *= grain


@compiled(**VECTOR_LOOP)
def light_ground(n: int, light: Light, maps: LightMaps, batch: Batch) -> None:
    for i in range(n):
        batch.sun[i] = sunlit(maps, batch.x[i], batch.y[i], 0.0, SHADOW_BIAS)
    for i in range(n):
        sun = light.sun_direction[2] * batch.sun[i]
        sky = open_sky(maps, batch.x[i], batch.y[i])
        batch.red[i] *= light.sun[0] * sun + light.sky[0] * sky
        batch.green[i] *= light.sun[1] * sun + light.sky[1] * sky
        batch.blue[i] *= light.sun[2] * sun + light.sky[2] * sky
        batch.sky[i] = sky


@compiled(**VECTOR_LOOP)
def mirror_in_puddles(n: int, light: Light, batch: Batch) -> None:
    """Add what water on the first n pixels reflects: the sky, or a dark car where the sky is occluded."""
    for i in range(n):
        steep = 1.0 + batch.ray_z[i]
        mirror = 0.025 + 0.975 * steep * steep * steep * steep * steep
        mirror *= _wet(light.wetness, batch.wettable[i]) * min(1.0, 0.3 + 1.1 * batch.wettable[i])
        mirror *= batch.sky[i] * batch.sky[i]
        ripple = 0.05 * (batch.grain[i] - 1.0)
        x, y = batch.ray_x[i] + ripple, batch.ray_y[i] + ripple
        red, green, blue = look_up(light.mirrored, light.brightest, x, y, max(-batch.ray_z[i], 0.0))
        batch.red[i] += (red - batch.red[i]) * mirror
        batch.green[i] += (green - batch.green[i]) * mirror
        batch.blue[i] += (blue - batch.blue[i]) * mirror


@compiled(**VECTOR_LEAF)
def _wet(wetness: Single, wettable: Single) -> Single:
    return wetness * min(1.0, 0.45 + 1.2 * wettable)
