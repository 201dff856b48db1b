"""Before and after: the same cars in several scenarios, and with other guidance."""

import math

import numpy as np
import pytest
from small_lots import features

from parkenv import InputError, ParkingLot, make_scenario
from parkenv.lots.formats.geojson import write_lot
from parkenv.studies.fleet.setting import NOWHERE
from parkenv.studies.fleet.study import FleetStudy
from parkenv.studies.fleet.tables import CHANGES, summarize_changes
from parkenv.studies.results import without_nan
from parkenv.studies.statistics import mean_interval

HOURS = {"arrivals": {"hours": "08:00-09:00"}, "occupancy": {"typical": {"demand": -0.8}}}
BEFORE = {"name": "before", "lot": "mini", **HOURS}
AFTER = {"name": "after", "lot": {"grid": {"rows": 2, "columns": 7}}, **HOURS}


def study(*scenarios, **changes):
    fields = {"arrivals_per_hour": (12.0,), "days": 4, "knows": ("own", "reserve"), "shares": (0.5,)}
    return FleetStudy(figures=False).changed(scenarios=scenarios, **fields | changes)


@pytest.fixture(scope="module")
def days():
    both = study(BEFORE, AFTER)
    return dict(zip([(one.scenario, one.knows) for one in both.fleet_settings], days_of(both), strict=True))


def days_of(study):
    return [[study.run_day(setting, day) for day in range(study.days)] for setting in study.fleet_settings]


def test_a_lot_compared_with_itself_differs_by_exactly_nothing():
    rows = summarize_changes(days_of(study(BEFORE, BEFORE | {"name": "same"}, days=2)))
    compared = [row for row in rows if row["change"] == "scenario"]
    names = [(row["before"], row["after"], row["knows"]) for row in compared]
    assert names == [("before", "same", knows) for knows in ("own", "reserve")]
    for row in compared:
        values = [row[name] for name in CHANGES] + [end for name in CHANGES for end in row[f"{name}_ci95"]]
        assert {value for value in values if not math.isnan(value)} == {0.0}
        assert not math.isnan(row["others_change_s"])


def test_changes_are_paired_by_day_and_by_car(days):
    rows = summarize_changes(list(days.values()))
    (row,) = (r for r in rows if r["change"] == "scenario" and r["knows"] == "reserve")
    pairs = list(zip(days["after", "reserve"], days["before", "reserve"], strict=True))
    assert all(one["cars"] == other["cars"] and one["member"] == other["member"] for one, other in pairs)
    for name, measure in (("change_s", "total_s"), ("search_change_s", "search_s")):
        expected = mean_interval([one[measure] - other[measure] for one, other in pairs])
        assert (row[name], *row[f"{name}_ci95"]) == pytest.approx(expected)
    for group in ("members", "others"):
        expected = mean_interval([one[f"{group}_s"] - other[f"{group}_s"] for one, other in pairs])
        assert row[f"{group}_change_s"] == pytest.approx(expected[0], abs=0.01)
    (row,) = (r for r in rows if r["change"] == "knows" and r["scenario"] == "before")
    gains, faster = [], []
    for after, before in zip(days["before", "reserve"], days["before", "own"], strict=True):
        member = np.array(after["member"].split()) == "1"
        gained = np.subtract(*(np.array(day["total_cs"].split(), float) for day in (after, before))) / 100.0
        gains.append(gained[member].mean())
        faster.append((gained <= -1.0).mean())
    assert row["members_change_s"] == pytest.approx(np.mean(gains)), "members are compared with themselves"
    assert row["better_off"] == pytest.approx(np.mean(faster))
    assert row["better_off"] + row["worse_off"] <= 1.0
    assert row["before"] == "own observations"
    assert row["after"] == "reservations for 50 %"


def test_only_equal_hours_have_the_same_cars():
    with pytest.raises(InputError, match=r"arrivals\.hours of 'after' are not those of 'before'"):
        study(BEFORE, AFTER | {"arrivals": {"hours": "09:00-10:00"}}).check()


def test_each_purpose_has_its_own_change_and_together_they_are_that_of_all():
    demand = {
        "shoppers": {"arrivals_per_hour": (30.0,) * 24, "stay_s": 900.0},
        "commuters": {"arrivals_per_hour": (15.0,) * 24, "stay_s": 7200.0},
    }
    after = {"name": "after", "costs": {"give_up_s": 60.0}}
    scenarios = BEFORE | {"demand": demand}, BEFORE | after | {"demand": demand}
    days = days_of(study(*scenarios, knows=("own",), arrivals_per_hour=None))
    whole, *parts = without_nan(summarize_changes(days, purposes={"before": list(demand)}))
    assert [row["purpose"] for row in parts] == list(demand)
    cars, changes = ([row[name] for row in parts] for name in ("cars_a_day", "change_s"))
    assert sum(cars) == pytest.approx(whole["cars_a_day"])
    assert np.average(changes, weights=cars) == pytest.approx(whole["change_s"], rel=0.1)


def test_prices_of_zones_change_what_is_paid_and_who_wins(tmp_path):
    lot = make_scenario("campus").lot
    zone = np.where(lot.walk_m() <= np.median(lot.walk_m()), "near", "far")
    write_lot(ParkingLot(**features(lot) | {"slot_zone": zone}), tmp_path / "zoned.geojson")
    specs = [
        {"name": name, "lot": str(tmp_path / "zoned.geojson"), "costs": {"prices": {"near": near, "far": 1.0}}, **HOURS}
        for name, near in (("before", 1.0), ("after", 1.2))
    ]  # fmt: skip
    priced = study(*specs, agents=("greedy-goal",), knows=("own",), arrivals_per_hour=(60.0,), days=3)
    before, after = days = days_of(priced)
    prices = {"before": {"far": 1.0, "near": 1.0}, "after": {"far": 1.0, "near": 1.2}}
    rows = summarize_changes(days, prices)
    assert [row["zone"] for row in rows] == [None, "far", "near"]
    whole, *by_zone = rows
    paid = [[np.array(day["paid_cents"].split(), float).mean() / 100.0 for day in of] for of in days]
    fleet, _ = priced.fleet(priced.fleet_settings[0])
    fleet.reset(priced.seed, 0)
    assert paid[0][0] == pytest.approx(fleet.cars["stay_s"].mean() / 3600.0, abs=0.01), "one price everywhere"
    assert whole["paid_change"] == pytest.approx(np.mean(np.subtract(*paid[::-1])))
    assert whole["paid_change"] > 0.0
    assert sum(row["cars_a_day"] for row in by_zone) == pytest.approx(whole["cars_a_day"])
    for name in ("parking_cost_change_s", "gave_up_change_s"):
        measure = name.replace("_change", "")
        changed = [a[measure] - b[measure] for a, b in zip(after, before, strict=True)]
        assert whole[name] == pytest.approx(np.mean(changed))
    assert whole["prices"] == "near 1 → 1.2 an hour"
    for day in before:
        day["zone"] = " ".join(["0", *day["zone"].split()[1:]])
    whole, nowhere, *by_zone = without_nan(summarize_changes(days, prices))
    assert nowhere["cars_a_day"] == 1.0
    assert sum(row["cars_a_day"] for row in (nowhere, *by_zone)) == pytest.approx(whole["cars_a_day"])
    assert nowhere["zone"] == NOWHERE
