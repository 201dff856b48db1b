"""Searches as files of other solvers: read back, their optimum is that of `exact`."""

from collections import defaultdict

import numpy as np
import pytest
from small_lots import features, small_lot
from test_exact import one_way_line

from parkenv import InputError, ParkingLot, SensorModel
from parkenv.lots import grid_lot, packaged_lot
from parkenv.world.occupancy.day_error import EXACT, DayError
from parkenv.world.scenario import SearchProblem
from planners.bounds.exact import ExactSolution
from planners.bounds.pomdp_file import write_pomdp


class Read:
    """A `.pomdp` file with sure transitions and observations, as ours are."""

    def __init__(self, path):
        after, reward, seen = {}, {}, {}
        for line in path.read_text(encoding="utf-8").splitlines():
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
def test_value_iteration_on_the_file_finds_the_exact_optimum(tmp_path, seed, day_error):
    problem, p_occupied, vertex = few_slots(seed)
    file = tmp_path / "lot.pomdp"
    size = write_pomdp(file, problem, p_occupied, vertex, day_error)
    read = Read(file)
    assert (len(read.states), len(read.actions), len(read.observations)) == size
    expected_s = ExactSolution(problem, p_occupied, vertex, day_error=day_error).expected_s
    assert -read.value() == pytest.approx(expected_s, abs=1e-6)


def test_pomdp_pys_value_iteration_on_the_file_finds_the_exact_optimum(tmp_path):
    pomdp_py = pytest.importorskip("pomdp_py", reason="needs the extra pomdp: pomdp-py")
    problem = SearchProblem(lot=grid_lot(1, 2), sensor_model=SensorModel(view_range=0.0), give_up_s=200.0)
    vertex, p_occupied, file = int(problem.lot.entry_vertices[0]), np.array([0.5, 0.8]), tmp_path / "x.pomdp"
    write_pomdp(file, problem, p_occupied, vertex)
    read, bonus = Read(file), 1e4

    class Transitions(pomdp_py.TransitionModel):
        def probability(self, next_state, state, action):
            return float(read.after[action, state] == next_state)

    class Observations(pomdp_py.ObservationModel):
        def probability(self, observation, next_state, action):
            return float(read.seen[next_state] == observation)

    class Rewards(pomdp_py.RewardModel):
        def sample(self, state, action, next_state):
            # Its horizon is finite: who has not parked by then goes without a prize.
            return read.reward[action, state] + bonus * (next_state == "done" != state)

    value = pomdp_py.value(
        read.chances, read.states, read.actions, read.observations, Transitions(), Observations(), Rewards(), 1.0,
        horizon=4,
    )  # fmt: skip
    assert bonus - value == pytest.approx(ExactSolution(problem, p_occupied, vertex).expected_s, abs=1e-6)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"lot": packaged_lot("campus")}, "189 slots"),
        ({"lot": grid_lot(2, 8)}, "states, want at most"),
        ({"sensor_model": SensorModel(view_range=6.0, hit_rate=0.9)}, "without errors"),
    ],
)
def test_what_no_file_can_hold_is_refused_and_nothing_is_written(tmp_path, changes, message):
    problem = SearchProblem(**{"lot": grid_lot(1, 3), **changes})
    with pytest.raises(InputError, match=message):
        write_pomdp(tmp_path / "x.pomdp", problem, np.full(problem.lot.n_slots, 0.5), 0)
    assert not list(tmp_path.iterdir())


def test_a_slot_that_is_never_seen_is_refused(tmp_path):
    lot = ParkingLot(**{**features(one_way_line(2, 30.0)), "entries": np.array([[15.0, 0.0]])})
    with pytest.raises(InputError, match="never in view"):
        write_pomdp(
            tmp_path / "x.pomdp", SearchProblem(lot=lot, sensor_model=SensorModel(view_range=0.0)), [0.5, 0.5],
            int(lot.entry_vertices[0]),
        )  # fmt: skip
