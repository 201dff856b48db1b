"""Tables of counts: readings of how many places of car parks are free, or taken.

Columns are known by their English and German names, and separated by commas, semicolons or tabs. Nothing is guessed: a
table that does not say whether its places are free or taken, or how many there are, is refused with all that it lacks.
"""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, date, datetime, timedelta
from pathlib import Path
from typing import NamedTuple
from zoneinfo import ZoneInfo

import numpy as np

from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.errors import InputError, naming, require
from parkenv.files.limited_reading import csv_rows
from parkenv.files.option import columns_in

MAX_COUNT_BYTES = 512_000_000  # maximum size of a file of counts, unpacked
MAX_NAME = 200  # maximum length of a car park's name, characters
MAX_DAYS = 400_000  # maximum number of car parks times days of a file of counts
# Names of each kind of column, in lower case and with `_` for other characters than letters. A car park has the first
# of its names.
NAMES = {
    "car_park": "car_park carpark parkhaus parkplatz parking blockface kerb facility block group name",
    "capacity": "capacity kapazität kapazitaet stellplätze stellplaetze plätze plaetze spaces",
    "free": "free free_spaces free_places available frei freie_plätze freie_plaetze",
    "taken": "taken occupied occupied_spaces cars cars_paid_spaces belegt belegte_plätze belegte_plaetze besetzt",
    "hour": "hour round",
    "hour_utc": "hour_utc",
    "time_utc": "time_utc",
    "date": "date datum tag",
    "time": "time zeit uhrzeit datetime timestamp zeitpunkt zeitstempel datum_zeit datum_uhrzeit",
}
LARGEST = "largest"  # stands for a capacity: the largest count of the car park
# Kinds of columns that say when a reading was taken, one of them in a table; a date may stand beside it.
TIMES = ("hour", "hour_utc", "time", "time_utc")
# Texts of readings without a value, as empty ones.
UNKNOWN = ("-", "--", "?", "k.a.", "k. a.", "n/a", "na", "null", "none")
_FORMATS = ("%d.%m.%Y %H:%M", "%d.%m.%Y %H:%M:%S", "%Y/%m/%d %H:%M", "%Y/%m/%d %H:%M:%S", "%Y-%m-%d %H:%M")
_AN_INSTANT = timedelta(microseconds=1)
HOURS, HOUR_S, DAY_S = 24, 3600.0, 86_400.0
FIRST_DAY = date(2000, 1, 1).toordinal()
FINE = 1.5  # readings in an hour from which on a table has several an hour: they are used all


# Places of the only car park, a table of car parks and their capacities, or `LARGEST`; None: those of the table.
Capacity = float | Path | str | None


class Readings(NamedTuple):
    """Readings of car parks in order of time; each array (k,).

    With several readings an hour, `hour` is that in which a reading was taken, else that at whose end it holds.
    """

    car_parks: tuple[str, ...]  # (c,) names, ascending
    first: date
    n_days: int
    park: IntArray  # index of the car park
    day: IntArray  # days since the first
    hour: IntArray  # of the day
    second: FloatArray  # float64, s since the first day's midnight, of the time in the table
    capacity: FloatArray  # float64, places
    free: FloatArray  # float64, places; NaN if unknown
    per_hour: float  # mean number of readings in an hour that has some


class Clock:
    """Reads times of a table as seconds of local time since `FIRST_DAY`; `timezone` is the IANA name of its zone."""

    def __init__(self, path: str | Path, timezone: str | None = None) -> None:
        try:
            self.zone = None if timezone is None else ZoneInfo(timezone)
        except (KeyError, ValueError, OSError) as error:
            raise InputError(f"timezone is {timezone!r}, want an IANA name such as Europe/Berlin") from error
        self.path = path
        self._known: dict[tuple[str, bool], float] = {}

    def __call__(self, text: str, utc: bool = False, before: timedelta = timedelta(0)) -> float:
        """Return the local time `before` a given one; ValueError for what is no time."""
        if (text, utc) not in self._known:
            moment = _moment(text.strip())
            if utc or moment.tzinfo is not None:
                if self.zone is None:
                    raise InputError(
                        f"{self.path}: has times in UTC or with an offset, want --timezone, the local time "
                        "zone, such as Europe/Berlin"
                    )
                moment = ((moment if moment.tzinfo else moment.replace(tzinfo=UTC)) - before).astimezone(
                    self.zone
                )
            else:
                moment -= before
            second = (moment.hour * 60 + moment.minute) * 60 + moment.second + moment.microsecond * 1e-6
            self._known[text, utc] = (moment.toordinal() - FIRST_DAY) * DAY_S + second
        return self._known[text, utc]

    def reads(self, title: str) -> bool:
        try:
            return len(title) > len("2024-03-01") and bool(self(title))
        except (ValueError, OverflowError, InputError):
            return False


