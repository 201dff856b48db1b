"""Values measured by `parkenv calibrate`, which may replace the assumed ones of a scenario."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from parkenv.errors import InputError, require_number
from parkenv.files.limited_reading import JsonFormat
from parkenv.world.scenario import Scenario

MAX_VALUE = 1_000_000
"""Maximum of each number of a calibration; sums of larger ones could overflow."""
_FORMAT = JsonFormat("parkenv-calibration", 1, "a calibration of `parkenv calibrate`")


@dataclass(frozen=True)
class Calibration:
    """Values measured in a scenario, which may replace the assumed ones."""

    scenario: str
    v_drive: float  # m/s, distance on the drive graph divided by the time on the lanes
    # s, time of an attempt at a taken slot, less the time for the part of the onward route that it covers
    failure_s: float
    # s, from the decision to park until the car stands in the slot. The drive graph does not charge it, so it adds to
    # the total time of every agent that parks.
    manoeuvre_s: float
    trips: int  # number of trips
    speed_limit: float  # speed limit on the lanes, m/s

    def __post_init__(self) -> None:
        for name in ("v_drive", "trips", "speed_limit"):
            require_number(f"calibration {name}", getattr(self, name), above=0.0, most=MAX_VALUE)
        for name in ("failure_s", "manoeuvre_s"):
            require_number(f"calibration {name}", getattr(self, name), least=0.0, most=MAX_VALUE)

    def applied(self, scenario: Scenario) -> Scenario:
        """Return the scenario with the measured speed and failure cost, under the same name."""
        return scenario.replace(v_drive=self.v_drive, failure_s=self.failure_s)

    def to_file(self, path: Path) -> None:
        """Write the calibration as JSON, atomically."""
        _FORMAT.write(path, dataclasses.asdict(self))

    @classmethod
    def from_file(cls, path: Path) -> Self:
        """Read a file written by `to_file`."""
        content = _FORMAT.read(path)
        names = [f.name for f in dataclasses.fields(cls)]
        if missing := [name for name in names if name not in content]:
            raise InputError(f"{path}: has no {', '.join(missing)}")
        return cls(**{name: content[name] for name in names})
