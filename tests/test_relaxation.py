"""The lower bound by information relaxation: it is never above the optimum, and close to it."""

import dataclasses
import itertools

import numpy as np
import pytest
from small_lots import small_lot

from parkenv import compare, make_scenario
from parkenv.compiled.keyed_random import world_key
from parkenv.errors import InputError
from parkenv.lots import grid_lot
from parkenv.world.occupancy.process import Arrival, SlotLaw, World
from parkenv.world.scenario import SearchProblem
from parkenv.world.tariff import Zone
from planners.bounds.exact import ExactSolution
from planners.bounds.oracle import best_slot
from planners.bounds.relaxation import SearchBound
from planners.routes import DriveRoutes


class StillWorld(World):
    """Slots that stay as they are."""

    def __init__(self, taken, p_taken):
        self.taken = np.asarray(taken)
        none = np.zeros((2, len(self.taken)))
        self._law = SlotLaw(np.asarray(p_taken), none, none, 3600.0)

    def occupied(self, slots, time):
        return self.taken[slots]

    def next_free(self, slots, time):
        return np.where(self.taken[slots], np.inf, time)

    def sojourn(self, slots, time):
        return np.ones(np.size(slots), np.int64)

    def law(self):
        return self._law


SHAPES = ((1, 4), (2, 2), (2, 3), (1, 6), (3, 2), (1, 5))


def means(problem, p_taken, entry, most_states=4_000):
    """The optimum, the bound and the clairvoyant bound, over all worlds that there are."""
    routes, bound, mean, clairvoyant = DriveRoutes(problem), SearchBound(problem, most_states), 0.0, 0.0
    for taken in itertools.product((False, True), repeat=problem.lot.n_slots):
        world = StillWorld(taken, p_taken)
        chance = np.prod(np.where(taken, p_taken, 1.0 - p_taken))
        mean += chance * bound.of_world(world, entry, 0.0)
        best = best_slot(problem, routes, world, entry, 0.0).total_s
        clairvoyant += chance * min(best, problem.give_up_s)
    return ExactSolution(problem, p_taken, entry).expected_s, mean, clairvoyant


def test_it_is_never_above_the_optimum_and_far_closer_than_the_clairvoyant_bound():
    exact, bound, clairvoyant = np.array([means(*small_lot(seed, SHAPES)) for seed in range(12)]).T
    assert (bound <= exact + 1e-3).all()
    assert (exact - bound).mean() < 0.25 * (exact - clairvoyant).mean()


def test_coarser_groups_give_a_lower_bound_that_still_holds():
    problem, p_taken, entry = small_lot(4, SHAPES)
    exact, fine, clairvoyant = means(problem, p_taken, entry)
    _, coarse, _ = means(problem, p_taken, entry, most_states=1)
    assert coarse <= fine + 1e-3 <= exact + 2e-3
    assert coarse >= clairvoyant - 1e-3


def test_the_law_of_a_world_is_that_of_its_slots_on_its_day():
    scenario = make_scenario("campus")
    model, slots = scenario.occupancy, np.arange(scenario.lot.n_slots)
    arrival = Arrival(36_000.0 - 100.0)  # the hour ends on the way
    taken, after, stayed = [], [], []
    for seed in range(300):
        world = model.world(world_key(seed, 0), arrival)
        law = world.law()
        here = world.occupied(slots, arrival.time)
        taken.append((here - law.p_taken).mean())
        after.append((world.occupied(slots, arrival.time + 900.0) - law.p_taken_after(900.0)).mean())
        stays = law.stays(0.0, 900.0)
        stayed.append(((world.next_free(slots, arrival.time) > arrival.time + 900.0) - stays)[here].mean())
    for differences in (taken, after, stayed):
        assert abs(np.mean(differences)) < 4.0 * np.std(differences) / np.sqrt(len(differences))
        assert np.std(differences) < 0.06


def test_it_is_compared_with_agents_and_drives_no_car():
    run = compare(agents=["bound", "belief"], scenarios=["mini"], episodes=8, jobs=1, figures=False)
    rows = {row["agent"]: row for row in run.rows}
    assert rows["belief"]["gap_to_bound"] == rows["belief"]["total_s"] / rows["bound"]["total_s"] - 1.0
    assert rows["belief"]["leads"]
    assert not rows["bound"]["leads"]
    with pytest.raises(InputError, match="bound"):
        SearchBound(make_scenario("mini")).predict({})


def test_a_driver_who_may_park_nowhere_gives_up():
    rules = {"permits": Zone("permits", users=("permit-a",))}
    lot = dataclasses.replace(grid_lot(1, 4), slot_zone=np.full(4, "permits"), zone_rules=rules)
    problem = SearchProblem(lot=lot, give_up_s=600.0)
    assert SearchBound(problem).of_world(StillWorld([False] * 4, np.zeros(4)), 0, 0.0) == 600.0
