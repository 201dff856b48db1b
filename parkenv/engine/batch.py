"""A batch of searches: one compiled call steps all of them and writes what each of them observes.

Where the tables of many places do not fit the processor's inner caches, waiting for them would double a step's time.
So while one search is stepped with its local observation, the data of the next ones are loaded.
"""

from abc import ABC, abstractmethod
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from gymnasium.vector.utils import create_empty_array
from numpy.typing import NDArray

from parkenv.compiled.arrays import BoolArray, FloatArray, IntArray
from parkenv.compiled.jit import inlined, kernel
from parkenv.compiled.memory import LINE, int32s, int64s, prefetch, uint8s
from parkenv.engine.kernel import (
    arrive,
    init_prior,
    observe_live,
    step_cost_s,
    sum_of_costs,
    take_step,
    write_clock,
)
from parkenv.engine.local_observation import Surroundings, local_space, observe_surroundings
from parkenv.engine.records import N_ACTIONS, SEARCH, SENTINEL, edge_at, scenario_at, search_at
from parkenv.engine.search_belief import refresh_belief
from parkenv.engine.searches import ScenarioRecords, Searches
from parkenv.engine.spaces import space_of
from parkenv.world.occupancy.kernel import EXTERNAL_KIND, PROCESS_KIND, prefetch_forecast
from parkenv.world.scenario import EDGE

_APART = 2  # searches between two stages of loading
_SEARCH_BYTES, _EDGE_BYTES = SEARCH.itemsize, EDGE.itemsize


class Steps(NamedTuple):
    """The results of a step, besides observations."""

    rewards: FloatArray  # (n,) float64
    terminated: BoolArray  # (n,) bool
    truncated: BoolArray
    mask: NDArray[np.int8]  # (n, 5) int8, the actions that are possible now


class Observer(ABC):
    """What the searches of a batch observe.

    Args:
        space: of the observations of one search; has an `action_mask`.
        full_belief: whether the searches keep `p_occupied` and `belief` up to date.
        kept: names of observations that are arrays of `Searches`.

    Attributes:
        seen: the observations by name, (n, ...) each.
        n_bytes: memory of searches and observations, bytes; `table_bytes` is what all share besides the scenarios.
    """

    table_bytes = 0

    def __init__(
        self,
        tables: ScenarioRecords,
        n: int,
        space: spaces.Dict,
        full_belief: bool = False,
        kept: tuple[str, ...] = (),
    ) -> None:
        most_observed = None if "step_observed" in kept else 0
        self.searches, self.space = Searches(tables, n, full_belief, most_observed), space
        own: Any = create_empty_array(spaces.Dict({k: v for k, v in space.items() if k not in kept}), n)
        self._own, self._kept = own, kept
        self.n_bytes: int = self.searches.n_bytes + sum(array.nbytes for array in own.values())
        self._find_arrays()

    def _find_arrays(self) -> None:
        searches = self.searches
        of_searches = {
            name: getattr(searches, name).reshape(len(searches.records), -1) for name in self._kept
        }
        self.seen: dict[str, NDArray[Any]] = self._own | of_searches
        self.address = searches.address

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name not in ("seen", "address")}

    def __setstate__(self, content: dict[str, Any]) -> None:
        vars(self).update(content)
        self._find_arrays()

    @abstractmethod
    def step(self, actions: IntArray, fresh: BoolArray, idle: BoolArray, limit: int, steps: Steps) -> None:
        """Step all searches except idle and fresh ones, and write results and observations of all except idle ones.

        Args:
            actions: (n,) int64.
            fresh: (n,) bool, searches that have just begun.
            idle: (n,) bool, searches to leave as they are.
            limit: number of steps after which a search is truncated.
            steps: results to write.
        """

    def observations(self) -> dict[str, NDArray[Any]]:
        return {name: array.copy() for name, array in self.seen.items()}


