"""Benchmark of towns: 20,000 spaces and 80,000 cars, and the day of districts beside SUMO."""

from __future__ import annotations

import dataclasses
import itertools
import time
from collections.abc import Sequence

import numpy as np

from benchmarks.rows import Row, duration, equal, peak_memory_gib
from benchmarks.sumo_days import streets_of, sumo_rows
from parkenv.compiled.arrays import FloatArray
from parkenv.engine.fleet import DriverKind, Fleet
from parkenv.lots import city_lot
from parkenv.lots.generators import Slots
from parkenv.scenarios.build import make_scenario
from parkenv.world.demand import ConstantTime, Demand, ExponentialTime, LogNormalTime, PoissonArrivals
from parkenv.world.drive_graph import NODE_TOLERANCE, node_labels
from parkenv.world.facility import Facility
from parkenv.world.lot import Lane, ParkingLot, Turn
from parkenv.world.scenario import Scenario, drive_times
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
CARS_PER_SPACE = 0.22  # that arrive in an hour: kerbs near the entries are full, so that cars search
STEP_S = 0.5  # time step of SUMO, s
SHIFT = 1.5  # m, from the middle of a two-way street to the lanes of its directions


def town_rows(
    seed: int = 0, seconds: float = 0.6, *, cars: Sequence[int] = CARS, lots: Sequence[str] = ()
) -> list[Row]:
    """Return the rows of `python benchmarks/run.py town`.

    In the town of `city_lot`, cars arrive from 7 to 20 o'clock at `ENTRIES` entries, head for `GOALS` goals, stay for
    2.5 hours in the mean, and are driven by `usual`.

    Args:
        seed: seed of town and days.
        seconds: not used: days are run once.
        cars: cars of the days.
        lots: files of lots, such as an imported district, whose days are compared with SUMO's, besides a made one.
    """
    del seconds
    rows: list[Row] = []
    scenario = made_town(SPACES, seed)
    for n in cars:
        driver = DriverKind(policy=POLICIES["usual"])
        fleet = Fleet(scenario, town_demand(scenario, n), background="none", drivers=[driver])
        fleet.reset(seed)
        fleet.run(until=fleet.begin + 60.0)  # compiles
        start = time.process_time()
        fleet.reset(seed)
        fleet.run()
        took = time.process_time() - start
        case = f"{SPACES:,} spaces, {n:,} cars from 7 to 20, usual"
        rows += duration("town", case, took, "s of CPU")
        rows += duration("town", case, 1e9 * took / fleet.totals["decisions"], "ns a decision")
        rows += duration("town", f"{case}: peak memory of the process", peak_memory_gib(), "GiB")
    made = with_garage(made_town(BLOCKS, seed).lot)
    return rows + [
        row for lot in (made, *(make_scenario(name).lot for name in lots)) for row in beside_sumo(lot, seed)
    ]


def made_town(spaces: int, seed: int) -> Scenario:
    """Return a town of kerbs with entries at its edge and goals anywhere in it."""
    city, rng = city_lot(spaces, seed), np.random.default_rng(seed)
    west, south, east, north = city.bounds()
    ends = np.concatenate([lane.points[[0, -1]] for lane in city.lanes[:-1]])
    goals = np.stack([rng.uniform(west, east, GOALS), rng.uniform(south, north, GOALS)], axis=1)
    lot = dataclasses.replace(city, goals=goals, entries=ends[rng.permutation(len(ends))[:ENTRIES]])
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


def beside_sumo(lot: ParkingLot, seed: int) -> list[Row]:
    """Return rows with CPU times, search times and occupancy of the same day of a district in a fleet and in SUMO.

    The district is that of `blocks_of`. Drivers are `greedy-drive`: they head for the nearest facility not known to be
    full, and learn that one is full when they come to its street.
    """
    blocks = blocks_of(lot)
    capacity, end_s = blocks.capacity, DAY[1] - DAY[0]
    arrivals = PoissonArrivals(CARS_PER_SPACE * float(capacity.sum()), *DAY)
    demand = Demand(arrivals, ExponentialTime(HOUR_S), entry_weights=(1.0,) * len(lot.entries))
    scenario = make_scenario(blocks, v_drive=SPEED)
    # As in SUMO, a car sees on its own side of the street only.
    scenario = scenario.replace(sensor_model=dataclasses.replace(scenario.sensor_model, view_range=SHIFT))
    driver = DriverKind(policy=POLICIES["greedy-drive"])
    fleet = Fleet(scenario, demand, background="none", drivers=[driver], leave_full_lot=False)
    case = (
        f"{lot.name}, {capacity.sum():,} spaces in {blocks.n_slots} kerbs and garages, "
        f"{arrivals.per_hour:.0f} cars an hour for {end_s / HOUR_S:g} hours"
    )
    rows, days = sumo_rows(fleet, case, seed, end_s, (STEP_S,))
    for peer in list(days)[1:]:
        ours, theirs = (days[name][0].parked_share(capacity, end_s) for name in ("ours", peer))
        whole, other, apart = (
            100.0 * float(np.average(share, weights=capacity))
            for share in (ours, theirs, np.abs(ours - theirs))
        )
        rows += equal("day", f"{case}: mean occupancy", whole, "%", **{peer: other})
        rows += duration("day", f"{case}: occupancy by facility, mean difference to {peer}", apart, "points")
    return rows


