"""Summaries of a commute by day and by week."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from parkenv.studies.results import Row
from parkenv.studies.statistics import columns_of, mean_interval, trimmed_mean_interval

FIXED, NONE = "fixed", "none"
"""Names in the column `map` of the references: a right map that does not learn; an agent that uses no map."""
TRIMMED = 0.1
"""Share of the courses, at either end, that a robust mean leaves out."""


def day_rows(episodes: Sequence[Row]) -> list[Row]:
    """Return a row per scenario, map, agent and day: mean total time and forecast error, with 95 % intervals.

    The forecast error is the Brier score of the forecast at the arrival: the mean squared difference of P(taken) and
    the true state, over slots. The excess is the time beyond that of the first agent with the right map, which does not
    learn, in the same worlds: a 10 % trimmed mean, since a full lot may add the give-up penalty to one of the two.
    Intervals are over courses: a fleet's drivers meet the same day.
    """
    cases = _grouped(episodes, lambda row: row["day_number"])
    return [
        {
            **dict(zip(("scenario", "map", "agent"), case, strict=True)),
            "day": day,
            "courses": len(by_course),
            **_mean("total_s", its),
            **_mean("forecast_error", its),
            **_difference("excess_s", by_course, _reference(cases, case[0], FIXED).get(day, {}), _robust),
        }
        for case, by_day in cases.items()
        for day, by_course in sorted(by_day.items())
        for its in [list(by_course.values())]
    ]


def week_rows(episodes: Sequence[Row]) -> list[Row]:
    """Return a row per scenario, map, agent and five days, with the paired difference to the first agent without a map.

    The difference is paired by course: the same driver on the same days.
    """
    cases = _grouped(episodes, lambda row: (row["day_number"] - 1) // 5 + 1)
    last = max((row["day_number"] for row in episodes), default=0)
    return [
        {
            **dict(zip(("scenario", "map", "agent"), case, strict=True)),
            "days": f"{5 * week - 4}-{min(5 * week, last)}",
            "courses": len(by_course),
            **_mean("total_s", its),
            **_mean("forecast_error", its),
            **_difference("difference_s", by_course, _reference(cases, case[0], NONE).get(week, {})),
            **_difference("excess_s", by_course, _reference(cases, case[0], FIXED).get(week, {}), _robust),
        }
        for case, by_week in cases.items()
        for week, by_course in sorted(by_week.items())
        for its in [list(by_course.values())]
    ]


_Runs = dict[int, list[Row]]
_Cases = dict[tuple[str, str, str], dict[int, _Runs]]


def _reference(cases: _Cases, scenario: str, map: str) -> dict[int, _Runs]:
    """Return the first agent with a map in a scenario, by period."""
    return next((its for case, its in cases.items() if case[0] == scenario and case[1] == map), {})


def _difference(
    name: str,
    courses: _Runs,
    reference: _Runs,
    interval: Callable[[Sequence[float]], tuple[float, float, float]] = mean_interval,
) -> Row:
    paired = [
        _course_mean("total_s", its) - _course_mean("total_s", reference[course])
        for course, its in courses.items()
        if len(reference.get(course, ())) == len(its)
    ]
    if not paired:
        return {}
    return columns_of(name, interval(paired))


def _grouped(episodes: Sequence[Row], period: Callable[[Row], int]) -> _Cases:
    """Group episodes by scenario, map and agent; then by period; then by course."""
    found: dict[Any, Any] = defaultdict(lambda: defaultdict(lambda: defaultdict(list)))
    for row in episodes:
        found[row["scenario"], row["map"], row["agent"]][period(row)][row["course"]].append(row)
    return found


def _course_mean(name: str, episodes: Sequence[Mapping[str, Any]]) -> float:
    return float(np.mean([np.nan if row[name] is None else row[name] for row in episodes]))


def _robust(values: Sequence[float]) -> tuple[float, float, float]:
    return trimmed_mean_interval(values, TRIMMED)


def _mean(name: str, courses: Iterable[Sequence[Row]]) -> Row:
    means = [_course_mean(name, its) for its in courses]
    # Agents without a map have no forecast error.
    return columns_of(name, mean_interval(means) if np.isfinite(means).all() else (np.nan, np.nan, np.nan))
