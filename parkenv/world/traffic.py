"""Other cars that drive about in the lot and people who walk there: where each of them is at a moment."""

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

CAR_SPEEDS = (2.0, 4.0)
"""m/s between which cars drive in a lot."""
WALK_SPEEDS = (0.9, 1.5)
"""m/s between which people walk."""
STRIDE_M = 1.4
"""Two steps."""

_CARS, _PEOPLE = 0, 1
_STOPS = 3
_AXLE_M = 1.3  # a car's axles are this far before and behind its middle, and run on its path
_STEP_M = 0.3
_EGO = np.array([2.4, 0.95])
_GAP = np.array([1.2, 0.4])
_HALF_CAR = np.array([2.3, 0.95])
_HALF_PERSON = np.array([0.35, 0.3])


@dataclass(frozen=True)
class Traffic:
    """How much moves in a lot besides the car that searches.

    It takes no slot. On the slot graph it blocks no way, and is there to be seen. Where the car really drives, on whole
    trips and in `parkenv/Drive-v1`, each waits for the other.

    Args:
        cars: how many drive about, along the lanes in rounds.
        pedestrians: how many walk between a slot and the goal and back.

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
        lot: whose lanes are driven and walked.
        goal: index of the goal that people walk to.
        traffic: how much there is.
        key: of the world.
        slots: whose vehicle models are driven.
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
        """Who is where.

        Args:
            time: s.
            ego: (3,) x, y, yaw of the searching car. Who would be in its way waits out of sight: everybody else
                drives as if it were not there, or the world would depend on the agent.

        Returns:
            None where nobody is about.
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
        """Where everybody is, each at a time of their own, as those need it who wait for somebody on their way.

        Args:
            times: (cars + pedestrians,) s, the cars first.

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
    """A closed way, gone round for ever.

    Args:
        path: (k, 2) m, its corners; the last one leads back to the first.
        reach: m; the heading is that of a chord from so far behind to so far ahead.
        speed: m/s.
        aside: m, to the right of the way.
        start: where on it, as a share, at time 0.
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
        """M gone since the start of the round."""
        return float((self._start + self._speed * time) % self._station[-1])

    def pose(self, time: float) -> FloatArray:
        """(3,) x, y in m, yaw in rad."""
        s = self.station(time)
        behind, ahead = self._point(s - self._reach), self._point(s + self._reach)
        chord = ahead - behind
        if np.hypot(*chord) < _STEP_M:  # it turns on the spot
            chord = self._point(s + 0.01) - self._point(s)
        yaw = np.arctan2(chord[1], chord[0])
        right = np.array([np.sin(yaw), -np.cos(yaw)])
        return np.array([*(0.5 * (behind + ahead) + self._aside * right), yaw])

    def _point(self, station: float) -> FloatArray:
        s = station % self._station[-1]
        return np.array([np.interp(s, self._station, self._corners[:, i]) for i in (0, 1)])


class _Routes:
    """Shortest ways over a lot's drive graph."""

    def __init__(self, lot: ParkingLot, goal: int) -> None:
        self._lot = lot
        self._goal = lot.goals[goal]
        away = lot.vertex_xy - self._goal
        self._goal_vertex = int(np.hypot(away[:, 0], away[:, 1]).argmin())
        self._drive = lot.drive_matrix()

    def round_trip(self, rng: np.random.Generator) -> FloatArray:
        """Corners, (k, 2) m, of a drive past some slots and back to the first."""
        stops = rng.choice(self._lot.n_slots, size=min(_STOPS, self._lot.n_slots), replace=False).tolist()
        legs = [self._way(a, b) for a, b in zip(stops, [*stops[1:], stops[0]], strict=True)]
        return np.concatenate(legs)

    def walk(self, rng: np.random.Generator) -> FloatArray:
        """Corners, (k, 2) m, of a walk from a slot to the goal and back."""
        slot = int(rng.integers(self._lot.n_slots))
        there = np.concatenate(
            [self._lot.mouth_xy()[[slot]], self._way(slot, self._goal_vertex), [self._goal]]
        )
        return np.concatenate([there, there[-2:0:-1]])

    def _way(self, start: int, end: int) -> FloatArray:
        """(k, 2) m, vertices from one to the other, the last left out; nothing where no way leads there."""
        from scipy.sparse.csgraph import dijkstra

        _, before = dijkstra(self._drive, indices=[start], return_predecessors=True)
        vertices = []
        vertex = int(before[0, end]) if start != end else -1
        while vertex >= 0:
            vertices.append(vertex)
            vertex = int(before[0, vertex])
        return np.asarray(self._lot.vertex_xy[vertices[::-1]]).reshape(-1, 2)


def _clear_of(ego: FloatArray, pose: FloatArray, half: FloatArray) -> NDArray[np.bool_]:
    """(n,) bool: which rectangles keep `_GAP` from the searching car."""
    offset = pose[:, :2] - ego[:2]
    c, s = np.cos(ego[2]), np.sin(ego[2])
    local = np.stack([c * offset[:, 0] + s * offset[:, 1], c * offset[:, 1] - s * offset[:, 0]], axis=1)
    turn = pose[:, 2] - ego[2]
    c, s = np.abs(np.cos(turn)), np.abs(np.sin(turn))
    extent = np.stack([c * half[0] + s * half[1], s * half[0] + c * half[1]], axis=1)
    return np.asarray((np.abs(local) > _EGO + _GAP + extent).any(axis=1))
