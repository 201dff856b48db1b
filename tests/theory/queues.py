"""Queueing theory of a lot: Erlang's loss formula, insensitivity, and parking strategies on a half-line of slots."""

import math
from dataclasses import dataclass
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np
from closed_forms import Statement, closed_form
from line import THESIS_SPEEDS, Line
from ordered_entry import ORDERED_ENTRY, by_distance

from parkenv.compiled.jit import inlined, kernel
from parkenv.engine.fleet import DriverKind, Fleet
from parkenv.engine.policy import LEAVE, TAKE_SLOT, CompiledPolicy
from parkenv.engine.records import LEFT, PARKED, car_at, fleet_at
from parkenv.engine.search_belief import is_shared_slot_taken
from parkenv.lots.generators import grid_lot
from parkenv.world.demand import (
    ConstantTime,
    Demand,
    Duration,
    EmpiricalTime,
    ExponentialTime,
    LogNormalTime,
    PoissonArrivals,
)
from parkenv.world.scenario import Scenario
from parkenv.world.sensor_model import SensorModel
from parkenv.world.week import HOUR_S
from planners.heuristics import POLICIES

STAY_S = HOUR_S  # mean stay, s: loads are arrivals an hour
EXPONENTIAL = ExponentialTime(STAY_S)
LAWS = {
    "exponential": EXPONENTIAL,
    "constant": ConstantTime(STAY_S),
    "log-normal, cv 2": LogNormalTime(STAY_S, 2.0),
    "0.2 or 1.8 h": EmpiricalTime((0.2 * STAY_S, 1.8 * STAY_S)),
}
GREEDY = POLICIES["greedy-drive"]


def erlang_b(slots, load):
    blocked = 1.0
    for k in range(1, slots + 1):
        blocked = load * blocked / (k + load * blocked)
    return blocked


def lane(slots):
    return Line(0.5, THESIS_SPEEDS, slots - 1, 0).scenario()


class Run(NamedTuple):
    cars: Any
    begin: float
    end: float

    @property
    def since(self):
        return self.cars[self.cars["arrival"] >= self.begin]

    @property
    def over(self):
        return self.since[self.since["ended_at"] <= self.end]

    def refused(self):
        return float(1.0 - np.isin(self.over["state"], (PARKED, LEFT)).mean())

    def mean_parked(self, n_slots):
        """Return the share of the window's time that cars stood in each slot, (n_slots,)."""
        parked = self.cars[self.cars["slot"] >= 0]
        begin, end = self.begin, self.end
        inside = np.clip(parked["left_at"], begin, end) - np.clip(parked["ended_at"], begin, end)
        return np.bincount(parked["slot"], inside, n_slots) / (end - begin)


@dataclass(frozen=True)
class Queue:
    scenario: Scenario
    policy: CompiledPolicy
    load: float
    runs: int
    warm_up_h: float
    hours: float  # h of arrivals
    stay: Duration = EXPONENTIAL

    def samples(self, measure, seed=0):
        demand = Demand(PoissonArrivals(self.load, 0.0, self.hours * HOUR_S), self.stay)
        fleet = Fleet(self.scenario, demand, background="none", drivers=(DriverKind(policy=self.policy),))
        measured = []
        for episode in range(self.runs):
            fleet.reset(seed, episode)
            end = fleet.begin + self.hours * HOUR_S
            fleet.run(until=end)
            measured.append(measure(Run(fleet.cars, fleet.begin + self.warm_up_h * HOUR_S, end)))
        return measured

    def mean_taken(self):
        n_slots = self.scenario.lot.n_slots
        return self.samples(lambda run: run.mean_parked(n_slots).sum())


ENTRY_SLOTS, ENTRY_LOAD = 24, 5.0  # the lot is full for one car in 10^9


@cache
def entries(policy=ORDERED_ENTRY):
    n = ENTRY_SLOTS
    queue = Queue(lane(n), policy, ENTRY_LOAD, 70, 10.0, 400.0)
    found = queue.samples(lambda run: [*run.mean_parked(n)[::-1], (n - run.since["slot"]).mean()])
    return np.array(found)


@closed_form("Ordered entry", "Erlang 1917; Cooper 1981, ordered hunting")
def ordered_entry(policy=ORDERED_ENTRY):
    r"""Cars arrive as a Poisson process, \(A\) of them in a mean stay, and each takes the nearest free slot at once.
    Whatever happens further away, a car enters one of the nearest \(k\) slots unless all are taken. So these are a
    loss system of their own, all taken with probability \(B(k, A) = (A^k/k!)/\sum_{j\le k} A^j/j!\), and they
    carry \(A(1 - B(k, A))\) cars; slot \(k\) alone carries \(A\,[B(k-1, A) - B(k, A)]\). Poisson arrivals see time
    averages, so the mean index of a car's slot is \(\sum_{k\ge0} B(k, A)\). This is also the *optimistic* strategy
    of Krapivsky and Redner (2019).
    """
    n, load = ENTRY_SLOTS, ENTRY_LOAD
    made = []
    for k in (1, 2, 3, 5, 8):
        carried = load * (erlang_b(k - 1, load) - erlang_b(k, load))
        case = f"A = {load:g}: slot {k} is taken"
        made.append(Statement(case, carried, lambda k=k: entries(policy)[:, k - 1]))
    case, mean = f"A = {load:g}: mean index of a car's slot", sum(erlang_b(k, load) for k in range(n))
    return [*made, Statement(case, mean, lambda: entries(policy)[:, n])]


