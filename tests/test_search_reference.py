"""The compiled search, alone and as a batch, against a plain reference; mixed lots, resets, ends, bad input."""

import dataclasses
from functools import cache

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from lot_checks import refusal
from search_reference import ReferenceSearch
from test_supply import FORBIDDEN, GARAGE, town

import parkenv  # noqa: F401 - registers the ids
from parkenv import InputError, OccupancyProcess, Scenario, SensorBand, SensorModel, make_scenario
from parkenv.envs.local_observation import LocalObservation
from parkenv.lots import city_lot, grid_lot
from parkenv.world.occupancy.arrival_window import ArrivalWindow
from parkenv.world.occupancy.day_error import DayError
from parkenv.world.occupancy.log import OccupancyLog
from parkenv.world.occupancy.process import Arrival, Forecast, PriorModel
from parkenv.world.occupancy.recorded import RecordedOccupancy

LIMIT = 40
N_SEARCHES = 3
BANDS = (SensorBand(5.0, True, 0.9, 0.95, 0.1), SensorBand(20.0, False, 0.5, 0.8, 0.3))
SENSORS = {
    "exact": SensorModel(9.0),
    "noisy": SensorModel(9.0, hit_rate=0.9, false_alarm_rate=0.2),
    "bands": SensorModel(12.0, bands=BANDS),
    "blind": SensorModel.blind(),
}


def random_log(rng, n_slots=5, n_days=10):
    """Weekdays in which slots change every few minutes."""
    days = [f"2015-11-{d:02d}" for d in range(2, 28) if d % 7 not in (0, 1)][:n_days]
    n, n_looks = n_slots * len(days), 120
    seconds = np.sort(rng.uniform(7 * 3600, 20 * 3600, (n, n_looks)), axis=1).ravel()
    slot = np.repeat(np.tile(np.arange(n_slots), len(days)), n_looks)
    day = np.repeat(np.arange(len(days)), n_slots * n_looks)
    ids = tuple(f"c{i}" for i in range(n_slots))
    return OccupancyLog(ids, tuple(days), slot, day, seconds, rng.random(len(slot)) < 0.7, 3600.0)


def random_process(rng, n):
    attraction, demand = rng.normal(0.5, 1.0, n), rng.normal(0.5, 1.0, 168)
    return OccupancyProcess.from_demand(attraction, demand, float(rng.choice([20.0, 300.0, 7200.0])))


def random_scenario(rng, kind, sensor):
    lot = grid_lot(int(rng.integers(1, 4)), int(rng.integers(2, 7)))
    if rng.random() < 0.5:
        costs = rng.uniform(0.0, 60.0, lot.n_slots)
        lot = dataclasses.replace(lot, slot_parking_cost_s=costs)
    process = random_process(rng, lot.n_slots)
    if kind == "days":
        process = process.with_day_error(DayError(*rng.uniform(0.0, 2.0, 2)), lot.walk_m())
    return Scenario(
        name="random",
        lot=lot,
        occupancy=RecordedOccupancy(random_log(rng), lot.walk_m()) if kind == "log" else process,
        # A forecast that is not the world's own.
        prior=random_process(rng, lot.n_slots) if rng.random() < 0.5 else None,
        arrival=ArrivalWindow((0, 1, 2, 3, 4), 9.9 * 3600.0, 10.1 * 3600.0),
        failure_s=float(rng.uniform(1.0, 90.0)),
        wait_s=float(rng.uniform(0.5, 3.0)),
        give_up_s=float(rng.uniform(100.0, 1000.0)),
        v_drive=float(rng.uniform(1.0, 5.0)),
        sensor_model=SENSORS[sensor],
    )


def assert_agrees(observation, wanted):
    assert observation["vertex"] == wanted["vertex"]
    np.testing.assert_array_equal(observation["action_mask"], wanted["action_mask"])
    for name in ("time", "p_occupied", "belief", "step_observed", "day_error"):
        np.testing.assert_allclose(observation[name], wanted[name], rtol=1e-6, atol=2e-7, err_msg=name)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("sensor", SENSORS)
