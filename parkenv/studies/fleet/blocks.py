"""What a day with many cars tells: of each block and hour, of each lane, and where the cars are.

A *block* is a facility, or where a lot has none, the slots of a tariff zone.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.compiled.jit import compiled
from parkenv.engine.fleet import Fleet
from parkenv.engine.records import BALKED, GAVE_UP, SEARCHING, STATES, STEP, TRUNCATED
from parkenv.files.csv_tables import NUMBER_OR_NAN, TEXT, WHOLE
from parkenv.studies.fleet.setting import KINDS, NOWHERE, SETTING_COLUMNS
from parkenv.studies.fleet.tables import day_means
from parkenv.studies.results import LongTable, Row
from parkenv.world.lot import ParkingLot
from parkenv.world.scenario import Scenario
from parkenv.world.tariff import NO_ZONE
from parkenv.world.week import DAY_S, HOUR_S

if TYPE_CHECKING:
    from parkenv.studies.fleet.measures import Roads

ALL = "all"
"""Stands for cars of every purpose."""
_DAY = (*SETTING_COLUMNS, "day")
_KINDS = {
    **KINDS,
    **dict.fromkeys(("block", "type", "zone", "purpose"), TEXT),
    **dict.fromkeys(("hour", "slots", "arrivals", "refused", "departures", "lane", *STATES), WHOLE),
    **dict.fromkeys(("occupancy", "search_s", "walk_s", "cruised_m"), NUMBER_OR_NAN),
}
BLOCKS = LongTable(
    "blocks.csv",
    _DAY,
    ("block", "purpose", "hour"),
    (
        "type", "zone", "slots", "occupancy", "arrivals", "refused", "departures", "search_s", "walk_s", "cruised_m",
        "paid",
    ),
    _KINDS,
)  # fmt: skip
"""What happens in each block in each hour of a day, to cars of each purpose and of all: the share of its slots that
they take; cars that park there, failed attempts, cars that leave; of those that park, the means of search time, walk
and detour, and what they pay for their stays. The arrivals of `NOWHERE` are the cars that go elsewhere. Hours count
from the midnight before the first arrival."""
LANES = LongTable("lanes.csv", _DAY, ("lane", "hour"), ("driven_m", "cruised_m"), _KINDS)
"""What searching cars drive in each lane in each hour of a day, and how much of it is a detour; see `Tally`."""
HOURS = LongTable("hours.csv", _DAY, ("purpose", "hour"), STATES, _KINDS)
"""Where the cars of a day are at the end of each hour: every car is in one of the states."""
TABLES = (BLOCKS, LANES, HOURS)
MEANS = (
    "occupancy", "parked_a_day", "share_parked", "refused_a_day", "search_s", "walk_s", "cruised_m", "paid_a_day",
    "paid_a_car", "balked_fraction",
)  # fmt: skip
"""Columns of a zone, a block or a purpose that are means over days."""
OF_CARS = ("search_s", "walk_s", "cruised_m")
"""Columns of `BLOCKS` that are means over cars."""
MOST_WITH_INTERVALS = 60
"""Blocks of a setting up to which their means have 95 % intervals."""


@dataclass(frozen=True, eq=False)
class Blocks:
    """The blocks of a lot.

    Attributes:
        names, types, zones: of each block; the type is `zone` or that of the facility.
        slots: (n_blocks,) int64, how many cars fit.
        of_slot: (n_slots,) int64, block of each slot.
    """

    names: tuple[str, ...]
    types: tuple[str, ...]
    zones: tuple[str, ...]
    slots: IntArray
    of_slot: IntArray

    @classmethod
    def of(cls, lot: ParkingLot) -> Self:
        """Return the blocks of a lot: facilities in their order, one for each of their zones, then zones."""
        # Slots without a facility come last.
        facility = np.where(lot.facility_of_slot < 0, len(lot.facilities), lot.facility_of_slot)
        pairs, of_slot = np.unique(
            np.stack([facility, lot.zone_of_slot], axis=1), axis=0, return_inverse=True
        )
        several = np.bincount(pairs[:, 0]) > 1
        names, types = [], []
        for number, zone in pairs.tolist():
            if number == len(lot.facilities):
                names.append(lot.zones[zone])
                types.append("zone")
            else:
                its = lot.facilities[number]
                names.append(f"{its.name}, {lot.zones[zone]}" if several[number] else its.name)
                types.append(its.kind)
        twice = {name for name in names if names.count(name) > 1} if len({*names}) < len(names) else {NOWHERE}
        names = [
            f"{name} ({kind})" if name in twice else name for name, kind in zip(names, types, strict=True)
        ]
        zones = tuple(lot.zones[zone] for zone in pairs[:, 1])
        slots = np.bincount(of_slot, lot.capacity).astype(np.int64)
        return cls(tuple(names), tuple(types), zones, slots, of_slot)


def has_zones(scenario: Scenario) -> bool:
    """Return whether there is something to say of zones."""
    return scenario.has_rules or scenario.lot.zones != (NO_ZONE,)


def zone_prices(scenario: Scenario) -> dict[str, float]:
    """Return what an hour costs in the zones of a lot."""
    return {
        name: float(zone.price.amount(scenario.priced_at_s, HOUR_S))
        for name, zone in zip(scenario.lot.zones, scenario.zone_rules, strict=True)
    }


def paid(fleet: Fleet) -> FloatArray:
    """Return what each car of a day whose searches are over pays, (n_cars,), in the currency of the prices."""
    lot, cars = fleet.scenario.lot, fleet.cars
    zone = lot.zone_of_slot[cars["slot"]]
    amounts = fleet.scenario.zone_price(fleet.drivers_of(slice(None)))[np.arange(len(cars)), zone]
    return np.where(cars["slot"] >= 0, amounts, 0.0)


class Tally:
    """Metres in each lane, and failed attempts, counted from the steps of a fleet's cars while it drives.

    A detour is driven at the end: once a car has driven as far as the shortest way to its slot, all that follows is
    cruised; of a car that goes elsewhere, all. So the detours in all lanes add up to those of all cars.

    Args:
        fleet: the fleet, which has been reset.
        roads: its shortest drives.

    Attributes:
        metres: (n_hours, n_lanes, 2) float64, m, from the first hour of the day on: driven, and cruised.
        refused: (k, 3) int64, failed attempts: car, slot, hour.
    """

    def __init__(self, fleet: Fleet, roads: Roads) -> None:
        self._fleet, self._roads = fleet, roads
        self._open = np.zeros(0, STEP)
        self._direct_m, self._driven_m = np.full(len(fleet.cars), np.nan), np.zeros(len(fleet.cars))
        self.metres = np.zeros((0, len(fleet.scenario.lot.lanes), 2))
        self.refused = np.zeros((0, 3), np.int64)
        fleet.keep_steps()

    def update(self) -> None:
        """Count the steps since the last call; those of cars that still search are counted later."""
        fleet, lot = self._fleet, self._fleet.scenario.lot
        new = np.flatnonzero((fleet.cars["state"] > SEARCHING) & np.isnan(self._direct_m))
        self._direct_m[new] = self._roads.direct_m(fleet.cars[new])
        first, last = hour_of(fleet, np.array([fleet.begin, fleet.time])).tolist()
        more = np.zeros((max(last + 1 - first - len(self.metres), 0), *self.metres.shape[1:]))
        self.metres = np.concatenate([self.metres, more])
        steps, since = np.concatenate([self._open, fleet.take_steps()]), fleet.begin // HOUR_S * HOUR_S
        graph = lot.neighbors, lot.edge_length, self._roads.lane_of_edge
        _add_metres(steps, since, *graph, self._direct_m, self._driven_m, self.metres)
        searches = np.isnan(self._direct_m[steps["car"]])
        failed = steps[steps["failed"] & ~searches]
        hour = hour_of(fleet, failed["begin"])
        self.refused = np.concatenate(
            [self.refused, np.stack([failed["car"], failed["vertex"], hour], axis=1)]
        )
        self._open = steps[searches]


@compiled(error_model="numpy")
def _add_metres(
    steps: NDArray[np.void],
    since: float,
    neighbors: NDArray[np.int32],
    edge_length: FloatArray,
    lane_of_edge: IntArray,
    direct_m: FloatArray,
    driven_m: FloatArray,
    metres: FloatArray,
) -> None:
    """Add the steps of cars whose shortest drive is known to `metres`, by hour and lane, and to `driven_m`, by car."""
    for step in steps:
        origin, car = step.origin, step.car
        if origin == step.vertex or np.isnan(direct_m[car]):
            continue
        for k in range(neighbors.shape[1]):
            if neighbors[origin, k] == step.vertex:
                length, hour = edge_length[origin, k], int((step.begin - since) // 3600.0)
                driven_m[car] += length
                lane = metres[hour, lane_of_edge[origin, k]]
                lane[0] += length
                lane[1] += min(max(driven_m[car] - direct_m[car], 0.0), length)
                break


def hour_of(fleet: Fleet, time: FloatArray) -> IntArray:
    """Return the hours of times, s since Monday 00:00, counted from the midnight before a fleet's day begins."""
    return np.asarray((time - fleet.begin // DAY_S * DAY_S) // HOUR_S, np.int64)


def day_rows(
    fleet: Fleet, blocks: Blocks, tally: Tally, cruised_m: FloatArray, times: FloatArray, taken: IntArray
) -> dict[str, Row]:
    """Return a row of each of `TABLES`, by its file, of a day whose searches are over, without setting and day.

    Args:
        fleet: the fleet.
        blocks: the blocks of its lot.
        tally: what its cars drove.
        cruised_m: (n_cars,) m, detour of each car.
        times: (n,) s since Monday 00:00, at which slots were looked at.
        taken: (n, n_slots) how many cars were in each.
    """
    ends = hour_of(fleet, np.array([fleet.begin, times[-1], fleet.cars["ended_at"].max()]))
    hours = np.arange(ends[0], ends.max() + 1)
    driven, cruised = tally.metres.transpose(2, 1, 0).round(1)
    lane, hour = np.nonzero(driven)
    return {
        BLOCKS.file: _block_row(fleet, blocks, tally, cruised_m, times, taken, hours),
        LANES.file: _row(LANES, lane, hours[hour], driven[lane, hour], cruised[lane, hour]),
        HOURS.file: _hour_row(fleet, hours),
    }


def _row(table: LongTable, *columns: NDArray[Any]) -> Row:
    names = (*table.line_keys, *table.columns)
    return {name: values.tolist() for name, values in zip(names, columns, strict=True)}


def _block_row(
    fleet: Fleet,
    blocks: Blocks,
    tally: Tally,
    cruised_m: FloatArray,
    times: FloatArray,
    taken: IntArray,
    hours: IntArray,
) -> Row:
    cars, first, n_blocks = fleet.cars, hours[0], len(blocks.names)
    names, purpose = purposes_of(fleet)
    parked, arrives = cars["slot"] >= 0, cars["parked_at"] < 0
    block = np.where(parked, blocks.of_slot[cars["slot"]], n_blocks)
    leaves = np.where(parked, cars["ended_at"] + cars["stay_s"], np.inf)
    shape = n_blocks + 1, len(names), len(hours)
    ended = block[arrives], purpose[arrives], hour_of(fleet, cars["ended_at"][arrives]) - first
    leaving = np.isfinite(leaves)
    car, slot, hour = tally.refused.T
    search_s, walk_s = cars["ended_at"] - cars["arrival"], cars["walk_s"]
    arrivals, refused, departures, *sums = (
        _with_all(_sums(shape, at, values))
        for at, values in (
            (ended, None),
            ((blocks.of_slot[slot], purpose[car], hour - first), None),
            ((block[leaving], purpose[leaving], hour_of(fleet, leaves[leaving]) - first), None),
            *((ended, values[arrives]) for values in (search_s, walk_s, cruised_m, paid(fleet))),
        )
    )
    means = [
        np.divide(its, arrivals, out=np.full(arrivals.shape, np.nan), where=arrivals > 0).round(2)
        for its in sums[:-1]
    ]
    # Cars of each purpose in each block at each look; with residents of the background, there may be more in all.
    looks = hour_of(fleet, times) - first
    comes, goes = (np.searchsorted(times, its[parked]) for its in (cars["ended_at"], leaves))
    at = n_blocks + 1, len(names), len(times) + 1
    change = _sums(at, (block[parked], purpose[parked], comes)) - _sums(
        at, (block[parked], purpose[parked], goes)
    )
    there = _with_all(np.cumsum(change, axis=2)[..., :-1])
    there[:-1, 0] = np.array([np.bincount(blocks.of_slot, row, n_blocks) for row in taken]).T
    occupancy = np.full(arrivals.shape, np.nan)
    for hour in np.unique(looks):
        occupancy[:-1, :, hour] = there[:-1, :, looks == hour].mean(axis=2) / blocks.slots[:, None]
    shown = (arrivals + refused + departures > 0) | (occupancy > 0.0)
    shown[:-1, 0] = True
    b, p, h = np.nonzero(shown)
    about = (np.array([*its, NOWHERE])[b] for its in (blocks.names, blocks.types, blocks.zones))
    block_name, kind, zone = about
    numbers = (its[shown] for its in (occupancy, arrivals, refused, departures, *means, sums[-1]))
    purpose_name = np.array(names if len(names) == 1 else (ALL, *names))[p]
    return _row(
        BLOCKS, block_name, purpose_name, hours[h], kind, zone, np.append(blocks.slots, 0)[b], *numbers
    )


def purposes_of(fleet: Fleet) -> tuple[tuple[str, ...], IntArray]:
    """Return the purposes of a fleet's drivers, `ALL` if there is one, and the number of that of each car."""
    names = tuple(one.name for one in fleet.demand.purposes)
    return (ALL,) if len(names) == 1 else names, np.array(fleet.cars["purpose"])


def _with_all(sums: NDArray[Any]) -> NDArray[Any]:
    """Return sums by block, purpose and hour with those of all purposes first, if there are several."""
    return sums if sums.shape[1] == 1 else np.concatenate([sums.sum(axis=1, keepdims=True), sums], axis=1)


def _sums(shape: tuple[int, ...], at: Sequence[IntArray], values: FloatArray | None = None) -> NDArray[Any]:
    """Return sums of values, or numbers of them, by indices of which those out of range are left out."""
    inside = np.all([(index >= 0) & (index < n) for index, n in zip(at, shape, strict=True)], axis=0)
    flat = np.ravel_multi_index([index[inside] for index in at], shape)
    weights = None if values is None else values[inside]
    return np.bincount(flat, weights, math.prod(shape)).reshape(shape)


def _hour_row(fleet: Fleet, hours: IntArray) -> Row:
    """Return the row of `HOURS`: all cars, then those of each purpose if there are several."""
    ends = fleet.begin // DAY_S * DAY_S + HOUR_S * (hours + 1)
    names, purpose = purposes_of(fleet)
    groups = [(ALL, slice(None))]
    groups += [(name, purpose == number) for number, name in enumerate(names) if name != ALL]

    def until(times: FloatArray) -> IntArray:
        return np.searchsorted(np.sort(times), ends, side="right")

    counts = []
    for _, which in groups:
        cars = fleet.cars[which]
        parks = cars["slot"] >= 0
        arrived, ended = until(cars["arrival"]), until(cars["ended_at"])
        left = until((cars["ended_at"] + cars["stay_s"])[parks])
        gone = [until(cars["ended_at"][cars["state"] == state]) for state in (GAVE_UP, BALKED, TRUNCATED)]
        parked = until(cars["ended_at"][parks]) - left
        counts.append([len(cars) - arrived, arrived - ended, parked, left, *gone])
    columns = np.concatenate(counts, axis=1)
    purposes = np.repeat([name for name, _ in groups], len(hours))
    return _row(HOURS, purposes, np.tile(hours, len(groups)), *columns)


def summarize_blocks(
    rows: Sequence[Row], by: str, prices: Mapping[str, Mapping[str, float]] = MappingProxyType({})
) -> list[Row]:
    """Return a row for each zone, block or purpose in each setting: means over days, with 95 % intervals.

    Occupancy is that while cars arrive; `share_parked` is the share of the parked cars; other means are those of the
    cars that park there, or of all cars of a purpose. Of more than `MOST_WITH_INTERVALS`, there are no intervals.

    Args:
        rows: of `BLOCKS`.
        by: `zone`, `block` or `purpose`.
        prices: of each scenario, the price of an hour in each zone.
    """
    days: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        for name, its in _day_by(row, by).items():
            days.setdefault((*(row[column] for column in SETTING_COLUMNS), name), []).append(its)
    made, known = [], () if by == "purpose" else ("block", "type", "zone", "slots")
    with_interval = MEANS if len({key[-1] for key in days}) <= MOST_WITH_INTERVALS else ()
    for key, of_days in days.items():
        about: Row = dict(zip((*SETTING_COLUMNS, by), key, strict=True))
        about |= {name: of_days[0][name] for name in known if name in of_days[0]}
        if "zone" in about:
            about["price"] = prices.get(about["scenario"], {}).get(about["zone"], 0.0)
        measures = MEANS if by == "purpose" else MEANS[:-1]
        made.append(about | day_means(of_days, measures, with_interval))
    return made


def _day_by(row: Row, by: str) -> dict[str, Row]:
    """Return what a day, a row of `BLOCKS`, tells of each zone, block or purpose."""
    names, _, grid = _grid(row, by)
    cars, parked = grid["arrivals"].sum(axis=1), grid["parked"].sum(axis=1)
    with np.errstate(invalid="ignore"):
        columns = {
            "slots": grid["slots"][:, 0].astype(int),
            "occupancy": np.nanmean(grid["occupancy"], axis=1),
            "parked_a_day": parked,
            "share_parked": parked / max(parked.sum(), 1.0),
            "refused_a_day": grid["refused"].sum(axis=1),
            **{name: grid[name].sum(axis=1) / cars for name in OF_CARS},
            "paid_a_day": grid["paid"].sum(axis=1),
            "paid_a_car": grid["paid"].sum(axis=1) / parked,
            "balked_fraction": 1.0 - parked / cars,
        }
    found = {name: {c: values[i].item() for c, values in columns.items()} for i, name in enumerate(names)}
    if by == "block":
        about = dict(zip(row["block"], zip(row["type"], row["zone"], strict=True), strict=True))
        found = {name: {"type": about[name][0], "zone": about[name][1], **its} for name, its in found.items()}
    return found


def _grid(row: Row, by: str) -> tuple[list[str], IntArray, dict[str, FloatArray]]:
    """Return zones, blocks or purposes and hours of a day, a row of `BLOCKS`, and sums by them, (n, n_hours) each."""
    every = {column: np.array(row[column]) for column in (*BLOCKS.line_keys, *BLOCKS.columns)}
    chosen = (every["purpose"] == ALL) == (by != "purpose")
    if by != "purpose":
        chosen &= every["block"] != NOWHERE
    lines = {column: values[chosen] for column, values in every.items()}
    names, group = np.unique(lines[by], return_inverse=True)
    hours = np.unique(every["hour"])
    shape, at = (len(names), len(hours)), (group, np.searchsorted(hours, lines["hour"]))
    arrivals = lines["arrivals"].astype(float)
    grid = {
        name: _sums(shape, at, lines[name].astype(float)) for name in ("slots", "arrivals", "refused", "paid")
    }
    grid["parked"] = _sums(shape, at, arrivals * (lines["block"] != NOWHERE))
    grid |= {name: _sums(shape, at, np.nan_to_num(lines[name]) * arrivals) for name in OF_CARS}
    if by == "purpose":
        its = (every["purpose"] == ALL) & (every["hour"] == hours[0])
        grid["slots"][:] = every["slots"][its].sum()
    # A zone of one block is as full as the block, to the last bit.
    share = lines["slots"] / grid["slots"][at]
    grid["occupancy"] = _sums(shape, at, np.nan_to_num(lines["occupancy"]) * share)
    looked_at = np.unique(every["hour"][np.isfinite(every["occupancy"])])
    grid["occupancy"][:, ~np.isin(hours, looked_at)] = np.nan
    return names.tolist(), hours, grid


def by_hour(rows: Sequence[Row], by: str) -> tuple[list[str], list[int], dict[str, FloatArray]]:
    """Return zones, blocks or purposes, hours, and means over the days of a setting, (n, n_hours) each.

    These are `occupancy`, `arrivals`, `refused` and `paid`, `slots`, and the sums over cars of `OF_CARS`.
    """
    days = [_grid(row, by) for row in rows]
    names = sorted({name for its, _, _ in days for name in its})
    hours = np.unique(np.concatenate([its for _, its, _ in days]))
    means: dict[str, FloatArray] = {}
    for column in days[0][2]:
        of_days = np.full((len(days), len(names), len(hours)), np.nan if column == "occupancy" else 0.0)
        for day, (its, there, grid) in zip(of_days, days, strict=True):
            day[np.ix_(np.searchsorted(names, its), np.searchsorted(hours, there))] = grid[column]
        known = np.isfinite(of_days)
        means[column] = np.where(known, of_days, 0.0).sum(axis=0) / np.where(
            known.any(axis=0), known.sum(axis=0), np.nan
        )
    return names, hours.tolist(), means
