"""In a world that does not change: the expected time of an agent's search, and the least one of any agent."""

import copy
import itertools
from functools import cache

import numpy as np

from parkenv.belief.slot_belief import SlotBelief
from parkenv.world.lot import PARK
from parkenv.world.occupancy.centred_logits import centred_logits
from parkenv.world.occupancy.day_error import EXACT, nearness

MOST_STEPS = 2000  # decisions after which a search is truncated at a cost of `give_up_s`, as in comparisons


def expected_time(agent, problem, p_occupied, vertex, day_error=EXACT):
    """Return the mean total time, s, of an agent's search by the rules of `parkenv/Search-v2`.

    Given the day, each slot is taken with a probability of its own, independently of the others. Every possible history
    of observations is enumerated, so lots can have about a dozen slots, observed without error.
    """
    assert problem.sensor_model.perfect
    p = np.asarray(p_occupied, dtype=np.float64)
    chance, p_free = days_of(problem, p, day_error)
    belief = SlotBelief.of_forecast(p, np.zeros(len(p)), (day_error.level, day_error.slope))
    return _Histories(agent, problem, p_free).mean(vertex, belief, chance, 0, None)


def days_of(problem, p_occupied, day_error):
    """Return the days of a forecast: the probability of each, (k,), and P(free) of each slot on each, (n_slots, k)."""
    near = nearness(problem.walk_s)
    levels, level_chance = _grid(day_error.level, 13)
    slopes, slope_chance = _grid(day_error.slope, 7)
    shift = (levels + near[:, None, None] * slopes[:, None]).reshape(len(near), -1)
    centre = centred_logits(p_occupied, day_error.deviations(near))[:, None]
    return np.outer(slope_chance, level_chance).ravel(), 1.0 / (1.0 + np.exp(centre + shift))


def _grid(deviation, count):
    if deviation == 0.0:
        return np.zeros(1), np.ones(1)
    z = np.linspace(-3.6, 3.6, count)
    density = np.exp(-0.5 * z**2)
    return deviation * z, density / density.sum()


def optimum_s(problem, p_occupied, vertex, day_error=EXACT):
    """Return the least expected time, s, of any agent, by dynamic programming over the belief states.

    A state is the vertex of the car, the slots observed and those observed free: they give the posterior of the day,
    and so P(free) of the other slots. The car drives to where it sees something new, or parks at a slot observed free.
    """
    lot, n = problem.lot, problem.lot.n_slots
    day_chance, p_free = days_of(problem, np.asarray(p_occupied, dtype=np.float64), day_error)
    view = [frozenset(problem.in_view(v).tolist()) for v in range(lot.n_vertices)]

    @cache
    def reach(start, seen):
        """Return the times, s, of drives from a vertex that show nothing new before their end."""
        seconds, done = {start: 0.0}, set()
        again = problem.wait_s if (lot.neighbors[start] < 0).any() else np.inf
        while rest := seconds.keys() - done:
            v = min(rest, key=seconds.get)
            done.add(v)
            if view[v] - seen and v != start:
                continue
            for u, move_s in zip(lot.neighbors[v].tolist(), problem.move_s[v].tolist(), strict=True):
                if u == start:
                    again = min(again, seconds[v] + move_s)
                elif u >= 0:
                    seconds[u] = min(seconds.get(u, np.inf), seconds[v] + move_s)
        if view[start] - seen:
            seconds[start] = again
        return seconds

    @cache
    def chance(seen, free):
        likelihood = np.ones_like(day_chance)
        for slot in seen:
            likelihood *= p_free[slot] if slot in free else 1.0 - p_free[slot]
        return float(day_chance @ likelihood)

    @cache
    def value(at, seen, free):
        if len(seen) == n and not free:
            return problem.give_up_s
        seconds = reach(at, seen)
        known = min((seconds[s] + problem.arrival_cost_s[s] for s in free if s in seconds), default=np.inf)
        best = known
        for v, drive_s in seconds.items():
            new = view[v] - seen
            if not new or drive_s >= known:
                continue
            total, after = drive_s, seen | new
            for outcome in itertools.product((True, False), repeat=len(new)):
                then = free | frozenset(itertools.compress(new, outcome))
                total += chance(after, then) / chance(seen, free) * value(v, after, then)
            best = min(best, total)
        return float(best)

    return value(vertex, frozenset(), frozenset())


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
        new, total = in_view[~belief.observed[in_view]], 0.0
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
