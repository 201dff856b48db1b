"""The exact optimum of a parking search over belief states, for very small lots whose slots fill and empty.

The belief about a slot follows from its last observation and the time since then: p(t) = p∞ + (p(0) - p∞)·exp(-rt).
On a grid of times the belief states are

    (vertex of the car, and for each slot: never observed, or observed free or taken k steps ago),

and value iteration solves Bellman's equation for the least expected time from each. Costs are exact; the time since an
observation is rounded to whole steps, and ages of `memory_steps` and more are not distinguished.
"""

import numpy as np

from parkenv.compiled.jit import compiled
from parkenv.world.lot import PARK

TOLERANCE = 1e-4
MOST_SWEEPS = 20_000
STAY, PARK_HERE = 4, 5
WAIT = 5  # the action of waiting where the car is


class ChangingSolution:
    """The optimal search from every belief state; the sensor must not err.

    `values` are the least expected times, (n_vertices, n_codes) s, inf for states that cannot occur; `rate` is 1/s,
    arrivals plus departures; moves and waits take at least one step; `belief_error` bounds the error of P(free) for
    slots whose age is no longer distinguished, and `rounding_error` is the largest relative one of the time of a move.
    """

    def __init__(self, problem, p_occupied, rate, step_s, memory_steps):
        lot, n = problem.lot, problem.lot.n_slots
        assert problem.sensor_model.perfect
        self.problem, self.step_s, self.memory_steps = problem, step_s, memory_steps
        unknown = np.exp(-rate * (memory_steps - 1) * step_s).max()
        self.belief_error = unknown * max(p_occupied.max(), 1.0 - p_occupied.min())
        usual, decayed = 1.0 - p_occupied[:, None], np.exp(-rate[:, None] * np.arange(memory_steps) * step_s)
        # P(free) by code: never observed; free k steps ago; taken k steps ago.
        free = np.concatenate([usual, usual + (1.0 - usual) * decayed, usual * (1.0 - decayed)], axis=1)
        moves = np.concatenate([lot.neighbors, np.arange(lot.n_vertices)[:, None]], axis=1).astype(np.int64)
        moves[~(lot.neighbors < 0).any(axis=1), STAY] = -1
        wait_s = np.full((lot.n_vertices, 1), problem.wait_s)
        seconds = np.concatenate([problem.move_s, wait_s], axis=1)
        cost_s = np.concatenate([problem.move_cost_s, wait_s], axis=1)
        steps = np.maximum(np.rint(seconds / step_s), 1).astype(np.int64)
        made = moves >= 0
        self.rounding_error = float(np.abs(steps[made] * step_s / seconds[made] - 1.0).max())
        self.values = np.full((lot.n_vertices, (2 * memory_steps + 1) ** n), np.inf)
        self.choices = np.full(self.values.shape, -1, dtype=np.int8)
        ways = moves, cost_s, steps, *problem.slots_in_view
        ends = problem.arrival_cost_s, problem.give_up_s, memory_steps
        assert _iterate(self.values, self.choices, free, *ways, *ends) < MOST_SWEEPS, "not converged"

    def expected_s(self, vertex):
        return float(self.values[vertex, 0])

    def decide(self, vertex, belief):
        age = np.minimum(np.rint(belief.age / self.step_s), self.memory_steps - 1).astype(np.int64)
        codes = np.where(belief.observed, 1 + age + np.where(belief.observed_free, 0, self.memory_steps), 0)
        state = int((codes * (2 * self.memory_steps + 1) ** np.arange(len(codes))).sum())
        choice = int(self.choices[vertex, state])
        return {STAY: WAIT, PARK_HERE: PARK}.get(choice, choice)


@compiled
def _iterate(values, choices, free, moves, seconds, steps, starts, viewed, cost_s, give_up_s, memory_steps):
    n_vertices, n_states = values.shape
    n = len(free)
    n_codes = 2 * memory_steps + 1
    powers = np.ones(n, np.int64)
    for s in range(1, n):
        powers[s] = powers[s - 1] * n_codes
    codes, aged = np.empty(n, np.int64), np.empty(n, np.int64)
    sweep = 0
    while sweep < MOST_SWEEPS:
        worst = 0.0
        for v in range(n_vertices):
            for state in range(n_states):
                rest, all_taken, possible = state, True, True
                for s in range(n):
                    codes[s] = rest % n_codes
                    rest //= n_codes
                    all_taken = all_taken and codes[s] > memory_steps
                for i in range(starts[v], starts[v + 1]):
                    c = codes[viewed[i]]
                    # Slots in view were observed just now, except at the start of the search.
                    possible = possible and (state == 0 or c == 1 or c == 1 + memory_steps)
                if not possible:
                    continue
                before = values[v, state]
                if before == np.inf:
                    before = give_up_s
                    values[v, state] = give_up_s
                if all_taken:
                    continue
                best, choice = np.inf, -1
                if v < n and codes[v] == 1:
                    best, choice = cost_s[v], PARK_HERE
                for m in range(moves.shape[1]):
                    u = moves[v, m]
                    if u < 0:
                        continue
                    base = 0
                    for s in range(n):
                        c = codes[s]
                        if 1 <= c <= memory_steps:
                            c = min(c + steps[v, m], memory_steps)
                        elif c > memory_steps:
                            c = min(c + steps[v, m], 2 * memory_steps)
                        aged[s] = c
                        base += c * powers[s]
                    first, k = starts[u], starts[u + 1] - starts[u]
                    expected = seconds[v, m]
                    for outcome in range(1 << k):
                        chance, after = 1.0, base
                        for i in range(k):
                            s = viewed[first + i]
                            if (outcome >> i) & 1:
                                chance *= free[s, aged[s]]
                                after += (1 - aged[s]) * powers[s]
                            else:
                                chance *= 1.0 - free[s, aged[s]]
                                after += (1 + memory_steps - aged[s]) * powers[s]
                        follows = values[u, after]
                        expected += chance * (give_up_s if follows == np.inf else follows)
                    if expected < best:
                        best, choice = expected, m
                values[v, state], choices[v, state] = best, choice
                worst = max(worst, abs(best - before))
        sweep += 1
        if worst < TOLERANCE:
            break
    return sweep
