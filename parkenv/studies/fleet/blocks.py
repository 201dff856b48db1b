"""Measures of a day with many cars by block, lane, purpose and hour.

A *block* is a facility, or where a lot has none, the slots of a tariff zone.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import BoolArray, FloatArray, IntArray
from parkenv.engine.records import BALKED, GAVE_UP, STATES, TRUNCATED
from parkenv.studies.fleet.day import ALL, Day
from parkenv.studies.fleet.setting import NOWHERE, SETTING_COLUMNS
from parkenv.studies.fleet.tables import day_means
from parkenv.studies.results import Row, Table
from parkenv.world.lot import ParkingLot
from parkenv.world.scenario import Scenario
from parkenv.world.tariff import NO_ZONE
from parkenv.world.week import DAY_S, HOUR_S

_DAY = (*SETTING_COLUMNS, "day")
BLOCKS = Table(
    "blocks.csv",
    _DAY,
    (
        "block", "purpose", "hour", "type", "zone", "slots", "occupancy", "arrivals", "refused", "departures",
        "search_s", "walk_s", "cruised_m", "paid",
    ),
    long=True,
)  # fmt: skip
"""What happens in each block in each hour of a day, to cars of each purpose and of all: the share of its slots that
they take; cars that park there, failed attempts, cars that leave; of those that park, the means of search time, walk
and detour, and what they pay for their stays. The arrivals of `NOWHERE` are the cars that go elsewhere. Hours count
from the midnight before the first arrival."""
LANES = Table("lanes.csv", _DAY, ("lane", "hour", "driven_m", "cruised_m"), long=True)
"""What searching cars drive in each lane in each hour of a day, and how much of it is a detour; see `LaneCounts`."""
HOURS = Table("hours.csv", _DAY, ("purpose", "hour", *STATES), long=True)
"""Where the cars of a day are at the end of each hour: every car is in one of the states."""
TABLES = (BLOCKS, LANES, HOURS)
MEANS = (
    "occupancy", "parked_a_day", "share_parked", "refused_a_day", "search_s", "walk_s", "cruised_m", "paid_a_day",
    "paid_a_car", "balked_fraction",
)  # fmt: skip
"""Columns of a zone, a block or a purpose that are means over days."""
OF_CARS = ("search_s", "walk_s", "cruised_m")
"""Columns of `BLOCKS` that are means over cars."""
MOST_WITH_INTERVALS = 60  # blocks of a setting up to which their means have 95 % intervals


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
                name, kind = lot.facilities[number].name, lot.facilities[number].kind
                names.append(f"{name}, {lot.zones[zone]}" if several[number] else name)
                types.append(kind)
        twice = {name for name in names if names.count(name) > 1} if len({*names}) < len(names) else {NOWHERE}
        names = [
            f"{name} ({kind})" if name in twice else name for name, kind in zip(names, types, strict=True)
        ]
        zones = tuple(lot.zones[zone] for zone in pairs[:, 1])
        slots = np.bincount(of_slot, lot.capacity).astype(np.int64)
        return cls(tuple(names), tuple(types), zones, slots, of_slot)


def has_zones(scenario: Scenario) -> bool:
    return scenario.has_rules or scenario.lot.zones != (NO_ZONE,)


def zone_prices(scenario: Scenario) -> dict[str, float]:
    return {
        name: float(zone.price.amount(scenario.priced_at_s, HOUR_S))
        for name, zone in zip(scenario.lot.zones, scenario.zone_rules, strict=True)
    }


def day_rows(day: Day) -> dict[str, Row]:
    """Return a row of each of `TABLES`, by its file, without setting and day."""
    ends = day.hour_of(np.array([day.fleet.begin, day.times[-1], day.fleet.cars["ended_at"].max()]))
    hours = np.arange(ends[0], ends.max() + 1)
    driven, cruised = day.lanes.metres.transpose(2, 1, 0).round(1)
    lane, hour = np.nonzero(driven)
    return {
        BLOCKS.file: _block_row(day, hours),
        LANES.file: _row(LANES, lane, hours[hour], driven[lane, hour], cruised[lane, hour]),
        HOURS.file: _hour_row(day, hours),
    }


def _row(table: Table, *columns: NDArray[Any]) -> Row:
    return {name: values.tolist() for name, values in zip(table.columns, columns, strict=True)}


def _block_row(day: Day, hours: IntArray) -> Row:
    cars, first, (names, purpose) = day.fleet.cars, hours[0], day.purposes
    blocks = Blocks.of(day.fleet.scenario.lot)
    n_blocks, parked, arrives = len(blocks.names), cars["slot"] >= 0, cars["parked_at"] < 0
    block = np.where(parked, blocks.of_slot[cars["slot"]], n_blocks)
    leaves = np.where(parked, cars["ended_at"] + cars["stay_s"], np.inf)
    shape = n_blocks + 1, len(names), len(hours)

    def sums_at(time: FloatArray, which: BoolArray, values: FloatArray | None = None) -> NDArray[Any]:
        at = block[which], purpose[which], day.hour_of(time[which]) - first
        return _with_all(_sums(shape, at, None if values is None else values[which]))

    car, slot, hour = day.lanes.refused.T
    refused = _with_all(_sums(shape, (blocks.of_slot[slot], purpose[car], hour - first)))
    arrivals = sums_at(cars["ended_at"], arrives)
    departures = sums_at(leaves, np.isfinite(leaves))
    amounts = sums_at(cars["ended_at"], arrives, day.paid())
    of_cars = cars["ended_at"] - cars["arrival"], cars["walk_s"], day.roads.cruised_m(cars)
    totals = (sums_at(cars["ended_at"], arrives, values) for values in of_cars)
    unknown = np.full(arrivals.shape, np.nan)
    means = [np.divide(sums, arrivals, out=unknown.copy(), where=arrivals > 0).round(2) for sums in totals]
    # Cars of each purpose in each block at each sample; with residents of the background, there may be more in all.
    comes, goes = (np.searchsorted(day.times, times[parked]) for times in (cars["ended_at"], leaves))
    at_samples = n_blocks + 1, len(names), len(day.times) + 1
    come, gone = (_sums(at_samples, (block[parked], purpose[parked], sample)) for sample in (comes, goes))
    there = _with_all(np.cumsum(come - gone, axis=2)[..., :-1])
    there[:-1, 0] = np.array([np.bincount(blocks.of_slot, row, n_blocks) for row in day.taken]).T
    occupancy, sampled = unknown, day.hour_of(day.times) - first
    for hour in np.unique(sampled):
        occupancy[:-1, :, hour] = there[:-1, :, sampled == hour].mean(axis=2) / blocks.slots[:, None]
    shown = (arrivals + refused + departures > 0) | (occupancy > 0.0)
    shown[:-1, 0] = True
    b, p, h = np.nonzero(shown)
    block_name, kind, zone = (
        np.array([*texts, NOWHERE])[b] for texts in (blocks.names, blocks.types, blocks.zones)
    )
    numbers = (values[shown] for values in (occupancy, arrivals, refused, departures, *means, amounts))
    purpose_name = np.array(names if len(names) == 1 else (ALL, *names))[p]
    return _row(
        BLOCKS, block_name, purpose_name, hours[h], kind, zone, np.append(blocks.slots, 0)[b], *numbers
    )


def _with_all(sums: NDArray[Any]) -> NDArray[Any]:
    return sums if sums.shape[1] == 1 else np.concatenate([sums.sum(axis=1, keepdims=True), sums], axis=1)


def _sums(shape: tuple[int, ...], at: Sequence[IntArray], values: FloatArray | None = None) -> NDArray[Any]:
    """Return sums of values, or numbers of them, by indices of which those out of range are left out."""
    inside = np.all([(index >= 0) & (index < n) for index, n in zip(at, shape, strict=True)], axis=0)
    flat = np.ravel_multi_index([index[inside] for index in at], shape)
    weights = None if values is None else values[inside]
    return np.bincount(flat, weights, math.prod(shape)).reshape(shape)


def _hour_row(day: Day, hours: IntArray) -> Row:
    ends = day.fleet.begin // DAY_S * DAY_S + HOUR_S * (hours + 1)
    names, purpose = day.purposes
    groups = {ALL: np.ones(len(purpose), bool)}
    groups |= {name: purpose == number for number, name in enumerate(names) if name != ALL}

    def until(times: FloatArray) -> IntArray:
        return np.searchsorted(np.sort(times), ends, side="right")

    counts = []
    for which in groups.values():
        cars = day.fleet.cars[which]
        parks = cars["slot"] >= 0
        arrived, ended = until(cars["arrival"]), until(cars["ended_at"])
        left = until((cars["ended_at"] + cars["stay_s"])[parks])
        gone = [until(cars["ended_at"][cars["state"] == state]) for state in (GAVE_UP, BALKED, TRUNCATED)]
        parked = until(cars["ended_at"][parks]) - left
        counts.append([len(cars) - arrived, arrived - ended, parked, left, *gone])
    purposes = np.repeat([*groups], len(hours))
    return _row(HOURS, purposes, np.tile(hours, len(groups)), *np.concatenate(counts, axis=1))


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
        for name, measures in _day_by(row, by).items():
            days.setdefault((*(row[column] for column in SETTING_COLUMNS), name), []).append(measures)
    with_interval = MEANS if len({key[-1] for key in days}) <= MOST_WITH_INTERVALS else ()
    summary = []
    for key, of_days in days.items():
        line: Row = dict(zip((*SETTING_COLUMNS, by), key, strict=True))
        if by != "purpose":
            line |= {name: of_days[0][name] for name in ("type", "zone", "slots") if name in of_days[0]}
            line["price"] = prices.get(line["scenario"], {}).get(line["zone"], 0.0)
        summary.append(line | day_means(of_days, MEANS if by == "purpose" else MEANS[:-1], with_interval))
    return summary


def _day_by(row: Row, by: str) -> dict[str, Row]:
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
    if by == "block":
        first = [row["block"].index(name) for name in names]
        columns |= {name: np.array(row[name])[first] for name in ("type", "zone")}
    return {name: {c: values[i].item() for c, values in columns.items()} for i, name in enumerate(names)}


def _grid(row: Row, by: str) -> tuple[list[str], IntArray, dict[str, FloatArray]]:
    """Return zones, blocks or purposes and hours of a day, a row of `BLOCKS`, and sums by them, (n, n_hours) each."""
    every = {column: np.array(row[column]) for column in BLOCKS.columns}
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
        of_all = (every["purpose"] == ALL) & (every["hour"] == hours[0])
        grid["slots"][:] = every["slots"][of_all].sum()
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
    names = sorted({name for of_day, _, _ in days for name in of_day})
    hours = np.unique(np.concatenate([of_day for _, of_day, _ in days]))
    means: dict[str, FloatArray] = {}
    for column in days[0][2]:
        of_days = np.full((len(days), len(names), len(hours)), np.nan if column == "occupancy" else 0.0)
        for values, (of_day, there, grid) in zip(of_days, days, strict=True):
            values[np.ix_(np.searchsorted(names, of_day), np.searchsorted(hours, there))] = grid[column]
        known = np.isfinite(of_days)
        days_known = np.where(known.any(axis=0), known.sum(axis=0), np.nan)
        means[column] = np.where(known, of_days, 0.0).sum(axis=0) / days_known
    return names, hours.tolist(), means
