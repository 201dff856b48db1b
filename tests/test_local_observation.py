"""The local observation: its values, on any lot."""

import gymnasium as gym
import networkx as nx
import numpy as np
import pytest

import parkenv  # noqa: F401 - registers the ids
from parkenv import OccupancyProcess, Scenario, SensorModel, make_scenario
from parkenv.engine.local_observation import FIRST_NEAR, HERE, PER_MOVE, PER_NEAR
from parkenv.envs.local_observation import LocalObservation
from parkenv.lots import grid_lot
from parkenv.world.lot import MOVES, PARK

K = 4


def squashed(seconds):
    return np.where(np.isfinite(seconds), seconds / (seconds + 60.0), 1.0)


def graph_of(scenario):
    graph = nx.DiGraph()
    for v, row in enumerate(scenario.lot.neighbors):
        for move, to in enumerate(row):
            if to >= 0:
                graph.add_edge(v, int(to), weight=float(scenario.move_s[v, move]))
    return graph


@pytest.mark.parametrize("name", ["mini", "street"])
def test_every_number_is_what_the_table_says(name):
    """Against networkx and the environment's own belief, at every step of a few drives."""
    scenario = make_scenario(name)
    lot, n = scenario.lot, scenario.lot.n_slots
    drive = dict(nx.all_pairs_dijkstra_path_length(graph_of(scenario)))
    env = LocalObservation(gym.make("parkenv/Search-v2", scenario=scenario), K)
    rng = np.random.default_rng(2)
    for seed in range(3):
        observation, _ = env.reset(seed=seed)
        before, first_looks = env.unwrapped.state.vertex, {}
        for _ in range(25):
            state, local = env.unwrapped.state, observation["local"]
            v, belief = state.vertex, state.belief
            free = 1.0 - belief.p_occupied
            here = v < n
            expected = [here, free[v] if here else 0.0, squashed(scenario.walk_s[v]) if here else 1.0]
            expected.append(squashed(state.time - state.arrival.time))
            for s in np.flatnonzero(belief.observed):
                first_looks.setdefault(int(s), float(free[s] > 1.0 - belief.forecast[s]))
            m = len(first_looks)
            expected.append(m / (m + 20))
            expected.append(np.mean(list(first_looks.values())) if m else 0.0)
            expected.append(np.mean(1.0 - belief.forecast[list(first_looks)]) if m else 0.0)
            np.testing.assert_allclose(local[:7], expected, atol=1e-6)

            reach = np.array([drive[v].get(s, np.inf) for s in range(n)])
            nearest = np.sort(reach)[:K]
            near = local[FIRST_NEAR:].reshape(K, PER_NEAR)
            np.testing.assert_allclose(near[:, 2], squashed(nearest), atol=1e-6)
            for row, seconds in zip(near, nearest, strict=True):
                # Ties may have any order and either route.
                tied = np.flatnonzero(np.isclose(reach, seconds))
                told = [[free[s], belief.observed[s], squashed(scenario.walk_s[s])] for s in tied]
                assert np.isclose(told, row[[0, 1, 3]], atol=1e-6).all(axis=1).any()
                assert row[4:].sum() == (seconds > 0.0)
            for move in range(len(MOVES)):
                block = local[HERE + PER_MOVE * move :][:PER_MOVE]
                to = lot.neighbors[v, move]
                assert block[0] == (to >= 0)
                if to < 0:
                    np.testing.assert_array_equal(block, [0, 1, 1, 0, 0, 1, 0, 1])
                    continue
                assert block[1] == pytest.approx(squashed(scenario.move_s[v, move]), abs=1e-6)
                best = min(drive[int(to)].get(s, np.inf) + scenario.walk_s[s] for s in range(n))
                assert block[2] == pytest.approx(squashed(scenario.move_s[v, move] + best), abs=1e-6)
                assert block[3] == (to == before and before != v)
                assert 0.0 <= block[4] <= 1.0
            moves = np.flatnonzero(observation["action_mask"][:PARK])
            observation, _, terminated, _, _ = env.step(rng.choice(moves))
            if env.unwrapped.state.vertex != v:
                before = v
            if terminated:
                break


def aisle(taken):
    """One aisle of slots that are always taken or always free."""
    lot = grid_lot(1, len(taken))
    process = OccupancyProcess.from_demand(np.where(taken, 25.0, -25.0), np.zeros(168), 1e9)
    return Scenario(name="aisle", lot=lot, occupancy=process)


