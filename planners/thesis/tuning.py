"""`mdp-tuned`: the thesis's planner with a failure cost that is tuned to the forecast by simulation.

The failure cost is the one parameter of the thesis's planner without a right value (T §4.3 shows that 10 s is too bold
and 90 s too cautious). Here it is chosen by simulation: days are drawn from the forecast and its day error, with
independent, constant slots given the day; the planner searches all of them at each cost with the sensor's errors, and
the cost with the lowest mean time is chosen.
"""

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from parkenv.belief.slot_belief import SlotBelief
from parkenv.compiled.arrays import FloatArray
from parkenv.compiled.jit import compiled
from parkenv.compiled.keyed_random import OBSERVATION_STREAM, VIEW_STREAM, keyed_uniform
from parkenv.errors import require, require_whole
from parkenv.world.occupancy.centred_logits import centred_logits
from parkenv.world.occupancy.day_error import EXACT, DayError, nearness
from parkenv.world.scenario import SearchProblem
from planners.agent import Observation, SearchAgent, require_observations
from planners.belief.planning_graph import PlanningGraph
from planners.neighborhood import MOST_VERTICES, Neighborhood, Neighborhoods
from planners.routes import DriveRoutes
from planners.thesis.replanning import Plan, ReplanningAgent

# s, failure costs to choose from; each is twice the previous one.
COSTS = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0)
WORLDS = 128
_MOST_STEPS = 2000
_KEPT = 256


@dataclass(frozen=True, eq=False)
class Tuning:
    costs: FloatArray  # (k,) float64, s, the failure costs compared
    mean_s: FloatArray  # (k,) float64, s, mean total time of the planner at each cost, in the same worlds

    @property
    def best(self) -> float:
        """The failure cost with the lowest mean time, s; among equals the lowest cost."""
        return float(self.costs[self.mean_s.argmin()])


def tune_failure_cost(
    problem: SearchProblem,
    p_occupied: ArrayLike,
    vertex: int,
    *,
    costs: Sequence[float] = COSTS,
    worlds: int = WORLDS,
    seed: int = 0,
    near: Neighborhood | None = None,
    day_error: DayError = EXACT,
) -> Tuning:
    """Simulate the thesis's planner in worlds drawn from a forecast.

    Slots are observed with the errors of the problem's sensor while they are in view, and do not change; a lot that is
    proven full costs `give_up_s`. Of a large lot only the part where the search takes place is simulated
    (`Neighborhoods`).

    Args:
        problem: lot, goal, speeds and costs.
        p_occupied: (n_slots,) the forecast.
        vertex: where the search begins.
        costs: failure costs to compare, s, each above 0.
        worlds: number of worlds; they are the same for each cost.
        seed: seed of the worlds.
        near: the part of the lot to simulate; None: choose it.
        day_error: how far days differ from the forecast; each world has a day of its own.

    Raises:
        InputError: a cost or the number of worlds is not positive, or the probabilities have the wrong shape or values.
    """
    p = np.asarray(p_occupied, dtype=np.float64)
    compared = np.asarray(costs, dtype=np.float64)
    require(
        p.shape == (problem.lot.n_slots,) and ((p >= 0.0) & (p <= 1.0)).all(),
        f"p_occupied has shape {p.shape}, want {problem.lot.n_slots} probabilities",
    )
    require(
        len(compared) and (np.isfinite(compared) & (compared > 0.0)).all(),
        f"costs are {list(costs)}, want finite seconds above 0",
    )
    require_whole("worlds", worlds, least=1)
    near = near or Neighborhoods(problem).toward(vertex)
    here = near.index(vertex)
    start = here if here >= 0 else near.index(near.entry)
    p, near_goal = p[near.slots], nearness(problem.walk_s)[near.slots]
    rng = np.random.default_rng(seed)
    uniform = rng.random((worlds, len(p)))
    if day_error:
        level, slope = rng.standard_normal((2, worlds, 1)) * [[[day_error.level]], [[day_error.slope]]]
        centre = centred_logits(np.clip(p, 1e-9, 1.0 - 1e-9), day_error.deviations(near_goal))
        taken = uniform < 1.0 / (1.0 + np.exp(-(centre + level + slope * near_goal)))
    else:
        taken = uniform < p
    keys = rng.integers(1 << 63, size=worlds, dtype=np.uint64)
    # The actual cost of a failed attempt in these worlds; the costs that are compared are the planner's.
    graph = near.planning_graph(problem, problem.failure_s)
    odds = np.divide(p, 1.0 - p, out=np.full(len(p), np.inf), where=p < 1.0)
    return Tuning(compared, _mean_times(start, taken, keys, odds, compared, graph))


@compiled
def _mean_times(
    vertex: int,
    taken: NDArray[np.bool_],
    keys: NDArray[np.uint64],
    odds: FloatArray,
    costs: FloatArray,
    graph: PlanningGraph,
) -> FloatArray:
    """Return the planner's mean total time, (k,) s, at each failure cost over worlds, (n_worlds, n_slots) bool."""
    mean = np.zeros(len(costs))
    for c in range(len(costs)):
        for w in range(len(taken)):
            total_s = _total_time(vertex, taken[w], keys[w], costs[c], graph, odds.copy())
            mean[c] += total_s / len(taken)
    return mean


