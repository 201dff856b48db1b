"""Summaries of the days of a study of many cars: settings, hours, and what changes for the same cars."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from types import MappingProxyType

import numpy as np

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
from parkenv.studies.results import Row
from parkenv.studies.statistics import columns_of, mean_interval, mean_or_nan, ratio_interval

ASSIGNED = "reserve"
COUNTS = "counted_occupancy"
WITH_INTERVAL = ("total_s", "search_s", "members_s", "others_s", "balked_fraction")
"""Measures whose summary has a 95 % interval over days."""
DIFFERENCES = {
    "difference_s": "total_s",
    "members_difference_s": "members_s",
    "others_difference_s": "others_s",
}
"""Columns of paired differences, and the measures that are compared."""
Pairs = list[tuple[Row, Row]]
"""The same days in two settings."""


def summarize_days(settings: Sequence[list[Row]]) -> list[Row]:
    """Return the summary, a row for each setting, from the days of each, at least one.

    The *price of anarchy* of a row is the ratio of its mean total time to that of `reserve` for all cars, with the same
    agents and demand; its interval is a bootstrap over days. The *price over the bound* is the ratio to the clairvoyant
    lower bound of the same days, likewise. Differences are paired: to the mean total time of all cars
    on the same days if nobody knows more than what it observes. Both are over the days that both settings have; null if
    there are none.
    """
    by_setting = {tuple(days[0][name] for name in SETTING_COLUMNS): days for days in settings}

    def paired(days: list[Row], knows: str, share: float) -> Pairs:
        first = days[0]
        key = (first["scenario"], first["agents"], knows, share, first["arrivals_per_hour"])
        return paired_days(days, by_setting.get(key, ()))

    def differences(days: list[Row]) -> list[Row]:
        pairs = paired(days, OWN, 0.0)
        return [{name: one[c] - other["total_s"] for name, c in DIFFERENCES.items()} for one, other in pairs]

    return [
        {
            **{name: days[0][name] for name in SETTING_COLUMNS},
            "days": len(days),
            "cars": sum(day["cars"] for day in days),
            **day_means(
                days, [name for name in MEASURES if name != COUNTS or _is_counted(days)], WITH_INTERVAL
            ),
            **day_means(differences(days), DIFFERENCES, DIFFERENCES),
            **_ratio("price_of_anarchy", paired(days, ASSIGNED, 1.0), "total_s"),
            **_ratio("price_over_bound", [(day, day) for day in days], "clairvoyant_s"),
        }
        for days in settings
    ]


def paired_days(days: Sequence[Row], others: Sequence[Row]) -> Pairs:
    by_day = {day["day"]: day for day in others}
    return [(day, by_day[day["day"]]) for day in days if day["day"] in by_day]


def _is_counted(days: Sequence[Row]) -> bool:
    return not math.isnan(days[0][COUNTS])


def summarize_hours(settings: Sequence[list[Row]], first: int) -> list[Row]:
    """Return the mean occupancy in each hour, simulated and as counted, of settings where it is known."""
    rows = []
    for days in filter(_is_counted, settings):
        simulated, counted = (np.array([day[name].split() for day in days], float).T for name in BY_HOUR)
        setting = {name: days[0][name] for name in SETTING_COLUMNS}
        for hour, (taken, taken_counted) in enumerate(zip(simulated, counted, strict=True), start=first):
            means = {"occupancy": float(taken.mean()), COUNTS: float(taken_counted.mean())}
            excess = columns_of("excess", mean_interval(taken - taken_counted))
            rows.append({**setting, "hour": hour, **means, **excess})
    return rows


def day_means(days: Sequence[Row], measures: Iterable[str], with_interval: Collection[str]) -> Row:
    """Return the mean of each measure over days, some with a 95 % interval."""
    row: Row = {}
    for name in measures:
        # On a day without members, or without others, there is no mean of theirs.
        values = [day[name] for day in days if not math.isnan(day[name])]
        row |= (
            columns_of(name, mean_interval(values))
            if name in with_interval
            else {name: float(np.mean(values or [math.nan]))}
        )
    return row


def _ratio(name: str, pairs: Pairs, column: str) -> Row:
    if not pairs or any(math.isnan(other[column]) for _, other in pairs):
        return columns_of(name, (math.nan, math.nan, math.nan))
    sums = (
        [day[c] * day["cars"] for day in days]
        for c, days in zip(("total_s", column), zip(*pairs, strict=True), strict=True)
    )
    return columns_of(name, ratio_interval(*sums))


NOTICED_S = 1.0  # a car is better or worse off if its total time differs by at least this, s
_NAMED = 3  # zones whose prices change alike, above which they are counted
CHANGES = (
    "change_s", "members_change_s", "others_change_s", "search_change_s", "parking_cost_change_s", "gave_up_change_s",
    "balked_change", "paid_change", "better_off", "worse_off",
)  # fmt: skip
"""Columns of a change: each has a 95 % interval over the days of both."""
GUIDANCE = {
    OWN: "own observations", "shared": "a live map", "reserve": "reservations", "full": "full knowledge",
}  # fmt: skip
"""What members know, in words."""


def summarize_changes(
    settings: Sequence[list[Row]],
    prices: Mapping[str, Mapping[str, float]] = MappingProxyType({}),
    purposes: Mapping[str, Sequence[str]] = MappingProxyType({}),
) -> list[Row]:
    """Return a row for each change between two settings, from the days of each setting, at least one.

    A scenario is compared with the first one, and guidance with nobody knowing more than what it observes; everything
    else is equal. Days are paired, and on each of them the cars: members, and others, are the same cars before and
    after. Differences are those after minus those before, so that negative times are gains. Where a lot has several
    zones, further rows are about the cars that parked in each `zone` before, and about those that found no slot, if
    there are some on each day: those who park gain less than the others by any change, as they had luck before. Of
    several purposes, further rows are about the cars of each `purpose`. Both are None for all cars.

    Args:
        settings: the days of each setting.
        prices: of each scenario, the price of an hour in each zone of the lot, in the order of the zones.
        purposes: of each scenario, those of its own demand, in their order, where there are several.
    """
    settings = [[_with_lists(day) for day in days] for days in settings]
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
    """Return what is compared of a setting.

    Examples:
        >>> _words("knows", {"knows": "reserve", "share": 0.25}), _words("knows", {"knows": "own", "share": 0.0})
        ('reservations for 25 %', 'own observations')
    """
    if what == "scenario" or setting["knows"] == OWN:
        return str(setting["scenario"] if what == "scenario" else GUIDANCE[OWN])
    members = "all" if setting["share"] == 1.0 else f"{100.0 * setting['share']:g} %"
    return f"{GUIDANCE[setting['knows']]} for {members}"


def _new_prices(before: Mapping[str, float], after: Mapping[str, float]) -> str | None:
    """Return the prices that change, in words; None if none does.

    Examples:
        >>> _new_prices({"centre": 0.0, "ring": 0.5}, {"centre": 2.0, "ring": 0.5})
        'centre 0 → 2 an hour'
    """
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
    """Return what changes on a day, with its lists, for some cars; NaN where it is not known.

    They are those that have a number in a column of `CAR_LISTS` before: that parked in a `zone`, or are of a `purpose`.
    None is for all cars.
    """
    row = dict.fromkeys(("cars_a_day", *CHANGES), float("nan"))
    if number is None:
        row |= {
            "cars_a_day": after["cars"],
            "change_s": after["total_s"] - before["total_s"],
            "search_change_s": after["search_s"] - before["search_s"],
            "parking_cost_change_s": after["parking_cost_s"] - before["parking_cost_s"],
            "gave_up_change_s": after["gave_up_s"] - before["gave_up_s"],
            "balked_change": after["balked_fraction"] - before["balked_fraction"],
        }
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


def _with_lists(day: Row) -> Row:
    return {**day, **{name: np.array(day.get(name, "").split(), np.float64) for name in CAR_LISTS}}
