"""Queueing theory of a lot: Erlang's loss formula, insensitivity, and parking strategies on a half-line of slots.

Cars arrive as a Poisson process, A of them in a mean stay. All cases run fleets on lots that are empty at first.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray
from parkenv.compiled.memory import int64s
from parkenv.engine.fleet import DriverKind, Fleet
from parkenv.engine.kernel import is_shared_slot_taken, is_slot_open
from parkenv.engine.policy import LEAVE, TAKE_SLOT, CompiledPolicy
from parkenv.engine.records import LEFT, PARKED, car_at, fleet_at
from parkenv.lots.generators import grid_lot
from parkenv.studies.verify.line import THESIS_SPEEDS, Line
from parkenv.studies.verify.rows import Row, Task, mean_row
from parkenv.world.demand import (
    ConstantTime,
    Demand,
    Duration,
    EmpiricalTime,
    ExponentialTime,
    LogNormalTime,
    PoissonArrivals,
)
from parkenv.world.occupancy.kernel import inlined, kernel
from parkenv.world.scenario import Scenario
from parkenv.world.sensor_model import SensorModel
from parkenv.world.week import HOUR_S
from planners.heuristics import POLICIES

STAY_S = HOUR_S  # mean stay, s: loads are arrivals an hour
EXPONENTIAL = ExponentialTime(STAY_S)


def erlang_b(slots: int, load: float) -> float:
    """Return Erlang's B: the share of arrivals that find all slots taken.

    Examples:
        >>> erlang_b(1, 1.0), round(erlang_b(10, 8.0), 4)
        (0.5, 0.1217)
    """
    blocked = 1.0
    for k in range(1, slots + 1):
        blocked = load * blocked / (k + load * blocked)
    return blocked


def lane(slots: int) -> Scenario:
    """Return a lane of slots that ends at the goal: slot `slots - 1` is at the goal."""
    return Line(0.5, THESIS_SPEEDS, slots - 1, 0).scenario()


class Run(NamedTuple):
    """A run of a queue, with the window of time, s, in which it counts."""

    cars: NDArray[np.void]
    begin: float
    end: float

    @property
    def since(self) -> NDArray[np.void]:
        """The cars that arrive once the lot has filled."""
        return self.cars[self.cars["arrival"] >= self.begin]

    def mean_parked(self, n_slots: int) -> FloatArray:
        """Return the share of the window's time that cars stood in each slot, (n_slots,)."""
        parked = self.cars[self.cars["slot"] >= 0]
        begin, end = self.begin, self.end
        inside = np.clip(parked["left_at"], begin, end) - np.clip(parked["ended_at"], begin, end)
        return np.bincount(parked["slot"], inside, n_slots) / (end - begin)


@dataclass(frozen=True)
class Queue:
    """Independent runs of a lot that is empty at first: Poisson arrivals, `load` of them in a mean stay."""

    scenario: Scenario
    policy: CompiledPolicy
    load: float
    runs: int
    warm_up_h: float
    hours: float  # h of arrivals
    stay: Duration = EXPONENTIAL

    def samples(self, seed: int, measure: Callable[[Run], Any]) -> list[Any]:
        """Run each world to the end of its arrivals; return what is measured in each."""
        demand = Demand(PoissonArrivals(self.load, 0.0, self.hours * HOUR_S), self.stay)
        fleet = Fleet(self.scenario, demand, background="none", drivers=(DriverKind(policy=self.policy),))
        measured = []
        for episode in range(self.runs):
            fleet.reset(seed, episode)
            end = fleet.begin + self.hours * HOUR_S
            fleet.run(until=end)
            measured.append(measure(Run(fleet.cars, fleet.begin + self.warm_up_h * HOUR_S, end)))
        return measured

    def mean_taken(self, seed: int) -> list[float]:
        """Return the mean number of taken slots in each run."""
        n_slots = self.scenario.lot.n_slots
        return self.samples(seed, lambda run: float(run.mean_parked(n_slots).sum()))


@inlined
def _by_distance(fleet: Any, car: Any) -> Any:
    """Return the slots in order of their distance from the goal, (n_slots,) int64."""
    return int64s(fleet.by_cost + 8 * fleet.n_slots * car.place)


@kernel
def decide_ordered_entry(address: int, number: int) -> int:
    """Stand in the free slot with the lowest cost of arrival at once; if there is none, park elsewhere.

    The driver of queueing theory's ordered entry: it knows everything and drives in no time.
    """
    fleet = fleet_at(address, 0)
    slots = _by_distance(fleet, car_at(fleet.cars, number))
    for i in range(fleet.n_slots):
        if is_slot_open(address, slots[i], number, fleet.time):
            return int(TAKE_SLOT + slots[i])
    return LEAVE


ORDERED_ENTRY = CompiledPolicy("ordered-entry", decide_ordered_entry)


# Ordered entry

ERLANG = "Erlang 1917; Cooper 1981, ordered hunting"
SHOWN = (1, 2, 3, 5, 8)


