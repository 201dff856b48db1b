"""The state of an episode of `parkenv/Drive-v1`."""

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
    """Everything that changes during an episode.

    Args:
        key: key of the world.
        task: the parking task; never changes.
        vehicle: (6,) state of the car, see `parkenv.driving.vehicle`.
        rng: random generator of the laser's noise.
        time: time since the start, s.
        driven_m: distance driven, m.
        direction: direction of the last motion: 1 forward, -1 backward, 0 before the first.
        direction_changes: number of changes between forward and backward.
        contact: name of the obstacle touched, empty without one.
        parked: whether the car has parked.
        over: whether the episode has ended.
        clocks: (n,) s, time of each moving road user.
        movers: (n, 3) x, y in m and yaw in rad, poses of the moving road users.
        trail: x, y in m and yaw in rad of the rear axle after each step.
    """

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
