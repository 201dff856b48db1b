"""Values measured by `parkenv calibrate`, which may replace the assumed ones of a scenario."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Self

from pydantic import Field

from parkenv.errors import InputError, naming
from parkenv.files.field_types import NotNegative, Positive, Validated, Whole
from parkenv.files.limited_reading import JsonFormat
from parkenv.world.scenario import Scenario

MAX_VALUE = 1_000_000  # maximum of each number of a calibration; sums of larger ones could overflow
_Positive = Annotated[Positive, Field(le=MAX_VALUE)]
_Seconds = Annotated[NotNegative, Field(le=MAX_VALUE)]
_Count = Annotated[Whole, Field(ge=1, le=MAX_VALUE)]
_FORMAT = JsonFormat("parkenv-calibration", 1, "a calibration of `parkenv calibrate`")


@dataclass(frozen=True)
class Calibration(Validated):
    """Values measured in a scenario, which may replace the assumed ones."""

    scenario: str
    v_drive: _Positive  # m/s, distance on the drive graph divided by the time on the lanes
    # s, time of an attempt at a taken slot, less the time for the part of the onward route that it covers
    failure_s: _Seconds
    # s, from the decision to park until the car stands in the slot. The drive graph does not charge it, so it adds to
    # the total time of every agent that parks.
    manoeuvre_s: _Seconds
    trips: _Count  # number of trips
    speed_limit: _Positive  # speed limit on the lanes, m/s

    def applied(self, scenario: Scenario) -> Scenario:
        return scenario.replace(v_drive=self.v_drive, failure_s=self.failure_s)

    def to_file(self, path: Path) -> None:
        _FORMAT.write(path, dataclasses.asdict(self))

    @classmethod
    def from_file(cls, path: Path) -> Self:
        content = _FORMAT.read(path)
        names = [f.name for f in dataclasses.fields(cls)]
        if missing := [name for name in names if name not in content]:
            raise InputError(f"{path}: has no {', '.join(missing)}")
        with naming(path):
            return cls(**{name: content[name] for name in names})