@pytest.mark.parametrize("kind", ["process", "days", "log"])
def test_single_environment_and_batch_agree_with_the_reference(kind, sensor, seed):
    rng = np.random.default_rng([seed, len(sensor), len(kind)])
    scenario = random_scenario(rng, kind, sensor)
    options = {"scenario": scenario, "max_episode_steps": LIMIT}
    envs = gym.make_vec("parkenv/Search-v2", N_SEARCHES, vectorization_mode="vector_entry_point", **options)
    env = gym.make("parkenv/Search-v2", **options)
    batch, _ = envs.reset(seed=seed)
    observation, _ = env.reset(seed=seed)
    references = [ReferenceSearch(scenario, seed + e) for e in range(N_SEARCHES)]
    episode, n_steps, done = np.zeros(N_SEARCHES, int), np.zeros(N_SEARCHES, int), np.zeros(N_SEARCHES, bool)
    for _ in range(80):
        for e, reference in enumerate(references):
            wanted = reference.observation()
            assert_agrees({name: values[e] for name, values in batch.items()}, wanted)
        assert_agrees(observation, references[0].observation())
        masks = [reference.observation()["action_mask"] for reference in references]
        masks = [mask if rng.random() < 0.9 else np.ones(5) for mask in masks]
        actions = np.array([rng.choice(np.flatnonzero(mask)) for mask in masks])
        batch, rewards, terminated, truncated, infos = envs.step(actions)
        for e, reference in enumerate(references):
            if done[e]:  # a batch begins the next episode in the step after the end
                episode[e] += 1
                references[e] = ReferenceSearch(scenario, seed + e, int(episode[e]))
                assert (rewards[e], terminated[e], truncated[e]) == (0.0, False, False)
                n_steps[e], done[e] = 0, False
                if e == 0:
                    observation, _ = env.reset()
                continue
            terms = reference.step(int(actions[e]))
            n_steps[e] += 1
            assert rewards[e] == pytest.approx(sum(terms.values()), rel=1e-12)
            assert (terminated[e], truncated[e]) == (reference.over, n_steps[e] >= LIMIT)
            done[e] = terminated[e] or truncated[e]
            if done[e]:
                reported = {name: values[e] for name, values in infos.items() if name in reference.info()}
                assert reported == pytest.approx(reference.info(), rel=1e-12)
            if e == 0:
                observation, reward, *ends, info = env.step(actions[0])
                assert [reward, *ends] == [rewards[0], terminated[0], truncated[0]]
                parts = {name: info.pop(f"reward_{name}") for name in terms}
                assert parts == pytest.approx(terms, rel=1e-12)
                assert info.pop("scenario_index") == 0
                assert info == pytest.approx(reference.info(), rel=1e-12)
    assert episode.sum() >= 1


class Rumour(PriorModel):
    """A prior that is neither a process nor a log, and changes every hour."""

    def __init__(self, n_slots):
        self._n = n_slots

    @property
    def n_slots(self):
        return self._n

    def forecast(self, arrival: Arrival) -> Forecast:
        p = 0.1 + 0.8 * np.linspace(0, 1, self.n_slots) * (arrival.time % 3600) / 3600
        return Forecast(p, np.full(self.n_slots, 1 / 900), DayError(p[-1], 0.5 * p[-1]))


@cache
def recorded_scenario():
    lot = grid_lot(2, 8)
    occupancy = RecordedOccupancy(random_log(np.random.default_rng(0)), lot.walk_m(0))
    return Scenario(name="log", lot=lot, occupancy=occupancy, arrival=ArrivalWindow.parse("08:00-13:00"))


def make_batch(n, scenario, **options):
    return gym.make_vec("parkenv/Search-v2", n, "vector_entry_point", scenario=scenario, **options)


