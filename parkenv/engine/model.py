"""A generative model of a search, for planners: worlds drawn from a belief, stepped and observed by the engine itself.

It is made of what an agent may know: the problem, and the forecast in the first observation. The world of a search is
out of its reach, where `get_state` and `set_state` of an environment replay it: a planner that looks ahead with them
sees the future.

Worlds follow the forecast: each slot is a two-state Markov chain with the forecast as its mean and the decay rate as
its speed, and the day has the level and the slope that `day_error` states. Given observations, the day is drawn from
its posterior, and the slots given the day. On request, days may also be unlike any forecast, as `belief` assumes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from parkenv.belief.day_belief import DayBelief
from parkenv.belief.slot_belief import Observations, SlotBelief
from parkenv.compiled.arrays import BoolArray, FloatArray, IntArray
from parkenv.compiled.jit import kernel
from parkenv.compiled.memory import address_of, call_at
from parkenv.engine.batch import first_wrong
from parkenv.engine.kernel import (
    act,
    draw_departure,
    enter,
    finish_step,
    give_up,
    is_about_to_leave,
    step_cost_s,
    sum_of_costs,
    take_step,
    write_clock,
)
from parkenv.engine.policy import CompiledPolicy, PolicyData, car_of
from parkenv.engine.records import (
    CAR,
    FLEET,
    N_ACTIONS,
    NO_SLOT,
    SEARCH,
    cue_at,
    scenario_at,
    search_at,
    slot_at,
)
from parkenv.engine.search_belief import column_of, end_observed, is_taken, set_belief_of
from parkenv.engine.searches import ScenarioRecords, Searches, most_observed_in
from parkenv.engine.spaces import action_number
from parkenv.errors import InputError, require, require_whole
from parkenv.world.lot import PARK
from parkenv.world.occupancy.centred_logits import centred_logits
from parkenv.world.occupancy.day_error import DayError, nearness
from parkenv.world.occupancy.kernel import MAX_PROBABILITY, MIN_PROBABILITY
from parkenv.world.occupancy.process import MAX_RATE, OccupancyProcess
from parkenv.world.scenario import Scenario, SearchProblem
from parkenv.world.week import WEEK_HOURS

MAX_STEPS = 2000  # steps after which `Simulations.run` ends a search, as environments do
_LEVELS, _SLOPES = 33, 9  # cells of the day's level and slope
_REACH = 3.5  # standard deviations that they span, on either side
_LEAST_RATE = 1e-9  # 1/s, of slots that never change
_SAME_TIME_S = 0.01


class Observation(NamedTuple):
    """What a step tells."""

    vertex: int  # where the car is
    time: float  # s since the search began
    # (k,) int64, the observed slots: first the one that the car attempted to park in, if it did
    slots: IntArray
    taken: BoolArray  # (k,) bool, what was observed
    # (k,) float64, P(observed taken | taken) and P(observed taken | free); 1 and 0 of an attempt
    hit_rate: FloatArray
    false_alarm_rate: FloatArray
    cue_evidence: FloatArray  # (k,) float64, what shows that the car in it leaves, see `SlotBelief.cues`

    @classmethod
    def of(cls, observation: Mapping[str, Any] | Observation) -> Observation:
        if isinstance(observation, Observation):
            return observation
        slots, _, taken, hit, false_alarm = SlotBelief.of_observation(observation).observations
        evidence = np.zeros(len(slots))
        if "cues" in observation:
            evidence = observation["cues"].reshape(3, -1)[2, slots].astype(np.float64)
        vertex, time = int(observation["vertex"]), float(observation["time"][1])
        return cls(vertex, time, slots, taken, hit, false_alarm, evidence)


@dataclass(frozen=True, eq=False)
class Belief:
    """What the driver knows; `Model.update` returns a new one."""

    vertex: int  # where the car is
    slots: SlotBelief  # P(taken) of each slot, and when it was observed
    day: DayBelief  # posterior over the level and the slope of the day
    last_taken: BoolArray  # (n_slots,) bool, whether the slot was last observed taken
    arrival: float  # when the search began, s since Monday 00:00
    n_steps: int  # number of steps so far
    _days: _Days
    _tables: ScenarioRecords
    over: bool = False  # whether the car has parked, or has observed that every slot is taken


class _Days(NamedTuple):
    """Hypotheses about the day, cells of its level and slope: prior weights, middles, (k,), and widths of a cell."""

    weight: FloatArray
    level: FloatArray
    slope: FloatArray
    widths: tuple[float, float]

    @classmethod
    def of(cls, error: DayError) -> _Days:
        levels, level_p, level_width = _cells(error.level, _LEVELS)
        slopes, slope_p, slope_width = _cells(error.slope, _SLOPES)
        weight = np.outer(level_p, slope_p).ravel()
        level, slope = (axis.ravel() for axis in np.meshgrid(levels, slopes, indexing="ij"))
        return cls(weight, level, slope, (level_width, slope_width))


def _cells(deviation: float, n: int) -> tuple[FloatArray, FloatArray, float]:
    """Return middles and probabilities, (n,), of equal cells of a normal law, and their width; one if it is certain."""
    if deviation == 0.0:
        return np.zeros(1), np.ones(1), 0.0
    edges = np.linspace(-_REACH, _REACH, n + 1)
    p = np.diff(ndtr(edges))
    return (edges[:-1] + edges[1:]) / 2 * deviation, p / p.sum(), float(2 * _REACH / n * deviation)


class Simulations:
    """Simulated searches in worlds of their own, stepped by compiled code; `Model.sample` makes them.

    They are as a particle filter or a tree search wants them: `take` copies some, `reseed` gives them another future.
    """

    def __init__(self, tables: ScenarioRecords, n: int) -> None:
        self.searches = Searches(tables, n, False, most_observed_in(tables.scenarios))
        self._costs, self._over = np.zeros(n), np.zeros(n, np.bool_)

    __copy__ = deepcopy

    def __len__(self) -> int:
        return len(self.searches.records)

    @property
    def over(self) -> BoolArray:
        return self.searches.records["over"].copy()

    def observation(self, i: int = 0) -> Observation:
        rows, record = self.searches.step_observed[i], self.searches.records[i]
        of_slots, taken, hit, false_alarm = rows[:, : int(record["n_step_observed"])].astype(np.float64)
        slots, evidence = of_slots.astype(np.int64), np.zeros(len(of_slots))
        if len(self.searches.cue_table):
            cues = self.searches.cue_table[i][self.searches.columns[i][slots]]
            evidence = np.where(cues["at"] == record["time"], cues["evidence"], 0.0)
        vertex, time = int(record["vertex"]), float(record["clock"][1])
        return Observation(vertex, time, slots, taken == 1.0, hit, false_alarm, evidence)

    def step(self, actions: IntArray) -> tuple[FloatArray, BoolArray]:
        """Take an action, (n,) int64, in each search in place; return costs, (n,) s, and which are over, (n,) bool.

        Those that are over stay as they are, at no cost.
        """
        actions = np.ascontiguousarray(np.broadcast_to(actions, len(self)), np.int64)
        wrong = first_wrong(actions)
        if wrong >= 0:
            action_number(actions[wrong])
        _step_at(self.searches.address, actions, self._costs, self._over)
        return self._costs.copy(), self._over.copy()

    def one(self, i: int) -> Simulations:
        """Return search i by itself, not a copy: its steps are those of search i, and take a tenth of `Model.step`."""
        require_whole("i", i, most=len(self) - 1)
        alone = object.__new__(Simulations)
        alone.searches = self.searches.row(i)
        alone._costs, alone._over = np.zeros(1), np.zeros(1, np.bool_)
        return alone

    def take(self, rows: IntArray) -> Simulations:
        """Return copies of some searches, (m,), with the same future as these; an index may occur several times."""
        taken = Simulations(self.searches.scenarios, len(rows))
        taken.searches.restore(self.searches.save(rows))
        return taken

    def reseed(self, rng: np.random.Generator) -> None:
        """Draw again how long states last, which slots are hidden, errors of the sensor; the present stays."""
        _reseed_at(self.searches.address, rng.integers(2**64, size=len(self), dtype=np.uint64))

    def run(self, policy: CompiledPolicy, max_steps: int = MAX_STEPS) -> FloatArray:
        """Let a compiled policy end all searches in place; return the cost from now on, (n,) s.

        That is what it is so far, where a search takes more than `max_steps`.
        """
        cost_s = np.zeros(len(self))
        self._drive(policy, max_steps, cost_s, np.zeros(0, np.int64))
        return cost_s

    def choose(self, policy: CompiledPolicy) -> IntArray:
        actions = np.full(len(self), -1)
        self._drive(policy, 0, np.zeros(len(self)), actions)
        return actions

    def _drive(self, policy: CompiledPolicy, max_steps: int, cost_s: FloatArray, actions: IntArray) -> None:
        require(
            isinstance(policy, CompiledPolicy),
            f"policy is {policy!r:.60}, want a CompiledPolicy, such as one of planners.heuristics.policies.POLICIES",
        )
        address, _kept = _policy_batch(self.searches, policy)
        _run_at(address, policy.address, max_steps, cost_s, actions)


class Model:
    """The generative model of a search.

    Args:
        problem: lot, goal, speeds, costs and sensor model; of a whole scenario the public part is kept. Live counts of
            facilities are refused.
    """

    def __init__(self, problem: SearchProblem) -> None:
        self.problem = problem.public()
        require(
            len(self.problem.live_slots) == 0,
            f"lot {self.problem.lot.name!r} has live counts, want one without them",
        )

    def initial_belief(self, observation: Mapping[str, Any]) -> Belief:
        """Return the belief in an observation of `parkenv/Search-v2`, such as the first one, that of `reset`.

        Of a search that goes on, the last observation of each slot counts for the day; with `update` after each step,
        all do.
        """
        if not isinstance(observation, Mapping):
            raise InputError(
                f"observation is a {type(observation).__name__}, want the dictionary of parkenv/Search-v2"
            )
        seen, n = SlotBelief.of_observation(observation), self.problem.lot.n_slots
        if len(seen.p_occupied) != n:
            raise InputError(f"observation has {len(seen.p_occupied)} slots, want {n}, those of the lot")
        slots = seen.take(np.arange(n))
        forecast = np.clip(slots.forecast, MIN_PROBABILITY, MAX_PROBABILITY)
        error = DayError(*(float(deviation) for deviation in seen.day_error))
        near, days = nearness(self.problem.walk_s), _Days.of(error)
        centre = centred_logits(forecast, error.deviations(near))
        logits = centre[:, None] + days.level + near[:, None] * days.slope
        day = DayBelief(slots, near, hypotheses=(days.weight, 1.0 / (1.0 + np.exp(-logits))))
        day.update(_last_observations(slots, forecast))
        rate, hours = np.clip(slots.decay_rate, _LEAST_RATE, MAX_RATE), np.ones(WEEK_HOURS)
        world = OccupancyProcess(forecast * rate, hours, (1.0 - forecast) * rate, hours, error, near)
        fields = {name: getattr(self.problem, name) for name in SearchProblem.__dataclass_fields__}
        tables = ScenarioRecords([Scenario(name="model", occupancy=world, **fields)])
        vertex, (now, elapsed) = int(observation["vertex"]), observation["time"]
        return Belief(vertex, slots, day, slots.observed_taken, float(now - elapsed), 0, days, tables)

    def sample(self, belief: Belief, rng: np.random.Generator, n: int = 1, copies: int = 1) -> Simulations:
        """Draw n worlds from a belief, with a search in each; it goes on unless the belief is `over`.

        With `copies`, simulations i, n + i, 2n + i, ... are in the same world i, to compare what they do there.

        The day comes from its posterior. Given the day, a slot that was observed is taken with the probability to which
        its observation has decayed, and others with that of the day; from now on all change at their rates.
        """
        self._require_own(belief)
        if not isinstance(rng, np.random.Generator):
            raise InputError(
                f"rng is {rng!r:.40}, want a numpy.random.Generator, such as np.random.default_rng(0)"
            )
        require_whole("n", n)
        require_whole("copies", copies, least=1)
        slots = np.flatnonzero(belief.slots.observed)
        p_day, p_taken = belief.day.on_days(slots, belief.slots.time)
        day = rng.choice(len(p_day), n, p=p_day)
        days = belief._days
        level = days.level[day] + days.widths[0] * (rng.random(n) - 0.5)
        slope = days.slope[day] + days.widths[1] * (rng.random(n) - 0.5)
        taken = rng.random((n, len(slots))) < p_taken.T[day]
        keys, rows = rng.integers(2**64, size=n, dtype=np.uint64), np.tile(np.arange(n), copies)
        drawn = Simulations(belief._tables, n * copies)
        _sample_at(
            drawn.searches.address, keys[rows], belief.vertex, belief.arrival, belief.slots.time, belief.n_steps,
            np.exp(level)[rows], slope[rows], slots, taken[rows], belief.last_taken[slots],
            belief.slots.p_observed[slots], belief.slots.observed_at[slots],
            *self._announced(belief.slots, slots, taken, rng, rows),
        )  # fmt: skip
        drawn.searches.records["over"] = belief.over
        return drawn

    def _announced(
        self, belief: SlotBelief, slots: IntArray, taken: BoolArray, rng: np.random.Generator, rows: IntArray
    ) -> tuple[FloatArray, BoolArray]:
        """Return the excess of each slot's last cue, (k,), and whether its car shows now that it leaves, (n, k)."""
        if not len(belief.cues):
            return np.zeros(0), np.zeros((len(rows), 0), np.bool_)
        excess, rate, _ = belief.cues.reshape(3, -1)[:, slots].astype(np.float64)
        usual = belief.decay_rate[slots] * (1.0 - belief.forecast[slots]) / rate
        p = usual + belief.announced[slots] / np.maximum(belief.p_occupied[slots], MIN_PROBABILITY)
        return excess, (taken & (rng.random(taken.shape) < p))[rows]

    def step(
        self, state: Simulations, action: int, rng: np.random.Generator | None = None
    ) -> tuple[Simulations, Observation, float, bool]:
        """Take an action in one simulated search, and leave `state` as it is; many are stepped by `Simulations.step`.

        `rng` draws what comes anew, see `Simulations.reseed`; without it, the future is that drawn with the state.

        Returns:
            The next state, what is observed, the cost of the step, s, and whether the search is over.
        """
        self._require_own(state)
        if len(state) != 1:
            raise InputError(f"state holds {len(state)} simulations, want one; Simulations.step steps many")
        if state.over[0]:
            raise InputError("state is of a search that is over, want one that goes on")
        after = state.take(np.zeros(1, np.int64))
        if rng is not None:
            after.reseed(rng)
        (cost_s,), (over,) = after.step(np.array([action_number(action)]))
        return after, after.observation(), float(cost_s), bool(over)

    def update(self, belief: Belief, action: int, observation: Mapping[str, Any] | Observation) -> Belief:
        """Return the belief after an action and what was observed then, in the model or the environment."""
        self._require_own(belief)
        vertex, time, slots, taken, *rates, evidence = Observation.of(observation)
        target = int(self.problem.edges["target"][belief.vertex, action_number(action)])
        require(
            vertex == target,
            f"observation is of vertex {vertex}, want {target}, to which action {action} leads",
        )
        attempts = self._n_attempts(vertex, action, slots)
        times = np.full(len(slots), time)
        times[:attempts] = belief.slots.time
        by_attempt, on_arrival = (
            (slots[part], taken[part], *(rate[part] for rate in (*rates, evidence)))
            for part in (slice(attempts), slice(attempts, None))
        )
        attempted = belief.slots.update(*by_attempt)
        after = attempted.decay(time - attempted.time).update(*on_arrival)
        last_taken, day = belief.last_taken.copy(), belief.day.copy()
        last_taken[slots] = taken
        # Of the whole step, as in the environment: `decay` has dropped that of an attempt.
        after.observations = Observations(slots, times, taken, *rates)
        day.update(after.observations)
        over = belief.over or bool(last_taken.all()) or (attempts == 1 and not taken[0])
        return replace(
            belief,
            vertex=vertex,
            slots=after,
            day=day,
            last_taken=last_taken,
            n_steps=belief.n_steps + 1,
            over=over,
        )

    def observation_probability(
        self, observation: Mapping[str, Any] | Observation, state: Simulations, action: int
    ) -> FloatArray:
        """Return how probable an observation is after an action in each simulation, (n,): weights of a particle filter.

        Up to a common factor, with cues; which slots can be seen has nothing to do with where cars are, and does not
        count. 0 where the action leads elsewhere or takes another time.
        """
        self._require_own(state)
        vertex, time, slots, *seen = Observation.of(observation)
        after, p = state.take(np.arange(len(state))), np.ones(len(state))
        number, attempts = action_number(action), self._n_attempts(vertex, action, slots)
        _probability_at(after.searches.address, number, vertex, time, attempts, slots, *seen, p)
        return p

    def _n_attempts(self, vertex: int, action: int, slots: IntArray) -> int:
        return int(action == PARK and self.problem.action_masks[vertex, PARK] == 1 and len(slots) > 0)

    def _require_own(self, of: Belief | Simulations) -> None:
        name = "belief" if isinstance(of, Belief) else "state"
        tables = of._tables if isinstance(of, Belief) else of.searches.scenarios
        lot, other = self.problem.lot, tables.scenarios[0].lot
        require(
            other is lot or other == lot,
            f"{name} is of lot {other.name!r} with {other.n_slots} slots, want {lot.name!r} with {lot.n_slots}",
        )


