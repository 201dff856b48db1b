"""Many drives of `parkenv/Drive-v1` at once, compiled: the training environment's engine.

Car, limits, tasks, goals and rewards are those of the environment. A contact is an outline that crosses the car's,
not a collision in pymunk, so grazing contacts may differ. Trained models are tested in the environment itself.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from parkenv.driving.parking_task import AREA, KINDS, ParkingTask
from parkenv.driving.vehicle import SPEED, YAW, VehicleParameters, advance
from parkenv.envs.drive import CONTROL_S, SUBSTEPS
from parkenv.envs.drive_goals import goal_error
from parkenv.envs.drive_observation import MOST_CARS, MOST_LINES, obstacle_map
from planners.driving.policy_interface import (
    ACTION_REPEAT,
    OBSERVATION_SIZE,
    Outlines,
    PolicyInterface,
    encode_observation,
    pedal_command,
)
from sim_sensors.compilation import compiled

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]
IntArray = NDArray[np.int64]

RUNNING, PARKED, CONTACT, LEFT_AREA = range(4)
"""Status of a drive."""

_MAX_OBSTACLES = MOST_CARS + MOST_LINES
_MAX_EDGES = 24 * MOST_CARS + MOST_LINES  # as many as the obstacle map holds


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
        self.state = np.zeros((n, 6))
        self.time, self.approach, self.took = np.zeros(n), np.zeros(n), np.zeros(n)
        self.status = np.zeros(n, dtype=np.int64)
        self._desired = np.zeros((n, 7), dtype=np.float32)
        self._about = np.zeros((n, 5))
        self._slot_yaw = np.zeros(n)
        self._edges = np.zeros((n, _MAX_EDGES, 4))
        self._first = np.zeros((n, _MAX_OBSTACLES + 1), dtype=np.int64)
        self._circle = np.zeros((n, _MAX_OBSTACLES, 3))
        self._obstacles = np.zeros(n, dtype=np.int64)
        self._limits, self._half, self._body = vehicle.limits, self.view.half, self.view.body

    def start(self, i: int, task: PreparedTask, pose: FloatArray | None = None) -> None:
        """Restart drive i with a task, at the task's start or at `pose`, (3,) of the rear axle, slot frame."""
        outlines = task.outlines
        self.state[i], self._desired[i], self._about[i] = task.start, task.desired, task.about
        if pose is not None:
            self.state[i, :3] = pose
        self._slot_yaw[i] = task.slot_yaw
        self._edges[i, : len(outlines.edges)] = outlines.edges
        self._first[i, : len(outlines.first)] = outlines.first
        self._circle[i, : len(outlines.circle)] = outlines.circle
        self._obstacles[i] = len(outlines.circle)
        self.time[i], self.status[i] = 0.0, RUNNING

    def drive(self, actions: Float32Array) -> None:
        """Apply one decision to each running drive.

        Args:
            actions: (n, 2) float32; see `planners.driving.policy_interface`.
        """
        _drive(
            np.ascontiguousarray(actions, dtype=np.float32),
            self.state, self.time, self.status, self.approach, self.took,
            self._desired, self._about, self._slot_yaw, self._edges, self._first, self._circle, self._obstacles,
            self._limits, self._half, self.view.pedals, self.view.vehicle.middle,
        )  # fmt: skip

    def observation(self, rows: IntArray | None = None) -> dict[str, Float32Array]:
        """Observations of the drives.

        Args:
            rows: (k,) int64, indices of drives; None for all.

        Returns:
            observation (k, `OBSERVATION_SIZE`), see `planners.driving.policy_interface.encode_observation`;
                achieved_goal and desired_goal (k, 7); float32.
        """
        rows = np.arange(len(self.state)) if rows is None else rows
        seen, achieved = (
            np.empty((len(rows), OBSERVATION_SIZE), np.float32),
            np.empty((len(rows), 7), np.float32),
        )
        _observe(
            rows, self.state, self._about, self._edges, self._first, self._circle, self._obstacles, self._body,
            self.view.vehicle.middle, seen, achieved,
        )  # fmt: skip
        return {"observation": seen, "achieved_goal": achieved, "desired_goal": self._desired[rows]}


