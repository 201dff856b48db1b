"""Summaries of days with many cars: by block, lane, purpose and hour; by setting; and what changes for whom.

A *block* is a facility, or where a lot has none, the slots of a tariff zone.
"""

import math
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import BoolArray, FloatArray, IntArray
from parkenv.engine.records import BALKED, GAVE_UP, STATES, TRUNCATED
from parkenv.studies.fleet.day import ALL, Day
from parkenv.studies.fleet.setting import (
    BY_HOUR,
    CAR_LISTS,
    COUNTED,
    GIVEN,
    MEASURES,
    NOWHERE,
    OWN,
    SETTING_COLUMNS,
)
from parkenv.studies.results import Row, Table
from parkenv.studies.statistics import columns_of, mean_interval, mean_or_nan, ratio_interval
from parkenv.world.lot import ParkingLot
from parkenv.world.week import DAY_S, HOUR_S

_DAY = (*SETTING_COLUMNS, "day")
# What happens in each block in each hour of a day, to cars of each purpose and of all: the share of its slots that they
# take; cars that park there, failed attempts, cars that leave; of those that park, the means of search time, walk and
# detour, and what they pay for their stays. The arrivals of `NOWHERE` are the cars that go elsewhere. Hours count from
# the midnight before the first arrival.
BLOCKS = Table(
    "blocks.csv",
    _DAY,
    (
        "block", "purpose", "hour", "type", "zone", "slots", "occupancy", "arrivals", "refused", "departures",
        "search_s", "walk_s", "cruised_m", "paid",
    ),
    long=True,
)  # fmt: skip
# What searching cars drive in each lane in each hour of a day, and how much of it is a detour; see `LaneCounts`.
LANES = Table("lanes.csv", _DAY, ("lane", "hour", "driven_m", "cruised_m"), long=True)
# Where the cars of a day are at the end of each hour: every car is in one of the states.
HOURS = Table("hours.csv", _DAY, ("purpose", "hour", *STATES), long=True)
TABLES = (BLOCKS, LANES, HOURS)
# Columns of a zone, a block or a purpose that are means over days.
MEANS = (
    "occupancy", "parked_a_day", "share_parked", "refused_a_day", "search_s", "walk_s", "cruised_m", "paid_a_day",
    "paid_a_car", "balked_fraction",
)  # fmt: skip
OF_CARS = ("search_s", "walk_s", "cruised_m")  # columns of `BLOCKS` that are means over cars
MOST_WITH_INTERVALS = 60  # blocks of a setting up to which their means have 95 % intervals


class Blocks(NamedTuple):
    """The blocks of a lot: facilities in their order, one for each of their zones, then zones."""

    names: tuple[str, ...]
    types: tuple[str, ...]  # `zone`, or that of the facility
    zones: tuple[str, ...]
    slots: IntArray  # (n_blocks,) how many cars fit
    of_slot: IntArray  # (n_slots,) block of each slot

    @classmethod
    def of(cls, lot: ParkingLot) -> Self:
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
        count = Counter((NOWHERE, NOWHERE, *names))
        names = [
            f"{name} ({kind})" if count[name] > 1 else name for name, kind in zip(names, types, strict=True)
        ]
        slots = np.bincount(of_slot, lot.capacity).astype(np.int64)
        return cls(tuple(names), tuple(types), tuple(lot.zones[zone] for zone in pairs[:, 1]), slots, of_slot)


