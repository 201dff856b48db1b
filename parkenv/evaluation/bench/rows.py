"""Rows of a table of throughputs, and the stop-watch behind them."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypedDict

import numpy as np


class BenchRow(TypedDict):
    """One figure, and that of a peer in the same run.

    Keys:
        part, case: what was measured, and on what.
        value, unit: the figure; None where nothing was measured, the case says why.
        peer, peer_value: what else does the same job, and its figure; None where there is none.
        ratio: ours over the peer's, above 1 means that we are faster.
    """

    part: str
    case: str
    value: float | None
    unit: str
    peer: str | None
    peer_value: float | None
    ratio: float | None


def rate(part: str, case: str, value: float, unit: str, **peers: float) -> list[BenchRow]:
    """A row for each peer, of a figure that is better the larger it is; one row without a peer.

    Args:
        part: what was measured.
        case: on what.
        value: how many a second.
        unit: of what, as in `scans/s`.
        peers: the same figure of other ways.
    """
    if not peers:
        return [_row(part, case, value, unit, None, None, None)]
    return [_row(part, case, value, unit, name, other, value / other) for name, other in peers.items()]


def duration(part: str, case: str, value: float, unit: str, **peers: float) -> list[BenchRow]:
    """As `rate`, of a figure that is better the smaller it is."""
    if not peers:
        return [_row(part, case, value, unit, None, None, None)]
    return [_row(part, case, value, unit, name, other, other / value) for name, other in peers.items()]


def absent(part: str, case: str, unit: str) -> list[BenchRow]:
    """The row of something that could not be measured."""
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
    """Median time, s, of `work(i)` for i = 0, 1, ...; the first call warms up and is left out.

    Args:
        work: what is timed.
        seconds: how long to go on.
        least: how many calls are timed at least.
    """
    work(0)
    times: list[float] = []
    end = time.perf_counter() + seconds
    while len(times) < least or time.perf_counter() < end:
        start = time.perf_counter()
        work(len(times))
        times.append(time.perf_counter() - start)
    return float(np.median(times))
