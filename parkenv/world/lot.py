"""The parking lot: slots, lanes, entries, goals and walls, and the drive graph derived from them."""

from __future__ import annotations

import copy
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from enum import IntEnum
from typing import TYPE_CHECKING, Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.errors import InputError, nearest, require_number
from parkenv.files.field_types import Flag, Number, Validated
from parkenv.files.file_names import is_plain
from parkenv.world.drive_graph import NODE_TOLERANCE, GraphError, GraphProblem, build_drive_graph
from parkenv.world.facility import NOMINAL_SLOT, Facility, facility_problem, nominal_slots
from parkenv.world.tariff import NO_ZONE, PUBLIC, Zone

if TYPE_CHECKING:
    from scipy.sparse import csr_array


MOVES = ("up", "down", "left", "right")
"""The names of the four columns of `ParkingLot.neighbors`, in order (eq. 3.13)."""
PARK = len(MOVES)  # the action "park" (eq. 3.14); lower actions are the moves.
ACTIONS = (*MOVES, "park")
FARTHEST = 1e8  # largest coordinate, m: enough for any map grid, and small enough for millimetres in float64
SLOT_SIDE = 0.1  # least length and width of a slot, m


class Mouth(IntEnum):
    """The side by which a slot is entered, relative to a car parked nose-in along the slot's yaw."""

    REAR = 0  # perpendicular and angled slots
    LEFT = 1  # kerbside slots to the right of their lane
    RIGHT = 2  # kerbside slots to the left of their lane


class _ByValue:
    """What equals another one of its class if all fields do, arrays among them."""

    def __eq__(self, other: object) -> bool:
        if type(other) is not type(self):
            return NotImplemented
        names = [f.name for f in fields(self)]  # type: ignore[arg-type]
        return all(_same(getattr(self, name), getattr(other, name)) for name in names)

    __hash__ = None  # type: ignore[assignment]


@dataclass(frozen=True, eq=False)
class Lane(Validated, _ByValue):
    """A drivable centre line.

    Args:
        points: (k, 2) float64, m, lot frame, k ≥ 2. Lanes are connected where they share a point.
        oneway: whether cars may drive only in the order of the points; otherwise they keep to their side.
        speed: how fast cars drive there, as a multiple of the scenario's driving speed.

    Raises:
        InputError: a wrong shape, a value that is not finite, or two equal consecutive points; a speed that is not
            from 0.05 to 20.
    """

    points: FloatArray
    oneway: bool = False
    speed: Annotated[Number, Field(ge=0.05, le=20.0)] = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        points = _frozen(self.points, "points")
        if points.ndim != 2 or points.shape[1] != 2 or len(points) < 2:
            raise InputError(f"lane points: shape {points.shape}, want (at least 2, 2)")
        _require_finite("lane points", points)
        step = np.diff(points, axis=0)
        short = np.flatnonzero(np.hypot(step[:, 0], step[:, 1]) <= NODE_TOLERANCE)
        if len(short):
            raise InputError(f"lane points[{short[0]}] and [{short[0] + 1}] are equal, want different points")
        object.__setattr__(self, "points", points)


@dataclass(frozen=True, eq=False)
class Turn(Validated, _ByValue):
    """A turn restriction: a turn at a junction that is prohibited, or mandatory.

    Args:
        points: (3, 2) float64, m, lot frame: a point on the lane by which cars come, the junction, and a point on the
            lane by which they leave; the first and the last one are the same where cars turn back.
        only: whether the turn is mandatory: all others from its lane are prohibited.
    """

    points: FloatArray
    only: Flag = False

    def __post_init__(self) -> None:
        super().__post_init__()
        points = _frozen(self.points, "points")
        if points.shape != (3, 2):
            raise InputError(f"turn points: shape {points.shape}, want (3, 2)")
        _require_finite("turn points", points)
        object.__setattr__(self, "points", points)


