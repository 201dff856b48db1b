"""The optimum where slots change: closed forms, the static optimum as a limit, and searches in the environment."""

import numpy as np
import pytest
from exact_changing import WAIT, ChangingSolution
from expected_time import optimum_s

from parkenv import OccupancyProcess, Scenario, SensorModel
from parkenv.compiled.keyed_random import world_key
from parkenv.lots import grid_lot
from parkenv.studies.episodes import EpisodeRunner
from parkenv.studies.statistics import mean_interval
from parkenv.world.occupancy.process import Arrival
from parkenv.world.scenario import SearchProblem
from planners import make_agent
from planners.agent import SearchAgent
from planners.bounds.oracle import best_slot
from planners.bounds.relaxation import SearchBound
from planners.routes import DriveRoutes


class ChangingAgent(SearchAgent[None]):
    name = "exact-changing"

    def __init__(self, solution):
        super().__init__(solution.problem)
        self.solution = solution

    def begin(self, observation, belief):
        """Return no memory: the belief is the state."""

    def decide(self, observation, belief, memory):
        vertex = int(observation["vertex"])
        action = self.solution.decide(vertex, belief)
        return self.wait(vertex) if action == WAIT else action


def busy(n_slots=3, stay_s=20.0, taken=(0.7, 0.85, 0.8), give_up_s=600.0):
    p = np.array(taken)
    return Scenario(
        name="busy",
        lot=grid_lot(1, n_slots, pitch=6.0),
        occupancy=OccupancyProcess.from_demand(np.log(p / (1.0 - p)), np.zeros(168), stay_s),
        v_drive=3.0,
        wait_s=2.0,
        give_up_s=give_up_s,
        sensor_model=SensorModel(view_range=0.0),
        entry=0,
    )


def solved(scenario, stay_s, taken, memory_steps=12):
    p = np.array(taken)
    return ChangingSolution(scenario.public(), p, 1.0 / (stay_s * (1.0 - p)), 2.0, memory_steps)


def times(scenario, agent, searches):
    runner = EpisodeRunner(scenario, agent.name, agent)
    return np.array([runner.run(seed).row["total_s"] for seed in range(searches)])


def test_one_slot_is_one_look():
    """Observing it as taken proves that the lot is full: waiting gains nothing."""
    scenario = busy(1, taken=(0.8,), give_up_s=50.0)
    solution = solved(scenario, 20.0, (0.8,))
    entry = int(scenario.lot.entry_vertices[0])
    drive = float(scenario.move_s[entry][scenario.lot.neighbors[entry] >= 0].min())
    expected = drive + 0.2 * scenario.walk_s[0] + 0.8 * 50.0
    assert solution.expected_s(entry) == pytest.approx(expected, abs=0.01)


def test_slots_that_hardly_change_give_the_static_optimum():
    scenario = busy(give_up_s=60.0)
    p = np.array([0.7, 0.85, 0.8])
    entry = int(scenario.lot.entry_vertices[0])
    changing = ChangingSolution(scenario.public(), p, np.full(3, 1e-9), 2.0, 2)
    assert changing.expected_s(entry) == pytest.approx(optimum_s(scenario.public(), p, entry), abs=0.01)


def test_searches_take_as_long_as_it_says_and_belief_hardly_longer():
    taken = (0.7, 0.85, 0.8)
    scenario = busy(taken=taken)
    solution = solved(scenario, 20.0, taken)
    assert solution.rounding_error < 1e-6
    assert solution.belief_error < 0.05
    best = times(scenario, ChangingAgent(solution), 200)
    mean, low, high = mean_interval(best)
    assert low - 1.0 < solution.expected_s(int(scenario.lot.entry_vertices[0])) < high + 1.0
    belief = times(scenario, make_agent("belief", scenario), 200)
    assert belief.mean() - mean < 0.02 * mean
    # The thesis's planner also observes the last slot, which proves that the lot is full.
    thesis = times(scenario, make_agent("mdp-tuned", scenario), 60)
    assert thesis.mean() > 3.0 * mean


def test_the_relaxation_stays_below_it_where_slots_change():
    problem = SearchProblem(lot=grid_lot(1, 3), give_up_s=100.0)
    p_taken, entry = np.array([0.9, 0.7, 0.8]), int(problem.lot.entry_vertices[0])
    model = OccupancyProcess(p_taken * 0.002, np.ones(168), (1.0 - p_taken) * 0.002, np.ones(168))
    bound, routes = SearchBound(problem), DriveRoutes(problem)
    exact = ChangingSolution(problem, p_taken, np.full(3, 0.002), 1.0, 40).expected_s(entry)
    totals, clairvoyant = np.empty(1_000), np.empty(1_000)
    arrival = Arrival(36_000.0)
    for seed in range(1_000):
        world = model.world(world_key(seed, 0), arrival)
        totals[seed] = bound.of_world(world, entry, arrival.time)
        best = best_slot(problem, routes, world, entry, arrival.time).total_s
        clairvoyant[seed] = min(best, problem.give_up_s)
    error = 3.0 * np.std(totals) / np.sqrt(len(totals))
    assert clairvoyant.mean() - error <= totals.mean() <= exact + error
    assert exact - totals.mean() < 0.5 * (exact - clairvoyant.mean())
