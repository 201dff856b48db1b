"""Shading of the ground: asphalt and grass in sun and shadow, and puddles."""

from __future__ import annotations

import math

from sim_sensors.camera.daylight import SHADOW_BIAS, Color, Light, Vector
from sim_sensors.camera.ground_texture import GroundTexture, sample_ground, sample_water
from sim_sensors.camera.light_maps import LightMaps, open_sky, sunlit
from sim_sensors.camera.sky import look_up
from sim_sensors.camera.textures import LEAF, Tile, sample_tile
from sim_sensors.compilation import compiled


@compiled(**LEAF)
def ground_level(row_z: float, height: float, focal: float, texel: float) -> float:
    """Return the pyramid level at which a ground texel is about as large as a pixel, in the middle of a row.

    Args:
        row_z: world z of the row's ray at unit depth.
        height: m, camera height above the ground.
        focal: px, focal length along the row.
        texel: m, side of a texel of the finest level.
    """
    depth = -height / min(row_z, -1e-3)
    # A pixel covers depth/f across and depth²/(f·h) along the ground: their geometric mean keeps edges sharp.
    footprint = depth / focal * math.sqrt(max(depth / height, 1.0))
    return max(math.log2(footprint / texel) - 0.4, 0.0)


@compiled(**LEAF)
def ground_radiance(
    px: float,
    py: float,
    ray: Vector,
    level: int,
    grain_level: int,
    light: Light,
    ground: GroundTexture,
    maps: LightMaps,
    grain_of_asphalt: Tile,
) -> Color:
    """Return the radiance, linear RGB, of the ground at (px, py), m, seen along the unit vector `ray`.

    `level` and `grain_level` are the levels of the pyramids of the ground and of the asphalt's grain.
    """
    albedo, grass, texel, below = sample_ground(ground, px, py, level)
    grain = 0.55 + 0.9 * sample_tile(grain_of_asphalt, px / 3.0, py / 3.0, grain_level)
    sky = open_sky(maps, px, py)
    sun = 0.0
    if light.sun[0] > 0.0:
        sun = light.sun_direction[2] * sunlit(maps, px, py, 0.0, SHADOW_BIAS)
    wet = 0.0
    if light.wetness > 0.0:
        wettable = sample_water(ground, texel, below)
        wet = light.wetness * min(1.0, 0.45 + 1.2 * wettable)
        grain *= 1.0 - 0.45 * wet
    albedo *= grain
    # Asphalt is a warm grey, grass a yellowish green.
    red = albedo * (1.03 - 0.08 * grass) * (light.sun[0] * sun + light.sky[0] * sky)
    green = albedo * (1.0 + 0.25 * grass) * (light.sun[1] * sun + light.sky[1] * sky)
    blue = albedo * (0.95 - 0.45 * grass) * (light.sun[2] * sun + light.sky[2] * sky)
    if wet > 0.0:
        # Water reflects the sky, or a dark car where the sky is occluded.
        dx, dy, dz = ray
        mirror = 1.0 + dz
        mirror = (0.025 + 0.975 * mirror * mirror * mirror * mirror * mirror) * wet
        mirror *= min(1.0, 0.3 + 1.1 * wettable)
        ripple = 0.05 * (grain - 1.0)
        m_red, m_green, m_blue = look_up(light.mirrored, dx + ripple, dy + ripple, max(-dz, 0.0))
        mirror *= sky * sky
        red += (m_red - red) * mirror
        green += (m_green - green) * mirror
        blue += (m_blue - blue) * mirror
    return red, green, blue