@dataclass(frozen=True, eq=False, repr=False)
class ParkingLot(_ByValue):
    """A parking lot: slots, lanes, entries, goals and walls, and the drive graph between slots.

    Units are metres in a local frame, x east and y north; yaw is counter-clockwise from x, in radians. The drive
    graph is derived from slots, lanes and entries on construction, so two lots with equal features have equal
    graphs. Vertex `i < n_slots` is the stop position on the lane before slot `i`, the planning state of the thesis
    (T §3.4.1, Fig. 3.6 right); further vertices are junctions and lane ends, and in a junction one more for each lane
    with restricted turns. `parkenv.lots` reads, writes and
    generates lots.

    Args:
        name: for tables and pictures.
        slot_ids: n_slots unique ids.
        slot_xy: (n_slots, 2) float64, m, centres.
        slot_yaw: (n_slots,) float64, rad, heading of a car parked nose-in.
        slot_length: (n_slots,) float64, m, along the yaw.
        slot_width: (n_slots,) float64, m.
        slot_mouth: (n_slots,) int8, a `Mouth` each: the side towards the lane.
        lanes: centre lines.
        entries: (n_entries, 2) float64, m, where cars enter; each must be within 15 m of a lane.
        goals: (n_goals, 2) float64, m, walking destinations; anywhere.
        walls: polylines, (k, 2) m each; they block the view, not pedestrians.
        slot_parking_cost_s: (n_slots,) float64, s, at least 0: cost of parking in each slot, as time. A price is
            converted by the value of time: 2 € at 12 € per hour are 600 s. Empty: all 0.
        slot_zone: (n_slots,) str, tariff zone of each slot; empty text: that of its facility, or none. Empty: none has
            one.
        slot_facility: (n_slots,) str, facility of each slot; empty text: none. Empty: none has one.
        facilities: kerbs, car parks and garages. A counted one is the slot of its name: the last slots are the counted
            facilities in their order, and are appended where they are missing.
        zone_rules: rules of zones, by name; empty: zones have none, and prices come from the scenario alone.
        goal_weights: how much demand each goal attracts, (n_goals,) float64 by purpose of the drivers; empty: unknown.
        entry_weights: how much demand comes from each entry, (n_entries,) float64 by purpose; empty: unknown.
        turns: turn restrictions at junctions, prohibited or mandatory turns.
        left_hand: whether cars keep to the left of two-way lanes, not to the right.

    Attributes:
        vertex_xy: (n_vertices, 2) float64, m.
        vertex_yaw: (n_vertices,) float64, rad, the direction of travel at a slot's vertex.
        neighbors: (n_vertices, 4) int32, the vertex reached by up, down, left, right; -1 where there is none.
        edge_length: (n_vertices, 4) float64, m; 0 where there is no edge.
        edge_speed: (n_vertices, 4) float64, `speed` of the edge's lane; 1 where there is no edge.
        entry_vertices: (n_entries,) int64, the vertex of each entry.
        zones: names of the zones, sorted; `NO_ZONE` stands for slots without one.
        zone_of_slot: (n_slots,) int64, index into `zones`.
        facility_of_slot: (n_slots,) int64, index into `facilities`; -1: none.
        capacity: (n_slots,) int64, number of cars that fit: 1, but for counted facilities.
        classes: classes of users that the rules name, `public` first.

    Raises:
        InputError: a wrong shape, a value that is not finite, a repeated id, no slot, entry or goal, a name of a
            facility or zone that the lot does not have.
        GraphError: slots, entries or facilities out of reach of all lanes, more than four lanes out of one junction, a
            turn restriction of lanes that do not exist or without any turn left, or a counted facility that no entry
            leads to.

    Examples:
        >>> from parkenv.lots import packaged_lot
        >>> lot = packaged_lot("mini")
        >>> lot.n_slots
        10
        >>> lot.neighbors.shape == (lot.n_vertices, 4)
        True
    """

    name: str
    slot_ids: tuple[str, ...]
    slot_xy: FloatArray
    slot_yaw: FloatArray
    slot_length: FloatArray
    slot_width: FloatArray
    slot_mouth: NDArray[np.int8]
    lanes: tuple[Lane, ...]
    entries: FloatArray
    goals: FloatArray
    walls: tuple[FloatArray, ...] = ()
    slot_parking_cost_s: FloatArray = field(default_factory=lambda: np.zeros(0))
    slot_zone: NDArray[np.str_] = field(default_factory=lambda: np.zeros(0, np.str_))
    slot_facility: NDArray[np.str_] = field(default_factory=lambda: np.zeros(0, np.str_))
    facilities: tuple[Facility, ...] = ()
    zone_rules: Mapping[str, Zone] = field(default_factory=dict)
    goal_weights: Mapping[str, FloatArray] = field(default_factory=dict)
    entry_weights: Mapping[str, FloatArray] = field(default_factory=dict)
    turns: tuple[Turn, ...] = ()
    left_hand: bool = False

    vertex_xy: FloatArray = field(init=False)
    vertex_yaw: FloatArray = field(init=False)
    neighbors: NDArray[np.int32] = field(init=False)
    edge_length: FloatArray = field(init=False)
    edge_speed: FloatArray = field(init=False)
    entry_vertices: NDArray[np.int64] = field(init=False)
    zones: tuple[str, ...] = field(init=False)
    zone_of_slot: NDArray[np.int64] = field(init=False)
    facility_of_slot: NDArray[np.int64] = field(init=False)
    capacity: NDArray[np.int64] = field(init=False)
    classes: tuple[str, ...] = field(init=False)

    def __post_init__(self) -> None:
        for name in ("slot_ids", "lanes", "turns", "facilities"):
            self._set(name, tuple(getattr(self, name)))
        self._set_counted()
        self._require_names()
        n = len(self.slot_ids)
        if np.size(self.slot_parking_cost_s) == 0:
            self._set("slot_parking_cost_s", np.zeros(n))
        self._set_facilities()
        self._set_zones()
        for name, shape in (
            ("slot_xy", (n, 2)),
            ("slot_yaw", (n,)),
            ("slot_length", (n,)),
            ("slot_width", (n,)),
            ("slot_parking_cost_s", (n,)),
            ("entries", (len(self.entries), 2)),
            ("goals", (len(self.goals), 2)),
        ):
            values = _frozen(getattr(self, name), name)
            if values.shape != shape:
                raise InputError(f"lot {self.name!r}: {name} has shape {values.shape}, want {shape}")
            _require_finite(f"lot {self.name!r}: {name}", values)
            self._set(name, values)
        for name, least in (
            ("slot_length", SLOT_SIDE),
            ("slot_width", SLOT_SIDE),
            ("slot_parking_cost_s", 0.0),
        ):
            if (value := getattr(self, name).min()) < least:
                raise InputError(f"lot {self.name!r}: {name} {value:g}, want at least {least:g}")
        mouth = np.array(self.slot_mouth, dtype=np.int8)
        if mouth.shape != (n,) or not np.isin(mouth, list(Mouth)).all():
            raise InputError(f"lot {self.name!r}: slot_mouth must hold {n} values of {list(map(int, Mouth))}")
        mouth.flags.writeable = False
        self._set("slot_mouth", mouth)
        self._set_walls()
        for kind, features in (("lane", self.lanes), ("entry", self.entries), ("goal", self.goals)):
            if len(features) == 0:
                raise InputError(f"lot {self.name!r} has no {kind}")

        graph = build_drive_graph(
            [(lane.points, lane.oneway, lane.speed) for lane in self.lanes],
            self.mouth_xy(),
            self.entries,
            [(turn.points, turn.only) for turn in self.turns],
            self.side,
        )
        for name in ("vertex_xy", "vertex_yaw", "neighbors", "edge_length", "edge_speed", "entry_vertices"):
            values = getattr(graph, name)
            values.flags.writeable = False
            self._set(name, values)
        self._require_reachable()
        for name, points in (("goal_weights", self.goals), ("entry_weights", self.entries)):
            self._set(name, self._weights(name, len(points)))

    def _set(self, name: str, value: object) -> None:
        object.__setattr__(self, name, value)

    def _set_walls(self) -> None:
        walls = tuple(_frozen(wall, "walls") for wall in self.walls)
        for wall in walls:
            if wall.ndim != 2 or wall.shape[1] != 2 or len(wall) < 2:
                raise InputError(f"lot {self.name!r}: a wall has shape {wall.shape}, want (at least 2, 2)")
            _require_finite(f"lot {self.name!r}: walls", wall)
        self._set("walls", walls)

    def _set_counted(self) -> None:
        """Append the slots of counted facilities that are missing, and place all of them beside their lanes."""
        counted = [facility for facility in self.facilities if facility.is_counted]
        if not counted:
            return
        names, n = tuple(facility.name for facility in counted), len(self.slot_ids)
        there = self.slot_ids[max(n - len(names), 0) :] == names
        drawn = n - len(names) if there else n
        xy, yaw = (
            nominal_slots(self.facilities, [lane.points for lane in self.lanes])
            if self.lanes
            else (np.zeros((len(counted), 2)), np.zeros(len(counted)))
        )
        self._set("slot_ids", self.slot_ids[:drawn] + names)
        for name, values in (
            ("slot_xy", xy),
            ("slot_yaw", yaw),
            ("slot_length", np.full(len(names), NOMINAL_SLOT[0])),
            ("slot_width", np.full(len(names), NOMINAL_SLOT[1])),
            ("slot_mouth", np.full(len(names), Mouth.REAR)),
            ("slot_parking_cost_s", np.zeros(len(names))),
            ("slot_zone", np.array([facility.zone for facility in counted], np.str_)),
            ("slot_facility", np.array(names, np.str_)),
        ):
            column = np.asarray(getattr(self, name))
            if column.size == 0 and drawn:
                column = np.zeros(drawn, values.dtype)
            if len(column) not in (drawn, n):
                raise InputError(f"lot {self.name!r}: {name} has {len(column)} values, want {n}")
            self._set(name, np.concatenate([column[:drawn].reshape(-1, *values.shape[1:]), values]))

    def _set_facilities(self) -> None:
        n, what = len(self.slot_ids), f"lot {self.name!r}"
        names = [facility.name for facility in self.facilities]
        order = {name: i for i, name in enumerate(names)}
        if len(order) < len(names):
            repeated = next(name for i, name in enumerate(names) if name in names[:i])
            raise InputError(f"{what}: facility {repeated!r:.40} appears twice")
        given = np.array(self.slot_facility if np.size(self.slot_facility) else [""] * n, dtype=np.str_)
        if given.shape != (n,):
            raise InputError(f"{what}: slot_facility has shape {given.shape}, want ({n},)")
        for name in set(given.tolist()) - {"", *names}:
            raise InputError(f"{what} has no facility {name!r:.40}; {nearest(name, names)}")
        index = np.array([order.get(name, -1) for name in given.tolist()], np.int64)
        capacity = np.ones(n, np.int64)
        n_slots = np.bincount(index[index >= 0], minlength=len(names))
        for i, facility in enumerate(self.facilities):
            if n_slots[i] == 0:
                raise InputError(f"{what}: facility {facility.name!r:.40} has neither a capacity nor slots")
            if facility.is_counted and n_slots[i] > 1:
                raise InputError(
                    f"{what}: facility {facility.name!r:.40} has a capacity, want no slots that name it"
                )
            if facility.is_counted:
                capacity[index == i] = facility.capacity
        for name, values in (("slot_facility", given), ("facility_of_slot", index), ("capacity", capacity)):
            values.flags.writeable = False
            self._set(name, values)

    def _require_reachable(self) -> None:
        counted = np.flatnonzero(self.is_counted)
        if not len(counted):
            return
        from scipy.sparse.csgraph import dijkstra

        reached = np.isfinite(dijkstra(self.drive_matrix(), indices=self.entry_vertices, min_only=True))
        lost = self.facility_of_slot[counted[~reached[counted]]].tolist()
        if lost:
            reason = "cannot be reached from an entry"
            raise GraphError([facility_problem(self.facilities[i], i, reason) for i in lost])

    def _weights(self, name: str, count: int) -> dict[str, FloatArray]:
        weights = {}
        for purpose, given in getattr(self, name).items():
            what = f"lot {self.name!r}: {name}[{purpose!r:.40}]"
            weights[purpose] = values = _frozen(given, what)
            if values.shape != (count,):
                raise InputError(f"{what} has shape {values.shape}, want ({count},)")
            for value in values.tolist():
                require_number(what, value, least=0.0)
        return weights

    def _set_zones(self) -> None:
        n = len(self.slot_ids)
        zone = np.array(self.slot_zone if np.size(self.slot_zone) else [""] * n, dtype=np.str_)
        if zone.shape != (n,):
            raise InputError(f"lot {self.name!r}: slot_zone has shape {zone.shape}, want ({n},)")
        if self.facilities:
            # One more for the index -1.
            inherited = np.array([*(facility.zone for facility in self.facilities), ""])
            zone = np.where(zone == "", inherited[self.facility_of_slot], zone)
        zone.flags.writeable = False
        self._set("slot_zone", zone)
        self._set("zones", tuple(sorted({name or NO_ZONE for name in zone.tolist()})))
        order = {name: i for i, name in enumerate(self.zones)}
        zone_of_slot = np.array([order[name or NO_ZONE] for name in zone.tolist()], np.int64)
        zone_of_slot.flags.writeable = False
        self._set("zone_of_slot", zone_of_slot)
        for name in self.zones:
            if not is_plain(name):
                raise InputError(f"lot {self.name!r}: zone {name!a:.60} has control characters")
            if self.zone_rules and name != NO_ZONE and name not in self.zone_rules:
                raise InputError(
                    f"lot {self.name!r} has no rules of zone {name!r:.40}; {nearest(name, self.zone_rules)}"
                )
        self._set("zone_rules", dict(self.zone_rules))
        for name, rules in self.zone_rules.items():
            if name != rules.name:
                raise InputError(f"lot {self.name!r}: zone_rules[{name!r:.40}] is of zone {rules.name!r:.40}")
        users = {user for rules in self.zone_rules.values() for user in rules.users}
        self._set("classes", (PUBLIC, *sorted(users - {PUBLIC})))

    def with_rules(self, zone_rules: Mapping[str, Zone]) -> ParkingLot:
        """Return the lot with other rules of its zones, on the same drive graph.

        Raises:
            InputError: see the class.
        """
        lot = copy.copy(self)
        lot._set("zone_rules", zone_rules)
        lot._set_zones()
        return lot

    def _require_names(self) -> None:
        if len(self.slot_ids) == 0:
            raise InputError(f"lot {self.name!r} has no slot")
        for name in (self.name, *self.slot_ids):
            if not is_plain(name):
                raise InputError(f"lot: name {name!a:.60} has control characters")
        if repeated := [name for name, count in Counter(self.slot_ids).items() if count > 1]:
            raise InputError(f"lot {self.name!r}: slot id {repeated[0]!r} appears twice")

    def __repr__(self) -> str:
        return f"ParkingLot({self.name!r}, {self.n_slots} slots, {self.n_vertices} vertices)"

    @property
    def n_slots(self) -> int:
        """Number of slots."""
        return len(self.slot_ids)

    @property
    def n_vertices(self) -> int:
        """Number of vertices of the drive graph: one per slot, then junctions and lane ends."""
        return len(self.vertex_xy)

    @property
    def junction_of_vertex(self) -> IntArray:
        """(n_vertices,) int64, the first vertex in the same place.

        That is the vertex itself, except at junctions with further vertices for lanes with restricted turns.
        """
        n = self.n_slots
        _, first, of = np.unique(self.vertex_xy[n:], axis=0, return_index=True, return_inverse=True)
        return np.concatenate([np.arange(n), n + first[of.ravel()]])

    @property
    def is_town(self) -> bool:
        """Whether there are kerbs, car parks or garages, so that a car drives some way before it can park."""
        return bool(self.facilities)

    @property
    def side(self) -> int:
        """1 where cars keep to the right, -1 where to the left: the sign of what lies on the driver's kerb side."""
        return -1 if self.left_hand else 1

    @property
    def is_counted(self) -> NDArray[np.bool_]:
        """Whether each slot stands for a counted facility, (n_slots,) bool."""
        counted = np.array([*(facility.is_counted for facility in self.facilities), False])
        return counted[self.facility_of_slot]

    def walk_from_xy(self) -> FloatArray:
        """Where people begin to walk, (n_slots, 2) float64, m: the slot's centre, or a counted facility's point."""
        points = [facility.xy for facility in self.facilities if facility.is_counted]
        return (
            np.concatenate([self.slot_xy[: self.n_slots - len(points)], points]) if points else self.slot_xy
        )

    def walk_m(self, goal: int = 0) -> FloatArray:
        """Straight-line distance from each slot to a goal, (n_slots,) float64, m (eq. 3.25)."""
        away = self.walk_from_xy() - self.goals[goal]
        return np.asarray(np.hypot(away[:, 0], away[:, 1]))

    def mouth_xy(self) -> FloatArray:
        """Middle of the side by which each slot is entered, (n_slots, 2) float64, m."""
        return mouth_points(self.slot_xy, self.slot_yaw, self.slot_length, self.slot_width, self.slot_mouth)

    def slot_corners(self) -> FloatArray:
        """Corners of the slots, (n_slots, 4, 2) float64, m, counter-clockwise from the rear right one."""
        return corner_points(self.slot_xy, self.slot_yaw, self.slot_length, self.slot_width)

    def bounds(self) -> tuple[float, float, float, float]:
        """Bounding box of all features: least x and y, greatest x and y, m."""
        lanes = (lane.points for lane in self.lanes)
        points = np.concatenate([*self.slot_corners(), *lanes, self.entries, self.goals, *self.walls])
        low, high = points.min(axis=0), points.max(axis=0)
        return float(low[0]), float(low[1]), float(high[0]), float(high[1])

    def drive_matrix(self, timed: bool = False) -> csr_array[np.float64]:
        """The drive graph as a sparse matrix of edge lengths, (n_vertices, n_vertices) float64, m, for scipy.

        Args:
            timed: whether lengths are divided by the lanes' `speed`: over the scenario's speed, they are seconds.
        """
        from scipy.sparse import csr_array

        source, column = np.nonzero(self.neighbors >= 0)
        target = self.neighbors[source, column]
        shape = (self.n_vertices, self.n_vertices)
        # The matrix would sum parallel edges: keep the shortest.
        length = (self.edge_length / self.edge_speed if timed else self.edge_length)[source, column]
        order = np.lexsort((length, target, source))
        source, target, length = source[order], target[order], length[order]
        first = np.r_[True, (np.diff(source) != 0) | (np.diff(target) != 0)]
        return csr_array((length[first], (source[first], target[first])), shape=shape)


