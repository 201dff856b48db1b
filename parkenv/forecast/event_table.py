"""Tables of single bays: when each was taken or free, in any of the layouts in which cities and cameras say so.

- Intervals: bay, arrival, departure, and perhaps state. Without rows of free bays a bay is free between its stays.
- Changes: bay, time, state, where nearly every row differs from the one before of its bay.
- Since: bay, state, since; with `updated`, up to when the state is known, or else the latest `since` of all bays.
  Several may stand side by side (`state_1,since_1,state_2,...`). Before `since` the bay was in the other state.
- Looks: bay, time, state, as of CNRPark-EXT; or bay, and a column of states for each moment, which is its name.

Real tables have faults. Each row that is changed or left out is counted under the name of its rule:

- `unreadable`: no bay, time or state; `unknown`: the state is said to be unknown; `duplicate`: a stay again.
- `negative`, `zero`: ends before it begins, or at once.
- `overlapping`: ends after the next one of its bay begins, and is cut there.
- `dead`: a state of more than three days: the sensor, not the car.
- `full_hours`: stays of a bay that all end at full hours without beginning so: ended by a clock.
- `both_states`: rows of free bays among those of stays; they are used.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from parkenv.compiled.arrays import BoolArray, FloatArray, IntArray
from parkenv.errors import InputError, require
from parkenv.files.option import columns_in
from parkenv.forecast.count_table import (
    DAY_S,
    FIRST_DAY,
    HOUR_S,
    UNKNOWN,
    Clock,
    folded,
    listed_faults,
    titled_rows,
)
from parkenv.forecast.count_table import NAMES as COUNT_NAMES

MAX_STATE_S = 72 * HOUR_S
BEFORE_S = 900.0  # how long before `since` the other state is taken to have held, s
# Names of each kind of column, the better ones first, as in `count_table`; `_utc` behind one says that it is UTC.
NAMES = {
    "bay": "bay slot_id bay_id bayid slot space_id spaceid kerbside_id kerbsideid marker_id street_marker streetmarker "
    "st_marker_id device_id deviceid meter_id sensor_id space",
    "arrival": "arrival arrival_time arrivaltime start start_time starttime from begin entry_time",
    "departure": "departure departure_time departuretime end end_time endtime to leave exit_time",
    "since": "since since_time status_timestamp statustimestamp last_change changed",
    "updated": "updated updated_at last_updated lastupdated snapshot",
    "time": "time datetime timestamp event_time eventtime date_time",
    "state": "state occupied status occupancy occupancy_state occupancystate status_description vehicle_present "
    "vehiclepresent taken",
}
_STATES = dict.fromkeys(
    ["1", "1.0", "true", "yes", "occupied", "taken", "present", "parked", "belegt"], True
) | dict.fromkeys(
    ["0", "0.0", "false", "no", "vacant", "free", "unoccupied", "available", "empty", "absent", "frei"], False
)
_WANTED = "bay with arrival and departure, with since and state, or with time and state"
_CHANGES = 0.95  # share of rows that differ from the one before in a table of changes
_MIN_PAIRS = 20  # to tell that
_MIN_STAYS = 8  # to tell that a clock ends them


class Events(NamedTuple):
    """Known states of bays, each array (k,), by bay and time."""

    bays: tuple[str, ...]
    first: int  # number of the first day (`date.toordinal`)
    bay: IntArray  # index
    start: FloatArray  # float64, s of local time since the first day's midnight
    end: FloatArray  # float64, s, up to when the state is known to hold; that of a look is its start
    taken: BoolArray
    faults: dict[str, int]  # number of rows by rule


class _Part(NamedTuple):
    """Columns of a state, its begin and its end; None: there is none; a text: a time that is a column's name."""

    state: int | None
    start: int | str
    end: int | str | None
    utc: tuple[bool, bool] = (False, False)  # whether begin and end are in UTC


