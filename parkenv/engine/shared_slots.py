"""Slots that many cars share: whether one is taken, by a car of the fleet or by the background."""

from __future__ import annotations

from typing import Any

import numpy as np

from parkenv.compiled.arrays import BoolArray
from parkenv.engine.records import (
    NO_CAR,
    PROCESS_BACKGROUND,
    RESIDENTS_BACKGROUND,
    counted_at,
    shared_slot_at,
    shared_world_at,
)
from parkenv.world.occupancy import kernel as worlds
from parkenv.world.occupancy.kernel import inlined, kernel


@kernel
def is_shared_slot_taken(address: int, slot: int, time: float) -> bool:
    """Return whether a slot of a SHARED_WORLD record is taken at a time, s; times must not decrease between calls."""
    world = shared_world_at(address, 0)
    if slot >= world.first_counted:
        counted = counted_at(world.counted, slot - world.first_counted)
        return bool(counted.n_cars >= counted.capacity)
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
    if time >= shared.valid_until:
        worlds.find_state(world.world_kind, world.world, world, slot, shared, time)
    return bool(shared.occupied)


@kernel
def empty_shared_slots(address: int) -> None:
    """Begin a world: no car of the fleet is parked, and residents are where the background has cars at the arrival."""
    world = shared_world_at(address, 0)
    worlds.begin_day(world.world_kind, world.world, world)
    for slot in range(world.n_slots):
        shared = shared_slot_at(world.slots, slot)
        shared.sojourn, shared.valid_until = 0, -np.inf
        shared.car, shared.held_by, shared.leaves_at = NO_CAR, NO_CAR, -np.inf
        if slot >= world.first_counted:
            counted = counted_at(world.counted, slot - world.first_counted)
            counted.n_cars = counted.published = 0
            counted.gate_free_at = counted.period = -np.inf
        elif world.background == RESIDENTS_BACKGROUND and _background_state(
            world, slot, shared, world.arrival
        ):
            shared.leaves_at = worlds.find_end_of_stay(
                world.world_kind, world.world, world, slot, shared, world.arrival
            )


@kernel
def shared_slots_taken_at(address: int, time: float, taken: BoolArray) -> None:
    """Write whether each slot, (n_slots,), is taken at a time, s; times must not decrease between calls."""
    for slot in range(len(taken)):
        taken[slot] = is_shared_slot_taken(address, slot, time)
