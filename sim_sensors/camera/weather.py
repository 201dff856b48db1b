"""Weather: sun, sky, haze and rain, by preset and seed."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from sim_sensors.errors import SensorError, require_numbers

Color = tuple[float, float, float]


class _Drawn(NamedTuple):
    low: float
    high: float
    color: Color | None = None

    def draw(self, generator: np.random.Generator) -> float | Color:
        factor = float(generator.uniform(self.low, self.high))
        if self.color is None:
            return factor
        red, green, blue = self.color
        return red * factor, green * factor, blue * factor


_BLACK: Color = (0.0, 0.0, 0.0)

# Fields of `Weather` by preset, in the order in which they are drawn; another order would change the weather.
_PRESETS: dict[str, dict[str, _Drawn | float | Color]] = {
    "sunny": {
        "sun_elevation": _Drawn(0.6, 1.1),
        "sun": _Drawn(2.3, 3.0, (1.0, 0.96, 0.87)),
        "sky": _Drawn(0.7, 0.95, (0.76, 0.86, 1.0)),
        "zenith": _Drawn(0.8, 1.1, (0.22, 0.38, 0.78)),
        "horizon": _Drawn(0.9, 1.1, (0.72, 0.82, 0.95)),
        "clouds": _Drawn(0.05, 0.55),
        "haze": _Drawn(0.0004, 0.0015),
    },
    "overcast": {
        "sun": _Drawn(0.0, 0.12, (1.0, 1.0, 1.0)),
        "sun_elevation": _Drawn(0.5, 1.0),
        "sky": _Drawn(0.8, 1.05, (0.94, 0.98, 1.04)),
        "zenith": _Drawn(0.85, 1.05, (0.98, 1.0, 1.04)),
        "horizon": _Drawn(0.8, 1.0, (0.78, 0.8, 0.84)),
        "clouds": _Drawn(0.85, 1.0),
        "haze": _Drawn(0.001, 0.004),
    },
    "low_sun": {
        "sun_elevation": _Drawn(0.12, 0.3),
        "sun": _Drawn(1.5, 2.2, (1.0, 0.74, 0.46)),
        "sky": _Drawn(0.4, 0.55, (0.72, 0.8, 1.0)),
        "zenith": _Drawn(0.6, 0.9, (0.25, 0.36, 0.62)),
        "horizon": _Drawn(0.8, 1.1, (1.0, 0.8, 0.58)),
        "clouds": _Drawn(0.1, 0.6),
        "haze": _Drawn(0.001, 0.004),
    },
    "dusk": {
        "sun_elevation": 0.05,
        "sun": _BLACK,
        "sky": _Drawn(0.03, 0.08, (0.8, 0.88, 1.1)),
        "zenith": _Drawn(0.8, 1.2, (0.03, 0.045, 0.085)),
        "horizon": _Drawn(0.6, 1.0, (0.16, 0.12, 0.1)),
        "clouds": _Drawn(0.1, 0.7),
        "haze": _Drawn(0.001, 0.003),
    },
    "rain": {
        "sun_elevation": _Drawn(0.5, 1.0),
        "sun": _BLACK,
        "sky": _Drawn(0.35, 0.6, (0.9, 0.97, 1.05)),
        "zenith": _Drawn(0.35, 0.55, (0.9, 0.95, 1.0)),
        "horizon": _Drawn(0.4, 0.55, (0.8, 0.83, 0.87)),
        "clouds": 1.0,
        "haze": _Drawn(0.005, 0.012),
        "wetness": _Drawn(0.6, 1.0),
        "rain": _Drawn(0.3, 1.0),
    },
}

PRESETS = tuple(_PRESETS)  # names of the weather presets


@dataclass(frozen=True)
class Weather:
    """The light of a scene. Radiance is relative: a white wall under an open overcast sky has radiance 1.

    Args:
        preset: name of the preset that it was drawn from.
        sun_azimuth: rad, direction to the sun, world frame, counter-clockwise from x.
        sun_elevation: rad above the horizon.
        sun: radiance of a white surface that faces the sun, linear RGB; black when hidden.
        sky: radiance of a white surface under the whole sky, linear RGB.
        zenith, horizon: radiance of the clear sky at zenith and horizon, linear RGB.
        clouds: fraction of the sky that clouds cover.
        haze: 1/m, rate at which objects fade into the horizon's colour.
        wetness: from 0, dry, to 1, puddles.
        rain: from 0, none, to 1, streaks in the air.
        seed: seed of clouds, skyline and puddles.

    Raises:
        SensorError: a value is not finite, or out of range.
    """

    preset: str = "sunny"
    sun_azimuth: float = -1.0
    sun_elevation: float = 0.8
    sun: Color = (2.6, 2.5, 2.25)
    sky: Color = (0.75, 0.85, 1.0)
    zenith: Color = (0.22, 0.38, 0.78)
    horizon: Color = (0.72, 0.82, 0.95)
    clouds: float = 0.3
    haze: float = 0.0008
    wetness: float = 0.0
    rain: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        require_numbers(self, "sun_azimuth")
        require_numbers(self, "sun_elevation haze", least=0.0)
        require_numbers(self, "clouds wetness rain", least=0.0, most=1.0)
        for name in ("sun", "sky", "zenith", "horizon"):
            value = getattr(self, name)
            if len(value) != 3 or not all(math.isfinite(part) and part >= 0.0 for part in value):
                raise SensorError(f"{name} is {value}, want three finite numbers of at least 0")

    @property
    def sun_direction(self) -> Color:
        """Unit vector to the sun, world frame."""
        flat = math.cos(self.sun_elevation)
        return (
            flat * math.cos(self.sun_azimuth),
            flat * math.sin(self.sun_azimuth),
            math.sin(self.sun_elevation),
        )

    @classmethod
    def draw(cls, preset: str, seed: int) -> Weather:
        """Draw the weather of a preset.

        Args:
            preset: one of `PRESETS`.
            seed: any integer of at least 0; equal seeds give equal weather.

        Raises:
            SensorError: an unknown preset or a negative seed.
        """
        if preset not in PRESETS:
            raise SensorError(f"weather preset is {preset!r}, want one of {', '.join(PRESETS)}")
        if seed < 0:
            raise SensorError(f"weather seed is {seed}, want at least 0")
        generator = np.random.default_rng([seed, PRESETS.index(preset)])
        azimuth = float(generator.uniform(-math.pi, math.pi))
        fields: dict[str, Any] = {
            name: value.draw(generator) if isinstance(value, _Drawn) else value
            for name, value in _PRESETS[preset].items()
        }
        return cls(preset, azimuth, **fields, seed=seed)
