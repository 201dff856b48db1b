"""The sensor model: range and error rates of slot observations from the lane."""

from __future__ import annotations

import os
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np

from parkenv.compiled.arrays import BoolArray, FloatArray
from parkenv.errors import InputError, require, require_one_of
from parkenv.files.field_types import Flag, NotNegative, Probability, Validated
from parkenv.files.limited_reading import JsonFormat

SENSOR_MODEL_NAMES = ("laser", "stereo")  # rigs with a packaged fitted sensor model
_FOLDER = Path(__file__).parent / "sensor_models"
_FORMAT = JsonFormat("parkenv-sensor-model", 1, "a sensor model")


class SensorRates(NamedTuple):
    seen: FloatArray  # (k,) float64, P(a slot in view is observed)
    hit: FloatArray  # (k,) float64, P(observed taken | taken, observed)
    false_alarm: FloatArray  # (k,) float64, P(observed taken | free, observed)

    def of(self, rows: slice) -> SensorRates:
        return SensorRates(self.seen[rows], self.hit[rows], self.false_alarm[rows])


@dataclass(frozen=True)
class SensorBand(Validated):
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

    up_to: NotNegative
    beside: Flag
    seen_rate: Probability
    hit_rate: Probability
    false_alarm_rate: Probability

    def __post_init__(self) -> None:
        super().__post_init__()
        _require_informative(self.hit_rate, self.false_alarm_rate)


@dataclass(frozen=True)
class SensorModel(Validated):
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

    view_range: NotNegative = 6.0
    hit_rate: Probability = 1.0
    false_alarm_rate: Probability = 0.0
    bands: tuple[SensorBand, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        _require_informative(self.hit_rate, self.false_alarm_rate)

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

    def rates(self, distance: FloatArray, beside: BoolArray) -> SensorRates:
        """Return the rates of slots at given distances, (k,) m, beside the car or not, (k,) bool."""
        k = len(distance)
        rates = SensorRates(np.ones(k), np.full(k, self.hit_rate), np.full(k, self.false_alarm_rate))
        for band in sorted(self.bands, key=lambda band: -band.up_to):
            reached = (distance <= band.up_to) & (beside == band.beside)
            rates.seen[reached] = band.seen_rate
            rates.hit[reached] = band.hit_rate
            rates.false_alarm[reached] = band.false_alarm_rate
        return rates


def _require_informative(hit_rate: float, false_alarm_rate: float) -> None:
    require(
        hit_rate > false_alarm_rate,
        f"hit_rate {hit_rate} is not above false_alarm_rate {false_alarm_rate}: "
        "observations would carry no information",
    )