def model(scenario: SearchProblem) -> Model:
    """Return the generative model of a search, on which planners are built; see the page "Write a planner".

    Args:
        scenario: the scenario, of which the model keeps the public part, or a problem.

    Examples:
        >>> import gymnasium as gym
        >>> import numpy as np
        >>> import parkenv
        >>> scenario, rng = parkenv.make_scenario("mini"), np.random.default_rng(0)
        >>> observation, _ = gym.make("parkenv/Search-v2", scenario=scenario).reset(seed=0)
        >>> model = parkenv.model(scenario)
        >>> belief = model.initial_belief(observation)
        >>> state, seen, cost_s, over = model.step(model.sample(belief, rng), 3, rng)
        >>> model.update(belief, 3, seen).vertex == seen.vertex
        True
    """
    return Model(scenario)


def _last_observations(slots: SlotBelief, forecast: FloatArray) -> Observations:
    seen = np.flatnonzero(slots.observed)
    p, taken = slots.p_observed[seen], slots.observed_taken[seen]
    with np.errstate(divide="ignore"):
        odds = p / (1.0 - p) * (1.0 - forecast[seen]) / forecast[seen]
        hit_rate, false_alarm_rate = np.where(taken, 1.0, 1.0 - odds), np.where(taken, 1.0 / odds, 0.0)
    rates = np.clip(hit_rate, 0.0, 1.0), np.clip(false_alarm_rate, 0.0, 1.0)
    return Observations(seen, slots.observed_at[seen].astype(np.float64), taken, *rates)


