"""`belief`: a planner for the search as it is, not as the thesis models it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from parkenv.errors import InputError
from parkenv.world.lot import PARK
from parkenv.world.scenario import SearchProblem
from planners.agent import Observation, SearchAgent, require_sight
from planners.belief.best_path import NOWHERE, TRY, Budget, best_path
from planners.belief.forecast_error import MapDoubt
from planners.belief.planning_graph import LOOKS_FREE, LOOKS_TAKEN, UNSEEN, Outlook, Path, new_path
from planners.neighborhood import MOST_VERTICES, Neighborhood, Neighborhoods
from planners.routes import DriveRoutes

FloatArray = NDArray[np.float64]

COSTS = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0)
"""Failure costs, s, with which the thesis's planner lays the paths that the search starts from."""
DEPTH = 3
"""Targets that a path may have before the thesis's planner goes on."""
WORK_PER_MS = 50_000
"""Steps of the path search that take about a millisecond."""
USUAL_STAY = 7200.0
"""How long a car is thought to stay, s, until ageing sightings tell."""
WORTH_PASSING_S = 1.0
"""s that driving on must promise over a free slot at hand, unless the map is taken at its word.

Where the map is right, next to nothing is lost by not driving on for less than that; where it is wrong, the slot passed
may have been the last one for long.
"""
STALE_S = 60.0
"""s without a slot that was not seen before, after which it is time to look beyond the part of the lot."""


@dataclass
class Search:
    """What the agent remembers of an episode.

    Attributes:
        forecast: (n_slots,) float32, the belief in all slots of the lot before anything was seen.
        near: the part of the lot that is planned for. The next six are of its slots, with its numbers.
        n_unseen: how many of its slots had not been seen when it was chosen.
        doubt: how far the forecast is thought to be off.
        kind: (n_slots,) int8, UNSEEN, LOOKS_FREE or LOOKS_TAKEN at the last look.
        looked_at: (n_slots,) float64, s, when each slot was last in view.
        missed: (n_slots,) float64, the greatest rate of a view from which each slot was not made out.
        p_occupied: (n_slots,) float32, the last observation's.
        time: s since the search began, of the last observation.
        news: s, when a slot of that part was last seen for the first time, or the part was chosen.
        leaving: (n_slots,) float64, 1/s, the rate at which a parked car leaves; NaN where nothing has told yet.
        targets: (DEPTH,) int64, what the path of the last decision goes past first, as the part numbers it.
        path: room for one.
        gate: the vertex that the car drives to before it plans, or -1.
        n_targets: how many targets there are.
        cost: s, the failure cost with which that path goes on.
        promise_s: s, what that path was expected to leave by now, unless something has been seen since; else inf.
        replans: how often the path ahead has changed.
        expected_s: s, what the search is expected to take from here.
    """

    forecast: NDArray[np.float32]
    near: Neighborhood
    n_unseen: int
    doubt: MapDoubt
    kind: NDArray[np.int8]
    looked_at: FloatArray
    missed: FloatArray
    p_occupied: NDArray[np.float32]
    time: float
    news: float
    leaving: FloatArray
    targets: NDArray[np.int64]
    path: Path
    gate: int = -1
    n_targets: int = 0
    cost: float = COSTS[1]
    promise_s: float = math.inf
    replans: int = 0
    expected_s: float = math.nan