def entry_rows(
    seed: int, policy: CompiledPolicy = ORDERED_ENTRY, runs: int = 200, hours: float = 1000.0
) -> list[Row]:
    """Return rows for some slots, and for the mean index of a car's slot.

    Every car takes the nearest free slot. The nearest k slots are a loss system of their own: a car enters one of them
    unless all k are taken, whatever happens further away. So they carry A(1 - B(k, A)), slot k alone the difference
    A(B(k - 1, A) - B(k, A)), and an arriving car finds the nearest k slots taken with probability B(k, A): its slot has
    the mean index sum over k >= 0 of B(k, A).
    """
    n, load = 24, 5.0  # the lot is full for one car in 10^9
    queue = Queue(lane(n), policy, load, runs, 10.0, hours)
    # The last slot of the lane is at the goal.
    found = queue.samples(seed, lambda run: (run.mean_parked(n)[::-1], (n - run.since["slot"]).mean()))
    shares = np.array([share for share, _ in found])
    case = f"ordered entry, A = {load:g}"
    made = [
        mean_row(
            f"{case}: slot {k} is taken",
            load * (erlang_b(k - 1, load) - erlang_b(k, load)),
            shares[:, k - 1],
            ERLANG,
        )
        for k in SHOWN
    ]
    expected = sum(erlang_b(k, load) for k in range(n))
    return [
        *made,
        mean_row(f"{case}: mean index of a car's slot", expected, [index for _, index in found], ERLANG),
    ]


# Blocking

FAST = 1e4  # m/s: the search takes no time


def blocking_row(
    policy: CompiledPolicy, seed: int, stay: Duration, named: str, runs: int = 200, hours: float = 600.0
) -> list[Row]:
    """Return the row of a kind of driver and a law of stays: how many cars find the lot full and go elsewhere.

    It is Erlang's B (M/M/c/c, and M/G/c/c). The number of cars N in c slots goes up at rate A (per mean stay) and down
    at rate N: detailed balance makes P(N = n) proportional to A^n/n!, and Poisson arrivals find what is there on
    average: P(N = c) = B(c, A) of them find it full.
    """
    scenario = lane(10)
    if policy is not ORDERED_ENTRY:
        # All slots are in view from everywhere, and the drive takes no time.
        sees_all = SensorModel(view_range=1e3)
        scenario = scenario.replace(lot=grid_lot(2, 5), v_drive=FAST, sensor_model=sees_all)
    queue = Queue(scenario, policy, 8.0, runs, 10.0, hours, stay)

    def blocked(run: Run) -> float:
        # Searches may be under way when the run ends.
        over = run.since[run.since["ended_at"] <= run.end]
        return float(1.0 - np.isin(over["state"], (PARKED, LEFT)).mean())

    case = f"10 slots, A = {queue.load:g}, stays {named}: cars turned away, {policy.name}"
    return [mean_row(case, erlang_b(10, queue.load), queue.samples(seed, blocked), "Erlang 1917")]


# Stays

LAWS: dict[str, Duration] = {
    "exponential": EXPONENTIAL,
    "constant": ConstantTime(STAY_S),
    "log-normal, cv 2": LogNormalTime(STAY_S, 2.0),
    "0.2 or 1.8 h": EmpiricalTime((0.2 * STAY_S, 1.8 * STAY_S)),
}


def loss_row(law: str, seed: int, runs: int = 200, hours: float = 600.0) -> list[Row]:
    """Return the row of a small lot that turns cars away.

    The number of taken slots depends on the mean of the stay alone, not on its law: A(1 - B(c, A)) in a lot that turns
    cars away (M/G/c/c, Sevast'yanov 1957).
    """
    queue = Queue(lane(5), ORDERED_ENTRY, 5.0, runs, 30.0, hours, LAWS[law])
    case = f"5 slots, A = {queue.load:g}, stays {law}: mean number taken"
    expected = queue.load * (1.0 - erlang_b(5, queue.load))
    return [mean_row(case, expected, queue.mean_taken(seed), "Sevast'yanov 1957")]


def drivers_row(law: str, seed: int, runs: int = 50, hours: float = 200.0) -> list[Row]:
    """Return the row of a lot in which cars drive and search, and that is full for one car in a million.

    In a lot that is never full the number of taken slots is Poisson with mean A, whatever the law (M/G/infinity).
    """
    lot = grid_lot(4, 15)
    scenario = lane(1).replace(lot=lot, occupancy=lane(lot.n_slots).occupancy)
    queue = Queue(scenario, POLICIES["greedy-drive"], 30.0, runs, 30.0, hours, LAWS[law])
    case = f"{lot.n_slots} slots, A = {queue.load:g}, stays {law}: mean number taken, greedy-drive"
    return [mean_row(case, queue.load, queue.mean_taken(seed), "Little 1961, M/G/infinity")]


# Strategies of Krapivsky and Redner on a half-line of slots k = 1, 2, ... from the goal

MEEK_LOADS = (0.5, 1.0, 2.0)
ZONE_LOAD = 200  # A of the threshold strategies
ZONE_SLOTS = 300
_BEST, _OTHER = 1, 0  # what a driver of a threshold strategy notes in the field `n_moves` of its CAR record


