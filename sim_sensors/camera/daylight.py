"""Light that reaches a point: from the sun, from the sky, and by mirror reflection."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import Float32Array
from parkenv.compiled.jit import compiled
from sim_sensors.camera.light_maps import LightMaps, open_sky
from sim_sensors.camera.sky import look_up, packed_sky
from sim_sensors.camera.textures import VECTOR_LEAF, Single
from sim_sensors.camera.weather import Weather

Color = tuple[Single, Single, Single]

SHADOW_BIAS = np.float32(0.05)  # m, offset towards the sun, against self-shadowing

_GROUND_TONE = 0.12  # albedo of the ground in reflections and for bounced light


class Light(NamedTuple):
    """A weather's light for compiled code; colours are (3,) float32, relative linear RGB radiance (see `Weather`)."""

    sun_direction: Float32Array  # (3,), world frame
    sun: Float32Array
    sky: Float32Array
    horizon: Float32Array
    haze: Single
    wetness: Single
    background: Float32Array  # (h, w, 3), the sky behind every pixel
    mirrored: NDArray[np.uint32]  # and `brightest`: the blurred sky, for `look_up`
    brightest: Single
    ground: Float32Array  # open ground in reflections and as bounced light


def daylight(weather: Weather, background: Float32Array) -> Light:
    sun, sky = np.array(weather.sun), np.array(weather.sky)
    ground = _GROUND_TONE * (1.0 - 0.5 * weather.wetness) * (sun * weather.sun_direction[2] + sky)
    return Light(
        np.array(weather.sun_direction, dtype=np.float32),
        sun.astype(np.float32),
        sky.astype(np.float32),
        np.array(weather.horizon, dtype=np.float32),
        np.float32(weather.haze),
        np.float32(weather.wetness),
        background,
        *packed_sky(weather),
        ground.astype(np.float32),
    )


@compiled(**VECTOR_LEAF)
def mirrored(
    px: Single, py: Single, pz: Single, rx: Single, ry: Single, rz: Single, light: Light, maps: LightMaps
) -> Color:
    """Return the radiance seen from a point in direction (rx, ry, rz): the sky, or the ground with its shadows."""
    red, green, blue = look_up(light.mirrored, light.brightest, rx, ry, max(rz, 0.0))
    reach = max(pz, 0.05) / max(-rz, 0.02)
    hidden = open_sky(maps, px + rx * reach, py + ry * reach)
    # Other cars, kerbs and hedges towards the horizon are darker than the open ground.
    tone = (0.25 + 0.75 * hidden) * (1.0 - 0.45 * min(1.0, reach * 0.12))
    up = rz >= 0.0
    return (
        red if up else light.ground[0] * tone,
        green if up else light.ground[1] * tone,
        blue if up else light.ground[2] * tone,
    )
