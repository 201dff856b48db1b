"""Learning curves of `parkenv train` in a report page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

Row = Mapping[str, Any]


def learning_panels(summary: Mapping[str, Any], seeds: Sequence[Sequence[Row]]) -> list[dict[str, Any]]:
    """Build the panel of learning curves: the total time of searches; none without curves.

    A point of the mean is decisions, mean, and the ends of its 95 % interval (None for one seed). Other trainings show
    their median, which is robust against single searches that drive in circles.

    Args:
        summary: content of the `summary.json` of a training.
        seeds: rows of each seed's `curve.csv`, NaN as None.
    """
    curve, lines = summary.get("curve"), summary.get("evaluated")
    if not curve or not isinstance(lines, Mapping):
        return []
    columns = ("total_s", "low_s", "high_s")
    beside = summary.get("beside", {})
    return [{
        "title": "total time, s",
        "mean": [[row["steps"], *(row.get(name) for name in columns)] for row in curve],
        "seeds": [
            [[row["steps"], row["total_s"]] for row in its if {"steps", "total_s"} <= row.keys()] for its in seeds
        ],
        "beside": [[name, [[row["steps"], row["median_s"]] for row in its]] for name, its in beside.items()],
        "lines": [[name, value] for name, value in lines.items()],
    }]  # fmt: skip