@kernel
def decide_meek(address: int, number: int) -> int:
    """Park right behind the most distant parked car."""
    fleet = fleet_at(address, 0)
    slots, behind = _by_distance(fleet, car_at(fleet.cars, number)), fleet.n_slots
    while behind > 0 and not is_shared_slot_taken(address, slots[behind - 1], fleet.time):
        behind -= 1
    return int(TAKE_SLOT + slots[behind]) if behind < fleet.n_slots else LEAVE


@inlined
def _take_first_of_zone(address: int, number: int, zone: int) -> int:
    """Take the first free slot of the zone; else the first one on the way back. Note whether it is the zone's best."""
    fleet = fleet_at(address, 0)
    car = car_at(fleet.cars, number)
    slots = _by_distance(fleet, car)
    first, count = -1, 0
    for k in range(zone - 1, -1, -1):
        if not is_shared_slot_taken(address, slots[k], fleet.time):
            if count == 0:
                first = slots[k]
            count += 1
    car.n_moves = _BEST if count == 1 else _OTHER
    if count > 0:
        return int(TAKE_SLOT + first)
    for k in range(zone, fleet.n_slots):
        if not is_shared_slot_taken(address, slots[k], fleet.time):
            return int(TAKE_SLOT + slots[k])
    return LEAVE


@kernel
def decide_quarter(address: int, number: int) -> int:
    """Threshold 1/4."""
    return int(_take_first_of_zone(address, number, ZONE_LOAD // 4))


@kernel
def decide_half(address: int, number: int) -> int:
    """Threshold 1/2."""
    return int(_take_first_of_zone(address, number, ZONE_LOAD // 2))


@kernel
def decide_three_quarters(address: int, number: int) -> int:
    """Threshold 3/4."""
    return int(_take_first_of_zone(address, number, 3 * ZONE_LOAD // 4))


MEEK = CompiledPolicy("meek", decide_meek)
THRESHOLDS: dict[float, Any] = {0.25: decide_quarter, 0.5: decide_half, 0.75: decide_three_quarters}


def meek_row(load: float, seed: int, runs: int = 200, hours: float = 2000.0) -> list[Row]:
    """Return the row of the first slot where a car parks right behind the most distant parked car.

    The first slot is taken by cars that find the lot empty only. The lot holds a Poisson number of cars, so a share
    exp(-A) of arrivals does, and by Little's law the first slot is taken with probability A exp(-A).
    """
    queue = Queue(lane(200), MEEK, load, runs, 15.0, hours)
    taken = queue.samples(seed, lambda run: run.mean_parked(200)[-1])
    case = f"meek drivers, A = {load:g}: the slot at the goal is taken"
    return [mean_row(case, load * math.exp(-load), taken, "Krapivsky & Redner 2019, own derivation")]


def threshold_row(tau: float, seed: int, runs: int = 30, hours: float = 200.0) -> list[Row]:
    """Return the row of the best slot of a zone next to the goal (the 1/2 rule).

    A car passes all slots but those of the zone, and takes the first free one that it meets there; if there is none it
    turns back. It gets the best slot of the zone, without turning back, if and only if exactly one is free. A zone of m
    slots takes every car unless it is full: a loss system, in which exactly one of m slots is free with probability
    (m/A)B(m, A). With m = tau A, as A grows, free slots are born at rate tau A and taken at rate A, their number is
    geometric, and the probability becomes tau(1 - tau): greatest at tau = 1/2, where it is 1/4.
    """
    zone = round(tau * ZONE_LOAD)
    policy = CompiledPolicy(f"threshold {tau:g}", THRESHOLDS[tau])
    queue = Queue(lane(ZONE_SLOTS), policy, ZONE_LOAD, runs, 15.0, hours)
    best = queue.samples(seed, lambda run: (run.since["n_moves"] == _BEST).mean())
    case = f"threshold {tau:g}, A = {ZONE_LOAD}: gets the best slot of the zone ({tau * (1.0 - tau):g} for large A)"
    return [mean_row(case, zone / ZONE_LOAD * erlang_b(zone, ZONE_LOAD), best, "Krapivsky & Redner 2020")]


def _blocking(seed: int) -> list[Task]:
    spread = LogNormalTime(STAY_S, 2.0)
    return [
        partial(blocking_row, ORDERED_ENTRY, seed, EXPONENTIAL, "exponential"),
        partial(blocking_row, ORDERED_ENTRY, seed, spread, "log-normal"),
        partial(blocking_row, POLICIES["greedy-drive"], seed, EXPONENTIAL, "exponential"),
    ]


CASES: dict[str, Callable[[int], list[Task]]] = {
    "entry": lambda seed: [partial(entry_rows, seed)],
    "stays": lambda seed: [partial(row, law, seed) for row in (loss_row, drivers_row) for law in LAWS],
    "blocking": _blocking,
    "strategies": lambda seed: [
        *(partial(meek_row, load, seed) for load in MEEK_LOADS),
        *(partial(threshold_row, tau, seed) for tau in THRESHOLDS),
    ],
}
"""The tasks of each case, from the first seed."""
