"""Scenario files: their scenarios, and errors of invalid files."""

import gymnasium as gym
import jsonschema
import numpy as np
import pytest
from lot_checks import refusal
from small_lots import CAR_PARKS

from parkenv import InputError, make_scenario
from parkenv.cli.options import spec_of as changed_by
from parkenv.engine.records import FORECAST
from parkenv.files.known_names import SCENARIO_NAMES
from parkenv.lots import grid_lot, packaged_lot, write_lot
from parkenv.mapping.learned_map import LearnedMap
from parkenv.mapping.store import MapStore, Session
from parkenv.scenarios.spec import ScenarioSpec, scenario_spec
from parkenv.studies.study import schemas
from parkenv.world.occupancy.arrival_window import ArrivalWindow
from parkenv.world.occupancy.day_error import DayError, nearness
from parkenv.world.occupancy.process import Arrival, ConstantForecast
from parkenv.world.occupancy.recorded import RecordedOccupancy
from parkenv.world.occupancy.typical_week import typical_occupancy

TUESDAY_NOON = Arrival(86_400.0 + 12 * 3600.0)


def written(folder, text, name="mine.toml"):
    file = folder / name
    file.write_text(text)
    return file


def test_packaged_scenarios_are_files_like_any_other():
    for name in SCENARIO_NAMES:
        assert make_scenario(name).name == name
    jam = make_scenario("jam")
    usual = typical_occupancy(packaged_lot("jam"), pull=1.0, demand=-0.3)
    ratio = jam.occupancy.arrival_factor / usual.arrival_factor
    assert set(np.round(ratio, 9)) == {1.0, 200.0}
    assert 0.7 < np.mean(ratio > 1.0) <= 0.75
    known = jam.forecast(TUESDAY_NOON).p_occupied
    assert np.array_equal(known, usual.forecast(TUESDAY_NOON).p_occupied)


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("day_error = 0.5", DayError(0.5)),
        ("day_error = 1", DayError(1.0)),
        ("day_error = { level = 0.5, slope = 0.25 }", DayError(0.5, 0.25)),
        ("day_error = { slope = 0.25 }", DayError(0.0, 0.25)),
        ("", DayError()),
    ],
)
def test_days_differ_from_their_forecast_by_what_the_file_says(tmp_path, text, wanted):
    made = make_scenario(written(tmp_path, f'lot = "street"\n[forecast]\nflat = 0.5\n[occupancy]\n{text}'))
    assert made.occupancy.day_error == made.forecast(TUESDAY_NOON).day_error == wanted
    if wanted.slope:
        np.testing.assert_array_equal(made.occupancy.nearness, nearness(made.walk_s))


def test_days_of_scenarios_can_be_changed():
    for name in CAR_PARKS:
        made = make_scenario(name)
        assert made.occupancy.day_error == made.forecast(TUESDAY_NOON).day_error == DayError(0.8)
        as_forecast = make_scenario(name, day_error=0.0)
        assert not as_forecast.occupancy.day_error
        assert not as_forecast.forecast(TUESDAY_NOON).day_error
        p = [scenario.forecast(TUESDAY_NOON).p_occupied for scenario in (made, as_forecast)]
        np.testing.assert_array_equal(*p)
    spec = scenario_spec("jam")
    assert changed_by(ScenarioSpec, {"--day-error": "0"}, spec).occupancy.day_error.level == 0.0
    changed = changed_by(ScenarioSpec, {"--day-error": "0.5,0.25"}, spec)
    assert changed.occupancy.day_error == DayError(0.5, 0.25)
    assert changed.occupancy.event == spec.occupancy.event
    for text in ("x", "1,2,3", "nan", "-1"):
        with pytest.raises(InputError, match=r"^--day-error is "):
            changed_by(ScenarioSpec, {"--day-error": text}, spec)


