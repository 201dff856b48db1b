"""The side on which each row of spaces opens: free space in front, facing rows, shared aisles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
import shapely
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.lots.infer.spaces import Row, Spaces
from parkenv.world.drive_graph import SLOT_REACH, component_labels

LOOK = 18.0  # how far ahead of a mouth obstacles are looked for, m
WIDEST_SHARED = 13.0  # widest aisle, m, that two facing rows share
LEAST_KERBSIDE, LEAST_PERPENDICULAR = 2.7, 3.9
"""Least width, m, of an aisle along kerbside and along perpendicular spaces; oblique ones are in between."""
TOLERATED, TOLERATED_ACROSS = 0.75, 0.95
"""Fraction of that width that is enough before single spaces of an oblique and of a perpendicular row."""
EXHAUSTIVE = 14  # undecided rows up to which all combinations of sides are tried
PREFERRED = 0.3  # gain per space of a row that opens to the side that its spaces prefer
ON_ROAD = 4.0  # gain per space of a row that opens to a road of the map
ALONE, UNUSED, SHARED = 0.55, 0.45, 1.0
"""Costs per space of a row that opens to free ground, of a gap as wide as an aisle that nothing opens to, and the gain
per space of two rows that share an aisle."""


@dataclass(frozen=True, eq=False)
class View:
    """What lies ahead of the mouths of a row, on one side."""

    clear: FloatArray  # (k,) m to the nearest obstacle, at most `LOOK`
    hit: IntArray  # (k,) the space that the middle of the view ends at; -1 for none


@dataclass(frozen=True, eq=False)
class OpenRow:
    """A row, the side that it opens to, and how sure that is (0 to 1)."""

    row: Row
    side: int
    view: View
    certainty: float


def least_aisle(row: Row) -> float:
    return LEAST_KERBSIDE + (LEAST_PERPENDICULAR - LEAST_KERBSIDE) * float(np.sin(row.slant)) ** 2


def open_rows(
    spaces: Spaces,
    rows: Sequence[Row],
    obstacles: Sequence[shapely.Geometry],
    roads: Sequence[FloatArray] = (),
) -> tuple[list[OpenRow], IntArray]:
    """Return the rows with their open sides, and the spaces that no aisle can reach.

    A row of which one part is open only to one side and another part only to the other is divided. A row opens to a
    road before it; `roads` are centre lines, (k, 2) m each. No aisle crosses obstacles or spaces.
    """
    scene = _Scene(spaces, obstacles)
    parts: list[tuple[Row, list[View]]] = []
    lost: list[int] = []
    for row in rows:
        views = [scene.view(row, side) for side in (0, 1)]
        wanted = np.stack([_agreement(spaces, row, side) for side in (0, 1)], axis=1)
        is_open = np.stack([_is_open(view.clear, row) for view in views], axis=1) & (wanted > -0.7)
        if len(row) == 1 and not is_open.any():
            lost += row.members.tolist()
            continue
        for index in _runs(is_open):
            index = index[is_open[index].any(axis=1)]
            if len(index):
                part = row.part(index)
                parts.append((part, [View(v.clear[index], v.hit[index]) for v in views]))
        lost += row.members[~is_open.any(axis=1)].tolist()
    sides, certainty = _choose(spaces, parts, roads)
    opened = [
        OpenRow(row, side, views[side], sure)
        for (row, views), side, sure in zip(parts, sides, certainty, strict=True)
    ]
    return opened, np.array(sorted(lost), dtype=np.int64)


class _Scene:
    """Everything that ends a view."""

    def __init__(self, spaces: Spaces, obstacles: Sequence[shapely.Geometry]) -> None:
        self.spaces = spaces
        self.shapes = np.concatenate([spaces.boxes(shrink=0.1), np.array(list(obstacles), dtype=object)])
        self.tree = shapely.STRtree(self.shapes)

    def view(self, row: Row, side: int) -> View:
        k, n = len(row), len(self.spaces)
        normal = row.normal(side)
        mouths = row.mouths(self.spaces, side)
        clear, hits = np.full((3, k), LOOK), np.full((3, k), -1)
        for j, share in enumerate((0.0, -0.3, 0.3)):
            start = mouths + share * row.pitch[:, None] * row.along
            rays = np.asarray(shapely.linestrings(np.stack([start, start + LOOK * normal], axis=1)))
            ray, shape = self.tree.query(rays, predicate="intersects")
            # The row itself ends no view, except around a tight bend.
            position = np.full(len(self.shapes), -(10**6))
            position[row.members] = np.arange(k)
            other = np.abs(position[shape] - ray) > 3
            ray, shape = ray[other], shape[other]
            far = shapely.distance(
                np.asarray(shapely.points(start))[ray], shapely.intersection(rays[ray], self.shapes[shape])
            )
            order = np.lexsort((shape, far))[::-1]
            clear[j, ray[order]] = far[order]
            hits[j, ray[order]] = np.where(shape[order] < n, shape[order], -1)
        return View(clear=np.minimum(clear[0], np.median(clear, axis=0)), hit=hits[0])


def _runs(is_open: NDArray[np.bool_]) -> list[IntArray]:
    """Divide a row into runs whose spaces share an open side; blocked spaces belong to any run."""
    runs: list[list[int]] = [[]]
    common = np.array([True, True])
    for i, sides in enumerate(is_open):
        if sides.any():
            if not (common & sides).any():
                runs.append([])
                common = np.array([True, True])
            common &= sides
        runs[-1].append(i)
    return [np.array(run) for run in runs]


def is_on_road(
    spaces: Spaces, row: Row, side: int, view: View, roads: Sequence[FloatArray]
) -> NDArray[np.bool_]:
    if not len(roads):
        return np.zeros(len(row), dtype=bool)
    mouths = row.mouths(spaces, side)
    reach = np.minimum(view.clear, SLOT_REACH - 0.1)[:, None]
    rays = np.asarray(shapely.linestrings(np.stack([mouths, mouths + reach * row.normal(side)], axis=1)))
    lines = shapely.multilinestrings([shapely.LineString(road) for road in roads])
    return np.asarray(shapely.intersects(rays, lines))


def _is_open(clear: FloatArray, row: Row) -> NDArray[np.bool_]:
    """Whether cars reach spaces from a side, (k,): where most of a row has the width that it needs, less is enough."""
    need = least_aisle(row)
    tolerated = TOLERATED if row.slant < np.radians(75.0) else TOLERATED_ACROSS
    return clear >= (tolerated * need if np.median(clear) >= need else need)


def _agreement(spaces: Spaces, row: Row, side: int) -> FloatArray:
    """How well a side agrees with the known open sides of spaces, (k,): 1, -1, half of these, or 0 if none is known."""
    if spaces.opens is None:
        return np.zeros(len(row))
    return np.asarray((spaces.opens[row.members] * row.outward(side)).sum(axis=1))


def _aisle_likeness(gap: FloatArray, need: float) -> FloatArray:
    """How much a gap between rows is like an aisle, 0 to 1: most from 5 to 7.5 m."""
    return np.interp(
        gap, [need - 0.01, need, 4.5, 5.2, 7.5, WIDEST_SHARED, LOOK], [0.0, 0.25, 0.8, 1.0, 1.0, 0.35, 0.2]
    )


def _choose(
    spaces: Spaces, parts: Sequence[tuple[Row, list[View]]], roads: Sequence[FloatArray]
) -> tuple[list[int], list[float]]:
    """Choose sides of least cost: rows share aisles where they can, and no gap like an aisle stays unused."""
    n = len(parts)
    owner = np.full(len(spaces), -1)
    for r, (row, _) in enumerate(parts):
        owner[row.members] = r
    unary = np.zeros((n, 2))
    pairs: dict[tuple[int, int], FloatArray] = {}
    for r, (row, views) in enumerate(parts):
        need = least_aisle(row)
        for side, view in enumerate(views):
            wanted = _agreement(spaces, row, side)
            shut = ~_is_open(view.clear, row) | (wanted < -0.7)
            unary[r, side] -= PREFERRED * float(wanted.sum())
            if shut.any():
                unary[r, side] += np.inf
                continue
            like = _aisle_likeness(view.clear, need)
            facing = np.zeros(len(row), dtype=bool)
            for k in np.flatnonzero(view.hit >= 0).tolist():
                other = int(owner[view.hit[k]])
                if other < 0 or other == r:
                    continue
                across, its_side = _faced_side(row, side, k, parts[other][0], int(view.hit[k]))
                if across is None:
                    continue
                facing[k] = True
                table = pairs.setdefault((min(r, other), max(r, other)), np.zeros((2, 2)))
                mine, theirs = np.zeros(2), np.zeros(2)
                mine[side], theirs[its_side] = 1.0, 1.0
                both, none = np.outer(mine, theirs), np.outer(1 - mine, 1 - theirs)
                change = 0.5 * float(like[k]) * (UNUSED * none - SHARED * both)
                table += change if r < other else change.T
            unary[r, side] += ALONE * float((~facing & (view.clear > 9.0)).sum())
            unary[r, side] += 0.3 * float((~facing & (view.clear <= 9.0)).sum())
            unary[r, side] -= ON_ROAD * float(is_on_road(spaces, row, side, view, roads).sum())
            # A wider view costs less than a narrow one, all else being equal.
            unary[r, side] += 0.25 * float((1.0 - like).sum()) - 0.01 * float(
                np.minimum(view.clear, 8.0).sum()
            )
    label = component_labels(np.array(list(pairs), dtype=np.int64), n) if n else np.empty(0, np.int64)
    sides, sure = np.zeros(n, dtype=int), np.ones(n)
    for part in np.unique(label):
        members = np.flatnonzero(label == part)
        inside = {pair: table for pair, table in pairs.items() if label[pair[0]] == part}
        sides[members] = _least_cost(unary[members], members, inside)
        for r in members.tolist():
            cost = unary[r].copy()
            for (a, b), table in inside.items():
                if r == a:
                    cost += table[:, sides[b]]
                elif r == b:
                    cost += table[sides[a], :]
            if np.isfinite(cost).all():
                sure[r] = min(1.0, max(0.0, cost[1 - sides[r]] - cost[sides[r]]) / (0.6 * len(parts[r][0])))
    return sides.tolist(), sure.tolist()


def _faced_side(row: Row, side: int, k: int, other: Row, space: int) -> tuple[float | None, int]:
    """Return the cosine between two facing rows, None if the view ends at a flank, and the side that is faced."""
    j = int(np.flatnonzero(other.members == space)[0])
    cosine = float(row.normal(side)[k] @ other.normal(0)[j])
    if abs(cosine) < 0.82:
        return None, 0
    return cosine, int(cosine > 0.0)


def _least_cost(unary: FloatArray, members: IntArray, pairs: dict[tuple[int, int], FloatArray]) -> IntArray:
    """Return the sides of least total cost: all combinations for few rows, otherwise by changes of one or two rows."""
    where = {int(r): i for i, r in enumerate(members)}
    tables = [(where[a], where[b], table) for (a, b), table in pairs.items()]
    free = np.flatnonzero(np.isfinite(unary).all(axis=1))
    fixed = np.argmin(unary, axis=1)

    def total(sides: IntArray) -> FloatArray:
        cost = np.asarray(unary[np.arange(len(unary)), sides].sum(axis=-1))
        for a, b, table in tables:
            cost = cost + table[sides[..., a], sides[..., b]]
        return cost

    if not len(free):
        return np.asarray(fixed)
    if len(free) <= EXHAUSTIVE:
        sides = np.tile(fixed, (2 ** len(free), 1))
        sides[:, free] = np.array(list(product((0, 1), repeat=len(free))), dtype=int).reshape(-1, len(free))
        return np.asarray(sides[int(np.argmin(total(sides)))])
    best, best_cost = fixed, np.inf
    for start in (fixed, _with(fixed, free, 0), _with(fixed, free, 1)):
        sides, cost = start.copy(), float(total(start))
        changed = True
        while changed:
            changed = False
            together = [[a, b] for a, b, _ in tables if a in free and b in free]
            for group in [[i] for i in free.tolist()] + together:
                for values in product((0, 1), repeat=len(group)):
                    trial = sides.copy()
                    trial[group] = values
                    trial_cost = float(total(trial))
                    if trial_cost < cost - 1e-9:
                        sides, cost, changed = trial, trial_cost, True
        if cost < best_cost:
            best, best_cost = sides, cost
    return np.asarray(best)


def _with(sides: IntArray, free: IntArray, value: int) -> IntArray:
    changed = sides.copy()
    changed[free] = value
    return changed