# ---- compiled


# Data of policies that drive simulations, by the scenario that they were made for, which tree searches run many times.
_DATA = WeakKeyDictionary[ScenarioRecords, dict[CompiledPolicy, PolicyData | None]]()


def _policy_batch(searches: Searches, policy: CompiledPolicy) -> tuple[int, list[Any]]:
    """Return the address of a FLEET record with a car for each search of one scenario, and what keeps it alive.

    The `moves` of the searches are the cars' from now on.
    """
    n, problem = len(searches.records), searches.scenarios.scenarios[0]
    cars, fleet = np.zeros(n, CAR), np.zeros(1, FLEET)
    moves = np.zeros((n, 2 * problem.lot.n_vertices), np.uint8)
    searches.records["moves"] = address_of(moves, np.uint8) + np.arange(n) * moves.shape[1]
    cars["search"], cars["target"] = searches.address + np.arange(n) * SEARCH.itemsize, NO_SLOT
    known = _DATA.setdefault(searches.scenarios, {})
    data = known[policy] if policy in known else known.setdefault(policy, policy.data_for([problem]))
    data_at = np.array([0 if data is None else data.address], np.int64)
    fleet["cars"], fleet["policy_data"] = address_of(cars, CAR), address_of(data_at, np.int64)
    return address_of(fleet, FLEET), [cars, fleet, moves, data, data_at]


