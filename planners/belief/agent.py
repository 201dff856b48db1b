"""`belief`: a planner in belief space, for slots that change and are observed while driving."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass
from typing import ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from parkenv.belief.day_belief import EVENT, UNINFORMATIVE_SLOT_PROBABILITY, DayBelief, independent_share
from parkenv.belief.slot_belief import UNOBSERVED, Observations, SlotBelief
from parkenv.compiled.arrays import FloatArray
from parkenv.errors import require_number
from parkenv.world.lot import PARK
from parkenv.world.occupancy.day_error import nearness
from parkenv.world.scenario import SearchProblem
from planners.agent import Observation, SearchAgent, belief_for_decision, require_observations
from planners.belief.best_path import ATTEMPT, NOWHERE, best_path
from planners.belief.path import Budget, Course
from planners.belief.planning_graph import (
    SLOT,
    BeliefSnapshot,
    PathBuffer,
    PlanningGraph,
    path_buffers,
    set_slots,
)
from planners.neighborhood import MOST_VERTICES, Neighborhood, Neighborhoods
from planners.routes import DriveRoutes

FAILURE_COSTS = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0)
"""s, failure costs of the thesis's planner for the initial paths of the search."""
DEPTH = 3  # maximum number of targets before a path follows the thesis's planner
WORK_PER_MS = 50_000  # steps of the path search per millisecond, approximately
WORTH_PASSING_S = 1.0
"""s by which driving on must be better than a known free slot, unless days never differ from their forecast.

If the forecast is right, stopping for a smaller gain costs next to nothing; if it is wrong, the slot that was passed
may have been the last one for a long time.
"""
ROWS = 40  # of the table of drives of a part that are computed at each decision on the way there: some 3 ms
STALE_S = 60.0  # s without a newly observed slot after which the search moves on to another part of the lot
PREVIEW_S = 60.0  # s, horizon of the plan preview
NEWS = 0.1  # excess of P(about to leave) from which a cue is news
_NO_COURSE = Course(np.zeros(0, np.int64), -1, math.nan)


class Crowd(NamedTuple):
    """When a driver came, and what it has seen of other searching cars."""

    arrival_s: float  # s since Monday 00:00, when the search began
    in_view: int = 0  # number of cars in view at the last decision
    met: int = 0  # number of times that one has come into view

    def after(self, observation: Observation) -> Crowd:
        if "cars" not in observation:
            return self
        in_view = int(observation["cars"][0].sum())
        return Crowd(self.arrival_s, in_view, self.met + max(in_view - self.in_view, 0))


@dataclass
class BeliefSearch:
    """What `belief` keeps during one search: its part of the lot, and the path that it follows."""

    # the part of the lot that is planned for. The arrays below cover its slots, in its numbering.
    near: Neighborhood
    crowd: Crowd
    n_unobserved: int  # number of its slots that were unobserved when it was chosen
    day: DayBelief  # belief about the day and, given the day, about the slots
    state: NDArray[np.int8]  # (n_slots,) int8, `SlotBelief.state` at the last decision
    # (n_slots,) float64, the highest detection rate among the views from which a slot was not detected
    missed_rate: FloatArray
    cued: NDArray[np.bool_]  # (n_slots,) whether a car seemed about to leave at the last decision
    time: float  # s since the search began, at the last decision
    # s, the last time at which an unobserved slot of the part was observed, or the part was chosen
    news_at: float
    paths: PathBuffer  # buffers of the path search
    # what was observed before this decision, step by step; empty if the part is the whole lot
    past: list[Observations]
    entry: int = -1  # vertex to drive to before planning, or -1
    # that of the path of the last decision, of up to `DEPTH` targets; its failure cost is nan if there was none
    course: Course = _NO_COURSE
    # s, time that was expected to remain on that path by now; inf if something has been observed since
    remaining_s: float = math.inf
    replans: int = 0  # number of times that the path ahead has changed
    expected_s: float = math.nan  # s, expected time of the search from here

    def copy(self) -> Self:
        """Return a copy that may be moved on without this one; the buffers are shared."""
        other = copy.copy(self)
        other.day, other.state, other.past = self.day.copy(), self.state.copy(), self.past.copy()
        other.missed_rate = self.missed_rate.copy()
        return other


