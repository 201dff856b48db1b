"""Benchmark of towns: 20,000 spaces and 80,000 cars, and the day of a district beside SUMO."""

from __future__ import annotations

import dataclasses
import itertools
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray
from parkenv.engine.fleet import DriverKind, Fleet, drive_times
from parkenv.lots import city_lot
from parkenv.scenarios.build import make_scenario
from parkenv.studies.bench.rows import BenchRow, absent, duration, rate
from parkenv.studies.bench.sumo import run_sumo, streets_of, sumo_folder, sumo_version
from parkenv.world.demand import ConstantTime, Demand, ExponentialTime, LogNormalTime, PoissonArrivals
from parkenv.world.drive_graph import node_labels
from parkenv.world.facility import Facility
from parkenv.world.lot import Lane, ParkingLot
from parkenv.world.scenario import Scenario
from parkenv.world.week import HOUR_S
from planners.heuristics import POLICIES

SPACES, CARS = 20_000, (20_000, 40_000, 80_000)
"""Spaces of the town, and cars of its days."""
GOALS, ENTRIES = 50, 12
WINDOW = 7 * HOUR_S, 20 * HOUR_S
STAY_S = 2.5 * HOUR_S
SPEED = 20.0 / 3.6  # m/s
BLOCKS, GARAGE = 1_000, 150
"""Spaces at the kerbs of the made district that is compared with SUMO, and in its garage."""
DAY = 8 * HOUR_S, 12 * HOUR_S
CARS_PER_SPACE = (
    0.22  # that arrive in an hour: those at entries have to search, and SUMO's streets do not jam
)
SHIFT = 1.5  # m, from the middle of a two-way street to the lanes of its directions


def town_rows(
    seed: int = 0, seconds: float = 0.6, *, cars: Sequence[int] = CARS, lots: Sequence[str] = ()
) -> list[BenchRow]:
    """Return the rows of `parkenv bench town`.

    In the town of `city_lot`, cars arrive from 7 to 20 o'clock at `ENTRIES` entries, head for `GOALS` goals, stay for
    2.5 hours in the mean, and are driven by `usual`.

    Args:
        seed: seed of town and days.
        seconds: not used: days are run once.
        cars: cars of the days.
        lots: files of lots, such as an imported district, whose days are compared with SUMO's, besides a made one.
    """
    del seconds
    rows: list[BenchRow] = []
    scenario = made_town(SPACES, seed)
    for n in cars:
        fleet = Fleet(
            scenario,
            town_demand(scenario, n),
            background="none",
            drivers=[DriverKind(policy=POLICIES["usual"])],
        )
        fleet.reset(seed)
        fleet.run(until=fleet.begin + 60.0)  # compiles
        start = time.process_time()
        fleet.reset(seed)
        fleet.run()
        took = time.process_time() - start
        case = f"{SPACES:,} spaces, {n:,} cars from 7 to 20, usual"
        rows += duration("town", case, took, "s of CPU")
        rows += duration("town", case, 1e9 * took / fleet.totals["decisions"], "ns a decision")
        rows += rate("town", f"{case}: cars, slots and searches", fleet.n_bytes / 2**20, "MiB, at most")
    for lot in (with_garage(made_town(BLOCKS, seed).lot), *(make_scenario(name).lot for name in lots)):
        rows += sumo_town_rows(lot, seed)
    return rows


def made_town(spaces: int, seed: int) -> Scenario:
    """Return a town of kerbs with entries at its edge and goals anywhere in it."""
    city, rng = city_lot(spaces, seed), np.random.default_rng(seed)
    west, south, east, north = city.bounds()
    ends = np.concatenate([lane.points[[0, -1]] for lane in city.lanes[:-1]])
    goals = np.stack([rng.uniform(west, east, GOALS), rng.uniform(south, north, GOALS)], axis=1)
    lot = _changed(city, goals=goals, entries=ends[rng.permutation(len(ends))[:ENTRIES]])
    scenario = make_scenario(lot, v_drive=SPEED)
    return scenario.replace(occupancy=scenario.occupancy.at_mean_occupancy(0.1, 0.0))