@kernel
def _sample_at(
    address: int,
    keys: NDArray[np.uint64],
    vertex: int,
    arrival: float,
    time: float,
    n_steps: int,
    day_odds: FloatArray,
    day_slope: FloatArray,
    slots: IntArray,
    taken: BoolArray,
    last_taken: BoolArray,
    p_observed: FloatArray,
    observed_at: FloatArray,
    excess: FloatArray,
    announced: BoolArray,
) -> None:
    """Put a search into the situation of a belief, in a world of which the day and the observed slots are given."""
    for e in range(len(keys)):
        search = search_at(address, e)
        search.scenario, search.scenario_index = search.scenarios, 0
        search.n_forbidden = scenario_at(search.scenario, 0).n_forbidden
        enter(search, keys[e], 0, arrival, 0.0, vertex)
        search.day_odds, search.day_slope = day_odds[e], day_slope[e]
        search.time, search.n_steps = arrival + time, n_steps
        for i in range(len(slots)):
            column = column_of(search, slots[i])
            set_belief_of(search, column, last_taken[i], p_observed[i], arrival + observed_at[i])
            record = slot_at(search.slots, column)
            if record.valid_until < np.inf:
                # What comes does not depend on when the state began.
                record.occupied, record.sojourn, record.end_known = taken[e, i], 1, False
                record.since = record.valid_until = search.time
                if len(excess) > 0:
                    cue = cue_at(search.cue_table, column)
                    cue.excess, cue.at, cue.p = excess[i], arrival + observed_at[i], p_observed[i]
                    if taken[e, i]:
                        draw_departure(search, column, announced[e, i])
        write_clock(search)


