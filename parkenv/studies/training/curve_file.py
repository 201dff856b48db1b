"""The file of a training's evaluations, `curve.csv`, and their means over seeds."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from parkenv.errors import InputError
from parkenv.files.csv_tables import NUMBER_OR_NAN, WHOLE, Kind, typed_records

CURVE = "curve.csv"

Row = dict[str, Any]


def read_curve(path: Path, columns: Sequence[str] = ()) -> list[Row]:
    """Read the evaluations of a training; none if there is no file.

    Args:
        path: a `curve.csv`.
        columns: those that it must have; all but `steps` are floats.
    """
    return require_columns([row for _, row in typed_records(path, _kind_of)], columns, path)


def require_columns(curve: list[Row], columns: Sequence[str], path: Path) -> list[Row]:
    """Return evaluations that a file held."""
    for name in columns:
        if any(name not in row for row in curve):
            raise InputError(f"{path}: has no column {name!r}, want {', '.join(columns)}")
    return curve


def across_seeds(curves: Sequence[Sequence[Row]]) -> list[dict[str, float]]:
    """Return mean, 95 % interval and median of `total_s` over seeds, at evaluations that all seeds have.

    Args:
        curves: rows of `curve.csv` of each seed.
    """
    from parkenv.studies.statistics import mean_interval

    rows = []
    for evaluations in zip(*curves, strict=False):
        values = [row["total_s"] for row in evaluations]
        mean, low, high = mean_interval(values)
        rows.append({
            "steps": float(np.mean([row["steps"] for row in evaluations])), "total_s": mean, "low_s": low,
            "high_s": high, "median_s": float(np.median(values)),
        })  # fmt: skip
    return rows


def _kind_of(column: str) -> Kind:
    return WHOLE if column == "steps" else NUMBER_OR_NAN
