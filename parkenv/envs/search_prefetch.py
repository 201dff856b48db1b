"""Prefetching for the batch: load what the next searches will read while this one is stepped.

With many places, their tables do not fit the processor's inner caches; waiting for them would double a step's time.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from parkenv.compiled.arrays import IntArray
from parkenv.compiled.memory import int32s, int64s, prefetch
from parkenv.engine.local_observation import Surroundings
from parkenv.engine.records import N_ACTIONS, SEARCH, SENTINEL, edge_at, scenario_at, search_at
from parkenv.world.occupancy.kernel import PROCESS_KIND, inlined, prefetch_forecast
from parkenv.world.scenario import EDGE

_APART = 2  # searches between two stages
_LINE = 64  # bytes of a cache line
_SEARCH_BYTES, _EDGE_BYTES = SEARCH.itemsize, EDGE.itemsize


@inlined
def prefetch_searches(address: int, around: Surroundings, actions: IntArray, e: int) -> None:
    """Prefetch for the searches after search e, in stages: each reads what the one before it has loaded."""
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
    """Return the vertex that an action leads to."""
    edges = scenario_at(search.scenario, 0).edges
    return int(edge_at(edges, search.vertex * N_ACTIONS + action).target)


@inlined
def _prefetch_vertex(search: Any, around: Surroundings, action: int) -> None:
    """Prefetch the rows of the vertex that an action leads to."""
    scenario = scenario_at(search.scenario, 0)
    target = _target(search, action)
    prefetch(scenario.action_masks + target * N_ACTIONS)
    prefetch(scenario.view_starts + 8 * target)
    row = around.first[search.place] + target
    width = 4 * around.numbers.shape[1]
    _prefetch(around.numbers.ctypes.data + row * width, width)
    width = 2 * around.indices.shape[1]
    _prefetch(around.indices.ctypes.data + row * width, width)
    prefetch(around.targets.ctypes.data + 16 * row)
    prefetch(around.starts.ctypes.data + 4 * row)
    prefetch(around.crow_s.ctypes.data + 16 * row)


@inlined
def _prefetch_lists(search: Any, around: Surroundings, action: int) -> None:
    """Prefetch the lists of slots in view of, and near, that vertex."""
    scenario = scenario_at(search.scenario, 0)
    target = _target(search, action)
    first = int64s(scenario.view_starts)[target]
    _prefetch(scenario.viewed + 8 * first, _LINE)
    _prefetch(around.view_s.ctypes.data + 4 * (around.first_view[search.place] + first), _LINE)
    start = around.starts[around.first[search.place] + target]
    _prefetch(around.slots.ctypes.data + 4 * start, _LINE)


@inlined
def _prefetch_slots(search: Any, around: Surroundings, action: int) -> None:
    """Prefetch what is known of these slots and of the remembered one."""
    scenario = scenario_at(search.scenario, 0)
    first, remembered = around.first[search.place], search.remembered_slot
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
    """Prefetch the bytes from an address on."""
    for offset in range(0, size, _LINE):
        prefetch(begin + offset)
    prefetch(begin + size - 1)
