"""Read the poses of a drive: a CSV table, or the track of a GPX file."""

import math
import re
from dataclasses import dataclass
from datetime import UTC, datetime
from decimal import Decimal
from pathlib import Path

import numpy as np

from parkenv.compiled.arrays import BoolArray, FloatArray, IntArray
from parkenv.errors import InputError
from parkenv.files.csv_tables import NUMBER, TEXT, Kind, typed_records
from parkenv.files.limited_reading import read_xml

MONDAY_S = 4 * 86_400  # 1970-01-05, the first Monday of Unix time, s
_WEEK_S = 604_800  # smaller times are since Monday 00:00
_UNIX_S = (1e8, 9e9)  # 1973 to 2255; nanoseconds fit 64 bits
_DECIMAL = re.compile(r"\d+\.\d+")
_STEP_M = 1.0  # between the positions of which a heading is made
# A gap in a track is longer than this, s, and than this multiple of the median time between two points.
_GAP_S, _GAP_STEPS = 2.0, 3.0
_SEGMENT = ("track_fid", "track_seg_id", "segment")  # columns that say where a track is interrupted
_WANT = "want columns time or file, x and y (m) or lat and lon (degrees), and yaw (rad) or heading (degrees) if known"


@dataclass(frozen=True, eq=False)
class Track:
    """The poses of a drive, in order."""

    stamps: IntArray  # (n,) ns of Unix time, rising; seconds after seconds where the file has no times
    files: tuple[str, ...]  # (n,) names of the pictures; empty if it has none
    positions: FloatArray  # (n, 2) m in the lot, or degrees, longitude first
    in_degrees: bool  # which of the two
    yaw: FloatArray  # (n,) rad, counter-clockwise from east; NaN where it is not given
    begins: BoolArray  # (n,) whether the track was interrupted before a position
    frames: tuple[int, ...] = ()  # (n,) numbers of the pictures; empty if it has none

    def headings(self, xy: FloatArray) -> FloatArray:
        """Return the headings, (n,) rad: as given, else the direction from position to position, (n, 2) m.

        They are made of positions of one part of the track, between interruptions; NaN in one of less than 2 m.
        """
        if not np.isnan(self.yaw).any():
            return self.yaw
        along = np.full(len(xy), np.nan)
        for part in np.split(np.arange(len(xy)), np.flatnonzero(self.begins[1:]) + 1):
            chosen = [int(part[0])]
            for k in part[1:].tolist():
                if math.dist(xy[k], xy[chosen[-1]]) >= _STEP_M:
                    chosen.append(k)
            step, middle = np.diff(xy[chosen], axis=0), 0.5 * (np.array(chosen[1:]) + chosen[:-1])
            if np.hypot(*step.T).sum() >= 2.0 * _STEP_M:
                along[part] = np.interp(part, middle, np.unwrap(np.arctan2(step[:, 1], step[:, 0])))
        yaw = np.where(np.isnan(self.yaw), along, self.yaw)
        if np.isnan(yaw).all():
            raise InputError("has no headings, and its way of less than 2 m shows none")
        return yaw


