"""Reduce junctions with more lanes than the drive graph has moves."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from parkenv.compiled.arrays import FloatArray
from parkenv.world.drive_graph import node_labels
from parkenv.world.lot import MOVES, Lane

JOIN_DISTANCE = 4.0
"""Distance from the junction, m, at which an excess lane joins its neighbour; half the length of a shorter one."""


def limit_junctions(lanes: Sequence[Lane]) -> list[Lane]:
    """Change lanes so that at most four lead away from every junction.

    At junctions with more, a lane that ends there joins the neighbouring arm a few metres before the junction instead.
    A junction at which too few lanes end stays unchanged.
    """
    lines = [lane.points for lane in lanes]
    oneway = [lane.oneway for lane in lanes]
    for _ in range(sum(map(len, lines))):
        crowded = _crowded_node(lines, oneway)
        if crowded is None or not _move_lane_end(lines, crowded):
            break
    return [Lane(points, one) for points, one in zip(lines, oneway, strict=True)]


def _leaving(lines: Sequence[FloatArray], oneway: Sequence[bool], at: set[tuple[int, int]]) -> int:
    """Count the ways that lead away from a node, given as (lane, point) pairs."""
    forward = sum(i + 1 < len(lines[k]) for k, i in at)
    return forward + sum(i > 0 and not oneway[k] for k, i in at)


def _crowded_node(lines: Sequence[FloatArray], oneway: Sequence[bool]) -> set[tuple[int, int]] | None:
    pairs = [(k, i) for k, line in enumerate(lines) for i in range(len(line))]
    at: dict[int, set[tuple[int, int]]] = {}
    for label, pair in zip(node_labels(np.concatenate(lines)).tolist(), pairs, strict=True):
        at.setdefault(label, set()).add(pair)
    for users in at.values():
        if _leaving(lines, oneway, users) > len(MOVES) and any(i in (0, len(lines[k]) - 1) for k, i in users):
            return users
    return None


def _move_lane_end(lines: list[FloatArray], users: set[tuple[int, int]]) -> bool:
    """Move the end of the lane closest to another arm onto that arm."""
    arms = []  # lane, point, neighbouring point, whether the lane ends here
    for k, i in sorted(users):
        ends = i in (0, len(lines[k]) - 1)
        arms += [(k, i, j, ends) for j in (i - 1, i + 1) if 0 <= j < len(lines[k])]
    best: tuple[float, int, int] | None = None
    for a, (k, i, j, ends) in enumerate(arms):
        for b, (other, i_b, j_b, _) in enumerate(arms):
            if not ends or other == k:
                continue
            one, two = lines[k][j] - lines[k][i], lines[other][j_b] - lines[other][i_b]
            turn = float(one @ two / (np.hypot(*one) * np.hypot(*two)))
            if best is None or turn > best[0]:
                best = (turn, a, b)
    if best is None:
        return False
    k, i, _, _ = arms[best[1]]
    other, i_b, j_b, _ = arms[best[2]]
    arm = lines[other][j_b] - lines[other][i_b]
    length = float(np.hypot(*arm))
    joint = lines[other][i_b] + min(JOIN_DISTANCE, length / 2) / length * arm
    lines[other] = np.insert(lines[other], max(i_b, j_b), joint, axis=0)
    moved = lines[k].copy()
    moved[i] = joint
    lines[k] = moved
    return True
