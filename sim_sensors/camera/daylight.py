"""Light that reaches a point: from the sun, from the sky, and by mirror reflection."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim_sensors.camera.light_maps import LightMaps, open_sky
from sim_sensors.camera.sky import look_up, mirrored_sky
from sim_sensors.camera.textures import LEAF
from sim_sensors.camera.weather import Weather
from sim_sensors.compilation import compiled

Float32Array = NDArray[np.float32]
FloatArray = NDArray[np.float64]
Color = tuple[float, float, float]
Vector = tuple[float, float, float]

SHADOW_BIAS = 0.05  # m, offset towards the sun, against self-shadowing

_GROUND_TONE = 0.12  # albedo of the ground in reflections and for bounced light


class Light(NamedTuple):
    """The light of a weather for compiled code; colours are relative linear RGB radiance (see `Weather`).

    Attributes:
        sun_direction: (3,) float64, unit vector to the sun, world frame.
        sun, sky, horizon: (3,) float64, as in `Weather`.
        haze, wetness, lit_windows: as in `Weather`.
        background: (h, w, 3) float32, the sky behind every pixel.
        mirrored: (n, n, 3) float32, the blurred sky, for `look_up`.
        ground: (3,) float64, radiance of open ground in reflections and as bounced light.
    """

    sun_direction: FloatArray
    sun: FloatArray
    sky: FloatArray
    horizon: FloatArray
    haze: float
    wetness: float
    lit_windows: float
    background: Float32Array
    mirrored: Float32Array
    ground: FloatArray


def daylight(weather: Weather, background: Float32Array) -> Light:
    """Return the light of a weather.

    Args:
        weather: the weather.
        background: (h, w, 3) float32, the sky of the view.
    """
    sun, sky = np.array(weather.sun), np.array(weather.sky)
    ground = _GROUND_TONE * (1.0 - 0.5 * weather.wetness) * (sun * weather.sun_direction[2] + sky)
    strengths = weather.haze, weather.wetness, weather.lit_windows
    direction, horizon = np.array(weather.sun_direction), np.array(weather.horizon)
    return Light(direction, sun, sky, horizon, *strengths, background, mirrored_sky(weather), ground)


@compiled(**LEAF)
def mirrored(
    px: float, py: float, pz: float, rx: float, ry: float, rz: float, light: Light, maps: LightMaps
) -> Color:
    """Return the radiance seen from a point in direction (rx, ry, rz): the sky, or the ground with its shadows."""
    if rz >= 0.0:
        red, green, blue = look_up(light.mirrored, rx, ry, rz)
        return red, green, blue
    reach = max(pz, 0.05) / max(-rz, 0.02)
    hidden = open_sky(maps, px + rx * reach, py + ry * reach)
    # Other cars, kerbs and hedges towards the horizon are darker than the open ground.
    far = min(1.0, reach * 0.12)
    tone = (0.25 + 0.75 * hidden) * (1.0 - 0.45 * far)
    return light.ground[0] * tone, light.ground[1] * tone, light.ground[2] * tone
