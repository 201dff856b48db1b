"""Curves: what searches are like as a function of occupancy, fitted over zones, held out, called and written."""

import dataclasses
import json

import numpy as np
import pytest
from command_line import ran, rows_in, summary_of
from small_lots import features

import parkenv
from parkenv import InputError, ParkingLot
from parkenv.engine.records import CAR
from parkenv.lots import grid_lot, write_lot
from parkenv.studies.curve.curves import (
    FORMS,
    OUTCOMES,
    Curves,
    Paths,
    Town,
    curve_table,
    fit_form,
    form_at,
    held_out_errors,
)
from parkenv.studies.curve.study import CurveStudy
from parkenv.studies.curve.zones import LONE, OF_CARS, STATE, Hours, Places, Zones, simulate_single_driver
from parkenv.studies.fleet.day import Roads

N_ZONES, N_HOURS, MULTIPLES, DAYS = 60, 4, (0.5, 1.0, 1.5, 2.0), 4
WORDS = ("--agents", "greedy-drive", "--arrivals-per-hour", "30,80", "--bootstraps", 2, "--reach", 15)


def search_law(occupancy, demand):
    return 10.0 + 40.0 * occupancy**3 * (1.0 + 4.0 * demand)


@pytest.fixture(scope="module")
def made():
    rng = np.random.default_rng(1)
    capacity, own = rng.uniform(50.0, 150.0, N_ZONES), rng.uniform(0.9, 1.1, N_ZONES)
    pull, by_hour = rng.uniform(0.2, 0.45, N_ZONES), np.array([0.6, 0.9, 1.1, 1.3])
    rows = []
    for multiple in MULTIPLES:
        occupancy = np.minimum(multiple * pull[:, None] * by_hour, 0.97)
        demand = multiple * rng.permutation(pull)[:, None] * by_hour[::-1]
        rows.append([])
        for _ in range(DAYS):
            zone, hour = np.divmod(np.arange(N_ZONES * N_HOURS), N_HOURS)
            cars = rng.poisson(60.0 * multiple, len(zone)) + 1
            search_s = cars * (search_law(occupancy, demand) * own[:, None]).ravel()
            search_s *= rng.gamma(400.0, 1.0 / 400.0, len(zone))
            index = {"zone": zone, "purpose": np.zeros_like(zone), "hour": hour}
            sums = dict(zip(OF_CARS, (cars, cars, np.zeros_like(cars), search_s, 80.0 * cars), strict=True))
            of_zones = occupancy, demand, occupancy.mean(axis=0), demand.mean(axis=0)
            state = dict(zip(STATE, of_zones, strict=True))
            rows[-1].append(index | sums | state | dict.fromkeys(LONE, cars))  # lone searches tell nothing
    spaces = np.stack([capacity, np.zeros(N_ZONES)], axis=1)
    names = tuple(map(str, range(N_ZONES)))
    zones = Zones(names, np.zeros((N_ZONES, 2)), *[np.ones(1)] * 2, spaces, spaces, 60.0)
    return Paths.of({"made": Town(zones, ("all",), rows)}, MULTIPLES, 8)


def test_zones_that_are_held_out_are_predicted_and_better_than_by_usual_forms(made):
    errors, points = held_out_errors(made, 0)
    (of,) = (row for row in errors if (row["held_out"], row["outcome"]) == ("zones", "search time, s"))
    assert of["curve"] < 0.1
    assert of["curve"] < 0.8 * min(of[form] for form in FORMS)
    assert len(points) == N_ZONES * N_HOURS * len(MULTIPLES)
    assert not [row for row in errors if row["outcome"] == "failed attempts"], "there were none"