@kernel
def _step_at(address: int, actions: IntArray, costs: FloatArray, over: BoolArray) -> None:
    for e in range(len(actions)):
        search = search_at(address, e)
        costs[e] = 0.0
        if not search.over:
            take_step(search, actions[e])
            end_observed(search)
            write_clock(search)
            costs[e] = step_cost_s(search)
        over[e] = search.over


@kernel
def _reseed_at(address: int, keys: NDArray[np.uint64]) -> None:
    for e in range(len(keys)):
        search = search_at(address, e)
        old = search.key
        for column in range(1, search.n_columns + 1):
            record = slot_at(search.slots, column)
            if record.sojourn > 0:
                announced = search.cue_table != 0 and is_about_to_leave(search, column, search.time)
                is_taken(search, column, search.time)
                record.since = record.valid_until = search.time
                record.end_known = False
                search.key = keys[e]
                if search.cue_table != 0 and record.occupied:
                    draw_departure(search, column, announced)
                search.key = old
        search.key = keys[e]


@kernel
def _run_at(fleet: int, policy: int, max_steps: int, cost_s: FloatArray, actions: IntArray) -> None:
    """Write the cost of all steps from now on, and the next action where `actions` has room."""
    for e in range(len(actions)):
        action = call_at(policy, fleet, e)
        actions[e] = action if action < N_ACTIONS else -1
    for e in range(len(cost_s)):
        search = search_at(car_of(fleet, e).search, 0)
        before, steps = sum_of_costs(search), 0
        while not search.over and steps < max_steps:
            action = call_at(policy, fleet, e)
            if 0 <= action < N_ACTIONS:
                take_step(search, action)
            else:
                give_up(search)
            write_clock(search)
            steps += 1
        cost_s[e] = sum_of_costs(search) - before


@kernel
def _probability_at(
    address: int,
    action: int,
    vertex: int,
    time: float,
    attempts: int,
    slots: IntArray,
    taken: BoolArray,
    hit_rate: FloatArray,
    false_alarm_rate: FloatArray,
    evidence: FloatArray,
    p: FloatArray,
) -> None:
    for e in range(len(p)):
        search = search_at(address, e)
        before = search.time
        act(search, action)
        finish_step(search)
        write_clock(search)
        # Observed times are rounded.
        if search.vertex != vertex or abs(search.clock[1] - time) > _SAME_TIME_S:
            p[e] = 0.0
        for i in range(len(slots)):
            at = before if i < attempts else search.time
            column = column_of(search, slots[i])
            rate = hit_rate[i] if is_taken(search, column, at) else false_alarm_rate[i]
            p[e] *= rate if taken[i] else 1.0 - rate
            if evidence[i] != 0.0:
                leaves = is_about_to_leave(search, column, at)
                p[e] /= 1.0 + math.exp(-evidence[i] if leaves else evidence[i])
