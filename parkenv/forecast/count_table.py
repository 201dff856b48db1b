"""Tables of counts: readings of how many places of car parks are free, or taken.

Columns are known by their English and German names, and separated by commas, semicolons or tabs. Nothing is guessed: a
table that does not say whether its places are free or taken, or how many there are, is refused with all that it lacks.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from datetime import UTC, date, datetime, timedelta
from pathlib import Path
from typing import NamedTuple
from zoneinfo import ZoneInfo

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray
from parkenv.errors import InputError
from parkenv.files.limited_reading import csv_rows

MAX_COUNT_BYTES = 512_000_000
"""Maximum size of a file of counts, unpacked."""
MAX_NAME = 200
"""Maximum length of a car park's name, characters."""
MAX_DAYS = 400_000
"""Maximum number of car parks times days of a file of counts."""
NAMES = {
    "car_park": "car_park carpark parkhaus parkplatz parking name",
    "capacity": "capacity kapazität kapazitaet stellplätze stellplaetze plätze plaetze spaces",
    "free": "free free_spaces free_places available frei freie_plätze freie_plaetze",
    "taken": "taken occupied occupied_spaces belegt belegte_plätze belegte_plaetze besetzt",
    "hour": "hour",
    "hour_utc": "hour_utc",
    "time_utc": "time_utc",
    "date": "date datum tag",
    "time": "time zeit uhrzeit datetime timestamp zeitpunkt zeitstempel datum_zeit datum_uhrzeit",
}
"""Names of each kind of column, in lower case and with `_` for other characters than letters."""
TIMES = ("hour", "hour_utc", "time", "time_utc")
"""Kinds of columns that say when a reading was taken, one of them in a table; a date may stand beside it."""
UNKNOWN = ("-", "--", "?", "k.a.", "k. a.", "n/a", "na", "null", "none")
"""Texts of readings without a value, as empty ones."""
_FORMATS = ("%d.%m.%Y %H:%M", "%d.%m.%Y %H:%M:%S", "%Y/%m/%d %H:%M", "%Y/%m/%d %H:%M:%S", "%Y-%m-%d %H:%M")
_AN_INSTANT = timedelta(microseconds=1)


class Readings(NamedTuple):
    """Readings of car parks in order of time; each array (k,)."""

    car_parks: tuple[str, ...]  # (c,) names, ascending
    first: date
    n_days: int
    park: NDArray[np.int64]  # index of the car park
    day: NDArray[np.int64]  # days since the first
    hour: NDArray[np.int64]  # of the day, at whose end the reading holds
    capacity: FloatArray  # float64, places
    free: FloatArray  # float64, places; NaN if unknown


def is_counts(path: str | Path) -> bool:
    """Whether a table is not a log of slots."""
    _, header = next(csv_rows(path, MAX_COUNT_BYTES), (0, []))
    return "slot_id" not in header


def read_table(path: str | Path, zone: ZoneInfo, capacity: float | None = None) -> Readings:
    """Read a table; `capacity` is the number of places of its only car park if it has no such column."""
    rows = csv_rows(path, MAX_COUNT_BYTES)
    _, header = next(rows, (0, []))
    at = _columns(path, header, capacity)
    when = [at[kind] for kind in ("date", *TIMES) if kind in at]
    utc, before = not at.keys().isdisjoint({"hour_utc", "time_utc"}), _AN_INSTANT
    if not at.keys().isdisjoint({"hour", "hour_utc"}):
        before = timedelta(0)
    whole, free_at, taken_at = (at.get(kind) for kind in ("capacity", "free", "taken"))
    own_name = re.sub(r"(\.csv)?(\.gz)?$", "", Path(path).name)
    names: dict[str, int] = {}
    times: dict[str, tuple[int, int, float]] = {}
    numbers: dict[str, float] = {}
    table: list[tuple[int, int, int, float, float, float]] = []
    for line, row in rows:
        name = row[at["car_park"]] if "car_park" in at else own_name
        if name not in names and not (0 < len(name) <= MAX_NAME and name.isprintable()):
            raise InputError(f"{path}: line {line}: car_park is {name!a:.40}, want a printable name")
        moment = row[when[0]] if len(when) == 1 else " ".join(row[i].strip() for i in when)
        try:
            if moment not in times:
                times[moment] = _local_hour(moment, zone, utc, before)
        except (ValueError, OverflowError):
            wanted = "a time such as 2024-03-01T07:00 or 01.03.2024 07:00"
            raise InputError(
                f"{path}: line {line}: {header[when[0]]} is {moment!r:.40}, want {wanted}"
            ) from None
        values = [math.nan] * 3
        for k, i in enumerate((whole, free_at, taken_at)):
            try:
                values[k] = math.nan if i is None else _number(row[i], numbers)
            except ValueError:
                raise InputError(
                    f"{path}: line {line}: {header[i or 0]} is {row[i or 0]!r:.40}, want a number"
                ) from None
        places, free, taken = values
        places = (free + taken if capacity is None else capacity) if whole is None else places
        free = places - taken if free_at is None else free
        table.append((names.setdefault(name, len(names)), *times[moment], places, free))
    if not table:
        raise InputError(f"{path}: has no readings, want at least one")
    if capacity is not None and len(names) > 1:
        raise InputError(f"{path}: has {len(names)} car parks, want a column of their capacities")
    _require_no_thousands(path, numbers)
    return _in_order(path, names, np.array(table, float))


