"""Scenarios: a lot, its occupancy, the goal, speeds and costs."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import InstanceOf
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from parkenv.compiled.arrays import BoolArray, FloatArray, IntArray
from parkenv.errors import nearest, require, require_keywords, require_whole
from parkenv.files.field_types import NotNegative, Positive, Validated
from parkenv.world.cues import Cues
from parkenv.world.demand import Demand, TownDemand
from parkenv.world.lot import ACTIONS, PARK, ParkingLot
from parkenv.world.occupancy.arrival_window import ArrivalWindow
from parkenv.world.occupancy.process import Arrival, ArrivalDay, Forecast, OccupancyModel, PriorModel
from parkenv.world.sensor_model import SensorModel, SensorRates
from parkenv.world.tariff import VALUE_OF_TIME, Hours, Tariff, Zone
from parkenv.world.traffic import Traffic
from parkenv.world.week import HOUR_S

KMH = 1 / 3.6  # 1 km/h in m/s

# Cached properties of a problem that do not depend on its goal.
_OF_ALL_GOALS = (
    "parking_cost_s",
    "move_s",
    "edges",
    "action_masks",
    "slots_in_view",
    "sight_lines",
    "sensor_rates",
    "live_drive_s",
)
EDGE = np.dtype([("target", np.int64), ("seconds", np.float64), ("metres", np.float64)], align=True)
"""Result of an action at a vertex: the vertex that it leads to, s, m.

