"""Scenarios: their files and errors; environments that change place, and trainings with held-out places."""

import itertools
import json
from functools import partial

import gymnasium as gym
import jsonschema
import numpy as np
import pytest
from command_line import ran, summary_of
from gymnasium.utils.env_checker import check_env
from small_lots import CAR_PARKS
from small_trainings import make_small, search_training
from stable_baselines3.common.env_checker import check_env as check_env_of_sb3

from parkenv import InputError, SensorModel, make_scenario, make_scenarios
from parkenv.cli.options import spec_of as changed_by
from parkenv.engine.records import FORECAST
from parkenv.envs.local_observation import LocalObservation
from parkenv.envs.search_vector import ParkSearchVectorEnv
from parkenv.files.known_names import SCENARIO_NAMES
from parkenv.lots import grid_lot, packaged_lot, write_lot
from parkenv.mapping.learned_map import LearnedMap
from parkenv.mapping.store import MapStore, Session
from parkenv.scenarios.selection import lot_share, scenario_of_episode, split_by_lot
from parkenv.scenarios.spec import ScenarioSpec, lot_scenario, scenario_spec, scenario_specs
from parkenv.studies.compare.comparison import Comparison
from parkenv.studies.study import schemas
from parkenv.studies.training.study import TrainingStudy
from parkenv.studies.training.training import Training, episode_times
from parkenv.world.occupancy.arrival_window import ArrivalWindow
from parkenv.world.occupancy.day_error import DayError, nearness
from parkenv.world.occupancy.process import Arrival, ConstantForecast
from parkenv.world.occupancy.real_week_figures import DAY_ERROR
from parkenv.world.occupancy.recorded import RecordedOccupancy
from parkenv.world.occupancy.typical_week import real_week_occupancy, typical_occupancy
from planners.model_file import LearnedAgent, ModelCard

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
    assert (made.name, made.lot.goals.tolist()) == ("mine", [[3.0, 20.0]])
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
    assert (env.unwrapped.scenario.failure_s, env.unwrapped.scenario.lot.n_slots) == (7.0, 12)
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
    kept = set(type(town).model_fields) - {"costs", "arrivals", "demand", "name"}
    assert all(getattr(its, name) == getattr(town, name) for name in kept)
    assert (its.title, its.costs.give_up_s, its.costs.prices["centre"]) == ("dear", town.costs.give_up_s, 3.0)
    assert its.arrivals == town.arrivals.changed(hours="09:00-10:00")
    shoppers = town.demand["shoppers"].changed(stay_s=60.0)
    assert its.demand == {**town.demand, "shoppers": shoppers}
    jsonschema.validate({"base": "town"}, schemas()["scenario"])


def test_logs_and_maps(tmp_path):
    looks = itertools.product((12, 13, 14), range(7, 20), (1, 2))
    lines = [f"2016-01-{day}T{hour:02d}:00,{slot},{(slot + hour) % 2}" for day, hour, slot in looks]
    (tmp_path / "log.csv").write_text("\n".join(["datetime,slot_id,occupied", *lines]))
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


def grids(n, seed):
    """Grids of slots with different numbers of rows and columns."""
    rng = np.random.default_rng(seed)
    rows, columns = rng.integers(2, 16, n), rng.integers(6, 34, n)
    return [grid_lot(int(r), int(c)) for r, c in zip(rows, columns, strict=True)]


LOTS = grids(6, seed=1)
PLACES = [
    make_scenario(lot, name=f"lot{i}", give_up_s=100.0 * (i + 1), day_error=0.5 * (i % 2))
    for i, lot in enumerate(LOTS)
]


@pytest.fixture
def folder(tmp_path):
    """A folder of lots, one of them with a scenario file."""
    for i, lot in enumerate(LOTS):
        write_lot(lot, tmp_path / f"lot{i}.geojson")
    (tmp_path / "busy.toml").write_text('lot = "lot2.geojson"\n[occupancy.typical]\ndemand = 1.0\n')
    (tmp_path / "notes.txt").write_text("not a lot")
    return tmp_path