class PreparedTask:
    """A task in the slot's frame, ready for a batch."""

    def __init__(self, task: ParkingTask) -> None:
        self.kind, self.slot_yaw = task.kind, float(task.slot[2])
        self.outlines = Outlines.of_map(*obstacle_map(task))
        self.start = task.start.copy()
        self.start[:2] = task.in_slot_frame(task.start[:2])
        self.start[2] -= self.slot_yaw
        turned = float(task.target[2]) - self.slot_yaw
        self.desired = np.array(
            [0.0, 0.0, round(math.cos(turned), 9), round(math.sin(turned), 9), 0.0, *task.room],
            dtype=np.float32,
        )
        self.about = np.array([*task.room, *(float(kind == task.kind) for kind in KINDS)])


@compiled(error_model="numpy")
def _drive(
    actions: Float32Array,
    states: FloatArray,
    time: FloatArray,
    status: IntArray,
    approach: FloatArray,
    took: FloatArray,
    desired: Float32Array,
    about: FloatArray,
    slot_yaw: FloatArray,
    edges: FloatArray,
    first: IntArray,
    circle: FloatArray,
    obstacles: IntArray,
    limits: FloatArray,
    half: FloatArray,
    pedals: FloatArray,
    middle: float,
) -> None:
    achieved = np.empty(7, np.float32)
    for i in range(len(states)):
        state = states[i]
        approach[i] = took[i] = 0.0
        steering = min(max(float(actions[i, 1]), -1.0), 1.0)
        for _ in range(ACTION_REPEAT):
            if status[i] != RUNNING:
                break
            pedal = pedal_command(actions[i], state[SPEED], pedals)
            for _ in range(SUBSTEPS):
                advance(state, pedal, steering, limits)
                time[i] += 0.5 * CONTROL_S
                if _touches(state, edges[i], first[i], circle[i], obstacles[i], half, middle):
                    status[i] = CONTACT
                    break
            _achieved_goal(state, about[i], middle, achieved)
            distance, angle, success = goal_error(achieved, desired[i], half)
            c, s = math.cos(slot_yaw[i]), math.sin(slot_yaw[i])
            east, north = c * achieved[0] - s * achieved[1], s * achieved[0] + c * achieved[1]
            if status[i] == RUNNING and max(abs(east), abs(north)) > AREA:
                status[i] = LEFT_AREA
            if status[i] == RUNNING and success > 0.5:
                status[i] = PARKED
            else:
                took[i] += CONTROL_S
                approach[i] += CONTROL_S * (distance / 10.0 + angle / math.pi)


@compiled(error_model="numpy")
def _observe(
    rows: IntArray,
    states: FloatArray,
    about: FloatArray,
    edges: FloatArray,
    first: IntArray,
    circle: FloatArray,
    obstacles: IntArray,
    body: FloatArray,
    middle: float,
    seen: Float32Array,
    achieved: Float32Array,
) -> None:
    for k in range(len(rows)):
        i = rows[k]
        _achieved_goal(states[i], about[i], middle, achieved[k])
        at = np.array([float(achieved[k, 0]), float(achieved[k, 1])])
        m = obstacles[i]
        encode_observation(
            at, states[i], (edges[i], first[i, : m + 1], circle[i, :m]), body, about[i], seen[k]
        )


@compiled(error_model="numpy")
def _achieved_goal(state: FloatArray, about: FloatArray, middle: float, achieved: Float32Array) -> None:
    c, s = math.cos(state[YAW]), math.sin(state[YAW])
    achieved[0], achieved[1] = state[0] + middle * c, state[1] + middle * s
    achieved[2], achieved[3], achieved[4] = c, s, state[SPEED]
    achieved[5], achieved[6] = about[0], about[1]


@compiled(error_model="numpy")
def _touches(
    state: FloatArray,
    edges: FloatArray,
    first: IntArray,
    circle: FloatArray,
    obstacles: int,
    half: FloatArray,
    middle: float,
) -> bool:
    """Return whether an edge intersects the car's outline."""
    c, s = math.cos(state[YAW]), math.sin(state[YAW])
    x, y = state[0] + middle * c, state[1] + middle * s
    own = math.hypot(half[0], half[1])
    for i in range(obstacles):
        dx, dy = circle[i, 0] - x, circle[i, 1] - y
        if dx * dx + dy * dy > (own + circle[i, 2]) ** 2:
            continue
        for k in range(first[i], first[i + 1]):
            px, py = edges[k, 0] - x, edges[k, 1] - y
            qx, qy = edges[k, 2] - x, edges[k, 3] - y
            if _crosses(c * px + s * py, c * py - s * px, c * qx + s * qy, c * qy - s * qx, half):
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
