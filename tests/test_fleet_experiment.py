"""Experiments with many cars: settings, measures, summary; the same cars before and after; report and replay."""

import itertools
import math
import shutil

import numpy as np
import pytest
from command_line import ran, refused, rows_in, summary_of
from pictures import shows_color
from small_lots import driven, features
from stored_rows import change_rows
from test_report import data_of

from parkenv import InputError, ParkingLot, SearchProblem, make_scenario, open_run
from parkenv.cli.report import make_report
from parkenv.lots import grid_lot
from parkenv.lots.formats.geojson import write_lot
from parkenv.scenarios.calibration import Calibration
from parkenv.scenarios.spec import scenario_specs
from parkenv.show.figures.fleet import KNOWLEDGE_COLORS
from parkenv.studies.fields import AgentSpec
from parkenv.studies.fleet.day import Roads, gini, random_order_search_s
from parkenv.studies.fleet.day_replay import DRIVE, FAIL, QUEUE, choose_days, record_day
from parkenv.studies.fleet.setting import MEASURES, NOWHERE, Setting
from parkenv.studies.fleet.study import FleetStudy
from parkenv.studies.fleet.tables import CHANGES, summarize_changes, summarize_days
from parkenv.studies.results import without_nan
from parkenv.studies.statistics import mean_interval
from parkenv.studies.study import ExecutionSpec, ReportOptions

HOURS = {"arrivals": {"hours": "08:00-09:00"}, "occupancy": {"typical": {"demand": -0.8}}}
BEFORE = {"name": "before", "lot": "mini", **HOURS}
AFTER = {"name": "after", "lot": {"grid": {"rows": 2, "columns": 7}}, **HOURS}


def experiment(**changes):
    (scenario,) = scenario_specs("mini")
    scenario = scenario.changed(arrivals={"hours": "08:00-09:00", "days": "weekdays"})
    fields = {"scenario": scenario, "arrivals_per_hour": (20.0,), "days": 2, **changes}
    return FleetStudy().changed(**fields)


def setting(agent, *rest):
    return Setting("mini", AgentSpec.of(agent), *rest)


def days_of(study):
    return [[study.run_day(one, day) for day in range(study.days)] for one in study.fleet_settings]


def test_gini_and_the_search_by_random_looks_have_their_closed_forms():
    assert gini(np.array([2.0, 2.0, 2.0])) == gini(np.zeros(3)) == 0.0
    assert gini(np.array([1.0, 3.0])) == pytest.approx(0.25)
    assert gini(np.random.default_rng(0).exponential(size=20_000)) == pytest.approx(0.5, abs=0.01)
    problem = SearchProblem(lot=grid_lot(1, 20))
    one, all_but_none = random_order_search_s(problem, np.array([0.0, 1.0]))
    hop_s = 2.5 / problem.v_drive
    assert all_but_none - one == pytest.approx(20 * hop_s, rel=0.05)


def test_all_settings_have_the_same_days_and_nobody_without_members_is_run_once():
    settings = experiment(knows=("own", "shared", "reserve"), shares=(0.0, 0.5, 1.0)).fleet_settings
    assert settings == [
        setting("greedy-drive", *rest, 20.0)
        for rest in (("own", 0.0), ("shared", 0.5), ("shared", 1.0), ("reserve", 0.5), ("reserve", 1.0))
    ]
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
    days = days_of(experiment(knows=("own", "reserve"), arrivals_per_hour=(15.0, 30.0), days=3))
    rows = summarize_days(days)
    for row in rows:
        low, high = row["price_of_anarchy_ci95"]
        assert low <= row["price_of_anarchy"] <= high
        low_over, high_over = row["price_over_bound_ci95"]
        assert 1.0 < low_over <= row["price_over_bound"] <= high_over
        if row["knows"] == "reserve":
            assert (low, row["price_of_anarchy"], high) == (1.0, 1.0, 1.0)
    own, reserve = days[0], days[1]
    totals = [sum(day["total_s"] * day["cars"] for day in its) for its in days]
    assert rows[0]["price_of_anarchy"] == pytest.approx(totals[0] / totals[1])
    assert set(MEASURES) - {"counted_occupancy"} <= rows[0].keys()
    assert rows[0]["difference_s"] == 0.0
    paired = [one["total_s"] - other["total_s"] for one, other in zip(reserve, own, strict=True)]
    assert rows[1]["difference_s"] == rows[1]["members_difference_s"] == pytest.approx(np.mean(paired))
    assert math.isnan(rows[1]["others_difference_s"])
    assert math.isnan(summarize_days(days[1:2])[0]["difference_s"])
    _, other = summarize_days([own, reserve[1:]])
    assert other["difference_s"] == pytest.approx(np.mean(paired[1:])), "of the days that both have"
    assert math.isnan(summarize_days(days[:1])[0]["price_of_anarchy"])


