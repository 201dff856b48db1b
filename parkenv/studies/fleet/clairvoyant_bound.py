"""A lower bound on the total time of a day with many cars, for any drivers and any knowledge in advance.

A schedule gives each car a slot and a time at which it parks there: not before its shortest drive, not before the
resident of the slot has left, not after the car's patience has ended, and no two cars are in one slot at a time. A car
without a slot goes elsewhere at the give-up penalty. All behaviour of drivers is such a schedule, so the total time of
the best one, which knows all arrivals and stays, bounds theirs.

The best schedule is hard to find; its Lagrangian relaxation is not. If a second in slot j at time t has the rent
π_j(t) ≥ 0, then

    Σ_i min(give-up penalty, min over j and p of p - a_i + cost_ij + ∫_p^{p+stay_i} π_j) - Σ_j ∫ π_j, where free

is a lower bound for any rents (weak duality): in a schedule, cars pay at most the rents of all seconds. Here p is
the time at which car i, which arrived at a_i, parks. Rents are constant within bins, so each minimum is exact: it lies
where the stay begins or ends at the edge of a bin, or at the earliest or latest time. Subgradient steps raise the
bound. At first all slots have the same rents, then parts of them that become ever smaller, then each slot has its own.
"""

import hashlib
import math
from typing import NamedTuple

import numpy as np

from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.compiled.jit import compiled

BIN_S = 300.0  # s, length of a bin of constant rent
LEVELS = (1, 2, 4, 8, 16, 32, 64)  # parts of the lot with the same rents, before each slot has its own
STEPS = 40  # subgradient steps at each level
WORK = 10_000_000  # parking times looked at after which a level ends
PATIENCE = 5  # steps without a better bound after which steps become shorter
_ROUNDING = 1e-9  # relative


class ParkingDay(NamedTuple):
    """Cars that arrive at a lot on a day, and when its slots become available. Times are s since the same moment."""

    arrival: FloatArray  # (n_cars,) float64, s
    stay_s: FloatArray  # (n_cars,) float64, s
    patience_s: FloatArray  # (n_cars,) float64, s, a car that parks does so within this time
    entry: IntArray  # (n_cars,) int64, row of `drive_s`
    drive_s: FloatArray  # (n_entries, n_slots) float64, s, shortest drives
    cost_s: FloatArray  # (n_slots,) float64, s, walk and parking cost without prices
    free_from: FloatArray  # (n_slots,) float64, s, when the resident has left; -inf without one, inf if it never does
    zone: IntArray  # (n_slots,) int64, column of `zone_cost_s`
    zone_cost_s: FloatArray  # (n_cars, n_zones) float64, s, price of each car's stay, at least 0
    give_up_s: float  # s, penalty of going elsewhere


def clairvoyant_bound_s(day: ParkingDay) -> float:
    # The same day is computed once in a process: the settings of an experiment share their days.
    columns = (repr(np.shape(column)).encode() + np.ascontiguousarray(column).tobytes() for column in day)
    key = hashlib.sha256(b"".join(columns)).digest()
    if key not in _BOUNDS:
        _BOUNDS[key] = _bound_s(day)
    return _BOUNDS[key]


_BOUNDS: dict[bytes, float] = {}


def _bound_s(day: ParkingDay) -> float:
    n_cars, n_slots = len(day.arrival), len(day.cost_s)
    if n_cars == 0:
        return 0.0
    begin = float(day.arrival.min())
    day = day._replace(
        arrival=day.arrival - begin,
        # It can be written to, as the others: code for both would take twice the time to compile.
        cost_s=np.array(day.cost_s),
        free_from=np.maximum(day.free_from - begin, 0.0),
    )
    target_s = float(_schedule_in_order(day))
    # A later parking would cost more than going elsewhere
    n_bins = math.floor(float((day.arrival + np.minimum(day.patience_s, day.give_up_s)).max()) / BIN_S) + 1
    # Rents end with the last bin
    day = day._replace(stay_s=np.minimum(day.stay_s, n_bins * BIN_S))
    alone_s = day.drive_s + day.cost_s
    order = np.argsort(alone_s, axis=1, kind="stable")
    rank = np.argsort(np.argsort(np.where(np.isfinite(alone_s), alone_s, 1e9).mean(axis=0), kind="stable"))
    part, rents, best_s = np.zeros(n_slots, np.int64), np.zeros((1, n_bins)), -np.inf
    for n_parts in (*(count for count in LEVELS if count < n_slots), n_slots):
        finer = rank * n_parts // n_slots
        first = np.zeros((n_parts, n_bins))
        first[finer] = rents[part]
        part = finer
        bound_s, rents = _raise_rents(day, order, part, first, target_s)
        best_s = max(best_s, float(bound_s))
    return min(best_s, target_s) * (1.0 - _ROUNDING)


@compiled(error_model="numpy")
def _schedule_in_order(day: ParkingDay) -> float:
    # Each car in order of arrival parks where it is soonest at its goal.
    total_s = 0.0
    free_from = day.free_from.copy()
    for i in range(len(day.arrival)):
        best, chosen, parks_at = day.give_up_s, -1, 0.0
        for j in range(len(day.cost_s)):
            at = max(day.arrival[i] + day.drive_s[day.entry[i], j], free_from[j])
            value = at - day.arrival[i] + day.cost_s[j] + day.zone_cost_s[i, day.zone[j]]
            if value < best and at <= day.arrival[i] + day.patience_s[i]:
                best, chosen, parks_at = value, j, at
        total_s += best
        if chosen >= 0:
            free_from[chosen] = parks_at + day.stay_s[i]
    return total_s


