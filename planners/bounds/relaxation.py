"""A lower bound on the mean total time of every agent: information relaxation with penalties.

The clairvoyant bound gives a car the future of all slots, so it is far below the result of any agent. Here a car pays
for additional information (Brown, Smith and Sun, *Information relaxations and duality in stochastic dynamic
programs*, Operations Research 58, 2010). The slots are divided into groups. A car that observes a slot of a group
learns when each slot of the group is free first, and it knows the day: more than an agent. In return it pays the
*penalty* of the group, which may be negative:

    mean over the possible states of the group of value(information) - value(information in this world).

Given the day slots are independent, so whatever the car has done, the mean of the penalty is zero. Therefore no agent
has a lower mean than the mean, over worlds, of the best that a car with all knowledge of its world can do, penalties
included. That is a shortest path over the sets of groups that have been seen, and holds for any `value`. The bound is
close where `value` is nearly the least expected time from there: it is that of a car that remembers the best known
slot, by dynamic programming over (set of groups, where the last one came into view, that slot).

What is loose: the day is known; a whole group is seen at once; and when the taken slots of seen groups become free is
known.
"""

import heapq
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.hierarchy import fcluster, linkage

from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.compiled.jit import compiled
from parkenv.errors import InputError, require_whole
from parkenv.world.occupancy.process import SlotLaw, World
from parkenv.world.scenario import SearchProblem
from planners.bounds.oracle import best_slot
from planners.routes import DriveRoutes

# Slots in groups, those with the least drive and walk. To park elsewhere costs at least as much as the next one.
MOST_SLOTS = 240
# Most pairs of a set of seen groups and the vertex where the last came into view: so fine are the groups.
MOST_STATES = 4_000
FINE_S = 25.0  # s by which a slot must be worse than the best one for a group to be e times as wide there
# Ends of the periods of waiting that `value` tells apart, in units of what a search takes if nothing is found.
PERIODS = np.array([0.1, 0.25, 0.5, 1.0, 2.0, 4.0])
_MOST_GROUPS = 62  # bits of a set
_FAR_S = 3600.0
_SURE = 1e-12


class _Ways(NamedTuple):
    """How groups come into view on the ways from a vertex.

    A state is a set of seen groups, and the vertex from which the last of them came into view. Sets are bit masks in
    ascending order, so a state's successors stand behind it.
    """

    sets: IntArray  # (n_sets,)
    first: IntArray  # (n_sets + 1,) first state of each set
    slot_s: FloatArray  # (n_states, n) drive to each seen slot that shows nothing new, s; inf for the others
    direct_s: FloatArray  # (n_states, n) shortest drive to each seen slot, s; inf for the others
    earliest_s: FloatArray  # (n_states,) s, least time to get there
    first_next: IntArray  # (n_sets + 1,) first of each set's successors
    next_state: IntArray
    first_drive: IntArray  # (n_sets + 1,) where the set's drives begin
    drive_s: FloatArray  # for each set, a row for each state and a column for each successor, s


class _Start(NamedTuple):
    """What the bound needs to know of a vertex where searches begin."""

    slots: IntArray  # (n,) the slots in groups
    group: IntArray  # (n,) the group of each
    beyond_s: float  # s, least time of parking in any other slot
    ways: _Ways


class _News(NamedTuple):
    """Information that a car may get when it observes a group: for each slot one item, or none.

    That is: the slot is free on arrival; it becomes free in some period of waiting.
    """

    slot: IntArray  # (m,)
    chance: FloatArray  # (m,)
    group: IntArray  # (n,) of each slot