def day_rows(day: Day) -> dict[str, Row]:
    # A row of each of `TABLES`, by its file, without setting and day.
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
    # Indices out of range are left out.
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
    """Return a row for each zone, block or purpose (`by`) in each setting: means over days, with 95 % intervals.

    Occupancy is that while cars arrive; `share_parked` is the share of the parked cars; other means are those of the
    cars that park there, or of all cars of a purpose. `prices` are those of an hour in each zone of each scenario.
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
    """Return zones, blocks or purposes and hours of a day, and sums by them, (n, n_hours) each."""
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
    sampled = np.unique(every["hour"][np.isfinite(every["occupancy"])])
    grid["occupancy"][:, ~np.isin(hours, sampled)] = np.nan
    return names.tolist(), hours, grid


def by_hour(rows: Sequence[Row], by: str) -> tuple[list[str], list[int], dict[str, FloatArray]]:
    """Return zones, blocks or purposes, hours, and means of `_grid` over the days of a setting, (n, n_hours) each."""
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


COUNTS = "counted_occupancy"
# Measures whose summary has a 95 % interval over days.
WITH_INTERVAL = ("total_s", "search_s", "members_s", "others_s", "balked_fraction")
# Columns of paired differences, and the measures that are compared.
DIFFERENCES = {
    "difference_s": "total_s",
    "members_difference_s": "members_s",
    "others_difference_s": "others_s",
}
Pairs = list[tuple[Row, Row]]  # the same days in two settings


def summarize_days(settings: Sequence[list[Row]]) -> list[Row]:
    """Return the summary, a row for each setting, from the days of each, at least one.

    The price of anarchy is the ratio of the mean total time to that of `reserve` for all cars, with the same agents and
    demand; the price over the bound, that to the clairvoyant lower bound. Differences are to the mean total time of all
    cars if nobody knows more than what it observes. All are over the days that both settings have; null without any.
    """
    by_setting = {tuple(days[0][name] for name in SETTING_COLUMNS): days for days in settings}

    def paired(days: list[Row], knows: str, share: float) -> Pairs:
        first = days[0]
        key = (first["scenario"], first["agents"], knows, share, first["arrivals_per_hour"])
        return paired_days(days, by_setting.get(key, ()))

    rows = []
    for days in settings:
        measures = [name for name in MEASURES if name != COUNTS or not math.isnan(days[0][COUNTS])]
        to_own = [
            {name: day[measure] - own["total_s"] for name, measure in DIFFERENCES.items()}
            for day, own in paired(days, OWN, 0.0)
        ]
        row = {name: days[0][name] for name in SETTING_COLUMNS}
        row |= {"days": len(days), "cars": sum(day["cars"] for day in days)}
        row |= day_means(days, measures, WITH_INTERVAL) | day_means(to_own, DIFFERENCES, DIFFERENCES)
        row |= _ratio("price_of_anarchy", paired(days, "reserve", 1.0), "total_s")
        rows.append(row | _ratio("price_over_bound", [(day, day) for day in days], "clairvoyant_s"))
    return rows


def paired_days(days: Sequence[Row], others: Sequence[Row]) -> Pairs:
    by_day = {day["day"]: day for day in others}
    return [(day, by_day[day["day"]]) for day in days if day["day"] in by_day]


def summarize_hours(settings: Sequence[list[Row]], first: int) -> list[Row]:
    rows = []
    for days in (days for days in settings if not math.isnan(days[0][COUNTS])):
        simulated, counted = (np.array([day[name].split() for day in days], float).T for name in BY_HOUR)
        setting = {name: days[0][name] for name in SETTING_COLUMNS}
        for hour, (taken, taken_counted) in enumerate(zip(simulated, counted, strict=True), start=first):
            means = {"occupancy": float(taken.mean()), COUNTS: float(taken_counted.mean())}
            excess = columns_of("excess", mean_interval(taken - taken_counted))
            rows.append({**setting, "hour": hour, **means, **excess})
    return rows


def day_means(days: Sequence[Row], measures: Iterable[str], with_interval: Collection[str]) -> Row:
    row: Row = {}
    for name in measures:
        # On a day without members, or without others, there is no mean of theirs.
        values = [day[name] for day in days if not math.isnan(day[name])]
        mean = {name: float(np.mean(values or [math.nan]))}
        row |= columns_of(name, mean_interval(values)) if name in with_interval else mean
    return row


def _ratio(name: str, pairs: Pairs, column: str) -> Row:
    if not pairs or any(math.isnan(other[column]) for _, other in pairs):
        return columns_of(name, (math.nan, math.nan, math.nan))
    total = [day["total_s"] * day["cars"] for day, _ in pairs]
    return columns_of(name, ratio_interval(total, [other[column] * other["cars"] for _, other in pairs]))


NOTICED_S = 1.0  # a car is better or worse off if its total time differs by at least this, s
_NAMED = 3  # zones whose prices change alike, above which they are counted
# Columns of a change: each has a 95 % interval over the days of both.
CHANGES = (
    "change_s", "members_change_s", "others_change_s", "search_change_s", "parking_cost_change_s", "gave_up_change_s",
    "balked_change", "paid_change", "better_off", "worse_off",
)  # fmt: skip
# Columns of a change for all cars, and the measures that change.
_OF_ALL = {
    "change_s": "total_s", "search_change_s": "search_s", "parking_cost_change_s": "parking_cost_s",
    "gave_up_change_s": "gave_up_s", "balked_change": "balked_fraction",
}  # fmt: skip
# What members know, in words.
GUIDANCE = {
    OWN: "own observations", "shared": "a live map", "reserve": "reservations", "full": "full knowledge",
}  # fmt: skip


def summarize_changes(
    settings: Sequence[list[Row]],
    prices: Mapping[str, Mapping[str, float]] = MappingProxyType({}),
    purposes: Mapping[str, Sequence[str]] = MappingProxyType({}),
) -> list[Row]:
    """Return a row for each change between two settings, from the days of each setting, at least one.

    A scenario is compared with the first one, and guidance with nobody knowing more than what it observes; everything
    else is equal, days are paired, and so are their cars. Of several zones, further rows are about the cars that parked
    in each `zone` before, and about those that found no slot, if there are some on each day: those who park gain less
    than the others by any change, as they had luck before. Of several purposes, there is a row of each.

    Of each scenario, `prices` are those of an hour in each zone, and `purposes` those of its own demand, if several.
    """
    settings = [
        [day | {c: np.array(day.get(c, "").split(), np.float64) for c in CAR_LISTS} for day in days]
        for days in settings
    ]
    by_setting = {tuple(days[0][name] for name in SETTING_COLUMNS): days for days in settings}
    first = settings[0][0]["scenario"] if settings else ""
    rows = []
    for days in settings:
        after = {name: days[0][name] for name in SETTING_COLUMNS}
        rate = after["arrivals_per_hour"]
        follows = isinstance(rate, str) and rate != GIVEN and not purposes.get(str(after["scenario"]))
        for what, earlier in (("scenario", {"scenario": first}), ("knows", {"knows": OWN, "share": 0.0})):
            if what == "scenario" and (follows or rate == COUNTED):
                continue  # a demand that follows counts has its own cars in every scenario
            before = after | earlier
            pairs = paired_days(days, by_setting.get(tuple(before.values()), ()))
            if after[what] == before[what] or not pairs:
                continue
            old, new = (prices.get(str(setting["scenario"]), {}) for setting in (before, after))
            head = {"change": what, "before": _words(what, before), "after": _words(what, after), **after}
            head |= {"days": len(pairs), "prices": _new_prices(old, new)}
            zones = (NOWHERE, *old) if len(old) > 1 else ()
            mixed = all(len(day["purpose"]) for day in pairs[0])
            named = purposes.get(str(before["scenario"]), ()) if mixed else ()
            parts: list[tuple[str, int | None, str | None]] = [("", None, None)]
            parts += [("zone", *zone) for zone in enumerate(zones)]
            parts += [("purpose", *purpose) for purpose in enumerate(named)]
            for column, number, name in parts:
                changes = [_change(*pair, column, number) for pair in pairs]
                if name != NOWHERE or all(change["cars_a_day"] for change in changes):
                    part = {"zone": None, "purpose": None} | ({column: name} if column else {})
                    rows.append(head | part | day_means(changes, ("cars_a_day", *CHANGES), CHANGES))
    return sorted(rows, key=lambda row: row["change"] != "scenario")


def _words(what: str, setting: Row) -> str:
    if what == "scenario" or setting["knows"] == OWN:
        return str(setting["scenario"] if what == "scenario" else GUIDANCE[OWN])
    members = "all" if setting["share"] == 1.0 else f"{100.0 * setting['share']:g} %"
    return f"{GUIDANCE[setting['knows']]} for {members}"


def _new_prices(before: Mapping[str, float], after: Mapping[str, float]) -> str | None:
    # Such as `centre 0 → 2 an hour`.
    new: dict[str, list[str]] = {}
    for zone, price in after.items():
        if before.get(zone, price) != price:
            new.setdefault(f"{before[zone]:g} → {price:g}", []).append(zone)
    parts = []
    for prices, zones in new.items():
        named = zones if len(zones) <= _NAMED else [zones[0], f"{len(zones) - 1} zones more"]
        parts.append(f"{', '.join(named)} {prices}")
    return f"{', '.join(parts)} an hour" if parts else None


def _change(after: Row, before: Row, column: str, number: int | None) -> Row:
    row = dict.fromkeys(("cars_a_day", *CHANGES), float("nan"))
    if number is None:
        row |= {change: after[name] - before[name] for change, name in _OF_ALL.items()}
        row["cars_a_day"] = after["cars"]
    times, earlier, member = after["total_cs"], before["total_cs"], after["member"]
    if not len(times) == len(earlier) == len(member) > 0:
        return row
    chosen = np.ones(len(times), bool) if number is None else before[column] == number
    gained = (times - earlier) / 100.0
    cents, earlier_cents = after["paid_cents"], before["paid_cents"]
    if len(cents) or len(earlier_cents):
        free = np.zeros(len(times))  # in a lot without prices
        cents, earlier_cents = (known if len(known) else free for known in (cents, earlier_cents))
        row["paid_change"] = mean_or_nan((cents - earlier_cents)[chosen] / 100.0)
    if number is not None:
        row |= {"cars_a_day": float(chosen.sum()), "change_s": mean_or_nan(gained[chosen])}
    return row | {
        "members_change_s": mean_or_nan(gained[chosen & (member == 1.0)]),
        "others_change_s": mean_or_nan(gained[chosen & (member == 0.0)]),
        "better_off": mean_or_nan((gained <= -NOTICED_S)[chosen]),
        "worse_off": mean_or_nan((gained >= NOTICED_S)[chosen]),
    }
