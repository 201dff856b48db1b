"""The file that an example writes for solvers of others: read back, its optimum is that of `exact`."""

import runpy
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest
from small_lots import small_lot

from parkenv.world.occupancy.day_error import EXACT, DayError
from planners.bounds.exact import ExactSolution

EXAMPLE = runpy.run_path(str(Path(__file__).parents[1] / "examples" / "write_pomdp.py"))


class Read:
    """A `.pomdp` file with sure transitions and observations, as ours are."""

    def __init__(self, lines):
        after, reward, seen = {}, {}, {}
        for line in lines:
            key, *rest = [part.strip() for part in line.split("#")[0].split(":")]
            words = [part.split() for part in rest]
            if key == "T":
                (action,), (state,), (target, p) = words
                assert float(p) == 1.0
                after[action, state] = target
            elif key == "R":
                (action,), (state,), _, (_, r) = words
                reward[action, state] = float(r)
            elif key == "O":
                (action,), (state,), (observation, p) = words
                assert (action, float(p)) == ("*", 1.0)
                seen[state] = observation
            elif key:
                setattr(self, key, words[0])
        self.chances = dict(zip(self.states, map(float, self.start), strict=True))
        self.after = {(a, s): after.get((a, s)) or after["*", s] for a in self.actions for s in self.states}
        self.reward = {key: reward.get(key, 0.0) for key in self.after}
        self.seen = seen
        assert sum(self.chances.values()) == pytest.approx(1.0)
        assert {*self.after.values(), *self.seen} <= {*self.states}
        assert {*self.seen.values()} <= {*self.observations}

    def value(self):
        """Value iteration over the beliefs that can follow from the start."""
        first = frozenset((s, p) for s, p in self.chances.items() if p)
        steps, waiting = {}, [first]
        while waiting:
            belief = waiting.pop()
            if belief in steps:
                continue
            steps[belief] = []
            for action in self.actions:
                by_seen, reward = defaultdict(list), 0.0
                for state, p in belief:
                    reward += p * self.reward[action, state]
                    after = self.after[action, state]
                    if after != "done":
                        by_seen[self.seen[after]].append((after, p))
                branches = []
                for found in by_seen.values():
                    total = sum(p for _, p in found)
                    branches.append((total, frozenset((s, round(p / total, 12)) for s, p in found)))
                steps[belief].append((reward, branches))
                waiting += [after for _, after in branches]
        values = dict.fromkeys(steps, 0.0)
        while True:
            worst = 0.0
            for belief, actions in steps.items():
                best = max(r + sum(p * values[b] for p, b in branches) for r, branches in actions)
                worst, values[belief] = max(worst, abs(best - values[belief])), best
            if worst < 1e-10:
                return values[first]


def few_slots(seed):
    """Three or four slots along one or two aisles."""
    problem, p_occupied, entry = small_lot(seed, ((1, 3), (2, 2), (1, 4)))
    return (
        problem,
        p_occupied,
        entry if seed % 2 else int(np.random.default_rng(seed).integers(len(p_occupied))),
    )


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("day_error", [EXACT, DayError(0.9, 0.4)])
def test_value_iteration_on_the_file_finds_the_exact_optimum(seed, day_error):
    problem, p_occupied, vertex = few_slots(seed)
    read = Read(EXAMPLE["pomdp_lines"](problem, p_occupied, vertex, day_error))
    expected_s = ExactSolution(problem, p_occupied, vertex, day_error=day_error).expected_s
    assert -read.value() == pytest.approx(expected_s, abs=1e-6)
