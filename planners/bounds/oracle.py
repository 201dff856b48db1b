"""The clairvoyant lower bound: the least total time of an episode, and an agent that knows every slot's future."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from parkenv.belief.slot_belief import SlotBelief
from parkenv.world.lot import MOVES, PARK
from parkenv.world.occupancy.process import World
from parkenv.world.scenario import SearchProblem
from planners.agent import Observation, SearchAgent
from planners.routes import DriveRoutes

_ASKED_AT_ONCE = 64  # slots, in one question to a world


@dataclass(frozen=True)
class BestSlot:
    slot: int  # its index; -1 if no slot ever becomes free
    wait_s: float  # s between the earliest possible arrival and parking
    total_s: float  # s, drive, wait and arrival cost; inf if there is none


def best_slot(
    problem: SearchProblem, routes: DriveRoutes, world: World, vertex: int, time: float, wait_s: float = 0.0
) -> BestSlot:
    """Find the slot that minimises drive, wait and arrival cost.

    Occupancy does not depend on the car, so arriving as early as possible and waiting is never worse than arriving
    later. With waits of any length (`wait_s` 0) the minimum over slots is therefore a lower bound for every search that
    ends in a slot. An agent that does not park pays `give_up_s`, so the total of any agent is at least the smaller of
    the two. With `wait_s` above 0 the car waits in steps of that length, as in the environment, and misses a slot that
    is free only between two steps.

    The car is at `vertex` at `time`, s since Monday 00:00.
    """
    arrival = time + routes.seconds_from(vertex)[: problem.lot.n_slots]
    cost_s = problem.arrival_cost_s
    earliest = arrival - time + cost_s
    best = BestSlot(-1, 0.0, np.inf)
    order = np.argsort(earliest)
    for start in range(0, len(order), _ASKED_AT_ONCE):
        slots = order[start : start + _ASKED_AT_ONCE]
        # Slots are in the order of earliest arrival: later ones cannot win even without a wait.
        if not earliest[slots[0]] < best.total_s:
            break
        for slot, free_from in zip(slots, world.next_free(slots, time), strict=True):
            if not earliest[slot] < best.total_s:
                break
            latest = time + best.total_s - cost_s[slot]
            parked = _first_free(world, int(slot), float(arrival[slot]), wait_s, latest, float(free_from))
            if parked < latest:
                best = BestSlot(int(slot), parked - arrival[slot], parked - time + cost_s[slot])
    return best


def _first_free(
    world: World, slot: int, arrival: float, wait_s: float, latest: float, free_from: float
) -> float:
    """Return the first time, s, at `arrival` or whole waits later, when the slot is free; inf if after `latest`.

    `free_from`, s, is the first time from some earlier moment on.
    """
    slots = np.array([slot])
    moment = arrival
    while moment < latest:
        free = free_from if free_from >= moment else float(world.next_free(slots, moment)[0])
        if free <= moment or wait_s == 0.0:
            return free
        moment += np.ceil((free - moment) / wait_s) * wait_s
    return np.inf


@dataclass
class OracleState:
    slot: int  # the target; -1 if it proves the lot full, or if no slot ever becomes free
    waits: int  # number of waits before it drives there
    # (n_slots,) bool, slots still to be observed to prove the lot full; None if it parks
    unobserved: NDArray[np.bool_] | None = None


class OracleAgent(SearchAgent[OracleState]):
    """`oracle`: drives to the slot with the least total time and arrives when it is free.

    It receives the world in `prepare` before each episode; no other agent has access to hidden state. If giving up is
    cheaper than waiting for any slot, it proves the lot full by a nearest-neighbour tour of the unobserved slots. Like
    every agent it waits in steps of `wait_s`, and its tour may not be the shortest, so its total can exceed the bound
    from `best_slot`.
    """

    name: ClassVar[str] = "oracle"

    def __init__(self, problem: SearchProblem) -> None:
        super().__init__(problem)
        self.routes = DriveRoutes(self.problem)
        self._world: World | None = None
        self._time = 0.0

    def prepare(self, world: World, time: float) -> None:
        """Receive the world of the next episode and its start time, s since Monday 00:00."""
        self._world, self._time = world, time

    def begin(self, observation: Observation, belief: SlotBelief) -> OracleState:
        if self._world is None:
            raise RuntimeError("the oracle was not shown the world: call prepare(world, time) after reset()")
        vertex, give_up_s = int(observation["vertex"]), self.problem.give_up_s
        best = best_slot(self.problem, self.routes, self._world, vertex, self._time, self.problem.wait_s)
        if best.total_s > give_up_s and self._tour_s(vertex, best.total_s - give_up_s) < np.inf:
            return OracleState(-1, 0, np.ones(self.problem.lot.n_slots, dtype=np.bool_))
        return self._bound_for(best, vertex)

    def _bound_for(self, best: BestSlot, vertex: int) -> OracleState:
        waits = round(best.wait_s / self.problem.wait_s)
        return OracleState(best.slot, waits + self._extra_waits(vertex, best.slot, waits) if waits else 0)

    def decide(self, observation: Observation, belief: SlotBelief, memory: OracleState) -> int:
        assert self._world is not None
        vertex, now = int(observation["vertex"]), self._time + belief.time
        can_wait = not observation["action_mask"][: len(MOVES)].all()
        wait = self.wait(vertex)
        if memory.unobserved is not None:
            memory.unobserved[self.problem.in_view(vertex)] = False
            nearest, _ = self.routes.nearest(vertex, memory.unobserved)
            if len(nearest):
                return self.routes.move_toward(vertex, int(nearest[0]))
            # All reachable slots were observed, but the lot is not proven full: an unreachable slot is free.
            best = best_slot(self.problem, self.routes, self._world, vertex, now, self.problem.wait_s)
            vars(memory).update(vars(self._bound_for(best, vertex)))
        elif self.problem.cues is not None:
            # Cars that move out may have been in the way.
            best = best_slot(self.problem, self.routes, self._world, vertex, now, self.problem.wait_s)
            vars(memory).update(vars(self._bound_for(best, vertex)))
        if memory.slot < 0:
            return wait
        if memory.waits > 0 and can_wait:
            memory.waits -= 1
            return wait
        if vertex != memory.slot:
            return self.routes.move_toward(vertex, memory.slot)
        return PARK if self._world.next_free(np.array([vertex]), now)[0] <= now else wait

    def plan_preview(self, observation: Observation, action: int, memory: OracleState) -> tuple[int, ...]:
        return self.routes.path(int(observation["vertex"]), memory.slot)

    def _extra_waits(self, vertex: int, slot: int, waits: int) -> int:
        """Return the number of extra waits so that it never observes the whole lot taken, which would end the search.

        If the route shows every slot, the target must be free when it comes into view, not just on arrival.
        """
        assert self._world is not None
        shown = np.zeros(self.problem.lot.n_slots, dtype=np.bool_)
        shown[self.problem.in_view(vertex)] = True
        driven, in_view_after = 0.0, 0.0 if shown[slot] else np.inf
        for move, following in self.routes.hops(vertex, slot):
            driven += float(self.problem.move_s[vertex, move])
            vertex = following
            shown[self.problem.in_view(vertex)] = True
            if shown[slot]:
                in_view_after = min(in_view_after, driven)
        if not shown.all():
            return 0
        target = np.array([slot])
        for more in range(1000):
            start = self._time + (waits + more) * self.problem.wait_s
            moments = (start + in_view_after, start + driven)
            if all(self._world.next_free(target, t)[0] <= t for t in moments):
                return more
        return 0

    def _tour_s(self, vertex: int, at_most: float) -> float:
        """Return the time, s, to observe every slot; inf if it exceeds `at_most` or a slot is unreachable."""
        unobserved = np.ones(self.problem.lot.n_slots, dtype=np.bool_)
        unobserved[self.problem.in_view(vertex)] = False
        total = 0.0
        while unobserved.any():
            nearest, seconds = self.routes.nearest(vertex, unobserved)
            total += seconds
            if not total < at_most:
                return np.inf
            # Slots observed on the way are ignored: an upper bound is enough.
            vertex = int(nearest[0])
            unobserved[self.problem.in_view(vertex)] = False
        return total
