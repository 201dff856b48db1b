"""Scenarios: a lot, what stands in it, where people want to go, and what time costs."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from parkenv.errors import InputError
from parkenv.lots import packaged_lot
from parkenv.world.lot import ACTIONS, PARK, ParkingLot
from parkenv.world.occupancy import (
    Arrival,
    ArrivalWindow,
    Forecast,
    OccupancyModel,
    OccupancyProcess,
    PriorModel,
)
from parkenv.world.sensor_model import SensorModel, SensorRates
from parkenv.world.traffic import Traffic

FloatArray = NDArray[np.float64]

KMH = 1 / 3.6
"""One kilometre an hour in metres a second."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SearchProblem:
    """What everybody may know of a search: the lot, the goal, speeds, costs, and how slots are seen.

    Args:
        lot: the lot.
        goal: index into `lot.goals`.
        v_drive: m/s (the thesis drives at 10 km/h).
        v_walk: m/s (the thesis walks at 4 km/h).
        failure_s: s that a try at a taken slot costs; planners are told the same figure.
        wait_s: s that a move costs which the graph does not have (the thesis's Δt).
        give_up_s: s that it costs to park elsewhere and walk, once the lot is proven full.
        sensor_model: how slots are seen.

    Raises:
        InputError: a value out of its range, by name.
    """

    lot: ParkingLot
    goal: int = 0
    v_drive: float = 10 * KMH
    v_walk: float = 4 * KMH
    failure_s: float = 10.0
    wait_s: float = 1.0
    give_up_s: float = 1800.0
    sensor_model: SensorModel = field(default_factory=SensorModel)

    def __post_init__(self) -> None:
        if not isinstance(self.lot, ParkingLot):
            raise InputError(f"lot is a {type(self.lot).__name__}, want a ParkingLot")
        if not isinstance(self.sensor_model, SensorModel):
            raise InputError(f"sensor_model is a {type(self.sensor_model).__name__}, want a SensorModel")
        _require_index("goal", self.goal, len(self.lot.goals))
        for name in ("v_drive", "v_walk", "wait_s"):
            _require_number(name, getattr(self, name), above=0.0)
        for name in ("failure_s", "give_up_s"):
            _require_number(name, getattr(self, name), least=0.0)

    @cached_property
    def walk_s(self) -> FloatArray:
        """Walk from each slot to the goal, (n_slots,) s (eq. 3.25)."""
        return _read_only(self.lot.walk_m(self.goal) / self.v_walk)

    @cached_property
    def arrival_cost_s(self) -> FloatArray:
        """What parking in each slot costs on arrival, (n_slots,) s: the walk."""
        return self.walk_s

    @cached_property
    def move_s(self) -> FloatArray:
        """Drive time of each edge, (n_vertices, 4) s; 0 where there is none (eq. 3.22)."""
        return _read_only(self.lot.edge_length / self.v_drive)

    @cached_property
    def action_masks(self) -> NDArray[np.int8]:
        """(n_vertices, 5) 1 where the graph has the action: an edge to drive along, or a slot to park in."""
        masks = np.zeros((self.lot.n_vertices, len(ACTIONS)), dtype=np.int8)
        masks[:, :PARK] = self.lot.neighbors >= 0
        masks[: self.lot.n_slots, PARK] = 1
        return _read_only(masks)

    @cached_property
    def slots_in_view(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Slots seen from each vertex, ascending, in rows: `slots[starts[v]:starts[v + 1]]`."""
        tree = cKDTree(self.lot.vertex_xy)
        # A slot's own vertex counts even at a range of 0.
        pairs = tree.query_pairs(self.sensor_model.view_range, output_type="ndarray")
        own = np.arange(self.lot.n_slots)
        viewer = np.concatenate([pairs[:, 0], pairs[:, 1], own])
        slot = np.concatenate([pairs[:, 1], pairs[:, 0], own])
        viewer, slot = viewer[slot < self.lot.n_slots], slot[slot < self.lot.n_slots]
        order = np.lexsort((slot, viewer))
        starts = np.searchsorted(viewer[order], np.arange(self.lot.n_vertices + 1))
        return _read_only(starts.astype(np.int64)), _read_only(slot[order].astype(np.int64))

    @cached_property
    def sight_lines(self) -> tuple[FloatArray, NDArray[np.bool_]]:
        """How far away each of `slots_in_view` is, m, and whether it is beside the car, row by row of it.

        Distances are between vertices, as the view range is. A slot is beside a car that stands before it or another
        slot if it lies to the right, within 45° of abreast.
        """
        starts, slots = self.slots_in_view
        viewer = np.repeat(np.arange(self.lot.n_vertices), np.diff(starts))
        away = self.lot.vertex_xy[slots] - self.lot.vertex_xy[viewer]
        to_slot = self.lot.slot_xy[slots] - self.lot.vertex_xy[viewer]
        angle = np.arctan2(to_slot[:, 1], to_slot[:, 0]) - self.lot.vertex_yaw[viewer]
        beside = (np.sin(angle) <= -math.sqrt(0.5)) & (viewer < self.lot.n_slots)
        return _read_only(np.hypot(away[:, 0], away[:, 1])), _read_only(beside)

    @cached_property
    def sensor_rates(self) -> SensorRates:
        """How well each of `slots_in_view` is seen, row by row of it."""
        return SensorRates(*map(_read_only, self.sensor_model.rates(*self.sight_lines)))

    def replace(self, **changes: Any) -> Self:
        """A copy with some fields changed, checked again.

        Raises:
            InputError: a field that does not exist; the message lists the known ones.
        """
        known = [f.name for f in dataclasses.fields(self) if f.init]
        for name in changes:
            if name not in known:
                raise InputError(f"a {type(self).__name__} has no field {name!r}; known: {', '.join(known)}")
        return dataclasses.replace(self, **changes)


@dataclass(frozen=True, eq=False, kw_only=True)
class Scenario(SearchProblem):
    """A search problem together with the world it takes place in, which agents do not get to see.

    Args:
        name: a word for tables.
        occupancy: what stands in the slots over time.
        prior: whose forecast the car starts from; the occupancy's own where None. A prior that differs
            from the world is a map that is out of date.
        arrival: when searches start.
        entry: index into `lot.entries`; None draws one for each search.
        traffic: what else moves in the lot, for those who look through sensors, and on driven trips.
    """

    name: str
    occupancy: OccupancyModel
    prior: PriorModel | None = None
    arrival: ArrivalWindow = field(default_factory=ArrivalWindow)
    entry: int | None = None
    traffic: Traffic = field(default_factory=Traffic)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.entry is not None:
            _require_index("entry", self.entry, len(self.lot.entries))
        if not isinstance(self.traffic, Traffic):
            raise InputError(f"traffic is a {type(self.traffic).__name__}, want a Traffic")
        for name in ("occupancy", "prior"):
            model = getattr(self, name)
            if model is not None and model.n_slots != self.lot.n_slots:
                raise InputError(
                    f"{name} is for {model.n_slots} slots, lot {self.lot.name!r} has {self.lot.n_slots}"
                )

    def public(self) -> SearchProblem:
        """What agents may know."""
        return SearchProblem(**{f.name: getattr(self, f.name) for f in dataclasses.fields(SearchProblem)})

    def forecast(self, arrival: Arrival) -> Forecast:
        """What the map predicts for a search that starts then."""
        return (self.prior or self.occupancy).forecast(arrival)

    @classmethod
    def named(cls, name: str, **changes: Any) -> Self:
        """One of the scenarios that come with the package, with some fields changed.

        Raises:
            InputError: an unknown name; the message lists the known ones.

        Examples:
            >>> scenario = Scenario.named("campus", failure_s=90.0)
            >>> scenario.lot.name, scenario.failure_s
            ('campus', 90.0)
        """
        try:
            make = _NAMED[name]
        except KeyError:
            raise InputError(f"unknown scenario {name!r}; known: {', '.join(_NAMED)}") from None
        return cls(**{"name": name, **make()}).replace(**changes)

    @classmethod
    def of(cls, scenario: str | Scenario, **changes: Any) -> Scenario:
        """A scenario, or the one that comes with the package under a name, with some fields changed."""
        if isinstance(scenario, str):
            return cls.named(scenario, **changes)
        if not isinstance(scenario, Scenario):
            raise InputError(f"scenario is a {type(scenario).__name__}, want a Scenario or the name of one")
        return scenario.replace(**changes)

    @classmethod
    def on_lot(cls, lot: ParkingLot, occupancy: OccupancyModel | None = None, **fields: Any) -> Self:
        """A scenario on any lot, with a typical day's occupancy where none is given."""
        goal = fields.get("goal", 0)
        return cls(name=lot.name, lot=lot, occupancy=occupancy or typical_occupancy(lot, goal=goal), **fields)


# Logit of how much a weekday's hour asks for; the shape is that of a campus lot: empty at night, full
# from mid-morning to mid-afternoon.
_WEEKDAY_DEMAND = np.array(
    [
        *(-4.0, -4.0, -4.0, -4.0, -4.0, -3.5, -2.5, -0.8, 0.6, 1.3, 1.7, 1.9),
        *(1.8, 1.7, 1.7, 1.5, 1.1, 0.2, -0.8, -1.6, -2.2, -2.8, -3.4, -3.8),
    ]
)
_WEEKEND_DEMAND = np.full(24, -2.5)
_WEEK_DEMAND = np.concatenate([np.tile(_WEEKDAY_DEMAND, 5), np.tile(_WEEKEND_DEMAND, 2)])


def typical_occupancy(
    lot: ParkingLot,
    *,
    goal: int = 0,
    pull: float = 1.6,
    unevenness: float = 0.6,
    demand: float = 0.0,
    mean_stay_s: float = 2 * 3600.0,
) -> OccupancyProcess:
    """A working week on any lot: full by day, empty by night, and the nearer to the goal the fuller.

    Args:
        lot: the lot.
        goal: index of the goal that draws people.
        pull: logits by which the nearest slot is asked for more, and the farthest less, than the middle.
        unevenness: standard deviation, in logits, of what makes equally near slots differ. It is drawn
            from a fixed seed: the same lot always has the same good and bad slots.
        demand: logits added at every hour.
        mean_stay_s: how long a car stays, s.
    """
    walk = lot.walk_m(goal)
    span = float(np.ptp(walk)) or 1.0
    nearness = 1.0 - 2.0 * (walk - walk.min()) / span
    noise = np.random.default_rng(lot.n_slots).normal(0.0, unevenness, lot.n_slots)
    return OccupancyProcess.from_demand(pull * nearness + noise, _WEEK_DEMAND + demand, mean_stay_s)


def _campus() -> dict[str, Any]:
    lot = packaged_lot("campus")
    return {"lot": lot, "occupancy": typical_occupancy(lot, pull=2.5, demand=0.3)}


def _jam() -> dict[str, Any]:
    # The map knows ordinary days; today an event has filled whatever lies near the goal.
    lot = packaged_lot("jam")
    usual = typical_occupancy(lot, pull=1.0, demand=-0.3)
    walk = lot.walk_m()
    near = walk < np.quantile(walk, 0.75)
    jammed = dataclasses.replace(usual, arrival_factor=usual.arrival_factor * np.where(near, 200.0, 1.0))
    return {"lot": lot, "occupancy": jammed, "prior": usual}


def _street() -> dict[str, Any]:
    lot = packaged_lot("street")
    return {"lot": lot, "occupancy": typical_occupancy(lot, pull=0.8, demand=0.8, mean_stay_s=1800.0)}


def _mini() -> dict[str, Any]:
    lot = packaged_lot("mini")
    # Ten slots are now and then all taken; there is another car park five minutes away.
    return {"lot": lot, "occupancy": typical_occupancy(lot, pull=1.0, demand=-0.8), "give_up_s": 300.0}


_NAMED: dict[str, Callable[[], dict[str, Any]]] = {
    "campus": _campus,
    "jam": _jam,
    "street": _street,
    "mini": _mini,
}

SCENARIO_NAMES = tuple(_NAMED)


def _read_only(array: NDArray[Any]) -> NDArray[Any]:
    array.flags.writeable = False
    return array


def _require_number(name: str, value: Any, *, above: float | None = None, least: float | None = None) -> None:
    want = f"above {above:g}" if above is not None else f"at least {least:g}"
    good = isinstance(value, (int, float, np.number)) and not isinstance(value, bool) and math.isfinite(value)
    if not good or (above is not None and not value > above) or (least is not None and not value >= least):
        raise InputError(f"{name} is {value!r}, want a finite number {want}")


def _require_index(name: str, value: Any, count: int) -> None:
    if not isinstance(value, (int, np.integer)) or isinstance(value, bool) or not 0 <= value < count:
        raise InputError(f"{name} is {value!r}, want an index from 0 to {count - 1}")
