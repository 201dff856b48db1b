"""Many drives of `parkenv/Drive-v1` at once, compiled: the training environment's engine.

Car, limits, tasks, goals and rewards are those of the environment. A contact is an outline of the obstacle map that
crosses the car's, where the environment asks pymunk; the map holds float32, so contacts begin at poses within a few
micrometres of those in pymunk. Trained models are tested in the environment itself.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import Float32Array, FloatArray, IntArray
from parkenv.compiled.jit import compiled
from parkenv.driving.parking_task import AREA, KINDS, ParkingTask
from parkenv.driving.vehicle import SPEED, YAW, VehicleParameters, advance
from parkenv.envs.drive import CONTROL_S, SUBSTEPS
from parkenv.envs.drive_goals import goal_error, goal_of
from parkenv.envs.drive_observation import MOST_CARS, MOST_LINES, obstacle_map
from planners.driving import policy_interface as interface
from planners.driving.policy_interface import Outlines, PolicyInterface

RUNNING, PARKED, CONTACT, LEFT_AREA = range(4)  # status of a drive

_MAX_OBSTACLES = MOST_CARS + MOST_LINES
_MAX_EDGES = 24 * MOST_CARS + MOST_LINES  # as many as the obstacle map holds


class _Drives(NamedTuple):
    """The drives of a batch, a row each; positions in the slots' frames."""

    state: FloatArray  # (n, 6) vehicle states
    time: FloatArray
    status: IntArray
    approach: FloatArray
    took: FloatArray
    desired: Float32Array  # (n, 7) goals
    about: FloatArray  # (n, 5) see `encode_observation`
    slot_yaw: FloatArray
    edges: FloatArray  # (n, e, 4), (n, o + 1) and (n, o, 3): obstacles as in `Outlines`
    first: IntArray
    circle: FloatArray
    n_obstacles: IntArray

    @classmethod
    def of(cls, n: int) -> Self:
        """Allocate n drives."""
        state, about, circle = np.zeros((n, 6)), np.zeros((n, 5)), np.zeros((n, _MAX_OBSTACLES, 3))
        status, obstacles = np.zeros(n, np.int64), np.zeros(n, np.int64)
        edges, first = np.zeros((n, _MAX_EDGES, 4)), np.zeros((n, _MAX_OBSTACLES + 1), np.int64)
        desired = np.zeros((n, 7), np.float32)
        time, approach, took, yaw = np.zeros((4, n))
        return cls(state, time, status, approach, took, desired, about, yaw, edges, first, circle, obstacles)


class _Car(NamedTuple):
    """The car: its limits; half its length and width; `PolicyInterface.body` and `pedals`; rear axle to middle, m."""

    limits: FloatArray
    half: FloatArray
    body: FloatArray
    pedals: FloatArray
    middle: float


class DriveBatch:
    """A batch of drives, each with its own task.

    Args:
        n: number of drives.
        vehicle: the car of all tasks; None for the default.

    Attributes:
        state: (n, 6) float64, vehicle states; x, y and yaw in each slot's frame.
        time: (n,) float64, time since the start, s.
        status: (n,) int64, `RUNNING`, `PARKED`, `CONTACT` or `LEFT_AREA`.
        approach: (n,) float64, s: 0.1 s × (distance / 10 m + angle / π), summed over the last decision (dense reward).
        took: (n,) float64, duration of the last decision, s, excluding the step that parked.
    """

    def __init__(self, n: int, vehicle: VehicleParameters | None = None) -> None:
        vehicle = vehicle or VehicleParameters()
        self.view = PolicyInterface(vehicle)
        self._drives = drives = _Drives.of(n)
        self.state, self.time, self.status = drives.state, drives.time, drives.status
        self.approach, self.took = drives.approach, drives.took
        view = self.view
        self._car = _Car(vehicle.limits, view.half, view.body, view.pedals, vehicle.middle)

    def get_state(self) -> Sequence[NDArray[Any]]:
        """Return the arrays of all drives, for `set_state`."""
        return self._drives

    def set_state(self, state: Sequence[NDArray[Any]]) -> None:
        """Continue from a state that `get_state` returned for as many drives."""
        for array, values in zip(self.get_state(), state, strict=True):
            array[...] = values

    def start(self, i: int, task: PreparedTask, pose: FloatArray | None = None) -> None:
        """Restart drive i with a task, at the task's start or at `pose`, (3,) of the rear axle, slot frame."""
        outlines, drives = task.outlines, self._drives
        drives.state[i], drives.desired[i], drives.about[i] = task.start, task.desired, task.about
        if pose is not None:
            drives.state[i, :3] = pose
        drives.slot_yaw[i] = task.slot_yaw
        drives.edges[i, : len(outlines.edges)] = outlines.edges
        drives.first[i, : len(outlines.first)] = outlines.first
        drives.circle[i, : len(outlines.circle)] = outlines.circle
        drives.n_obstacles[i] = len(outlines.circle)
        drives.time[i], drives.status[i] = 0.0, RUNNING

    def drive(self, actions: Float32Array) -> None:
        """Apply one decision, see `planners.driving.policy_interface`, to each running drive; (n, 2) float32."""
        _drive(np.ascontiguousarray(actions, dtype=np.float32), self._drives, self._car)

    def observation(self, rows: IntArray | None = None) -> dict[str, Float32Array]:
        """Observations of the drives.

        Args:
            rows: (k,) int64, indices of drives; None for all.

        Returns:
            observation (k, `OBSERVATION_SIZE`), see `planners.driving.policy_interface.encode_observation`;
                achieved_goal and desired_goal (k, 7); float32.
        """
        rows = np.arange(len(self.state)) if rows is None else rows
        seen = np.empty((len(rows), interface.OBSERVATION_SIZE), np.float32)
        achieved = np.empty((len(rows), 7), np.float32)
        _observe(rows, self._drives, self._car, seen, achieved)
        return {"observation": seen, "achieved_goal": achieved, "desired_goal": self._drives.desired[rows]}


