"""Experiments with many cars: settings, measures, summary, figure and command."""

import math

import numpy as np
import pytest
from command_line import refused

from parkenv import InputError, SearchProblem
from parkenv.lots import grid_lot
from parkenv.scenarios.calibration import Calibration
from parkenv.scenarios.spec import scenario_specs
from parkenv.studies.fields import AgentSpec
from parkenv.studies.fleet.day import Roads, gini, random_order_search_s
from parkenv.studies.fleet.setting import MEASURES, Setting
from parkenv.studies.fleet.study import FleetStudy
from parkenv.studies.fleet.tables import summarize_days


def experiment(**changes):
    (scenario,) = scenario_specs("mini")
    scenario = scenario.changed(arrivals={"hours": "08:00-09:00", "days": "weekdays"})
    fields = {"scenario": scenario, "arrivals_per_hour": (20.0,), "days": 2, **changes}
    return FleetStudy().changed(**fields)


def setting(agent, *rest):
    return Setting("mini", AgentSpec.of(agent), *rest)


def days_of(study):
    return [[study.run_day(one, day) for day in range(study.days)] for one in study.fleet_settings]


def test_gini():
    assert gini(np.array([2.0, 2.0, 2.0])) == gini(np.zeros(3)) == 0.0
    assert gini(np.array([1.0, 3.0])) == pytest.approx(0.25)
    exponential = np.random.default_rng(0).exponential(size=20_000)
    assert gini(exponential) == pytest.approx(0.5, abs=0.01)


def test_nobody_without_members_is_run_once():
    settings = experiment(knows=("own", "shared", "reserve"), shares=(0.0, 0.5, 1.0)).fleet_settings
    assert settings == [
        setting("greedy-drive", *rest, 20.0)
        for rest in (("own", 0.0), ("shared", 0.5), ("shared", 1.0), ("reserve", 0.5), ("reserve", 1.0))
    ]


def test_all_settings_have_the_same_days():
    study = experiment(arrivals_per_hour=(40.0,))
    plans, members = [], []
    for share in (0.3, 0.6):
        fleet, _ = study.fleet(setting("greedy-drive", "full", share, 40.0))
        fleet.reset(3, 1)
        plans.append(fleet.cars[["arrival", "entry", "stay_s", "patience_s"]].copy())
        members.append(fleet.cars["kind"] == 0)
    assert np.array_equal(*plans)
    assert (members[1] | ~members[0]).all(), "members stay members as their share grows"
    assert members[1].sum() > members[0].sum() > 0


def test_measures_of_a_day_are_those_of_its_cars():
    study = experiment(arrivals_per_hour=(60.0,), shares=(0.5,))
    chosen = setting("greedy-drive", "shared", 0.5, 60.0)
    day = study.run_day(chosen, 0)
    fleet, agents = study.fleet(chosen)
    fleet.reset(study.seed, 0)
    fleet.run(agents)
    cars = fleet.cars
    members = (cars["kind"] == 0).mean()
    assert day["cars"] == len(cars)
    assert day["total_s"] == pytest.approx(cars["total_s"].mean())
    assert day["total_s"] == pytest.approx(members * day["members_s"] + (1 - members) * day["others_s"])
    assert day["balked_fraction"] == (cars["slot"] < 0).mean() > 0.0, "60 cars for ten slots"
    assert 0.5 < day["occupancy"] <= 1.0
    assert 0.0 < day["cruising_share"] < 1.0
    assert day["cruised_m"] < day["driven_m"]
    assert day["bound_s"] <= day["clairvoyant_s"] < day["total_s"]
    assert day["search_s"] == pytest.approx((cars["drive_s"] + cars["failed_s"]).mean())
    roads, parked = Roads(fleet.scenario), cars[cars["slot"] >= 0]
    assert (cars["total_s"] >= roads.alone_s(fleet) - 1e-9).all()
    assert (parked["driven_m"] >= roads.direct_m(parked) - 1e-9).all()


