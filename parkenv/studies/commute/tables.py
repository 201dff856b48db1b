"""Summaries of a commute by day and by week."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from parkenv.studies.results import Row
from parkenv.studies.statistics import columns_of, mean_interval, trimmed_mean_interval

FIXED, NONE = "fixed", "none"
"""Names in the column `map` of the references: a right map that does not learn; an agent that uses no map."""
TRIMMED = 0.1  # share of the courses, at either end, that a robust mean leaves out


_Runs = dict[int, list[Row]]


def day_rows(episodes: Sequence[Row]) -> list[Row]:
    """Return a row per scenario, map, agent and day: mean total time and forecast error, with 95 % intervals.

    The forecast error is the Brier score of the forecast at the arrival: the mean squared difference of P(taken) and
    the true state, over slots. The excess is the time beyond that of the first agent with the right map, which does not
    learn, in the same worlds: a 10 % trimmed mean, since a full lot may add the give-up penalty to one of the two.
    Intervals are over courses: a fleet's drivers meet the same day.
    """
    return [
        {**case, "day": day, **row, **excess}
        for case, day, row, _, excess in _periods(episodes, lambda row: row["day_number"])
    ]


def week_rows(episodes: Sequence[Row]) -> list[Row]:
    """Return a row per scenario, map, agent and five days, with the paired difference to the first agent without a map.

    The difference is paired by course: the same driver on the same days.
    """
    last = max((row["day_number"] for row in episodes), default=0)
    return [
        {**case, "days": f"{5 * week - 4}-{min(5 * week, last)}", **row, **difference, **excess}
        for case, week, row, difference, excess in _periods(
            episodes, lambda row: (row["day_number"] - 1) // 5 + 1
        )
    ]


def _periods(
    episodes: Sequence[Row], period: Callable[[Row], int]
) -> Iterator[tuple[Row, int, Row, Row, Row]]:
    """Yield each scenario, map and agent, a period, its means, difference to no map, and excess over the right map."""
    cases: dict[Any, Any] = defaultdict(lambda: defaultdict(lambda: defaultdict(list)))
    for row in episodes:
        cases[row["scenario"], row["map"], row["agent"]][period(row)][row["course"]].append(row)
    for case, by_period in cases.items():
        # The first agents with these maps.
        none, fixed = (
            next((cases[other] for other in cases if other[:2] == (case[0], name)), dict[int, _Runs]())
            for name in (NONE, FIXED)
        )
        columns = dict(zip(("scenario", "map", "agent"), case, strict=True))
        for number, courses in sorted(by_period.items()):
            means = {
                "courses": len(courses),
                **_mean("total_s", courses.values()),
                **_mean("forecast_error", courses.values()),
            }
            difference = _difference("difference_s", courses, none.get(number, {}))
            excess = _difference("excess_s", courses, fixed.get(number, {}), _robust)
            yield columns, number, means, difference, excess


def _difference(
    name: str,
    courses: _Runs,
    reference: _Runs,
    interval: Callable[[Sequence[float]], tuple[float, float, float]] = mean_interval,
) -> Row:
    paired = [
        _course_mean("total_s", searches) - _course_mean("total_s", reference[course])
        for course, searches in courses.items()
        if len(reference.get(course, ())) == len(searches)
    ]
    if not paired:
        return {}
    return columns_of(name, interval(paired))


def _course_mean(name: str, episodes: Sequence[Mapping[str, Any]]) -> float:
    return float(np.mean([np.nan if row[name] is None else row[name] for row in episodes]))


def _robust(values: Sequence[float]) -> tuple[float, float, float]:
    return trimmed_mean_interval(values, TRIMMED)


def _mean(name: str, courses: Iterable[Sequence[Row]]) -> Row:
    means = [_course_mean(name, searches) for searches in courses]
    # Agents without a map have no forecast error.
    return columns_of(name, mean_interval(means) if np.isfinite(means).all() else (np.nan, np.nan, np.nan))
