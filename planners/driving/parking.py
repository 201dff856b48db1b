"""The planning parking agent: it plans a path among the obstacles, tracks it, and replans after deviations."""

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray
from parkenv.driving.road_users import is_blocked
from parkenv.driving.vehicle import VehicleParameters
from parkenv.errors import require
from planners.agent import predict_each
from planners.driving.car_path import CarPath
from planners.driving.hybrid_astar import SearchSettings, plan_path, why_no_path
from planners.driving.path_tracking import PathTracker

MOST_PLANS = 12
"""Maximum number of plans per episode; after that the car stays where it is."""
STRAYED_M, STRAYED_RAD = 0.20, math.radians(12.0)
"""Deviation from the path, m and rad, that triggers replanning."""

PATIENCE_S = 3.0
"""Time of waiting for a standing road user, s, after which a path around it is planned."""

_CONTROL_S = 0.1
_NOWHERE = 999.0  # m; unused rows of the obstacle map are farther away
_STANDS = 0.01
Observation = Mapping[str, Any]
_Task = tuple[VehicleParameters, FloatArray, NDArray[np.int64], FloatArray, FloatArray]


@dataclass
class ParkingMemory:
    """State of the agent within an episode.

    Attributes:
        tracker: tracker of the current path, if any.
        paths: all planned paths, in the slot's frame.
        planning_s: wall time of each planning call, s.
        reason: why the car stands still where no path was found; else empty.
        others: (n, 2) m, positions of the moving road users at the previous step.
        waited_s: s, time that the car has waited for road users.
    """

    tracker: PathTracker | None = None
    paths: list[CarPath] = field(default_factory=list)
    planning_s: list[float] = field(default_factory=list)
    reason: str = ""
    others: FloatArray | None = None
    waited_s: float = 0.0


