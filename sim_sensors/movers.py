"""Moving vehicles and pedestrians of a scene at one moment."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray, IntArray
from sim_sensors.errors import SensorError, as_floats, as_integers
from sim_sensors.mesh import Mesh
from sim_sensors.scenery import GAITS, pedestrian_mesh

LOOKS = 12  # number of different pedestrians


@dataclass(frozen=True, eq=False)
class Movers:
    """Moving vehicles and pedestrians at one moment; world frame."""

    # (m, 3): x, y in m, yaw in rad
    vehicle_pose: FloatArray = field(default_factory=lambda: np.empty((0, 3)))
    # (m,) int, index into the scene's `fleet.models`
    vehicle_model: IntArray = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    walker_pose: FloatArray = field(default_factory=lambda: np.empty((0, 3)))  # (p, 3): x, y in m, yaw in rad
    walker_stride: FloatArray = field(default_factory=lambda: np.empty(0))  # (p,) turns, phase of the stride
    # (p,) int, 0 to `LOOKS` - 1: appearance
    walker_look: IntArray = field(default_factory=lambda: np.empty(0, dtype=np.int64))

    def __post_init__(self) -> None:
        for name, rows in (("vehicle_pose", "vehicle_model"), ("walker_pose", "walker_look")):
            object.__setattr__(self, name, as_floats(name, getattr(self, name), None, 3))
            numbers = as_integers(rows, np.asarray(getattr(self, rows)), len(getattr(self, name)), least=0)
            object.__setattr__(self, rows, numbers)
        stride = as_floats("walker_stride", self.walker_stride, self.n_walkers)
        object.__setattr__(self, "walker_stride", stride)
        if self.walker_look.max(initial=0) >= LOOKS:
            raise SensorError(f"walker_look is {self.walker_look.tolist()}, want 0 to {LOOKS - 1}")

    @property
    def n_vehicles(self) -> int:
        return len(self.vehicle_pose)

    @property
    def n_walkers(self) -> int:
        return len(self.walker_pose)

    def only(self, vehicles: NDArray[np.bool_], walkers: NDArray[np.bool_]) -> Movers:
        return Movers(
            self.vehicle_pose[vehicles],
            self.vehicle_model[vehicles],
            self.walker_pose[walkers],
            self.walker_stride[walkers],
            self.walker_look[walkers],
        )

    def joined(self, others: Movers | None) -> Movers:
        """Return these and others, after them."""
        if others is None:
            return self
        return Movers(*(np.concatenate([getattr(m, f.name) for m in (self, others)]) for f in fields(self)))

    @property
    def gait(self) -> IntArray:
        return np.round(self.walker_stride * GAITS).astype(np.int64) % GAITS


@lru_cache(maxsize=1)
def people_meshes() -> tuple[Mesh, ...]:
    return tuple(pedestrian_mesh(gait / GAITS, look) for look in range(LOOKS) for gait in range(GAITS))