def test_what_lies_ahead_is_told_move_by_move():
    """In an aisle that is full on one side and free on the other, the move features show the right direction."""
    taken = np.arange(12) >= 6
    scenario = aisle(taken)
    env = LocalObservation(gym.make("parkenv/Search-v2", scenario=scenario), K)
    observation, _ = env.reset(seed=0)
    lot = scenario.lot
    for _ in range(40):
        v = env.unwrapped.state.vertex
        for move in np.flatnonzero(observation["action_mask"][:PARK]):
            block = observation["local"][HERE + PER_MOVE * move :][:PER_MOVE]
            east = lot.vertex_xy[int(lot.neighbors[v, move]), 0] - lot.vertex_xy[v, 0]
            xs = lot.vertex_xy[:12, 0]
            ahead = np.flatnonzero((xs - lot.vertex_xy[v, 0]) * np.sign(east) > 1e-6)
            if len(ahead) >= K and len(set(taken[ahead])) == 1:
                # The forecast is certain to within a thousandth.
                assert block[4] == pytest.approx(0.0 if taken[ahead[0]] else 1.0, abs=0.01)
        observation, _, terminated, _, _ = env.step(np.flatnonzero(observation["action_mask"][:PARK])[-1])
        if terminated:
            break


def test_the_best_free_slot_is_remembered_until_it_is_seen_taken():
    scenario = make_scenario("street")
    env = LocalObservation(gym.make("parkenv/Search-v2", scenario=scenario), K)
    rng, remembered = np.random.default_rng(0), 0
    for seed in range(5):
        observation, _ = env.reset(seed=seed)
        np.testing.assert_array_equal(observation["local"][11:14], [0.0, 1.0, 1.0])
        for _ in range(40):
            observation, _, over, *_ = env.step(rng.choice(np.flatnonzero(observation["action_mask"][:PARK])))
            belief = env.unwrapped.state.belief
            free = belief.observed & (belief.p_occupied < belief.forecast)
            chance, walk, _ = observation["local"][11:14]
            if chance > 0.0:
                remembered += 1
                same = np.isclose(squashed(scenario.walk_s), walk, atol=1e-6)
                assert np.isclose(1.0 - belief.p_occupied[free & same], chance, atol=1e-6).any()
            if over:
                break
    assert remembered > 10


class Replay(gym.Env):
    """A search that was recorded, without its world."""

    def __init__(self, env, observations):
        self.observation_space, self.action_space = env.observation_space, env.action_space
        self.scenario = env.unwrapped.scenario.public()
        self.scenarios = (self.scenario,)
        self.observations = iter(observations)

    def reset(self, *, seed=None, options=None):
        return next(self.observations), {}

    def step(self, action):
        return next(self.observations), 0.0, False, False, {}


@pytest.mark.parametrize("sensor", [SensorModel(), SensorModel(8.0, hit_rate=0.9, false_alarm_rate=0.2)])
def test_it_is_computed_from_observations_alone(sensor):
    """A recorded search gives what a batch computes from the tables of its searches."""
    scenario = make_scenario("mini", sensor_model=sensor)
    env = gym.make("parkenv/Search-v2", scenario=scenario)
    options = {"scenario": scenario, "observation": "local", "k": K}
    batch = gym.make_vec("parkenv/Search-v2", 1, "vector_entry_point", **options)
    rng, over = np.random.default_rng(3), False
    recorded, local = [env.reset(seed=5)[0]], [batch.reset(seed=5)[0]["local"][0]]
    while not over and len(recorded) < 60:
        action = rng.choice(np.flatnonzero(recorded[-1]["action_mask"]))
        observation, _, over, *_ = env.step(action)
        recorded.append(observation)
        local.append(batch.step(np.array([action]))[0]["local"][0])
    replay = LocalObservation(Replay(env, recorded), K)
    replayed = [replay.reset()[0], *(replay.step(0)[0] for _ in recorded[1:])]
    np.testing.assert_array_equal([observation["local"] for observation in replayed], local)


def test_a_lot_smaller_than_k_is_told_of_as_far_as_it_goes():
    env = LocalObservation(gym.make("parkenv/Search-v2", scenario=aisle([False, True])), 6)
    observation, _ = env.reset(seed=0)
    near = observation["local"][FIRST_NEAR:].reshape(6, PER_NEAR)
    np.testing.assert_array_equal(near[2:], [[0, 0, 1, 1, 0, 0, 0, 0]] * 4)
    assert (near[:2, 2] < 1.0).all()


def test_wrong_use_is_refused():
    with pytest.raises(TypeError, match="wraps parkenv/Search-v2, not CartPoleEnv"):
        LocalObservation(gym.make("CartPole-v1"))
