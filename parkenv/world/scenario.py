"""Scenarios: a lot, what stands in it, where people want to go, and what time costs."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from parkenv.errors import InputError
from parkenv.world.lot import ACTIONS, PARK, ParkingLot
from parkenv.world.occupancy import (
    Arrival,
    ArrivalWindow,
    Forecast,
    OccupancyModel,
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
        """What parking in each slot costs on arrival, (n_slots,) s: the walk and the price."""
        return _read_only(self.walk_s + self.parking_cost_s)

    @property
    def parking_cost_s(self) -> FloatArray:
        """Price of each slot times the inverse value of time, (n_slots,) s."""
        return self.lot.slot_parking_cost_s

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
