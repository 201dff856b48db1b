"""The planner that expects rivals: what it prefers, when it is `belief`, and how it is asked."""

import itertools
from functools import partial

import gymnasium as gym
import numpy as np
import pytest

from parkenv import InputError, OccupancyProcess, SensorModel, make_scenario
from parkenv.belief.day_belief import DayBelief
from parkenv.belief.slot_belief import SlotBelief
from parkenv.engine.fleet import DriverKind, Fleet
from parkenv.lots import grid_lot
from parkenv.scenarios.spec import scenario_specs
from parkenv.studies.fields import AgentSpec
from parkenv.studies.fleet.setting import Setting
from parkenv.studies.fleet.study import FleetStudy
from parkenv.world.demand import ConstantTime, Demand, ListedArrivals
from parkenv.world.lot import PARK
from planners import make_agent


def actions(agent, scenario, seed):
    env = gym.make("parkenv/Search-v2", scenario=scenario)
    observation, _ = env.reset(seed=seed)
    chosen, memory, over = [], None, False
    while not over:
        action, memory = agent.predict(observation, memory)
        chosen.append(int(action))
        observation, _, terminated, truncated, _ = env.step(action)
        over = terminated or truncated
    return chosen


def test_without_rivals_it_is_belief_and_equal_seeds_give_equal_actions_in_batches_too():
    scenario = make_scenario("mini")
    belief, nobody = (
        make_agent("belief", scenario),
        make_agent("belief-rivals", scenario, arrivals_per_hour=0),
    )
    for seed in range(3):
        assert actions(belief, scenario, seed) == actions(nobody, scenario, seed)
    agent = make_agent("belief-rivals", scenario)
    assert actions(agent, scenario, 3) == actions(make_agent("belief-rivals", scenario), scenario, 3)
    observations = [gym.make("parkenv/Search-v2", scenario=scenario).reset(seed=seed)[0] for seed in range(4)]
    batch = {name: np.stack([one[name] for one in observations]) for name in observations[0]}
    together, _ = agent.predict(batch)
    assert together.tolist() == [int(agent.predict(one)[0]) for one in observations]


def in_view_of_a_free_slot(scenario):
    """A car beside a free slot; nearer to the goal, another one was seen free."""
    walk_s, lot = scenario.walk_s, scenario.lot
    drive = scenario.move_s
    for vertex in np.argsort(-walk_s):
        for move in range(4):
            ahead = lot.neighbors[vertex, move]
            if 0 <= ahead < lot.n_slots and walk_s[ahead] + drive[vertex, move] < walk_s[vertex] - 1.2:
                return int(vertex), int(ahead)
    raise AssertionError("no such pair")


def test_where_slots_vanish_it_prefers_the_free_slot_at_hand_to_a_better_one_further_on():
    scenario = make_scenario("campus")
    here, better = in_view_of_a_free_slot(scenario)
    n = scenario.lot.n_slots
    belief = SlotBelief.of_forecast(np.full(n, 0.7), np.full(n, 1e-3))
    belief = belief.update([here, better], [False, False])
    observation = {
        "vertex": np.int64(here), "time": np.array([8 * 3600.0, 0.0]), "action_mask": np.ones(5, np.int8),
        **belief.to_observation(),
    }  # fmt: skip
    calm, _ = make_agent("belief", scenario).predict(observation)
    crowded, _ = make_agent("belief-rivals", scenario, arrivals_per_hour=20_000).predict(observation)
    assert calm != PARK
    assert crowded == PARK
    cars = np.zeros((2, scenario.lot.n_vertices), np.int8)
    for in_view in (0, 100):
        cars[0, here] = in_view
        learned, _ = make_agent("belief-rivals", scenario).predict({**observation, "cars": cars})
        assert (learned == PARK) == (in_view > 0), "whoever meets many cars reckons with many"


def test_rivals_take_the_best_slots_whatever_is_observed_of_one():
    n = 40
    belief = SlotBelief.of_forecast(np.full(n, 0.6), np.full(n, 1e-3))
    near = np.linspace(1.0, -1.0, n)
    rates = np.zeros(n)
    rates[:10] = 0.05
    calm = DayBelief(belief, near)
    crowd = DayBelief(belief, near, rival_rates=rates)
    for seen_taken in (False, True):
        belief = belief.update([0], [seen_taken])
        for day in (calm, crowd):
            day.update(belief.observations)
        belief = belief.decay(2.0)
    assert crowd.p_occupied(belief.time)[5] > calm.p_occupied(belief.time)[5] + 0.05
    assert crowd.p_occupied(belief.time)[5] > crowd.p_occupied(belief.time)[20], (
        "the best slots are the rivals'"
    )


