"""CSV tables: written whole, read with one kind of value in a column; a wrong value is named with its place."""

import csv
import io
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from parkenv.errors import InputError
from parkenv.files.atomic_write import write_text
from parkenv.files.limited_reading import csv_records

MAX_NUMBER = 1e12  # maximum absolute value of a number; sums and squares of larger ones could overflow
_MAX_DIGITS = 15
# Texts that begin with one of these run as formulas in spreadsheets; an apostrophe before it prevents that.
_FORMULA = ("=", "+", "-", "@", "\t", "\r")


class Kind(NamedTuple):
    """What a column holds: in words, and what makes it of a text, or raises ValueError."""

    wanted: str
    parse: Callable[[str], Any]


def _number(text: str) -> float:
    value = float(text)
    if not abs(value) <= MAX_NUMBER:
        raise ValueError(text)
    return value


def _whole(text: str) -> int:
    if not (text.isdecimal() and len(text) <= _MAX_DIGITS):
        raise ValueError(text)
    return int(text)


TEXT = Kind("text", str)
NUMBER = Kind(f"a number, at most {MAX_NUMBER:g}", _number)
NUMBER_OR_NAN = Kind(
    f"a number, at most {MAX_NUMBER:g}, or nan", lambda text: float("nan") if text == "nan" else _number(text)
)
WHOLE = Kind(f"a whole number of at most {_MAX_DIGITS} digits", _whole)


def typed_records(path: Path, kind_of: Callable[[str], Kind]) -> Iterator[tuple[int, dict[str, Any]]]:
    """Yield the rows of a table, none without a file, with their line numbers; `kind_of` gives a column's kind."""
    if not path.exists():
        return
    for line, record in csv_records(path):
        row = {}
        for name, text in record.items():
            kind = kind_of(name)
            try:
                row[name] = kind.parse(text[1:] if _is_formula(text[1:]) and text[0] == "'" else text)
            except ValueError as error:
                raise InputError(
                    f"{path}: line {line}: {name:.80} is {text!r:.80}, want {kind.wanted}"
                ) from error
        yield line, row


def csv_text(columns: Sequence[str], rows: Iterable[Mapping[str, Any]], *, header: bool = False) -> str:
    """Return rows as CSV text; what spreadsheets would run as a formula gets an apostrophe, removed on reading."""
    text = _Lines()
    writer = csv.DictWriter(text, columns, lineterminator="\r\n")  # so both are quoted within texts
    if header:
        writer.writeheader()
    writer.writerows({name: _harmless(value) for name, value in row.items()} for row in rows)
    return text.getvalue()


def csv_columns(columns: Sequence[Sequence[Any]]) -> str:
    """Return columns of equal length as harmless CSV text without a header, ten times faster than rows."""
    text = _Lines()
    cells = (
        [_harmless(value) for value in column] if column and isinstance(column[0], str) else column
        for column in columns
    )
    csv.writer(text, lineterminator="\r\n").writerows(zip(*cells, strict=True))
    return text.getvalue()


class _Lines(io.StringIO):
    def write(self, line: str) -> int:
        return super().write(line.removesuffix("\r\n") + "\n")


def _harmless(value: Any) -> Any:
    """Return a cell with an apostrophe before what would be a formula, or would be read as a formula's text."""
    return f"'{value}" if isinstance(value, str) and _is_formula(value) else value


def _is_formula(text: str) -> bool:
    """Whether a text, or what follows its apostrophes, begins as a formula, and is no number."""
    bare = text.lstrip("'")
    if not bare.startswith(_FORMULA):
        return False
    try:
        float(text)
    except ValueError:
        return True
    return False


def write_csv(path: Path, columns: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> None:
    write_text(path, csv_text(columns, rows, header=True))
