"""Theory of towns: counted garages, cruising beside a garage, equilibrium of flows, search on a network of streets.

Cars arrive as a Poisson process. Where drivers choose between two facilities, a share of them takes the first one, and
from day to day it moves to where the costs of the day before were lower, until they are equal: Wardrop's equilibrium.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import brentq
from scipy.sparse import diags_array, eye_array
from scipy.sparse.linalg import spsolve

from parkenv.belief.slot_belief import OBSERVED_FREE
from parkenv.compiled.arrays import FloatArray
from parkenv.compiled.memory import record_at
from parkenv.engine.fleet import DriverKind, Fleet
from parkenv.engine.policy import (
    LEAVE,
    TAKE_SLOT,
    CompiledPolicy,
    PolicyData,
    car_of,
    draw_action,
    draw_uniform,
    is_allowed,
    policy_data,
    recent_state,
    search_of,
)
from parkenv.engine.records import LEFT, PARKED, fleet_at
from parkenv.lots.generators import city_lot, kerb_rows
from parkenv.scenarios.build import make_scenario
from parkenv.studies.verify.queues import EXPONENTIAL, Queue, Run, erlang_b, lane
from parkenv.studies.verify.rows import Row, Task, certain_row, mean_row
from parkenv.world.demand import ConstantTime, Demand, Duration, Headways, PoissonArrivals
from parkenv.world.facility import Facility
from parkenv.world.lot import PARK, Lane, ParkingLot
from parkenv.world.occupancy.kernel import kernel
from parkenv.world.occupancy.process import OccupancyProcess
from parkenv.world.scenario import Scenario, SearchProblem
from parkenv.world.tariff import Price, Zone
from parkenv.world.week import HOUR_S, WEEK_HOURS

HUGE = 100_000  # spaces of a garage that is never full
DAY_S = 8 * HOUR_S
WARM_UP_S = 2 * HOUR_S  # of each day, which does not count
SHARE_TOLERANCE = 0.005  # of a share that follows the costs of single days
LAST_S = 0.5 * HOUR_S  # of each day, in which nobody arrives


def beside(scenario: Scenario, *facilities: Facility, **changes: Any) -> Scenario:
    """Return a scenario with counted facilities at its lanes, all of whose slots are free."""
    fields = {f.name: getattr(scenario.lot, f.name) for f in dataclasses.fields(ParkingLot) if f.init}
    lot = ParkingLot(**fields | {"facilities": facilities} | changes)
    return scenario.replace(lot=lot, occupancy=lane(lot.n_slots).occupancy)


# ---- a garage


def garage_rows(
    seed: int, capacity: int = 30, load: float = 25.0, runs: int = 60, hours: float = 200.0
) -> list[Row]:
    """Return the rows of a garage: cars that it refuses, Erlang's B, and the time before its barrier.

    A barrier that takes g for each car is a queue M/D/1: cars wait for lambda g^2 / (2 (1 - lambda g)) in the mean
    (Pollaczek and Khinchine).
    """
    xy = tuple(lane(1).lot.vertex_xy[0].tolist())
    full = beside(lane(1), Facility("garage", "garage", capacity=capacity, xy=xy))
    closed = CompiledPolicy("garage", decide_garage)
    queue = Queue(full, closed, load, runs, 10.0, hours)

    def refused(run: Run) -> float:
        over = run.since[run.since["ended_at"] <= run.end]
        return float(1.0 - np.isin(over["state"], (PARKED, LEFT)).mean())

    gate_s, per_hour = 20.0, 130.0
    gate = beside(lane(1), Facility("garage", "garage", capacity=HUGE, xy=xy, gate_s=gate_s))
    barrier = Queue(gate, closed, per_hour, runs // 2, 2.0, hours / 10)
    rho = per_hour * gate_s / HOUR_S
    waits = barrier.samples(seed, lambda run: run.since["queued_s"][run.since["ended_at"] <= run.end].mean())
    return [
        mean_row(
            f"garage of {capacity}, A = {load:g}, exponential stays: cars refused",
            erlang_b(capacity, load),
            queue.samples(seed, refused),
            "Erlang 1917",
        ),
        mean_row(
            f"barrier of {gate_s:g} s, {per_hour:g} cars an hour: wait before it, s",
            rho * gate_s / (2.0 * (1.0 - rho)),
            waits,
            "Pollaczek 1930, Khinchine 1932",
        ),
    ]


@kernel
def decide_garage(address: int, number: int) -> int:
    """Drive into the last facility at once; leave if it is full."""
    car = car_of(address, number)
    search = search_of(car.search)
    if search.failed_parks > 0:
        return LEAVE
    return int(TAKE_SLOT + fleet_at(address, 0).n_slots - 1)


# ---- drivers who choose

CHOICE = np.dtype([("share", np.float64), ("first", np.int64), ("second", np.int64)], align=True)
"""Share of the cars that choose the first facility; slots of the two counted facilities; -1: the kerb."""
_choice_at = record_at(CHOICE)
_KERB = -1
_UNDECIDED = -1


@kernel
def decide_choice(address: int, number: int) -> int:
    """Choose one of two facilities; at the kerb, drive on until a slot is free."""
    car = car_of(address, number)
    choice, search = _choice_at(policy_data(address, car), 0), search_of(car.search)
    if search.n_steps == 0:
        slot = choice.first if draw_uniform(search) < choice.share else choice.second
        if slot != _KERB:
            return int(TAKE_SLOT + slot)
    if is_allowed(search, PARK) and recent_state(search, search.vertex) == OBSERVED_FREE:
        return PARK
    for move in range(PARK):
        if is_allowed(search, move):
            return move
    return LEAVE


class ChoicePolicy(CompiledPolicy):
    """Drivers of whom a share chooses the first of two facilities."""

    def __init__(self, first: int, second: int) -> None:
        super().__init__("choice", decide_choice)
        self.data = PolicyData(CHOICE, {"share": 0.5, "first": first, "second": second}, {})

    def data_for(self, problems: Any) -> PolicyData:
        """Return the share and the facilities."""
        del problems
        return self.data


class Settled(NamedTuple):
    """Days after the share has settled, (n,) each: the share, the costs of the two facilities, s, and what is asked."""

    share: FloatArray
    first_s: FloatArray
    second_s: FloatArray
    drive_s: FloatArray


def settle(
    scenario: Scenario,
    slots: tuple[int, int],
    per_hour: float,
    stay: Duration,
    seed: int,
    days: int,
    slow_s: float,
) -> Settled:
    """Let drivers choose between two facilities from day to day, and return the second half of the days.

    A difference of costs of `slow_s` s moves them at full speed.
    """
    first, second = slots
    policy = ChoicePolicy(first, second)
    demand = Demand(PoissonArrivals(per_hour, 0.0, DAY_S - LAST_S), stay)
    fleet = Fleet(
        scenario, demand, background="none", drivers=(DriverKind(policy=policy),), leave_full_lot=False
    )
    share, kept = 0.5, []
    for day in range(days):
        policy.data.record["share"] = share
        fleet.reset(seed, day)
        fleet.run(until=fleet.begin + DAY_S)
        cars = fleet.cars
        since = (
            (cars["arrival"] >= fleet.begin + WARM_UP_S) & (cars["slot"] >= 0) & (cars["ended_at"] < np.inf)
        )
        chose = cars["slot"] == first if first != _KERB else cars["slot"] != second
        costs = [cars["total_s"][since & which].mean() for which in (chose, ~chose)]
        kept.append((share, *costs, cars["drive_s"][since & chose].mean()))
        # Smaller and smaller steps at first, then equal ones: what is left is the noise of single days.
        gain = max(1.0 / (day + 3.0), 0.02)
        step = np.clip((costs[0] - costs[1]) / slow_s, -1.0, 1.0)
        share = float(np.clip(share - gain * step, 0.02, 0.98))
    return Settled(*np.array(kept[days // 2 :]).T)


def cruising_rows(seed: int, days: int = 120) -> list[Row]:
    """Return the row of a cheap kerb beside a dear garage.

    Cars cruise along the kerb of a ring of streets until a space is free. In equilibrium nobody gains by the other
    choice: the mean time that they cruise is worth what the garage costs more, difference of prices x stay / value of
    time (Shoup 2006; Arnott and Inci 2006).
    """
    stay_s, kerb, garage, value = 900.0, 1.0, 3.0, 12.0
    angle = np.linspace(0.0, 2.0 * np.pi, 61)
    ring = 25.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    slots, _ = kerb_rows(ring[:-1], ring[1:], np.zeros(60, bool), (2.5, 2.0))
    zones = {"kerb": Zone("kerb", Price(per_hour=kerb)), "garage": Zone("garage", Price(per_hour=garage))}
    base = lane(1).replace(v_drive=5.0, value_of_time=value, stay_s=stay_s)
    made = beside(
        base,
        Facility("garage", "garage", "garage", capacity=HUGE, xy=tuple(ring[0].tolist())),
        slot_ids=tuple(map(str, range(len(slots)))),
        **slots.columns()
        | {"slot_zone": np.full(len(slots), "kerb"), "slot_facility": np.full(len(slots), "")},
        lanes=(Lane(ring, oneway=True),),
        entries=ring[:1],
        goals=np.zeros((1, 2)),
        zone_rules=zones,
    )
    per_hour = 1.6 * len(slots) * HOUR_S / stay_s
    days_of = settle(made, (_KERB, made.lot.n_slots - 1), per_hour, ConstantTime(stay_s), seed, days, 120.0)
    more_s = (garage - kerb) * stay_s / value
    case = (
        f"kerb {kerb:g}/h beside a garage {garage:g}/h, stay {stay_s / 60:g} min, value of time {value:g}/h"
    )
    return [mean_row(f"{case}: cruising, s", more_s, days_of.drive_s, "Shoup 2006, Arnott & Inci 2006")]


def split_rows(seed: int, days: int = 400) -> list[Row]:
    """Return the row of drivers who do not mind which of two garages they take.

    Where the barriers take g and h for each car, the flows x and lambda - x settle where the time before both is equal,
    that of M/D/1 (Wardrop 1952).
    """
    per_hour, gates = 150.0, (20.0, 32.0)
    xy = tuple(lane(1).lot.vertex_xy[0].tolist())
    made = beside(
        lane(1),
        *(Facility(f"G{i}", "garage", capacity=HUGE, xy=xy, gate_s=gate) for i, gate in enumerate(gates)),
    )

    def time_s(share: float, gate_s: float) -> float:
        rho = share * per_hour * gate_s / HOUR_S
        return gate_s + rho * gate_s / (2.0 * (1.0 - rho))

    expected = float(brentq(lambda x: time_s(x, gates[0]) - time_s(1.0 - x, gates[1]), 0.3, 0.99))
    n = made.lot.n_slots
    found = settle(made, (n - 2, n - 1), per_hour, EXPONENTIAL, seed, days, 20.0)
    case = f"barriers of {gates[0]:g} and {gates[1]:g} s, {per_hour:g} cars an hour: share at the first"
    source = "Wardrop 1952, Pollaczek-Khinchine"
    return [certain_row(case, expected, float(found.share.mean()), source, tolerance=SHARE_TOLERANCE)]


# ---- search on a network of streets

TAKEN = (0.7, 0.9, 0.97)


@kernel
def decide_walk(address: int, number: int) -> int:
    """Park in the first free slot; else take any of the lanes, all with equal probability."""
    search = search_of(car_of(address, number).search)
    if is_allowed(search, PARK) and recent_state(search, search.vertex) == OBSERVED_FREE:
        return PARK
    move = draw_action(search, PARK)
    return LEAVE if move < 0 else int(move)


WALK = CompiledPolicy("walk", decide_walk)


def walk_time_s(problem: SearchProblem, taken: float) -> float:
    """Return the mean time until a car that turns at random finds a free slot, s, from the first entry.

    With the matrix P of its turns, the drive t of each and the probability phi of a vertex to offer no slot, the time
    from a vertex is the drive to the next one and what is left there if it has none: T = (I - P phi)^-1 P t.
    """
    lot, neighbors = problem.lot, problem.lot.neighbors
    turns, phi = 1.0 / (neighbors >= 0).sum(axis=1), np.ones(lot.n_vertices)
    phi[: lot.n_slots] = taken
    links = lot.drive_matrix()
    links.data[:] = 1.0
    chain = diags_array(turns) @ links
    next_s = turns * problem.move_s.sum(axis=1)
    times = spsolve((eye_array(lot.n_vertices) - chain @ diags_array(phi)).tocsc(), next_s)
    return float(times[lot.entry_vertices[0]])


def network_rows(seed: int, cars: int = 4000) -> list[Row]:
    """Return the rows of drivers who turn at random in a random network of streets and take the first free slot.

    The formula of Bulckaen and Nicolas (2023) assumes that what a car finds does not depend on what it has found
    before: slots change so fast here that this holds. Where cars stay for an hour, those that come round again find the
    same cars, and search longer.
    """
    lot = city_lot(400, seed)
    rows = []
    for taken in TAKEN:
        odds = np.log(taken / (1.0 - taken))
        process = OccupancyProcess.from_demand(np.full(lot.n_slots, odds), np.zeros(WEEK_HOURS), 1.0)
        scenario = make_scenario(lot).replace(occupancy=process)
        scenario = scenario.replace(sensor_model=dataclasses.replace(scenario.sensor_model, view_range=0.0))
        demand = Demand(Headways(cars, 1.0), ConstantTime(1e-3))
        fleet = Fleet(
            scenario,
            demand,
            background="process",
            drivers=(DriverKind(policy=WALK),),
            max_steps=10**6,
            leave_full_lot=False,
        )
        fleet.reset(seed)
        fleet.run()
        case = f"random turns in {lot.n_slots} slots, {taken:.0%} taken and renewed: search, s"
        rows.append(
            mean_row(case, walk_time_s(scenario, taken), fleet.cars["drive_s"], "Bulckaen & Nicolas 2023")
        )
    return rows


CASES: dict[str, Callable[[int], list[Task]]] = {
    "town": lambda seed: [
        partial(rows, seed) for rows in (garage_rows, cruising_rows, split_rows, network_rows)
    ]
}