@compiled(error_model="numpy")
def _raise_rents(
    day: ParkingDay, order: IntArray, part: IntArray, rents: FloatArray, target_s: float
) -> tuple[float, FloatArray]:
    """Return the best lower bound, s, of some subgradient steps, and its rents, (n_parts, n_bins).

    `order` are the slots of each entry, soonest at the goal first if they were without prices; `part` is that of each
    slot; `rents`, s per s, are changed; the steps aim at the total time of a schedule, `target_s` (Polyak).
    """
    n_parts, n_bins = rents.shape
    free_s = np.zeros((n_parts, n_bins))
    for j in range(len(part)):
        for b in range(n_bins):
            free_s[part[j], b] += min(max((b + 1) * BIN_S - day.free_from[j], 0.0), BIN_S)
    paid = np.zeros((n_parts, n_bins + 1))  # rent of the time up to each edge of a bin
    used = np.zeros((n_parts, n_bins))  # s that cars are in slots of each part, minus the s that they may be
    best_s, best_rents, best_used = -np.inf, rents.copy(), used.copy()
    length, since, work = 1.0, 0, 0
    for _ in range(STEPS):
        bound_s = 0.0
        for g in range(n_parts):
            for b in range(n_bins):
                used[g, b] = -free_s[g, b]
                bound_s -= rents[g, b] * free_s[g, b]
                paid[g, b + 1] = paid[g, b] + rents[g, b] * BIN_S
        for i in range(len(day.arrival)):
            value, slot, at, looked_at = _best_place(i, order, part, rents, paid, day)
            bound_s += value
            work += looked_at
            if slot >= 0:
                _add_stay(at, at + day.stay_s[i], used[part[slot]])
        since += 1
        if bound_s > best_s:
            if bound_s > best_s + 1e-3 * (target_s - best_s):
                since = 0
            best_s = bound_s
            best_rents[:], best_used[:] = rents, used
        if work > WORK:
            break
        if since >= PATIENCE:
            # Go on from the best rents with shorter steps.
            length, since, bound_s = 0.5 * length, 0, best_s
            rents[:], used[:] = best_rents, best_used
        square = 0.0
        for g in range(n_parts):
            for b in range(n_bins):
                if rents[g, b] > 0.0 or used[g, b] > 0.0:
                    square += used[g, b] * used[g, b]
        if square == 0.0 or target_s - bound_s <= 0.0:
            break
        step = length * (target_s - bound_s) / square
        for g in range(n_parts):
            for b in range(n_bins):
                rents[g, b] = max(rents[g, b] + step * used[g, b], 0.0)
    return best_s, best_rents


@compiled(error_model="numpy")
def _best_place(
    car: int, order: IntArray, part: IntArray, rents: FloatArray, paid: FloatArray, day: ParkingDay
) -> tuple[float, int, float, int]:
    """Return the least cost with rent of a car, s, its slot, -1 for elsewhere, when it parks, and the work."""
    arrival, stay_s, entry = day.arrival[car], day.stay_s[car], day.entry[car]
    best, chosen, parks_at, work = day.give_up_s, -1, 0.0, 0
    for j in order[entry]:
        if day.drive_s[entry, j] + day.cost_s[j] >= best:
            break
        cost_s, g = day.cost_s[j] + day.zone_cost_s[car, day.zone[j]], part[j]
        # Not later than pays off without a rent
        last = arrival + min(day.patience_s[car], best - cost_s)
        at = max(arrival + day.drive_s[entry, j], day.free_from[j])
        if at > last:
            continue
        edge, end_edge = math.floor(at / BIN_S) + 1.0, math.floor((at + stay_s) / BIN_S) + 1.0
        while True:
            rent = _paid_by(at + stay_s, rents[g], paid[g]) - _paid_by(at, rents[g], paid[g])
            value = at - arrival + cost_s + rent
            work += 1
            if value < best:
                best, chosen, parks_at = value, j, at
            if rent == 0.0 or at >= last:
                break
            begins, ends = edge * BIN_S, end_edge * BIN_S - stay_s
            if begins <= ends:
                at = begins
                edge += 1.0
            else:
                at = ends
                end_edge += 1.0
            at = min(at, last)
    return best, chosen, parks_at, work


@compiled(error_model="numpy")
def _paid_by(time: float, rents: FloatArray, paid: FloatArray) -> float:
    n_bins = len(rents)
    if time >= n_bins * BIN_S:
        return float(paid[n_bins])
    b = int(time / BIN_S)
    return float(paid[b] + rents[b] * (time - b * BIN_S))


@compiled(error_model="numpy")
def _add_stay(begin: float, end: float, used: FloatArray) -> None:
    b = int(begin / BIN_S)
    while b < len(used) and b * BIN_S < end:
        used[b] += min(end, (b + 1) * BIN_S) - max(begin, b * BIN_S)
        b += 1
