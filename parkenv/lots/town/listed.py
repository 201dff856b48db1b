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
from parkenv.files.file_names import is_plain
from parkenv.files.limited_reading import csv_records

COLUMNS = ("name", "capacity", "lat", "lon")
MAX_CAPACITY = 1_000_000
NEAR = 100.0  # m, from a car park of the list to the entry of the facility that it is
SAME_NAME = 4.0  # so many times as far if they share a word that few of the list have
_SIMILAR = 3.0  # largest ratio of the capacities of facilities that share no word


class ListedCarPark(NamedTuple):
    """A car park of a list: its capacity (0: not stated) and position, degrees."""

    name: str
    capacity: int
    lat: float
    lon: float


def read_listed(path: Path) -> list[ListedCarPark]:
    """Read a list of car parks, a CSV file with `COLUMNS`; others are not read.

    Raises:
        InputError: the file cannot be read, or a value is wrong; the message names file, line, column and value.
    """
    found: dict[str, ListedCarPark] = {}
    for line, record in csv_records(path):
        if missing := [name for name in COLUMNS if name not in record]:
            raise InputError(f"{path}: has no column {missing[0]}, want {','.join(COLUMNS)}")
        name = record["name"]
        if not (0 < len(name) <= 80 and is_plain(name)) or name in found:
            raise InputError(f"{path}: line {line}: name is {name!a:.40}, want a name of its own, printable")
        numbers = []
        for column, least, most in (
            ("capacity", 0.0, MAX_CAPACITY),
            ("lat", -90.0, 90.0),
            ("lon", -180.0, 180.0),
        ):
            text = record[column]
            try:
                value = float(text or 0.0) if column == "capacity" else float(text)
            except ValueError:
                value = np.nan
            if not least <= value <= most or (column == "capacity" and value % 1):
                wanted = "a whole number" if column == "capacity" else "degrees"
                raise InputError(
                    f"{path}: line {line}: {column} is {text!r:.40}, want {wanted} from {least:g} to {most:g}"
                )
            numbers.append(value)
        found[name] = ListedCarPark(name, int(numbers[0]), *numbers[1:])
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
