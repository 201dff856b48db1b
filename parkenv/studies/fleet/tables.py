"""Summary of the days of a study of many cars."""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Iterable, Sequence
from typing import Any

import numpy as np

from parkenv.studies.fleet.setting import (
    BY_HOUR,
    COUNTED,
    MEASURES,
    OWN,
    SETTING_COLUMNS,
    rate_text,
    times_demanded,
)
from parkenv.studies.results import Row
from parkenv.studies.statistics import columns_of, mean_interval, ratio_interval

ASSIGNED = "reserve"
COUNTS = "counted_occupancy"
FAR = 0.03
"""Difference between simulated and counted occupancy that is said."""
WITH_INTERVAL = ("total_s", "search_s", "members_s", "others_s", "balked_fraction")
"""Measures whose summary has a 95 % interval over days."""
DIFFERENCES = {
    "difference_s": "total_s",
    "members_difference_s": "members_s",
    "others_difference_s": "others_s",
}
"""Columns of paired differences, and the measures that are compared."""
ONE_DAY = "One day has no interval: a difference may be chance. Five days or more (-n 5) tell."
"""Said where each setting has one day."""
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
    """Return the mean occupancy in each hour, simulated and as counted, of settings where it is known.

    Args:
        settings: the days of each setting.
        first: the hour of the day in which cars begin to arrive.
    """
    rows = []
    for days in filter(_is_counted, settings):
        simulated, counted = (np.array([day[name].split() for day in days], float).T for name in BY_HOUR)
        for hour, (mine, theirs) in enumerate(zip(simulated, counted, strict=True), start=first):
            its = {name: days[0][name] for name in SETTING_COLUMNS} | {"hour": hour}
            means = {"occupancy": float(mine.mean()), COUNTS: float(theirs.mean())}
            rows.append(its | means | columns_of("excess", mean_interval(mine - theirs)))
    return rows


def carried(rows: Sequence[Row], most_balked: float) -> list[str]:
    """Say up to which of the demands driven at most a share of the cars finds no slot; nothing of a single demand.

    A line for each scenario, agent and guidance of all cars, of demands in cars an hour and of multiples.

    Args:
        rows: of `summarize_days`.
        most_balked: that share.
    """
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        if row["share"] in (0.0, 1.0):
            key = (row["scenario"], row["agents"], row["knows"], isinstance(row["arrivals_per_hour"], str))
            groups.setdefault(key, []).append(row)

    def rate(row: Row) -> float:
        its = row["arrivals_per_hour"]
        return times_demanded(its) if isinstance(its, str) else float(its)

    def found(row: Row) -> str:
        low, high = row["balked_fraction_ci95"]
        interval = "" if None in (low, high) or low != low else f" [{max(low, 0.0):.1%}, {high:.1%}]"
        return f"{row['balked_fraction']:.1%}{interval}"

    said = []
    for (scenario, agent, knows, is_times), its in groups.items():
        its = sorted(its, key=rate)
        if len(its) == 1:
            continue
        few = list(itertools.takewhile(lambda row: row["balked_fraction"] <= most_balked, its))
        if len(few) == len(its):
            tried = (
                f"at {rate_text(its[-1]['arrivals_per_hour'])}, the most tried, {found(its[-1])} find no slot"
            )
        else:
            above, most = its[len(few)], f"{most_balked:.0%} of the cars find no slot"
            at = f"at {rate_text(above['arrivals_per_hour'])}"
            tried = f"{at}, the fewest tried, already more than {most}: {found(above)}"
            if few:
                up_to = f"up to {rate_text(few[-1]['arrivals_per_hour'])}"
                tried = f"{up_to} at most {most} ({found(few[-1])}); {at} it is {found(above)}"
            between = np.linspace(rate(few[-1]) if few else 0.0, rate(above), 5)[1:-1]
            closer = ",".join(f"{value:.3g}{'x' * is_times}" for value in between)
            tried += f". --arrivals-per-hour {closer} looks closer"
        said.append(f"{agent} on {scenario}, {knows}: {tried}.")
    return said


def unreached(reach: Sequence[Row]) -> list[str]:
    """Say from how many entries of a lot most spaces cannot be reached: `scenario`, and `Roads.reach`."""
    return [
        f"On {its['scenario']}, most spaces cannot be reached from {its['entries_cut_off']} of the {its['entries']} "
        "entries: look at the streets there (parkenv lot show --graph)."
        for its in reach
        if its["entries_cut_off"]
    ]


def departures(hours: Sequence[Row], rows: Sequence[Row]) -> list[str]:
    """Say when the lot is least as full as counted, by more than `FAR` and not by chance, and why, if that is known.

    A line for each scenario, agent and demand; nothing of so many times the counted demand, which is not meant to be as
    full.

    Args:
        hours: of `summarize_hours`.
        rows: of `summarize_days`.
    """
    balked = {tuple(row[name] for name in SETTING_COLUMNS): row["balked_fraction"] for row in rows}
    worst: dict[tuple[str, str, float | str], Row] = {}
    for row in sorted(hours, key=lambda row: abs(row["excess"])):
        (low, high), rate = row["excess_ci95"], row["arrivals_per_hour"]
        meant = rate == COUNTED or not isinstance(rate, str)
        if meant and abs(row["excess"]) > FAR and (low or 0.0) * (high or 0.0) > 0.0:
            worst[row["scenario"], row["agents"], rate] = row

    def reason(row: Row) -> str:
        gone = balked.get(tuple(row[name] for name in SETTING_COLUMNS))
        if row["arrivals_per_hour"] != COUNTED:
            return "; --arrivals-per-hour counted follows the counts"
        if row["excess"] > 0.0:
            return "; shorter stays (--stay-min) may follow better"
        return f"; it is full at times, and {gone:.1%} of the cars go elsewhere" if gone else ""

    return [
        f"{agent} on {scenario}, {row['knows']}, {rate_text(rate)}: from {row['hour']}:00 to {row['hour'] + 1}:00 "
        f"{row['occupancy']:.0%} of the slots are taken, as counted {row[COUNTS]:.0%}{reason(row)}."
        for (scenario, agent, rate), row in worst.items()
    ]


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