def assert_parity(scenarios, observation="full", n=4, steps=150, **changes):
    """Whole episodes, several in a row, of each search of a batch and of the single environment of its seed.

    Returns the names of the places of the episodes that ended.
    """
    options = {"max_episode_steps": LIMIT, **changes}
    envs = make_batch(n, scenarios, observation=observation, **options)
    singles = [gym.make("parkenv/Search-v2", scenario=scenarios, **options) for _ in range(n)]
    if observation == "local":
        singles = [LocalObservation(env) for env in singles]
    batch, _ = envs.reset(seed=7)
    alone = [env.reset(seed=7 + i)[0] for i, env in enumerate(singles)]
    rng = np.random.default_rng(0)
    done, episodes = np.zeros(n, dtype=bool), []
    for _ in range(steps):
        for i in range(n):
            for name, value in alone[i].items():
                np.testing.assert_array_equal(batch[name][i], value, err_msg=name)
        # Mostly valid actions, and sometimes invalid ones.
        masks = [o["action_mask"] if rng.random() < 0.9 else np.ones(5) for o in alone]
        actions = np.array([rng.choice(np.flatnonzero(mask)) for mask in masks])
        batch, rewards, terminated, truncated, info = envs.step(actions)
        terms = envs.reward_terms
        for i, env in enumerate(singles):
            if done[i]:
                alone[i], _ = env.reset()
                assert (rewards[i], terminated[i], truncated[i]) == (0.0, False, False)
                done[i] = False
                continue
            alone[i], reward, *ends, metrics = env.step(actions[i])
            assert (rewards[i], terminated[i], truncated[i]) == (reward, *ends)
            assert {name: values[i] for name, values in terms.items()} == {n: metrics[n] for n in terms}
            done[i] = any(ends)
            if done[i]:
                episodes.append(metrics["scenario_index"])
                for name, value in metrics.items():
                    assert info[f"_{name}"][i]
                    assert info[name][i] == value, name
    assert len(episodes) >= n
    return episodes


@pytest.mark.parametrize("observation", ["full", "local"])
def test_different_lots_in_one_batch(observation):
    mini = make_scenario("mini", sensor_model=SensorModel(8.0, hit_rate=0.9, false_alarm_rate=0.2))
    foretold = make_scenario("street").replace(prior=Rumour(make_scenario("street").lot.n_slots))
    garage = dataclasses.replace(GARAGE, known="live", capacity=3)
    ruled = make_scenario(town(facilities=(garage, town().facilities[1]), zone_rules=FORBIDDEN))
    places = [recorded_scenario(), mini, make_scenario("jam"), foretold]
    places += [ruled] if observation == "full" else []
    assert set(assert_parity(places, observation, n=8)) == set(range(len(places)))


def test_occupancy_is_the_full_observation_without_what_it_was_computed_from():
    full, lean = (make_batch(3, "mini", observation=name) for name in ("full", "occupancy"))
    assert set(full.observation_space) - set(lean.observation_space) == {"belief", "step_observed"}
    pairs = [(full.reset(seed=2)[0], lean.reset(seed=2)[0])]
    pairs += [tuple(envs.step(np.full(3, action))[0] for envs in (full, lean)) for action in (3, 1, 4, 2)]
    for more, less in pairs:
        assert lean.observation_space.contains(less)
        for name, value in less.items():
            np.testing.assert_array_equal(more[name], value)


def test_gymnasium_s_own_batch_of_single_environments_says_the_same():
    ours = make_batch(3, "mini", max_episode_steps=LIMIT)
    theirs = gym.make_vec("parkenv/Search-v2", 3, "sync", scenario="mini", max_episode_steps=LIMIT)
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    assert ours.single_observation_space == theirs.single_observation_space
    assert batch_space(ours.single_action_space, 3) == ours.action_space
    pairs = [(ours.reset(seed=1), theirs.reset(seed=1)), (ours.step([3, 3, 3]), theirs.step([3, 3, 3]))]
    for (observation, *results, _), (expected, *others, _) in pairs:
        assert ours.observation_space.contains(observation)
        values = [*(observation[name] for name in expected), *results]
        for value, wanted in zip(values, [*expected.values(), *others], strict=True):
            assert value.dtype == wanted.dtype