def test_drivers_who_know_the_same_make_tours_of_their_own():
    scenario = make_scenario("campus")
    observation, _ = gym.make("parkenv/Search-v2", scenario=scenario).reset(seed=1)
    tours = {}
    for name in ("belief", "belief-rivals"):
        agent, tours[name] = make_agent(name, scenario), set()
        for later_s in range(8):
            driver = {**observation, "time": observation["time"] + np.array([later_s, 0.0], np.float32)}
            action, memory = agent.predict(driver)
            tours[name].add(agent.plan_preview(driver, int(action), memory))
    assert len(tours["belief"]) == 1
    assert len(tours["belief-rivals"]) >= 4


def test_wrong_rates_are_refused():
    for rate in (-1.0, np.inf, np.nan):
        with pytest.raises(InputError, match="arrivals_per_hour is"):
            make_agent("belief-rivals", make_scenario("mini"), arrivals_per_hour=rate)


def test_an_experiment_tells_it_the_demand():
    (scenario,) = scenario_specs("mini")
    study = FleetStudy().changed(scenario=scenario)
    for name, rate in (("belief-rivals", 120.0), ("belief-rivals(arrivals_per_hour=30)", 30.0)):
        _, (agent, _) = study.fleet(Setting("mini", AgentSpec.of(name), "own", 0.0, 120.0))
        assert agent.arrivals_per_hour == rate
    sighted = study.changed(sees_cars=True)
    _, (agent, _) = sighted.fleet(Setting("mini", AgentSpec.of("belief-rivals"), "own", 0.0, 120.0))
    assert agent.arrivals_per_hour is None, "it counts the cars that it meets"


LOT = grid_lot(1, 3, pitch=12.0)


class FromSlot:
    def __init__(self, first, world):
        del world
        self.first = first

    def predict(self, observation, state=None):
        last = -1 if state is None else state
        vertex = int(observation["vertex"])
        known = SlotBelief.of_observation(observation)
        if vertex < 3 and known.observed_free[vertex] and (vertex >= self.first or last == 3):
            return PARK, last
        (ahead,) = np.flatnonzero(LOT.neighbors[vertex] >= 0)[:1]
        return int(ahead), 3 if vertex == 2 else last


def scenario(p_taken, taken, v_walk):
    occupancy = OccupancyProcess.from_demand(np.where(taken, 25.0, -25.0), np.zeros(168), 1e9)
    logit = np.log(p_taken / (1.0 - p_taken))
    prior = OccupancyProcess.from_demand(np.full(3, logit), np.zeros(168), 600.0)
    blind = SensorModel(view_range=0.0)
    return make_scenario(
        LOT, occupancy=occupancy, prior=prior, sensor_model=blind, v_walk=v_walk, give_up_s=120.0
    )


def costs(p_taken, v_walk, drivers):
    total_s = np.zeros((len(drivers), len(drivers), 2))
    arrivals = ListedArrivals((8 * 3600.0, 8 * 3600.0 + 2.0))
    demand = Demand(arrivals, ConstantTime(3600.0), ConstantTime(120.0))
    for taken in itertools.product((False, True), repeat=3):
        world = scenario(p_taken, np.array(taken), v_walk)
        p = np.where(taken, p_taken, 1.0 - p_taken).prod()
        kinds = [DriverKind(), DriverKind()]
        for i, first in enumerate(drivers):
            for j, second in enumerate(drivers):
                fleet = Fleet(world, demand, drivers=kinds, background="process", leave_full_lot=False)
                fleet.reset(0)
                agents, memory = [make(world) for make in (first, second)], [None, None]
                while (car := fleet.next_decision()) is not None:
                    action, memory[car] = agents[car].predict(fleet.observation(car), memory[car])
                    fleet.act(action)
                total_s[i, j] += p * fleet.cars["total_s"]
    return total_s


def equilibria(total_s):
    first, second = total_s[..., 0], total_s[..., 1]
    least = (first <= first.min(axis=0) + 1e-9) & (second <= second.min(axis=1, keepdims=True) + 1e-9)
    return [tuple(pair) for pair in np.argwhere(least)]


def ours(world):
    return make_agent("belief-rivals", world, arrivals_per_hour=20)


@pytest.mark.parametrize(("p_taken", "v_walk"), [(0.5, 1.1), (0.3, 0.3), (0.1, 0.3)])
def test_two_of_it_need_no_longer_than_in_equilibrium_and_the_second_cannot_gain(p_taken, v_walk):
    total_s = costs(p_taken, v_walk, [*(partial(FromSlot, k) for k in range(3)), ours])
    exact = equilibria(total_s[:3, :3])
    assert exact
    assert total_s[3, 3].mean() < 1.01 * min(total_s[pair].mean() for pair in exact)
    first, second = total_s[3, 3]
    assert second < total_s[3, :3, 1].min() + 1.0
    # It reckons with more rivals than the one behind it, so in front it may stop too early.
    assert first < total_s[:3, 3, 0].min() + 25.0
