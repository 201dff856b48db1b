"""A search in a small lot as a file of Cassandra's format `.pomdp`, for other solvers.

It is the model of `planners.bounds.exact`, with single moves: given the day, slots are taken independently of each
other, and do not change; slots in view are observed without error. A state is the vertex of the car and the
slots that are taken, or `done`. The day needs no states: the probabilities of the initial states contain it.

Three things keep the least expected cost to that of `exact`. At the start, a separate state, the car has observed
nothing yet and cannot park. Giving up in a lot that is not full costs so much that it is never optimal before every
slot was observed. Rewards are minus seconds, discounted only if asked for.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from parkenv.belief.slot_belief import SlotBelief
from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.errors import InputError, require_number
from parkenv.files.atomic_write import atomic_write
from parkenv.world.lot import ACTIONS, PARK
from parkenv.world.occupancy.day_error import EXACT, DayError
from parkenv.world.scenario import SearchProblem
from planners.agent import Observation
from planners.bounds.days import Days
from planners.bounds.exact import ExactSolution, require_small
from planners.road_table import RoadTable

GIVE_UP = "give-up"
"""The action that ends the search in a full lot."""
DONE = "done"
"""The state after the search."""
MOST_STATES = 50_000
"""Maximum number of states of a file."""
_LEAST_FREE = 1e-6


class FileSize(NamedTuple):
    """What a file holds."""

    n_states: int
    n_actions: int
    n_observations: int


def write_pomdp(
    file: Path,
    problem: SearchProblem,
    p_occupied: ArrayLike,
    vertex: int,
    day_error: DayError = EXACT,
    discount: float = 1.0,
) -> FileSize:
    """Write the search from a vertex in which no slot has been observed.

    The value of the start is minus the `expected_s` of `ExactSolution`, to rounding.

    Args:
        file: where to.
        problem: lot, goal, speeds and costs; the sensor must not err.
        p_occupied: (n_slots,) probability that each slot is taken.
        vertex: where the car is.
        day_error: how far days differ from the forecast.
        discount: of each step; many solvers want less than 1.

    Raises:
        InputError: a lot with too many states; a sensor that errs; a slot that is never free or never seen.
    """
    require_small(problem)
    require_number("discount", discount, above=0.0, most=1.0)
    search = _Search.of(problem, np.asarray(p_occupied, np.float64), vertex, day_error)
    n_states = len(search.places) * 2**problem.lot.n_slots + 1
    if n_states > MOST_STATES:
        raise InputError(
            f"lot {problem.lot.name!r} makes {n_states:,} states, want at most {MOST_STATES:,}: fewer slots than "
            f"{problem.lot.n_slots}, of which each doubles them"
        )
    with atomic_write(file) as beside, beside.open("w", encoding="utf-8") as lines:
        lines.writelines(f"{line}\n" for line in search.lines(discount))
    return FileSize(n_states, PARK + 2, 2**search.most_seen)


def write_first(
    file: Path, problem: SearchProblem, observation: Observation, discount: float = 1.0
) -> tuple[FileSize, float]:
    """Write the search that begins with an observation of `parkenv/Search-v2`; also return its `expected_s`.

    Raises:
        InputError: see `write_pomdp`.
    """
    belief, vertex = SlotBelief.of_observation(observation), int(observation["vertex"])
    day_error = DayError(*map(float, belief.day_error))
    size = write_pomdp(file, problem, belief.forecast, vertex, day_error, discount)
    return size, ExactSolution(problem, belief.forecast, vertex, day_error=day_error).expected_s


class _Search(NamedTuple):
    problem: SearchProblem
    days: Days
    places: list[tuple[str, int]]  # name and vertex of the places where the car can be, the start first
    most_seen: int  # slots in view of a vertex, at most
    false_give_up_s: float  # cost of giving up where a slot is free

    @classmethod
    def of(cls, problem: SearchProblem, p_occupied: FloatArray, vertex: int, day_error: DayError) -> _Search:
        days, table, n = (
            Days.of(p_occupied, problem.walk_s, day_error),
            RoadTable.of(problem),
            len(p_occupied),
        )
        vertices: list[int] = np.flatnonzero(np.isfinite(table.seconds[vertex])).tolist()
        seen = {int(slot) for v in vertices for slot in problem.in_view(v)}
        if unseen := sorted(set(range(n)) - seen):
            raise InputError(f"slot {problem.lot.slot_ids[unseen[0]]!r} is never in view, want every slot")
        if (rare := float(days.p_free.min())) < _LEAST_FREE:
            raise InputError(f"a slot is free with a probability of {rare:g}, want {_LEAST_FREE:g} or more")
        drives = table.seconds[np.ix_(vertices, vertices)]
        cost = problem.arrival_cost_s
        longest_s = n * drives[np.isfinite(drives)].max() + cost[np.isfinite(cost)].max(initial=0.0)
        # To see all slots saves no more; what is unseen is free with at least this probability.
        false_give_up_s = (longest_s + problem.give_up_s) / rare
        places = [(f"v{v}", v) for v in vertices]
        most_seen = max(len(problem.in_view(v)) for _, v in places)
        # From a slot's own vertex the car could park before it has looked.
        at_slot = bool(problem.action_masks[vertex, PARK])
        first = [("start", vertex)] if at_slot else [places.pop(vertices.index(vertex))]
        return cls(problem, days, first + places, most_seen, false_give_up_s)

    def lines(self, discount: float) -> Iterator[str]:
        problem, n, names = self.problem, self.problem.lot.n_slots, [name for name, _ in self.places]
        full = 2**n - 1
        yield f"# The search for a free slot in lot {problem.lot.name!a}; rewards are minus seconds."
        yield "# State vV_BITS: the car is at vertex V (start: has not looked yet); slot i is taken where bit i is 1."
        yield "# Observation seen_BITS: which of the slots in view of the vertex are taken, in their order; then zeros."
        yield "# Slots stay as they are during the search, and are observed without error; level and slope of the day"
        yield f"# are on a grid. To give up while a slot is free costs {self.false_give_up_s:.6g} s."
        yield f"discount: {discount!r}"
        yield "values: reward"
        yield f"states: {' '.join(f'{name}_{_bits(o, n)}' for name in names for o in range(2**n))} {DONE}"
        yield f"actions: {' '.join(ACTIONS)} {GIVE_UP}"
        yield f"observations: {' '.join(_seen(o, self.most_seen) for o in range(2**self.most_seen))}"
        chances = [*self.chances(), *[0.0] * ((len(names) - 1) * 2**n + 1)]
        yield f"start: {' '.join(f'{float(p)!r}' for p in chances)}"
        yield f"T: * : {DONE} : {DONE} 1.0"
        yield f"O: * : {DONE} : {_seen(0, self.most_seen)} 1.0"
        for name, v in self.places:
            in_view = problem.in_view(v)
            for taken in range(2**n):
                state = f"{name}_{_bits(taken, n)}"
                yield f"O: * : {state} : {self.seen(in_view, taken)} 1.0"
                for action, target, cost_s in self.outcomes(name, v, taken):
                    after = DONE if target < 0 else f"v{target}_{_bits(taken, n)}"
                    yield f"T: {action} : {state} : {after} 1.0"
                    yield f"R: {action} : {state} : * : * {-cost_s!r}"
                cost_s = problem.give_up_s if taken == full else self.false_give_up_s
                yield f"T: {GIVE_UP} : {state} : {DONE} 1.0"
                yield f"R: {GIVE_UP} : {state} : * : * {-float(cost_s)!r}"

    def chances(self) -> FloatArray:
        """Return the probability of each set of taken slots, (2^n,)."""
        p_free, chance = self.days.p_free, self.days.chance[None, :]
        for slot in range(len(p_free)):
            chance = np.concatenate([chance * p_free[slot], chance * (1.0 - p_free[slot])])
        p: FloatArray = chance.sum(axis=1) / chance.sum()
        return p

    def seen(self, in_view: IntArray, taken: int) -> str:
        return _seen(sum((taken >> int(slot) & 1) << i for i, slot in enumerate(in_view)), self.most_seen)

    def outcomes(self, place: str, vertex: int, taken: int) -> Iterator[tuple[str, int, float]]:
        """Yield what each action of the environment leads to: its name, the vertex, -1 after parking, and the cost."""
        problem = self.problem
        # As `exact` has it, the car can wait where a move is missing.
        wait_s = problem.wait_s if (problem.lot.neighbors[vertex] < 0).any() else self.false_give_up_s
        for action, name in enumerate(ACTIONS):
            edge = problem.edges[vertex, action]
            target, cost_s = int(edge["target"]), float(edge["seconds"])
            if action == PARK:
                if place == "start" or not problem.action_masks[vertex, PARK]:
                    cost_s = wait_s
                elif taken >> vertex & 1:
                    cost_s = problem.failure_s
                else:
                    target, cost_s = -1, float(problem.arrival_cost_s[vertex])
            yield name, target, cost_s


def _bits(number: int, n: int) -> str:
    """Return n binary digits, the lowest first."""
    return "".join(str(number >> i & 1) for i in range(n))


def _seen(number: int, n: int) -> str:
    return f"seen_{_bits(number, n)}"
