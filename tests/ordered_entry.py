"""The driver of queueing theory: it knows everything, drives in no time and takes the slot that costs least."""

from parkenv.compiled.jit import inlined, kernel
from parkenv.compiled.memory import int64s
from parkenv.engine.policy import LEAVE, TAKE_SLOT, CompiledPolicy
from parkenv.engine.records import car_at, fleet_at
from parkenv.engine.search_belief import is_slot_open


@inlined
def by_distance(fleet, car):
    """Return the slots in order of their distance from the goal, (n_slots,) int64."""
    return int64s(fleet.by_cost + 8 * fleet.n_slots * car.scenario_index)


@kernel
def decide_ordered_entry(address, number):
    """Stand in the free slot with the lowest cost of arrival at once; if there is none, park elsewhere."""
    fleet = fleet_at(address, 0)
    slots = by_distance(fleet, car_at(fleet.cars, number))
    for i in range(fleet.n_slots):
        if is_slot_open(address, slots[i], number, fleet.time):
            return int(TAKE_SLOT + slots[i])
    return LEAVE


ORDERED_ENTRY = CompiledPolicy("ordered-entry", decide_ordered_entry)
