"""The parking lot: slots, lanes, entries, goals and walls, and the drive graph derived from them."""

from __future__ import annotations

import copy
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from enum import IntEnum
from typing import TYPE_CHECKING, Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from parkenv.compiled.arrays import BoolArray, FloatArray, IntArray
from parkenv.errors import InputError, naming, nearest, require
from parkenv.files.field_types import Flag, Number, Validated, as_array
from parkenv.files.file_names import is_plain
from parkenv.world.drive_graph import NODE_TOLERANCE, GraphError, GraphProblem, build_drive_graph
from parkenv.world.facility import NOMINAL_SLOT, Facility, facility_problem, nominal_slots
from parkenv.world.tariff import NO_ZONE, PUBLIC, Zone

if TYPE_CHECKING:
    from scipy.sparse import csr_array


# The names of the four columns of `ParkingLot.neighbors`, in order (eq. 3.13).
MOVES = ("up", "down", "left", "right")
PARK = len(MOVES)  # the action "park" (eq. 3.14); lower actions are the moves.
ACTIONS = (*MOVES, "park")
FARTHEST = 1e8  # largest coordinate, m: enough for any map grid, and small enough for millimetres in float64
SLOT_SIDE = 0.1  # least length and width of a slot, m
_OPTIONAL = ("slot_parking_cost_s", "slot_zone", "slot_facility")


class Mouth(IntEnum):
    """The side by which a slot is entered, relative to a car parked nose-in along the slot's yaw."""

    REAR = 0  # perpendicular and angled slots
    LEFT = 1  # kerbside slots to the right of their lane
    RIGHT = 2  # kerbside slots to the left of their lane


class _ByValue:
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
        points = as_array("lane points", self.points, -2, 2, least=-FARTHEST, most=FARTHEST)
        step = np.diff(points, axis=0)
        short = np.flatnonzero(np.hypot(step[:, 0], step[:, 1]) <= NODE_TOLERANCE)
        if len(short):
            raise InputError(f"lane points[{short[0]}] and [{short[0] + 1}] are equal, want different points")
        object.__setattr__(self, "points", points)