def with_garage(lot: ParkingLot, capacity: int = GARAGE) -> ParkingLot:
    """Return a lot with a garage next to its first goal."""
    x, y = lot.vertex_xy[np.hypot(*(lot.vertex_xy - lot.goals[0]).T).argmin()].tolist()
    garage = Facility("garage", "garage", capacity=capacity, xy=(x, y), known="sign")
    return dataclasses.replace(lot, facilities=(garage,))


def blocks_of(lot: ParkingLot) -> ParkingLot:
    """Return a lot as SUMO can have it: one-way lanes, and a counted facility for the kerb of each street's side.

    The two directions of a street share its ends only, so nobody turns round amid a street. Garages are kept, rules
    and prices are not.
    """
    lanes, turns = _one_way(lot)

    def plain(slots: Slots, facilities: tuple[Facility, ...]) -> ParkingLot:
        slots = dataclasses.replace(slots, zone=slots.zone[:0], facility=slots.facility[:0])
        ids = tuple(map(str, range(len(slots))))
        return ParkingLot(
            lot.name,
            ids,
            **slots.columns(),
            lanes=lanes,
            entries=lot.entries,
            goals=lot.goals,
            facilities=facilities,
            turns=turns,
        )

    drawn = Slots.of_lot(lot)[~lot.is_counted]
    each = plain(drawn, ())
    reached = np.isfinite(drive_times(make_scenario(each), each.entry_vertices).min(axis=0))
    kerbs = []
    for street in streets_of(each):
        slots = [slot for slot, _ in street.slots if reached[slot]]
        if slots:
            x, y = each.vertex_xy[slots[len(slots) // 2]].tolist()
            kerb = Facility(f"kerb {street.name}", "kerb", capacity=len(slots), xy=(x, y), known="sign")
            kerbs.append(kerb)
    garages = [one for one in lot.facilities if one.is_counted and one.kind == "garage"]
    garages = [dataclasses.replace(garage, zone="", known="sign") for garage in garages]
    return plain(drawn[:0], (*kerbs, *garages))


def _one_way(lot: ParkingLot) -> tuple[tuple[Lane, ...], tuple[Turn, ...]]:
    """Return lanes with two one-way ones for the directions of each two-way one, and the turns between them."""
    points = np.concatenate([lane.points for lane in lot.lanes])
    label = node_labels(points)
    shared = (np.bincount(label) > 1)[label]
    made, first = list[Lane](), 0
    old = list[FloatArray]()
    for lane in lot.lanes:
        is_end = shared[first : first + len(lane.points)].copy()
        first += len(lane.points)
        is_end[[0, -1]] = True
        cuts = np.flatnonzero(is_end)
        for begin, end in itertools.pairwise(cuts):
            part = lane.points[begin : end + 1]
            old += [part] if lane.oneway else [part, part[::-1]]
            made += (
                [Lane(part, oneway=True)]
                if lane.oneway
                else [_shifted(part, lot.side), _shifted(part[::-1], lot.side)]
            )

    def beside(at: FloatArray, point: FloatArray, end: int, inner: int) -> FloatArray:
        """Return the point next to a junction on the lane that leads a way."""
        ways = np.array([part[inner] - part[end] for part in old])
        alike = ways @ (point - at) / np.hypot(*ways.T)
        alike[np.hypot(*(np.array([part[end] for part in old]) - at).T) > NODE_TOLERANCE] = -np.inf
        chosen: FloatArray = made[int(alike.argmax())].points[inner]
        return chosen

    turns = [
        Turn(np.array([beside(at, before, -1, -2), at, beside(at, after, 0, 1)]), turn.only)
        for turn in lot.turns
        for before, at, after in (turn.points,)
    ]
    return tuple(made), tuple(turns)


def _shifted(points: FloatArray, side: int) -> Lane:
    """Return the lane on the kerb side of a line, with the same ends."""
    step = np.diff(points, axis=0)
    length = np.hypot(*step.T)[:, None]
    right = np.stack([step[:, 1], -step[:, 0]], axis=1) / length * (side * SHIFT)
    margin = np.minimum(1.0, length / 4.0) * step / length
    beside = np.concatenate([points[:-1] + margin + right, points[1:] - margin + right], axis=1).reshape(
        -1, 2
    )
    return Lane(np.concatenate([points[:1], beside, points[-1:]]), oneway=True)