def read_track(path: Path, timezone_s: float = 0.0) -> Track:
    """Read a GPX file (`.gpx`), or a CSV table.

    A table has `time` (or `unix_s`, which counts if there are both), `file` (a picture's name), or both, `frame` (its
    number) if that is known; `x` and `y` (m in the lot) or `lat` and `lon` (degrees);
    and, if they are known, `yaw` (rad, counter-clockwise from x) or `heading` (degrees, clockwise from north). Other
    columns are skipped. A time is a date, of the place if it has no zone, Unix time from 1e8 s on, or, below 604,800 s,
    time since Monday 00:00; `timezone_s` is the time of the place minus UTC.
    """
    wanted = "a date (2026-05-04T09:00:00Z), Unix time, or seconds of a week"
    time = Kind(wanted, lambda text: stamp_in(text, timezone_s))
    kinds = dict.fromkeys(("x", "y", "lat", "lon", "heading"), NUMBER) | {"time": time}
    kinds["yaw"] = Kind("radians, -6.3 to 6.3", _angle)
    kinds |= {
        "unix_s": time,
        "frame": Kind("a number of a picture", lambda text: int(text) if text.isdecimal() else -1),
    }
    if path.suffix.lower() == ".gpx":
        texts = [
            p.attrib | {"time": (p.findtext("{*}time") or "").strip(), "segment": str(number)}
            for number, segment in enumerate(read_xml(path, "gpx").iterfind(".//{*}trkseg"))
            for p in segment.iterfind("{*}trkpt")
        ]
        rows = []
        for number, point in enumerate(texts, 1):
            try:
                row = {name: kinds[name].parse(point.get(name, "")) for name in ("time", "lat", "lon")}
                rows.append(row | {"segment": point["segment"]})
            except ValueError as error:
                shown = str({name: text for name, text in point.items() if name != "segment"})[:120]
                raise InputError(
                    f"{path}: track point {number} is {shown}, want lat, lon and time"
                ) from error
    elif not path.is_file():
        raise InputError(f"{path}: no such file")
    else:
        rows = [row for _, row in typed_records(path, lambda name: kinds.get(name, TEXT))]
        rows = [row | {"time": row["unix_s"]} if "unix_s" in row else row for row in rows]
    has = rows[0].keys() if rows else set()
    pair = ("x", "y") if "x" in has else ("lon", "lat")
    if not has >= set(pair) or not has & {"time", "file"}:
        raise InputError(f"{path}: has {', '.join(has) or 'no poses'}; {_WANT}")
    if path.suffix.lower() == ".gpx":  # receivers repeat points within a second
        rows = [row for k, row in enumerate(rows) if k == 0 or row["time"] != rows[k - 1]["time"]]
    stamps = np.array([row.get("time", (MONDAY_S + k) * 10**9) for k, row in enumerate(rows)], np.int64)
    if (fall := np.flatnonzero(np.diff(stamps) <= 0)).size:
        before, after = stamps[fall[0] : fall[0] + 2] / 1e9
        times = f"{before:.3f} to {after:.3f} s at pose {fall[0] + 2}"
        raise InputError(f"{path}: time goes from {times}, want it to rise")
    at = np.array([[row[name] for name in pair] for row in rows])
    if pair[0] == "lon" and (off := np.flatnonzero((np.abs(at) > (180.0, 90.0)).any(axis=1))).size:
        place = at[off[0]].tolist()
        raise InputError(f"{path}: pose {off[0] + 1} is lon, lat {place}, want a place on the globe")
    turned = [row.get("yaw", math.pi / 2 - math.radians(row.get("heading", math.nan))) for row in rows]
    files = tuple(row["file"] for row in rows if "file" in has)
    parts = [tuple(row.get(name) for name in _SEGMENT) for row in rows]
    begins = np.array([k == 0 or part != parts[k - 1] for k, part in enumerate(parts)])
    seconds = np.diff(stamps) / 1e9
    begins[1:] |= seconds > max(_GAP_S, _GAP_STEPS * float(np.median(seconds)) if seconds.size else 0.0)
    frames = tuple(row["frame"] for row in rows if "frame" in has)
    return Track(stamps, files, at, pair[0] == "lon", np.array(turned), begins, frames)


def stamp_in(text: str, timezone_s: float) -> int:
    """Return a time, ns of Unix time, or raise ValueError; see `read_track`."""
    fraction, shift = 0, 0.0
    try:
        seconds: float = NUMBER.parse(text)
        if 0.0 <= seconds < _WEEK_S:
            return round((seconds - (timezone_s - MONDAY_S)) * 1e9)
    except ValueError:
        date = datetime.fromisoformat(text)
        fraction, shift = date.microsecond * 1000, timezone_s if date.tzinfo is None else 0.0
        seconds = date.replace(microsecond=0, tzinfo=date.tzinfo or UTC).timestamp()
    if not _UNIX_S[0] <= seconds <= _UNIX_S[1]:
        raise ValueError(text)
    if _DECIMAL.fullmatch(text):  # nanoseconds, which floats are too short for
        return round(Decimal(text) * 10**9)
    return round((seconds - shift) * 1e9) + fraction


def _angle(text: str) -> float:
    value: float = NUMBER.parse(text)
    if abs(value) > 2.0 * math.pi + 0.02:
        raise ValueError(text)
    return value
