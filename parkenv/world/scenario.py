"""Scenarios: a lot, its occupancy, the goal, speeds and costs."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from parkenv.compiled.arrays import FloatArray
from parkenv.errors import InputError, require_keywords, require_number
from parkenv.world.lot import ACTIONS, PARK, ParkingLot
from parkenv.world.occupancy.arrival_window import ArrivalWindow
from parkenv.world.occupancy.process import Arrival, Forecast, OccupancyModel, PriorModel
from parkenv.world.sensor_model import SensorModel, SensorRates
from parkenv.world.tariff import HOUR_S, VALUE_OF_TIME, Tariff
from parkenv.world.traffic import Traffic

KMH = 1 / 3.6  # 1 km/h in m/s

EDGE = np.dtype([("target", np.int64), ("seconds", np.float64), ("metres", np.float64)], align=True)
"""Result of an action at a vertex: the vertex that it leads to, s, m.

Parking, and actions that the graph does not have, lead back to the same vertex.
"""


@dataclass(frozen=True, eq=False, kw_only=True)
class SearchProblem:
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

    Raises:
        InputError: a value out of its range; the message names the field.
    """

    lot: ParkingLot
    goal: int = 0
    v_drive: float = 10 * KMH
    v_walk: float = 4 * KMH
    failure_s: float = 10.0
    wait_s: float = 1.0
    give_up_s: float = 1800.0
    sensor_model: SensorModel = field(default_factory=SensorModel)
    tariff: Tariff = field(default_factory=Tariff)
    stay_s: float = HOUR_S
    value_of_time: float = VALUE_OF_TIME

    def __post_init__(self) -> None:
        if not isinstance(self.lot, ParkingLot):
            raise InputError(f"lot is a {type(self.lot).__name__}, want a ParkingLot")
        if not isinstance(self.sensor_model, SensorModel):
            raise InputError(f"sensor_model is a {type(self.sensor_model).__name__}, want a SensorModel")
        _require_index("goal", self.goal, len(self.lot.goals))
        if not isinstance(self.tariff, Tariff):
            raise InputError(f"tariff is a {type(self.tariff).__name__}, want a Tariff")
        self.tariff.require_zones(self.lot.zones, self.lot.name)
        for name in ("v_drive", "v_walk", "wait_s", "value_of_time"):
            require_number(name, getattr(self, name), above=0.0)
        for name in ("failure_s", "give_up_s", "stay_s"):
            require_number(name, getattr(self, name), least=0.0)

    @cached_property
    def walk_s(self) -> FloatArray:
        """Walk from each slot to the goal, (n_slots,) s (eq. 3.25)."""
        return _read_only(self.lot.walk_m(self.goal) / self.v_walk)

    @cached_property
    def arrival_cost_s(self) -> FloatArray:
        """Cost of arriving in each slot, (n_slots,) s: walk plus parking cost."""
        return _read_only(self.walk_s + self.parking_cost_s)

    @cached_property
    def parking_cost_s(self) -> FloatArray:
        """Parking cost of each slot as time, (n_slots,) s: that of the lot, and the price of the expected stay."""
        return _read_only(self.parking_cost_of(self.stay_s))

    def parking_cost_of(self, stay_s: FloatArray | float) -> FloatArray:
        """Return what stays of the driver cost in each slot, (..., n_slots) s: that of the lot, and the price."""
        return self.lot.slot_parking_cost_s + self.zone_cost_s(stay_s)[..., self.lot.zone_of_slot]

    def zone_cost_s(self, stay_s: FloatArray | float) -> FloatArray:
        """Return what stays of the driver cost in each of the lot's zones, (..., n_zones) s.

        That is the price divided by the value of time; agents plan on it, and the reward charges it.

        Args:
            stay_s: (...) s, lengths of the stays.
        """
        return self.tariff.amounts(self.lot.zones, stay_s) * (HOUR_S / self.value_of_time)

    @property
    def is_priced(self) -> bool:
        """Whether slots have prices or parking costs."""
        return bool(self.tariff) or bool(self.lot.slot_parking_cost_s.any())

    @cached_property
    def move_s(self) -> FloatArray:
        """Drive time of each edge, (n_vertices, 4) s; 0 where there is none (eq. 3.22)."""
        return _read_only(self.lot.edge_length / self.v_drive)

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
        """(n_vertices, 5), 1 if the graph has the action: an edge to drive along, or a slot to park in."""
        masks = np.zeros((self.lot.n_vertices, len(ACTIONS)), dtype=np.int8)
        masks[:, :PARK] = self.lot.neighbors >= 0
        masks[: self.lot.n_slots, PARK] = 1
        return _read_only(masks)

    @cached_property
    def slots_in_view(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Slots in view, as (starts, slots): for vertex v `slots[starts[v]:starts[v + 1]]`, ascending."""
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

    def in_view(self, vertex: int) -> NDArray[np.int64]:
        """Return the slots in view of a vertex, ascending."""
        starts, slots = self.slots_in_view
        return slots[starts[vertex] : starts[vertex + 1]]

    @cached_property
    def sight_lines(self) -> tuple[FloatArray, NDArray[np.bool_]]:
        """Distance, m, of each of `slots_in_view`, and whether it is beside the car.

        Distances are between vertices, like the view range. A slot is beside a car at a slot's vertex if it lies to the
        right, within 45° of the perpendicular.
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
        """Sensor rates for each of `slots_in_view`."""
        return SensorRates(*map(_read_only, self.sensor_model.rates(*self.sight_lines)))

    def public(self) -> SearchProblem:
        """Return the part that agents may know."""
        return self

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
        entry: index into `lot.entries`; None draws one for each search.
        traffic: other road users in the lot, visible to simulated sensors and on driven trips.
        rig: name of the car's sensor rig, where sensors are simulated.
        detector: name of the car's detector there, as `parkenv.perception.detector_registry.make_detector` takes it.
    """

    name: str
    occupancy: OccupancyModel
    prior: PriorModel | None = None
    arrival: ArrivalWindow = field(default_factory=ArrivalWindow)
    entry: int | None = None
    traffic: Traffic = field(default_factory=Traffic)
    rig: str = "laser"
    detector: str = "hog"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.entry is not None:
            _require_index("entry", self.entry, len(self.lot.entries))
        if not isinstance(self.traffic, Traffic):
            raise InputError(f"traffic is a {type(self.traffic).__name__}, want a Traffic")
        if not isinstance(self.arrival, ArrivalWindow):
            raise InputError(f"arrival is {self.arrival!r:.60}, want an ArrivalWindow")
        for name in ("occupancy", "prior"):
            model = getattr(self, name)
            if model is not None and model.n_slots != self.lot.n_slots:
                raise InputError(
                    f"{name} is for {model.n_slots} slots, lot {self.lot.name!r} has {self.lot.n_slots}"
                )

    def public(self) -> SearchProblem:
        """Return the part that agents may know: without the occupancy, its forecast model and the traffic."""
        return SearchProblem(**{f.name: getattr(self, f.name) for f in dataclasses.fields(SearchProblem)})

    def forecast(self, arrival: Arrival) -> Forecast:
        """Return the forecast for a search that starts at the arrival."""
        return (self.prior or self.occupancy).forecast(arrival)


def _read_only(array: NDArray[Any]) -> NDArray[Any]:
    array.flags.writeable = False
    return array


def _require_index(name: str, value: Any, count: int) -> None:
    if not isinstance(value, (int, np.integer)) or isinstance(value, bool) or not 0 <= value < count:
        raise InputError(f"{name} is {value!r}, want an index from 0 to {count - 1}")