def listed_faults(faults: Mapping[str, int]) -> str:
    """Return in words how many rows or readings have each fault."""
    return ", ".join(f"{rule.replace('_', ' ')} {n:,}" for rule, n in faults.items() if n)


def folded(title: str) -> str:
    return re.sub(r"[\W_]+", "_", title.strip().casefold()).strip("_")


def titled_rows(path: str | Path, columns: str | None = None) -> Iterator[tuple[int, list[str]]]:
    """Yield the rows of a table, its header first, with the columns that the user names under what they mean."""
    rows = csv_rows(path, MAX_COUNT_BYTES)
    _, header = next(rows, (0, []))
    with naming(path):
        named = columns_in(columns)
    for title in (title for titles in named.values() for title in titles):
        if title not in header:
            raise InputError(f"{path}: has no column {title!r:.40}, but {', '.join(header)!r:.200}")
    at = [[header.index(title) for title in titles] for titles in named.values()]
    hidden = {i for places in at for i in places} | {
        i for i, title in enumerate(header) if any(_alike(kind, folded(title)) for kind in named)
    }
    yield 0, ["" if i in hidden else title for i, title in enumerate(header)] + list(named)
    for line, row in rows:
        yield line, row + [row[i] if not more else _sum(row, (i, *more)) for i, *more in at]


def _alike(kind: str, title: str) -> bool:
    """Whether a column says the same as one of a kind that the user names."""
    kinds = {kind, *((*TIMES, "date") if kind in (*TIMES, "date") else ())}
    return any(title in NAMES.get(name, "").split() for name in kinds)


def _sum(row: Sequence[str], at: Sequence[int]) -> str:
    """Return a sum as text; what is no number counts as none, but without any there is no sum."""
    numbers = [float(row[i]) for i in at if re.fullmatch(r"\s*\d{1,9}(\.\d+)?\s*", row[i])]
    return str(sum(numbers)) if numbers else ""


def read_table(
    path: str | Path, timezone: str | None = None, capacity: Capacity = None, columns: str | None = None
) -> Readings:
    """Read a table; the time zone is that of the local time, wanted if times are in UTC or have an offset."""
    rows = titled_rows(path, columns)
    _, header = next(rows)
    at, clock = _columns(path, header, capacity), Clock(path, timezone)
    when = [at[kind] for kind in ("date", *TIMES) if kind in at]
    utc = not at.keys().isdisjoint({"hour_utc", "time_utc"})
    before = timedelta(0) if not at.keys().isdisjoint({"hour", "hour_utc"}) else _AN_INSTANT
    whole, free_at, taken_at = (at.get(kind) for kind in ("capacity", "free", "taken"))
    own_name = re.sub(r"(\.csv)?(\.gz)?$", "", Path(path).name)
    names: dict[str, int] = {}
    numbers: dict[str, float] = {}
    stated = _capacities(capacity) if isinstance(capacity, Path) else {}
    table: list[tuple[float, ...]] = []
    for line, row in rows:
        name = row[at["car_park"]] if "car_park" in at else own_name
        if name not in names and not (0 < len(name) <= MAX_NAME and name.isprintable()):
            raise InputError(f"{path}: line {line}: car_park is {name!a:.40}, want a printable name")
        moment = row[when[0]] if len(when) == 1 else " ".join(row[i].strip() for i in when)
        try:
            time = clock(moment, utc, before)
        except InputError:
            raise
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
        if whole is None:
            places = capacity if isinstance(capacity, int | float) else stated.get(name, free + taken)
        free = places - taken if free_at is None else free
        table.append((names.setdefault(name, len(names)), time, places, free, taken))
    require(table, f"{path}: has no readings, want at least one")
    require(
        len(names) == 1 or not isinstance(capacity, int | float),
        f"{path}: has {len(names)} car parks, want a column of their capacities, or --capacity FILE",
    )
    _require_no_thousands(path, numbers)
    readings = np.array(table, float)
    if capacity == LARGEST:
        largest, park = np.ones(len(names)), readings[:, 0].astype(np.int64)
        np.fmax.at(largest, park, readings[:, 4])
        readings[:, 2], readings[:, 3] = largest[park], largest[park] - readings[:, 4]
    return _in_order(path, names, readings, before.total_seconds())


