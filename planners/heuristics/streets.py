"""The rule of `usual`, compiled: the next street to try, by its cost and its chance of a free slot.

A *place* is a run of slots on one side of a street, between two junctions and in one zone, or a counted facility. The
rule is Pandora's (Weitzman 1979), with places as boxes that take a drive to open: a place where n slots were not
observed yet, each taken with probability p, has a free one with q = 1 - p^n, and its index is c + d / q, with the
arrival cost c and the drive d there. The driver goes to the place of the lowest index, and through it; it takes a free
slot on its way that costs no more than what is left of that index, and goes on to the next place where one is full.

p is the forecast, corrected by what the driver remembers: the odds that a slot of a zone is free are multiplied by how
many slots of it were seen free over how many were expected, with `PRIOR_PSEUDO_COUNT` added to both (the posterior mean
of a factor that has a gamma law with mean 1 beforehand). After some full streets, the next ones of the zone promise
less, and garages more.

People do the same: on the way they judge by the spaces they pass how many are still to come, and once they have missed
the goal, they search an area that grows with time (PARKAGENT: Benenson, Martens and Birfir 2008, from surveys). Here
both follow from one rule: full streets near the goal leave those farther out as the next cheapest ones, one by one,
and none is tried again while the driver remembers it.

Places are searched over junctions instead of slots, in a fraction of the time.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from parkenv.belief.slot_belief import OBSERVED_FREE, OBSERVED_TAKEN, UNOBSERVED
from parkenv.compiled.arrays import FloatArray
from parkenv.compiled.heap import pop, push
from parkenv.compiled.jit import inlined, kernel
from parkenv.compiled.memory import ADDRESS, float64_array, float64s, int32s, int64s, record_at, uint8s
from parkenv.engine.policy import (
    PolicyData,
    forecast,
    has_own_price,
    least_zone_cost_s,
    observed_column,
    search_of,
)
from parkenv.world.lot import MOVES, ParkingLot
from parkenv.world.scenario import SearchProblem
from planners.heuristics.rules import (
    GREEDY_DRIVE,
    addresses,
    choose_route,
    cost_of,
    heuristic_tables,
    state_of,
)

# Free slots, seen and expected, that stand for what a driver believes of a zone before it has seen any of it.
PRIOR_PSEUDO_COUNT = 1.0
_N_MOVES = len(MOVES)
_NONE = -1

# The streets of a lot, and work space.
STREETS = np.dtype(
    [
        # TABLES of `greedy-drive`, for where no place is left.
        ("plain", ADDRESS),
        *((name, np.int64) for name in ("n_slots", "n_zones", "n_junctions", "n_streets", "n_places")),
        # The drive graph, (n_vertices, 4): int32 vertex that each move leads to; float64 its cost, s.
        *addresses("neighbors move_s"),
        # (n_junctions, 4) int32 street that each move of a junction enters, or -1.
        *addresses("street_of"),
        # By street, one direction each: int32 junctions at its ends, as vertices; float64 its length, s; uint8 the move
        # that leaves it; (n_streets + 1,) int32 its first position among the slots, and its first place.
        *addresses("start end length_s last_move first first_place"),
        # By position, street by street in the order of the drive: int32 slot; int32 street; float64 drive from the
        # beginning of the street, s; uint8 move that leads there. By slot: int32 its position.
        *addresses("slots street_at along_s move_into position"),
        # (n_places + 1,) int32 first position of each place; (n_places,) int64 its zone; (n_goals,
        # n_places) float64 lower bound on the arrival cost of its slots, s, without and with the price of the stay.
        *addresses("place_first place_zone place_walk_s place_cost_s"),
        # (n_slots,) int64 zone of each slot.
        *addresses("zone_of_slot"),
        # By goal: (n_slots,) float64 arrival costs, s; (n_junctions,) float64, the least drive and bound from there, s.
        *addresses("arrival_cost_s onward_walk_s onward_cost_s"),
        # What the observation of an agent holds, (n_slots,): uint8 recent states, and those last observed; float64
        # P(taken), and its forecast.
        *addresses("states last_states p_occupied forecast"),
        # Of the last search: (n_zones,) float64 slots seen free, and expected free.
        *addresses("seen_free expected_free"),
        # Of the last search: by junction, float64 drive, s, inf where it did not arrive; int32 the street by which it
        # is reached, and the position on it from which that was entered, -1 for its beginning; (n_junctions + 1,)
        # int32, how many junctions it reached, and then these.
        *addresses("seconds via via_from reached"),
        # A heap: (n_streets + 8,) float64 keys, int32 junctions; how many there are, and where the driver's bounds by
        # junction are.
        *addresses("keys vertices"),
        ("n_queued", np.int64),
        ("bounds_s", ADDRESS),
        # Best place so far: its index, s; int32 position of the target, its street, position from which that is
        # entered.
        ("best_s", np.float64),
        ("best", np.int64),
        ("best_from", np.int64),
    ],
    align=True,
)
streets_at = record_at(STREETS)


def street_tables(problems: Sequence[SearchProblem]) -> PolicyData:
    lot, plain = problems[0].lot, heuristic_tables(GREEDY_DRIVE, problems, None)
    streets = streets_of(lot, np.asarray(problems[0].move_cost_s))
    n_junctions, n_streets = lot.n_vertices - lot.n_slots, len(streets["start"])
    first = streets["place_first"][:-1]
    # Rounding must not lift a bound above the cost.
    bounds = [
        np.minimum.reduceat(np.array(costs_s)[:, streets["slots"]], first, axis=1) - 1e-6
        for costs_s in (
            [problem.walk_s + lot.slot_parking_cost_s for problem in problems],
            plain.arrays["arrival_cost_s"],
        )
    ]
    walk, cost = bounds
    numbers = {
        "plain": plain.address, "n_slots": lot.n_slots, "n_zones": len(lot.zones), "n_junctions": n_junctions,
        "n_streets": n_streets, "n_places": len(first),
    }  # fmt: skip
    shared = ("neighbors", "move_s", "arrival_cost_s", "states", "p_occupied")
    arrays: dict[str, NDArray[Any]] = {
        **{name: plain.arrays[name] for name in shared},
        **streets,
        "place_zone": lot.zone_of_slot[streets["slots"][first]],
        "place_walk_s": walk,
        "place_cost_s": cost,
        "onward_walk_s": _onward(streets, lot.n_slots, walk),
        "onward_cost_s": _onward(streets, lot.n_slots, cost),
        "zone_of_slot": np.ascontiguousarray(lot.zone_of_slot, np.int64),
        "forecast": np.zeros(lot.n_slots),
        "last_states": np.full(lot.n_slots, UNOBSERVED, np.uint8),
        "seen_free": np.zeros(len(lot.zones)),
        "expected_free": np.zeros(len(lot.zones)),
        "seconds": np.full(n_junctions, np.inf),
        "via": np.zeros(n_junctions, np.int32),
        "via_from": np.zeros(n_junctions, np.int32),
        "reached": np.zeros(n_junctions + 1, np.int32),
        "keys": np.zeros(n_streets + 2 * _N_MOVES),
        "vertices": np.zeros(n_streets + 2 * _N_MOVES, np.int32),
    }
    return PolicyData(STREETS, numbers, arrays, kept=plain)


def streets_of(lot: ParkingLot, move_s: FloatArray) -> dict[str, NDArray[Any]]:
    n, neighbors = lot.n_slots, lot.neighbors
    # On from each slot: to a junction, else to the slot that lies in the same direction; not across the street.
    turn = np.cos(lot.vertex_yaw[:n, None] - lot.vertex_yaw[neighbors[:n]])
    likeness = np.where(neighbors[:n] >= n, 2.0, np.where(neighbors[:n] >= 0, turn, -np.inf))
    onward = likeness.argmax(axis=1)
    kind = np.stack([lot.zone_of_slot, lot.facility_of_slot], axis=1)
    rows: dict[str, list[Any]] = {
        name: [] for name in ("start", "end", "length_s", "last_move", "first", "first_place")
    }
    at: dict[str, list[Any]] = {name: [] for name in ("slots", "street_at", "along_s", "move_into")}
    place_first, street_of = list[int](), np.full((lot.n_vertices - n, _N_MOVES), _NONE, np.int32)
    for junction, move in np.argwhere(neighbors[n:] >= 0).tolist():
        street, v, seconds = len(rows["start"]), n + junction, 0.0
        street_of[junction, move] = street
        rows["start"].append(v)
        rows["first"].append(len(at["slots"]))
        rows["first_place"].append(len(place_first))
        before = _NONE
        while True:
            seconds += move_s[v, move]
            v = int(neighbors[v, move])
            if v >= n:
                break
            if before == _NONE or (kind[v] != kind[before]).any():
                place_first.append(len(at["slots"]))
            for values, value in zip(at.values(), (v, street, seconds, move), strict=True):
                values.append(value)
            before, move = v, int(onward[v])
        for name, value in (("end", v), ("length_s", seconds), ("last_move", move)):
            rows[name].append(value)
    rows["first"].append(len(at["slots"]))
    rows["first_place"].append(len(place_first))
    place_first.append(len(at["slots"]))
    kinds = {"length_s": np.float64, "along_s": np.float64, "last_move": np.uint8, "move_into": np.uint8}
    arrays = {name: np.array(values, kinds.get(name, np.int32)) for name, values in (rows | at).items()}
    position = np.zeros(n, np.int32)
    position[arrays["slots"]] = np.arange(len(arrays["slots"]))
    first = np.array(place_first, np.int32)
    return arrays | {"street_of": street_of, "place_first": first, "position": position}


def _onward(streets: dict[str, NDArray[Any]], n_slots: int, bounds: FloatArray) -> FloatArray:
    """Return the least drive from each junction to a place and its bound, (n_goals, n_junctions) s."""
    n, start, end = len(streets["street_of"]), streets["start"] - n_slots, streets["end"] - n_slots
    via = streets["along_s"][streets["place_first"][:-1]] + bounds
    of = start[np.repeat(np.arange(len(start)), np.diff(streets["first_place"]))]
    onward = np.full((len(bounds), n), np.inf)
    for row, at in zip(onward, via, strict=True):
        np.minimum.at(row, of, at)
        before = np.empty(0)
        while not np.array_equal(row, before):
            before = row.copy()
            np.minimum.at(row, start, streets["length_s"] + before[end])
    return onward


@kernel
def choose_place(
    address: int, goal: int, search: int, vertex: int, target: int, moves: NDArray[np.uint8], n_moves: int
) -> tuple[int, int, float]:
    """Choose the slot to drive to, the last one in its place that may be free, and plan the way through the place.

    Arguments are as for `choose_route`, but of the STREETS record. Return the target, or `NO_SLOT`; the number of moves
    to it; the index of its place, s. If no place may have a free slot, they are those of `greedy-drive`, and inf.
    """
    streets = streets_at(address, 0)
    _search_places(streets, goal, search, vertex)
    if streets.best == _NONE:
        chosen, n_moves = choose_route(streets.plain, goal, search, vertex, target, moves, n_moves)
        return chosen, n_moves, np.inf
    return (
        int(int32s(streets.slots)[streets.best]),
        _plan_moves(streets, vertex, moves),
        float(streets.best_s),
    )


@kernel
def takes_slot(address: int, goal: int, search: int, slot: int, left_s: float) -> bool:
    """Return whether a driver takes the slot that it passes: free, and for no more than what is left of the index, s.

    Other arguments are as for `choose_place`.
    """
    streets = streets_at(address, 0)
    if slot >= streets.n_slots or state_of(streets, search, slot) != OBSERVED_FREE:
        return False
    cost_s = cost_of(streets, goal, search, slot)
    return bool(cost_s <= left_s and cost_s < np.inf)


@inlined
def _forecast(streets: Any, search: int, slot: int) -> float:
    return float(forecast(search_of(search), slot) if search else float64s(streets.forecast)[slot])


@kernel
def _count_free(streets: Any, search: int) -> None:
    """Count by zone how many of the slots that the driver has seen were free, and how many the forecast expected."""
    zone_of_slot, n_zones = int64s(streets.zone_of_slot), streets.n_zones
    free, expected = (
        float64_array(streets.seen_free, (n_zones,)),
        float64_array(streets.expected_free, (n_zones,)),
    )
    free[:] = expected[:] = 0.0
    # Sums of numbers that were rounded to float32 are exact, so their order does not matter.
    zone, n_free, n_expected = np.int64(0), 0.0, 0.0
    for i in range(search_of(search).n_columns if search else streets.n_slots):
        slot, is_free, p = observed_column(search_of(search), i) if search else _observed_slot(streets, i)
        if slot < 0:
            continue
        if zone_of_slot[slot] != zone:
            free[zone] += n_free
            expected[zone] += n_expected
            zone, n_free, n_expected = zone_of_slot[slot], 0.0, 0.0
        n_free += is_free
        n_expected += 1.0 - p
    free[zone] += n_free
    expected[zone] += n_expected


@inlined
def _observed_slot(streets: Any, slot: int) -> tuple[Any, float, Any]:
    state = uint8s(streets.last_states)[slot]
    seen = np.int64(slot if state != UNOBSERVED else _NONE)
    return seen, 1.0 if state == OBSERVED_FREE else 0.0, float64s(streets.forecast)[slot]


@inlined
def _level(streets: Any, zone: int) -> float:
    """Return the factor of the odds that a slot of a zone is free: as many as were seen over those expected."""
    return float(
        (float64s(streets.seen_free)[zone] + PRIOR_PSEUDO_COUNT)
        / (float64s(streets.expected_free)[zone] + PRIOR_PSEUDO_COUNT)
    )


@inlined
def _onward_s(streets: Any, goal: int, search: int) -> tuple[int, float]:
    """Return where lower bounds on the drive and the arrival cost from each junction begin, and what to add, s."""
    first = 8 * streets.n_junctions * goal
    if search and has_own_price(search_of(search)):
        return streets.onward_walk_s + first, least_zone_cost_s(search_of(search), streets.n_zones)
    return streets.onward_cost_s + first, 0.0


@inlined
def _bound_s(streets: Any, goal: int, search: int, k: int) -> float:
    """Return a lower bound on the driver's arrival cost of the slots of a place, s."""
    if search and has_own_price(search_of(search)):
        zone_cost_s = float64s(search_of(search).zone_cost_s)[int64s(streets.place_zone)[k]]
        return float(float64s(streets.place_walk_s)[streets.n_places * goal + k] + zone_cost_s)
    return float(float64s(streets.place_cost_s)[streets.n_places * goal + k])