class SearchBound:
    """`bound`: what every agent takes at least in the mean. It drives no car.

    Args:
        problem: lot, goal, speeds, costs and view range.
        most_states: limits how fine the groups are, and so the time of a bound.
    """

    name: ClassVar[str] = "bound"

    def __init__(self, problem: SearchProblem, most_states: int = MOST_STATES) -> None:
        require_whole("most_states", most_states, least=1)
        self._problem, self._most_states = problem, most_states
        self._routes = DriveRoutes(problem)
        self._starts: dict[int, _Start | None] = {}

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[Any, Any]:
        raise InputError("bound drives no car: it is what agents take at least; want it in parkenv compare")

    def of_world(self, world: World, vertex: int, time: float) -> float:
        """Return the bound of one world, s; their mean is the bound, a single search may take less.

        Where the law of the slots is not known, as in a log, or cars show that they leave, it is the clairvoyant bound.
        The search begins at `vertex` at `time`, s since Monday 00:00.
        """
        law = None if self._problem.cues is not None else world.law()
        if law is None:
            best = best_slot(self._problem, self._routes, world, vertex, time)
            return min(best.total_s, self._problem.give_up_s)
        if vertex not in self._starts:
            self._starts[vertex] = self._start(vertex)
        start = self._starts[vertex]
        if start is None:
            return self._problem.give_up_s
        after = self._routes.seconds_from(vertex)[start.slots]
        free = world.next_free(start.slots, time) - time
        for i in np.flatnonzero(free < after):
            free[i] = world.next_free(start.slots[i : i + 1], time + after[i])[0] - time
        return self._bound(start, law.take(start.slots), after, free)

    def _start(self, vertex: int) -> _Start | None:
        """Return the groups of slots for searches from a vertex; None if they can park nowhere."""
        n, cost_s = self._problem.lot.n_slots, self._problem.arrival_cost_s
        total_s = self._routes.seconds_from(vertex)[:n] + cost_s
        order = np.argsort(total_s, kind="stable")[: np.isfinite(total_s).sum()]
        if not len(order):
            return None
        slots, others = order[:MOST_SLOTS], order[MOST_SLOTS:]
        apart_s = np.array([self._routes.seconds_from(slot)[slots] for slot in slots])
        apart_s = np.minimum(np.minimum(apart_s, apart_s.T), _FAR_S)
        worse_s = (total_s[slots] - total_s[slots[:1]])[np.triu_indices(len(slots), 1)[1]]
        apart_s = apart_s[np.triu_indices(len(slots), 1)] * np.exp(-worse_s / FINE_S)
        tree = linkage(apart_s, "average") if len(slots) > 1 else None
        finest, n_groups = None, 1
        while n_groups <= min(len(slots), _MOST_GROUPS):
            group = np.zeros(len(slots), np.int64)
            if tree is not None:
                group = fcluster(tree, n_groups, "maxclust").astype(np.int64) - 1
            ways = self._ways(vertex, slots, group)
            if ways is None:
                break
            finest, n_groups = (group, ways), n_groups + 1 + n_groups // 8
        assert finest is not None
        return _Start(slots, finest[0], float(total_s[others[0]]) if len(others) else np.inf, finest[1])

    def _ways(self, vertex: int, slots: IntArray, group: IntArray) -> _Ways | None:
        """Return the ways from a vertex; None if there are too many states, unless there is only one group."""
        lot = self._problem.lot
        of_slot = np.zeros(lot.n_slots, np.int64)
        of_slot[slots] = 1 << group
        shows = np.zeros(lot.n_vertices, np.int64)
        shows[: lot.n_slots] = of_slot
        starts, seen = self._problem.slots_in_view
        np.bitwise_or.at(shows, np.repeat(np.arange(lot.n_vertices), np.diff(starts)), of_slot[seen])
        root = int(shows[vertex])
        gates: dict[int, dict[int, None]] = {root: {vertex: None}}
        waiting, sets = [root], list[int]()
        drives: list[tuple[FloatArray, list[tuple[int, int]]]] = []
        n_states = 0
        while waiting:
            known = heapq.heappop(waiting)
            n_states += len(gates[known])
            if n_states > self._most_states and group.any():
                return None
            # Drives end where they show something new.
            shows_new = shows & ~known != 0
            seconds = np.array([self._routes.seconds_from(v, shows_new) for v in gates[known]])
            new = np.flatnonzero(np.isfinite(seconds.min(axis=0)) & shows_new)
            following = [(known | int(shows[v]), int(v)) for v in new]
            for more, v in following:
                if more not in gates:
                    gates[more] = {}
                    heapq.heappush(waiting, more)
                gates[more][v] = None
            sets.append(known)
            drives.append((seconds, following))
        first = np.cumsum([0, *(len(gates[known]) for known in sets)])
        number = {
            (known, v): at + i
            for known, at in zip(sets, first[:-1].tolist(), strict=True)
            for i, v in enumerate(gates[known])
        }
        seen_slots = np.repeat((np.array(sets)[:, None] >> group) & 1 == 1, np.diff(first), axis=0)
        slot_s = np.where(seen_slots, np.concatenate([seconds[:, slots] for seconds, _ in drives]), np.inf)
        away_s = {
            v: self._routes.seconds_from(v)[slots]
            for v in {v for vertices in gates.values() for v in vertices}
        }
        direct_s = np.where(seen_slots, [away_s[v] for known in sets for v in gates[known]], np.inf)
        blocks = [seconds[:, [v for _, v in following]].ravel() for seconds, following in drives]
        steps = (
            np.cumsum([0, *(len(following) for _, following in drives)]),
            np.array([number[state] for _, following in drives for state in following], np.int64),
            np.cumsum([0, *(len(block) for block in blocks)]),
            np.concatenate(blocks),
        )
        return _Ways(np.array(sets, np.int64), first, slot_s, direct_s, _earliest(first, *steps), *steps)

    def _bound(self, start: _Start, law: SlotLaw, after: FloatArray, free: FloatArray) -> float:
        """Return the bound, given the law of the slots in groups on the day.

        `after` and `free`, (n,) s from the arrival: until a car can be at each slot, and until it is free then.
        """
        cost_s = self._problem.arrival_cost_s[start.slots]
        p_taken = law.p_taken_after(after)
        nothing_s = float(after.mean()) + _wait_s(p_taken * law.leaving[0], cost_s)
        # (k, n) of periods of waiting
        ends = after + np.minimum(PERIODS[:, None] * nothing_s, law.known_for_s - after)
        stays = law.stays(after, np.vstack([after, ends]))
        chance = np.vstack([1.0 - p_taken, p_taken * -np.diff(stays, axis=0)])
        slot, period = np.divmod(np.flatnonzero(chance.T > 0.0), len(chance))
        from_s = np.vstack([np.zeros(len(after)), after, ends])[period, slot]
        news = _News(slot, chance[period, slot], start.group)
        revealed = np.full((len(after), len(chance) + 1), len(slot))
        revealed[slot, period] = np.arange(len(slot))
        now = (free > after) + (free > ends).sum(axis=0)
        ways = start.ways
        # Time left at a state if the car goes to a slot that is free from a moment on; no news: infinite
        left_s = np.full((len(ways.earliest_s), len(slot) + 1), np.inf, np.float32)
        left_s[:, :-1] = np.maximum(ways.direct_s[:, slot], from_s - ways.earliest_s[:, None]) + cost_s[slot]
        longest_s = min((PERIODS[-1] + 1.0) * nothing_s, self._problem.give_up_s)
        penalty = _penalties(ways, news, left_s, longest_s, revealed[np.arange(len(after)), now])
        return float(_least_s(ways, penalty, start, free, cost_s, self._problem.give_up_s))