def test_experiments_without_bounds_or_of_unequal_hours_are_refused():
    with pytest.raises(InputError, match="40000000 days"):
        experiment(days=10_000, arrivals_per_hour=tuple(map(float, range(1, 1001))))
    with pytest.raises(InputError, match=r"arrivals\.hours of 'after' are not those of 'before'"):
        study(BEFORE, AFTER | {"arrivals": {"hours": "09:00-10:00"}}).check()


def test_cars_get_in_each_others_way_as_calibrated(tmp_path):
    crowded = experiment(arrivals_per_hour=(60.0,), knows=("own",), days=1)
    for name, value in (("manoeuvre_s", 12.0), ("sees_cars", True)):
        changed = crowded.changed(**{name: value})
        assert changed.settings() != crowded.settings()
        assert getattr(changed.fleet(changed.fleet_settings[0])[0].options, name) == value
    Calibration("mini", 2.0, 15.0, 14.0, 40, 2.8).to_file(tmp_path / "calibrated.json")
    calibrated = crowded.changed(calibrated=tmp_path / "calibrated.json")
    (built,) = calibrated.built.values()
    assert (built.v_drive, built.failure_s) == (2.0, 15.0)
    assert (calibrated.blocked_s, calibrated.changed(manoeuvre_s=0.0).blocked_s) == (14.0, 0.0)
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


def study(*scenarios, **changes):
    fields = {"arrivals_per_hour": (12.0,), "days": 4, "knows": ("own", "reserve"), "shares": (0.5,)}
    return FleetStudy(figures=False).changed(scenarios=scenarios, **fields | changes)


@pytest.fixture(scope="module")
def days():
    both = study(BEFORE, AFTER)
    return dict(zip([(one.scenario, one.knows) for one in both.fleet_settings], days_of(both), strict=True))


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
    assert (row["before"], row["after"]) == ("own observations", "reservations for 50 %")


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


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    out = tmp_path_factory.mktemp("report") / "fleet"
    done = ran(
        "fleet", "--scenario", "mini", "--hours", "08:00-08:30", "--arrivals-per-hour", "20,40", "--share", "0.5,1",
        "--knows", "own,reserve", "-n", 2, "--jobs", 1, "--out", out, "--report",
    )  # fmt: skip
    assert (done.stderr, done.stdout.count("reserve ") >= 4) == ("", True)
    return out


def test_the_command_writes_rows_days_and_a_figure(run):
    assert (len(summary_of(run)["rows"]), len(rows_in(run / "days.csv"))) == (2 * 3, 2 * 2 * 3)
    assert shows_color(run / "fleet.png", KNOWLEDGE_COLORS["reserve"])
    assert [path.name for path in open_run(run).figures()] == ["fleet.png"]


def test_the_data_replay_the_days_of_the_run(run):
    data = data_of(run / "report.html")
    assert (data["run"]["title"], len(data["run"]["findings"])) == ("Many cars on mini", 1)
    assert len(data["fleets"]) == 8
    assert all(day["agrees"] for day in data["fleets"])
    names = ("arrivals_per_hour", "knows", "share")
    settings = [tuple(day[name] for name in names) for day in data["fleets"] if day["day"] == 0]
    kinds = (("own", 0), ("reserve", 0.5), ("reserve", 1))
    assert settings == [(a, *kind) for a in (20, 40) for kind in kinds]