@kernel
def _search_places(streets: Any, goal: int, search: int, vertex: int) -> None:
    """Find the place of the lowest index from a vertex (A* over the junctions)."""
    n, seconds, reached = streets.n_slots, float64s(streets.seconds), int32s(streets.reached)
    street_of, end, length_s = int32s(streets.street_of), int32s(streets.end), float64s(streets.length_s)
    keys, vertices = float64s(streets.keys), int32s(streets.vertices)
    streets.bounds_s, more_s = _onward_s(streets, goal, search)
    onward_s = float64s(streets.bounds_s)
    for i in range(1, reached[0] + 1):
        seconds[reached[i]] = np.inf
    reached[0] = 0
    streets.best_s, streets.best, streets.n_queued = np.inf, _NONE, 0
    _count_free(streets, search)
    if vertex >= n:
        seconds[vertex - n], reached[0], reached[1] = 0.0, 1, vertex - n
        streets.n_queued = push(keys, vertices, 0, onward_s[vertex - n], vertex - n)
    else:
        # On along the street, or across it.
        here = np.int64(int32s(streets.position)[vertex])
        _enter(streets, goal, search, here, 0.0)
        for move in range(_N_MOVES):
            v = np.int64(int32s(streets.neighbors)[vertex * _N_MOVES + move])
            if 0 <= v < n and not _follows(streets, here, v):
                there = np.int64(int32s(streets.position)[v])
                _enter(streets, goal, search, there, float64s(streets.move_s)[vertex * _N_MOVES + move])
    while streets.n_queued > 0:
        least_s, junction = keys[0], np.int64(vertices[0])
        if least_s + more_s >= streets.best_s:
            break
        far = seconds[junction]
        streets.n_queued = pop(keys, vertices, streets.n_queued)
        if least_s > far + onward_s[junction]:
            continue
        for move in range(_N_MOVES):
            street = np.int64(street_of[junction * _N_MOVES + move])
            if street != _NONE:
                _look_along(streets, goal, search, street, _NONE, far)
                _reach(streets, end[street] - n, street, _NONE, far + length_s[street])


