"""Krapivsky and Redner's parking strategies on a half-line of slots k = 1, 2, ... from the goal.

Cars arrive at rate A and each leaves at rate 1.

*Meek* (2019): a car parks right behind the most distant parked car. The first slot is taken by cars that find the lot
empty only. The lot holds a Poisson number of cars, so a share exp(-A) of arrivals does, and by Little's law the first
slot is taken with probability A exp(-A).

*Threshold* (2020, the 1/2 rule): a car passes all slots but those of a zone next to the goal, and takes the first free
one that it meets there; if there is none it turns back. It gets the best slot of the zone, without turning back, if and
only if exactly one is free. A zone of m slots takes every car unless it is full: a loss system, in which exactly one of
m slots is free with probability (m/A)B(m, A). With m = tau A, as A grows, free slots are born at rate tau A and taken
at rate A, their number is geometric, and the probability becomes tau(1 - tau): greatest at tau = 1/2, where it is 1/4.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any

from parkenv.compiled.memory import int64s
from parkenv.engine.events import LEAVE, TAKE_SLOT
from parkenv.engine.kernel import is_shared_slot_taken
from parkenv.engine.policy import CompiledPolicy
from parkenv.engine.records import car_at, fleet_at
from parkenv.studies.verify.fleets import erlang_b, independent_runs, lane, loaded_fleet, mean_parked
from parkenv.studies.verify.rows import Row, Task, mean_row
from parkenv.world.occupancy.kernel import inlined, kernel
from parkenv.world.week import HOUR_S

MEEK_SOURCE = "Krapivsky & Redner 2019, own derivation"
RULE_SOURCE = "Krapivsky & Redner 2020"
MEEK_LOADS = (0.5, 1.0, 2.0)
MEEK_SLOTS = 200
ZONE_LOAD = 200  # A of the threshold strategies
ZONE_SLOTS = 300
WARM_UP_H = 15.0
_BEST, _OTHER = 1, 0  # what a driver of a threshold strategy notes in the field `n_moves` of its CAR record


@inlined
def _by_distance(fleet: Any, car: Any) -> Any:
    """Return the slots in order of their distance from the goal, (n_slots,) int64."""
    return int64s(fleet.by_cost + 8 * fleet.n_slots * car.place)


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


THRESHOLDS: dict[float, Any] = {0.25: decide_quarter, 0.5: decide_half, 0.75: decide_three_quarters}


def meek_row(load: float, seed: int, runs: int = 200, hours: float = 2000.0) -> list[Row]:
    """Return the row of the first slot where all cars are meek."""
    fleet = loaded_fleet(lane(MEEK_SLOTS), CompiledPolicy("meek", decide_meek), load, hours)
    taken = [
        mean_parked(cars, MEEK_SLOTS, fleet.begin + WARM_UP_H * HOUR_S, fleet.begin + hours * HOUR_S)[-1]
        for cars in independent_runs(fleet, runs, seed, hours)
    ]
    case = f"meek drivers, A = {load:g}: the slot at the goal is taken"
    return [mean_row(case, load * math.exp(-load), taken, MEEK_SOURCE)]


def threshold_row(tau: float, seed: int, runs: int = 30, hours: float = 200.0) -> list[Row]:
    """Return the row of the best slot of the zone."""
    zone = round(tau * ZONE_LOAD)
    fleet = loaded_fleet(
        lane(ZONE_SLOTS), CompiledPolicy(f"threshold {tau:g}", THRESHOLDS[tau]), ZONE_LOAD, hours
    )
    best = []
    for cars in independent_runs(fleet, runs, seed, hours):
        since = cars["arrival"] >= fleet.begin + WARM_UP_H * HOUR_S
        best.append((cars["n_moves"][since] == _BEST).mean())
    case = f"threshold {tau:g}, A = {ZONE_LOAD}: gets the best slot of the zone ({tau * (1.0 - tau):g} for large A)"
    return [mean_row(case, zone / ZONE_LOAD * erlang_b(zone, ZONE_LOAD), best, RULE_SOURCE)]


def tasks(seed: int) -> list[Task]:
    """Return the tasks of this case."""
    return [
        *(partial(meek_row, load, seed) for load in MEEK_LOADS),
        *(partial(threshold_row, tau, seed) for tau in THRESHOLDS),
    ]