Parking, and actions that the graph does not have, lead back to the same vertex.
"""


class Drivers(NamedTuple):
    """What decides where drivers may park and what it costs them: numbers, or arrays of one shape, (...)."""

    stay_s: ArrayLike
    arrival_s: ArrayLike  # s since Monday 00:00, from when the stay counts
    value_of_time: ArrayLike  # of an hour, in the currency of the prices
    classes: ArrayLike  # int64, sum of 2^i over the driver's classes `ParkingLot.classes[i]`
    kwh: ArrayLike = 0.0  # charged while parked


@dataclass(frozen=True, eq=False, kw_only=True)
class SearchProblem(Validated):
    """The public part of a search: lot, goal, speeds, costs and sensor model.

    Args:
        lot: the lot.
        goal: index into `lot.goals`.
        v_drive: driving speed, m/s (10 km/h in the thesis).
        v_walk: walking speed, m/s (4 km/h in the thesis).
        failure_s: cost of a failed parking attempt, s; planners use the same value.
        wait_s: cost of a move that the graph does not have, s (the thesis's Δt).
        give_up_s: give-up penalty, s: parking elsewhere and walking, once the lot is proven full.
        sensor_model: range and error rates of observations.
        tariff: prices of the lot's zones.
        stay_s: expected stay, s, which the price is for; in a fleet each car has its own.
        value_of_time: value of an hour of the driver's time, in the currency of the prices.
        priced_at_s: clock time that prices and hours count from, s since Monday 00:00; in a fleet it is each car's
            arrival.
        classes: classes of users that the driver belongs to, beside `public`.
        kwh: kWh that the car takes where it can charge.
        walk_back: whether the walk from the goal back to the car counts, too.
        cues: what shows that cars are about to leave; None: nothing.

    Raises:
        InputError: a value out of its range; the message names the field.
    """

    lot: InstanceOf[ParkingLot]
    goal: int = 0
    v_drive: Positive = 10 * KMH
    v_walk: Positive = 4 * KMH
    failure_s: NotNegative = 10.0
    wait_s: Positive = 1.0
    give_up_s: NotNegative = 1800.0
    sensor_model: InstanceOf[SensorModel] = field(default_factory=SensorModel)
    tariff: InstanceOf[Tariff] = field(default_factory=Tariff)
    stay_s: NotNegative = HOUR_S
    value_of_time: Positive = VALUE_OF_TIME
    priced_at_s: NotNegative = 34 * HOUR_S
    classes: tuple[str, ...] = ()
    kwh: NotNegative = 0.0
    walk_back: bool = False
    cues: InstanceOf[Cues] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        require_whole("goal", self.goal, most=len(self.lot.goals) - 1)
        self.tariff.require_zones(self._own_zones, self.lot.name)
        object.__setattr__(self, "classes", tuple(self.classes))
        self.class_bits(self.classes)

    @cached_property
    def walk_s(self) -> FloatArray:
        """Walk from each slot to the goal, and back where that counts, (n_slots,) s (eq. 3.25)."""
        return _read_only(self.lot.walk_m(self.goal) / self.v_walk * (2.0 if self.walk_back else 1.0))

    @cached_property
    def arrival_cost_s(self) -> FloatArray:
        """Cost of arriving in each slot, (n_slots,) s: `enter_s`, walk and parking; infinite where it is forbidden."""
        return _read_only(self.walk_s + self.parking_cost_s + self.enter_s)

    @cached_property
    def finite_cost_s(self) -> FloatArray:
        """`arrival_cost_s` for arithmetic: a forbidden slot, which counts as taken, has the largest cost."""
        allowed = np.isfinite(self.arrival_cost_s)
        if allowed.all():
            return self.arrival_cost_s
        dearest = max(self.give_up_s, float(self.arrival_cost_s[allowed].max(initial=0.0)))
        return _read_only(np.where(allowed, self.arrival_cost_s, dearest))

    @cached_property
    def enter_s(self) -> FloatArray:
        """Expected time from the entry of each counted facility to a space, (n_slots,) s: barrier, half-full inside."""
        facilities = [facility for facility in self.lot.facilities if facility.is_counted]
        enter_s = np.zeros(self.lot.n_slots)
        enter_s[self.lot.n_slots - len(facilities) :] = [f.gate_s + sum(f.inside_s) / 2 for f in facilities]
        return _read_only(enter_s)

    @cached_property
    def parking_cost_s(self) -> FloatArray:
        """Parking cost of each slot as time, (n_slots,) s: that of the lot, and the price of the expected stay."""
        return _read_only(self.parking_cost_of(self.driver))

    @property
    def driver(self) -> Drivers:
        """The driver of the search."""
        return Drivers(
            self.stay_s, self.priced_at_s, self.value_of_time, self.class_bits(self.classes), self.kwh
        )

    def class_bits(self, classes: Iterable[str]) -> int:
        """Return the number that stands for classes of users in `Drivers`; `public` is always among them.

        Raises:
            InputError: no zone of the lot names a class.
        """
        known = self.lot.classes
        for name in classes:
            lot = f"lot {self.lot.name!r:.40}"
            require(name in known, f"classes has {name!r:.40}, no class of {lot}; {nearest(name, known)}")
        return sum(1 << i for i, name in enumerate(known) if i == 0 or name in classes)

    @cached_property
    def zone_rules(self) -> tuple[Zone, ...]:
        """Rules of the lot's zones, in their order, with the prices of the tariff."""
        return tuple(map(self.tariff.priced, self._own_zones))

    @property
    def _own_zones(self) -> list[Zone]:
        return [self.lot.zone_rules.get(name, Zone(name)) for name in self.lot.zones]

    def parking_cost_of(self, drivers: Drivers) -> FloatArray:
        """Return what drivers pay in each slot as time, (..., n_slots) s: that of the lot, and `zone_cost_s`."""
        return self.lot.slot_parking_cost_s + self.zone_cost_s(drivers)[..., self.lot.zone_of_slot]

    def zone_cost_s(self, drivers: Drivers) -> FloatArray:
        """Return what parking costs drivers in each of the lot's zones as time, (..., n_zones) s.

        That is the price divided by the value of time, infinite where a driver may not park: in none of the zone's
        classes of users, outside its hours, or for longer than its longest stay. Agents plan on it, and the reward
        charges it.
        """
        seconds = HOUR_S / np.asarray(drivers.value_of_time, np.float64)[..., None]
        return np.where(self.admits(drivers), zone_prices(self.zone_rules, drivers) * seconds, np.inf)

    def admits(self, drivers: Drivers) -> BoolArray:
        """Return whether drivers may park in each of the lot's zones, (..., n_zones) bool."""
        arrival, stay, classes = np.broadcast_arrays(drivers.arrival_s, drivers.stay_s, drivers.classes)
        known, zones = list(enumerate(self.lot.classes)), self.zone_rules
        users = np.array([sum(1 << i for i, name in known if name in zone.users) for zone in zones])
        is_user = (classes.astype(np.int64)[..., None] & users) != 0
        return np.asarray(is_user & np.stack([zone.admits(arrival, stay) for zone in zones], axis=-1))

    @property
    def is_priced(self) -> bool:
        """Whether slots have prices or parking costs."""
        return self.has_rules or bool(self.lot.slot_parking_cost_s.any())

    @cached_property
    def has_rules(self) -> bool:
        """Whether prices, hours, longest stays or classes tell drivers apart, or are stated, be they 0."""
        return bool(self.tariff) or any(zone != Zone(zone.name) for zone in self.zone_rules)

    @cached_property
    def move_s(self) -> FloatArray:
        """Drive time of each edge, (n_vertices, 4) s; 0 where there is none (eq. 3.22)."""
        return _read_only(self.lot.edge_length / self.lot.edge_speed / self.v_drive)

    @property
    def move_cost_s(self) -> FloatArray:
        """Cost of each move, (n_vertices, 4) s: its drive time and what else it costs (nothing yet).

        Agents minimise this and `arrival_cost_s`; clocks, and beliefs that decay, count `move_s`.
        """
        return self.move_s

    @cached_property
    def edges(self) -> NDArray[Any]:
        """What each action does at each vertex, (n_vertices, 5) `EDGE` records."""
        edges = np.zeros((self.lot.n_vertices, len(ACTIONS)), EDGE)
        edges["target"] = np.arange(self.lot.n_vertices)[:, None]
        edges["seconds"] = self.wait_s
        moves = self.lot.neighbors >= 0
        for name, of_moves in (
            ("target", self.lot.neighbors),
            ("seconds", self.move_s),
            ("metres", self.lot.edge_length),
        ):
            edges[name][:, :PARK][moves] = of_moves[moves]
        edges["seconds"][: self.lot.n_slots, PARK] = 0.0
        return edges

    @cached_property
    def action_masks(self) -> NDArray[np.int8]:
        """(n_vertices, 5), 1 if the driver may take the action: that of the graph, parking where it is allowed."""
        forbidden = np.flatnonzero(np.isinf(self.parking_cost_s))
        if not len(forbidden):
            return self.graph_masks
        masks = self.graph_masks.copy()
        masks[forbidden, PARK] = 0
        return _read_only(masks)

    @cached_property
    def graph_masks(self) -> NDArray[np.int8]:
        """(n_vertices, 5), 1 if the graph has the action: an edge to drive along, or a slot to park in."""
        masks = np.zeros((self.lot.n_vertices, len(ACTIONS)), dtype=np.int8)
        masks[:, :PARK] = self.lot.neighbors >= 0
        masks[: self.lot.n_slots, PARK] = 1
        return _read_only(masks)

    @cached_property
    def slots_in_view(self) -> tuple[IntArray, IntArray]:
        """Slots in view, as (starts, slots): for vertex v `slots[starts[v]:starts[v + 1]]`, ascending.

        Counted facilities without a sign are in view of no vertex.
        """
        tree = cKDTree(self.lot.vertex_xy)
        # A slot's own vertex counts even at a range of 0.
        pairs = tree.query_pairs(self.sensor_model.view_range, output_type="ndarray")
        own = np.arange(self.lot.n_slots)
        viewer = np.concatenate([pairs[:, 0], pairs[:, 1], own])
        slot = np.concatenate([pairs[:, 1], pairs[:, 0], own])
        shown = np.arange(self.lot.n_vertices) < self.lot.n_slots
        shown[self._counted("nothing")] = False
        viewer, slot = viewer[shown[slot]], slot[shown[slot]]
        order = np.lexsort((slot, viewer))
        starts = np.searchsorted(viewer[order], np.arange(self.lot.n_vertices + 1))
        return _read_only(starts.astype(np.int64)), _read_only(slot[order].astype(np.int64))

    @property
    def live_slots(self) -> IntArray:
        """Slots of counted facilities with a live count."""
        return self._counted("live")

    @property
    def observes_exactly(self) -> bool:
        """Whether slots in view are observed without error, and nothing is known of others."""
        return self.sensor_model.perfect and not len(self.live_slots) and self.cues is None

    @cached_property
    def live_drive_s(self) -> FloatArray:
        """Drive from each vertex to each of `live_slots`, (n_live, n_vertices) s."""
        if not len(self.live_slots):
            return np.zeros((0, self.lot.n_vertices))
        metres = dijkstra(self.lot.drive_matrix(timed=True).T.tocsr(), indices=self.live_slots)
        return _read_only(metres / self.v_drive)

    def _counted(self, known: str) -> IntArray:
        facilities = [facility for facility in self.lot.facilities if facility.is_counted]
        there = np.flatnonzero([facility.known == known for facility in facilities])
        return self.lot.n_slots - len(facilities) + there

    def in_view(self, vertex: int) -> IntArray:
        """Return the slots in view of a vertex, ascending."""
        starts, slots = self.slots_in_view
        return slots[starts[vertex] : starts[vertex + 1]]

    @cached_property
    def sight_lines(self) -> tuple[FloatArray, BoolArray]:
        """Distance, m, of each of `slots_in_view`, and whether it is beside the car.

        Distances are between vertices, like the view range. A slot is beside a car at a slot's vertex if it lies on its
        kerb side, within 45° of the perpendicular.
        """
        starts, slots = self.slots_in_view
        viewer = np.repeat(np.arange(self.lot.n_vertices), np.diff(starts))
        away = self.lot.vertex_xy[slots] - self.lot.vertex_xy[viewer]
        to_slot = self.lot.slot_xy[slots] - self.lot.vertex_xy[viewer]
        angle = np.arctan2(to_slot[:, 1], to_slot[:, 0]) - self.lot.vertex_yaw[viewer]
        beside = (self.lot.side * np.sin(angle) <= -math.sqrt(0.5)) & (viewer < self.lot.n_slots)
        return _read_only(np.hypot(away[:, 0], away[:, 1])), _read_only(beside)

    @cached_property
    def sensor_rates(self) -> SensorRates:
        """Sensor rates for each of `slots_in_view`."""
        return SensorRates(*map(_read_only, self.sensor_model.rates(*self.sight_lines)))

    def of_driver(self, driver: Drivers, walks: float = 1.0) -> Self:
        """Return the problem of another driver, whose walk counts `walks` times as often."""
        stay_s, priced_at_s, value_of_time, classes, kwh = (float(np.asarray(value)) for value in driver)
        names = [name for i, name in enumerate(self.lot.classes) if i and int(classes) >> i & 1]
        return self.replace(
            stay_s=stay_s,
            priced_at_s=priced_at_s,
            value_of_time=value_of_time,
            kwh=kwh,
            classes=tuple(names),
            walk_back=self.walk_back or walks > 1.0,
        )

    def public(self) -> SearchProblem:
        """Return the part that agents may know."""
        return self

    def at_goal(self, goal: int) -> Self:
        """Return the problem of another goal; it shares all tables that do not depend on the goal."""
        other = self.replace(goal=goal)
        vars(other).update({name: getattr(self, name) for name in _OF_ALL_GOALS})
        return other

    def replace(self, **changes: Any) -> Self:
        """Return a copy with some fields changed and validated.

        Raises:
            TypeError: an unknown field; the message lists the known ones.
        """
        known = [f.name for f in dataclasses.fields(self) if f.init]
        require_keywords(type(self).__name__, changes, known)
        return dataclasses.replace(self, **changes)


@dataclass(frozen=True, eq=False, kw_only=True)
class Scenario(SearchProblem):
    """A search problem with its world, which is hidden from agents.

    Args:
        name: name for tables.
        occupancy: true occupancy of the slots over time.
        prior: model of the initial forecast; None: `occupancy`. A prior that differs from the world models an outdated
            map.
        arrival: when searches start.
        demand: demand for days with many cars; None: none.
        entry: index into `lot.entries`; None draws one for each search.
        traffic: other road users in the lot, visible to simulated sensors and on driven trips.
        rig: name of the car's sensor rig, where sensors are simulated.
        detector: name of the car's detector there, as `parkenv.perception.detector_registry.make_detector` takes it.
    """

    name: str
    occupancy: OccupancyModel
    prior: PriorModel | None = None
    arrival: InstanceOf[ArrivalWindow] = field(default_factory=ArrivalWindow)
    demand: InstanceOf[Demand] | InstanceOf[TownDemand] | None = None
    entry: int | None = None
    traffic: InstanceOf[Traffic] = field(default_factory=Traffic)
    rig: str = "laser"
    detector: str = "hog"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.entry is not None:
            require_whole("entry", self.entry, most=len(self.lot.entries) - 1)
        for name in ("occupancy", "prior"):
            model = getattr(self, name)
            n_slots = self.lot.n_slots if model is None else model.n_slots
            require(
                n_slots == self.lot.n_slots,
                f"{name} is for {n_slots} slots, lot {self.lot.name!r} has {self.lot.n_slots}",
            )

    def public(self) -> SearchProblem:
        """Return the part that agents may know: without the occupancy, its forecast model and the traffic."""
        return SearchProblem(**{f.name: getattr(self, f.name) for f in dataclasses.fields(SearchProblem)})

    @property
    def arrival_days(self) -> list[ArrivalDay]:
        """Days on which searches begin, from which each draws one."""
        return self.occupancy.arrival_days(self.arrival)

    @property
    def entry_vertices(self) -> IntArray:
        """Vertices of the entries, from which each search draws one."""
        vertices = self.lot.entry_vertices
        return vertices if self.entry is None else vertices[[self.entry]]

    def forecast(self, arrival: Arrival) -> Forecast:
        """Return the forecast for a search that starts at the arrival."""
        return (self.prior or self.occupancy).forecast(arrival)


def zone_prices(zones: Sequence[Zone], drivers: Drivers) -> FloatArray:
    """Return what drivers pay in each of some zones, (..., n_zones) in the currency of the prices."""
    arrival, stay, kwh = np.broadcast_arrays(drivers.arrival_s, drivers.stay_s, drivers.kwh)
    amounts, seconds = [], dict[Hours, FloatArray]()
    for price in (zone.price for zone in zones):
        if price.hourly and price.daily_cap is None and not price.per_kwh:
            # Many zones share their hours.
            for hours in (hours for hours, _ in price.hourly if hours not in seconds):
                seconds[hours] = hours.within(arrival, stay)
            amounts.append(price.of_hours(seconds))
        else:
            amounts.append(price.amount(arrival, stay, kwh))
    return np.stack(amounts, axis=-1)


def drive_times(problem: SearchProblem, vertex: int | IntArray) -> FloatArray:
    """Return the shortest drive time from a vertex, or several, to each slot's stop position, (..., n_slots) s.

    It is infinite where there is no way.
    """
    return drive_metres(problem.lot, vertex, timed=True) / problem.v_drive


def drive_metres(lot: ParkingLot, vertex: int | IntArray, *, timed: bool = False) -> FloatArray:
    """Return the shortest drive from a vertex, or several, to each slot, (..., n_slots) m; see `drive_matrix`."""
    metres = dijkstra(lot.drive_matrix(timed), indices=np.asarray(vertex))
    return np.asarray(metres[..., : lot.n_slots])


def _read_only(array: NDArray[Any]) -> NDArray[Any]:
    array.flags.writeable = False
    return array
