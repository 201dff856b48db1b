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
from parkenv.engine.fleet import Fleet
from parkenv.engine.records import BALKED, GAVE_UP, SEARCHING, STATES, STEP, TRUNCATED
from parkenv.files.csv_tables import NUMBER_OR_NAN, TEXT, WHOLE
from parkenv.studies.fleet.setting import KINDS, NOWHERE, SETTING_COLUMNS
from parkenv.studies.fleet.tables import day_means
from parkenv.studies.results import LongTable, Row
from parkenv.world.lot import ParkingLot
from parkenv.world.scenario import Scenario
from parkenv.world.tariff import HOUR_S, NO_ZONE
from parkenv.world.week import DAY_S

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
    "paid_a_car",
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
        metres: by hour, (2, n_lanes) float64, m: driven, and cruised.
        refused: (k, 3) int64, failed attempts: car, slot, hour.
    """

    def __init__(self, fleet: Fleet, roads: Roads) -> None:
        self._fleet, self._roads = fleet, roads
        self._open = np.zeros(0, STEP)
        self.metres: dict[int, FloatArray] = {}
        self.refused = np.zeros((0, 3), np.int64)
        fleet.keep_steps()

    def update(self) -> None:
        """Count the steps since the last call; those of cars that still search are counted later."""
        steps = np.concatenate([self._open, self._fleet.take_steps()])
        searches = self._fleet.cars["state"][steps["car"]] == SEARCHING
        self._open, steps = steps[searches], steps[~searches]
        fleet, lot = self._fleet, self._fleet.scenario.lot
        steps = steps[np.argsort(steps["car"], kind="stable")]
        car, origin, vertex, failed = (steps[name] for name in ("car", "origin", "vertex", "failed"))
        column = (lot.neighbors[origin] == vertex[:, None]).argmax(axis=1)
        lane, hour = self._roads.lane_of_edge[origin, column], hour_of(fleet, steps["begin"])
        driven = np.where(origin == vertex, 0.0, lot.edge_length[origin, column])
        so_far = np.cumsum(driven)
        so_far -= (so_far - driven)[np.searchsorted(car, car)]
        ended, number = np.unique(car, return_inverse=True)
        cruised = np.clip(so_far - self._roads.direct_m(fleet.cars[ended])[number], 0.0, driven)
        for now in np.unique(hour).tolist():
            its = hour == now
            sums = [np.bincount(lane[its], metres[its], len(lot.lanes)) for metres in (driven, cruised)]
            self.metres[now] = self.metres.get(now, np.zeros((2, len(lot.lanes)))) + sums
        self.refused = np.concatenate([self.refused, np.stack([car, vertex, hour], axis=1)[failed]])


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
    of_lanes = [tally.metres.get(hour, np.zeros((2, len(fleet.scenario.lot.lanes)))) for hour in hours]
    driven, cruised = np.array(of_lanes).transpose(1, 2, 0).round(1)
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
    cars, first = fleet.cars, hours[0]
    purpose, parked, n_blocks = np.zeros(len(cars), np.int64), cars["slot"] >= 0, len(blocks.names)
    block = np.where(parked, blocks.of_slot[cars["slot"]], n_blocks)
    leaves = np.where(parked, cars["ended_at"] + cars["stay_s"], -np.inf)
    shape = n_blocks + 1, 1, len(hours)
    ended = block, purpose, hour_of(fleet, cars["ended_at"]) - first
    arrivals = _sums(shape, ended)
    car, slot, hour = tally.refused.T
    refused = _sums(shape, (blocks.of_slot[slot], purpose[car], hour - first))
    left = np.where(np.isfinite(leaves), leaves, fleet.begin - HOUR_S)
    departures = _sums(shape, (block, purpose, hour_of(fleet, left) - first))
    search_s, walk_s = cars["ended_at"] - cars["arrival"], cars["walk_s"]
    of_cars = [
        np.divide(sums, arrivals, out=np.full(shape, np.nan), where=arrivals > 0).round(2)
        for sums in (_sums(shape, ended, values) for values in (search_s, walk_s, cruised_m))
    ]
    occupancy = np.full(shape, np.nan)
    looks = hour_of(fleet, times) - first
    in_block = np.array([np.bincount(blocks.of_slot, row, n_blocks) for row in taken])
    for hour in np.unique(looks):
        occupancy[:-1, 0, hour] = in_block[looks == hour].mean(axis=0) / blocks.slots
    there = (arrivals + refused + departures > 0) | (occupancy > 0.0)
    there[:-1, 0] = True
    b, p, h = np.nonzero(there)
    names, types, zones = (np.array([*its, NOWHERE]) for its in (blocks.names, blocks.types, blocks.zones))
    counts = (
        its[there]
        for its in (occupancy, arrivals, refused, departures, *of_cars, _sums(shape, ended, paid(fleet)))
    )
    return _row(
        BLOCKS,
        names[b],
        np.array([ALL])[p],
        hours[h],
        types[b],
        zones[b],
        np.append(blocks.slots, 0)[b],
        *counts,
    )


def _sums(shape: tuple[int, ...], at: Sequence[IntArray], values: FloatArray | None = None) -> NDArray[Any]:
    """Return sums of values, or numbers of them, by indices of which those out of range are left out."""
    inside = np.all([(index >= 0) & (index < n) for index, n in zip(at, shape, strict=True)], axis=0)
    flat = np.ravel_multi_index([index[inside] for index in at], shape)
    weights = None if values is None else values[inside]
    return np.bincount(flat, weights, math.prod(shape)).reshape(shape)


def _hour_row(fleet: Fleet, hours: IntArray) -> Row:
    cars, ends = fleet.cars, fleet.begin // DAY_S * DAY_S + HOUR_S * (hours + 1)

    def until(times: FloatArray) -> IntArray:
        return np.searchsorted(np.sort(times), ends, side="right")

    parks = cars["slot"] >= 0
    arrived, ended, left = (
        until(cars["arrival"]),
        until(cars["ended_at"]),
        until((cars["ended_at"] + cars["stay_s"])[parks]),
    )
    gone = [until(cars["ended_at"][cars["state"] == state]) for state in (GAVE_UP, BALKED, TRUNCATED)]
    parked = until(cars["ended_at"][parks]) - left
    counts = len(cars) - arrived, arrived - ended, parked, left, *gone
    return _row(HOURS, np.full(len(hours), ALL), hours, *counts)


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
    made, known = [], ("block", "type", "zone", "slots")
    with_interval = MEANS if len({key[-1] for key in days}) <= MOST_WITH_INTERVALS else ()
    for key, of_days in days.items():
        about: Row = dict(zip((*SETTING_COLUMNS, by), key, strict=True))
        about |= {name: of_days[0][name] for name in known if name in of_days[0]}
        if "zone" in about:
            about["price"] = prices.get(about["scenario"], {}).get(about["zone"], 0.0)
        made.append(about | day_means(of_days, MEANS, with_interval))
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
