"""Turn restrictions at junctions, in the drive graph.

Which turns a car may make depends on the chain by which it reaches the junction. So a junction has one more vertex for
each chain with a restriction, in the same place: the chain ends there, and the edges of that vertex are the permitted
turns. All cars on the graph obey the restrictions without further code.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from parkenv.compiled.arrays import BoolArray, FloatArray, IntArray

SAME_WAY = np.cos(np.radians(30.0))
"""Cosine of the largest angle between the point that a turn names and the lane that it means."""
SAME_NODE = 0.01  # m, between the middle point of a turn and the junction that it means

TurnParts = tuple[FloatArray, bool]
"""Three points of a turn: on the lane by which cars come, the junction, on the lane by which they leave; and whether it
is the only one that they may make."""


class Chains(NamedTuple):
    """The directions of all segments of lanes between nodes: chain 2k runs along segment k, 2k + 1 against it.

    Attributes:
        first, last: (2n,) int64, node where each begins and where it ends.
        leaving: (2n, 2) float64, unit vector, its direction at its first node.
        drivable: (2n,) bool, whether cars may drive it.
        node_xy: (n_nodes, 2) float64, m.
    """

    first: IntArray
    last: IntArray
    leaving: FloatArray
    drivable: BoolArray
    node_xy: FloatArray

    def onward(self, chain: int) -> IntArray:
        """Return the chains by which cars may leave the node where one ends."""
        return np.flatnonzero((self.first == self.last[chain]) & self.drivable)


class Rule(NamedTuple):
    """The chains that cars may not take after one."""

    chain: int
    forbidden: IntArray


def rules_of(chains: Chains, turns: Sequence[TurnParts]) -> list[Rule | str]:
    """Return the rule of each turn, or why there is none."""
    if not turns:
        return []
    far, nearest = cKDTree(chains.node_xy).query([points[1] for points, _ in turns])
    at = zip(turns, np.atleast_1d(far).tolist(), np.atleast_1d(nearest).tolist(), strict=True)
    return [
        _rule_at(chains, node, turn)
        if away <= SAME_NODE
        else f"has no junction or end of a lane at {_place(turn[0][1])}"
        for turn, away, node in at
    ]


def _rule_at(chains: Chains, node: int, turn: TurnParts) -> Rule | str:
    (before, at, after), only = turn
    arms = np.flatnonzero(chains.first == node)
    comes, leaves = (_arm(chains, arms, point - at) for point in (before, after))
    if comes < 0 or not chains.drivable[comes ^ 1]:
        return f"has no lane by which cars come from {_place(before)} to {_place(at)}"
    if leaves < 0 or not chains.drivable[leaves]:
        return f"has no lane by which cars leave {_place(at)} for {_place(after)}"
    out = chains.onward(comes ^ 1)
    return Rule(comes ^ 1, out[out != leaves] if only else out[out == leaves])


def _arm(chains: Chains, arms: IntArray, way: FloatArray) -> int:
    """Return the arm of a junction that leads a way, -1 if none does."""
    alike = chains.leaving[arms] @ way / max(float(np.hypot(*way)), 1e-9)
    return int(arms[alike.argmax()]) if alike.max() >= SAME_WAY else -1


def _place(xy: FloatArray) -> str:
    return f"({xy[0]:.1f}, {xy[1]:.1f}) m"


def forbidden_after(chains: Chains, turns: Sequence[TurnParts]) -> tuple[dict[int, IntArray], dict[int, str]]:
    """Return which chains cars may not take after each chain with turns, and what is wrong with turns, by number."""
    wrong: dict[int, str] = {}
    forbidden: dict[int, IntArray] = {}
    for number, rule in enumerate(rules_of(chains, turns)):
        if isinstance(rule, str):
            wrong[number] = rule
            continue
        together = np.union1d(forbidden.get(rule.chain, rule.forbidden), rule.forbidden)
        if len(together) == len(chains.onward(rule.chain)):
            wrong[number] = f"prohibits the last turn that cars may make at {_place(turns[number][0][1])}"
        else:
            forbidden[rule.chain] = together
    return forbidden, wrong


def connected(chains: Chains, rules: Sequence[Rule]) -> BoolArray:
    """Return which chains are in the largest part in which each leads to every other one, (2n,) bool."""
    drivable = np.flatnonzero(chains.drivable)
    out = drivable[np.argsort(chains.first[drivable], kind="stable")]
    begin, end = (
        np.searchsorted(chains.first[out], chains.last[drivable], side) for side in ("left", "right")
    )
    source = np.repeat(drivable, end - begin)
    target = out[
        np.arange(len(source)) + np.repeat(begin - np.r_[0, np.cumsum(end - begin)[:-1]], end - begin)
    ]
    n = len(chains.first)
    forbidden = np.concatenate([np.empty(0, np.int64), *(rule.chain * n + rule.forbidden for rule in rules)])
    free = ~np.isin(source * n + target, forbidden)
    graph = coo_array((np.ones(int(free.sum()), bool), (source[free], target[free])), shape=(n, n))
    part = connected_components(graph, connection="strong")[1]
    largest: BoolArray = chains.drivable & (part == np.bincount(part[drivable]).argmax())
    return largest
