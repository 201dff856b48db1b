"""A parking lot as the sensors see it."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

from parkenv.lot import Mouth, ParkingLot, is_building
from sim_sensors.slot_scenes import SlotLot, slot_surroundings

WALL_HEIGHT = 1.8
"""Height, m, of walls that a lot's file gives as open lines; closed ones are buildings."""


def slot_lot(lot: ParkingLot, seed: int = 0) -> SlotLot:
    """The lot's slots for `sim_sensors`: `slot_lot(lot).scene(occupied)` is what stands there.

    Closed walls become buildings, open ones free-standing walls. Place i of the scene is slot i, in the lot's
    own frame.

    Args:
        lot: the lot.
        seed: of the cars' models and of everything's texture.
    """
    buildings = [wall[:-1] for wall in lot.walls if is_building(wall)]
    legs = [
        [*start, *end, WALL_HEIGHT]
        for wall in lot.walls
        if not is_building(wall)
        for start, end in pairwise(wall)
    ]
    slots = SlotLot(
        lot.slot_xy,
        lot.slot_yaw,
        lot.slot_length,
        lot.slot_width,
        kerbside=lot.slot_mouth != Mouth.REAR,
        seed=seed,
    )
    lanes = [lane.points for lane in lot.lanes]
    around = slot_surroundings(slots, lanes, buildings=buildings, walls=legs, seed=seed)
    return replace(slots, surroundings=around)