class BeliefObserver(Observer):
    """The observations of `parkenv/Search-v2`, but for the names in `without`."""

    def __init__(self, tables: ScenarioRecords, n: int, without: tuple[str, ...] = ()) -> None:
        space = {k: v for k, v in space_of(tables.scenarios).items() if k not in without}
        names = ("p_occupied", "belief", "step_observed", "day_error", "cues")
        kept = tuple(name for name in names if name in space)
        super().__init__(tables, n, spaces.Dict(space), full_belief=True, kept=kept)

    def step(self, actions: IntArray, fresh: BoolArray, idle: BoolArray, limit: int, steps: Steps) -> None:
        vertex, time = self.seen["vertex"], self.seen["time"]
        step_with_belief(self.address, actions, fresh, idle, limit, steps, vertex, time)


class LocalObserver(Observer):
    """The observations of `parkenv.engine.local_observation`, of k slots."""

    def __init__(self, tables: ScenarioRecords, n: int, k: int) -> None:
        self._around = Surroundings.of(tables.scenarios, k)
        self.table_bytes = self._around.n_bytes
        super().__init__(tables, n, local_space(k))

    def step(self, actions: IntArray, fresh: BoolArray, idle: BoolArray, limit: int, steps: Steps) -> None:
        step_with_surroundings(
            self.address, self._around, actions, fresh, idle, limit, steps, self.seen["local"]
        )


@kernel
def first_wrong(actions: IntArray) -> int:
    for e in range(len(actions)):
        if not 0 <= actions[e] < N_ACTIONS:
            return e
    return -1


@kernel
def arrive_all(address: int, which: BoolArray) -> None:
    for e in range(len(which)):
        if which[e]:
            search = search_at(address, e)
            search.episode += 1
            arrive(search)
            scenario = scenario_at(search.scenario, 0)
            # With a full belief, `init_prior` does that.
            if scenario.n_live > 0 and scenario.prior_kind != EXTERNAL_KIND and search.belief == 0:
                observe_live(search)


@inlined
def advance(search: Any, e: int, action: int, fresh: bool, limit: int, steps: Steps) -> None:
    if fresh:
        steps.rewards[e] = 0.0
        steps.terminated[e] = steps.truncated[e] = False
    else:
        take_step(search, action)
        steps.rewards[e] = -step_cost_s(search)
        steps.terminated[e] = search.over
        steps.truncated[e] = search.n_steps >= limit
    write_clock(search)
    masks = uint8s(scenario_at(search.scenario, 0).action_masks)
    for move in range(N_ACTIONS):
        steps.mask[e, move] = masks[search.vertex * N_ACTIONS + move]


@kernel
def step_with_belief(
    address: int,
    actions: IntArray,
    fresh: BoolArray,
    idle: BoolArray,
    limit: int,
    steps: Steps,
    vertex: IntArray,
    time: NDArray[np.float32],
) -> None:
    """Step, update the full belief, and write vertex and time."""
    for e in range(len(actions)):
        if idle[e]:
            continue
        search = search_at(address, e)
        advance(search, e, actions[e], fresh[e], limit, steps)
        if fresh[e]:
            init_prior(search)
        else:
            refresh_belief(search)
        vertex[e], time[e, 0], time[e, 1] = search.vertex, search.clock[0], search.clock[1]


@kernel
def step_with_surroundings(
    address: int,
    around: Surroundings,
    actions: IntArray,
    fresh: BoolArray,
    idle: BoolArray,
    limit: int,
    steps: Steps,
    local: NDArray[np.float32],
) -> None:
    for e in range(len(actions)):
        _prefetch_searches(address, around, actions, e)
        if idle[e]:
            continue
        search = search_at(address, e)
        advance(search, e, actions[e], fresh[e], limit, steps)
        observe_surroundings(search, around, local[e])