@inlined
def _follows(streets: Any, position: int, slot: int) -> bool:
    after, street = position + 1, int32s(streets.street_at)[position]
    return bool(after < int32s(streets.first)[street + 1] and int32s(streets.slots)[after] == slot)


@kernel
def _enter(streets: Any, goal: int, search: int, position: int, drive_s: float) -> None:
    street, before_s = np.int64(int32s(streets.street_at)[position]), float64s(streets.along_s)[position]
    _look_along(streets, goal, search, street, position, drive_s - before_s)
    end_s = drive_s - before_s + float64s(streets.length_s)[street]
    _reach(streets, np.int64(int32s(streets.end)[street] - streets.n_slots), street, position, end_s)


@inlined
def _reach(streets: Any, junction: int, street: int, position: int, far: float) -> None:
    """Note that a street, entered at a position or -1, leads to a junction."""
    seconds, reached = float64s(streets.seconds), int32s(streets.reached)
    if far >= seconds[junction]:
        return
    if seconds[junction] == np.inf:
        reached[0] += 1
        reached[reached[0]] = junction
    seconds[junction] = far
    int32s(streets.via)[junction], int32s(streets.via_from)[junction] = street, position
    keys, vertices = float64s(streets.keys), int32s(streets.vertices)
    bound_s = far + float64s(streets.bounds_s)[junction]
    streets.n_queued = push(keys, vertices, streets.n_queued, bound_s, junction)


