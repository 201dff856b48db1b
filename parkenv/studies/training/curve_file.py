"""The file of a training's evaluations, `curve.csv`."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from parkenv.errors import require
from parkenv.files.csv_tables import NUMBER_OR_NAN, WHOLE, typed_records

CURVE = "curve.csv"

Row = dict[str, Any]


def read_curve(path: Path, columns: Sequence[str] = ()) -> list[Row]:
    """Read the evaluations of a training, which have these columns; none if there is no file."""
    kinds = typed_records(path, lambda column: WHOLE if column == "steps" else NUMBER_OR_NAN)
    curve = [row for _, row in kinds]
    for name in columns:
        require(
            all(name in row for row in curve), f"{path}: has no column {name!r}, want {', '.join(columns)}"
        )
    return curve