class ParkingAgent:
    """Parks in `parkenv/Drive-v1` with hybrid A*, Reeds-Shepp shots and a tracking controller.

    The agent knows the car and the observation: the poses of car and slot and, with `obstacle_map=True`, the outlines
    of parked cars, kerbs and walls, and of moving road users, for which it waits.

    Args:
        vehicle: the car.
        search: settings of the planner.
    """

    name = "planner"

    def __init__(
        self, vehicle: VehicleParameters | None = None, search: SearchSettings | None = None
    ) -> None:
        self.vehicle = vehicle or VehicleParameters()
        self.search = search or SearchSettings()

    def predict(
        self,
        observation: Observation,
        state: Any = None,
        episode_start: NDArray[np.bool_] | Sequence[bool] | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[np.float32], Any]:
        """Return the action, (2,) float32, and the state for the next call, as `Agent.predict`; or those of a batch.

        Raises:
            InputError: an observation without the obstacle map, or of another vehicle than the agent's.
        """
        self.require_map(observation)
        return predict_each(self._predict_one, observation, "achieved_goal", 1, state, episode_start)

    def _predict_one(
        self, observation: Observation, memory: ParkingMemory | None
    ) -> tuple[NDArray[np.float32], ParkingMemory]:
        memory = memory or ParkingMemory()
        return self._decide(observation, memory), memory

    def require_map(self, observation: Observation) -> None:
        """Raise an `InputError` unless observations have the obstacle map and are of the agent's own vehicle."""
        for key in ("cars", "lines", "vehicle"):
            require(
                key in observation,
                f"the observation has no {key!r}: make the environment with obstacle_map=True",
            )
        self.vehicle.require_same(observation["vehicle"], f"agent {self.name!r}")

    def plan(self, observation: Observation, *, around_others: bool = False) -> CarPath | None:
        """Plan a path to the desired pose, in the slot's frame, or None; road users stand still, or are not there."""
        return plan_path(*self._task(observation, around_others), self.search)

    def _task(self, observation: Observation, around_others: bool) -> _Task:
        cars = observation["cars"]
        if around_others:
            cars = np.concatenate([cars, observation["movers"]])
        outlines, n_corners = _obstacles(cars, observation["lines"])
        self.require_map(observation)
        start, target = (
            self.vehicle.at_rear_axle(_pose(observation[goal])) for goal in ("achieved_goal", "desired_goal")
        )
        return self.vehicle, outlines, n_corners, start, target

    def _decide(self, observation: Observation, memory: ParkingMemory) -> NDArray[np.float32]:
        pose = self.vehicle.at_rear_axle(_pose(observation["achieved_goal"]))
        speed, steering = float(observation["observation"][4]), float(observation["observation"][5])
        tracker = memory.tracker
        waits = tracker is not None and "movers" in observation and self._waits(observation, memory, speed)
        if waits:
            memory.waited_s += _CONTROL_S
            if memory.waited_s < PATIENCE_S or abs(speed) >= _STANDS:
                return self._stop(speed, steering)
            memory.waited_s, memory.tracker, tracker = 0.0, None, None
        elif tracker is not None:
            memory.waited_s = 0.0
            command = tracker.command(pose, speed, steering)
            strayed = abs(tracker.offset) > STRAYED_M or abs(tracker.askew) > STRAYED_RAD
            if not (tracker.done or strayed):
                return np.array(command, dtype=np.float32)
            if abs(speed) >= _STANDS:
                return self._stop(speed, steering)
        if not memory.reason and len(memory.paths) < MOST_PLANS:
            began = time.perf_counter()
            path = self.plan(observation, around_others=waits)
            memory.planning_s.append(time.perf_counter() - began)
            if path is not None and len(path.length):
                memory.paths.append(path)
                memory.tracker = PathTracker(self.vehicle, path)
                return np.array(memory.tracker.command(pose, speed, steering), dtype=np.float32)
        if not waits and not memory.reason:
            of_plans = f"{MOST_PLANS} paths did not lead into the slot"
            few = len(memory.paths) < MOST_PLANS
            memory.reason = why_no_path(*self._task(observation, around_others=False)) if few else of_plans
        return np.zeros(2, dtype=np.float32)

    def _stop(self, speed: float, steering: float) -> NDArray[np.float32]:
        """Brake and keep the steering angle."""
        # Brake no harder than needed to stop within the step.
        pedal = min(abs(speed) / (self.vehicle.max_braking * _CONTROL_S), 1.0)
        return np.array(
            [-math.copysign(pedal, speed), steering / self.vehicle.max_steering], dtype=np.float32
        )

    def _waits(self, observation: Observation, memory: ParkingMemory, speed: float) -> bool:
        """Return whether a road user, at constant velocity, would come too close to the car on its path."""
        outlines = np.asarray(observation["movers"], dtype=np.float64)
        at = outlines.mean(axis=1)
        before, memory.others = memory.others, at
        velocity = np.zeros_like(at) if before is None else (at - before) / _CONTROL_S
        assert memory.tracker is not None
        return is_blocked(self.vehicle, memory.tracker.middle_ahead(speed), outlines, velocity)


def _pose(goal: NDArray[np.float32]) -> FloatArray:
    return np.array([float(goal[0]), float(goal[1]), math.atan2(float(goal[3]), float(goal[2]))])


def _obstacles(cars: NDArray[np.float32], lines: NDArray[np.float32]) -> tuple[FloatArray, NDArray[np.int64]]:
    """Return the outlines in the obstacle map, (n, k, 2) m, and their numbers of valid corners, (n,)."""
    cars = cars[cars[:, 0, 0] < _NOWHERE]
    lines = lines[lines[:, 0, 0] < _NOWHERE]
    outlines = np.concatenate([cars, np.repeat(lines, [1, cars.shape[1] - 1], axis=1)]).astype(np.float64)
    count = np.full(len(outlines), 2, dtype=np.int64)
    # Outlines with fewer corners repeat the last one.
    count[: len(cars)] = 1 + (np.abs(np.diff(cars, axis=1)) > 0.0).any(axis=2).sum(axis=1)
    return outlines, count
