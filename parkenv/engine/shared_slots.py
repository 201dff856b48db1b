"""Slots that many cars share: who stands in each, and whether it is taken.

A slot is taken if a car of the fleet stands in it, or else by the *background*: nobody; residents, who were parked when
the world began, leave once and are followed by cars of the fleet only; or the scenario's own process or log, in which
other cars come and go all day.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.memory import ADDRESS, record_at
from parkenv.world.occupancy import kernel as worlds
from parkenv.world.occupancy.kernel import CURSOR_FIELDS, WORLD_FIELDS, inlined, kernel

BACKGROUNDS = ("process", "residents", "none")
PROCESS_BACKGROUND, RESIDENTS_BACKGROUND, NO_BACKGROUND = range(3)
NO_CAR = -1

# Records do not begin with another's fields: numba would take them for that type, with a warning.
SHARED_WORLD_FIELDS = [
    # (n_slots,) SHARED_SLOT records.
    ("n_slots", np.int64),
    ("slots", ADDRESS),
    *WORLD_FIELDS,
    ("background", np.int64),
    # The scenario's own world, as in SCENARIO: whether it is a log; a PROCESS record, or the RECORDED_DAY of the day.
    ("is_log", np.bool_),
    ("world", ADDRESS),
]
SHARED_WORLD = np.dtype(SHARED_WORLD_FIELDS, align=True)
"""The hidden occupancy of a world that many cars share. A longer record that begins with these fields also serves, by
its address."""

SHARED_SLOT = np.dtype(
    [
        ("car", np.int64),
        ("leaves_at", np.float64),
        ("held_by", np.int64),
        *CURSOR_FIELDS,
    ],
    align=True,
)
"""A shared slot: the car of the fleet in it or `NO_CAR`; when that car, or else the resident, leaves or has left, s;
the car that waits for it, or `NO_CAR`; cursor of the background."""

shared_world_at, shared_slot_at = record_at(SHARED_WORLD), record_at(SHARED_SLOT)


@kernel
def is_shared_slot_taken(address: int, slot: int, time: float) -> bool:
    """Return whether a slot is taken at a time, s; times must not decrease between calls.

    Args:
        address: address of the SHARED_WORLD record.
        slot: index of the slot.
        time: s since Monday 00:00.
    """
    world = shared_world_at(address, 0)
    shared = shared_slot_at(world.slots, slot)
    if shared.car != NO_CAR:
        return True
    if world.background == PROCESS_BACKGROUND:
        return bool(_background_state(world, slot, shared, time))
    return bool(time < shared.leaves_at)


@inlined
def is_slot_open(address: int, slot: int, car: int, time: float) -> bool:
    """Return whether a car may park in a slot at a time, s: it is free, and no other car waits for it."""
    held_by = shared_slot_at(shared_world_at(address, 0).slots, slot).held_by
    return bool(held_by in (NO_CAR, car) and not is_shared_slot_taken(address, slot, time))


@inlined
def leaves_soon(world: Any, slot: int, time: float, soon_s: float) -> bool:
    """Return whether the car in a slot, of the fleet or a resident, leaves within `soon_s` s after a time, s."""
    leaves_at = shared_slot_at(world.slots, slot).leaves_at
    return bool(time < leaves_at <= time + soon_s)


@inlined
def _background_state(world: Any, slot: int, shared: Any, time: float) -> bool:
    """Return whether the scenario's own process or log takes a slot at a time."""
    if time >= shared.valid_until:
        if world.is_log:
            worlds.recorded_state(worlds.recorded_day_at(world.world, 0), slot, shared, time)
        else:
            worlds.process_state(worlds.process_at(world.world, 0), world, slot, shared, time)
    return bool(shared.occupied)


@kernel
def empty_shared_slots(address: int) -> None:
    """Begin a world: no car of the fleet is parked, and residents are where the background has cars at the arrival.

    Args:
        address: address of the SHARED_WORLD record.
    """
    world = shared_world_at(address, 0)
    if not world.is_log:
        worlds.draw_day(worlds.process_at(world.world, 0), world)
    for slot in range(world.n_slots):
        shared = shared_slot_at(world.slots, slot)
        shared.sojourn, shared.valid_until = 0, -np.inf
        shared.car, shared.held_by, shared.leaves_at = NO_CAR, NO_CAR, -np.inf
        if world.background == RESIDENTS_BACKGROUND and _background_state(world, slot, shared, world.arrival):
            shared.leaves_at = _end_of_stay(world, slot, shared)


@inlined
def _end_of_stay(world: Any, slot: int, shared: Any) -> float:
    """Return when the background's car that stands in a slot leaves, s; infinite if never."""
    if not world.is_log:
        worlds.find_sojourn_end(worlds.process_at(world.world, 0), world, slot, shared)
        return float(shared.valid_until)
    while shared.occupied and shared.valid_until < np.inf:
        _background_state(world, slot, shared, shared.valid_until + 1e-3)
    return float(np.inf if shared.occupied else shared.valid_until)


@kernel
def shared_slots_taken_at(address: int, time: float, taken: NDArray[np.bool_]) -> None:
    """Write whether each slot, (n_slots,), is taken at a time, s; times must not decrease between calls."""
    for slot in range(len(taken)):
        taken[slot] = is_shared_slot_taken(address, slot, time)
