"""Learning curves of `parkenv train` in a report page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from parkenv.show.columns import columns_of

Row = Mapping[str, Any]


def learning_panels(summary: Mapping[str, Any], seeds: Sequence[Sequence[Row]]) -> list[dict[str, Any]]:
    """Build the panels of learning curves: total time of searches, or success by kind of slot."""
    curve, lines = summary.get("curve"), summary.get("evaluated")
    if not curve or not isinstance(lines, Mapping):
        return []
    beside = summary.get("beside", {})
    if isinstance(curve, Mapping):
        return [
            _panel(
                kind,
                f"{kind}_success",
                its,
                seeds,
                {name: other[kind] for name, other in beside.items()},
                {"planner": lines[kind]} if kind in lines else {},
                share=True,
            )
            for kind, its in curve.items()
        ]
    return [_panel("total time, s", "total_s", curve, seeds, beside, lines, share=False)]


def _panel(
    title: str,
    column: str,
    curve: Sequence[Row],
    seeds: Sequence[Sequence[Row]],
    beside: Mapping[str, Sequence[Row]],
    lines: Mapping[str, float],
    *,
    share: bool,
) -> dict[str, Any]:
    """Build a panel; a point of the mean is decisions, mean, and the ends of its 95 % interval (None for one seed).

    Other trainings show their median, which is robust against single searches that drive in circles.
    """
    low, high, median = columns_of(column)
    return {
        "title": title,
        "share": share,
        "mean": [[row["steps"], *(row.get(name) for name in (column, low, high))] for row in curve],
        "seeds": [
            [[row["steps"], row[column]] for row in its if {"steps", column} <= row.keys()] for its in seeds
        ],
        "beside": [[name, [[row["steps"], row[median]] for row in its]] for name, its in beside.items()],
        "lines": [[name, value] for name, value in lines.items()],
    }