@kernel
def copy_fields(address: int, which: BoolArray, offsets: IntArray, words: IntArray) -> None:
    """Write 8 bytes from each offset of the SEARCH records of some searches; `words` is (k, n)."""
    for e in range(len(which)):
        if which[e]:
            search = search_at(address, e)
            search.total_s = sum_of_costs(search)
            for i in range(len(offsets)):
                words[i, e] = int64s(address + e * _SEARCH_BYTES + offsets[i])[0]


# ---- loading ahead


@inlined
def _prefetch_searches(address: int, around: Surroundings, actions: IntArray, e: int) -> None:
    """Load what the searches after search e will read, in stages: each reads what the one before it has loaded."""
    n = len(actions)
    if e + 5 * _APART < n:
        _prefetch(address + (e + 5 * _APART) * _SEARCH_BYTES, _SEARCH_BYTES)
    if e + 4 * _APART < n:
        search = search_at(address, e + 4 * _APART)
        edge = search.vertex * N_ACTIONS + actions[e + 4 * _APART]
        prefetch(scenario_at(search.scenario, 0).edges + edge * _EDGE_BYTES)
    if e + 3 * _APART < n:
        _prefetch_vertex(search_at(address, e + 3 * _APART), around, actions[e + 3 * _APART])
    if e + 2 * _APART < n:
        _prefetch_lists(search_at(address, e + 2 * _APART), around, actions[e + 2 * _APART])
    if e + _APART < n:
        _prefetch_slots(search_at(address, e + _APART), around, actions[e + _APART])


@inlined
def _target(search: Any, action: int) -> int:
    edges = scenario_at(search.scenario, 0).edges
    return int(edge_at(edges, search.vertex * N_ACTIONS + action).target)


@inlined
def _prefetch_vertex(search: Any, around: Surroundings, action: int) -> None:
    scenario = scenario_at(search.scenario, 0)
    target = _target(search, action)
    prefetch(scenario.action_masks + target * N_ACTIONS)
    prefetch(scenario.view_starts + 8 * target)
    row = around.first[search.scenario_index] + target
    width = 4 * around.numbers.shape[1]
    _prefetch(around.numbers.ctypes.data + row * width, width)
    width = 2 * around.indices.shape[1]
    _prefetch(around.indices.ctypes.data + row * width, width)
    prefetch(around.targets.ctypes.data + 16 * row)
    prefetch(around.starts.ctypes.data + 4 * row)
    prefetch(around.crow_s.ctypes.data + 16 * row)


@inlined
def _prefetch_lists(search: Any, around: Surroundings, action: int) -> None:
    scenario = scenario_at(search.scenario, 0)
    target = _target(search, action)
    first = int64s(scenario.view_starts)[target]
    _prefetch(scenario.viewed + 8 * first, LINE)
    _prefetch(around.view_s.ctypes.data + 4 * (around.first_view[search.scenario_index] + first), LINE)
    start = around.starts[around.first[search.scenario_index] + target]
    _prefetch(around.slots.ctypes.data + 4 * start, LINE)


@inlined
def _prefetch_slots(search: Any, around: Surroundings, action: int) -> None:
    scenario = scenario_at(search.scenario, 0)
    first, remembered = around.first[search.scenario_index], search.remembered_slot
    prefetch(around.crow_s.ctypes.data + 16 * (first + remembered))
    prefetch(scenario.walk_s + 8 * remembered)
    prefetch(scenario.parking_cost_s + 8 * remembered)
    if scenario.prior_kind != PROCESS_KIND:
        return
    row, columns = first + _target(search, action), int32s(search.columns)
    for i in range(around.starts[row], around.starts[row + 1]):
        slot = np.int64(around.slots[i])
        if columns[slot] == SENTINEL:
            prefetch_forecast(scenario.prior, search.hour, slot)


@inlined
def _prefetch(begin: int, size: int) -> None:
    for offset in range(0, size, LINE):
        prefetch(begin + offset)
    prefetch(begin + size - 1)