def _layout(header: Sequence[str]) -> tuple[str, int, list[_Part]] | None:
    """Return what tells the layout (arrival, since or time), the column of the bays, and those of their states."""
    titles = [folded(title) for title in header]
    at: dict[str, int] = {}
    for kind, names in NAMES.items():
        for name in reversed(names.split()):
            for i, title in enumerate(titles):
                number = re.fullmatch(rf"{name}(?:_utc)?(_\d+)?(?:_utc)?", title)
                if number and (number[1] is None or kind in ("state", "since", "updated")):
                    at[kind + (number[1] or "")] = i

    def part(state: str, start: str, end: str | None) -> _Part:
        start_utc, end_utc = (name is not None and "_utc" in titles[at[name]] for name in (start, end))
        return _Part(at.get(state), at[start], at[end] if end else None, (start_utc, end_utc))

    if "bay" not in at:
        return None
    if {"arrival", "departure"} <= at.keys():
        return "arrival", at["bay"], [part("state", "arrival", "departure")]
    if snapshots := [name for name in at if name.startswith("since") and f"state{name[5:]}" in at]:
        updated = {
            name: next((u for u in (f"updated{name[5:]}", "updated") if u in at), None) for name in snapshots
        }
        return "since", at["bay"], [part(f"state{name[5:]}", name, updated[name]) for name in snapshots]
    if {"time", "state"} <= at.keys():
        return "time", at["bay"], [part("state", "time", "time")]
    named = [_Part(i, title, title) for i, title in enumerate(header) if Clock("").reads(title)]
    return ("time", at["bay"], named) if named else None


def is_counts(path: str | Path, columns: str | None = None) -> bool:
    """Whether a table is not a log of bays."""
    _, header = next(titled_rows(path, columns))
    kinds = {kind.removesuffix("_utc") for kind in columns_in(columns)}
    whole = {name for kind in ("capacity", "free") for name in COUNT_NAMES[kind].split()}
    if kinds & {"car_park", "capacity", "free", "taken"} or whole & {folded(title) for title in header}:
        return True
    return _layout(header) is None


def read_events(
    paths: Sequence[str | Path], timezone: str | None = None, columns: str | None = None
) -> Events:
    """Read tables of one layout, .csv or .csv.gz, as one.

    The IANA name of the local time zone is wanted if times are in UTC or have an offset; for columns see `columns_in`.
    """
    table, parts, source = _Table(), list[FloatArray](), ",".join(map(str, paths))
    for path in paths:
        rows = titled_rows(path, columns)
        _, header = next(rows)
        layout = _layout(header)
        if layout is None or layout[0] != (table.kind or layout[0]):
            titles = ", ".join(header)
            wanted = f", as in {paths[0]}" if layout else "; see --columns"
            raise InputError(f"{path}: has the columns {titles!r:.200}, want {_WANTED}{wanted}")
        table.kind = layout[0]
        parts.append(table.read(path, *layout[1:], rows, Clock(path, timezone)))
    values = np.concatenate(parts)
    first = float(np.floor(values[:, 1].min() / DAY_S)) if len(values) else 0.0
    bay, (start, end) = values[:, 0].astype(np.int64), values[:, 1:3].T - first * DAY_S
    states = table.cleaned(_Rows(bay, start, end, values[:, 3] > 0))
    faults = {rule: n for rule, n in table.faults.items() if n}
    if not states[0].size:
        raise InputError(f"{source}: has no states of bays, want some ({listed_faults(faults) or 'no row'})")
    return Events(tuple(table.bays), int(first) + FIRST_DAY, *states, faults)


