"""The state of a drive into a slot, as the environment changes it and pictures show it."""

from __future__ import annotations

import copy
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from parkenv.driving.parking_task import ParkingTask

FloatArray = NDArray[np.float64]


@dataclass
class DriveState:
    """Everything that changes during an episode; `DriveEnv.get_state` hands out a copy."""

    key: np.uint64
    task: ParkingTask
    vehicle: FloatArray
    rng: np.random.Generator
    time: float = 0.0
    driven_m: float = 0.0
    direction: int = 0
    direction_changes: int = 0
    contact: str = ""
    parked: bool = False
    over: bool = False
    clocks: FloatArray = field(default_factory=lambda: np.empty(0))
    movers: FloatArray = field(default_factory=lambda: np.empty((0, 3)))
    trail: list[tuple[float, float, float]] = field(default_factory=list)

    def __deepcopy__(self, memo: dict[int, Any]) -> DriveState:
        twin = copy.copy(self)  # a task never changes
        twin.vehicle = self.vehicle.copy()
        twin.rng = copy.deepcopy(self.rng, memo)
        twin.trail = list(self.trail)
        twin.clocks, twin.movers = self.clocks.copy(), self.movers.copy()
        return twin