def _wait_s(freed: FloatArray, cost_s: FloatArray) -> float:
    """Return the least mean time, s, until one of the k best slots is freed, and its cost, over k."""
    order = np.argsort(cost_s)
    rate = np.cumsum(freed[order])
    with np.errstate(divide="ignore", invalid="ignore"):
        mean_s = (1.0 + np.cumsum(freed[order] * cost_s[order])) / rate
    return float(min(np.nanmin(mean_s, initial=np.inf), _FAR_S))


@compiled(error_model="numpy")
def _earliest(
    first: IntArray, first_next: IntArray, next_state: IntArray, first_drive: IntArray, drive_s: FloatArray
) -> FloatArray:
    earliest = np.full(first[-1], np.inf)
    earliest[0] = 0.0
    for k in range(len(first) - 1):
        n_next = first_next[k + 1] - first_next[k]
        for x in range(first[k], first[k + 1]):
            row = drive_s[first_drive[k] + (x - first[k]) * n_next :]
            for i in range(n_next):
                y = next_state[first_next[k] + i]
                earliest[y] = min(earliest[y], earliest[x] + row[i])
    return earliest


@compiled(error_model="numpy")
def _penalties(
    ways: _Ways, news: _News, left_s: NDArray[np.float32], longest_s: float, revealed: IntArray
) -> FloatArray:
    """Return the penalty, s, of each way on from a set, and of what the first state shows, (n_next + 1,).

    `left_s`, (n_states, m + 1), is the time left if the car goes to a slot of which it knows the news, inf for the
    others; at most `longest_s` it is `value`, about the least expected time from a state with that slot in mind.
    `revealed`, (n,), is the news of each slot in this world.
    """
    m = len(news.slot)
    value = np.minimum(left_s, np.float32(longest_s))
    penalty, onward, seen = np.empty(len(ways.next_state) + 1), np.empty(m + 1), np.empty(m + 1, np.int64)
    for k in range(len(ways.sets) - 1, -1, -1):
        n_seen = 0
        for j in range(m):
            if (ways.sets[k] >> news.group[news.slot[j]]) & 1:
                seen[n_seen] = j
                n_seen += 1
        seen[n_seen] = m
        n_next = ways.first_next[k + 1] - ways.first_next[k]
        for i in range(n_next):
            y = ways.next_state[ways.first_next[k] + i]
            of_set = ways.sets[np.searchsorted(ways.first, y, side="right") - 1]
            order, mean, rest = _mean_value(of_set & ~ways.sets[k], left_s[y], value[y], news)
            best_s = left_s[y][order]
            for at in range(n_seen + 1):
                place = np.searchsorted(best_s, left_s[y, seen[at]])
                onward[at] = mean[place] + rest[place] * value[y, seen[at]]
            before = _best_revealed(ways.sets[k], left_s[y], news, revealed)
            after = _best_revealed(of_set, left_s[y], news, revealed)
            place = np.searchsorted(best_s, left_s[y, before])
            penalty[ways.first_next[k] + i] = mean[place] + rest[place] * value[y, before] - value[y, after]
            for x in range(ways.first[k], ways.first[k + 1]):
                drive = ways.drive_s[ways.first_drive[k] + (x - ways.first[k]) * n_next + i]
                for at in range(n_seen + 1):
                    value[x, seen[at]] = min(value[x, seen[at]], drive + onward[at])
    order, mean, rest = _mean_value(ways.sets[0], left_s[0], value[0], news)
    best = _best_revealed(ways.sets[0], left_s[0], news, revealed)
    penalty[-1] = mean[-1] + rest[-1] * value[0, m] - value[0, best]
    return penalty