def test_a_file_says_it_all(tmp_path):
    write_lot(grid_lot(2, 6), tmp_path / "lot.geojson")
    typical_occupancy(grid_lot(3, 5)).to_file(tmp_path / "rates.json")
    file = written(
        tmp_path,
        """
        lot = "lot.geojson"
        goal = [3.0, 20.0]
        entry = 0
        occupancy = "rates.json"
        forecast = { flat = 0.25 }
        arrivals = { days = ["sat", "sun"], hours = "10:00-11:30" }
        speeds = { v_drive_kmh = 18, v_walk_kmh = 3.6 }
        costs = { failure_s = 90, wait_s = 2.0, give_up_s = 600 }
        sensor_model = { hit_rate = 0.9, false_alarm_rate = 0.1, view_range = 12 }
        traffic = { cars = 2 }
        """,
    )
    made = make_scenario(file)
    assert made.name == "mine"
    assert made.lot.goals.tolist() == [[3.0, 20.0]]
    assert made.occupancy.n_slots == made.lot.n_slots == 12, "rates of 15 slots, mapped to 12"
    assert isinstance(made.prior, ConstantForecast)
    assert set(made.forecast(TUESDAY_NOON).p_occupied) == {0.25}
    assert made.arrival.weekdays == (5, 6)
    assert made.arrival.end_s == 11.5 * 3600
    assert (made.v_drive, made.v_walk) == pytest.approx((5.0, 1.0))
    assert (made.failure_s, made.wait_s, made.give_up_s, made.entry) == (90.0, 2.0, 600.0, 0)
    assert (made.sensor_model.hit_rate, made.sensor_model.view_range) == (0.9, 12.0)
    assert made.traffic.cars == 2

    env = gym.make("parkenv/Search-v2", scenario=str(file), failure_s=7.0)
    observation, _ = env.reset(seed=3)
    assert (observation["belief"][FORECAST] == 0.25).all()
    assert env.unwrapped.scenario.failure_s == 7.0
    assert env.unwrapped.scenario.lot.n_slots == 12
    assert make_scenario(tmp_path / "lot.geojson").name == "lot", "a lot file alone"

    # What was read can be written and read again, from anywhere.
    scenario_spec(file).write(tmp_path / "copy.json")
    assert ScenarioSpec.read(tmp_path / "copy.json") == scenario_spec(file)


def test_a_base_has_what_a_file_leaves_out(tmp_path):
    path = tmp_path / "dear.toml"
    path.write_text(
        'base = "town"\ncosts = { prices = { centre = 3 } }\narrivals = { hours = "09:00-10:00" }\n'
        "[demand.shoppers]\nstay_s = 60"
    )
    its, town = ScenarioSpec.read(path), scenario_spec("town")
    changed = ("costs", "arrivals", "demand", "name")
    assert all(
        getattr(its, name) == getattr(town, name) for name in type(town).model_fields if name not in changed
    )
    assert (its.title, its.costs.give_up_s, its.costs.prices["centre"]) == ("dear", town.costs.give_up_s, 3.0)
    assert its.arrivals == town.arrivals.changed(hours="09:00-10:00")
    shoppers = town.demand["shoppers"].changed(stay_s=60.0)
    assert its.demand == {**town.demand, "shoppers": shoppers}
    jsonschema.validate({"base": "town"}, schemas()["scenario"])
    with pytest.raises(InputError, match="base is 'campsu', want"):
        ScenarioSpec.parse({"base": "campsu"}, "")


