"""Prices of zones: what parking costs a driver, in single searches and in fleets, and what a city reads of it."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from command_line import rows_in
from small_lots import driven, features

from parkenv import InputError, ParkingLot, fleet, make_scenario
from parkenv.engine.fleet import DriverKind, Fleet
from parkenv.lots import grid_lot, packaged_lot, write_lot
from parkenv.scenarios.spec import ScenarioSpec
from parkenv.studies.episodes import EpisodeRunner
from parkenv.studies.fields import AgentSpec
from parkenv.studies.fleet.drivers import AgentsByStay, policy_of
from parkenv.world.cost_terms import COST_FIELDS
from parkenv.world.demand import ConstantTime, Demand, ExponentialTime, Headways
from parkenv.world.occupancy.process import OccupancyProcess
from parkenv.world.scenario import drive_times
from parkenv.world.tariff import NO_ZONE, Hours, Price, Tariff, Zone
from planners import make_agent
from planners.heuristics import POLICIES


def zoned(lot, far="", **columns):
    """The lot with the nearer half of its slots in the zone `centre`."""
    walk = lot.walk_m()
    zone = np.where(walk <= np.median(walk), "centre", far)
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


@pytest.mark.parametrize("policy", ["greedy-total", "greedy-drive"])
def test_a_car_pays_for_its_own_stay_whoever_drives(scenario, policy):
    demand, lot = Demand(Headways(12, mean_s=30.0), ExponentialTime(2400.0)), scenario.lot
    driver = DriverKind(policy=POLICIES[policy])
    cars = driven(Fleet(scenario, demand, drivers=[driver], background="none"), 1).cars
    parked = cars[cars["slot"] >= 0]
    price = np.where(lot.slot_zone == "centre", 3.0, 0.0)[parked["slot"]]
    paid_s = price * parked["stay_s"] / 10.0
    np.testing.assert_allclose(parked["parking_cost_s"], lot.slot_parking_cost_s[parked["slot"]] + paid_s)
    np.testing.assert_allclose(sum(cars[name] for name in COST_FIELDS), cars["total_s"])


def test_who_stays_long_drives_to_where_it_is_free():
    """Between a near zone and a free one far away, the indifferent stay is that whose price is worth the walk."""
    lot = zoned(grid_lot(1, 20), far="far")
    nobody = OccupancyProcess.from_demand(np.full(lot.n_slots, -50.0), np.zeros(168))
    scenario = make_scenario(lot, occupancy=nobody, tariff=Tariff({"centre": 2.0}), value_of_time=12.0)
    drive_s = drive_times(scenario, int(lot.entry_vertices[0]))
    way_s, centre = drive_s + scenario.walk_s, lot.slot_zone == "centre"
    worth_s = way_s[~centre].min() - way_s[centre].min()
    assert worth_s > 0.0
    indifferent_s = worth_s * 12.0 / 2.0
    for stay_s, zone in ((0.98 * indifferent_s, "centre"), (1.02 * indifferent_s, "far")):
        driver = DriverKind(policy=POLICIES["greedy-total"], knows="full")
        demand = Demand(Headways(1), ConstantTime(stay_s))
        cars = driven(Fleet(scenario, demand, background="none", drivers=[driver]), 0).cars
        assert lot.slot_zone[cars["slot"][0]] == zone
        # The same indifference in the value of time, for a fixed stay.
        dear = scenario.replace(stay_s=indifferent_s, value_of_time=12.0 * indifferent_s / stay_s)
        slot = EpisodeRunner(dear, "oracle", make_agent("oracle", dear)).run(0).row["slot"]
        assert lot.slot_zone[lot.slot_ids.index(slot)] == zone


def test_revenue_is_price_times_stay_of_the_parked_cars(tmp_path):
    file = tmp_path / "zones.geojson"
    write_lot(zoned(packaged_lot("mini")), file)
    result = fleet(
        scenarios=[{"lot": str(file), "costs": {"prices": {"centre": 3.0}}, "arrivals": {"hours": "08:00-09:00"}}],
        arrivals_per_hour=(12.0,), knows=("own",), days=2, folder=tmp_path / "run",
    )  # fmt: skip
    (row,), study = result.rows, result.study
    assert row["agents"] == "greedy-total"
    assert sum(row[name] for name in COST_FIELDS) == pytest.approx(row["total_s"])
    revenue, paid, n_parked = [], [], []
    for day in range(2):
        day_fleet, agents = study.fleet(*study.fleet_settings)
        cars = driven(day_fleet, study.seed, day, agents=agents).cars
        parked = cars[cars["slot"] >= 0]
        inside = study.built["zones"].lot.slot_zone[parked["slot"]] == "centre"
        revenue.append(3.0 * parked["stay_s"][inside].sum() / 3600.0)
        paid.append(revenue[-1] / len(cars))
        n_parked.append([inside.sum(), (~inside).sum()])
    centre, other = result.summary["zones"]
    assert (centre["zone"], centre["slots"]) == ("centre", 5)
    assert (other["zone"], other["paid_a_day"]) == (NO_ZONE, 0.0)
    assert centre["paid_a_day"] == pytest.approx(np.mean(revenue))
    assert [centre["parked_a_day"], other["parked_a_day"]] == np.mean(n_parked, axis=0).tolist()
    assert row["paid"] == pytest.approx(np.mean(paid))
    lines = rows_in(tmp_path / "run" / "blocks.csv")
    assert sum(float(line["paid"]) for line in lines) == pytest.approx(sum(revenue))


def test_agents_in_python_know_their_own_stay(scenario):
    """A car whose driver decides in Python drives as the compiled one does."""
    policy, agent = policy_of(AgentSpec.of("greedy-total"), scenario)
    assert agent is None
    python = AgentsByStay(AgentSpec.of("greedy-total"), scenario, {})
    demand = Demand(Headways(8, mean_s=30.0), ExponentialTime(2400.0))
    slots = []
    for kind, agents in ((DriverKind(policy=policy), None), (DriverKind(), [python])):
        its = Fleet(scenario, demand, drivers=[kind], background="none")
        slots.append(driven(its, 3, agents=agents).cars["slot"].tolist())
    assert slots[0] == slots[1]


def test_prices_are_added_to_those_of_paid_zones():
    """Their hours, free minutes and limits stay; zones that cost nothing, or have another name, keep their prices."""
    day = Hours.parse("Mo-Fr 08:00-20:00")
    paid = Zone("kerb paid Mo-Fr", Price(2.0, free_s=900.0, charged=day), max_stay_s=7200.0)
    steps = Zone("kerb steps", Price(4.0, steps=((3600.0, 1.0), (7200.0, 3.0))))
    others = Zone("kerb free"), Zone("garage", Price(2.0))
    tariff = Tariff({"kerb*": "+1"})
    assert tariff.priced(paid) == replace(paid, price=Price(3.0, free_s=900.0, charged=day))
    assert tariff.priced(steps).price == Price(5.0, steps=((3600.0, 2.0), (7200.0, 5.0)))
    assert tuple(map(tariff.priced, others)) == others
    assert Tariff({"garage": "+0.5"}).priced(others[1]).price == Price(2.5)
    with pytest.raises(InputError, match="no paid zone 'lot"):
        Tariff({"lot*": "+1"}).require_zones([paid, *others], "town")


def test_a_scenario_changes_the_rules_of_zones():
    ring = {"price": "1 @ 08:00-12:00; 3 @ 12:00-20:00", "users": ["public", "permit-a"], "max_stay_s": 7200}
    plain, changed = (make_scenario({"base": "town", "zones": its}).lot for its in ({}, {"ring": ring}))
    price = changed.zone_rules["ring"].price.amount(np.array([10.0, 11.0, 18.0]) * 3600.0, 7200.0)
    assert price.tolist() == [2.0, 4.0, 6.0]
    assert changed.zone_rules["ring"].max_stay_s == 7200.0
    assert changed.zone_rules["ring"].hours == plain.zone_rules["ring"].hours
    assert changed.zone_rules["outer"] == plain.zone_rules["outer"]
    for wrong, field in (
        ({"mall": {"price": 1}}, "mall"),
        ({"ring": {"users": ["nobody"]}}, "nobody"),
        ({"ring": {"hours": "late"}}, "hours"),
        ({"ring": {"price": "1 @ late"}}, "price"),
    ):
        with pytest.raises(InputError, match=field):
            make_scenario({"base": "town", "zones": wrong})


def test_prices_by_hours_are_a_tariff():
    zone = Tariff({"near": "1 @ 08:00-12:00; 3 @ 12:00-15:00"}).priced(Zone("near", Price(9.0)))
    begin = np.array([7.0, 11.5, 16.0]) * 3600.0
    assert zone.price.raised(1.0).amount(begin, 7200.0).tolist() == [2.0, 7.0, 0.0]
    with pytest.raises(InputError, match="hourly"):
        Price(1.0, hourly=zone.price.hourly)
    with pytest.raises(InputError, match="price"):
        Tariff({"near": "cheap"})
