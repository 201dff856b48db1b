"""Theory of towns: counted garages, cruising beside a garage, equilibrium of flows, search on a network of streets."""

import dataclasses
from functools import cache, partial

import numpy as np
from closed_forms import Statement, closed_form
from queues import EXPONENTIAL, Queue, Run, erlang_b, lane
from scipy.optimize import brentq
from scipy.sparse import diags_array, eye_array
from scipy.sparse.linalg import spsolve
from small_lots import driven, features

from parkenv.belief.slot_belief import OBSERVED_FREE
from parkenv.compiled.jit import kernel
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
from parkenv.engine.records import fleet_at
from parkenv.lots.generators import city_lot, kerb_rows
from parkenv.scenarios.build import make_scenario
from parkenv.world.demand import ConstantTime, Demand, Headways, PoissonArrivals
from parkenv.world.facility import Facility
from parkenv.world.lot import PARK, Lane, ParkingLot
from parkenv.world.occupancy.process import OccupancyProcess
from parkenv.world.tariff import Price, Zone
from parkenv.world.week import HOUR_S, WEEK_HOURS

HUGE = 100_000  # spaces of a garage that is never full
DAY_S = 8 * HOUR_S
WARM_UP_S = 2 * HOUR_S  # of each day, which does not count
LAST_S = 0.5 * HOUR_S  # of each day, in which nobody arrives


def beside(scenario, *facilities, **changes):
    lot = ParkingLot(**features(scenario.lot) | {"facilities": facilities} | changes)
    return scenario.replace(lot=lot, occupancy=lane(lot.n_slots).occupancy)


def on_lane(*garages):
    xy = tuple(lane(1).lot.vertex_xy[0].tolist())
    return beside(lane(1), *(Facility(f"G{i}", "garage", xy=xy, **its) for i, its in enumerate(garages)))


def md1_wait_s(per_hour, gate_s):
    rho = per_hour * gate_s / HOUR_S
    return rho * gate_s / (2.0 * (1.0 - rho))


@kernel
def decide_garage(address, number):
    search = search_of(car_of(address, number).search)
    if search.failed_parks > 0:
        return LEAVE
    return int(TAKE_SLOT + fleet_at(address, 0).n_slots - 1)


@closed_form("A garage and its barrier", "Erlang 1917; Pollaczek 1930, Khinchine 1932")
def garage():
    r"""A counted garage of \(c\) spaces refuses \(B(c, A)\) of the cars. A barrier that takes \(g\) for each car is a
    queue M/D/1: cars that come at rate \(\lambda\) wait for \(\lambda g^2 / (2(1 - \lambda g))\) in the mean.
    """
    policy = CompiledPolicy("garage", decide_garage)
    full = Queue(on_lane({"capacity": 30}), policy, 25.0, 30, 10.0, 100.0)
    barrier = Queue(on_lane({"capacity": HUGE, "gate_s": 20.0}), policy, 130.0, 30, 2.0, 20.0)
    return [
        Statement("30 spaces, A = 25: cars refused", erlang_b(30, 25.0), partial(full.samples, Run.refused)),
        Statement(
            "barrier of 20 s, 130 cars an hour: wait before it, s",
            md1_wait_s(130.0, 20.0),
            partial(barrier.samples, lambda run: run.over["queued_s"].mean()),
        ),
    ]


# Drivers who choose

CHOICE = np.dtype([("share", np.float64), ("first", np.int64), ("second", np.int64)], align=True)
"""Share of the cars that choose the first facility; slots of the two counted facilities; -1: the kerb."""
_choice_at = record_at(CHOICE)
_KERB = -1


@kernel
def decide_choice(address, number):
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
    def __init__(self, first, second):
        super().__init__("choice", decide_choice)
        self.data = PolicyData(CHOICE, {"share": 0.5, "first": first, "second": second}, {})

    def data_for(self, problems):
        return self.data