@dataclass(frozen=True, eq=False)
class Turn(Validated, _ByValue):
    """A turn restriction: a turn at a junction that is prohibited, or mandatory."""

    # (3, 2) float64, m, lot frame: a point on the lane by which cars come, the junction, and a point on the lane by
    # which they leave; the first and the last one are the same where cars turn back
    points: FloatArray
    only: Flag = False  # whether the turn is mandatory: all others from its lane are prohibited

    def __post_init__(self) -> None:
        super().__post_init__()
        points = as_array("turn points", self.points, 3, 2, least=-FARTHEST, most=FARTHEST)
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
    entry_vertices: IntArray = field(init=False)
    zones: tuple[str, ...] = field(init=False)
    zone_of_slot: IntArray = field(init=False)
    facility_of_slot: IntArray = field(init=False)
    capacity: IntArray = field(init=False)
    classes: tuple[str, ...] = field(init=False)

    def __post_init__(self) -> None:
        for name in ("slot_ids", "lanes", "turns", "facilities"):
            self._set(name, tuple(getattr(self, name)))
        _add_counted(self)
        with naming(f"lot {self.name!r}"):
            self._set_features()
            self._set_facilities()
            self._set_rules(self.zone_rules)
        graph = build_drive_graph(
            [(lane.points, lane.oneway, lane.speed) for lane in self.lanes],
            self.mouth_xy(),
            self.entries,
            [(turn.points, turn.only) for turn in self.turns],
            self.side,
        )
        for name in ("vertex_xy", "vertex_yaw", "neighbors", "edge_length", "edge_speed", "entry_vertices"):
            self._set(name, getattr(graph, name))
        _require_reachable(self)

    def _set(self, name: str, value: object) -> None:
        if isinstance(value, np.ndarray):
            value.flags.writeable = False
        object.__setattr__(self, name, value)

    def _set_features(self) -> None:
        n, within = len(self.slot_ids), {"least": -FARTHEST, "most": FARTHEST}
        for kind, features in (
            ("slot", self.slot_ids), ("lane", self.lanes), ("entry", self.entries), ("goal", self.goals),
        ):  # fmt: skip
            require(len(features) > 0, f"has no {kind}")
        if repeated := [name for name, count in Counter(self.slot_ids).items() if count > 1]:
            raise InputError(f"slot id {repeated[0]!r} appears twice")
        for name, shape, dtype, least in (
            ("slot_xy", (n, 2), np.float64, -FARTHEST),
            ("slot_yaw", (n,), np.float64, -FARTHEST),
            ("slot_length", (n,), np.float64, SLOT_SIDE),
            ("slot_width", (n,), np.float64, SLOT_SIDE),
            ("slot_mouth", (n,), np.int8, None),
            ("entries", (-1, 2), np.float64, -FARTHEST),
            ("goals", (-1, 2), np.float64, -FARTHEST),
            ("slot_parking_cost_s", (n,), np.float64, 0.0),
            ("slot_zone", (n,), np.str_, None),
            ("slot_facility", (n,), np.str_, None),
        ):
            values = getattr(self, name)
            if name in _OPTIONAL and np.size(values) == 0:
                values = np.zeros(shape, dtype)
            self._set(name, as_array(name, values, *shape, dtype=dtype, least=least, most=FARTHEST))
        if not np.isin(self.slot_mouth, list(Mouth)).all():
            raise InputError(f"slot_mouth must hold {n} values of {list(map(int, Mouth))}")
        self._set("walls", tuple(as_array("walls", wall, -2, 2, **within) for wall in self.walls))
        for name, count in (("goal_weights", len(self.goals)), ("entry_weights", len(self.entries))):
            weights = getattr(self, name).items()
            self._set(
                name, {key: as_array(f"{name}[{key!r:.40}]", w, count, least=0.0) for key, w in weights}
            )
        for name in (self.name, *self.slot_ids, *self.slot_zone.tolist()):
            require(is_plain(name), f"name {name!a:.60} has control characters")

    def _set_facilities(self) -> None:
        names = [facility.name for facility in self.facilities]
        if repeated := [name for name, count in Counter(names).items() if count > 1]:
            raise InputError(f"facility {repeated[0]!r:.40} appears twice")
        for name in set(self.slot_facility.tolist()) - {"", *names}:
            raise InputError(f"no facility {name!r:.40}; {nearest(name, names)}")
        order = {"": -1} | {name: i for i, name in enumerate(names)}
        index = np.array([order[name] for name in self.slot_facility.tolist()], np.int64)
        n_slots = np.bincount(index[index >= 0], minlength=len(names)).tolist()
        for facility, n in zip(self.facilities, n_slots, strict=True):
            require(n > 0, f"facility {facility.name!r:.40} has neither a capacity nor slots")
            if facility.is_counted and n > 1:
                raise InputError(f"facility {facility.name!r:.40} has a capacity, want no slots that name it")
        # One more for the index -1.
        inherited = np.array([*(facility.zone for facility in self.facilities), ""])
        zone = np.where(self.slot_zone == "", inherited[index], self.slot_zone)
        capacity = np.array([*(facility.capacity for facility in self.facilities), 0], np.int64)
        zones, zone_of_slot = np.unique(np.where(zone == "", NO_ZONE, zone), return_inverse=True)
        for name, value in (
            ("facility_of_slot", index),
            ("capacity", np.maximum(capacity[index], 1)),
            ("slot_zone", zone),
            ("zones", tuple(zones.tolist())),
            ("zone_of_slot", zone_of_slot.astype(np.int64)),
        ):
            self._set(name, value)

    def _set_rules(self, zone_rules: Mapping[str, Zone]) -> None:
        for name in self.zones:
            if zone_rules and name != NO_ZONE and name not in zone_rules:
                raise InputError(f"no rules of zone {name!r:.40}; {nearest(name, zone_rules)}")
        for name, rules in zone_rules.items():
            require(name == rules.name, f"zone_rules[{name!r:.40}] is of zone {rules.name!r:.40}")
        users = {user for rules in zone_rules.values() for user in rules.users}
        self._set("zone_rules", dict(zone_rules))
        self._set("classes", (PUBLIC, *sorted(users - {PUBLIC})))

    def with_rules(self, zone_rules: Mapping[str, Zone]) -> ParkingLot:
        """Return the lot with other rules of its zones, on the same drive graph.

        Raises:
            InputError: see the class.
        """
        lot = copy.copy(self)
        with naming(f"lot {self.name!r}"):
            lot._set_rules(zone_rules)
        return lot

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
    def is_counted(self) -> BoolArray:
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