class _Table:
    kind = ""

    def __init__(self) -> None:
        self.bays: dict[str, int] = {}
        self.faults = Counter[str]()

    def read(
        self,
        path: str | Path,
        bay: int,
        parts: list[_Part],
        rows: Iterator[tuple[int, list[str]]],
        clock: Clock,
    ) -> FloatArray:
        """Return rows (bay, begin, end, taken), times in s."""
        n, bad, first_bad, values = 0, 0, "", list[tuple[float, ...]]()
        latest = [-np.inf] * len(parts)
        for line, row in rows:
            n += 1
            try:
                name = row[bay].strip()
                if not (0 < len(name) <= 200 and name.isprintable()):
                    raise ValueError(f"the bay is {name!a:.40}, want a name")
                for k, (state, *times, utc) in enumerate(parts):
                    taken = True if state is None else self._state(row[state], len(parts) > 1)
                    if taken is None:
                        continue
                    texts = [row[time] if isinstance(time, int) else time for time in times]
                    start, end = (
                        np.nan if text is None else clock(text, is_utc)
                        for text, is_utc in zip(texts, utc, strict=True)
                    )
                    latest[k] = max(latest[k], start)
                    values.append((self.bays.setdefault(name, len(self.bays)), start, end, taken, k))
            except InputError:
                raise
            except (ValueError, OverflowError) as fault:
                bad, first_bad = bad + 1, first_bad or f"line {line}: {fault}"
        self.faults["unreadable"] += bad
        require(bad <= n / 2, f"{path}: {bad:,} of {n:,} rows are unreadable: {first_bad}")
        table = np.array(values, float).reshape(len(values), 5)
        return np.where(np.isnan(table), np.array(latest)[table[:, 4:].astype(int)], table)[:, :4]

    def _state(self, text: str, several: bool) -> bool | None:
        word = text.strip().casefold()
        if word not in _STATES and word not in ("", "unknown", *UNKNOWN):
            raise ValueError(f"the state is {text!r:.40}, want occupied or vacant, or 1 or 0")
        self.faults["unknown"] += word not in _STATES and bool(word or not several)
        return _STATES.get(word)

    def cleaned(self, table: _Rows) -> _Rows:
        is_stay, is_since = self.kind == "arrival", self.kind == "since"
        # Stable: of two looks at the same time the later row stands.
        table = table.kept(np.lexsort((table.end, table.start, table.bay)))
        follows = table.same & (np.append(table.start[1:], np.inf) == table.start)
        if not is_stay:  # of the same change in several snapshots the last one knows most
            table = table.kept(~(follows & (~np.array(is_since) | (np.roll(table.taken, -1) == table.taken))))
        else:
            again = (
                follows & (np.roll(table.end, -1) == table.end) & (np.roll(table.taken, -1) == table.taken)
            )
            table = self._dropped("duplicate", table, again)
            self.faults["both_states"] += int((~table.taken).sum())
            n = np.bincount(table.bay, minlength=len(self.bays))
            times = (table.start % HOUR_S == 0, table.end % HOUR_S == 0)
            begins, ends = (np.bincount(table.bay, is_full, len(self.bays)) for is_full in times)
            by_clock = (n >= _MIN_STAYS) & (ends == n) & (begins < n)
            table = self._dropped("full_hours", table, by_clock[table.bay])
            table = self._dropped("zero", table, table.end == table.start)
        table = self._dropped("negative", table, table.end < table.start)
        following = np.append(table.start[1:], np.inf)
        late = table.same & (following < table.end)
        self.faults["overlapping"] += int(late.sum()) if is_stay else 0
        table = table._replace(end=np.where(late, following, table.end))
        pairs = np.flatnonzero(table.same)
        changed = table.taken[pairs] != table.taken[pairs + 1]
        if self.kind == "time" and pairs.size >= _MIN_PAIRS and changed.mean() >= _CHANGES:
            table = table._replace(end=np.where(table.same, following, table.start))
        looks = not (table.end > table.start).any()
        table = self._dropped("dead", table, table.end - table.start > MAX_STATE_S)
        if is_since or (is_stay and table.taken.all()):  # what was before
            earlier = np.append(-np.inf, np.where(table.same, table.end, -np.inf))[:-1]
            begin = np.maximum(table.start - BEFORE_S, earlier) if is_since else earlier
            known = np.isfinite(begin)
            other = table._replace(start=begin, end=table.start, taken=~table.taken).kept(known)
            both: Any = map(np.append, table, other)
            table = _Rows(*both)
            table = self._dropped("dead", table, table.end - table.start > MAX_STATE_S)
        order = np.lexsort((table.start, table.bay))
        return table.kept(order[looks | (table.end > table.start)[order]])

    def _dropped(self, rule: str, table: _Rows, bad: BoolArray) -> _Rows:
        self.faults[rule] += int(bad.sum())
        return table.kept(~bad)


class _Rows(NamedTuple):
    bay: IntArray
    start: FloatArray
    end: FloatArray
    taken: BoolArray

    @property
    def same(self) -> BoolArray:
        return np.append(np.diff(self.bay) == 0, False)[: self.bay.size]

    def kept(self, which: BoolArray | IntArray) -> _Rows:
        return _Rows(self.bay[which], self.start[which], self.end[which], self.taken[which])
