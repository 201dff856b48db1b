"""The sensor model: range and error rates of slot observations from the lane."""

from __future__ import annotations

import os
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray
from parkenv.errors import InputError, require_number, require_one_of
from parkenv.files.limited_reading import JsonFormat

SENSOR_MODEL_NAMES = ("laser", "stereo")  # rigs with a packaged fitted sensor model
_FOLDER = Path(__file__).parent / "sensor_models"
_FORMAT = JsonFormat("parkenv-sensor-model", 1, "a sighting model")


class SensorRates(NamedTuple):
    """Sensor rates for k slots."""

    seen: FloatArray  # (k,) float64, P(a slot in view is observed)
    hit: FloatArray  # (k,) float64, P(observed taken | taken, observed)
    false_alarm: FloatArray  # (k,) float64, P(observed taken | free, observed)

    def of(self, rows: slice) -> SensorRates:
        """The rates of some of the slots."""
        return SensorRates(self.seen[rows], self.hit[rows], self.false_alarm[rows])


@dataclass(frozen=True)
class SensorBand:
    """Sensor rates for slots within some distance, on one side.

    Args:
        up_to: m, distance from the car to the slot's vertex; the nearest band that reaches the slot applies.
        beside: whether the band is for slots to the right of a car on its lane, where the thesis's camera points.
        seen_rate: P(a slot in view is observed). Occlusions persist: observing again from the same distance reveals
            nothing new.
        hit_rate: P(observed taken | taken).
        false_alarm_rate: P(observed taken | free).

    Raises:
        InputError: a rate outside [0, 1], a negative distance, or uninformative observations (equal rates).
    """

    up_to: float
    beside: bool
    seen_rate: float
    hit_rate: float
    false_alarm_rate: float

    def __post_init__(self) -> None:
        require_number("up_to", self.up_to, least=0.0)
        if not isinstance(self.beside, bool):
            raise InputError(f"beside is {self.beside!r}, want true or false")
        _require_rates(self.hit_rate, self.false_alarm_rate)
        require_number("seen_rate", self.seen_rate, least=0.0, most=1.0)


@dataclass(frozen=True)
class SensorModel:
    """Range and error rates of slot observations from the lane.

    Args:
        view_range: m; a slot is in view while the car is within this distance of the slot's vertex. The
            default covers the slot at the car's vertex, its neighbours and those across the aisle.
        hit_rate: P(observed taken | taken).
        false_alarm_rate: P(observed taken | free).
        bands: rates by distance and side; where a band applies, it overrides these two rates.

    Raises:
        InputError: a rate outside [0, 1], a negative range, or uninformative observations (equal rates).
    """

    view_range: float = 6.0
    hit_rate: float = 1.0
    false_alarm_rate: float = 0.0
    bands: tuple[SensorBand, ...] = ()

    def __post_init__(self) -> None:
        require_number("view_range", self.view_range, least=0.0)
        _require_rates(self.hit_rate, self.false_alarm_rate)

    @classmethod
    def named(cls, name: str) -> Self:
        """Return the sensor model fitted to the perception stack with a rig by `parkenv fit-sensor-model`.

        Args:
            name: `laser`, a camera and a 270° laser; `stereo`, only a stereo pair.

        Raises:
            InputError: an unknown name.

        Examples:
            >>> SensorModel.named("laser").view_range
            16.0
        """
        require_one_of("sensor_model", name, SENSOR_MODEL_NAMES)
        return cls.from_file(_FOLDER / f"{name}.json")

    @classmethod
    def from_file(cls, path: str | os.PathLike[str]) -> Self:
        """Read a file written by `to_file`.

        Raises:
            InputError: the file cannot be read; the message names the file and the problem.
        """
        content = _FORMAT.read(path)
        try:
            bands = tuple(SensorBand(**band) for band in content["bands"])
            return cls(content["view_range"], content["hit_rate"], content["false_alarm_rate"], bands)
        except (KeyError, TypeError, InputError) as error:
            raise InputError(f"{path}: {error}") from error

    def to_file(self, path: str | os.PathLike[str]) -> None:
        """Write the model as JSON."""
        _FORMAT.write(path, asdict(self))

    @classmethod
    def blind(cls) -> Self:
        """Return a model without observations: only a parking attempt reveals a slot's state."""
        return cls(0.0, bands=tuple(SensorBand(0.0, beside, 0.0, 1.0, 0.0) for beside in (False, True)))

    @property
    def perfect(self) -> bool:
        """Whether all observations are error-free."""
        return not self.bands and self.hit_rate == 1.0 and self.false_alarm_rate == 0.0

    def rates(self, distance: FloatArray, beside: NDArray[np.bool_]) -> SensorRates:
        """Return the rates of slots at given distances, (k,) m, beside the car or not, (k,) bool."""
        k = len(distance)
        rates = SensorRates(np.ones(k), np.full(k, self.hit_rate), np.full(k, self.false_alarm_rate))
        for band in sorted(self.bands, key=lambda band: -band.up_to):
            reached = (distance <= band.up_to) & (beside == band.beside)
            rates.seen[reached] = band.seen_rate
            rates.hit[reached] = band.hit_rate
            rates.false_alarm[reached] = band.false_alarm_rate
        return rates


def _require_rates(hit_rate: float, false_alarm_rate: float) -> None:
    for name, rate in (("hit_rate", hit_rate), ("false_alarm_rate", false_alarm_rate)):
        require_number(name, rate, least=0.0, most=1.0)
    if hit_rate <= false_alarm_rate:
        raise InputError(
            f"hit_rate {hit_rate} is not above false_alarm_rate {false_alarm_rate}: "
            "observations would carry no information"
        )
