"""Car parks that a city lists, such as those that it counts, and which facilities of a map they are."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from parkenv.compiled.arrays import FloatArray
from parkenv.errors import InputError
from parkenv.files.csv_tables import TEXT, WHOLE, Kind, typed_records
from parkenv.files.file_names import is_plain
from parkenv.files.limited_reading import require_file

NEAR = 100.0  # m, from a car park of the list to the entry of the facility that it is
SAME_NAME = 4.0  # so many times as far if they share a word that few of the list have
_SIMILAR = 3.0  # largest ratio of the capacities of facilities that share no word


class ListedCarPark(NamedTuple):
    """A car park of a list: its capacity (0: not stated) and position, degrees."""

    name: str
    capacity: int
    lat: float
    lon: float


def _name(text: str) -> str:
    if not (0 < len(text) <= 80 and is_plain(text)):
        raise ValueError(text)
    return text


def _capacity(text: str) -> int:
    if len(text) > 6:
        raise ValueError(text)
    return int(WHOLE.parse(text or "0"))


def _degrees(most: float) -> Kind:
    def parse(text: str) -> float:
        if not abs(float(text)) <= most:
            raise ValueError(text)
        return float(text)

    return Kind(f"degrees from {-most:g} to {most:g}", parse)


_COLUMNS = {
    "name": Kind("a printable name of 1 to 80 letters", _name),
    "capacity": Kind("a whole number of up to 6 digits, or nothing", _capacity),
    "lat": _degrees(90.0),
    "lon": _degrees(180.0),
}


def read_listed(path: Path) -> list[ListedCarPark]:
    """Read a list of car parks, a CSV file with the columns name, capacity, lat and lon; others are not read."""
    require_file(path)
    found: dict[str, ListedCarPark] = {}
    for line, row in typed_records(path, lambda name: _COLUMNS.get(name, TEXT)):
        if missing := [name for name in _COLUMNS if name not in row]:
            raise InputError(f"{path}: has no column {missing[0]}, want {','.join(_COLUMNS)}")
        if row["name"] in found:
            raise InputError(
                f"{path}: line {line}: name is {row['name']!r:.40}, want one that no other line has"
            )
        found[row["name"]] = ListedCarPark(*(row[name] for name in _COLUMNS))
    if not found:
        raise InputError(f"{path}: has no car park, want a line for each")
    return list(found.values())


def matched(
    listed: list[ListedCarPark], at: FloatArray, names: list[str], capacity: FloatArray, xy: FloatArray
) -> NDArray[np.int64]:
    """Return which facility each car park of a list is, (k,) index, -1: none; each is at most one.

    It is one within `NEAR` of about the same capacity, or one whose name shares a word with it within `SAME_NAME` times
    as far; words that many of the list have, such as *garage*, do not count. In all, distances are as small as can be.

    Args:
        listed: the car parks.
        at: (k, 2) m, where they are.
        names: of the n facilities.
        capacity: (n,) of these.
        xy: (n, 2) m, where these are entered.
    """
    words = [set(_words(one.name)) for one in listed]
    use = Counter(word for mine in words for word in mine)
    rare = [{word for word in mine if use[word] <= max(len(listed) // 4, 1)} for mine in words]
    shared = np.array([[bool(mine & set(_words(name))) for name in names] for mine in rare])
    ratio = np.array([[max(one.capacity, 1)] for one in listed]) / np.maximum(capacity, 1.0)
    away = np.hypot(*(at[:, None] - xy).transpose(2, 0, 1))
    away = np.where(shared, away / SAME_NAME, away)
    stated = np.array([[one.capacity > 0] for one in listed])
    unlike = ~shared & stated & (np.maximum(ratio, 1.0 / ratio) > _SIMILAR)
    cost = np.where((away > NEAR) | unlike, 2.0 * NEAR, away)
    found = np.full(len(listed), -1)
    for k, n in zip(*linear_sum_assignment(cost), strict=True):
        if cost[k, n] <= NEAR:
            found[k] = n
    return found


def _words(name: str) -> list[str]:
    return [word for word in name.casefold().replace("-", " ").replace("/", " ").split() if len(word) > 1]