class PreparedTask:
    """A task in the slot's frame, ready for a batch."""

    def __init__(self, task: ParkingTask) -> None:
        self.kind, self.slot_yaw = task.kind, float(task.slot[2])
        self.outlines = Outlines.of_map(*obstacle_map(task))
        self.start = task.start.copy()
        self.start[:2] = task.in_slot_frame(task.start[:2])
        self.start[2] -= self.slot_yaw
        self.desired = goal_of(task)
        self.about = np.array([*task.room, *(float(kind == task.kind) for kind in KINDS)])


@compiled(error_model="numpy")
def _drive(actions: Float32Array, drives: _Drives, car: _Car) -> None:
    achieved = np.empty(7, np.float32)
    status, approach, took = drives.status, drives.approach, drives.took
    for i in range(len(actions)):
        state = drives.state[i]
        approach[i] = took[i] = 0.0
        steering = min(max(float(actions[i, 1]), -1.0), 1.0)
        for _ in range(interface.ACTION_REPEAT):
            if status[i] != RUNNING:
                break
            pedal = interface.pedal_command(actions[i], state[SPEED], car.pedals)
            for _ in range(SUBSTEPS):
                advance(state, pedal, steering, car.limits)
                drives.time[i] += 0.5 * CONTROL_S
                if _touches(drives, i, car):
                    status[i] = CONTACT
                    break
            _achieved_goal(drives, i, car, achieved)
            distance, angle, success = goal_error(achieved, drives.desired[i], car.half)
            c, s = math.cos(drives.slot_yaw[i]), math.sin(drives.slot_yaw[i])
            east, north = c * achieved[0] - s * achieved[1], s * achieved[0] + c * achieved[1]
            if status[i] == RUNNING and max(abs(east), abs(north)) > AREA:
                status[i] = LEFT_AREA
            if status[i] == RUNNING and success > 0.5:
                status[i] = PARKED
            else:
                took[i] += CONTROL_S
                approach[i] += CONTROL_S * (distance / 10.0 + angle / math.pi)


@compiled(error_model="numpy")
def _observe(rows: IntArray, drives: _Drives, car: _Car, seen: Float32Array, achieved: Float32Array) -> None:
    for k in range(len(rows)):
        i = rows[k]
        _achieved_goal(drives, i, car, achieved[k])
        at = np.array([float(achieved[k, 0]), float(achieved[k, 1])])
        m = drives.n_obstacles[i]
        outlines = drives.edges[i], drives.first[i, : m + 1], drives.circle[i, :m]
        interface.encode_observation(at, drives.state[i], outlines, car.body, drives.about[i], seen[k])


@compiled(error_model="numpy")
def _achieved_goal(drives: _Drives, i: int, car: _Car, achieved: Float32Array) -> None:
    state = drives.state[i]
    c, s = math.cos(state[YAW]), math.sin(state[YAW])
    achieved[0], achieved[1] = state[0] + car.middle * c, state[1] + car.middle * s
    achieved[2], achieved[3], achieved[4] = c, s, state[SPEED]
    achieved[5], achieved[6] = drives.about[i, 0], drives.about[i, 1]


@compiled(error_model="numpy")
def _touches(drives: _Drives, i: int, car: _Car) -> bool:
    """Return whether an edge intersects the car's outline."""
    state, edges, circle = drives.state[i], drives.edges[i], drives.circle[i]
    c, s = math.cos(state[YAW]), math.sin(state[YAW])
    x, y = state[0] + car.middle * c, state[1] + car.middle * s
    own = math.hypot(car.half[0], car.half[1])
    for j in range(drives.n_obstacles[i]):
        dx, dy = circle[j, 0] - x, circle[j, 1] - y
        if dx * dx + dy * dy > (own + circle[j, 2]) ** 2:
            continue
        for k in range(drives.first[i, j], drives.first[i, j + 1]):
            px, py = edges[k, 0] - x, edges[k, 1] - y
            qx, qy = edges[k, 2] - x, edges[k, 3] - y
            if _crosses(c * px + s * py, c * py - s * px, c * qx + s * qy, c * qy - s * qx, car.half):
                return True
    return False


@compiled(error_model="numpy")
def _crosses(px: float, py: float, qx: float, qy: float, half: FloatArray) -> bool:
    """Return whether the edge from p to q, m, in the car-centred frame, intersects the box of half-size `half`."""
    if max(px, qx) < -half[0] or min(px, qx) > half[0] or max(py, qy) < -half[1] or min(py, qy) > half[1]:
        return False
    # If all corners of the box lie on one side of the edge's line, they do not intersect.
    ex, ey = qx - px, qy - py
    return bool(abs(ex * py - ey * px) <= abs(ex) * half[1] + abs(ey) * half[0])