def test_names_files_folders_and_sequences_of_them_are_scenarios(folder):
    in_folder = ["busy", "lot0", "lot1", "lot3", "lot4", "lot5"]
    assert [spec.title for spec in scenario_specs(folder)] == in_folder, "lot2 is that of a scenario"
    assert [one.name for one in make_scenarios(str(folder))] == in_folder
    several = ["mini", folder / "lot1.geojson", scenario_spec("jam"), PLACES[0], LOTS[1], folder]
    names = ["mini", "lot1", "jam", "lot0", "grid", *in_folder]
    assert [one.name for one in make_scenarios(several)] == names
    assert {one.failure_s for one in make_scenarios(several, failure_s=7.0)} == {7.0}
    # Experiment files and the command line say it in the same way.
    spec = Comparison.parse({"scenarios": ["mini", "."]}, "test", folder)
    assert [one.title for one in spec.scenarios] == ["mini", *in_folder]
    options = "--agents first-free -n 1 --jobs 1 --occupancy-levels none --no-figures --out"
    ran("compare", "--scenario", f"mini,{folder}", *options.split(), folder / "out")
    assert [row["scenario"] for row in summary_of(folder / "out")["rows"]] == ["mini", *in_folder]


def test_a_lot_alone_is_a_scenario_with_days(folder):
    made = make_scenario(folder / "lot3.geojson")
    assert made.occupancy.day_error == DayError(DAY_ERROR)
    usual = real_week_occupancy(made.lot)
    np.testing.assert_array_equal(made.occupancy.arrival_profile, usual.arrival_profile)
    assert not make_scenario(folder / "lot3.geojson", day_error=0.0).occupancy.day_error
    (folder / "lot3.geojson").rename(folder / "lot3.json")
    np.testing.assert_array_equal(make_scenario(folder / "lot3.json").lot.slot_xy, made.lot.slot_xy)
    assert lot_scenario(folder / "lot3.json").title == "lot3"
    write_lot(LOTS[0], folder / "Market, north.geojson")
    assert scenario_spec(folder / "Market, north.geojson").title == "Market  north"


@pytest.mark.parametrize("kind", ["goal", "entry"])
def test_a_lot_without_goal_or_entry_says_how_to_give_them(folder, kind):
    file = folder / "lot0.geojson"
    content = json.loads(file.read_text())
    content["features"] = [f for f in content["features"] if f["properties"]["kind"] != kind]
    file.write_text(json.dumps(content))
    for source in (file, folder, [file]):
        wanted = rf'^{file}: no {kind}: [^\n]*add one to the file: a Point with the properties {{"kind": "{kind}"}}$'
        with pytest.raises(InputError, match=wanted):
            gym.make("parkenv/Search-v2", scenario=source)


def test_what_is_no_scenario_is_refused_in_a_line(folder, tmp_path_factory):
    (folder / "bad.toml").write_text('lot = "lot0.geojson"\ngoal = -1\n')
    for source, message in (
        ("nowhere", "unknown scenario 'nowhere', and no such file"),
        ([], "scenario is an empty sequence"),
        (["mini", 3], "scenario is a int, want a Scenario"),
        (["mini", "none.geojson"], r"none\.geojson: lot\.file is 'none\.geojson', want a file; there"),
        (folder, r"bad\.toml: goal is -1, want the index"),
        (tmp_path_factory.mktemp("empty"), r"holds no scenario \(\.toml\) and no lot \(\.geojson\)"),
    ):
        with pytest.raises(InputError, match=message) as caught:
            make_scenarios(source)
        assert "\n" not in str(caught.value)
    with pytest.raises(InputError, match="holds 6 scenarios, want one"):
        scenario_spec("parkenv/lots/packaged")
    with pytest.raises(InputError, match="scenario has 6 scenarios, want one"):
        gym.make("parkenv/SearchSensors-v2", scenario=PLACES)


def places_of(env, seed, n=12, act=None):
    """Places of the first n episodes of a seed."""
    names = []
    for episode in range(n):
        _, info = env.reset(seed=seed if episode == 0 else None)
        names.append(PLACES[info["scenario_index"]].name)
        assert env.unwrapped.scenario.name == names[-1]
        if act is not None:
            *_, info = env.step(act)
            assert PLACES[info["scenario_index"]].name == names[-1]
    return names


