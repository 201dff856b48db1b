"""The compiled search, alone and as a batch, agrees with the plain reference on random scenarios, seeds and actions."""

import dataclasses

import gymnasium as gym
import numpy as np
import pytest
from search_reference import ReferenceSearch

import parkenv  # noqa: F401 - registers the ids
from parkenv import OccupancyProcess, Scenario, SensorBand, SensorModel
from parkenv.lots import grid_lot
from parkenv.world.occupancy.arrival_window import ArrivalWindow
from parkenv.world.occupancy.day_error import DayError
from parkenv.world.occupancy.log import OccupancyLog
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