def _add_counted(lot: ParkingLot) -> None:
    """Append the slots of counted facilities that are missing, and place all of them beside their lanes."""
    counted = [facility for facility in lot.facilities if facility.is_counted]
    if not counted:
        return
    names, n = tuple(facility.name for facility in counted), len(lot.slot_ids)
    there = lot.slot_ids[max(n - len(names), 0) :] == names
    drawn = n - len(names) if there else n
    xy, yaw = np.zeros((len(counted), 2)), np.zeros(len(counted))
    if lot.lanes:
        xy, yaw = nominal_slots(lot.facilities, [lane.points for lane in lot.lanes])
    lot._set("slot_ids", lot.slot_ids[:drawn] + names)
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
        column = np.asarray(getattr(lot, name))
        if column.size == 0 and drawn:
            column = np.zeros(drawn, values.dtype)
        require(len(column) in (drawn, n), f"lot {lot.name!r}: {name} has {len(column)} values, want {n}")
        lot._set(name, np.concatenate([column[:drawn].reshape(-1, *values.shape[1:]), values]))


def _require_reachable(lot: ParkingLot) -> None:
    counted = np.flatnonzero(lot.is_counted)
    if not len(counted):
        return
    from scipy.sparse.csgraph import dijkstra

    reached = np.isfinite(dijkstra(lot.drive_matrix(), indices=lot.entry_vertices, min_only=True))
    lost = lot.facility_of_slot[counted[~reached[counted]]].tolist()
    if lost:
        reason = "cannot be reached from an entry"
        raise GraphError([facility_problem(lot.facilities[i], i, reason) for i in lost])


def mouth_heading(yaw: FloatArray, mouth: NDArray[np.int8]) -> FloatArray:
    return yaw + np.array([np.pi, np.pi / 2, -np.pi / 2])[mouth]  # type: ignore[no-any-return]


def mouth_points(
    xy: FloatArray, yaw: FloatArray, length: FloatArray, width: FloatArray, mouth: NDArray[np.int8]
) -> FloatArray:
    half = np.where(mouth == Mouth.REAR, length, width) / 2
    heading = mouth_heading(yaw, mouth)
    return xy + half[:, None] * np.stack([np.cos(heading), np.sin(heading)], axis=1)  # type: ignore[no-any-return]


def corner_points(xy: FloatArray, yaw: FloatArray, length: FloatArray, width: FloatArray) -> FloatArray:
    """Corners of rectangles, (n, 4, 2) float64, m, counter-clockwise from the rear right one."""
    along = np.stack([np.cos(yaw), np.sin(yaw)], axis=1) * length[:, None] / 2
    left = np.stack([-np.sin(yaw), np.cos(yaw)], axis=1) * width[:, None] / 2
    signs = ((-1, -1), (1, -1), (1, 1), (-1, 1))
    return np.stack([xy + a * along + b * left for a, b in signs], axis=1)


def is_building(wall: FloatArray) -> bool:
    return len(wall) >= 4 and np.array_equal(wall[0], wall[-1])


def _same(a: object, b: object) -> bool:
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        return np.array_equal(a, b)
    if isinstance(a, tuple) and isinstance(b, tuple):
        return len(a) == len(b) and all(map(_same, a, b))
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        return a.keys() == b.keys() and all(_same(a[key], b[key]) for key in a)
    return a == b


__all__ = ["ACTIONS", "MOVES", "PARK", "GraphError", "GraphProblem", "Lane", "Mouth", "ParkingLot", "Turn"]