def _capacities(path: Path) -> dict[str, float]:
    """Read the capacities of car parks; one without a number has none."""
    rows = titled_rows(path)
    _, header = next(rows)
    at, numbers = _kinds(path, header), dict[str, float]()
    if not {"car_park", "capacity"} <= at.keys():
        raise InputError(f"{path}: has the columns {', '.join(header)!r:.120}, want car_park and capacity")
    try:
        return {row[at["car_park"]]: _number(row[at["capacity"]], numbers) for _, row in rows}
    except ValueError:
        raise InputError(f"{path}: a capacity is no number, want numbers of places") from None


def _kinds(path: str | Path, header: Sequence[str]) -> dict[str, int]:
    at: dict[str, int] = {}
    titles = [folded(title) for title in header]
    for i, title in enumerate(titles):
        kind = next((kind for kind, names in NAMES.items() if title in names.split()), None)
        if kind in at and kind != "car_park":
            raise InputError(f"{path}: columns {header[at[kind]]!r} and {header[i]!r} say the same, want one")
        if kind is not None:
            at[kind] = next(titles.index(name) for name in NAMES[kind].split() if name in titles)
    return at


def _columns(path: str | Path, header: Sequence[str], capacity: Capacity) -> dict[str, int]:
    require(header, f"{path}: is empty, want a table of counts")
    at = _kinds(path, header)
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
            f"{path}: has the columns {titles!r:.120}, of neither counts nor a log of bays (bay with arrival and "
            f"departure, since and state, or time and state): want {'; '.join(wanted)}; see --columns"
            if len(wanted) > 1
            else f"{path}: has the columns {titles!r:.120}, want {wanted[0]}"
        )
    if capacity is not None and "capacity" in at:
        raise InputError(f"{path}: has a column {header[at['capacity']]!r}, want no --capacity with it")
    require(
        len(at.keys() & set(TIMES)) <= 1,
        f"{path}: has several columns of times, want one of hour, hour_utc, time and time_utc",
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


def _moment(text: str) -> datetime:
    if len(text) <= len("2024-03-01"):
        raise ValueError("a day without a time")
    for form in ("", *_FORMATS):
        try:
            return datetime.strptime(text, form) if form else datetime.fromisoformat(text)
        except ValueError:
            continue
    raise ValueError(f"the time is {text!r:.40}, want one such as 2015-11-12 07:09")


def _in_order(path: str | Path, names: dict[str, int], values: FloatArray, before_s: float) -> Readings:
    newest_first = values[0, 1] > values[-1, 1]
    values = values[::-1] if newest_first else values
    values = values[np.argsort(values[:, 1], kind="stable")]
    rank = np.unique(list(names), return_inverse=True)[1]
    # In whole milliseconds, so that the instant that was taken off is put back.
    moments = np.round(values[:, 1] + before_s, 3)
    per_hour = len(values) / len(np.unique(np.stack([values[:, 0], moments // HOUR_S], axis=1), axis=0))
    time = moments if per_hour >= FINE else values[:, 1]
    days = (time // DAY_S).astype(np.int64)
    n_days = int(days.max() - days.min()) + 1
    require(
        n_days * len(names) <= MAX_DAYS,
        f"{path}: has {len(names):,} car parks over {n_days:,} days, want at most {MAX_DAYS:,} in all",
    )
    return Readings(
        tuple(sorted(names)),
        date.fromordinal(int(days.min()) + FIRST_DAY),
        n_days,
        rank[values[:, 0].astype(np.int64)],
        days - days.min(),
        (time % DAY_S // HOUR_S).astype(np.int64),
        moments - days.min() * DAY_S,
        values[:, 2],
        values[:, 3],
        per_hour,
    )
