"""The state of an episode of `parkenv/Drive-v1`."""

from __future__ import annotations

import copy
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from parkenv.compiled.arrays import FloatArray
from parkenv.driving.parking_task import ParkingTask


@dataclass
class DriveState:
    """Everything that changes during an episode."""

    key: np.uint64
    task: ParkingTask  # the parking task; never changes
    vehicle: FloatArray  # (6,) state of the car, see `parkenv.driving.vehicle`
    rng: np.random.Generator  # random generator of the laser's noise
    time: float = 0.0  # time since the start, s
    driven_m: float = 0.0  # distance driven, m
    direction: int = 0  # direction of the last motion: 1 forward, -1 backward, 0 before the first
    direction_changes: int = 0  # number of changes between forward and backward
    contact: str = ""  # name of the obstacle touched, empty without one
    parked: bool = False  # whether the car has parked
    over: bool = False  # whether the episode has ended
    clocks: FloatArray = field(default_factory=lambda: np.empty(0))  # (n,) s, time of each moving road user
    # (n, 3) x, y in m and yaw in rad, poses of the moving road users
    movers: FloatArray = field(default_factory=lambda: np.empty((0, 3)))
    # x, y in m and yaw in rad of the rear axle after each step
    trail: list[tuple[float, float, float]] = field(default_factory=list)

    def __deepcopy__(self, memo: dict[int, Any]) -> DriveState:
        twin = copy.copy(self)  # a task never changes
        twin.vehicle = self.vehicle.copy()
        twin.rng = copy.deepcopy(self.rng, memo)
        twin.trail = list(self.trail)
        twin.clocks, twin.movers = self.clocks.copy(), self.movers.copy()
        return twin
