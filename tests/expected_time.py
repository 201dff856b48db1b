"""The exact expected time of an agent's search in a world that does not change, over all possible observations."""

import copy
import itertools

import numpy as np

from parkenv.belief.slot_belief import SlotBelief
from parkenv.world.lot import PARK
from parkenv.world.occupancy.day_error import EXACT
from planners.bounds.exact import Days

MOST_STEPS = 2000  # decisions after which a search is truncated at a cost of `give_up_s`, as in comparisons


def expected_time(agent, problem, p_occupied, vertex, day_error=EXACT):
    """Return the mean total time, s, of an agent's search by the rules of `parkenv/Search-v2`.

    Given the day, each slot is taken with a probability of its own, independently of the others. Every possible history
    of observations is enumerated, so lots can have about a dozen slots, observed without error.
    """
    assert problem.sensor_model.perfect
    p = np.asarray(p_occupied, dtype=np.float64)
    days = Days.of(p, problem.walk_s, day_error)
    belief = SlotBelief.of_forecast(p, np.zeros(len(p)), (day_error.level, day_error.slope))
    return _Histories(agent, problem, days.p_free).mean(vertex, belief, days.chance, 0, None)


class _Histories:
    """The tree of all histories of observations; `day` is the probability of each day after a history."""

    def __init__(self, agent, problem, p_free):
        self.agent, self.problem, self.p_free = agent, problem, p_free
        self.masks = problem.action_masks

    def mean(self, vertex, belief, day, steps, memory):
        """Return the expected time, s, from here, after `steps` decisions."""
        problem, begun = self.problem, belief.time
        while True:
            if steps >= MOST_STEPS:
                return belief.time - begun + problem.give_up_s
            action, memory = self.agent.predict(observation(problem, vertex, belief), memory)
            chosen = int(action)
            steps += 1
            if chosen == PARK and vertex < problem.lot.n_slots:
                known = belief.observed[vertex]
                p_free = float(belief.observed_free[vertex]) if known else float(day @ self.p_free[vertex])
                parked_s = belief.time - begun + problem.arrival_cost_s[vertex]
                if p_free == 1.0:
                    return float(parked_s)
                failed = belief.decay(problem.failure_s).update([vertex], [True])
                then = day if known else day * (1.0 - self.p_free[vertex]) / (1.0 - p_free)
                failed_s = failed.time - begun + self.observe(vertex, failed, then, steps, memory)
                return float(p_free * parked_s + (1.0 - p_free) * failed_s)
            if not self.masks[vertex, chosen]:
                belief = belief.decay(problem.wait_s)
            else:
                belief = belief.decay(float(problem.move_s[vertex, chosen]))
                vertex = int(problem.lot.neighbors[vertex, chosen])
            if not belief.observed[problem.in_view(vertex)].all():
                return belief.time - begun + self.observe(vertex, belief, day, steps, memory)

    def observe(self, vertex, belief, day, steps, memory):
        """Return the expected time, s, from the moment of an observation at a vertex."""
        in_view = self.problem.in_view(vertex)
        new = in_view[~belief.observed[in_view]]
        total = 0.0
        for outcome in itertools.product((False, True), repeat=len(new)):
            taken = np.array(outcome, dtype=np.bool_)
            then = day * np.where(taken[:, None], 1.0 - self.p_free[new], self.p_free[new]).prod(axis=0)
            chance = float(then.sum())
            if chance == 0.0:
                continue
            after = belief.update(new, taken)
            if after.observed_taken.all():
                total += chance * self.problem.give_up_s
            else:
                total += chance * self.mean(vertex, after, then / chance, steps, copy.deepcopy(memory))
        return total


def observation(problem, vertex, belief):
    """Return what an agent is shown at a vertex with a belief."""
    return {
        "vertex": np.int64(vertex),
        "time": np.array([belief.time, belief.time], dtype=np.float32),
        "action_mask": problem.action_masks[vertex].copy(),
        **belief.to_observation(),
    }
