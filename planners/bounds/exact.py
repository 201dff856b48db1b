"""The exact optimum of a parking search over belief states, on small lots.

In this model slots do not change: given the day, each is free with a known probability, independently of the others,
and is revealed as soon as it is in view. The day is hidden: what was observed gives its posterior, and so P(free) of
the other slots. The belief state is then the set of observed slots and the subset of these that are free. Dynamic
programming finds the optimum over the states

    (vertex of the car, observed, observed free).

Three facts keep the state space small without loss of optimality (w is the arrival cost of a slot, D the drive time
between two slots):

- Vertices that show nothing new need no decision: the car chooses among the *frontier*, the vertices that show
  something new and are reachable through vertices that do not.
- A slot f' observed free can be left out if another free slot f is at least as good from there: w_f + D(f', f) <= w_f'.
  (Not where days differ from their forecast: what was observed of f' tells of the day.)
- The search ends when the best slot observed free, reached by a route that shows nothing new, costs no more than any
  other slot possibly could.
"""

from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from parkenv.belief.slot_belief import SlotBelief
from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.compiled.jit import compiled
from parkenv.errors import require
from parkenv.world.lot import PARK
from parkenv.world.occupancy.centred_logits import centred_logits
from parkenv.world.occupancy.day_error import EXACT, DayError, nearness
from parkenv.world.scenario import SearchProblem
from planners.agent import Observation, SearchAgent
from planners.routes import RoadTable, edges_out, search

MOST_SLOTS = 25  # maximum number of slots; the key of a belief state has room for no more
MOST_STATES = 8_000_000  # default maximum number of belief states: about 200 MB, and twice that while solving

LEVELS, SLOPES = 13, 7  # numbers of levels and slopes of the grid, from -3.6 to 3.6 standard deviations
_MOST_DEVIATIONS = 3.6
_POSITION_BITS = 10
_SEARCH_ENDS = -1
_UNDECIDED = -2
_CHUNK = 20_000


class Days(NamedTuple):
    """Days that a search may meet, on a grid of levels and slopes; slots are independent given the day."""

    chance: FloatArray  # (k,) float64, probability of each day
    p_free: FloatArray  # (n_slots, k) float64, P(free) of each slot on each day

    @classmethod
    def of(cls, p_occupied: FloatArray, walk: FloatArray, day_error: DayError) -> Self:
        """Return the days of a forecast, (n_slots,); one day if they do not differ. `walk` orders the slots."""
        near = nearness(walk)
        if not day_error:
            return cls(np.ones(1), 1.0 - p_occupied[:, None])
        levels, level_chance = _grid(day_error.level, LEVELS)
        slopes, slope_chance = _grid(day_error.slope, SLOPES)
        shift = (levels + near[:, None, None] * slopes[:, None]).reshape(len(near), -1)
        centre = centred_logits(p_occupied, day_error.deviations(near))[:, None]
        return cls(np.outer(slope_chance, level_chance).ravel(), 1.0 / (1.0 + np.exp(centre + shift)))


def _grid(deviation: float, count: int) -> tuple[FloatArray, FloatArray]:
    if deviation == 0.0:
        return np.zeros(1), np.ones(1)
    z = np.linspace(-_MOST_DEVIATIONS, _MOST_DEVIATIONS, count)
    density = np.exp(-0.5 * z**2)
    return deviation * z, density / density.sum()


class _SmallLot(NamedTuple):
    """Data of a small lot for the dynamic program; sets of slots are bit masks."""

    shows: IntArray  # (n_vertices,) the slots in view of each vertex
    edges: tuple[NDArray[np.int32], NDArray[np.int32], FloatArray]  # as `search` takes them
    drive_s: FloatArray  # (n_vertices, n_vertices) shortest drives
    cost_s: FloatArray  # (n_slots,) arrival cost
    dominated_by: IntArray  # (n_slots,) the slots that are at least as good as each one
    day_chance: FloatArray  # (k,) probability of each day
    p_free: FloatArray  # (n_slots, k) on each day
    give_up_s: float
    stay_s: FloatArray  # (n_vertices,) time of a wait that shows the view of the start vertex