def test_curves_grow_with_demand_and_their_intervals_hold_the_truth(made):
    table = curve_table(made, 4, 0)
    value, low, high = (table.columns[f"search_s{end}"] for end in ("", "_low", "_high"))
    assert (np.diff(value, axis=1) >= 0.0).all()
    assert (np.diff(table.columns["occupancy"], axis=1) >= 0.0).all()
    whole = (table.numbers[:, 1:] < 0).sum(axis=1) == 2  # one purpose: zones and hours added up
    assert whole.sum() == 1
    cars = made.sums["cars"].mean(axis=0)
    truth = (cars * search_law(made.features[..., 0], made.features[..., 1])).sum(axis=0) / cars.sum(axis=0)
    np.testing.assert_allclose(value[whole][0], truth, rtol=0.08)
    assert (low < value).mean() > 0.99
    assert (value < high).mean() > 0.99
    full = np.random.default_rng(0).uniform(size=(DAYS, N_ZONES * N_HOURS, 1)) > 0.05
    parked = np.where(full, 0.0, made.sums["cars"] // 2)
    table = curve_table(dataclasses.replace(made, sums={**made.sums, "parked": parked}), 2, 0)
    assert 0.9 < table.columns["balked_fraction"].max() < table.columns["balked_fraction_high"].max() <= 1.0


@pytest.mark.parametrize(
    ("form", "law"),
    [
        ("a/(1 - x)", lambda x: 7.0 / (1.0 - x)),
        ("t0 (1 + a x^b)", lambda x: 20.0 * (1.0 + 3.0 * x**4)),
        ("a exp(b x)", lambda x: 3.0 * np.exp(3.5 * x)),
    ],
)
def test_a_usual_form_finds_its_own_law(form, law):
    x = np.linspace(0.0, 0.95, 500)
    fit = fit_form(form, x, law(x), np.ones(500))
    np.testing.assert_allclose(form_at(form, fit, x), law(x), rtol=0.02)


@pytest.fixture(scope="module")
def district(tmp_path_factory):
    folder, plain = tmp_path_factory.mktemp("district"), grid_lot(rows=4, columns=15)
    (x0, y0), (x1, y1) = plain.slot_xy.min(axis=0), plain.slot_xy.max(axis=0)
    goals = [(x, y) for x in np.linspace(x0, x1, 3) for y in (y0 - 5.0, y1 + 5.0)]
    write_lot(ParkingLot(**features(plain) | {"goals": goals}), folder / "district.geojson")
    shoppers = {"arrivals_per_hour": 50, "stay_s": 1800, "patience_s": 400, "goals": [3, 1, 1, 1, 1, 0]}
    visitors = {"arrivals_per_hour": 20, "patience_s": 400, "goals": [1, 1, 1, 1, 1, 1]}
    spec = {"lot": "district.geojson", "arrivals": {"hours": "08:00-09:30"}}
    spec["demand"] = {"shoppers": shoppers, "visitors": visitors}
    (folder / "district.json").write_text(json.dumps(spec))
    return folder / "district.json"


def test_a_day_of_zones_has_all_cars_and_what_their_searches_take_beyond_the_direct_drive(district):
    study = CurveStudy.parse({"scenarios": [str(district)], "agents": ["greedy-drive"], "reach_m": 15.0}, "")
    setting = study.fleet_settings[-1]
    row = study.run_day(setting, 0)["zones.jsonl"]
    fleet, _ = study.fleet(setting)
    fleet.reset(study.seed, 0)
    fleet.run()
    parked = fleet.cars[fleet.cars["slot"] >= 0]
    beyond_s = parked["ended_at"] - parked["arrival"] - Roads(fleet.scenario).direct_s(parked)
    assert beyond_s.min() > -1e-6
    assert sum(row["cars"]) == len(fleet.cars)
    assert sum(row["parked"]) == len(parked)
    assert sum(row["search_s"]) == pytest.approx(beyond_s.sum(), abs=len(row["cars"]))
    places = np.bincount(row["zone"], row["cars"], 6)
    assert places.tolist() == np.bincount(fleet.cars["scenario_index"], minlength=6).tolist()
    demand = np.array(row["town_demand"]) * fleet.scenario.lot.n_slots * [1.0, 0.5]
    assert demand.sum() == pytest.approx(len(fleet.cars), rel=0.01), "the last hour is half of one"
    assert 0.0 < np.min(row["occupancy"]) < np.max(row["occupancy"]) <= 1.0


@pytest.mark.parametrize(
    ("believed", "expected"),
    [
        # First A: 10 s on foot and 10 s of drive; then B, 13 s on: 23 s, 11 s more than the 12 s
        # that the direct drive takes.
        ([0.0, 0.0], [0.5 + 0.5 * 0.8, 0.5 + 0.1, 0.5 * 3.0 + 0.4 * 11.0, 0.5 * 10.0 + 0.4 * 40.0]),
        # Whoever believes that A is full goes to B first, and then 8 s on to A.
        ([0.9, 0.0], [0.8 + 0.2 * 0.5, 0.2 + 0.1, 0.1 * (10.0 + 3.0), 0.8 * 40.0 + 0.1 * 10.0]),
    ],
)
def test_a_lone_search_goes_on_to_the_next_best_place_as_often_as_one_is_full(believed, expected):
    cars, first, place = np.zeros(1, CAR), np.zeros(1, np.int64), np.zeros(2, np.int64)
    cars["walks"], cars["patience_s"] = 1.0, 900.0
    hours = Hours(np.array([believed]), full=np.array([[0.5, 0.2]]), inside_s=np.array([[3.0, 0.0]]))
    entry_drive_s, drive_s = np.array([[10.0, 12.0]]), np.array([[0.0, 13.0], [8.0, 0.0]])
    places = Places(entry_drive_s, drive_s, np.array([[10.0, 40.0]]), np.zeros(2), place + 1, place)
    measures = simulate_single_driver(cars, first, first, np.zeros((1, 1)), (1.0, 1.0), hours, places)
    np.testing.assert_allclose(measures[:, 0], expected)


def test_curves_are_called_with_arrays_and_say_what_there_is_not():
    curve = {"occupancy": [0.2, 0.5, 0.8], "demand": [0.1, 0.2, 0.4]}
    curve |= {f"search_s{end}": [10.0 + k, 20.0 + k, 60.0 + k] for k, end in enumerate(("", "_low", "_high"))}
    curves = Curves({("town", zone, "all", hour): curve for zone in "ab" for hour in ("8", "9")})
    value = curves.search_s(occupancy=[[0.2], [0.65], [1.0]], zone=["a", "b"], hour=9).value
    assert value.shape == (3, 2)
    assert (value[0] == 10.0).all()
    assert value[2] == pytest.approx(60.0)
    assert 20.0 < value[1, 0] < 60.0
    assert curves.search_s(demand=0.4, zone="a", hour=8).high == pytest.approx(62.0)
    for outcome, words, named in (
        ("search_s", {"occupancy": 0.5, "zone": "c"}, "zone is 'c'"),
        ("search_s", {"zone": "a"}, "occupancy and demand"),
        ("search", {"occupancy": 0.5, "zone": "a"}, "outcome is 'search'"),
    ):
        with pytest.raises(InputError, match=named):
            curves.at(outcome, hour=8, **words)
    with pytest.raises(InputError, match="curves"):
        Curves({})


def test_the_command_writes_what_other_models_read(district, tmp_path):
    ran("curve", district, *WORDS, "-n", 2, "--jobs", 1, "--out", tmp_path / "a")
    assert (tmp_path / "a" / "curve.png").exists()
    summary = summary_of(tmp_path / "a")
    assert summary["zones"] == {"district": 6}
    for name, columns in {
        "activitysim.csv": "zone_id TERMINAL TERMINAL_AM",
        "matsim.csv": "onstreet_spots offstreet_spots alpha beta",
        "curve.csv": "zone purpose hour occupancy search_s search_s_low balked_fraction_high",
        "held_out.csv": "measured predicted",
    }.items():
        assert set(columns.split()) <= set(rows_in(tmp_path / "a" / name)[0]), name
    assert sum(int(row["onstreet_spots"]) for row in rows_in(tmp_path / "a" / "matsim.csv")) == 60
    errors, rows = CurveStudy.page(summary, tmp_path / "a").tables
    assert all(column["share"] for column in errors["columns"] if column["key"] in ("curve", *FORMS))
    assert "slots taken" in [column["label"] for column in rows["columns"]]
    curves = parkenv.load_curves(tmp_path / "a")
    curve = curves.curves["district", "0", "all", "8"]  # its own demand is 70 cars an hour
    (row,) = (row for row in rows_in(tmp_path / "a" / "activitysim.csv") if row["zone_id"] == "0")
    cost_min = (curve["search_s"][1] + curve["walk_s"][1]) / 60.0
    assert float(row["TERMINAL_AM"]) == pytest.approx(cost_min, abs=0.01)
    both = ["shoppers", "visitors"]
    value, low, high = curves.search_s(occupancy=[0.2, 0.9], zone="0", hour=8, purpose=both)
    assert (low <= value).all()
    assert (value <= high).all()
    assert set(OUTCOMES) <= set(next(iter(curves.curves.values())))
