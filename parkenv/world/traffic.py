"""Traffic in a lot: moving cars and pedestrians, and their poses at any time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from parkenv.compiled.arrays import BoolArray, FloatArray
from parkenv.files.field_types import Validated, Whole
from parkenv.world.lot import ParkingLot

if TYPE_CHECKING:
    from sim_sensors.movers import Movers
    from sim_sensors.slot_scenes import SlotLot


CAR_SPEEDS = (2.0, 4.0)  # range of car speeds, m/s
WALK_SPEEDS = (0.9, 1.5)  # range of walking speeds, m/s
STRIDE_M = 1.4  # length of a stride (two steps), m

_CARS, _PEOPLE = 0, 1
_STOPS = 3
_AXLE_M = 1.3  # from a car's middle to its axles, which follow its path
_STEP_M = 0.3
_EGO = np.array([2.4, 0.95])
_GAP = np.array([1.2, 0.4])
HALF_CAR = np.array([2.3, 0.95])
HALF_PERSON = np.array([0.35, 0.3])


@dataclass(frozen=True)
class Traffic(Validated):
    """Numbers of road users in a lot besides the searching car.

    Traffic does not occupy slots. In the search environments it blocks nothing and is only visible to the sensors. On
    driven trips and in `parkenv/Drive-v1`, the car and the road users yield to each other.

    Args:
        cars: number of cars that drive in loops along the lanes.
        pedestrians: number of pedestrians that walk between a slot and the goal and back.

    Raises:
        InputError: a number below 0.
    """

    cars: Whole = 0
    pedestrians: Whole = 0


class LotTraffic:
    """The traffic of one world: a pure function of (lot, key, time). `slots` provides the vehicle models."""

    def __init__(self, lot: ParkingLot, goal: int, traffic: Traffic, key: np.uint64, slots: SlotLot) -> None:
        self._n_cars, self._n = traffic.cars, traffic.cars + traffic.pedestrians
        if self._n == 0:
            return
        routes = _Routes(lot, goal)
        cars, people = (
            [make(routes, np.random.default_rng([int(key), kind, k]), slots) for k in range(n)]
            for kind, make, n in ((_CARS, _car, traffic.cars), (_PEOPLE, _person, traffic.pedestrians))
        )
        self._loops = _Loops([loop for loop, _ in (*cars, *people)])
        self._models = np.array([number for _, number in cars], dtype=np.int64)
        self._looks = np.array([number for _, number in people], dtype=np.int64)

    def at(self, time: float, ego: FloatArray | None = None) -> Movers | None:
        """Return the road users at a time, s; None without traffic.

        Those in the way of the searching car at `ego`, (3,) x, y, yaw, are hidden; all others ignore it, so that the
        world does not depend on the agent.
        """
        if self._n == 0:
            return None
        every = self.movers_at(np.full(self._n, time))
        if ego is None:
            return every
        clear = clear_of(ego, every.vehicle_pose, HALF_CAR)
        return every.only(clear, clear_of(ego, every.walker_pose, HALF_PERSON))

    def movers_at(self, times: FloatArray) -> Movers:
        from sim_sensors.movers import LOOKS, Movers

        n, station = self._n_cars, self._loops.stations(times)
        poses = self._loops.poses(station)
        stride = station[n:] / STRIDE_M % 1.0
        return Movers(poses[:n], self._models, poses[n:], stride, self._looks % LOOKS)

    def poses_at(self, times: FloatArray) -> FloatArray:
        if self._n == 0:
            return np.empty((0, 3))
        return self._loops.poses(self._loops.stations(times))


class _Loop(NamedTuple):
    path: FloatArray  # (k, 2) m, corners; the last one connects to the first
    reach: float  # m; the heading is that of the chord from this far behind to this far ahead
    speed: float  # m/s
    aside: float  # m, lateral offset to the right of the path
    start: float  # position on the path at time 0, as a fraction of its length


class _Loops:
    """Several loops, a row each, padded to the longest."""

    def __init__(self, loops: list[_Loop]) -> None:
        corners, stations = zip(*(_measured(loop.path) for loop in loops), strict=True)
        widest = max(map(len, stations))
        # A point lies before the first corner whose station is beyond its own.
        self._station = np.stack([np.pad(s, (0, widest - len(s)), constant_values=np.inf) for s in stations])
        self._corners = np.stack([np.pad(c, ((0, widest - len(c)), (0, 0)), "edge") for c in corners])
        self._length = np.array([s[-1] for s in stations])
        self._last = np.array([len(s) - 1 for s in stations])
        self._row = np.arange(len(loops))
        self._reach, self._speed, self._aside, start = np.array([loop[1:] for loop in loops]).T
        self._start = start * self._length

    def stations(self, times: FloatArray) -> FloatArray:
        return (self._start + self._speed * times) % self._length  # type: ignore[no-any-return]

    def poses(self, station: FloatArray) -> FloatArray:
        """Poses, (n, 3) x, y in m and yaw in rad, at stations, (n,) m."""
        behind, ahead = self._points(station - self._reach), self._points(station + self._reach)
        chord = ahead - behind
        turning = np.hypot(chord[:, 0], chord[:, 1]) < _STEP_M  # in place
        if turning.any():
            chord[turning] = (self._points(station + 0.01) - self._points(station))[turning]
        yaw = np.arctan2(chord[:, 1], chord[:, 0])
        right = np.stack([np.sin(yaw), -np.cos(yaw)], axis=1)
        return np.column_stack([0.5 * (behind + ahead) + self._aside[:, None] * right, yaw])

    def _points(self, station: FloatArray) -> FloatArray:
        row, s = self._row, station % self._length
        i = np.minimum((self._station <= s[:, None]).sum(axis=1), self._last)
        start, end = self._corners[row, i - 1], self._corners[row, i]
        low, high = self._station[row, i - 1], self._station[row, i]
        return (end - start) / (high - low)[:, None] * (s - low)[:, None] + start  # type: ignore[no-any-return]


def _measured(path: FloatArray) -> tuple[FloatArray, FloatArray]:
    corners = np.concatenate([path, path[:1]])
    leg = np.hypot(*np.diff(corners, axis=0).T)
    if not leg.any():
        return corners[[0, 0]], np.array([0.0, 1.0])  # it stands
    return corners[np.r_[True, leg > 0.0]], np.r_[0.0, np.cumsum(leg[leg > 0.0])]


def _car(routes: _Routes, rng: np.random.Generator, slots: SlotLot) -> tuple[_Loop, int]:
    loop = _Loop(routes.round_trip(rng), _AXLE_M, rng.uniform(*CAR_SPEEDS), 0.0, rng.random())
    return loop, int(rng.choice(slots.fitting[int(rng.integers(len(slots.fitting)))]))


def _person(routes: _Routes, rng: np.random.Generator, _: SlotLot) -> tuple[_Loop, int]:
    loop = _Loop(routes.walk(rng), 0.5, rng.uniform(*WALK_SPEEDS), rng.uniform(-0.4, 0.9), rng.random())
    return loop, int(rng.integers(1 << 30))


class _Routes:
    def __init__(self, lot: ParkingLot, goal: int) -> None:
        self._lot = lot
        self._goal = lot.goals[goal]
        away = lot.vertex_xy - self._goal
        self._goal_vertex = int(np.hypot(away[:, 0], away[:, 1]).argmin())
        self._drive = lot.drive_matrix()

    def round_trip(self, rng: np.random.Generator) -> FloatArray:
        stops = rng.choice(self._lot.n_slots, size=min(_STOPS, self._lot.n_slots), replace=False).tolist()
        legs = [self._shortest_path(a, b) for a, b in zip(stops, [*stops[1:], stops[0]], strict=True)]
        path = np.concatenate(legs)
        return path if len(path) else np.asarray(self._lot.vertex_xy[stops[:1]])

    def walk(self, rng: np.random.Generator) -> FloatArray:
        slot = int(rng.integers(self._lot.n_slots))
        there = np.concatenate(
            [self._lot.mouth_xy()[[slot]], self._shortest_path(slot, self._goal_vertex), [self._goal]]
        )
        return np.concatenate([there, there[-2:0:-1]])

    def _shortest_path(self, start: int, end: int) -> FloatArray:
        """Vertices on the shortest path, (k, 2) m, without the last; empty where there is no path."""
        from scipy.sparse.csgraph import dijkstra

        _, before = dijkstra(self._drive, indices=[start], return_predecessors=True)
        vertices = []
        vertex = int(before[0, end]) if start != end else -1
        while vertex >= 0:
            vertices.append(vertex)
            vertex = int(before[0, vertex])
        return np.asarray(self._lot.vertex_xy[vertices[::-1]]).reshape(-1, 2)


def clear_of(ego: FloatArray, pose: FloatArray, half: FloatArray) -> BoolArray:
    offset = pose[:, :2] - ego[:2]
    c, s = np.cos(ego[2]), np.sin(ego[2])
    local = np.stack([c * offset[:, 0] + s * offset[:, 1], c * offset[:, 1] - s * offset[:, 0]], axis=1)
    turn = pose[:, 2] - ego[2]
    c, s = np.abs(np.cos(turn)), np.abs(np.sin(turn))
    extent = np.stack([c * half[0] + s * half[1], s * half[0] + c * half[1]], axis=1)
    return np.asarray((np.abs(local) > _EGO + _GAP + extent).any(axis=1))