def test_the_price_of_anarchy_is_the_ratio_to_reservations_for_all():
    study = experiment(knows=("own", "reserve"), arrivals_per_hour=(15.0, 30.0), days=3)
    days = days_of(study)
    rows = summarize_days(days)
    for row in rows:
        low, high = row["price_of_anarchy_ci95"]
        assert low <= row["price_of_anarchy"] <= high
        low_over, high_over = row["price_over_bound_ci95"]
        assert 1.0 < low_over <= row["price_over_bound"] <= high_over
        if row["knows"] == "reserve":
            assert (low, row["price_of_anarchy"], high) == (1.0, 1.0, 1.0)
    own, reserve = days[0], days[1]
    expected = sum(day["total_s"] * day["cars"] for day in own) / sum(
        day["total_s"] * day["cars"] for day in reserve
    )
    assert rows[0]["price_of_anarchy"] == pytest.approx(expected)
    assert set(MEASURES) - {"counted_occupancy"} <= rows[0].keys()
    assert rows[0]["difference_s"] == 0.0
    paired = [one["total_s"] - other["total_s"] for one, other in zip(reserve, own, strict=True)]
    assert rows[1]["difference_s"] == rows[1]["members_difference_s"] == pytest.approx(np.mean(paired))
    assert math.isnan(rows[1]["others_difference_s"])
    assert math.isnan(summarize_days(days[1:2])[0]["difference_s"])
    _, other = summarize_days([own, reserve[1:]])
    assert other["difference_s"] == pytest.approx(np.mean(paired[1:])), "of the days that both have"
    assert math.isnan(summarize_days(days[:1])[0]["price_of_anarchy"])


def test_the_closed_form_of_random_looks_ends_at_the_last_slot():
    problem = SearchProblem(lot=grid_lot(1, 20))
    one, all_but_none = random_order_search_s(problem, np.array([0.0, 1.0]))
    hop_s = 2.5 / problem.v_drive
    assert all_but_none - one == pytest.approx(20 * hop_s, rel=0.05)


def test_an_experiment_without_bounds_is_refused():
    with pytest.raises(InputError, match="40000000 days"):
        experiment(days=10_000, arrivals_per_hour=tuple(map(float, range(1, 1001))))


def test_cars_get_in_each_others_way_as_calibrated(tmp_path):
    crowded = experiment(arrivals_per_hour=(60.0,), knows=("own",), days=1)
    for name, value in (("manoeuvre_s", 12.0), ("sees_cars", True)):
        changed = crowded.changed(**{name: value})
        assert changed.settings() != crowded.settings()
        assert getattr(changed.fleet(changed.fleet_settings[0])[0].options, name) == value
    measured = Calibration("mini", 2.0, 15.0, 14.0, 40, 2.8)
    measured.to_file(tmp_path / "calibrated.json")
    calibrated = crowded.changed(calibrated=tmp_path / "calibrated.json")
    (built,) = calibrated.built.values()
    assert (built.v_drive, built.failure_s) == (2.0, 15.0)
    assert calibrated.blocked_s == 14.0
    assert calibrated.changed(manoeuvre_s=0.0).blocked_s == 0.0
    (day,), (queueing,) = days_of(crowded)[0], days_of(calibrated)[0]
    assert (day["queued_s"], queueing["cars"]) == (0.0, day["cars"])
    assert 0.0 < queueing["queued_s"] < queueing["search_s"]
    with pytest.raises(InputError, match="was measured on 'mini', the fleet drives on 'street'"):
        _ = calibrated.changed(scenario=scenario_specs("street")[0]).built


def test_an_agent_that_fails_is_named_and_earlier_days_are_kept(tmp_path):
    (tmp_path / "leaving.py").write_text(
        "class Failing:\n"
        "    calls = 0\n"
        "    def __init__(self, scenario): pass\n"
        "    def predict(self, observation, state=None, **_):\n"
        "        Failing.calls += 1\n"
        "        if Failing.calls > 100:\n"
        "            raise SystemExit(3)\n"
        "        return int(observation['action_mask'].nonzero()[0][-1]), state\n"
    )
    out = tmp_path / "out"
    words = ("--scenario", "mini", "--hours", "08:00-09:00", "--arrivals-per-hour", 3, "--knows", "own")
    words += ("-n", 30, "--jobs", 1, "--out", out)
    message = refused("fleet", "--agents", "leaving:Failing", *words, cwd=tmp_path)
    assert "SystemExit" in message
    assert "leaving:Failing, own, share 0, 3 cars an hour, day" in message
    assert FleetStudy.table.read(out)