def test_a_seed_decides_the_places_whatever_was_done_before():
    env = gym.make("parkenv/Search-v2", scenario=PLACES).unwrapped
    first = places_of(env, 3)
    assert set(first) == {one.name for one in PLACES} or len(set(first)) > 3
    assert first == [PLACES[scenario_of_episode(3, episode, 6)].name for episode in range(12)]
    places_of(env, 4, n=5, act=2)
    assert places_of(env, 3, act=1) == first
    assert places_of(env, 4) != first
    counts = np.bincount([scenario_of_episode(seed, 0, 6) for seed in range(6_000)])
    assert (np.abs(counts - 1_000) < 150).all(), "each place as often as the others"


def test_an_episode_is_that_of_its_place_alone():
    """Same world, rewards and observations, except for the padding."""
    noisy = make_scenario("mini", sensor_model=SensorModel(8.0, hit_rate=0.9, false_alarm_rate=0.2))
    make = partial(gym.make, "parkenv/Search-v2", max_episode_steps=40)
    env = make(scenario=[*PLACES[:4], noisy])
    envs = {place.name: make(scenario=place) for place in (*PLACES[:4], noisy)}
    met, rng = set(), np.random.default_rng(0)
    for seed in range(9):
        observation, info = env.reset(seed=seed)
        scenario = env.unwrapped.scenario
        alone = envs[scenario.name]
        expected, _ = alone.reset(seed=seed)
        met.add(info["scenario_index"])
        ended, n = False, scenario.lot.n_slots
        while not ended:
            assert env.observation_space.contains(observation)
            np.testing.assert_array_equal(env.unwrapped.action_masks(), observation["action_mask"] == 1)
            for name, value in expected.items():
                seen = observation[name]
                if name == "p_occupied":
                    assert (seen[n:] == 1.0).all()
                    seen = seen[:n]
                elif name == "belief":
                    parts = seen.reshape(4, -1)
                    assert (parts[:, n:] == [[1.0], [0.0], [1.0], [-1.0]]).all()
                    seen = parts[:, :n].ravel()
                np.testing.assert_array_equal(seen, value, err_msg=name)
            action = rng.choice(np.flatnonzero(observation["action_mask"]))
            observation, reward, terminated, truncated, info = env.step(action)
            expected, *others = alone.step(action)
            assert [reward, terminated, truncated, info | {"scenario_index": 0}] == others
            ended = terminated or truncated
        assert env.unwrapped.state.belief.p_occupied.shape == (n,)
    assert len(met) > 3


@pytest.mark.filterwarnings("error")
def test_checkers_accept_an_environment_that_changes_place():
    check_env(gym.make("parkenv/Search-v2", scenario=PLACES).unwrapped, skip_render_check=True)
    check_env_of_sb3(LocalObservation(gym.make("parkenv/Search-v2", scenario=PLACES)))


def test_a_state_of_another_place_is_refused():
    env, alone = (gym.make("parkenv/Search-v2", scenario=its).unwrapped for its in (PLACES, PLACES[0]))
    for each in (env, alone):
        each.reset(seed=0)
    with pytest.raises(InputError, match="state is of"):
        alone.set_state(env.get_state())


def test_a_batch_draws_a_place_at_each_automatic_reset():
    envs = ParkSearchVectorEnv(5, PLACES, observation="local", max_episode_steps=8, autoreset_mode="SameStep")
    _, info = envs.reset(seed=20)
    assert info["_scenario_index"].all()
    episode, rng = np.zeros(5, dtype=int), np.random.default_rng(0)
    for _ in range(60):
        places = envs.scenario_index
        drawn = [scenario_of_episode(20 + i, int(e), 6) for i, e in enumerate(episode)]
        assert places.tolist() == drawn
        observation, _, terminated, truncated, info = envs.step(rng.integers(0, 5, 5))
        assert envs.observation_space.contains(observation)
        done = terminated | truncated
        for i in np.flatnonzero(done):
            assert info["final_info"]["scenario_index"][i] == places[i], "that of the episode that has ended"
        episode += done
    assert episode.min() >= 6


