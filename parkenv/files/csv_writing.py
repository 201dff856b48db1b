"""Write tables as CSV; `parkenv.files.limited_reading.csv_records` reads them."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from parkenv.files.atomic_write import atomic_write


def csv_text(columns: Sequence[str], rows: Iterable[Mapping[str, Any]], *, header: bool = False) -> str:
    """Return rows as CSV text, below a header if wanted; values that a row lacks are empty."""
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    if header:
        writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def write_csv(path: Path, columns: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> None:
    """Write a CSV file with a header, atomically.

    Raises:
        InputError: the file cannot be written.
    """
    with atomic_write(path) as beside:
        beside.write_text(csv_text(columns, rows, header=True), encoding="utf-8")