class ExactSolution:
    """The optimal search from one belief state.

    Args:
        problem: lot, goal, speeds, costs and view range; the sensor must not err.
        p_occupied: (n_slots,) probability that each slot is taken; used for unobserved slots only.
        vertex: where the car is.
        seen: (n_slots,) bool, slots that were observed; None: no slot.
        free: (n_slots,) bool, slots that were observed free.
        most_states: maximum number of belief states.
        table: shortest drives of the lot; None: compute them.
        day_error: how far days differ from the forecast.

    Attributes:
        expected_s: s, the least expected time from here to the goal.
        n_states: number of belief states.

    Raises:
        InputError: more than `MOST_SLOTS` slots or `most_states` states, or a sensor that errs.

    Examples:
        >>> from parkenv.lots import grid_lot
        >>> problem = SearchProblem(lot=grid_lot(1, 6), give_up_s=300.0)
        >>> entry = int(problem.lot.entry_vertices[0])
        >>> ExactSolution(problem, np.zeros(6), entry).expected_s < ExactSolution(
        ...     problem, np.full(6, 0.8), entry).expected_s
        True
    """

    def __init__(
        self,
        problem: SearchProblem,
        p_occupied: ArrayLike,
        vertex: int,
        seen: NDArray[np.bool_] | None = None,
        free: NDArray[np.bool_] | None = None,
        *,
        most_states: int = MOST_STATES,
        table: RoadTable | None = None,
        day_error: DayError = EXACT,
    ) -> None:
        n = problem.lot.n_slots
        require_small(problem)
        p = np.asarray(p_occupied, dtype=np.float64)
        require(
            p.shape == (n,) and ((p >= 0.0) & (p <= 1.0)).all(),
            f"p_occupied has shape {p.shape}, want {n} probabilities",
        )
        days = Days.of(p, problem.walk_s, day_error)
        self._lot = _small_lot(problem, days, table or RoadTable.of(problem))
        seen_bits = 0 if seen is None else bits_of(seen)
        free_bits = 0 if free is None else bits_of(free) & seen_bits
        root = _key(seen_bits, vertex, _without_dominated(free_bits, self._lot.dominated_by), n)
        self._enumerate(root, most_states)
        self._values = np.empty(len(self._keys))
        self._choices = np.empty(len(self._keys), dtype=np.int16)
        for level in range(n, -1, -1):
            _back_up(self._keys, self._levels, level, self._values, self._choices, self._lot)
        self.n_states = len(self._keys)
        self.expected_s = float(self._values[0])

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        return self  # immutable: copies of a plan share it

    def decide(self, seen: int, vertex: int, free: int) -> tuple[float, int] | None:
        """Return the expected time, s, and the next vertex to observe from (-1: park); None for an unreachable state.

        `seen` and `free` are bit masks; `vertex` is that of the start, or one that showed something new.
        """
        level = _popcount(seen)
        low, high = self._levels[level], self._levels[level + 1]
        key = _key(seen, vertex, _without_dominated(free, self._lot.dominated_by), len(self._lot.cost_s))
        at = low + int(np.searchsorted(self._keys[low:high], key))
        if at >= high or self._keys[at] != key:
            return None
        return float(self._values[at]), int(self._choices[at])

    def toward(self, vertex: int, target: int, seen: int) -> int:
        """Return the next vertex on a drive that shows nothing new before its end."""
        start, leads_to, edge_s = self._lot.edges
        source = np.repeat(np.arange(len(start) - 1), np.diff(start))
        reach = self.drives(vertex, seen)
        reach[vertex] = 0.0
        walls = self._lot.shows & ~seen != 0
        walls[vertex] = False
        while True:
            before = np.flatnonzero((leads_to == target) & ~walls[source])
            seconds = reach[source[before]] + edge_s[before]
            nearest = source[before[seconds == seconds.min()]]
            nearest = nearest[np.argsort(reach[nearest], kind="stable")]
            if nearest[0] == vertex:
                return target
            target = int(nearest[0])

    def drives(self, vertex: int, seen: int) -> FloatArray:
        """Return times, (n_vertices,) s, of drives that show nothing new before their end."""
        return np.asarray(_drive_within_known(vertex, seen, self._lot))

    def _enumerate(self, root: int, most_states: int) -> None:
        """Find all states that can follow from the first one, in the order of the number of observed slots."""
        n = len(self._lot.cost_s)
        pending: list[list[IntArray]] = [[] for _ in range(n + 1)]
        pending[_popcount(root >> (n + _POSITION_BITS))].append(np.array([root], dtype=np.int64))
        levels_keys, total = list[IntArray](), 0
        for level in range(n + 1):
            keys = np.unique(np.concatenate([np.empty(0, np.int64), *pending[level]]))
            pending[level] = []
            levels_keys.append(keys)
            total += len(keys)
            for start in range(0, len(keys), _CHUNK):
                if total > most_states:
                    break
                new = np.unique(_successors(keys[start : start + _CHUNK], self._lot))
                levels = np.bitwise_count(new >> (n + _POSITION_BITS))
                for more in np.unique(levels):
                    pending[more].append(new[levels == more])
                    if len(pending[more]) > 32:
                        pending[more] = [np.unique(np.concatenate(pending[more]))]
            require(
                total <= most_states,
                f"this lot has over {most_states} belief states: want fewer slots than {n} (about 20 along one "
                "aisle, 16 along two, 11 where days differ), or a higher most_states",
            )
        self._keys = np.concatenate(levels_keys)
        self._levels = np.cumsum([0, *(len(keys) for keys in levels_keys)])