def mouth_heading(yaw: FloatArray, mouth: NDArray[np.int8]) -> FloatArray:
    """Direction that the mouth of each slot faces, (n,) float64, rad."""
    heading: FloatArray = yaw + np.array([np.pi, np.pi / 2, -np.pi / 2])[mouth]
    return heading


def mouth_points(
    xy: FloatArray, yaw: FloatArray, length: FloatArray, width: FloatArray, mouth: NDArray[np.int8]
) -> FloatArray:
    """Middle of the side by which each slot is entered, (n, 2) float64, m."""
    half = np.where(mouth == Mouth.REAR, length, width) / 2
    heading = mouth_heading(yaw, mouth)
    middle: FloatArray = xy + half[:, None] * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    return middle


def corner_points(xy: FloatArray, yaw: FloatArray, length: FloatArray, width: FloatArray) -> FloatArray:
    """Corners of rectangles, (n, 4, 2) float64, m, counter-clockwise from the rear right one."""
    along = np.stack([np.cos(yaw), np.sin(yaw)], axis=1) * length[:, None] / 2
    left = np.stack([-np.sin(yaw), np.cos(yaw)], axis=1) * width[:, None] / 2
    signs = ((-1, -1), (1, -1), (1, 1), (-1, 1))
    return np.stack([xy + a * along + b * left for a, b in signs], axis=1)


def is_building(wall: FloatArray) -> bool:
    """Whether a wall, (k, 2) m, is a closed line, i.e. the outline of a building."""
    return len(wall) >= 4 and np.array_equal(wall[0], wall[-1])


def _frozen(values: ArrayLike, name: str) -> FloatArray:
    try:
        array = np.array(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name} is {values!r:.60}, want numbers") from error
    array.flags.writeable = False
    return array


def _require_finite(what: str, values: FloatArray) -> None:
    wrong = ~(np.abs(values) <= FARTHEST)
    if wrong.any():
        where = tuple(np.argwhere(wrong)[0])
        index = ", ".join(map(str, where))
        raise InputError(f"{what}[{index}] is {values[where]}, want a finite number, at most {FARTHEST:.0e}")


def _same(a: object, b: object) -> bool:
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        return np.array_equal(a, b)
    if isinstance(a, tuple) and isinstance(b, tuple):
        return len(a) == len(b) and all(map(_same, a, b))
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        return a.keys() == b.keys() and all(_same(a[key], b[key]) for key in a)
    return a == b


__all__ = ["ACTIONS", "MOVES", "PARK", "GraphError", "GraphProblem", "Lane", "Mouth", "ParkingLot", "Turn"]