def test_cars_drive_along_the_lanes_and_no_slot_holds_two(run):
    lot = make_scenario("mini").lot
    edges = {(v, int(t)) for v in range(lot.n_vertices) for t in lot.neighbors[v] if t >= 0}
    names = ("tracks", "arrival", "ended", "slot", "leaves")
    for day in data_of(run / "report.html")["fleets"]:
        occupied = [[] for _ in range(lot.n_slots)]
        for slot, leaves in zip(day["residents"][::2], day["residents"][1::2], strict=True):
            occupied[slot].append((0, leaves))
        for track, arrival, ended, slot, leaves in zip(*(day[name] for name in names), strict=True):
            assert arrival + sum(track[1::2]) == ended
            vertices = [track[0], *(code >> 2 for code in track[2::2])]
            for before, after, code in zip(vertices, vertices[1:], track[2::2], strict=False):
                kind = code & 3
                assert (before == after) == (kind != DRIVE)
                assert kind != DRIVE or (before, after) in edges
            if slot >= 0:
                assert vertices[-1] == slot
                occupied[slot].append((ended, leaves))
        for stays in occupied:
            stays.sort()
            assert all(one[1] <= two[0] for one, two in itertools.pairwise(stays))


def test_failed_attempts_and_queues_are_on_the_track():
    spec = FleetStudy().changed(
        scenario={"lot": "mini", "arrivals": {"hours": "08:00-08:30"}}, agents=["first-free"], knows=["own"],
        arrivals_per_hour=[120], days=1, manoeuvre_s=6.0,
    )  # fmt: skip
    ((setting, day),) = choose_days(spec, spec.fleet_settings, 1)
    fleet, agents = spec.fleet(setting)
    fleet.keep_steps()
    cars = driven(fleet, 0, 0, agents=agents).cars
    time_of = {kind: np.zeros(len(cars)) for kind in (FAIL, QUEUE)}
    for car, track in enumerate(record_day(spec, setting, day, {})["fleet"]["tracks"]):
        for elapsed, code in zip(track[1::2], track[2::2], strict=True):
            if code & 3 in time_of:
                time_of[code & 3][car] += elapsed / 100
    assert np.allclose(time_of[FAIL], cars["failed_s"], atol=0.1)
    assert np.allclose(time_of[QUEUE], cars["queued_s"], atol=0.5)
    assert cars["queued_s"].max() > 0.0
    assert len(fleet.steps) == (cars["n_steps"] - (cars["slot"] >= 0)).sum()
    assert (np.diff(fleet.steps["begin"]) >= 0.0).all()


def test_days_and_agents_can_be_chosen(run, tmp_path):
    page = tmp_path / "chosen.html"
    make_report(run, ExecutionSpec(jobs=1), ReportOptions(numbers=(1,), agents=("greedy-drive",)), out=page)
    assert [day["day"] for day in data_of(page)["fleets"]] == [1] * 6
    make_report(run, ExecutionSpec(jobs=1), ReportOptions(episodes=0), out=page)
    assert data_of(page)["fleets"] == []
    for options, message in (
        ({"numbers": (2,)}, "2; .* 0 to 1"),
        ({"agents": ("belief",)}, "'belief'; known: greedy-drive"),
    ):
        with pytest.raises(InputError, match=message):
            make_report(run, ExecutionSpec(jobs=1), ReportOptions(**options), out=page)


def test_a_day_that_differs_is_noted_and_days_with_too_many_cars_are_not_replayed(run, tmp_path, monkeypatch):
    copy = shutil.copytree(run, tmp_path / "copy")
    change_rows(copy, lambda row: "total_s" in row and row.update(total_s=1.0))
    done = ran("report", copy, "--episodes", 1, "--jobs", 1)
    assert "days.csv says 1.00 s" in " ".join(done.stdout.split())
    monkeypatch.setattr("parkenv.studies.fleet.day_replay.MOST_CARS", 15)
    make_report(run, ExecutionSpec(jobs=1), ReportOptions(episodes=1), out=tmp_path / "page.html")
    data = data_of(tmp_path / "page.html")
    assert {day["arrivals_per_hour"] for day in data["fleets"]} == {20.0}
    assert "40 cars an hour" in data["run"]["notes"][0]