def test_disabled_wants_those_that_ended_to_be_reset():
    envs = make_batch(3, "mini", max_episode_steps=2, autoreset_mode="Disabled")
    envs.reset(seed=0)
    for _ in range(2):
        *_, terminated, truncated, _ = envs.step(np.full(3, 2))
    done = terminated | truncated
    assert done.all()
    with pytest.raises(gym.error.ResetNeeded, match="search 0 is over"):
        envs.step(np.zeros(3, dtype=int))
    observation, _ = envs.reset(options={"reset_mask": np.array([True, False, True])})
    assert observation["time"][0, 1] == observation["time"][2, 1] == 0.0
    assert observation["time"][1, 1] > 0.0
    with pytest.raises(gym.error.ResetNeeded, match="search 1 is over"):
        envs.step(np.zeros(3, dtype=int))


def test_seeds_sequences_of_them_and_generators_set_by_hand_decide():
    envs = make_batch(3, "mini")
    first, _ = envs.reset(seed=[9, 9, 4])
    np.testing.assert_array_equal(first["time"][0], first["time"][1])
    single = gym.make("parkenv/Search-v2", scenario="mini")
    single.reset(seed=4)
    np.testing.assert_array_equal(envs.reset()[0]["time"][2], single.reset()[0]["time"])
    kept, _ = envs.reset(seed=[None, 9, None])
    np.testing.assert_array_equal(kept["time"][1], first["time"][1])
    assert kept["time"][0, 0] != first["time"][0, 0]
    times = []
    for make in (
        lambda: make_batch(2, "mini"),
        lambda: gym.make("parkenv/Search-v2", scenario="mini").unwrapped,
    ):
        for k in (3, 3, 4):
            env = make()
            env.np_random = np.random.default_rng(k)
            times.append(env.reset()[0]["time"].tolist())
    assert times[0] == times[1] != times[2]
    assert times[3] == times[4] != times[5]


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP, AutoresetMode.DISABLED])
@pytest.mark.parametrize("kept", [0, 2])
def test_held_observations_stay_and_equal_those_that_are_overwritten(mode, kept):
    """Memory that the caller let go of is used again; views and slices count as held."""
    rng = np.random.default_rng(kept)
    copied, live = (
        make_batch(8, ["mini", grid_lot(3, 8)], copy=copy, autoreset_mode=mode, max_episode_steps=9)
        for copy in (True, False)
    )
    parts = {0: lambda o: o, 1: lambda o: {k: v[2:5] for k, v in o.items()}, 2: lambda o: dict(o)}
    held = []

    def check(ours, theirs):
        assert list(ours) == list(theirs)
        for name, value in theirs.items():
            np.testing.assert_array_equal(ours[name], value, err_msg=name)
        part = parts[int(rng.integers(3))]
        held.append((part(ours), {name: value.copy() for name, value in part(theirs).items()}))
        del held[: max(len(held) - kept, 0)]
        for mine, then in held:
            for name, value in then.items():
                np.testing.assert_array_equal(mine[name], value, err_msg=name)

    check(copied.reset(seed=1)[0], live.reset(seed=1)[0])
    done = np.zeros(8, dtype=bool)
    for _ in range(50):
        if mode is AutoresetMode.DISABLED and done.any():
            options = {"options": {"reset_mask": done}}
            check(copied.reset(**options)[0], live.reset(**options)[0])
        actions = rng.integers(0, 5, 8)
        ours, theirs = copied.step(actions), live.step(actions)
        check({**ours[0], "rewards": ours[1]}, {**theirs[0], "rewards": theirs[1]})
        done = ours[2] | ours[3]