def settle(scenario, first, per_hour, stay, days, slow_s):
    """Let drivers choose between two facilities, the second the last one of the lot, from day to day.

    A difference of costs of `slow_s` s moves them at full speed. Returns the share of the first and the mean drive to
    it, s, of each day of the second half, (2, days / 2).
    """
    second = scenario.lot.n_slots - 1
    policy = ChoicePolicy(first, second)
    demand = Demand(PoissonArrivals(per_hour, 0.0, DAY_S - LAST_S), stay)
    kind = DriverKind(policy=policy)
    fleet = Fleet(scenario, demand, background="none", drivers=(kind,), leave_full_lot=False)
    share, days_so_far = 0.5, []
    for day in range(days):
        policy.data.record["share"] = share
        fleet.reset(0, day)
        fleet.run(until=fleet.begin + DAY_S)
        counts = (fleet.cars["arrival"] >= fleet.begin + WARM_UP_S) & (fleet.cars["slot"] >= 0)
        cars = fleet.cars[counts & (fleet.cars["ended_at"] < np.inf)]
        chose = cars["slot"] == first if first != _KERB else cars["slot"] != second
        cost_s = [cars["total_s"][which].mean() for which in (chose, ~chose)]
        days_so_far.append((share, cars["drive_s"][chose].mean()))
        # Smaller and smaller steps at first, then equal ones: what is left is the noise of single days.
        gain = max(1.0 / (day + 3.0), 0.02)
        step = np.clip((cost_s[0] - cost_s[1]) / slow_s, -1.0, 1.0)
        share = float(np.clip(share - gain * step, 0.02, 0.98))
    return np.array(days_so_far[days // 2 :]).T


@closed_form("A cheap kerb beside a dear garage", "Shoup 2006; Arnott & Inci 2006")
def cruising():
    r"""Cars that choose the kerb of a ring of streets cruise until a space is free. From day to day, drivers switch to
    the option with the lower total, until no driver gains: then they cruise for as long as the garage costs more,
    difference of prices × stay / value of time.
    """
    stay_s, kerb, dear, value = 900.0, 1.0, 3.0, 12.0
    angle = np.linspace(0.0, 2.0 * np.pi, 61)
    ring = 25.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    slots, _ = kerb_rows(ring[:-1], ring[1:], np.zeros(60, bool), (2.5, 2.0))
    rules = {name: Zone(name, Price(per_hour=price)) for name, price in (("kerb", kerb), ("garage", dear))}
    scenario = beside(
        lane(1).replace(v_drive=5.0, value_of_time=value, stay_s=stay_s),
        Facility("garage", "garage", "garage", capacity=HUGE, xy=tuple(ring[0].tolist())),
        slot_ids=tuple(map(str, range(len(slots)))),
        **slots.columns()
        | {"slot_zone": np.full(len(slots), "kerb"), "slot_facility": np.full(len(slots), "")},
        lanes=(Lane(ring, oneway=True),),
        entries=ring[:1],
        goals=np.zeros((1, 2)),
        zone_rules=rules,
    )
    per_hour = 1.6 * len(slots) * HOUR_S / stay_s
    return [
        Statement(
            f"kerb {kerb:g}/h, garage {dear:g}/h, stay {stay_s / 60:g} min, value of time {value:g}/h: cruising, s",
            (dear - kerb) * stay_s / value,
            lambda: settle(scenario, _KERB, per_hour, ConstantTime(stay_s), 120, 120.0)[1],
            slow=True,
        )
    ]


@closed_form("Two garages, one choice", "Wardrop 1952; Pollaczek-Khinchine")
def split():
    r"""Drivers indifferent between two garages, whose barriers take \(g\) and \(h\) for each car, split so that the
    time before both barriers, of M/D/1, is the same. The share follows the costs of single days: it has a
    tolerance.
    """
    per_hour, gates = 150.0, (20.0, 32.0)
    scenario = on_lane(*({"capacity": HUGE, "gate_s": gate} for gate in gates))

    def difference_s(share):
        parts = zip((share, 1.0 - share), gates, strict=True)
        return -np.diff([gate + md1_wait_s(part * per_hour, gate) for part, gate in parts])[0]

    return [
        Statement(
            f"barriers of {gates[0]:g} and {gates[1]:g} s, {per_hour:g} cars an hour: share at the first",
            float(brentq(difference_s, 0.3, 0.99)),
            lambda: settle(scenario, scenario.lot.n_slots - 2, per_hour, EXPONENTIAL, 400, 20.0)[0].mean(),
            0.005,
        )
    ]


# Search on a network of streets


@kernel
def decide_walk(address, number):
    search = search_of(car_of(address, number).search)
    if is_allowed(search, PARK) and recent_state(search, search.vertex) == OBSERVED_FREE:
        return PARK
    move = draw_action(search, PARK)
    return LEAVE if move < 0 else int(move)


def walk_time_s(problem, taken):
    lot, neighbors = problem.lot, problem.lot.neighbors
    turns, phi = 1.0 / (neighbors >= 0).sum(axis=1), np.ones(lot.n_vertices)
    phi[: lot.n_slots] = taken
    links = lot.drive_matrix()
    links.data[:] = 1.0
    chain = diags_array(turns) @ links
    next_s = turns * problem.move_s.sum(axis=1)
    times = spsolve((eye_array(lot.n_vertices) - chain @ diags_array(phi)).tocsc(), next_s)
    return float(times[lot.entry_vertices[0]])


@cache
def renewed(taken):
    lot = city_lot(400, 0)
    odds = np.full(lot.n_slots, np.log(taken / (1.0 - taken)))
    occupancy = OccupancyProcess.from_demand(odds, np.zeros(WEEK_HOURS), 1.0)
    scenario = make_scenario(lot).replace(occupancy=occupancy)
    return scenario.replace(sensor_model=dataclasses.replace(scenario.sensor_model, view_range=0.0))


def walks_s(taken, cars=1000):
    drivers = (DriverKind(policy=CompiledPolicy("walk", decide_walk)),)
    demand = Demand(Headways(cars, 1.0), ConstantTime(1e-3))
    limits = {"max_steps": 10**6, "leave_full_lot": False}
    fleet = Fleet(renewed(taken), demand, background="process", drivers=drivers, **limits)
    return driven(fleet, 0).cars["drive_s"]


@closed_form(
    "Search on a network of streets",
    "Bulckaen & Nicolas 2023, [2304.05062](https://arxiv.org/abs/2304.05062)",
)
def network():
    r"""A car takes any of the lanes at each vertex, all with equal probability, and the first free slot. With the
    matrix \(P\) of its turns, the drives \(t\) and the probability \(\varphi\) that a vertex offers no slot, the
    time from a vertex is the drive to the next one and what is left there if it has none: \(T = (I -
    P\varphi)^{-1} P t\). This assumes that the states found by a car are independent of those it found before:
    slots are renewed within a second here. Where cars stay for an hour, a car that returns finds the same cars and
    searches longer.
    """
    return [
        Statement(
            f"random turns in 400 slots, {taken:.0%} taken: search, s",
            walk_time_s(renewed(taken), taken),
            partial(walks_s, taken),
        )
        for taken in (0.7, 0.9, 0.97)
    ]
