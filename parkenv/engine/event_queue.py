"""A queue of events in continuous time, for compiled code: a binary heap of records."""

from __future__ import annotations

from typing import Any

import numpy as np

from parkenv.compiled.memory import ADDRESS, record_at
from parkenv.world.occupancy.kernel import inlined, kernel

DEPARTURE, ARRIVAL, REACH = range(3)
"""Kinds of events, in the order in which they happen at the same time: a parked car leaves; a car arrives at its entry;
a car's step is over."""

EVENT = np.dtype(
    [("time", np.float64), ("kind", np.int64), ("number", np.int64), ("car", np.int64)], align=True
)
"""An event: s since Monday 00:00; kind; number of the event in its world, which decides between equal ones; the car."""

QUEUE_FIELDS = [("events", ADDRESS), ("n_events", np.int64), ("event_number", np.int64)]
"""A queue: address of its EVENT records, with room for all; how many there are; number of the next one."""

event_at = record_at(EVENT)


@inlined
def is_before(one: Any, other: Any) -> bool:
    """Return whether an event happens before another one."""
    if one.time != other.time:
        return bool(one.time < other.time)
    if one.kind != other.kind:
        return bool(one.kind < other.kind)
    return bool(one.number < other.number)


@inlined
def _copy(to: Any, event: Any) -> None:
    to.time, to.kind, to.number, to.car = event.time, event.kind, event.number, event.car


@kernel
def push_event(queue: Any, time: float, kind: int, car: int) -> None:
    """Add an event to the queue of a record with `QUEUE_FIELDS`."""
    events, at = queue.events, queue.n_events
    new = event_at(events, at)
    new.time, new.kind, new.number, new.car = time, kind, queue.event_number, car
    queue.n_events += 1
    queue.event_number += 1
    number = new.number
    while at > 0:
        parent = event_at(events, (at - 1) >> 1)
        here = event_at(events, at)
        if parent.time < time or (
            parent.time == time and (parent.kind < kind or (parent.kind == kind and parent.number < number))
        ):
            break
        _copy(here, parent)
        at = (at - 1) >> 1
        up = event_at(events, at)
        up.time, up.kind, up.number, up.car = time, kind, number, car


@kernel
def pop_event(queue: Any) -> int:
    """Remove the first event, at least one must be there; returns its car."""
    events = queue.events
    car: int = event_at(events, 0).car
    queue.n_events -= 1
    n, at = queue.n_events, 0
    last = event_at(events, n)
    while True:
        child = 2 * at + 1
        if child >= n:
            break
        if child + 1 < n and is_before(event_at(events, child + 1), event_at(events, child)):
            child += 1
        if not is_before(event_at(events, child), last):
            break
        _copy(event_at(events, at), event_at(events, child))
        at = child
    _copy(event_at(events, at), last)
    return car
