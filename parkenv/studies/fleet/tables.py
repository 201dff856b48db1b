"""Summary of the days of a study of many cars."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence

import numpy as np

from parkenv.studies.fleet.setting import (
    BY_HOUR,
    MEASURES,
    OWN,
    SETTING_COLUMNS,
)
from parkenv.studies.results import Row
from parkenv.studies.statistics import columns_of, mean_interval, ratio_interval

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

    return [
        {
            **{name: days[0][name] for name in SETTING_COLUMNS},
            "days": len(days),
            "cars": sum(day["cars"] for day in days),
            **day_means(
                days, [name for name in MEASURES if name != COUNTS or _is_counted(days)], WITH_INTERVAL
            ),
            **_differences(paired(days, OWN, 0.0)),
            **_ratio("price_of_anarchy", paired(days, ASSIGNED, 1.0), "total_s"),
            **_ratio("price_over_bound", [(day, day) for day in days], "clairvoyant_s"),
        }
        for days in settings
    ]


def paired_days(days: Sequence[Row], others: Sequence[Row]) -> Pairs:
    """Return the days of a setting, each with the same day in another one, as far as both have it."""
    by_day = {day["day"]: day for day in others}
    return [(day, by_day[day["day"]]) for day in days if day["day"] in by_day]


def _is_counted(days: Sequence[Row]) -> bool:
    return not math.isnan(days[0][COUNTS])


def summarize_hours(settings: Sequence[list[Row]], first: int) -> list[Row]:
    """Return the mean occupancy in each hour, simulated and as counted, of settings where it is known."""
    rows = []
    for days in filter(_is_counted, settings):
        simulated, counted = (np.array([day[name].split() for day in days], float).T for name in BY_HOUR)
        for hour, (mine, theirs) in enumerate(zip(simulated, counted, strict=True), start=first):
            its = {name: days[0][name] for name in SETTING_COLUMNS} | {"hour": hour}
            means = {"occupancy": float(mine.mean()), COUNTS: float(theirs.mean())}
            rows.append(its | means | columns_of("excess", mean_interval(mine - theirs)))
    return rows


def _differences(pairs: Pairs) -> Row:
    apart = [
        {name: one[column] - other["total_s"] for name, column in DIFFERENCES.items()} for one, other in pairs
    ]
    return day_means(apart, DIFFERENCES, DIFFERENCES)


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
    """Return the ratio of the total time of all cars to a column of the same days, with a bootstrap over days."""
    if not pairs or any(math.isnan(theirs[column]) for _, theirs in pairs):
        return columns_of(name, (math.nan, math.nan, math.nan))
    mine, theirs = (
        [day[name] * day["cars"] for day in days]
        for name, days in zip(("total_s", column), zip(*pairs, strict=True), strict=True)
    )
    return columns_of(name, ratio_interval(mine, theirs))