def test_logs_and_maps(tmp_path):
    lines = [f"2016-01-{day}_{hour:02d}.00,{slot},{(slot + hour) % 2}" for day in (12, 13, 14) for hour in range(7, 20)
             for slot in (1, 2)]  # fmt: skip
    (tmp_path / "log.csv").write_text(
        "datetime,slot_id,occupied\n" + "\n".join(lines).replace("_", "T").replace(".", ":")
    )
    mini = packaged_lot("mini")
    pairs = [f"{slot},{1 + i % 2}" for i, slot in enumerate(mini.slot_ids)]
    (tmp_path / "mapping.csv").write_text("slot_id,log_slot_id\n" + "\n".join(pairs))
    with MapStore(tmp_path / "map.sqlite", mini) as store:
        p_occupied = np.arange(10) % 2 * 0.98 + 0.01
        store.add(Session("k", 86_400.0, "laser", "sunny", p_occupied, np.zeros((0, 3))))
    text = 'lot = "mini"\nforecast = "map.sqlite"\noccupancy = { log = "log.csv", mapping = "mapping.csv" }'
    made = make_scenario(written(tmp_path, text))
    assert isinstance(made.occupancy, RecordedOccupancy)
    assert isinstance(made.prior, LearnedMap)
    assert made.forecast(TUESDAY_NOON).p_occupied.shape == (10,)
    (tmp_path / "later.csv").write_text((tmp_path / "log.csv").read_text().replace("2016-01-1", "2016-01-2"))
    for log in ("'log.csv,later.csv'", "['log.csv', 'later.csv']"):
        text = f'replay_from = 2016-01-22\nforecast_from = "rolling"\nlog = {log}'
        spec = scenario_spec(written(tmp_path, f'lot = "mini"\n[occupancy]\n{text}'))
        spec.write(tmp_path / "copy.json")
        assert ScenarioSpec.read(tmp_path / "copy.json") == spec
        occupancy = make_scenario(spec).occupancy
        assert occupancy.days_in(ArrivalWindow()) == ["2016-01-22"]
        assert occupancy.log.days[3:] == ("2016-01-22", "2016-01-23", "2016-01-24")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('lot = "mini"\n[costs]\nfailre_s = 5', "unknown key 'failre_s' in [costs]; did you mean 'failure_s'? known: "),
        ('lto = "mini"', "unknown key 'lto'; did you mean 'lot'? known: name, lot, goal"),
        ("goal = 0", "lot is missing"),
        ('lot = "nowhere.geojson"', "lot.file is 'nowhere.geojson', want a file; there is none at /"),
        ('lot = "campsu"', "lot is 'campsu', want a packaged lot (campus, jam, street, mini, town, kerbs) or a"),
        ('lot = { name = "mini", grid = { rows = 1, columns = 2 } }', "want exactly one of name, file, grid, city"),
        ('lot = "mini"\nspeeds = { v_walk_kmh = -4 }', "speeds.v_walk_kmh is -4, want a number of at least 0.1"),
        ('lot = "mini"\ncosts = { failure_s = nan }', "costs.failure_s is nan, want a finite number"),
        ("lot = { city = { slots = 1000000000 } }", "lot.city.slots is 1000000000, want a number of at most 1000000"),
        ('lot = "mini"\ngoal = 7', "goal is 7, want an index from 0 to 0"),
        ('lot = "mini"\ngoal = [1.0]', "goal is [1.0], want the index of one of the lot's goals, or a point [x, y]"),
        ('lot = "mini"\noccupancy = "busy"', "occupancy is 'busy', want typical, real-week, a process (.json)"),
        ('lot = "mini"\noccupancy = { mapping = "mine.toml" }', "want mapping only together with a log"),
        ('lot = "mini"\noccupancy = { replay_from = 2016 }', "occupancy.replay_from is 2016, want a date such as"),
        ('lot = "mini"\noccupancy = { day_error = -1 }', "occupancy.day_error.level is -1"),
        ('lot = "mini"\noccupancy = { log = "mine.toml", day_error = 1 }', "day_error only without a log or counts"),
        ('lot = "mini"\noccupancy = { log = "no.csv" }', "occupancy.log.0 is 'no.csv', want a file; there is none at"),
        ('lot = "mini"\nsensor_model = { hit_rate = 0.5 }', "want hit_rate and false_alarm_rate together"),
        ('lot = "mini"\nname = "a/b"', "name is 'a/b', want at most 80 printable characters without comma or slash"),
        ('lot = "mini', "not TOML: "),
    ],
)  # fmt: skip
def test_bad_files_are_refused_in_one_line(tmp_path, text, message):
    line = refusal(make_scenario, written(tmp_path, text))
    assert line.startswith(f"{tmp_path / 'mine.toml'}")
    assert message in line
