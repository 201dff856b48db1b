"""Repair of a label-setting plan after some probabilities have changed, instead of planning from scratch.

After Ramalingam and Reps (1996): a change can increase only the labels of the tree of vertices that were labelled from
the changed stop. These get the best label that their other neighbours offer; labels then spread only from there and
from stops that improved. Most observations affect a handful of vertices, whatever the size of the lot. If a change
reaches more than a fixed part of the lot, planning from scratch is faster and is done instead.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray
from parkenv.compiled.heap import push
from parkenv.compiled.jit import compiled
from planners.thesis import label_setting
from planners.thesis.label_setting import Labels, StoppingGraph

REACH = 0.1  # fraction of the lot's vertices that a repair may change; above it the plan is made from scratch
_LEAST_REACH = 64
_AFFECTED = label_setting.STOP + 1


def repair(graph: StoppingGraph, labels: Labels, vertices: NDArray[np.int64], p_free: FloatArray) -> int:
    """Update a plan in place after some slots, (k,), got other probabilities, (k,), as if it were made from scratch.

    Return the number of labels set; -1 if it was planned from scratch. `labels.settled` is as after `set_labels`.
    """
    labels.p_free[vertices] = p_free
    reach = max(_LEAST_REACH, int(REACH * len(labels.cost)))
    touched = -1
    if labels.settled and len(vertices) <= reach:
        touched = _repair(graph, vertices, labels.p_free, labels.cost, labels.move, reach)
    if touched < 0:
        label_setting.update_labels(graph, labels)
    return touched


@compiled(error_model="numpy")
def _repair(
    graph: StoppingGraph,
    vertices: NDArray[np.int64],
    p_free: FloatArray,
    cost: FloatArray,
    move: NDArray[np.int8],
    reach: int,
) -> int:
    """Return the number of labels set; -1, with unusable labels, if more than `reach` vertices are affected."""
    affected, n_affected = np.empty(reach, dtype=np.int32), 0
    keys, queued, size = np.empty(2 * reach), np.empty(2 * reach, dtype=np.int32), 0
    for i in range(len(vertices)):
        s = vertices[i]
        if move[s] == label_setting.STOP and label_setting.stop_cost(graph, p_free, s) > cost[s]:
            affected[n_affected], move[s] = s, _AFFECTED
            n_affected += 1
    tail = 0
    while tail < n_affected:
        v = affected[tail]
        tail += 1
        for e in range(graph.in_start[v], graph.in_start[v + 1]):
            u = graph.in_source[e]
            if move[u] == graph.in_move[e]:
                if n_affected == reach:
                    return -1
                affected[n_affected], move[u] = u, _AFFECTED
                n_affected += 1
    for i in range(n_affected):
        u = affected[i]
        cost[u], best = label_setting.stop_cost(graph, p_free, u), label_setting.STOP
        for a in range(graph.neighbors.shape[1]):
            v = graph.neighbors[u, a]
            if v >= 0 and move[v] != _AFFECTED:
                label = graph.move_s[u, a] + graph.gamma * cost[v]
                if label < cost[u]:
                    cost[u], best = label, a
        move[u] = best
        if cost[u] < np.inf:
            size = push(keys, queued, size, cost[u], u)
    n_set = n_affected
    for i in range(len(vertices)):
        s = vertices[i]
        own = label_setting.stop_cost(graph, p_free, s)
        if own < cost[s]:
            cost[s], move[s] = own, label_setting.STOP
            size = push(keys, queued, size, own, s)
            n_set += 1
    n_spread = label_setting.spread(graph, cost, move, keys, queued, size)
    return n_set + n_spread if n_spread >= 0 else -1
