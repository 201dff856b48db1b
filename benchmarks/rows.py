"""Rows of the benchmarks, and timing.

A row has the keys part, case (the input), value, unit, peer (other software for the same task, None without one),
peer_value and ratio, above 1 if ours is faster. The value is None if nothing was measured; `case` says why.
"""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

Row = dict[str, Any]
Measure = Callable[[int], float]
"""Measures something once; called with 0, 1, ..."""


def rate(part: str, case: str, value: float, unit: str, **peers: float) -> list[Row]:
    """Return one row per peer for a value where higher is better; a single row without peers."""
    return _rows(part, case, value, unit, {name: (other, value / other) for name, other in peers.items()})


def duration(part: str, case: str, value: float, unit: str, **peers: float) -> list[Row]:
    """Return rows like `rate` for a value where lower is better."""
    return _rows(part, case, value, unit, {name: (other, other / value) for name, other in peers.items()})


def equal(part: str, case: str, value: float, unit: str, **peers: float) -> list[Row]:
    """Return rows like `rate` for a value that is to be equal, not high or low."""
    return _rows(part, case, value, unit, {name: (other, None) for name, other in peers.items()})


def absent(part: str, case: str, unit: str) -> list[Row]:
    """Return the row of a value that could not be measured."""
    return _rows(part, case, None, unit, {})


def _rows(part: str, case: str, value: float | None, unit: str, peers: Mapping[Any, Any]) -> list[Row]:
    head = {"part": part, "case": case, "value": value, "unit": unit}
    found = peers or {None: (None, None)}
    return [
        head | {"peer": peer, "peer_value": other, "ratio": ratio} for peer, (other, ratio) in found.items()
    ]


def peak_memory_gib() -> float:
    """Return this process's peak of resident memory."""
    # Kilobytes, except on macOS.
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**30


def medians(measures: Mapping[str, Measure], seconds: float = 0.6, least: int = 3) -> dict[str, float]:
    """Return the median of what each function measures; they take turns, so that other load affects all equally.

    Args:
        measures: the functions; the first call of each is a warm-up, which may compile.
        seconds: minimum time of all calls of each.
        least: minimum number of calls of each.
    """
    found: dict[str, list[float]] = {name: [] for name in measures}
    spent = dict.fromkeys(measures, 0.0)
    for measure in measures.values():
        measure(0)
    while waiting := [name for name in measures if len(found[name]) < least or spent[name] < seconds]:
        for name in waiting:
            start = time.perf_counter()
            found[name].append(measures[name](1 + len(found[name])))
            spent[name] += time.perf_counter() - start
    return {name: float(np.median(values)) for name, values in found.items()}


def median_of(measure: Measure, seconds: float = 0.6, least: int = 3) -> float:
    """Return the median of what a function measures; see `medians`."""
    return medians({"": measure}, seconds, least)[""]


def seconds_each(work: Callable[[int], object], seconds: float = 0.6, least: int = 3) -> float:
    """Return the median time, s, of `work(i)`; see `medians`."""

    def timed(i: int) -> float:
        start = time.perf_counter()
        work(i)
        return time.perf_counter() - start

    return median_of(timed, seconds, least)
