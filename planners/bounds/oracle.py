"""The clairvoyant: it knows every slot's whole future, and so bounds every agent from below."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from parkenv.world.lot import MOVES, PARK
from parkenv.world.scenario import SearchProblem
from planners.agent import Observation, SearchAgent
from planners.routes import DriveRoutes


class Future(Protocol):
    """What the oracle is shown: when slots will be free."""

    def next_free(self, slots: NDArray[np.int64], time: float) -> NDArray[np.float64]:
        """Earliest time, (k,) s, from `time` on at which each slot is free; inf if never."""
        ...


@dataclass(frozen=True)
class Choice:
    """The best there is: which slot, the wait before it is free, and the total; slot -1 and inf if none is.

    Attributes:
        slot: where to park.
        wait_s: s, how much later than it could be there the car parks.
        total_s: s, drive, wait and walk.
    """

    slot: int
    wait_s: float
    total_s: float


def best_slot(
    problem: SearchProblem,
    routes: DriveRoutes,
    future: Future,
    vertex: int,
    time: float,
    wait_s: float = 0.0,
) -> Choice:
    """The slot that minimises drive, wait and walk.

    Slots come and go whatever the car does, so to arrive as early as possible and to wait is never worse
    than to arrive later: with waits of any length (`wait_s` 0) the minimum over slots bounds every search
    that ends in a slot. An agent that does not park pays `give_up_s`, so no agent's total is below the
    smaller of the two. With `wait_s` above 0 waits come in such steps, as in the environment, and a slot
    that comes free between two of them for less than a step is missed.
    """
    arrival = time + routes.seconds_from(vertex)[: problem.lot.n_slots]
    earliest = arrival - time + problem.walk_s
    best = Choice(-1, 0.0, np.inf)
    for slot in np.argsort(earliest):
        # In this order, what comes later cannot even win without a wait.
        if not earliest[slot] < best.total_s:
            break
        latest = time + best.total_s - problem.walk_s[slot]
        parked = _first_free(future, int(slot), float(arrival[slot]), wait_s, latest)
        if parked < latest:
            best = Choice(int(slot), parked - arrival[slot], parked - time + problem.walk_s[slot])
    return best


def _first_free(future: Future, slot: int, arrival: float, wait_s: float, latest: float) -> float:
    """When a car that is there from `arrival` on, or comes whole waits later, can park, s; inf if too late."""
    slots = np.array([slot])
    moment = arrival
    while moment < latest:
        free = float(future.next_free(slots, moment)[0])
        if free <= moment or wait_s == 0.0:
            return free
        moment += np.ceil((free - moment) / wait_s) * wait_s
    return np.inf


@dataclass
class Foresight:
    """What the oracle remembers.

    Attributes:
        slot: the one that it goes for; -1 where it wants to prove the lot full, or none ever comes free.
        waits: how many waits to make before it drives there.
        unseen: (n_slots,) bool, what is left to see of a lot that it wants to prove full; None otherwise.
    """

    slot: int
    waits: int
    unseen: NDArray[np.bool_] | None = None


class OracleAgent(SearchAgent[Foresight]):
    """`oracle`: goes to the best slot that there will be, and arrives when it is free.

    It has to be shown the future with `reveal` before each episode; nothing else is told hidden state.
    Where nothing comes free for so long that giving up is cheaper, it proves the lot full, by a tour from
    each slot to the nearest one not yet seen. It waits in steps of `wait_s`, as everybody must, and its tour
    need not be the shortest, so its total may exceed the bound that `best_slot` gives.
    """

    name: ClassVar[str] = "oracle"

    def __init__(self, problem: SearchProblem) -> None:
        super().__init__(problem)
        self.routes = DriveRoutes(problem)
        self._future: Future | None = None
        self._time = 0.0

    def reveal(self, future: Future, time: float) -> None:
        """Show the world of the episode about to begin, and its exact starting time, s."""
        self._future, self._time = future, time

    def begin(self, observation: Observation) -> Foresight:
        """Choose the slot, or to give up."""
        if self._future is None:
            raise RuntimeError("the oracle was not shown the future: call reveal(world, time) after reset()")
        vertex, time = int(observation["vertex"]), self._time
        choice = best_slot(self.problem, self.routes, self._future, vertex, time, self.problem.wait_s)
        give_up_s = self.problem.give_up_s
        if choice.total_s > give_up_s and self._tour_s(vertex, choice.total_s - give_up_s) < np.inf:
            return Foresight(-1, 0, np.ones(self.problem.lot.n_slots, dtype=np.bool_))
        return self._going_for(choice, vertex)

    def _going_for(self, choice: Choice, vertex: int) -> Foresight:
        waits = round(choice.wait_s / self.problem.wait_s)
        return Foresight(choice.slot, waits + self._hidden_waits(vertex, choice.slot, waits) if waits else 0)

    def decide(self, observation: Observation, memory: Foresight) -> int:
        """Wait, drive there, and park when the slot is free; or drive on along the tour."""
        assert self._future is not None
        vertex = int(observation["vertex"])
        missing = np.flatnonzero(observation["action_mask"][: len(MOVES)] == 0)
        wait = int(missing[0]) if len(missing) else 0
        if memory.unseen is not None:
            memory.unseen[self._in_view(vertex)] = False
            target, seconds = self._nearest_unseen(vertex, memory.unseen)
            if np.isfinite(seconds):
                return self.routes.move_toward(vertex, target)
            # All was seen, and yet the lot is not proven full: a slot that nobody can drive to is free.
            now = self._time + float(observation["time"][1])
            choice = best_slot(self.problem, self.routes, self._future, vertex, now, self.problem.wait_s)
            vars(memory).update(vars(self._going_for(choice, vertex)))
        if memory.slot < 0:
            return wait
        if memory.waits > 0 and len(missing):
            memory.waits -= 1
            return wait
        if vertex != memory.slot:
            return self.routes.move_toward(vertex, memory.slot)
        now = self._time + float(observation["time"][1])
        return PARK if self._future.next_free(np.array([vertex]), now)[0] <= now else wait

    def _hidden_waits(self, vertex: int, slot: int, waits: int) -> int:
        """How many waits to add so that it never sees the whole lot taken, which would end the search.

        It waits before it drives, so what it sees on the way matters only where the way shows every slot:
        then the one that it goes for must be free when it comes in view, not just on arrival.
        """
        assert self._future is not None
        shown = np.zeros(self.problem.lot.n_slots, dtype=np.bool_)
        shown[self._in_view(vertex)] = True
        driven = 0.0
        in_view_after = 0.0 if shown[slot] else np.inf
        for move, following in self.routes.way(vertex, slot):
            driven += float(self.problem.move_s[vertex, move])
            vertex = following
            shown[self._in_view(vertex)] = True
            if shown[slot]:
                in_view_after = min(in_view_after, driven)
        if not shown.all():
            return 0
        target = np.array([slot])
        for more in range(1000):
            start = self._time + (waits + more) * self.problem.wait_s
            moments = (start + in_view_after, start + driven)
            if all(self._future.next_free(target, t)[0] <= t for t in moments):
                return more
        return 0

    def _in_view(self, vertex: int) -> NDArray[np.int64]:
        starts, slots = self.problem.slots_in_view
        return slots[starts[vertex] : starts[vertex + 1]]

    def _nearest_unseen(self, vertex: int, unseen: NDArray[np.bool_]) -> tuple[int, float]:
        """The next slot of a tour and the drive to it, s; -1 and inf where none is within reach."""
        slots, seconds = self.routes.nearest(vertex, unseen)
        return int(slots[0]) if len(slots) else -1, seconds

    def _tour_s(self, vertex: int, at_most: float) -> float:
        """How long it takes to see every slot, s; inf where that is over `at_most`, or some are out of reach."""
        unseen = np.ones(self.problem.lot.n_slots, dtype=np.bool_)
        unseen[self._in_view(vertex)] = False
        total = 0.0
        while unseen.any():
            target, seconds = self._nearest_unseen(vertex, unseen)
            total += seconds
            if not total < at_most:
                return np.inf
            # What is seen in passing is left out: an upper bound is good enough.
            vertex = target
            unseen[self._in_view(vertex)] = False
        return total