class BeliefAgent(SearchAgent[Search]):
    """`belief`: drives the path on which stopping at the best moment is expected to take the least time.

    Model: a slot is free with the probability that the map gives, unless the map is off in one of several ways, of
    which the slots seen so far tell (`MapDoubt`); it is revealed when it comes in view; once seen, its state lasts and
    decays as a two-state chain, so a free slot may be gone on arrival and a taken one may come free. At each
    decision candidate paths are laid: as the thesis's planner would go on if all that it sees were taken, at several
    failure costs, and past up to three vertices put in before. Each is valued by optimal stopping with recall
    (`path_worth`), so whatever lies on the way counts, and so does that taken slots make the map more doubtful; the
    best one's first step is taken, and its targets are where the next decision starts from. Where a path ends, a part
    of it is driven again and again, or what it found so far is extrapolated where enough slots are left to see; and
    where one more look may prove the lot full, the look may be left out.

    Why it wins over the thesis's planner: that one values the one slot it drives to and needs a failure cost to stand
    for all else, which goes wrong by a factor where the map is wrong; and it makes the look that proves a lot full
    where it had better wait for a car to leave. This one has no cost to tune; on small lots it stays within a
    thousandth of the exact optimum on average where slots last, and within 2 % where they change (tests). Where it
    does not win: where the map is right, the thesis's planner with its failure cost tuned to the forecast is as good,
    for then it is as near to the best path as this one is. Doubting the map costs a little on such days; where an
    event has filled a lot against the map, those who take the first free slot that they see still do better. What is
    valued is one path at a time, so it is not foreseen that the car leaves the path for another one after a sighting.
    Estimates differ by where the car is, so that it could turn round between two paths for ever: until it sees
    something, it keeps to its path unless another is better than what that one had promised.

    What it may know: rates are not observed, so the rate at which cars leave is read off the way in which a slot's
    belief decays once it is out of view; until then stays of two hours are assumed, and no look
    is left out in the hope that a car leaves. Where sight is imperfect, a slot that was in view and not made out is
    looked for only from where it is likelier than not to be seen then; one that does not show from its own vertex
    either is tried.

    Args:
        problem: lot, goal, speeds and costs.
        budget_ms: about how long a decision may take, ms. It is counted in work, not on the clock, so
            that the same observations give the same actions on every machine.
        trusting: whether the map is taken at its word, without `MapDoubt`.
        most_vertices: a lot with more is planned for in part (`Neighborhoods`).

    Raises:
        InputError: a budget that is not positive, a bad `most_vertices`, or a problem in which nothing is seen.
    """

    name: ClassVar[str] = "belief"

    def __init__(
        self,
        problem: SearchProblem,
        budget_ms: float = 5.0,
        trusting: bool = False,
        most_vertices: int = MOST_VERTICES,
    ) -> None:
        super().__init__(problem)
        require_sight(self.name, problem)
        if not (budget_ms > 0.0 and math.isfinite(budget_ms)):
            raise InputError(f"budget_ms is {budget_ms}, want a finite number above 0")
        self.trusting = trusting
        self._budget = Budget(np.array(COSTS), int(budget_ms * WORK_PER_MS), DEPTH)
        # Where a slot is seen for what it is, nobody tries a taken one.
        self._failure_s = 0.0 if self.problem.sensor_model.perfect else self.problem.failure_s
        self._neighborhoods = Neighborhoods(self.problem, most_vertices)
        self._routes = DriveRoutes(self.problem)

    def begin(self, observation: Observation) -> Search:
        """Nothing seen yet."""
        forecast = np.array(observation["p_occupied"])
        vertex = int(observation["vertex"])
        memory = self._search(self._neighborhoods.toward(vertex), forecast, float(observation["time"][1]))
        if memory.near.place(vertex) < 0:
            memory.gate = memory.near.gate
        return memory

    def _search(self, near: Neighborhood, forecast: NDArray[np.float32], time: float) -> Search:
        n, p = near.n_slots, forecast[near.slots]
        return Search(
            forecast=forecast,
            near=near,
            n_unseen=n,
            doubt=MapDoubt(p.astype(np.float64), near.walk_s, self.trusting),
            kind=np.full(n, UNSEEN, dtype=np.int8),
            looked_at=np.zeros(n),
            missed=np.zeros(n),
            p_occupied=p,
            time=time,
            news=time,
            leaving=np.full(n, np.nan),
            targets=np.zeros(DEPTH, dtype=np.int64),
            path=new_path(n, len(near.vertices)),
        )

    def decide(self, observation: Observation, memory: Search) -> int:
        """Take in what was seen, search for the best path, and go its first step or to the slot to settle for."""
        vertex = int(observation["vertex"])
        self._take_in(observation, vertex, memory)
        if memory.gate not in (-1, vertex):
            return self._routes.move_toward(vertex, memory.gate)
        if memory.gate == vertex:
            memory.gate, memory.news = -1, memory.time
        here = memory.near.place(vertex)
        # Half of what there was to see has been seen, or nothing new for long: time to look farther.
        half = 2 * _n_unseen(memory.kind) < memory.n_unseen
        spent = not memory.near.whole and (half or memory.time - memory.news > STALE_S)
        action = None if here < 0 or spent else self._act(vertex, here, memory)
        if action is None and not memory.near.whole:
            self._move_on(observation, vertex, memory)
            if memory.gate >= 0:
                return self._routes.move_toward(vertex, memory.gate)
            action = self._act(vertex, memory.near.place(vertex), memory)
        return self._wait(vertex) if action is None else action

    def _act(self, vertex: int, here: int, memory: Search) -> int | None:
        """What the best path begins with, or None where there is none."""
        near = memory.near
        before = memory.targets[: memory.n_targets].tolist(), memory.cost
        choice = best_path(
            here,
            memory.targets,
            memory.n_targets,
            memory.cost,
            memory.promise_s,
            self._budget,
            near.ground(self.problem, self._failure_s),
            self._outlook(here, memory),
            memory.path,
        )
        memory.n_targets, memory.cost = choice.n_targets, choice.cost
        memory.promise_s = choice.then_s
        memory.expected_s = min(choice.onward_s, choice.at_hand_s)
        memory.replans += before != (memory.targets[: memory.n_targets].tolist(), memory.cost)
        worth_passing_s = 0.0 if self.trusting else WORTH_PASSING_S
        if choice.slot >= 0 and choice.at_hand_s <= choice.onward_s + worth_passing_s:
            memory.promise_s = math.inf
            return PARK if choice.slot == here else near.table.move(here, choice.slot)
        if choice.following == TRY:
            return PARK
        if choice.following == NOWHERE:
            return None
        return self._wait(vertex) if choice.following == here else near.table.move_to(here, choice.following)

    def _move_on(self, observation: Observation, vertex: int, memory: Search) -> None:
        """Plan for the part of the lot around the car from now on, and take along what is known of it."""
        old = memory.near
        taken = np.flatnonzero(np.asarray(observation["p_occupied"]) > memory.forecast)
        near = self._neighborhoods.around(vertex, taken)
        new = self._search(near, memory.forecast, memory.time)
        _, ours, theirs = np.intersect1d(old.slots, near.slots, assume_unique=True, return_indices=True)
        for known in ("looked_at", "missed", "leaving"):
            getattr(new, known)[theirs] = getattr(memory, known)[ours]
        new.cost, new.replans = memory.cost, memory.replans
        # The caller holds on to `memory`.
        vars(memory).update(vars(new))
        memory.gate = -1 if near.gate == vertex else near.gate
        self._take_in(observation, vertex, memory)
        memory.n_unseen = _n_unseen(memory.kind)

    def _take_in(self, observation: Observation, vertex: int, memory: Search) -> None:
        p, time = np.asarray(observation["p_occupied"])[memory.near.slots], float(observation["time"][1])
        forecast = memory.forecast[memory.near.slots]
        near, in_view, here = memory.near, np.zeros(len(p), dtype=np.bool_), memory.near.place(vertex)
        view = slice(0, 0) if here < 0 else slice(*near.view_starts[here : here + 2])
        in_view[near.view_slots[view]] = True
        self._watch_ageing(p, forecast, time, in_view, memory)
        kind = np.where(p < forecast, LOOKS_FREE, np.where(p > forecast, LOOKS_TAKEN, UNSEEN))
        first = np.flatnonzero((kind != UNSEEN) & (memory.kind == UNSEEN))
        memory.news = time if len(first) else memory.news
        memory.doubt.look(first, kind[first] == LOOKS_TAKEN)
        # A sighting that has quite faded leaves the slot as good as unseen, but it was a first look once.
        kind = np.where(kind == UNSEEN, memory.kind, kind).astype(np.int8)
        if (kind != memory.kind).any():
            memory.promise_s = math.inf
        memory.kind = kind
        memory.looked_at[in_view] = time
        if time > memory.time:
            # Who has just arrived has not looked yet.
            hidden = np.where(memory.kind[near.view_slots[view]] == UNSEEN, near.view_rates[view], 0.0)
            np.maximum.at(memory.missed, near.view_slots[view], hidden)
        memory.p_occupied, memory.time = p, time

    def _watch_ageing(
        self,
        p: NDArray[np.float32],
        forecast: NDArray[np.float32],
        time: float,
        in_view: NDArray[np.bool_],
        memory: Search,
    ) -> None:
        """Read the rate at which cars leave off the beliefs that have grown older."""
        elapsed = time - memory.time
        if not elapsed > 0.0:
            return
        forecast = forecast.astype(np.float64)
        was, now = memory.p_occupied - forecast, p - forecast
        ageing = np.flatnonzero(
            ~in_view & (np.abs(was) > 0.05) & (now * was > 0.0) & (np.abs(now) <= np.abs(was))
        )
        rate = np.log(was[ageing] / now[ageing]) / elapsed
        memory.leaving[ageing] = rate * (1.0 - forecast[ageing])

    def _outlook(self, here: int, memory: Search) -> Outlook:
        told = memory.leaving[np.isfinite(memory.leaving)]
        typical = float(np.median(told)) if len(told) else 1.0 / USUAL_STAY
        leaving = np.where(np.isfinite(memory.leaving), memory.leaving, typical)
        weights, free_if = memory.doubt.mixture()
        usual = np.maximum(weights @ free_if, 1e-6)
        rate = leaving / usual
        seen_free = memory.kind == LOOKS_FREE
        free = np.where(memory.kind == UNSEEN, usual, 1.0 - memory.p_occupied.astype(np.float64))
        # The observation ages by the map; a lot that is fuller than the map takes free slots faster.
        kept = usual + (1.0 - usual) * np.exp(-rate * (memory.time - memory.looked_at))
        free = np.where(seen_free, np.minimum(free, kept), free)
        drive = memory.near.table.seconds[here, : len(free)]
        there = usual + (free - usual) * np.exp(-rate * np.where(np.isfinite(drive), drive, 0.0))
        odds = np.divide(1.0 - there, there, out=np.full(len(free), np.inf), where=there > 0.0)
        of_slots = np.ascontiguousarray(free_if.T)
        return Outlook(
            memory.kind,
            free,
            weights,
            of_slots,
            usual,
            rate,
            odds,
            1.0 / usual - 1.0,
            memory.missed,
            len(told) > 0,
        )

    def _wait(self, vertex: int) -> int:
        """A move that the graph does not have; where it has all four, the shortest."""
        missing = np.flatnonzero(self.problem.lot.neighbors[vertex] < 0)
        return int(missing[0]) if len(missing) else int(self.problem.move_s[vertex].argmin())


def _n_unseen(kind: NDArray[np.int8]) -> int:
    return int((kind == UNSEEN).sum())