@kernel
def _look_along(streets: Any, goal: int, search: int, street: int, position: int, before_s: float) -> None:
    """Compare the places along a street, from a position on or, with -1, all, with the best one.

    `before_s` is the drive to the beginning of the street.
    """
    place_first, slots = int32s(streets.place_first), int32s(streets.slots)
    along_s = float64s(streets.along_s)
    for k in range(int32s(streets.first_place)[street], int32s(streets.first_place)[street + 1]):
        first, end = np.int64(max(place_first[k], position)), np.int64(place_first[k + 1])
        if first >= end:
            continue
        if not before_s + along_s[first] + _bound_s(streets, goal, search, k) < streets.best_s:
            continue
        n_open, first_open, last_open = 0, _NONE, _NONE
        for i in range(first, end):
            slot = np.int64(slots[i])
            state = state_of(streets, search, slot)
            if state == OBSERVED_FREE:
                cost_s = cost_of(streets, goal, search, slot)
                _compare(streets, before_s + along_s[i] + cost_s, i, position)
            elif state != OBSERVED_TAKEN:
                n_open, last_open = n_open + 1, i
                first_open = i if first_open == _NONE else first_open
        if n_open > 0:
            slot = np.int64(slots[(first_open + last_open) // 2])
            drive_s = before_s + (along_s[first_open] + along_s[last_open]) / 2.0
            p = _forecast(streets, search, slot)
            p /= p + (1.0 - p) * _level(streets, int64s(streets.place_zone)[k])
            q = 1.0 - p**n_open
            if q > 0.0:
                _compare(streets, cost_of(streets, goal, search, slot) + drive_s / q, last_open, position)


@inlined
def _compare(streets: Any, index_s: float, target: int, position: int) -> None:
    if index_s < streets.best_s:
        streets.best_s, streets.best, streets.best_from = index_s, target, position


@kernel
def _plan_moves(streets: Any, vertex: int, moves: NDArray[np.uint8]) -> int:
    """Write the moves to the best place, the last one first; returns their number."""
    move_into, first, via = uint8s(streets.move_into), int32s(streets.first), int32s(streets.via)
    position, begin, n_moves = np.int64(streets.best), np.int64(streets.best_from), 0
    street = np.int64(int32s(streets.street_at)[position])
    while True:
        before = begin if begin != _NONE else np.int64(first[street]) - 1
        while position > before:
            moves[n_moves] = move_into[position]
            position, n_moves = position - 1, n_moves + 1
        if begin != _NONE:
            break
        junction = np.int64(int32s(streets.start)[street] - streets.n_slots)
        if junction + streets.n_slots == vertex:
            return n_moves
        begin, street = np.int64(int32s(streets.via_from)[junction]), np.int64(via[junction])
        moves[n_moves] = uint8s(streets.last_move)[street]
        n_moves += 1
        position = np.int64(first[street + 1]) - 1
    entered = np.int64(int32s(streets.slots)[begin])
    if entered != vertex:
        best_s = np.inf
        for move in range(_N_MOVES):
            edge = vertex * _N_MOVES + move
            if int32s(streets.neighbors)[edge] == entered and float64s(streets.move_s)[edge] < best_s:
                best_s, moves[n_moves] = float64s(streets.move_s)[edge], move
        n_moves += 1
    return n_moves