@closed_form("The law of the stay", "Sevast'yanov 1957; Little 1961, M/G/∞")
def stays():
    r"""The number of slots taken depends on the stay's law through its mean only: Poisson with mean \(A\) in a lot
    that is never full, and \(A(1 - B(c, A))\) in the mean in a lot of \(c\) slots that turns cars away. The first
    is seen with 60 slots in which `greedy-drive` drives and searches, the second with five slots and ordered
    entry.
    """
    lot = grid_lot(4, 15)
    wide = lane(1).replace(lot=lot, occupancy=lane(lot.n_slots).occupancy)
    small = 5.0 * (1.0 - erlang_b(5, 5.0))
    made = []
    for law, stay in LAWS.items():
        for slots, expected, queue in (
            (5, small, Queue(lane(5), ORDERED_ENTRY, 5.0, 70, 30.0, 300.0, stay)),
            (60, 30.0, Queue(wide, GREEDY, 30.0, 12, 30.0, 100.0, stay)),
        ):
            case = f"{slots} slots, A = {queue.load:g}, stays {law}: mean number taken, {queue.policy.name}"
            made.append(Statement(case, expected, queue.mean_taken))
    return made


@closed_form("Cars turned away", "Erlang 1917")
def blocking():
    r"""The number of cars \(N\) in \(c\) slots goes up at rate \(A\) per mean stay and down at rate \(N\): detailed
    balance makes \(P(N = n)\) proportional to \(A^n/n!\), and \(B(c, A)\) of the cars find the lot full, whatever
    the law of the stay. `greedy-drive` has to prove it full; there, all slots are in view and the drive takes no
    time.
    """
    at_once = lane(10)
    driven = at_once.replace(lot=grid_lot(2, 5), v_drive=1e4, sensor_model=SensorModel(view_range=1e3))
    return [
        Statement(
            f"10 slots, A = 8, stays {law}: cars turned away, {policy.name}",
            erlang_b(10, 8.0),
            partial(Queue(scenario, policy, 8.0, 70, 10.0, 300.0, LAWS[law]).samples, Run.refused),
        )
        for scenario, policy, law in (
            (at_once, ORDERED_ENTRY, "exponential"),
            (at_once, ORDERED_ENTRY, "log-normal, cv 2"),
            (driven, GREEDY, "exponential"),
        )
    ]


# Strategies of Krapivsky and Redner on a half-line of slots k = 1, 2, ... from the goal

ZONE_LOAD, ZONE_SLOTS = 200, 300
_BEST, _OTHER = 1, 0  # what a driver of a threshold strategy notes in the field `n_moves` of its CAR record


@kernel
def decide_meek(address, number):
    fleet = fleet_at(address, 0)
    slots, behind = by_distance(fleet, car_at(fleet.cars, number)), fleet.n_slots
    while behind > 0 and not is_shared_slot_taken(address, slots[behind - 1], fleet.time):
        behind -= 1
    return int(TAKE_SLOT + slots[behind]) if behind < fleet.n_slots else LEAVE


@inlined
def _take_first_of_zone(address, number, zone):
    fleet = fleet_at(address, 0)
    car = car_at(fleet.cars, number)
    slots = by_distance(fleet, car)
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
def decide_quarter(address, number):
    return int(_take_first_of_zone(address, number, ZONE_LOAD // 4))


@kernel
def decide_half(address, number):
    return int(_take_first_of_zone(address, number, ZONE_LOAD // 2))


@kernel
def decide_three_quarters(address, number):
    return int(_take_first_of_zone(address, number, 3 * ZONE_LOAD // 4))


MEEK = CompiledPolicy("meek", decide_meek)
THRESHOLDS = {
    tau: CompiledPolicy(f"threshold {tau:g}", decide)
    for tau, decide in ((0.25, decide_quarter), (0.5, decide_half), (0.75, decide_three_quarters))
}


@closed_form("Strategies on the half-line", "Krapivsky & Redner 2019 and 2020")
def strategies():
    r"""In *Simple parking strategies* (2019), *meek* drivers park right behind the most distant parked car. The slot
    at the goal is taken only by cars that find the lot empty. The number of cars is Poisson, so these are a share
    \(e^{-A}\) of arrivals, and by Little's law that slot is taken with probability \(A e^{-A}\), however many want
    it.

    In *Where should you park your car? The ½ rule* (2020), a driver passes all slots except those of a zone next
    to the goal and takes the first free one there; if there is none, it turns back. It gets the best slot of the
    zone, without turning back, if and only if exactly one is free. The zone of \(m\) slots takes every car unless
    it is full, a loss system again, so exactly one of its slots is free with probability \((m/A)\,B(m, A)\). With
    \(m = \tau A\) and \(A \to \infty\) this is \(\tau(1-\tau)\), greatest at \(\tau = \frac12\).
    """
    made = []
    for load in (0.5, 1.0, 2.0):
        queue = Queue(lane(200), MEEK, load, 100, 15.0, 800.0)
        found = partial(queue.samples, lambda run: run.mean_parked(200)[-1])
        case = f"meek drivers, A = {load:g}: the slot at the goal is taken"
        made.append(Statement(case, load * math.exp(-load), found))
    for tau, policy in THRESHOLDS.items():
        queue = Queue(lane(ZONE_SLOTS), policy, ZONE_LOAD, 12, 15.0, 100.0)
        found = partial(queue.samples, lambda run: (run.since["n_moves"] == _BEST).mean())
        case = f"threshold {tau:g}, A = {ZONE_LOAD}: gets the best slot of the zone"
        made.append(Statement(case, tau * erlang_b(round(tau * ZONE_LOAD), ZONE_LOAD), found))
    return made