def require_small(problem: SearchProblem) -> None:
    lot = problem.lot
    require(
        lot.n_slots <= MOST_SLOTS and lot.n_vertices <= 1 << _POSITION_BITS,
        f"lot {lot.name!r} has {lot.n_slots} slots and {lot.n_vertices} vertices; the exact planner takes at most "
        f"{MOST_SLOTS} slots and {1 << _POSITION_BITS} vertices",
    )
    require(problem.sensor_model.perfect, "the exact planner requires a sensor model without errors")


def bits_of(slots: NDArray[np.bool_]) -> int:
    return int(sum(1 << int(s) for s in np.flatnonzero(slots)))


def _small_lot(problem: SearchProblem, days: Days, table: RoadTable) -> _SmallLot:
    lot = problem.lot
    starts, slots = problem.slots_in_view
    shows = np.zeros(lot.n_vertices, dtype=np.int64)
    np.bitwise_or.at(shows, np.repeat(np.arange(lot.n_vertices), np.diff(starts)), 1 << slots)
    n, cost = lot.n_slots, problem.arrival_cost_s
    gain = cost[:, None] - (cost[None, :] + table.seconds[:n, :n])
    as_good = (gain > 1e-9) | ((np.abs(gain) <= 1e-9) & (np.arange(n)[None, :] < np.arange(n)[:, None]))
    np.fill_diagonal(as_good, val=False)
    # Of two equally good slots keep the one with the lower number; else each would remove the other.
    # What was observed of a slot also tells of the day: then all count.
    as_good &= len(days.chance) == 1
    dominated_by = np.array([bits_of(row) for row in as_good], dtype=np.int64)
    stay_s = np.where((lot.neighbors < 0).any(axis=1), problem.wait_s, np.inf)
    edges = edges_out(lot.neighbors, problem.move_cost_s)
    return _SmallLot(shows, edges, table.seconds, cost, dominated_by, *days, problem.give_up_s, stay_s)


@compiled
def _key(seen: int, vertex: int, free: int, n: int) -> int:
    return (((seen << _POSITION_BITS) | vertex) << n) | free


@compiled
def _state(key: int, n: int) -> tuple[int, int, int]:
    group = key >> n
    return group >> _POSITION_BITS, group & ((1 << _POSITION_BITS) - 1), key & ((1 << n) - 1)


@compiled
def _popcount(bits: int) -> int:
    count = 0
    while bits:
        bits &= bits - 1
        count += 1
    return count


@compiled
def _without_dominated(free: int, dominated_by: IntArray) -> int:
    """Keep the slots observed free that no other free slot dominates."""
    kept = free
    for s in range(len(dominated_by)):
        if (free >> s) & 1 and dominated_by[s] & free:
            kept &= ~(1 << s)
    return kept