@compiled
def _total_time(
    vertex: int, taken: NDArray[np.bool_], key: np.uint64, cost: float, graph: PlanningGraph, odds: FloatArray
) -> float:
    """Return the total time, s, of the thesis's planner in one world; its belief `odds`, P(taken)/P(free), changes."""
    total, n_taken = 0.0, 0
    seen_taken = np.zeros(len(taken), np.bool_)  # by each slot's last observation
    for step in range(_MOST_STEPS):
        target, value = _best_target(vertex, cost, graph, odds)
        if target < 0 or not value < np.inf:
            break
        if target == vertex:
            if not taken[target]:
                return float(total + graph.cost_s[target])
            total += graph.failure_s
            odds[target] = np.inf
            n_taken += not seen_taken[target]
            seen_taken[target] = True
        else:
            following = int(graph.next_vertex[vertex, target])
            total += graph.drive_s[vertex, following]
            vertex = following
        for i in range(graph.view_starts[vertex], graph.view_starts[vertex + 1]):
            view = graph.views[i]
            s = view.slot
            # What is certain stays so: slots do not change. Occlusions persist, as in the environment.
            if odds[s] == 0.0 or odds[s] == np.inf or keyed_uniform(key, VIEW_STREAM, s, 0) >= view.rate:
                continue
            p_reported = view.hit if taken[s] else view.false_alarm
            reported = keyed_uniform(key, OBSERVATION_STREAM, s, step) < p_reported
            if_taken, if_free = view.hit, view.false_alarm
            if not reported:
                if_taken, if_free = 1.0 - if_taken, 1.0 - if_free
            odds[s] = odds[s] * if_taken / if_free if if_free > 0.0 else np.inf
            n_taken += reported - seen_taken[s]
            seen_taken[s] = reported
        if n_taken == len(taken):
            break
    return total + graph.give_up_s


@compiled
def _best_target(vertex: int, cost: float, graph: PlanningGraph, odds: FloatArray) -> tuple[int, float]:
    """Return the slot that the thesis's planner drives to, and its expected time, s, as in `planners.belief.path`."""
    best, chosen = np.inf, -1
    drive_s = graph.drive_s[vertex]
    for s in range(len(odds)):
        value = drive_s[s] + graph.cost_s[s] + cost * odds[s]
        if value < best:
            best, chosen = value, s
    return chosen, best


@dataclass
class TunedPlan(Plan):
    failure_s: float = 0.0  # s, the chosen failure cost
    entry: int = -1  # the vertex to drive to before following the plan, or -1


class TunedAgent(SearchAgent[TunedPlan]):
    """`mdp-tuned`: chooses a failure cost for the forecast on arrival, then acts as the thesis's planner.

    On a lot too large to simulate as a whole it first drives to the entry of the simulated part.

    Args:
        problem: lot, goal, speeds and costs.
        worlds: number of worlds drawn from the forecast.
        seed: seed of those worlds.
        gamma: discount per decision. None: 0.9999, or more where edges are short.
        most_vertices: a larger lot is simulated in part (`Neighborhoods`).
    """

    name: ClassVar[str] = "mdp-tuned"

    def __init__(
        self,
        problem: SearchProblem,
        worlds: int = WORLDS,
        seed: int = 0,
        gamma: float | None = None,
        most_vertices: int = MOST_VERTICES,
    ) -> None:
        super().__init__(problem)
        require_observations(self.name, problem)
        require_whole("worlds", worlds, least=1)
        self.worlds, self.seed, self.gamma = worlds, seed, gamma
        self._neighborhoods = Neighborhoods(self.problem, most_vertices)
        self._routes = DriveRoutes(self.problem)
        self._planners: dict[float, ReplanningAgent] = {}
        self._tuned: OrderedDict[tuple[int, DayError, bytes], Tuning] = OrderedDict()

    def tuning(self, p_occupied: NDArray[np.floating], vertex: int, day_error: DayError = EXACT) -> Tuning:
        """Return the simulation for a forecast, (n_slots,), and a start vertex; results are cached."""
        # Forecasts are rounded to a percent, so arrivals within minutes of each other share a result.
        near = self._neighborhoods.toward(vertex)
        rounded = np.round(np.asarray(p_occupied, dtype=np.float64), 2)
        key = vertex, day_error, rounded[near.slots].tobytes()
        if key not in self._tuned:
            p = np.clip(rounded, 0.001, 0.999)
            self._tuned[key] = tune_failure_cost(
                self.problem, p, vertex, worlds=self.worlds, seed=self.seed, near=near, day_error=day_error
            )
            if len(self._tuned) > _KEPT:
                self._tuned.popitem(last=False)
        return self._tuned[key]

    def begin(self, observation: Observation, belief: SlotBelief) -> TunedPlan:
        vertex = int(observation["vertex"])
        best = self.tuning(belief.p_occupied, vertex, DayError(*map(float, belief.day_error))).best
        if best not in self._planners:
            self._planners[best] = ReplanningAgent(self.problem, failure_s=best, gamma=self.gamma)
        near = self._neighborhoods.toward(vertex)
        entry = near.entry if near.index(vertex) < 0 else -1
        return TunedPlan(**vars(self._planners[best].begin(observation, belief)), failure_s=best, entry=entry)

    def decide(self, observation: Observation, belief: SlotBelief, memory: TunedPlan) -> int:
        vertex = int(observation["vertex"])
        if vertex == memory.entry:
            memory.entry = -1
        if memory.entry >= 0:
            return self._routes.move_toward(vertex, memory.entry)
        return self._planners[memory.failure_s].decide(observation, belief, memory)

    def plan_preview(self, observation: Observation, action: int, memory: TunedPlan) -> tuple[int, ...]:
        if memory.entry >= 0:
            return self._routes.path(int(observation["vertex"]), memory.entry)
        return self._planners[memory.failure_s].plan_preview(observation, action, memory)