@compiled(error_model="numpy")
def _least_s(
    ways: _Ways, penalty: FloatArray, start: _Start, free_s: FloatArray, cost_s: FloatArray, give_up_s: float
) -> float:
    """Return the least time of a car that knows when each slot is free, (n,) s, and pays the penalties of `_penalties`.

    It may park in a slot without a group, or pay `give_up_s` where all groups have been seen.
    """
    total_s, penalty_s = np.full(len(ways.earliest_s), np.inf), np.full(len(ways.earliest_s), np.inf)
    every, least = 0, np.inf
    for group in start.group:
        every |= 1 << group
    # Before anything is seen, the car is where the first state is.
    total_s[0] = penalty_s[0] = penalty[-1]
    for k in range(len(ways.sets)):
        for x in range(ways.first[k], ways.first[k + 1]):
            least = min(least, start.beyond_s + penalty_s[x])
            if ways.sets[k] == every:
                least = min(least, total_s[x] + give_up_s)
            for s in range(len(free_s)):
                if ways.slot_s[x, s] < np.inf:
                    parked_s = max(total_s[x] + ways.slot_s[x, s], free_s[s] + penalty_s[x])
                    least = min(least, parked_s + cost_s[s])
        n_next = ways.first_next[k + 1] - ways.first_next[k]
        for i in range(n_next):
            edge = ways.first_next[k] + i
            y = ways.next_state[edge]
            for x in range(ways.first[k], ways.first[k + 1]):
                drive = ways.drive_s[ways.first_drive[k] + (x - ways.first[k]) * n_next + i]
                total_s[y] = min(total_s[y], total_s[x] + drive + penalty[edge])
                penalty_s[y] = min(penalty_s[y], penalty_s[x] + penalty[edge])
    return float(least)


@compiled(error_model="numpy")
def _best_revealed(known: int, left_s: NDArray[np.float32], news: _News, revealed: IntArray) -> int:
    """Return the news of the slots of known groups with the least time left at a state."""
    best = len(news.slot)
    for s in range(len(revealed)):
        if (known >> news.group[s]) & 1 and left_s[revealed[s]] < left_s[best]:
            best = revealed[s]
    return int(best)


@compiled(error_model="numpy")
def _mean_value(
    new: int, left_s: NDArray[np.float32], value: NDArray[np.float32], news: _News
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Average `value` at a state over what new groups may be.

    Return the possible news of their slots, best first, (k,); the sum of the value over the first i, weighted with the
    probability that each is the best, and the probability that there is none of them, (k + 1,).
    """
    order, k = np.empty(len(news.slot), np.int64), 0
    for j in range(len(news.slot)):
        if (new >> news.group[news.slot[j]]) & 1 and left_s[j] < np.inf:
            order[k] = j
            k += 1
    order = order[:k]
    order = order[np.argsort(left_s[order])]
    mean, rest, other = np.zeros(k + 1), np.ones(k + 1), np.ones(len(news.group))
    for i in range(k):
        # The news of a slot excludes other news of it.
        s, chance = news.slot[order[i]], news.chance[order[i]]
        best = rest[i] / other[s] * chance if other[s] > _SURE else 0.0
        other[s] -= chance
        mean[i + 1], rest[i + 1] = mean[i] + best * value[order[i]], rest[i] - best
    return order, mean, rest