@compiled
def _drive_within_known(vertex: int, seen: int, lot: _SmallLot) -> FloatArray:
    """Return drive times, s, through vertices that show nothing new, to these vertices and to the frontier.

    If the car has not observed from its start vertex yet, the time to that vertex is that of the shortest step that
    ends there: a wait or a round trip.
    """
    reach, shows_new = np.full(len(lot.shows), np.inf), (lot.shows & ~seen) != 0
    is_new, shows_new[vertex] = shows_new[vertex], False
    start, leads_to, edge_s = lot.edges
    search(start, leads_to, edge_s, vertex, shows_new[:0], shows_new, reach)
    if is_new:
        reach[vertex] = lot.stay_s[vertex]
        for v in range(len(reach)):
            for e in range(start[v], start[v + 1]):
                if leads_to[e] == vertex and v != vertex and not shows_new[v]:
                    reach[vertex] = min(reach[vertex], reach[v] + edge_s[e])
    return reach


@compiled
def _least_cost(slots: int, drive_s: FloatArray, cost_s: FloatArray) -> float:
    least = np.inf
    for s in range(len(cost_s)):
        if (slots >> s) & 1:
            least = min(least, drive_s[s] + cost_s[s])
    return least


@compiled
def _successors(keys: IntArray, lot: _SmallLot) -> IntArray:
    """List the states after one more observation, with duplicates."""
    n, n_vertices = len(lot.cost_s), len(lot.shows)
    found, count = np.empty(1024, np.int64), 0
    previous, least, reach = -1, np.inf, np.empty(0)
    for i in range(len(keys)):
        seen, vertex, free = _state(keys[i], n)
        if keys[i] >> n != previous:
            previous = keys[i] >> n
            reach = _drive_within_known(vertex, seen, lot)
            least = _least_cost(~seen, lot.drive_s[vertex], lot.cost_s)
        best = _least_cost(free, reach, lot.cost_s)
        if best <= min(least, _least_cost(free, lot.drive_s[vertex], lot.cost_s)):
            continue
        for v in range(n_vertices):
            new = lot.shows[v] & ~seen
            if new == 0 or not reach[v] < best:
                continue
            revealed = new
            while True:
                if count == len(found):
                    found = np.concatenate((found, np.empty(count, np.int64)))
                found[count] = _key(seen | new, v, _without_dominated(free | revealed, lot.dominated_by), n)
                count += 1
                if revealed == 0:
                    break
                revealed = (revealed - 1) & new
    return found[:count]


@compiled
def _weigh_days(before: FloatArray, seen: int, free: int, lot: _SmallLot, after: FloatArray) -> None:
    """Multiply the weights of the days by the probability of observing `free` of the slots `seen` on each."""
    after[:] = before
    for s in range(len(lot.cost_s)):
        if (seen >> s) & 1:
            for d in range(len(before)):
                after[d] *= lot.p_free[s, d] if (free >> s) & 1 else 1.0 - lot.p_free[s, d]