def town_demand(scenario: Scenario, cars: int) -> Demand:
    """Return cars that come at a constant rate, to all goals and from all entries alike."""
    lot, (begin, end) = scenario.lot, WINDOW
    return Demand(
        PoissonArrivals(cars * HOUR_S / (end - begin), begin, end),
        LogNormalTime(STAY_S),
        ConstantTime(1800.0),
        entry_weights=(1.0,) * len(lot.entries),
        goal_weights=(1.0,) * len(lot.goals),
    )


# ---- beside SUMO


def sumo_town_rows(lot: ParkingLot, seed: int) -> list[BenchRow]:
    """Return rows with CPU times, search times and occupancy of the same day of a district in a fleet and in SUMO.

    The district is that of `blocks_of`. Drivers are `greedy-drive`: they head for the nearest facility not known to be
    full, and learn that one is full when they come to its street.
    """
    folder = sumo_folder()
    blocks = blocks_of(lot)
    case = f"{lot.name}, {int(blocks.capacity.sum()):,} spaces in {blocks.n_slots} kerbs and garages"
    if folder is None:
        return absent("day", f"{case}; SUMO: not installed", "s")
    per_hour = CARS_PER_SPACE * float(blocks.capacity.sum())
    demand = Demand(
        PoissonArrivals(per_hour, *DAY), ExponentialTime(HOUR_S), entry_weights=(1.0,) * len(lot.entries)
    )
    scenario = make_scenario(blocks, v_drive=SPEED)
    # As in SUMO, a car sees on its own side of the street only.
    sensor = dataclasses.replace(scenario.sensor_model, view_range=SHIFT)
    fleet = Fleet(
        scenario.replace(sensor_model=sensor),
        demand,
        background="none",
        drivers=[DriverKind(policy=POLICIES["greedy-drive"])],
        leave_full_lot=False,
    )
    fleet.reset(seed)
    fleet.run()  # compiles
    start = time.process_time()
    fleet.reset(seed)
    fleet.run(until=fleet.begin + (DAY[1] - DAY[0]))
    took = time.process_time() - start
    fleet.run()
    ours, end_s = fleet.cars, DAY[1] - DAY[0]
    theirs = run_sumo(fleet, folder, 1.0, end_s + HOUR_S)
    peer = f"{sumo_version(folder)}, steps of 1 s"
    case = f"{case}, {len(ours):,} cars in {end_s / HOUR_S:g} h, greedy-drive"
    search_s = ours["ended_at"] - ours["arrival"]
    both = np.isfinite(theirs.search_s)
    rows = duration("day", case, 1e3 * took, "ms", **{peer: 1e3 * theirs.cpu_s})
    rows += _equal(
        f"{case}: mean search time",
        float(search_s[both].mean()),
        "s of search",
        peer,
        float(theirs.search_s[both].mean()),
    )
    shares = [
        parked_share(
            blocks, ours["slot"], ours["ended_at"] - fleet.begin, ours["left_at"] - fleet.begin, end_s
        ),
        parked_share(blocks, theirs.slot, theirs.began_s, theirs.left_s, end_s),
    ]
    rows += _equal(
        f"{case}: mean occupancy", 100 * _mean(blocks, shares[0]), "%", peer, 100 * _mean(blocks, shares[1])
    )
    apart = 100 * _mean(blocks, np.abs(shares[0] - shares[1]))
    return [*rows, *rate("day", f"{case}: occupancy by facility, mean difference to SUMO", apart, "points")]


def parked_share(
    lot: ParkingLot, slot: NDArray[np.int64], began_s: FloatArray, left_s: FloatArray, end_s: float
) -> FloatArray:
    """Return the mean share of the spaces of each slot in which cars stood until a time, (n_slots,)."""
    stood = np.clip(left_s, 0.0, end_s) - np.clip(began_s, 0.0, end_s)
    parked = (slot >= 0) & np.isfinite(began_s)
    return np.bincount(slot[parked], stood[parked], lot.n_slots) / (end_s * lot.capacity)