def _columns(path: str | Path, header: Sequence[str], capacity: float | None) -> dict[str, int]:
    if not header:
        raise InputError(f"{path}: is empty, want a table of counts")
    at: dict[str, int] = {}
    for i, title in enumerate(header):
        folded = re.sub(r"[\W_]+", "_", title.strip().casefold()).strip("_")
        kind = next((kind for kind, names in NAMES.items() if folded in names.split()), None)
        if kind in at:
            raise InputError(f"{path}: columns {header[at[kind]]!r} and {title!r} say the same, want one")
        if kind is not None:
            at[kind] = i
    lacks = {
        "a column of times (hour, hour_utc, time or time_utc)": at.keys().isdisjoint(("date", *TIMES)),
        "a column of free or taken places (free or taken)": at.keys().isdisjoint({"free", "taken"}),
        "the number of places (a column capacity, or --capacity)": capacity is None
        and "capacity" not in at
        and not {"free", "taken"} <= at.keys(),
    }
    if wanted := [what for what, is_missing in lacks.items() if is_missing]:
        titles = ", ".join(header)
        raise InputError(
            f"{path}: has the columns {titles!r:.120}, of neither a log of slots nor counts: want {'; '.join(wanted)}"
            if len(wanted) > 1
            else f"{path}: has the columns {titles!r:.120}, want {wanted[0]}"
        )
    if capacity is not None and "capacity" in at:
        raise InputError(f"{path}: has a column {header[at['capacity']]!r}, want no --capacity with it")
    if len(at.keys() & set(TIMES)) > 1:
        raise InputError(
            f"{path}: has several columns of times, want one of hour, hour_utc, time and time_utc"
        )
    return at


def _number(text: str, known: dict[str, float]) -> float:
    if text not in known:
        number = text.strip().lower()
        number = "" if number in UNKNOWN else number
        if re.fullmatch(r"\d{1,3},\d{3}", number):
            raise ValueError("thousands")
        known[text] = float(number.replace(",", ".") if "." not in number else number) if number else math.nan
    return known[text]


def _require_no_thousands(path: str | Path, numbers: dict[str, float]) -> None:
    """Check that dots are decimal points: they are not if beside whole numbers three digits follow all of them."""
    dotted = [text for text in numbers if "." in text]
    if (
        len(dotted) < len(numbers)
        and dotted
        and all(re.fullmatch(r"\d{1,3}\.\d{3}", t.strip()) for t in dotted)
    ):
        raise InputError(f"{path}: has the number {dotted[0]!r}, want whole numbers without separators")


def _local_hour(text: str, zone: ZoneInfo, utc: bool, before: timedelta) -> tuple[int, int, float]:
    """Return the day (proleptic Gregorian ordinal), the hour and the Unix time of the time `before` a given one."""
    moment = _moment(text.strip()) - before
    if moment.tzinfo is None:
        moment = moment.replace(tzinfo=UTC if utc else zone)
    moment = moment if moment.tzinfo is zone else moment.astimezone(zone)
    return moment.toordinal(), moment.hour, moment.timestamp()


def _moment(text: str) -> datetime:
    if len(text) <= len("2024-03-01"):
        raise ValueError("a day without a time")
    for form in ("", *_FORMATS):
        try:
            return datetime.strptime(text, form) if form else datetime.fromisoformat(text)
        except ValueError:
            continue
    raise ValueError("no time")


def _in_order(path: str | Path, names: dict[str, int], values: FloatArray) -> Readings:
    newest_first = values[0, 3] > values[-1, 3]
    values = values[::-1] if newest_first else values
    values = values[np.argsort(values[:, 3], kind="stable")]
    rank = np.unique(list(names), return_inverse=True)[1]
    days = values[:, 1].astype(np.int64)
    n_days = int(days.max() - days.min()) + 1
    if n_days * len(names) > MAX_DAYS:
        raise InputError(
            f"{path}: has {len(names):,} car parks over {n_days:,} days, want at most {MAX_DAYS:,} in all"
        )
    return Readings(
        tuple(sorted(names)),
        date.fromordinal(int(days.min())),
        n_days,
        rank[values[:, 0].astype(np.int64)],
        days - days.min(),
        values[:, 2].astype(np.int64),
        values[:, 4],
        values[:, 5],
    )