def test_a_lot_of_thousands_of_slots_touches_only_what_is_near():
    envs = make_batch(2, make_scenario(city_lot(3_000)), observation="local")
    envs.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(50):
        envs.step(rng.integers(0, 4, 2))
    assert 0 < envs._searches.records["n_columns"].max() < 600


@pytest.mark.parametrize(
    ("options", "second"),
    [
        ({"scenario": "street", "entry": 1, "arrival": "Tue 08:30"}, 86400.0 + 8.5 * 3600.0),
        ({"scenario": 0, "arrival": 86400.0 + 8.5 * 3600}, 86400.0 + 8.5 * 3600.0),
        ({"scenario": "log", "arrival": "wed 09:05"}, 2 * 86400.0 + 9 * 3600.0 + 300.0),
        ({"scenario": "mini"}, None),
        ({}, None),
    ],
)
def test_the_caller_of_reset_may_choose_place_entry_and_time_alone_and_in_batches(options, second):
    two_entries = dataclasses.replace(grid_lot(2, 8), entries=np.array([[0.0, 0.0], [30.0, 0.0]]))
    street = Scenario(name="street", lot=two_entries, occupancy=make_scenario(two_entries).occupancy)
    places = [make_scenario("mini"), street, recorded_scenario()]
    env, envs = gym.make("parkenv/Search-v2", scenario=places).unwrapped, make_batch(3, places)
    batch, _ = envs.reset(seed=7, options=options)
    for i in range(3):
        observation, info = env.reset(seed=7 + i, options=options)
        if "scenario" in options:
            assert places[info["scenario_index"]].name in (options["scenario"], "mini")
        if second is not None:
            assert observation["time"][0] == pytest.approx(second, abs=0.1)
        if "entry" in options:
            assert env.state.vertex == two_entries.entry_vertices[1]
        for key, value in observation.items():
            np.testing.assert_array_equal(batch[key][i], value)
    env.reset(seed=7, options=options)
    later, plain = env.reset()[0], gym.make("parkenv/Search-v2", scenario=places)
    plain.reset(seed=7)
    np.testing.assert_array_equal(later["time"], plain.reset()[0]["time"], "the choice is for one episode")


def test_a_batch_draws_the_frames_of_its_single_environments():
    options = {"scenario": "mini", "render_mode": "rgb_array"}
    envs = gym.make_vec("parkenv/Search-v2", 2, vectorization_mode="vector_entry_point", **options)
    singles = [gym.make("parkenv/Search-v2", **options) for _ in range(2)]
    envs.reset(seed=3)
    for i, env in enumerate(singles):
        env.reset(seed=3 + i)
    for _ in range(4):
        envs.step(np.array([3, 3]))
        frames = envs.render()
        assert isinstance(frames, tuple)
        for frame, env in zip(frames, singles, strict=True):
            env.step(3)
            np.testing.assert_array_equal(frame, env.render())


def test_wrong_use_is_refused():
    envs = make_batch(2, "mini")
    with pytest.raises(InputError, match="option of reset is 'speed', want one of scenario, entry, arrival"):
        envs.reset(options={"speed": 1})
    assert "seed holds 3 numbers, want 2" in refusal(envs.reset, seed=[1, 2, 3])
    assert "leaves out" in refusal(envs.reset, options={"reset_mask": np.array([True, False])})
    envs.reset(seed=0)
    assert "reset_mask has shape" in refusal(envs.reset, options={"reset_mask": np.array([True])})
    for wrong in (np.zeros(3, dtype=int), np.zeros(2), np.zeros((2, 1), dtype=int)):
        assert "actions have shape" in refusal(envs.step, wrong)
    before = envs._searches.records.copy()
    for wrong in (5, -1):
        with pytest.raises(InputError, match=rf"actions\[1\] is {wrong}, want a number from 0 to 4"):
            envs.step(np.array([0, wrong]))
    np.testing.assert_array_equal(envs._searches.records, before, err_msg="a refused step changes nothing")