@compiled
def _back_up(
    keys: IntArray,
    levels: IntArray,
    level: int,
    values: FloatArray,
    choices: NDArray[np.int16],
    lot: _SmallLot,
) -> None:
    """Apply Bellman's equation to the states with `level` observed slots; states with more are already solved."""
    n, n_vertices = len(lot.cost_s), len(lot.shows)
    low, high = np.empty(n_vertices, np.int64), np.empty(n_vertices, np.int64)
    all_slots = (1 << n) - 1
    previous, least, reach = -1, np.inf, np.empty(0)
    day, day_then = np.empty_like(lot.day_chance), np.empty_like(lot.day_chance)
    for i in range(levels[level], levels[level + 1]):
        seen, vertex, free = _state(keys[i], n)
        # With a single day, what was observed says nothing, and dominated free slots are missing from `free`.
        day[:] = lot.day_chance
        if len(day) > 1:
            _weigh_days(lot.day_chance, seen, free, lot, day)
            day /= day.sum()
        if keys[i] >> n != previous:
            previous = keys[i] >> n
            reach = _drive_within_known(vertex, seen, lot)
            least = _least_cost(~seen, lot.drive_s[vertex], lot.cost_s)
            low[:] = -1
        best = _least_cost(free, reach, lot.cost_s)
        choice = _SEARCH_ENDS
        if best == np.inf and seen == all_slots:
            best = lot.give_up_s
        elif best > min(least, _least_cost(free, lot.drive_s[vertex], lot.cost_s)):
            limit = best
            if best == np.inf:
                # With unreachable slots the lot is never proven full; the step limit then costs the same.
                best = lot.give_up_s
            for v in range(n_vertices):
                new = lot.shows[v] & ~seen
                if new == 0 or not reach[v] < limit:
                    continue
                after = seen | new
                if low[v] < 0:
                    start, end = levels[_popcount(after)], levels[_popcount(after) + 1]
                    low[v] = start + np.searchsorted(keys[start:end], _key(after, v, 0, n))
                    high[v] = start + np.searchsorted(keys[start:end], _key(after, v, all_slots, n) + 1)
                expected = reach[v]
                revealed = new
                while True:
                    _weigh_days(day, new, revealed, lot, day_then)
                    chance = day_then.sum()
                    if chance > 0.0:
                        key = _key(after, v, _without_dominated(free | revealed, lot.dominated_by), n)
                        at = low[v] + np.searchsorted(keys[low[v] : high[v]], key)
                        expected += chance * values[at]
                    if revealed == 0:
                        break
                    revealed = (revealed - 1) & new
                # A forced observation counts even if it may end in giving up.
                if expected < best or (choice == _SEARCH_ENDS and limit == np.inf):
                    best, choice = expected, v
        values[i] = best
        choices[i] = choice


@dataclass
class ExactState:
    before: SlotBelief  # belief before the first observation
    solution: ExactSolution  # the most recent solution
    seen: int = 0  # slots observed, as a bit mask
    free: int = 0  # slots that were free when last observed, as a bit mask
    # the next vertex to observe from; -1 to park at a slot observed free; -2 before a decision
    target: int = _UNDECIDED


class ExactAgent(SearchAgent[ExactState]):
    """`exact`: follows the optimum over belief states; for lots of up to about 20 slots.

    It assumes that slots do not change. If a slot observed free turns out to be taken, it solves the problem again from
    there.

    Args:
        problem: lot, goal, speeds and costs.
        most_states: maximum number of belief states.
    """

    name: ClassVar[str] = "exact"

    def __init__(self, problem: SearchProblem, most_states: int = MOST_STATES) -> None:
        super().__init__(problem)
        require_small(self.problem)
        self.most_states = most_states
        self.table = RoadTable.of(self.problem)

    def begin(self, observation: Observation, belief: SlotBelief) -> ExactState:
        return ExactState(belief, self._solve(belief, int(observation["vertex"])))

    def _solve(self, before: SlotBelief, vertex: int, *observed: NDArray[np.bool_]) -> ExactSolution:
        return ExactSolution(
            self.problem,
            before.forecast,
            vertex,
            *observed,
            most_states=self.most_states,
            table=self.table,
            day_error=DayError(*map(float, before.day_error)),
        )

    def decide(self, observation: Observation, belief: SlotBelief, memory: ExactState) -> int:
        vertex = int(observation["vertex"])
        seen, free = bits_of(belief.observed), bits_of(belief.observed_free)
        undecided = memory.target == _UNDECIDED or vertex == memory.target
        if (seen, free) != (memory.seen, memory.free) or undecided:
            memory.seen, memory.free = seen, free
            decision = memory.solution.decide(seen, vertex, free)
            if decision is None:
                memory.solution = self._solve(memory.before, vertex, belief.observed, belief.observed_free)
                decision = memory.solution.decide(seen, vertex, free)
                assert decision is not None
            memory.target = decision[1]
        target = memory.target
        if target == _SEARCH_ENDS:
            if not free:
                return self.wait(vertex)
            reach = memory.solution.drives(vertex, memory.seen)
            arrival_s = reach[: self.problem.lot.n_slots] + self.problem.arrival_cost_s
            target = int(np.where(belief.observed_free, arrival_s, np.inf).argmin())
            if target == vertex:
                return PARK
        elif target == vertex:
            return self.wait(vertex)
        return self.table.move_to(vertex, memory.solution.toward(vertex, target, memory.seen))
