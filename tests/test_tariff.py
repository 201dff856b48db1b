"""Prices of zones: what parking costs a driver, in single searches and in fleets, and what a city reads of it."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from small_lots import features

from parkenv import InputError, ParkingLot, make_scenario
from parkenv.lots import grid_lot
from parkenv.scenarios.spec import ScenarioSpec
from parkenv.world.tariff import NO_ZONE, Tariff


def zoned(lot, **columns):
    """The lot with the nearer half of its slots in the zone `centre`."""
    walk = lot.walk_m()
    zone = np.where(walk <= np.median(walk), "centre", "")
    return ParkingLot(**features(lot) | {"slot_zone": zone} | columns)


@pytest.fixture(scope="module")
def scenario():
    """Half of the slots in a zone with a price, on top of the costs of the lot itself."""
    plain = make_scenario("mini")
    lot = zoned(plain.lot, slot_parking_cost_s=np.arange(plain.lot.n_slots, dtype=float))
    return plain.replace(lot=lot, tariff=Tariff({"centre": 3.0}), value_of_time=10.0, stay_s=1800.0)


def test_what_parking_costs_is_price_times_stay_over_the_value_of_time(scenario):
    lot = scenario.lot
    assert lot.zones == ("centre", NO_ZONE)
    paid_s = 3.0 * 0.5 / 10.0 * 3600.0
    expected = lot.slot_parking_cost_s + paid_s * (lot.slot_zone == "centre")
    for problem in (scenario, scenario.public(), pickle.loads(pickle.dumps(scenario))):
        np.testing.assert_allclose(problem.parking_cost_s, expected)
        np.testing.assert_allclose(problem.arrival_cost_s, problem.walk_s + expected)
    free = scenario.replace(tariff=Tariff())
    assert free.parking_cost_s.tolist() == lot.slot_parking_cost_s.tolist()


def test_a_file_says_what_options_say(tmp_path):
    file = tmp_path / "town.toml"
    file.write_text('lot = "mini"\n[costs]\nprices = { other = 2 }\nvalue_of_time = 8\nstay_s = 900\n')
    scenario = make_scenario(file)
    assert set(scenario.parking_cost_s) == {2 * 900 / 8}
    again = ScenarioSpec.parse(ScenarioSpec.read(file).tables(), "again")
    assert again.costs == ScenarioSpec.read(file).costs


@pytest.mark.parametrize(
    ("costs", "message"),
    [
        ({"prices": {"othr": 1.0}}, "no zone 'othr'; did you mean 'other'"),
        ({"prices": {"other": -1.0}}, "costs.prices.other is -1.0, want a number of at least 0"),
        ({"prices": {"other": "2"}}, "costs.prices.other is '2', want a number"),
        ({"value_of_time": 0.0}, "costs.value_of_time is 0.0, want a number above 0"),
    ],
)
def test_wrong_prices_are_named(costs, message):
    with pytest.raises(InputError, match=message):
        make_scenario(ScenarioSpec.parse({"lot": "mini", "costs": costs}, "town"))


def test_a_price_of_a_zone_that_the_lot_lacks_is_refused_in_python_too():
    lot = zoned(grid_lot(1, 4))
    with pytest.raises(InputError, match="no zone 'center'; did you mean 'centre'"):
        make_scenario(lot, tariff=Tariff({"center": 1.0}))
    with pytest.raises(InputError, match="price of zone 'centre' is nan"):
        Tariff({"centre": np.nan})
    with pytest.raises(InputError, match="control characters"):
        replace(lot, slot_zone=["a\x1b"] * 4)
