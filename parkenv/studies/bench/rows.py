"""Rows of the benchmark table, and timing."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypedDict

import numpy as np


class BenchRow(TypedDict):
    """One measured value, and that of a peer in the same run.

    Keys:
        part, case: what was measured, and on which input.
        value, unit: the value; None if nothing was measured, for the reason given in `case`.
        peer, peer_value: other software for the same task and its value; None without a peer.
        ratio: above 1 if ours is faster.
    """

    part: str
    case: str
    value: float | None
    unit: str
    peer: str | None
    peer_value: float | None
    ratio: float | None


def rate(part: str, case: str, value: float, unit: str, **peers: float) -> list[BenchRow]:
    """Return one row per peer for a value where higher is better; a single row without peers.

    Args:
        part: what was measured.
        case: the input.
        value: value per second.
        unit: unit, such as `scans/s`.
        peers: values of the peers.
    """
    if not peers:
        return [_row(part, case, value, unit, None, None, None)]
    return [_row(part, case, value, unit, name, other, value / other) for name, other in peers.items()]


def duration(part: str, case: str, value: float, unit: str, **peers: float) -> list[BenchRow]:
    """Return rows like `rate` for a value where lower is better."""
    if not peers:
        return [_row(part, case, value, unit, None, None, None)]
    return [_row(part, case, value, unit, name, other, other / value) for name, other in peers.items()]


def absent(part: str, case: str, unit: str) -> list[BenchRow]:
    """Return the row of a value that could not be measured."""
    return [_row(part, case, None, unit, None, None, None)]


def _row(
    part: str,
    case: str,
    value: float | None,
    unit: str,
    peer: str | None,
    peer_value: float | None,
    ratio: float | None,
) -> BenchRow:
    return BenchRow(
        part=part, case=case, value=value, unit=unit, peer=peer, peer_value=peer_value, ratio=ratio
    )


def seconds_each(work: Callable[[int], object], seconds: float = 0.6, least: int = 3) -> float:
    """Return the median time, s, of `work(i)` for i = 0, 1, ...; the first call is a warm-up.

    Args:
        work: the timed function.
        seconds: minimum total duration.
        least: minimum number of timed calls.
    """
    work(0)
    times: list[float] = []
    end = time.perf_counter() + seconds
    while len(times) < least or time.perf_counter() < end:
        start = time.perf_counter()
        work(len(times))
        times.append(time.perf_counter() - start)
    return float(np.median(times))