class BeliefAgent(SearchAgent[BeliefSearch]):
    """`belief`: follows the path with the least expected time under optimal stopping.

    **Model.** A slot is free with the forecast probability, unless the day differs from its forecast; the slots
    observed so far are evidence for how it does (`DayBelief`). A slot is revealed when it comes into view; then its
    state decays as a two-state Markov chain, so a free slot may be gone on arrival and a taken one may become free.

    **Search.** Each decision rolls out candidate paths (`rollout_path`): they follow the thesis's planner as if every
    slot that it observes were taken, at several failure costs, and pass up to three inserted vertices first. Each path
    is evaluated by optimal stopping with recall (`evaluate_path`), which counts every slot on the way, and counts taken
    slots as evidence for a full day. The agent takes the first step of the best path; the next decision starts from its
    targets. The time beyond the end of a path is that of driving a part of it repeatedly, or is extrapolated from the
    path if enough slots are unobserved. Where one more observation may prove the lot full, it can be better to avoid
    it.

    **Why it beats the thesis's planner.** The thesis's planner values one slot, the one it drives to, and needs a
    failure cost for everything else; the right cost changes by a factor when the forecast is wrong. It also makes the
    observation that proves a lot full when it would be better to wait for a car to leave. This planner has no cost to
    tune. On small lots its mean time is within 0.1 % of the exact optimum where slots do not change, and within 2 %
    where they do (tests).

    **Where it does not.** If the forecast is right, the thesis's planner with a failure cost tuned to the forecast is
    as close to the best path as this one. Allowing for forecast errors costs a little time on such days. If an event
    has filled a lot against the forecast, drivers who take the first free slot still do better. Each path is
    evaluated on its own, without the option to change to another path after an observation. Estimates depend on the
    position of the car, so it could alternate between two paths forever; until it observes something new, it
    therefore keeps its path, and the slot that it drives to, unless another one is better than the time that this
    path was expected to take, or that time is over. Another observation of a slot that is still taken is not new: the
    path expected it. If a sensor misses slots, a slot that was in view and not detected is observed again only from
    vertices where a detection is more likely than not. A slot that is not detected from its own vertex either is
    attempted.

    Args:
        problem: lot, goal, speeds and costs.
        budget_ms: approximate time of a decision, ms. It limits the amount of work, not the wall time, so the same
            observations give the same actions on every machine.
        day: whether to learn from observations how the day differs from its forecast; if not, the forecast is assumed
            to be right, whatever is observed.
        most_vertices: a larger lot is planned for in part (`Neighborhoods`).
        doubt: probability that the forecast of a slot carries no information, if the day is learned; 0 to 1.
        event: probability that an event has filled the slots near the goal, if the day is learned; 0 to 0.9. It is
            lower in small lots, and where the forecast has many of these slots free.

    Raises:
        InputError: the budget is not positive, `doubt`, `event` or `most_vertices` is out of range, or no slot can be
            observed.
    """

    name: ClassVar[str] = "belief"
    memory: ClassVar = BeliefSearch

    def __init__(
        self,
        problem: SearchProblem,
        budget_ms: float = 1.0,
        day: bool = True,
        most_vertices: int = MOST_VERTICES,
        doubt: float = UNINFORMATIVE_SLOT_PROBABILITY,
        event: float = EVENT,
    ) -> None:
        super().__init__(problem)
        require_observations(self.name, problem)
        require_number("budget_ms", budget_ms, above=0.0)
        require_number("doubt", doubt, least=0.0, most=1.0)
        require_number("event", event, least=0.0, most=0.9)
        self._doubt, self._event = doubt, event
        self._day = day
        self._nearness = nearness(self.problem.walk_s)
        self._evidence = independent_share(self.problem.lot.facility_of_slot)
        self._worth_passing_s = WORTH_PASSING_S if day else 0.0
        self._budget = Budget(np.array(FAILURE_COSTS), int(budget_ms * WORK_PER_MS), DEPTH)
        # s, what a taken slot costs on arrival; with a perfect sensor none is attempted
        self.failure_s = 0.0 if self.problem.sensor_model.perfect else self.problem.failure_s
        self._neighborhoods = Neighborhoods(self.problem, most_vertices)
        self._routes = DriveRoutes(self.problem)

    def compile_ahead(self, belief: SlotBelief) -> None:
        """Compile the search of a path for any belief, which takes as long as all else that a search needs."""
        near = self._neighborhoods.toward(int(self.problem.lot.entry_vertices[0]))
        memory = self._search_of(near, belief, Crowd(0.0))
        self._follow_best_path(int(near.vertices[0]), 0, belief.take(near.slots), memory)

    def begin(self, observation: Observation, belief: SlotBelief) -> BeliefSearch:
        vertex = int(observation["vertex"])
        crowd = Crowd(float(observation["time"][0])).after(observation)
        memory = self._search_of(self._neighborhoods.toward(vertex), belief, crowd)
        memory.time = -1.0
        if memory.near.index(vertex) < 0:
            memory.entry = memory.near.entry
        return memory

    def _search_of(self, near: Neighborhood, belief: SlotBelief, crowd: Crowd) -> BeliefSearch:
        n = near.n_slots
        search: BeliefSearch = self.memory(
            near=near,
            n_unobserved=n,
            crowd=crowd,
            day=self._day_belief(near, belief, crowd),
            state=np.full(n, UNOBSERVED, dtype=np.int8),
            missed_rate=np.zeros(n),
            cued=np.zeros(n, np.bool_),
            time=belief.time,
            news_at=belief.time,
            paths=path_buffers(len(FAILURE_COSTS) + 1, n, len(near.vertices)),
            past=[],
        )
        return search

    def _day_belief(self, near: Neighborhood, belief: SlotBelief, crowd: Crowd) -> DayBelief:
        slots, rival_rates = near.slots, self._rival_rates(belief, crowd)
        return DayBelief(
            belief.take(slots),
            self._nearness[slots],
            certain=not self._day,
            rival_rates=None if rival_rates is None else rival_rates[slots],
            doubt=self._doubt,
            event=self._event,
            evidence=self._evidence[slots],
        )

    def _rival_rates(self, belief: SlotBelief, crowd: Crowd) -> FloatArray | None:
        """Return the rates at which rivals take each slot, (n_slots,) 1/s; None without rivals."""
        return None

    def _planning_graph(self, memory: BeliefSearch) -> PlanningGraph:
        return memory.near.planning_graph(self.problem, self.failure_s)

    def decide(self, observation: Observation, belief: SlotBelief, memory: BeliefSearch) -> int:
        vertex = int(observation["vertex"])
        if not memory.near.whole:
            memory.past.append(belief.observations)
        known = self._update(belief, vertex, memory)
        if memory.entry not in (-1, vertex):
            if belief.time > 0.0:  # The first decision has enough to do.
                memory.near.table.prepare(ROWS)
            return self._routes.move_toward(vertex, memory.entry)
        if memory.entry == vertex:
            memory.entry, memory.news_at = -1, memory.time
        here = memory.near.index(vertex)
        # Search another part if half of the unobserved slots have been observed, or none for a long time.
        half = 2 * np.count_nonzero(memory.state == UNOBSERVED) < memory.n_unobserved
        spent = not memory.near.whole and (half or memory.time - memory.news_at > STALE_S)
        action = None if here < 0 or spent else self._follow_best_path(vertex, here, known, memory)
        if action is None and not memory.near.whole:
            known = self._change_part(belief, vertex, memory)
            if memory.entry >= 0:
                return self._routes.move_toward(vertex, memory.entry)
            action = self._follow_best_path(vertex, memory.near.index(vertex), known, memory)
        return self.wait(vertex) if action is None else action

    def _update(self, belief: SlotBelief, vertex: int, memory: BeliefSearch) -> SlotBelief:
        near = memory.near
        known = belief.take(near.slots)
        state = known.state
        first = np.flatnonzero((state != UNOBSERVED) & (memory.state == UNOBSERVED))
        if len(first):
            memory.news_at = belief.time
        changed = (state != memory.state).any()
        if changed:
            memory.remaining_s = math.inf
        if changed or memory.course.heading in known.observations.slots:
            memory.course = memory.course._replace(heading=-1)
        memory.state = state
        cued = known.cues[: near.n_slots] > NEWS if len(known.cues) else memory.cued
        if (cued & ~memory.cued).any():
            memory.remaining_s = math.inf
        memory.cued = cued
        here = near.index(vertex)
        if belief.time > memory.time:
            memory.day.update(known.observations)
        # Nothing is observed at the moment of arrival.
        if here >= 0 and belief.time > max(memory.time, 0.0):
            views = near.in_view(here)
            seen = np.zeros(near.n_slots, np.bool_)
            seen[known.observations.slots] = True
            missed = views[~seen[views["slot"]]]
            np.maximum.at(memory.missed_rate, missed["slot"], missed["rate"])
        memory.time = belief.time
        return known

    def _follow_best_path(
        self, vertex: int, here: int, known: SlotBelief, memory: BeliefSearch
    ) -> int | None:
        """Return the first action of the best path, or None where there is no path."""
        near, last = memory.near, memory.course
        graph, belief = self._planning_graph(memory), snapshot(here, known, memory)
        choice = best_path(here, last, memory.remaining_s, self._budget, graph, belief, memory.paths)
        memory.course, (expected_s, remaining_s, following) = choice.course, choice.value
        is_same = memory.course.failure_s == last.failure_s and np.array_equal(
            memory.course.targets, last.targets
        )
        memory.replans += not (is_same or math.isnan(last.failure_s))
        # A path that has had its time is given up for a new plan.
        memory.remaining_s = remaining_s if remaining_s > 0.0 else math.inf
        memory.expected_s = min(expected_s, choice.at_hand_s)
        if choice.slot >= 0 and choice.at_hand_s <= expected_s + self._worth_passing_s:
            memory.remaining_s = math.inf
            return PARK if choice.slot == here else near.table.move(here, choice.slot)
        if following == ATTEMPT:
            return PARK
        if following == NOWHERE:
            return None
        if following == here:
            return self.wait(vertex)
        return near.table.move_to(here, following)

    def _change_part(self, belief: SlotBelief, vertex: int, memory: BeliefSearch) -> SlotBelief:
        old = memory.near
        near = self._neighborhoods.around(vertex, np.flatnonzero(belief.observed_taken))
        new = self._search_of(near, belief, memory.crowd)
        _, ours, theirs = np.intersect1d(old.slots, near.slots, assume_unique=True, return_indices=True)
        new.missed_rate[theirs] = memory.missed_rate[ours]
        new.day.carry_over(memory.day, theirs, ours)
        new.past = memory.past
        added = np.where(np.isin(near.slots, old.slots), -1, near.slots)
        for observations in new.past:
            new.day.update(observations.take(added))
        new.course, new.replans = new.course._replace(failure_s=memory.course.failure_s), memory.replans
        # Update in place: the caller keeps `memory`.
        vars(memory).update(vars(new))
        memory.entry = -1 if near.entry == vertex else near.entry
        known = self._update(belief, vertex, memory)
        memory.n_unobserved = int(np.count_nonzero(memory.state == UNOBSERVED))
        return known

    def plan_preview(self, observation: Observation, action: int, memory: BeliefSearch) -> tuple[int, ...]:
        """Return the path that the agent would drive if it observed only taken slots."""
        belief = belief_for_decision(observation)
        imagined = memory.copy()
        problem, vertex, path = self.problem, int(observation["vertex"]), list[int]()
        end = belief.time + PREVIEW_S
        while action != PARK:
            following = int(problem.lot.neighbors[vertex, action])
            if following < 0 or following in path or following == observation["vertex"] or belief.time > end:
                break
            belief = belief.decay(float(problem.move_s[vertex, action]))
            vertex = following
            path.append(vertex)
            shown = problem.in_view(vertex)
            belief = belief.update(shown, ~belief.observed_free[shown])
            action = self.decide({"vertex": vertex}, belief, imagined)
        return tuple(path)


def snapshot(here: int, known: SlotBelief, memory: BeliefSearch) -> BeliefSnapshot:
    slots = np.empty(len(memory.state), SLOT)
    slots["missed_rate"], slots["state"] = memory.missed_rate, memory.state
    belief = BeliefSnapshot(slots, *memory.day.mixture())
    drive_s = memory.near.table.seconds[here]
    set_slots(belief, known.parts, known.cues, known.time, memory.day.p_occupied(known.time), drive_s)
    return belief
