"""Traffic in a lot: moving cars and pedestrians, and their poses at any time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from parkenv.errors import InputError
from parkenv.world.lot import ParkingLot

if TYPE_CHECKING:
    from sim_sensors.movers import Movers
    from sim_sensors.slot_scenes import SlotLot

FloatArray = NDArray[np.float64]

CAR_SPEEDS = (2.0, 4.0)  # range of car speeds, m/s
WALK_SPEEDS = (0.9, 1.5)  # range of walking speeds, m/s
STRIDE_M = 1.4  # length of a stride (two steps), m

_CARS, _PEOPLE = 0, 1
_STOPS = 3
_AXLE_M = 1.3  # from a car's middle to its axles, which follow its path
_STEP_M = 0.3
_EGO = np.array([2.4, 0.95])
_GAP = np.array([1.2, 0.4])
_HALF_CAR = np.array([2.3, 0.95])
_HALF_PERSON = np.array([0.35, 0.3])


@dataclass(frozen=True)
class Traffic:
    """Numbers of road users in a lot besides the searching car.

    Traffic does not occupy slots. In the search environments it blocks nothing and is only visible to the sensors. On
    driven trips and in `parkenv/Drive-v1`, the car and the road users yield to each other.

    Args:
        cars: number of cars that drive in loops along the lanes.
        pedestrians: number of pedestrians that walk between a slot and the goal and back.

    Raises:
        InputError: a number below 0.
    """

    cars: int = 0
    pedestrians: int = 0

    def __post_init__(self) -> None:
        for name in ("cars", "pedestrians"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 0:
                raise InputError(f"Traffic.{name} is {value!r}, want a whole number of at least 0")


class LotTraffic:
    """The traffic of one world: a pure function of (lot, key, time).

    Args:
        lot: defines the lanes.
        goal: index of the goal that pedestrians walk to.
        traffic: numbers of cars and pedestrians.
        key: key of the world.
        slots: scene data of the lot; provides the vehicle models.
    """

    def __init__(self, lot: ParkingLot, goal: int, traffic: Traffic, key: np.uint64, slots: SlotLot) -> None:
        self._routes = _Routes(lot, goal) if traffic.cars or traffic.pedestrians else None
        self._cars = [
            self._car(np.random.default_rng([int(key), _CARS, k]), slots) for k in range(traffic.cars)
        ]
        self._people = [
            self._person(np.random.default_rng([int(key), _PEOPLE, k])) for k in range(traffic.pedestrians)
        ]

    def at(self, time: float, ego: FloatArray | None = None) -> Movers | None:
        """Return the road users at a time.

        Args:
            time: s.
            ego: (3,) x, y in m and yaw in rad of the searching car. Road users in its way are hidden; all others
                ignore it, so that the world does not depend on the agent.

        Returns:
            The road users; None without traffic.
        """
        from sim_sensors.movers import LOOKS, Movers

        if self._routes is None:
            return None
        cars = np.array([loop.pose(time) for loop, _ in self._cars]).reshape(-1, 3)
        people = np.array([loop.pose(time) for loop, _ in self._people]).reshape(-1, 3)
        stride = np.array([loop.station(time) / STRIDE_M % 1.0 for loop, _ in self._people])
        model = np.array([number for _, number in self._cars], dtype=np.int64)
        look = np.array([number % LOOKS for _, number in self._people], dtype=np.int64)
        if ego is not None:
            clear, free = _clear_of(ego, cars, _HALF_CAR), _clear_of(ego, people, _HALF_PERSON)
            cars, model, people, stride, look = (
                cars[clear],
                model[clear],
                people[free],
                stride[free],
                look[free],
            )
        return Movers(cars, model, people, stride, look)

    def poses_at(self, times: FloatArray) -> FloatArray:
        """Return the poses of all road users, each at its own time, for traffic that waits.

        Args:
            times: (cars + pedestrians,) s, cars first.

        Returns:
            (cars + pedestrians, 3) x, y in m and yaw in rad.
        """
        loops = [loop for loop, _ in (*self._cars, *self._people)]
        poses = [loop.pose(time) for loop, time in zip(loops, np.asarray(times).tolist(), strict=True)]
        return np.array(poses).reshape(-1, 3)

    def _car(self, rng: np.random.Generator, slots: SlotLot) -> tuple[_Loop, int]:
        assert self._routes is not None
        path = self._routes.round_trip(rng)
        loop = _Loop(path, _AXLE_M, rng.uniform(*CAR_SPEEDS), 0.0, rng.random())
        slot = int(rng.integers(len(slots.fitting)))
        return loop, int(rng.choice(slots.fitting[slot]))

    def _person(self, rng: np.random.Generator) -> tuple[_Loop, int]:
        assert self._routes is not None
        path = self._routes.walk(rng)
        loop = _Loop(path, 0.5, rng.uniform(*WALK_SPEEDS), rng.uniform(-0.4, 0.9), rng.random())
        return loop, int(rng.integers(1 << 30))


class _Loop:
    """Motion along a closed path at constant speed.

    Args:
        path: (k, 2) m, corners; the last one connects to the first.
        reach: the heading is that of the chord from this far behind to this far ahead, m.
        speed: m/s.
        aside: lateral offset to the right of the path, m.
        start: position on the path at time 0, as a fraction of its length.
    """

    def __init__(self, path: FloatArray, reach: float, speed: float, aside: float, start: float) -> None:
        corners = np.concatenate([path, path[:1]])
        leg = np.hypot(*np.diff(corners, axis=0).T)
        corners = corners[np.r_[True, leg > 0.0]]
        self._corners = corners
        self._station = np.r_[0.0, np.cumsum(leg[leg > 0.0])]
        self._reach, self._speed, self._aside = reach, speed, aside
        self._start = start * self._station[-1]

    def station(self, time: float) -> float:
        """Station on the path, m."""
        return float((self._start + self._speed * time) % self._station[-1])

    def pose(self, time: float) -> FloatArray:
        """Pose, (3,) x, y in m and yaw in rad."""
        s = self.station(time)
        behind, ahead = self._point(s - self._reach), self._point(s + self._reach)
        chord = ahead - behind
        if np.hypot(*chord) < _STEP_M:  # it turns in place
            chord = self._point(s + 0.01) - self._point(s)
        yaw = np.arctan2(chord[1], chord[0])
        right = np.array([np.sin(yaw), -np.cos(yaw)])
        return np.array([*(0.5 * (behind + ahead) + self._aside * right), yaw])

    def _point(self, station: float) -> FloatArray:
        s = station % self._station[-1]
        return np.array([np.interp(s, self._station, self._corners[:, i]) for i in (0, 1)])


class _Routes:
    """Random routes over the drive graph of a lot."""

    def __init__(self, lot: ParkingLot, goal: int) -> None:
        self._lot = lot
        self._goal = lot.goals[goal]
        away = lot.vertex_xy - self._goal
        self._goal_vertex = int(np.hypot(away[:, 0], away[:, 1]).argmin())
        self._drive = lot.drive_matrix()

    def round_trip(self, rng: np.random.Generator) -> FloatArray:
        """Draw a drive past some slots and back to the first: corners, (k, 2) m."""
        stops = rng.choice(self._lot.n_slots, size=min(_STOPS, self._lot.n_slots), replace=False).tolist()
        legs = [self._shortest_path(a, b) for a, b in zip(stops, [*stops[1:], stops[0]], strict=True)]
        return np.concatenate(legs)

    def walk(self, rng: np.random.Generator) -> FloatArray:
        """Draw a walk from a slot to the goal and back: corners, (k, 2) m."""
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


def _clear_of(ego: FloatArray, pose: FloatArray, half: FloatArray) -> NDArray[np.bool_]:
    """Mask, (n,), of the rectangles that keep a distance of `_GAP` from the searching car."""
    offset = pose[:, :2] - ego[:2]
    c, s = np.cos(ego[2]), np.sin(ego[2])
    local = np.stack([c * offset[:, 0] + s * offset[:, 1], c * offset[:, 1] - s * offset[:, 0]], axis=1)
    turn = pose[:, 2] - ego[2]
    c, s = np.abs(np.cos(turn)), np.abs(np.sin(turn))
    extent = np.stack([c * half[0] + s * half[1], s * half[0] + c * half[1]], axis=1)
    return np.asarray((np.abs(local) > _EGO + _GAP + extent).any(axis=1))
