"""The file of a training's evaluations, `curve.csv`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from parkenv.errors import InputError
from parkenv.files.typed_csv import NUMBER_OR_NAN, WHOLE, Kind, typed_records

CURVE = "curve.csv"

Row = dict[str, Any]


def read_curve(path: Path, columns: Sequence[str] = ()) -> list[Row]:
    """Read the evaluations of a training; none if there is no file.

    Args:
        path: a `curve.csv`.
        columns: those that it must have; all but `steps` are floats.

    Raises:
        InputError: a column is missing, or a value is not a number.
    """
    return require_columns([row for _, row in typed_records(path, _kind_of)], columns, path)


def require_columns(curve: list[Row], columns: Sequence[str], path: Path) -> list[Row]:
    """Return evaluations that a file held.

    Raises:
        InputError: one lacks a column.
    """
    for name in columns:
        if any(name not in row for row in curve):
            raise InputError(f"{path}: has no column {name!r}, want {', '.join(columns)}")
    return curve


def _kind_of(column: str) -> Kind:
    return WHOLE if column == "steps" else NUMBER_OR_NAN
