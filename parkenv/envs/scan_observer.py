"""Laser scans of a batch of searches, compiled."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from gymnasium.vector.utils import create_empty_array
from numba import get_num_threads
from numpy.typing import NDArray

from parkenv.compiled import numpy_streams
from parkenv.compiled.arrays import BoolArray, FloatArray, IntArray
from parkenv.compiled.jit import compiled
from parkenv.compiled.memory import address_of
from parkenv.compiled.threads import in_threads
from parkenv.engine.batch import Observer, Steps, advance
from parkenv.engine.records import ScenarioRecords, scenario_at, search_at
from parkenv.engine.sensor_sampler import SensorSampler, make_rig
from parkenv.engine.spaces import LATEST
from parkenv.envs.car_footprints import CarLibrary, Scratch, draw_car, put_car, remove_car
from parkenv.envs.scan_observation import SCANS, ScanHistory, goal_of, observe_scans, scans_space
from parkenv.envs.sensors import FARTHEST
from parkenv.errors import InputError
from parkenv.world.lot_scene import CARS_APART, slot_lot
from parkenv.world.occupancy.kernel import CURSOR, cursor_at, find_state, kernel, sojourn_number
from sim_sensors.laser.kernel import BEAMS_PER_DRAW, scan_all
from sim_sensors.laser.scanner import NOISE_TABLE_SIZE, LaserScanner, noise_table
from sim_sensors.rig import SensorRig

_WIDEST_CAR_M = 6.0
_SENSOR_WORDS = 2  # the rig's word for lasers in the seed of their noise
_NOTHING = -1  # instead of a sojourn: the slot has not been drawn


class Stops(NamedTuple):
    """Where and when each search measures.

    Attributes:
        count: (n,) int64, number of captures of the last step.
        pose: (n, captures, 3) float64, x, y in m and yaw in rad of the vehicle.
        time: (n, captures) float64, s since Monday 00:00.
    """

    count: IntArray  # type: ignore[assignment]  # hides tuple.count
    pose: FloatArray
    time: FloatArray


class Lanes(NamedTuple):
    """The lot as the car drives through it, and how often it measures.

    Attributes:
        xy: (n_vertices, 2) float64, m.
        yaw: (n_slots,) float64, rad, of the lane in front of each slot.
        neighbor: (n_vertices,) int64, a neighbour of each vertex.
        captures, every: as in `SensorSampler`.
        near_start, near: the slots whose cars may be in range near vertex v: `near[near_start[v]:near_start[v + 1]]`.
    """

    xy: FloatArray
    yaw: FloatArray
    neighbor: IntArray
    captures: int
    every: float
    near_start: IntArray
    near: IntArray


class Planes(NamedTuple):
    """The scan planes of all searches.

    Attributes:
        quads: obstacles with up to four corners, the same for all searches: `Cells` as a tuple.
        corners, x, y, radius: (n, ...), those arrays of each search's other obstacles.
        label, cell_start, frame: as in `Cells`, the same for all searches.
        k: number of corners.
        shown: (n, n_slots) int32, the sojourn in which each slot is drawn; `_NOTHING` before the first.
    """

    quads: Any
    corners: NDArray[np.float32]
    x: FloatArray
    y: FloatArray
    radius: NDArray[np.float32]
    label: NDArray[np.int32]
    cell_start: IntArray
    frame: FloatArray
    k: int
    shown: NDArray[np.int32]


class Laser(NamedTuple):
    """The laser and its pose on the vehicle: x, y in m and yaw in rad; see `LaserScanner`."""

    mount: tuple[float, float, float]
    heading: float
    beams: Any
    table: NDArray[np.float32]
    noise_sd: np.float32
    lost_below: np.float32
    max_range: np.float32


@kernel
def step_to_stops(
    address: int,
    lanes: Lanes,
    actions: IntArray,
    fresh: BoolArray,
    idle: BoolArray,
    limit: int,
    steps: Steps,
    stops: Stops,
    vertex: IntArray,
    time: NDArray[np.float32],
) -> None:
    """Step, and write vertex, time, and where the searches measure."""
    for e in range(len(actions)):
        if idle[e]:
            continue
        search = search_at(address, e)
        before, begun = search.vertex, search.time
        advance(search, e, actions[e], fresh[e], limit, steps)
        vertex[e], time[e, 0], time[e, 1] = search.vertex, search.time, search.time - search.arrival
        _write_stops(search, lanes, e, before, begun, stops)


@kernel
def _write_stops(search: Any, lanes: Lanes, e: int, before: int, begun: float, stops: Stops) -> None:
    """Write the captures of a step as `SensorSampler.sample_step` chooses them."""
    stops.count[e] = 0
    if search.parked:
        return
    here = search.vertex
    x, y = lanes.xy[here, 0], lanes.xy[here, 1]
    n = 1
    if before != here:
        from_x, from_y = lanes.xy[before, 0], lanes.xy[before, 1]
        way_x, way_y = x - from_x, y - from_y
        n = min(max(int(math.hypot(way_x, way_y) / lanes.every), 1), lanes.captures)
        yaw = math.atan2(way_y, way_x)
        for k in range(1, n):
            share = k / n
            stops.time[e, k - 1] = begun + share * (search.time - begun)
            stops.pose[e, k - 1, 0] = from_x + share * way_x
            stops.pose[e, k - 1, 1] = from_y + share * way_y
            stops.pose[e, k - 1, 2] = yaw
    stops.time[e, n - 1] = search.time
    stops.pose[e, n - 1, 0], stops.pose[e, n - 1, 1] = x, y
    if here < len(lanes.yaw):
        stops.pose[e, n - 1, 2] = lanes.yaw[here]
    else:
        start, end = search.previous_vertex, here
        if start == end:
            start, end = here, lanes.neighbor[here]
        way_x, way_y = lanes.xy[end, 0] - lanes.xy[start, 0], lanes.xy[end, 1] - lanes.xy[start, 1]
        stops.pose[e, n - 1, 2] = math.atan2(way_y, way_x)
    stops.count[e] = n


@compiled(error_model="numpy", nogil=True)
def scan_searches(
    first: int,
    end: int,
    address: int,
    cursors: int,
    fresh: BoolArray,
    idle: BoolArray,
    lanes: Lanes,
    library: CarLibrary,
    planes: Planes,
    laser: Laser,
    stops: Stops,
    pose: NDArray[np.float32],
    captured_at: NDArray[np.float32],
    scan: NDArray[np.float32],
) -> None:
    """Measure with the searches from `first` to `end` - 1, except idle ones."""
    n_slots, captures = planes.shown.shape[1], stops.time.shape[1]
    work = Scratch(np.zeros(8, np.uint32), np.zeros(4, np.uint32), np.zeros(5, np.uint64), np.zeros(3))
    sensor, nobody = np.empty((captures, 3)), np.full(captures, -1, np.int32)
    n_draws = (scan.shape[2] + BEAMS_PER_DRAW - 1) // BEAMS_PER_DRAW
    offsets, no_ids = np.empty((captures, n_draws, 2), np.int64), np.empty((0, scan.shape[2]), np.int32)
    for e in range(first, end):
        if idle[e]:
            continue
        search = search_at(address, e)
        scenario = scenario_at(search.scenario, 0)
        corners, x, y, radius = planes.corners[e], planes.x[e], planes.y[e], planes.radius[e]
        if fresh[e]:
            _forget_cars(cursors, library, planes, e)
        count, done = stops.count[e], 0
        scan[e, count:] = np.float32(0.0)
        pose[e, count:] = np.float32(0.0)
        captured_at[e, count:] = np.float32(0.0)
        others = (corners, x, y, radius, planes.label, planes.cell_start, planes.frame, planes.k)
        for capture in range(count):
            time = stops.time[e, capture]
            for i in range(lanes.near_start[search.vertex], lanes.near_start[search.vertex + 1]):
                slot = lanes.near[i]
                cursor = cursor_at(cursors, e * n_slots + slot)
                if time < cursor.valid_until:
                    continue
                taken = find_state(scenario.world_kind, search.world, search, slot, cursor, time)
                sojourn = sojourn_number(scenario.world_kind, search.world, slot, cursor, time)
                if sojourn == planes.shown[e, slot]:
                    continue
                if done < capture:
                    # The captures before saw the plane as it was.
                    _scan(
                        planes.quads, others, sensor, nobody, offsets, no_ids, laser, done, capture, scan[e]
                    )
                    done = capture
                planes.shown[e, slot] = sojourn
                remove_car(library, slot, x, y)
                if taken:
                    number = np.int64(search.key % np.uint64(CARS_APART)) + sojourn
                    model = draw_car(library, slot, number, work)
                    put_car(library, slot, model, work.car, corners, x, y, radius)
            at_x, at_y, yaw = stops.pose[e, capture, 0], stops.pose[e, capture, 1], stops.pose[e, capture, 2]
            cosine, sine = math.cos(yaw), math.sin(yaw)
            sensor[capture, 0] = at_x + cosine * laser.mount[0] - sine * laser.mount[1]
            sensor[capture, 1] = at_y + sine * laser.mount[0] + cosine * laser.mount[1]
            sensor[capture, 2] = yaw + laser.mount[2]
            _draw_noise(search.key, time, work, offsets[capture])
            pose[e, capture, 0], pose[e, capture, 1], pose[e, capture, 2] = at_x, at_y, yaw
            captured_at[e, capture] = time - search.arrival
        if done < count:
            _scan(planes.quads, others, sensor, nobody, offsets, no_ids, laser, done, count, scan[e])


@kernel
def forget_all_cars(cursors: int, library: CarLibrary, planes: Planes) -> None:
    """Remove the cars of all searches; the next scan draws those near again."""
    for e in range(planes.shown.shape[0]):
        _forget_cars(cursors, library, planes, e)


@kernel
def _forget_cars(cursors: int, library: CarLibrary, planes: Planes, e: int) -> None:
    """Remove the cars of a search."""
    n_slots = planes.shown.shape[1]
    for slot in range(n_slots):
        cursor = cursor_at(cursors, e * n_slots + slot)
        cursor.sojourn, cursor.valid_until = 0, 0.0
        planes.shown[e, slot] = _NOTHING
        remove_car(library, slot, planes.x[e], planes.y[e])


@compiled(error_model="numpy")
def _scan(quads, others, sensor, nobody, offsets, no_ids, laser, first, end, scan):  # type: ignore[no-untyped-def]
    """Write the scans of the captures from `first` to `end` - 1."""
    ranges = scan[first:end]
    scan_all(
        quads, others, sensor[first:end], laser.heading, nobody[first:end], laser.beams, laser.table,
        offsets[first:end], laser.noise_sd, laser.lost_below, ranges, no_ids,
    )  # fmt: skip
    for row in range(end - first):
        for beam in range(ranges.shape[1]):
            ranges[row, beam] = min(ranges[row, beam], laser.max_range)


@kernel
def _draw_noise(key: np.uint64, time: float, work: Any, offsets: IntArray) -> None:
    """Draw the places in the noise table, as sampler, rig and laser do for a capture."""
    n = numpy_streams.append_words(work.words, 0, key)
    n = numpy_streams.append_words(work.words, n, np.uint64(np.int64(time * 1000.0)))
    numpy_streams.fill_pool(work.words, n, work.pool)
    seed = numpy_streams.first_word(work.pool)
    n = numpy_streams.append_words(work.words, 0, np.uint64(seed))
    n = numpy_streams.append_words(work.words, n, np.uint64(_SENSOR_WORDS))
    n = numpy_streams.append_words(work.words, n, np.uint64(0))
    numpy_streams.fill_pool(work.words, n, work.pool)
    numpy_streams.start(work.pool, work.state)
    for draw in range(offsets.shape[0]):
        for use in range(2):
            offsets[draw, use] = numpy_streams.integer_below(work.state, NOISE_TABLE_SIZE)


class LaserObserver(Observer):
    """The observations of `parkenv/SearchSensors-v2` with `observation="scan"`.

    Args:
        tables: one scenario, without traffic.
        n: number of searches.
        rig, captures, every: as in `parkenv/SearchSensors-v2`; the rig needs one laser.

    Raises:
        InputError: several scenarios, traffic, or an argument out of its range.
    """

    def __init__(
        self,
        tables: ScenarioRecords,
        n: int,
        rig: str | SensorRig | None = None,
        captures: int = 4,
        every: float = 1.0,
    ) -> None:
        if len(tables.scenarios) != 1:
            raise InputError(
                f"there are {len(tables.scenarios)} scenarios, want one for searches that observe scans"
            )
        world = tables.scenarios[0]
        sensors = make_rig(rig, world)
        if len(sensors.lasers) != 1:
            raise InputError(f"the rig has {len(sensors.lasers)} lasers, want one")
        if world.traffic.cars or world.traffic.pedestrians:
            raise InputError(f"traffic is {world.traffic}, want none in a batch of scans")
        self.rig = sensors.only_lasers()
        sampler = SensorSampler(world, self.rig, None, captures, every)
        name, laser, mount = self.rig.lasers[0]
        k, lot = sampler.captures, world.lot
        space = {
            "vertex": spaces.Discrete(lot.n_vertices),
            "time": spaces.Box(0.0, LATEST, (2,), np.float32),
            "action_mask": spaces.Box(0, 1, (5,), np.int8),
            "count": spaces.Discrete(k + 1),
            "pose": spaces.Box(-FARTHEST, FARTHEST, (k, 3), np.float32),
            "captured_at": spaces.Box(0.0, LATEST, (k,), np.float32),
            f"scan.{name}": spaces.Box(0.0, laser.max_range, (k, laser.n_beams), np.float32),
        }
        super().__init__(tables, n, spaces.Dict(space))
        self._measured, self._scan = self.seen, self.seen[f"scan.{name}"]
        self._stops = Stops(self.seen["count"], np.zeros((n, k, 3)), np.zeros((n, k)))
        self._library, quads, others = CarLibrary.of(slot_lot(lot))
        self._lanes = _lanes_of(lot, k, float(every), laser.max_range)
        self._planes = Planes(
            tuple(quads),
            np.repeat(others.corners[None], n, axis=0),
            np.repeat(others.x[None], n, axis=0),
            np.repeat(others.y[None], n, axis=0),
            np.repeat(others.radius[None], n, axis=0),
            others.label,
            others.cell_start,
            others.frame,
            int(others.k),
            np.full((n, lot.n_slots), _NOTHING, np.int32),
        )
        self._cursors = np.zeros(n * lot.n_slots, CURSOR)
        planes = self._planes
        own = (planes.corners, planes.x, planes.y, planes.radius, planes.shown, self._cursors, *self._stops)
        self.n_bytes += sum(array.nbytes for array in own)
        self._laser = _laser_of(laser, (float(mount.x), float(mount.y), float(mount.yaw)))
        # Each thread has a share of the searches.
        ends: list[int] = np.linspace(0, n, min(get_num_threads(), n) + 1).astype(int).tolist()
        self._shares = list(pairwise(ends))

    def step(self, actions: IntArray, fresh: BoolArray, idle: BoolArray, limit: int, steps: Steps) -> None:
        """See `Observer`."""
        seen, cursors = self._measured, address_of(self._cursors, CURSOR)
        step_to_stops(
            self.address, self._lanes, actions, fresh, idle, limit, steps, self._stops, seen["vertex"], seen["time"]
        )  # fmt: skip

        def scan_part(part: tuple[int, int]) -> None:
            scan_searches(
                *part, self.address, cursors, fresh, idle, self._lanes, self._library, self._planes, self._laser,
                self._stops, seen["pose"], seen["captured_at"], self._scan,
            )  # fmt: skip

        in_threads(scan_part, self._shares)

    def set_state(self, state: tuple[NDArray[Any], ...]) -> None:
        """See `Observer`; cars follow from the worlds, so they are drawn again rather than kept."""
        super().set_state(state)
        forget_all_cars(address_of(self._cursors, CURSOR), self._library, self._planes)


class ScansObserver(LaserObserver):
    """The last k scans, as `parkenv.envs.scan_observation.ScanObservation` observes them: one for each decision.

    Args:
        tables, n: see `LaserObserver`.
        k: number of scans.

    Raises:
        InputError: see `LaserObserver`.
    """

    def __init__(self, tables: ScenarioRecords, n: int, k: int = SCANS) -> None:
        super().__init__(tables, n, captures=1)
        self._history, self._goal = ScanHistory.of(n, k), goal_of(tables.scenarios[0])
        self.space = scans_space(k)
        empty: Any = create_empty_array(self.space, n)
        self.seen = empty | {"action_mask": self._measured["action_mask"]}
        self.n_bytes += sum(array.nbytes for array in (self.seen["scan"], *self._history))

    def step(self, actions: IntArray, fresh: BoolArray, idle: BoolArray, limit: int, steps: Steps) -> None:
        """See `Observer`."""
        super().step(actions, fresh, idle, limit, steps)
        seen = self._measured
        observe_scans(
            self._scan, seen["pose"], seen["count"], seen["time"], self._goal, fresh, idle, self._history,
            self.seen["scan"],
        )  # fmt: skip

    def get_state(self) -> tuple[NDArray[Any], ...]:
        """See `Observer`."""
        return (*super().get_state(), *(array.copy() for array in self._history))

    def set_state(self, state: tuple[NDArray[Any], ...]) -> None:
        """See `Observer`."""
        own: tuple[NDArray[Any], ...] = self._history
        super().set_state(state[: -len(own)])
        for mine, saved in zip(own, state[-len(own) :], strict=True):
            mine[...] = saved


def _laser_of(laser: LaserScanner, mount: tuple[float, float, float]) -> Laser:
    beams, heading = laser.beams
    table, limits = noise_table(), (laser.noise_sd, laser.lost_below, laser.max_range)
    return Laser(mount, heading, beams, table, *(np.float32(value) for value in limits))


def _lanes_of(lot: Any, captures: int, every: float, max_range: float) -> Lanes:
    longest = float(lot.edge_length[lot.neighbors >= 0].max(initial=0.0))
    away = np.hypot(*(lot.vertex_xy[:, None] - lot.slot_xy[None]).transpose(2, 0, 1))
    vertex, slot = np.nonzero(away < max_range + longest + _WIDEST_CAR_M)
    first = np.argmax(lot.neighbors >= 0, axis=1)
    return Lanes(
        np.ascontiguousarray(lot.vertex_xy, dtype=np.float64),
        np.ascontiguousarray(lot.vertex_yaw[: lot.n_slots], dtype=np.float64),
        lot.neighbors[np.arange(lot.n_vertices), first].astype(np.int64),
        captures,
        every,
        np.searchsorted(vertex, np.arange(lot.n_vertices + 1)),
        slot,
    )
