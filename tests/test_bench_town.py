"""The benchmark of towns: its district is one that SUMO can have, and its rows add up."""

import numpy as np

from parkenv.lots import city_lot
from parkenv.studies.bench import sumo, town


def test_a_district_of_counted_kerbs_keeps_its_spaces_and_its_garage():
    lot = town.with_garage(city_lot(200, 1), 30)
    blocks = town.blocks_of(lot)
    assert blocks.capacity.sum() == 230
    assert blocks.is_counted.all()
    assert blocks.capacity[-1] == 30
    slots = [slot for street in sumo.streets_of(blocks) for slot, _ in street.slots]
    assert sorted(slots) == list(range(blocks.n_slots))
    names = [street.name for street in sumo.streets_of(blocks)]
    assert len(set(names)) == len(names)


def test_occupancy_is_the_share_of_the_spaces_and_the_time():
    blocks = town.blocks_of(town.with_garage(city_lot(200, 1), 30))
    slot = np.array([blocks.n_slots - 1, blocks.n_slots - 1, -1])
    began, left = np.array([0.0, 50.0, np.nan]), np.array([100.0, np.inf, np.nan])
    share = sumo.ParkedDay(began, slot, began, left, 0.0).parked_share(blocks.capacity, 100.0)
    assert share[-1] == 1.5 / 30
    assert not share[:-1].any()
