"""The car's surroundings as a vector of the same length on every lot, for policies that transfer between lots.

The vector has 46 + 8k numbers from 0 to 1. A time of s seconds is encoded as s / (s + 60): a minute becomes 0.5, and
distant or missing slots come close to, or equal, 1. Probabilities are not transformed. Where cars show that they
leave, "free" is free or about to be. The slots "ahead" of a move are
the k nearest slots, by drive time, whose shortest path from here starts with that move.

| Index | Meaning |
|---|---|
| 0 | whether there is a slot here |
| 1 | P(free) of it; 0 if there is none |
| 2 | walk from it to the goal plus its parking cost; 1 if there is none |
| 3 | time since the search began |
| 4 | number of slots observed, n / (n + 20) |
| 5 | fraction of them that were free when first observed |
| 6 | fraction of them that were forecast to be free |
| 7-10 | forecast fraction of free slots in each quarter of the lot by walk, nearest to the goal first |
| 11 | P(free) of the remembered slot: the one observed free with the shortest drive and walk; 0 if none |
| 12 | walk from it plus its parking cost; 1 if there is none |
| 13 | straight-line drive to it; 1 if there is none |
| 14 + 8a | for each move a (up, down, left, right): whether the graph has it |
| 15 + 8a | drive time of the move; 1 if there is no such move, as for all times below |
| 16 + 8a | the move, then the shortest drive and walk via any slot, if all were free |
| 17 + 8a | whether the move leads back to the previous vertex |
| 18 + 8a | P(at least one of the slots ahead is free) |
| 19 + 8a | expected drive and walk via the best free slot ahead; if none is free, a minute more than the worst |
| 20 + 8a | fraction of the slots ahead that were observed |
| 21 + 8a | straight-line drive from the end of the move to the remembered slot |
| 46 + 8i | for each of the k slots nearest by drive, nearest first: P(free); 0 if there is none |
| 47 + 8i | whether it was observed |
| 48 + 8i | drive to it; 1 if there is none |
| 49 + 8i | walk from it plus its parking cost; 1 if there is none |
| 50 + 8i to 53 + 8i | whether the drive to it begins with up, down, left, right |
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from parkenv.compiled.arrays import Float32Array, FloatArray
from parkenv.compiled.jit import compiled, inlined, kernel
from parkenv.compiled.memory import LINE, float64s, in_one_block, int32s, int64s
from parkenv.engine.kernel import enter
from parkenv.engine.records import (
    BLOCK_BITS,
    BLOCK_SIZE,
    N_ACTIONS,
    N_REGIONS,
    OBSERVED_AT,
    P_OBSERVED,
    SENTINEL,
    UNGUIDED,
    block_at,
    cue_at,
    scenario_at,
    search_at,
    slot_at,
)
from parkenv.engine.search_belief import (
    add_column,
    column_of,
    decay_belief,
    forecast_of,
    has_cue,
    leaving_rate,
    set_belief_of,
)
from parkenv.engine.searches import ScenarioRecords, Searches
from parkenv.errors import require_whole
from parkenv.world.lot import MOVES
from parkenv.world.occupancy.kernel import PROCESS_KIND, prefetch_forecast
from parkenv.world.scenario import SearchProblem

MINUTE = 60.0
MANY_SLOTS = 20.0
NEAR_SLOTS = 5  # default number of slots described
MAX_SLOTS = 1_000  # maximum number of slots in an observation
N_MOVES = len(MOVES)
HERE, PER_MOVE, PER_NEAR = 14, 8, 8
FIRST_NEAR = HERE + N_MOVES * PER_MOVE
SAMPLES = 4
_NOWHERE = -1
# A row of `Surroundings.numbers`: whether there is a slot here, the walk from it; for each move, whether the graph has
# it, drive time, the move with the shortest drive and walk after it, and where it leads, in s from here; drive to the k
# nearest slots; walk from them; drive plus walk via the k slots ahead of each move. Times but the last are encoded.
_FIRST_MOVE, _MOVE_NUMBERS = 2, 5
_FIRST_SLOT = _FIRST_MOVE + N_MOVES * _MOVE_NUMBERS


class Surroundings(NamedTuple):
    """The surroundings of every vertex of one or several lots; rows are vertices, lot after lot.

    What a step reads of a row lies in few cache lines: with many places, they come from the slow outer cache.
    """

    first: NDArray[np.int64]  # (n_lots,) int64, first row of each lot
    # (n, at least 22 + 6k) float32, the constant numbers of the observation, see `_FIRST_SLOT`
    numbers: NDArray[np.float32]
    # (n, at least 6k) int16: indices of the k nearest slots into the row's slots, -1 past the last; the first move to
    # each, -1 if none; those of the k slots ahead of each move, least drive plus walk first, -1 past the last
    indices: NDArray[np.int16]
    # (n, 4) int32, vertices that the moves lead to; -1 if the graph has no such move
    targets: NDArray[np.int32]
    starts: NDArray[np.int32]  # (n + 1,) int32, start of each row's slots in `slots`
    slots: NDArray[np.int32]  # int32, the near or ahead slots of each row, without repeats
    crow_s: FloatArray  # (n, 2) s, coordinates divided by the driving speed
    samples: NDArray[np.int32]  # (n_lots, 4, 4) int32, sample slots from each quarter of the lot by walk
    first_view: NDArray[np.int64]  # (n_lots,) int64, start of each lot in `view_s`
    view_s: NDArray[np.float32]  # s, straight-line drive plus walk for each slot in view of each vertex
    columns: NDArray[np.int32]  # (5k,) int32, scratch space for the columns of a row's slots

    @property
    def n_numbers(self) -> int:
        return FIRST_NEAR + PER_NEAR * (self.columns.size // (N_MOVES + 1))

    @property
    def n_bytes(self) -> int:
        return sum(array.nbytes for array in self)

    def __deepcopy__(self, memo: dict[int, Any]) -> Surroundings:
        return self._replace(columns=self.columns.copy())  # the rest never changes

    @classmethod
    def of(cls, problems: Sequence[SearchProblem], k: int) -> Surroundings:
        """Compute the surroundings of all vertices, with k slots nearby and k ahead of each move.

        Raises:
            InputError: k is not a whole number from 1 to `MAX_SLOTS`.
        """
        require_whole("k", k, least=1, most=MAX_SLOTS)
        parts = [_around(problem, int(k)) for problem in problems]
        joined = [np.concatenate(arrays) for arrays in zip(*parts, strict=True)]
        first = np.concatenate([[0], np.cumsum([p.lot.n_vertices for p in problems])[:-1]])
        count, numbers, indices, targets, slots, crow_s, samples = joined
        starts = np.concatenate([[0], np.cumsum(count)]).astype(np.int32)
        views = [_view_s(problem) for problem in problems]
        first_view = np.concatenate([[0], np.cumsum([len(seconds) for seconds in views])[:-1]])
        arrays: list[NDArray[Any]] = [
            first.astype(np.int64), numbers, indices, targets, starts, slots, crow_s, samples,
            first_view.astype(np.int64), np.concatenate(views), np.zeros((N_MOVES + 1) * k, dtype=np.int32),
        ]  # fmt: skip
        return cls(*in_one_block(arrays))


def local_space(k: int) -> spaces.Dict:
    """The observation space: `local`, (46 + 8k,) float32, and `action_mask`, (5,) int8."""
    return spaces.Dict(
        {
            "local": spaces.Box(0.0, 1.0, (FIRST_NEAR + PER_NEAR * k,), np.float32),
            "action_mask": spaces.Box(0, 1, (N_ACTIONS,), np.int8),
        }
    )


@kernel
def observe_surroundings_at(address: int, around: Surroundings, local: NDArray[np.float32]) -> None:
    observe_surroundings(search_at(address, 0), around, local)


@inlined
def observe_surroundings(search: Any, around: Surroundings, local: NDArray[np.float32]) -> None:
    """Write the local observation of a search; must be called after each reset and each step."""
    decay_belief(search)
    _write_local(search, around, local)


class FollowedSearch:
    """Local observations, of k slots, of a search from those of `parkenv/Search-v2`, one after the other.

    Raises:
        InputError: see `Surroundings.of`.
    """

    def __init__(self, problems: Sequence[SearchProblem], k: int) -> None:
        self._around = Surroundings.of(problems, k)
        public = [problem.public() for problem in problems]
        self._search = Searches(ScenarioRecords(public), 1, full_belief=False)
        self._n_numbers = FIRST_NEAR + PER_NEAR * int(k)

    def observe(self, observation: Mapping[str, Any], begins: int | None = None) -> dict[str, NDArray[Any]]:
        """Return the local observation; `begins` is the index of the problem whose search begins with this one."""
        if begins is not None:
            self._search.begin_outside(begins, observation)
        local = np.empty(self._n_numbers, np.float32)
        vertex, cues = int(observation["vertex"]), observation.get("cues", np.empty(0, np.float32))
        parts = (*(observation[name] for name in ("time", "p_occupied", "belief", "step_observed")), cues)
        follow_at(self._search.address, self._around, begins is not None, vertex, parts, local)
        return {"local": local, "action_mask": observation["action_mask"]}


@kernel
def follow_at(
    address: int,
    around: Surroundings,
    begins: bool,
    vertex: int,
    parts: tuple[Float32Array, ...],
    local: Float32Array,
) -> None:
    time, p_occupied, belief, step_observed, cues = parts
    search, n, most = search_at(address, 0), p_occupied.size, step_observed.size // 4
    if begins:
        enter(search, np.uint64(0), 0, 0.0, 0.0, vertex)
    else:
        search.n_steps += 1
        if vertex != search.vertex:
            search.previous_vertex, search.vertex = search.vertex, vertex
    search.time = time[1]
    for i in range(most):
        slot = int(step_observed[i])
        if slot >= 0:
            p, observed_at = belief[P_OBSERVED * n + slot], belief[OBSERVED_AT * n + slot]
            column = column_of(search, slot)
            set_belief_of(search, column, step_observed[most + i] == 1.0, p, observed_at)
            if cues.size > 0:
                cue = cue_at(search.cue_table, column)
                cue.excess, cue.at = cues[slot], observed_at
    for column in range(SENTINEL + 1, search.n_columns + 1):
        block, k = block_at(search.blocks, column >> BLOCK_BITS), column & (BLOCK_SIZE - 1)
        block.p_occupied[k] = p_occupied[slot_at(search.slots, column).slot]
    _write_local(search, around, local)


@kernel
def _write_local(search: Any, around: Surroundings, local: NDArray[np.float32]) -> None:
    """Write the local observation of a search whose belief is up to date.

    All that it reads is in observations; numbers are rounded as there.
    """
    lot = search.scenario_index
    if search.n_steps == 0:
        _forecast_regions(search, around, lot)
    _remember(search, around, lot)
    scenario, first = scenario_at(search.scenario, 0), around.first[lot]
    row = first + search.vertex
    numbers, indices, columns = around.numbers[row], around.indices[row], around.columns
    k = columns.size // (N_MOVES + 1)
    _find_columns(search, around, row)
    local[0], local[2] = numbers[0], numbers[1]
    local[1] = 1.0 - _p_occupied(search, columns[indices[0]]) if local[0] == 1.0 else 0.0
    local[3] = _squashed(np.float32(search.time - search.arrival))
    local[4] = local[5] = local[6] = 0.0
    if search.n_observed > 0:
        local[4] = search.n_observed / (search.n_observed + MANY_SLOTS)
        local[5] = search.n_observed_free / search.n_observed
        local[6] = search.n_expected_free / search.n_observed
    for region in range(N_REGIONS):
        local[7 + region] = search.free_by_region[region]
    remembered, dx, dy = search.remembered_slot, 0.0, 0.0
    local[11], local[12], local[13] = 0.0, 1.0, 1.0
    if remembered != _NOWHERE:
        dx = around.crow_s[first + remembered, 0] - around.crow_s[row, 0]
        dy = around.crow_s[first + remembered, 1] - around.crow_s[row, 1]
        local[11] = 1.0 - _p_occupied(search, column_of(search, remembered))
        local[12] = _squashed(_arrival_cost_s(scenario, remembered))
        local[13] = _squashed(math.sqrt(dx * dx + dy * dy))
    for move in range(N_MOVES):
        at, here = HERE + PER_MOVE * move, _FIRST_MOVE + _MOVE_NUMBERS * move
        for i in range(3):
            local[at + i] = numbers[here + i]
        for i in range(3, PER_MOVE):
            local[at + i] = 0.0
        local[at + 5] = local[at + 7] = 1.0
        if local[at] == 0.0:
            continue
        local[at + 3] = 1.0 if around.targets[row, move] == search.previous_vertex else 0.0
        if remembered != _NOWHERE:
            x, y = dx - numbers[here + 3], dy - numbers[here + 4]
            local[at + 7] = _squashed(math.sqrt(x * x + y * y))
        none_free, expected, n_ahead, n_observed_ahead, worst = 1.0, 0.0, 0, 0, 0.0
        for i in range(k):
            which = indices[(2 + move) * k + i]
            if which == _NOWHERE:
                break
            worst = numbers[_FIRST_SLOT + (2 + move) * k + i]
            column = columns[which]
            p_taken = _p_occupied(search, column)
            expected += none_free * (1.0 - p_taken) * worst
            none_free *= p_taken
            n_ahead += 1
            n_observed_ahead += int(_is_observed(search, column))
        if n_ahead > 0:
            local[at + 4] = 1.0 - none_free
            local[at + 5] = _squashed(expected + none_free * (worst + MINUTE))
            local[at + 6] = n_observed_ahead / n_ahead
    for i in range(k):
        at, which, first_move = FIRST_NEAR + PER_NEAR * i, indices[i], indices[k + i]
        local[at] = local[at + 1] = 0.0
        if which != _NOWHERE:
            column = columns[which]
            local[at] = 1.0 - _p_occupied(search, column)
            local[at + 1] = 1.0 if _is_observed(search, column) else 0.0
        local[at + 2], local[at + 3] = numbers[_FIRST_SLOT + i], numbers[_FIRST_SLOT + k + i]
        for move in range(N_MOVES):
            local[at + 4 + move] = 1.0 if first_move == move else 0.0


@inlined
def _p_occupied(search: Any, column: int) -> float:
    if search.reserved != UNGUIDED:
        return 0.0 if slot_at(search.slots, column).slot == search.reserved else 1.0
    p = np.float32(block_at(search.blocks, column >> BLOCK_BITS).p_occupied[column & (BLOCK_SIZE - 1)])
    if search.cue_table != 0:
        return float(max(p - _announced(search, column), 0.0))
    return float(p)


@kernel
def _announced(search: Any, column: int) -> float:
    """Return P(about to leave) beyond the usual, from numbers rounded as in observations."""
    if not has_cue(search, column):
        return 0.0
    cue, k = cue_at(search.cue_table, column), column & (BLOCK_SIZE - 1)
    block = block_at(search.blocks, column >> BLOCK_BITS)
    rate = np.float32(leaving_rate(search, np.float32(block.prior[k]), np.float32(block.decay_rate[k])))
    gap = np.float32(search.time - search.arrival) - np.float32(cue.at - search.arrival)
    return float(np.float32(cue.excess) * math.exp(-rate * gap))


@inlined
def _is_observed(search: Any, column: int) -> bool:
    return bool(slot_at(search.slots, column).observed or search.reserved != UNGUIDED)


@inlined
def _arrival_cost_s(scenario: Any, slot: int) -> float:
    """Walk from a slot to the goal plus its parking cost, s; the time inside a counted facility does not count."""
    return float(float64s(scenario.walk_s)[slot] + float64s(scenario.parking_cost_s)[slot])


@inlined
def _find_columns(search: Any, around: Surroundings, row: int) -> None:
    columns, begin = int32s(search.columns), around.starts[row]
    for i in range(around.starts[row + 1] - begin):
        slot = np.int64(around.slots[begin + i])
        column = np.int64(columns[slot])
        if column == SENTINEL:
            column = add_column(search, slot)
        around.columns[i] = column


@inlined
def _squashed(seconds: float) -> float:
    return seconds / (seconds + MINUTE)


@inlined
def _crow_s(around: Surroundings, one: int, other: int) -> float:
    dx = around.crow_s[one, 0] - around.crow_s[other, 0]
    dy = around.crow_s[one, 1] - around.crow_s[other, 1]
    return math.sqrt(dx * dx + dy * dy)


@kernel
def _forecast_regions(search: Any, around: Surroundings, lot: int) -> None:
    scenario = scenario_at(search.scenario, 0)
    if scenario.prior_kind == PROCESS_KIND:
        for region in range(N_REGIONS):
            for i in range(SAMPLES):
                prefetch_forecast(scenario.prior, search.hour, np.int64(around.samples[lot, region, i]))
    for region in range(N_REGIONS):
        free = 0.0
        for i in range(SAMPLES):
            forecast, _ = forecast_of(search, np.int64(around.samples[lot, region, i]))
            free += 1.0 - float(np.float32(forecast))
        search.free_by_region[region] = free / SAMPLES


@inlined
def _remember(search: Any, around: Surroundings, lot: int) -> None:
    if search.reserved != UNGUIDED:
        search.remembered_slot = search.reserved
        return
    scenario, columns = scenario_at(search.scenario, 0), int32s(search.columns)
    first, first_view, vertex = around.first[lot], around.first_view[lot], search.vertex
    best, least = search.remembered_slot, np.inf
    if best != _NOWHERE and slot_at(search.slots, columns[best]).observed_taken:
        best = _NOWHERE
    if best != _NOWHERE:
        least = _arrival_cost_s(scenario, best) + _crow_s(around, first + vertex, first + best)
    viewed, starts = int64s(scenario.viewed), int64s(scenario.view_starts)
    for i in range(starts[vertex], starts[vertex + 1]):
        if around.view_s[first_view + i] >= least:
            continue
        column = np.int64(columns[viewed[i]])
        record = slot_at(search.slots, column)
        if not record.observed or record.observed_taken:
            continue
        if (
            block_at(search.blocks, column >> BLOCK_BITS).observed_at[column & (BLOCK_SIZE - 1)]
            == search.time
        ):
            best, least = viewed[i], around.view_s[first_view + i]
    search.remembered_slot = best


def _view_s(problem: SearchProblem) -> NDArray[np.float32]:
    starts, slots = problem.slots_in_view
    viewer = np.repeat(np.arange(problem.lot.n_vertices), np.diff(starts))
    away = problem.lot.vertex_xy[slots] - problem.lot.vertex_xy[viewer]
    seconds = np.hypot(away[:, 0], away[:, 1]) / problem.v_drive + problem.finite_cost_s[slots]
    return seconds.astype(np.float32)


def _around(problem: SearchProblem, k: int) -> tuple[NDArray[Any], ...]:
    """For one lot: the number of slots of each row, and the arrays from `numbers` to `samples` but `starts`."""
    lot = problem.lot
    n = lot.n_vertices
    neighbors, move_s, walk_s = lot.neighbors, problem.move_s, problem.finite_cost_s
    near, near_s, near_move, ahead, ahead_s = _nearest(neighbors, move_s, lot.n_slots, k)
    total_s = ahead_s + np.where(ahead >= 0, walk_s[ahead], np.inf)
    order = np.argsort(total_s, axis=2, kind="stable")
    ahead, total_s = (np.take_along_axis(a, order, axis=2) for a in (ahead, total_s))
    count, slots, near_index, ahead_index = _without_repeats(near, ahead)

    def squashed(seconds: FloatArray) -> FloatArray:
        with np.errstate(invalid="ignore"):
            return np.where(np.isfinite(seconds), seconds / (seconds + MINUTE), 1.0)

    crow_s = lot.vertex_xy / problem.v_drive
    best_s = _best_totals(neighbors, move_s, walk_s)
    there = neighbors >= 0
    here = np.zeros((n, 2))
    here[:, 1] = 1.0
    here[: lot.n_slots] = np.stack([np.ones(lot.n_slots), squashed(walk_s)], axis=1)
    moves = np.empty((n, N_MOVES, _MOVE_NUMBERS))
    moves[..., 0] = there
    moves[..., 1] = squashed(np.where(there, move_s, np.inf))
    moves[..., 2] = squashed(np.where(there, move_s + best_s[neighbors], np.inf))
    moves[..., 3:] = np.where(there[..., None], crow_s[neighbors] - crow_s[:, None], 0.0)
    near_walk_s = np.where(near >= 0, walk_s[near], np.inf)
    ahead_total_s = np.where(ahead_index >= 0, total_s, 0.0)
    numbers = (here, moves, squashed(near_s), squashed(near_walk_s), ahead_total_s)
    by_walk = np.argsort(walk_s, kind="stable")
    shares = (np.arange(N_REGIONS)[:, None] + (np.arange(SAMPLES) + 0.5) / SAMPLES) / N_REGIONS
    samples = by_walk[(shares * lot.n_slots).astype(np.int64)].astype(np.int32)
    indices = _in_lines((near_index, near_move, ahead_index), np.int16)
    targets = neighbors.astype(np.int32)
    return count, _in_lines(numbers, np.float32), indices, targets, slots, crow_s, samples[None]


def _in_lines(parts: Sequence[NDArray[Any]], dtype: type[np.generic]) -> NDArray[Any]:
    rows = np.concatenate([part.reshape(len(part), -1) for part in parts], axis=1).astype(dtype)
    return np.pad(rows, ((0, 0), (0, -rows.shape[1] % (LINE // rows.itemsize))))


@compiled
def _nearest(
    neighbors: NDArray[np.int32], move_s: FloatArray, n_slots: int, k: int
) -> tuple[NDArray[np.int32], FloatArray, NDArray[np.int32], NDArray[np.int32], FloatArray]:
    """The k slots nearest to each vertex by drive: slot, drive, first move; and nearest by each first move."""
    n = len(neighbors)
    near = np.full((n, k), _NOWHERE, np.int32)
    near_s = np.full((n, k), np.inf)
    near_move = np.full((n, k), _NOWHERE, np.int32)
    ahead = np.full((n, N_MOVES, k), _NOWHERE, np.int32)
    ahead_s = np.full((n, N_MOVES, k), np.inf)
    settled = np.full(n, _NOWHERE, np.int32)
    # A move that starts no shortest path has no slots ahead: bound the search for them.
    patience = 64 + 8 * k * N_MOVES
    for v in range(n):
        heap: list[tuple[float, int, int]] = [(0.0, v, _NOWHERE)]
        n_near, n_settled = 0, 0
        n_ahead = np.zeros(N_MOVES, np.int64)
        wanting = 0
        for move in range(N_MOVES):
            wanting += neighbors[v, move] >= 0
        while len(heap) > 0 and n_settled < patience and (n_near < k or wanting > 0):
            seconds, at, first = heapq.heappop(heap)
            if settled[at] == v:
                continue
            settled[at] = v
            n_settled += 1
            if at < n_slots:
                if n_near < k:
                    near[v, n_near], near_s[v, n_near], near_move[v, n_near] = at, seconds, first
                    n_near += 1
                if first != _NOWHERE and n_ahead[first] < k:
                    ahead[v, first, n_ahead[first]], ahead_s[v, first, n_ahead[first]] = at, seconds
                    n_ahead[first] += 1
                    wanting -= n_ahead[first] == k
            for move in range(N_MOVES):
                to = np.int64(neighbors[at, move])
                if to >= 0 and settled[to] != v:
                    way = move if at == v else first
                    heapq.heappush(heap, (seconds + move_s[at, move], int(to), way))
    return near, near_s, near_move, ahead, ahead_s


@compiled
def _without_repeats(
    near: NDArray[np.int32], ahead: NDArray[np.int32]
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int32], NDArray[np.int32]]:
    """Number of distinct slots of each row, these slots, and the rows as indices into them."""
    n, k = near.shape
    wanted = np.concatenate((near, ahead.reshape(n, N_MOVES * k)), axis=1)
    index = np.full(wanted.shape, _NOWHERE, np.int32)
    count = np.zeros(n, np.int32)
    slots = np.empty(wanted.size, np.int32)
    size = 0
    for v in range(n):
        for i in range(wanted.shape[1]):
            if wanted[v, i] == _NOWHERE:
                continue
            for j in range(count[v]):
                if slots[size + j] == wanted[v, i]:
                    index[v, i] = j
            if index[v, i] == _NOWHERE:
                index[v, i] = count[v]
                slots[size + count[v]] = wanted[v, i]
                count[v] += 1
        size += count[v]
    return count, slots[:size].copy(), index[:, :k].copy(), index[:, k:].copy().reshape(n, N_MOVES, k)


@compiled
def _best_totals(neighbors: NDArray[np.int32], move_s: FloatArray, walk_s: FloatArray) -> FloatArray:
    """Least drive plus walk from each vertex via any slot, (n,) s; inf if no slot is reachable."""
    best = np.full(len(neighbors), np.inf)
    best[: len(walk_s)] = walk_s
    better = True
    while better:
        better = False
        for v in range(len(neighbors)):
            for move in range(N_MOVES):
                to = neighbors[v, move]
                if to >= 0 and move_s[v, move] + best[to] < best[v]:
                    best[v] = move_s[v, move] + best[to]
                    better = True
    return best
