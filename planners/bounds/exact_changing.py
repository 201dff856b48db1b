"""The exact optimum of a parking search over belief states, for very small lots whose slots fill and empty.

The belief about a slot follows from its last observation and the time since then: p(t) = p∞ + (p(0) - p∞)·exp(-rt).
On a grid of times the belief states are

    (vertex of the car, and for each slot: never observed, or observed free or taken k steps ago),

and value iteration solves Bellman's equation for the least expected time from each. Costs are exact; the time since an
observation is rounded to whole steps, and ages of `memory_steps` and more are not distinguished.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from parkenv.belief.slot_belief import SlotBelief
from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.compiled.jit import compiled
from parkenv.errors import InputError
from parkenv.world.lot import PARK
from parkenv.world.scenario import SearchProblem

MOST_STATES = 20_000_000  # maximum number of belief states: 180 MB
_TOLERANCE = 1e-4
_MOST_SWEEPS = 20_000
_STAY, _PARK = 4, 5
WAIT = 5  # the action of waiting where the car is


class ChangingSolution:
    """The optimal search from every belief state.

    Args:
        problem: lot, goal, speeds and costs; the sensor must not err.
        p_occupied: (n_slots,) constant probability that each slot is taken.
        rate: (n_slots,) 1/s, arrival rate plus departure rate.
        step_s: s, step of the time grid; times of moves and waits are rounded to at least one step.
        memory_steps: number of ages that are distinguished.

    Attributes:
        values: (n_vertices, n_codes) float64, s, the least expected time; inf for states that cannot occur.
        belief_error: bound on the error of P(free) for slots whose age is no longer distinguished.
        rounding_error: largest relative error of the time of a move.

    Raises:
        InputError: a sensor that errs, a value out of range, or too many states.

    Example:
        Where cars leave more often, the same slots, equally often taken, are found sooner.

        >>> from parkenv.lots import grid_lot
        >>> problem = SearchProblem(lot=grid_lot(1, 2), give_up_s=600.0)
        >>> entry, p = int(problem.lot.entry_vertices[0]), np.full(2, 0.8)
        >>> slow, quick = (ChangingSolution(problem, p, np.full(2, r), 1.0, 12) for r in (1e-3, 1e-1))
        >>> quick.expected_s(entry) < slow.expected_s(entry)
        True
    """

    def __init__(
        self, problem: SearchProblem, p_occupied: ArrayLike, rate: ArrayLike, step_s: float, memory_steps: int
    ) -> None:
        lot, n = problem.lot, problem.lot.n_slots
        p, r = np.asarray(p_occupied, dtype=np.float64), np.asarray(rate, dtype=np.float64)
        if p.shape != (n,) or not ((p > 0.0) & (p < 1.0)).all():
            raise InputError(f"p_occupied has shape {p.shape}, want {n} probabilities between 0 and 1")
        if r.shape != (n,) or not ((r > 0.0) & np.isfinite(r)).all():
            raise InputError(f"rate has shape {r.shape}, want {n} finite rates above 0")
        if not (step_s > 0.0 and math.isfinite(step_s)) or memory_steps < 2:
            raise InputError(
                f"step_s is {step_s} and memory_steps {memory_steps}, want seconds above 0 and at least 2"
            )
        if not problem.sensor_model.perfect:
            raise InputError("the exact planner requires a sensor model without errors")
        codes = 2 * memory_steps + 1
        if codes**n * lot.n_vertices > MOST_STATES:
            raise InputError(
                f"{n} slots, {lot.n_vertices} vertices and {memory_steps} steps make more than {MOST_STATES} belief "
                "states: want fewer slots or steps"
            )
        self.problem, self.step_s, self.memory_steps = problem, step_s, memory_steps
        self.belief_error = float(
            np.exp(-r * (memory_steps - 1) * step_s).max() * max(p.max(), 1.0 - p.min())
        )
        ages = np.arange(memory_steps) * step_s
        usual = 1.0 - p[:, None]
        decayed = np.exp(-r[:, None] * ages)
        # P(free) by code: never observed; free k steps ago; taken k steps ago.
        self._free = np.concatenate([usual, usual + (1.0 - usual) * decayed, usual * (1.0 - decayed)], axis=1)
        moves = np.concatenate([lot.neighbors, np.arange(lot.n_vertices)[:, None]], axis=1).astype(np.int64)
        waits = (lot.neighbors < 0).any(axis=1)
        moves[~waits, _STAY] = -1
        wait_s = np.full((lot.n_vertices, 1), problem.wait_s)
        seconds = np.concatenate([problem.move_s, wait_s], axis=1)
        cost_s = np.concatenate([problem.move_cost_s, wait_s], axis=1)
        steps = np.maximum(np.rint(seconds / step_s), 1).astype(np.int64)
        made = moves >= 0
        self.rounding_error = float(np.abs(steps[made] * step_s / seconds[made] - 1.0).max())
        starts, slots = problem.slots_in_view
        self.values = np.full((lot.n_vertices, codes**n), np.inf)
        self._choices = np.full(self.values.shape, -1, dtype=np.int8)
        sweeps = _iterate(
            self.values,
            self._choices,
            self._free,
            moves,
            cost_s,
            steps,
            starts,
            slots,
            problem.arrival_cost_s,
            problem.give_up_s,
            memory_steps,
        )
        if sweeps >= _MOST_SWEEPS:
            raise InputError(
                "Bellman's equation did not converge: want rates that let a car leave within hours"
            )

    def expected_s(self, vertex: int, codes: IntArray | None = None) -> float:
        """Return the least expected time, s, from a vertex in a belief state (see `code`); None: nothing observed."""
        return float(self.values[vertex, self._index(codes)])

    def decide(self, vertex: int, codes: IntArray) -> int:
        """Return the optimal action: a move, `PARK`, or `WAIT` to observe again."""
        choice = int(self._choices[vertex, self._index(codes)])
        return {_STAY: WAIT, _PARK: PARK}.get(choice, choice)

    def code(self, belief: SlotBelief) -> IntArray:
        """Return the codes, (n_slots,), of the belief about each slot."""
        age = np.minimum(np.rint(belief.age / self.step_s), self.memory_steps - 1).astype(np.int64)
        return np.where(belief.observed, 1 + age + np.where(belief.observed_free, 0, self.memory_steps), 0)

    def _index(self, codes: IntArray | None) -> int:
        if codes is None:
            return 0
        return int((np.asarray(codes) * (2 * self.memory_steps + 1) ** np.arange(len(codes))).sum())


@compiled
def _iterate(
    values: FloatArray,
    choices: NDArray[np.int8],
    free: FloatArray,
    moves: IntArray,
    seconds: FloatArray,
    steps: IntArray,
    view_starts: IntArray,
    view_slots: IntArray,
    cost_s: FloatArray,
    give_up_s: float,
    memory_steps: int,
) -> int:
    """Solve in place by sweeps over the states that can occur; return the number of sweeps."""
    n_vertices, n_states = values.shape
    n = len(free)
    n_codes = 2 * memory_steps + 1
    powers = np.ones(n, np.int64)
    for s in range(1, n):
        powers[s] = powers[s - 1] * n_codes
    codes, aged = np.empty(n, np.int64), np.empty(n, np.int64)
    sweep = 0
    while sweep < _MOST_SWEEPS:
        worst = 0.0
        for v in range(n_vertices):
            for state in range(n_states):
                rest, all_taken, possible = state, True, True
                for s in range(n):
                    codes[s] = rest % n_codes
                    rest //= n_codes
                    all_taken = all_taken and codes[s] > memory_steps
                for i in range(view_starts[v], view_starts[v + 1]):
                    c = codes[view_slots[i]]
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
                    best, choice = cost_s[v], _PARK
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
                    first, k = view_starts[u], view_starts[u + 1] - view_starts[u]
                    expected = seconds[v, m]
                    for outcome in range(1 << k):
                        chance, after = 1.0, base
                        for i in range(k):
                            s = view_slots[first + i]
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
        if worst < _TOLERANCE:
            break
    return sweep