def _mean(lot: ParkingLot, values: FloatArray) -> float:
    """Return the mean of a value of each slot over its spaces."""
    return float(np.average(values, weights=lot.capacity))


def with_garage(lot: ParkingLot, capacity: int = GARAGE) -> ParkingLot:
    """Return a lot with a garage next to its first goal."""
    nearest = lot.vertex_xy[np.hypot(*(lot.vertex_xy - lot.goals[0]).T).argmin()]
    return _changed(
        lot,
        facilities=(
            Facility("garage", "garage", capacity=capacity, xy=tuple(nearest.tolist()), known="sign"),
        ),
    )


def blocks_of(lot: ParkingLot) -> ParkingLot:
    """Return a lot as SUMO can have it: one-way lanes, and a counted facility for the kerb of each street's side.

    The two directions of a street share its ends only, so nobody turns round amid a street. Garages are kept.
    """
    drawn = ~lot.is_counted
    columns = {f.name: getattr(lot, f.name)[drawn] for f in dataclasses.fields(lot) if f.name in _COLUMNS}
    ids = tuple(name for name, is_drawn in zip(lot.slot_ids, drawn, strict=True) if is_drawn)
    garages = tuple(each for each in lot.facilities if each.is_counted and each.kind == "garage")
    plain = _changed(lot, slot_ids=ids, **columns, lanes=_one_way(lot.lanes), facilities=(), slot_facility=())
    reached = np.isfinite(
        np.min([drive_times(make_scenario(plain), int(v)) for v in plain.entry_vertices], axis=0)
    )
    kerbs = []
    for street in streets_of(plain):
        slots = [slot for slot, _ in street.slots if reached[slot]]
        if slots:
            x, y = plain.vertex_xy[slots[len(slots) // 2]].tolist()
            kerbs.append(
                Facility(f"kerb {street.name}", "kerb", capacity=len(slots), xy=(x, y), known="sign")
            )
    none = {name: column[:0] for name, column in columns.items()}
    return _changed(plain, slot_ids=(), **none, slot_facility=(), facilities=(*kerbs, *garages))


_COLUMNS = (
    "slot_xy", "slot_yaw", "slot_length", "slot_width", "slot_mouth", "slot_parking_cost_s", "slot_zone",
)  # fmt: skip


def _one_way(lanes: Sequence[Lane]) -> tuple[Lane, ...]:
    """Return lanes with two one-way ones for the directions of each two-way one."""
    points = np.concatenate([lane.points for lane in lanes])
    label = node_labels(points)
    shared = (np.bincount(label) > 1)[label]
    made, first = list[Lane](), 0
    for lane in lanes:
        is_end = shared[first : first + len(lane.points)].copy()
        first += len(lane.points)
        is_end[[0, -1]] = True
        cuts = np.flatnonzero(is_end)
        for begin, end in itertools.pairwise(cuts):
            part = lane.points[begin : end + 1]
            made += [Lane(part, oneway=True)] if lane.oneway else [_shifted(part), _shifted(part[::-1])]
    return tuple(made)


def _shifted(points: FloatArray) -> Lane:
    """Return the lane to the right of a line, with the same ends."""
    step = np.diff(points, axis=0)
    length = np.hypot(*step.T)[:, None]
    right = np.stack([step[:, 1], -step[:, 0]], axis=1) / length * SHIFT
    margin = np.minimum(1.0, length / 4.0) * step / length
    beside = np.concatenate([points[:-1] + margin + right, points[1:] - margin + right], axis=1).reshape(
        -1, 2
    )
    return Lane(np.concatenate([points[:1], beside, points[-1:]]), oneway=True)


def _changed(lot: ParkingLot, **changes: Any) -> ParkingLot:
    fields = {f.name: getattr(lot, f.name) for f in dataclasses.fields(lot) if f.init}
    return ParkingLot(**fields | changes)


def _equal(case: str, ours: float, unit: str, peer: str, theirs: float) -> list[BenchRow]:
    """Return a row of values that are to be equal, not small."""
    rows = duration("day", case, ours, unit, **{peer: theirs})
    return [row | {"ratio": None} for row in rows]