def test_a_batch_can_be_kept_to_the_first_places():
    envs = ParkSearchVectorEnv(32, PLACES, observation="local", max_episode_steps=3)
    envs.n_scenarios = 2
    envs.reset(seed=0)
    assert set(envs.scenario_index) == {0, 1}
    envs.n_scenarios = 6
    assert set(envs.scenario_index) == {0, 1}, "from the next episodes on"
    for _ in range(4):
        envs.step(np.zeros(32, dtype=int))
    assert len(set(envs.scenario_index)) > 4
    for wrong in (0, 7, 1.5):
        with pytest.raises(InputError, match="n_scenarios is"):
            envs.n_scenarios = wrong


def test_tiny_lots_with_equal_tables_keep_their_own_forecasts():
    """Tables that are written to must not be shared."""
    tiny = grids(1, 0)[0]
    places = [make_scenario(tiny), make_scenario(tiny, occupancy=typical_occupancy(tiny, demand=-3.0))]
    envs = ParkSearchVectorEnv(40, places)
    observation, _ = envs.reset(seed=0)
    full = observation["p_occupied"].mean(axis=1)
    assert full[envs.scenario_index == 0].min() > full[envs.scenario_index == 1].max()


def test_the_split_is_by_lot_and_stable():
    packaged = make_scenarios(["campus", "street", "jam", "mini"])
    assert [round(lot_share(one.lot), 3) for one in packaged] == [0.475, 0.881, 0.292, 0.279]
    learned, held_out = split_by_lot(PLACES, 0.5)
    assert {*learned, *held_out} == set(PLACES)
    for further in (PLACES[1:], [*packaged, *PLACES[::-1]]):
        more = split_by_lot(further, 0.5)
        for one in further:
            if one in PLACES:
                assert (one in more[1]) == (one in held_out), "whatever other places there are"
    # Another scenario on a lot is the same place; the order of the slots does not matter.
    renamed = PLACES[0].replace(name="other", failure_s=3.0)
    assert lot_share(renamed.lot) == lot_share(PLACES[0].lot)
    for share, what in ((1e-9, "holds out none of 6"), (1.0 - 1e-9, "leaves none to train on of 6")):
        with pytest.raises(InputError, match=what):
            split_by_lot(PLACES, share)


def test_a_training_evaluates_on_scenarios_it_never_met(tmp_path, monkeypatch):
    make_small(monkeypatch)
    training = search_training("ppo", 2_048, 1_024, PLACES[:4], PLACES[4:], episodes=12)
    curve = training.train(0, tmp_path)
    card = ModelCard.of_file(tmp_path / "model.safetensors")
    assert (card.scenarios, card.held_out) == (("lot0", "lot1", "lot2", "lot3"), ("lot4", "lot5"))
    assert {"total_s", "held_out_s", "held_out_parked_fraction"} < set(curve[-1])
    best = min(curve, key=lambda row: row["total_s"])  # the places trained on decide which model is kept
    assert card.results["held_out_s"] == best["held_out_s"]
    # The mean over drawn places, each with its own give-up penalty, is that of the searches one by one.
    agent = LearnedAgent(PLACES[0], "ppo", tmp_path / "model.safetensors")
    seeds = range(2_000_000, 2_000_012)
    together, _ = episode_times(agent.model, PLACES, seeds)
    apart = [episode_times(agent.model, PLACES[scenario_of_episode(s, 0, 6)], [s])[0][0] for s in seeds]
    np.testing.assert_array_equal(together, apart)


def test_a_task_names_both_sides_and_keeps_them_apart(folder):
    specs = tuple(scenario_specs(folder))
    training = Training(TrainingStudy().changed(scenarios=specs, held_out=0.5))
    names = tuple({one.name for one in side} for side in training.sides)
    assert names[0] | names[1] == {spec.title for spec in specs}
    assert not names[0] & names[1]
    assert sorted(training.settings()["held_out"]) == sorted(names[1])
    assert [len(places) for places in training.tests.values()] == [len(side) for side in names]
    same = scenario_spec(folder / "busy.toml").changed(name="again")
    for others, message in (
        ((same,), "evaluate_on has 'again', whose lot is that of 'busy', which is trained on"),
        (specs[1:2], "scenarios has 'lot0' twice, want different names"),
    ):
        with pytest.raises(InputError, match=message):
            Training(TrainingStudy().changed(scenarios=specs, evaluate_on=others)).settings()
