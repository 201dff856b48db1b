"""Aisles between rows of slots, and the roads that connect the aisles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray
from parkenv.lots.generators import TWO_WAY_HALF_WIDTH
from parkenv.lots.importers.facing_rows import FacingRows, opens_toward
from parkenv.lots.importers.slot_rows import PARALLEL_ROWS, SAME_WAY, STRAIGHT, AmbiguousLayoutError, Row
from parkenv.world.lot import Lane

OPEN_AISLE = TWO_WAY_HALF_WIDTH
"""Distance from a row without a facing row to the middle of its aisle, and from an aisle's last slot to its end, m."""
ACROSS_GAP = 15.0  # widest gap, m, in the rows across which an aisle continues
LEAST_GAP = 4.5  # least width, m, of a gap in a row through which a road may lead
SAME_AISLE = 1.5  # largest offset, m, between the lines of two pieces of one aisle
SAME_STOP = 1.5  # distance, m, within which roads that meet an aisle share one junction
ROAD_HALF_WIDTH = 1.25
LONGEST_LINK = 60.0  # longest road, m, between two aisles


@dataclass(frozen=True, eq=False)
class Aisle:
    """A straight piece of aisle, from `start` to `end`, (2,) m."""

    start: FloatArray
    end: FloatArray

    @property
    def along(self) -> FloatArray:
        """Unit vector, (2,), from start to end."""
        step = self.end - self.start
        return np.asarray(step / np.hypot(*step))


def find_aisles(rows: Sequence[Row], sides: Sequence[int], faced: FacingRows) -> list[Aisle]:
    """Return the aisles that rows open to, midway between rows that face each other.

    Args:
        rows: all rows.
        sides: the side to which each row opens, 1 left, -1 right.
        faced: the rows that face each other.
    """
    pieces: list[Aisle] = []
    done: set[tuple[int, int]] = set()
    for i, (row, side) in enumerate(zip(rows, sides, strict=True)):
        if i in {k for pair in done for k in pair}:
            continue
        j = faced.row(i, side)
        offset = row.depth / 2 + OPEN_AISLE
        low, high = row.low, row.high
        if j is not None and opens_toward(rows, sides[j], j, i):
            other = rows[j]
            away = other.middle - row.middle
            offset = (abs(float(away @ row.left)) + row.depth / 2 - other.depth / 2) / 2
            sign = 1 if row.along @ other.along > 0 else -1
            ends = away @ row.along + sign * np.array([other.low, other.high])
            low, high = min(low, *ends.tolist()), max(high, *ends.tolist())
            if faced.row(j, sides[j]) == i:
                done.add((i, j))
        line = row.middle + side * offset * row.left
        pieces.append(Aisle(line + low * row.along, line + high * row.along))
    return _joined(pieces)


def _joined(pieces: Sequence[Aisle]) -> list[Aisle]:
    """Merge collinear pieces; an aisle continues across gaps of up to `ACROSS_GAP`."""
    left = list(pieces)
    while True:
        for a, one in enumerate(left):
            b = next((b for b in range(a + 1, len(left)) if _in_line(one, left[b])), None)
            if b is not None:
                break
        else:
            return left
        other = left.pop(b)
        along = one.along
        sign = 1.0 if along @ other.along > 0 else -1.0
        weight = [float(np.hypot(*(piece.end - piece.start))) for piece in (one, other)]
        along = along * weight[0] + sign * other.along * weight[1]
        along /= np.hypot(*along)
        ends = np.array([one.start, one.end, other.start, other.end])
        middle = np.average(ends, axis=0, weights=np.repeat(weight, 2))
        station = (ends - middle) @ along
        left[a] = Aisle(middle + station.min() * along, middle + station.max() * along)


def _in_line(one: Aisle, other: Aisle) -> bool:
    along = one.along
    if abs(along @ other.along) < np.cos(PARALLEL_ROWS):
        return False
    left = np.array([-along[1], along[0]])
    ends = np.array([other.start, other.end]) - one.start
    if np.abs(ends @ left).min() > SAME_AISLE or abs(ends.mean(axis=0) @ left) > SAME_AISLE:
        return False
    station = np.sort(ends @ along)
    length = float(np.hypot(*(one.end - one.start)))
    return bool(max(station[0] - length, -station[1]) <= ACROSS_GAP)


def extended_aisle(aisle: Aisle, mouth_xy: FloatArray) -> Aisle:
    """Extend an aisle by half its width beyond its last slots, so that they still open to it."""
    line = shapely.LineString([aisle.start, aisle.end])
    beyond = max(OPEN_AISLE, float(shapely.distance(shapely.MultiPoint(mouth_xy), line))) * aisle.along
    return Aisle(aisle.start - beyond, aisle.end + beyond)


def lanes_through(
    aisles: Sequence[Aisle],
    rows: Sequence[Row],
    boxes: NDArray[np.object_],
    mouth_xy: FloatArray,
    xy: FloatArray,
) -> list[Lane]:
    """Create lanes from the aisles and the roads that connect them, with common points where they meet.

    Raises:
        AmbiguousLayoutError: an aisle would cross slots, or no road connects some aisles.
    """
    tree = shapely.STRtree(boxes)
    for aisle in aisles:
        road = shapely.LineString([aisle.start, aisle.end]).buffer(ROAD_HALF_WIDTH, cap_style="flat")
        if len(tree.query(road, predicate="intersects")):
            (x, y), (x_1, y_1) = aisle.start.tolist(), aisle.end.tolist()
            raise AmbiguousLayoutError(
                f"an aisle from ({x:.1f}, {y:.1f}) to ({x_1:.1f}, {y_1:.1f}) m would cross slots", rows, xy
            )
    if len(aisles) == 1:
        return [Lane(np.stack([aisles[0].start, aisles[0].end]))]
    links = _links(aisles, rows, boxes, mouth_xy)
    part = np.arange(len(aisles))
    chosen: list[tuple[int, int, FloatArray, FloatArray]] = []
    # Build all roads perpendicular to the aisles; others only if nothing else connects two components.
    for square in (True, False):
        for i, j, start, end, is_square in links:
            if is_square == square and (square or part[i] != part[j]):
                chosen.append((i, j, start, end))
                part[part == part[j]] = part[i]
    if len(set(part.tolist())) > 1:
        alone = int(np.bincount(part).argmax())
        count = int((part != alone).sum())
        raise AmbiguousLayoutError(
            f"{len(aisles)} aisles, of which {count} are connected to the others by no road", rows, xy
        )
    stops: list[list[FloatArray]] = [[aisle.start, aisle.end] for aisle in aisles]
    lanes = []
    for i, j, start, end in chosen:
        for k, xy_k in ((i, start), (j, end)):
            if all(np.hypot(*(xy_k - stop)) > SAME_STOP for stop in stops[k]):
                stops[k].append(xy_k)
        near = [
            min(stops[k], key=lambda stop, at=at: float(np.hypot(*(stop - at))))  # type: ignore[misc]
            for k, at in ((i, start), (j, end))
        ]
        lanes.append(np.stack(near))
    for aisle, points in zip(aisles, stops, strict=True):
        points.sort(key=lambda point, aisle=aisle: float((point - aisle.start) @ aisle.along))  # type: ignore[misc]
    return [Lane(np.stack(points)) for points in stops] + [Lane(line) for line in lanes]


def _links(
    aisles: Sequence[Aisle], rows: Sequence[Row], boxes: NDArray[np.object_], mouth_xy: FloatArray
) -> list[tuple[int, int, FloatArray, FloatArray, bool]]:
    """Return possible roads between two aisles, shortest first: indices, ends, whether perpendicular to the second."""
    lines = np.array([shapely.LineString([aisle.start, aisle.end]) for aisle in aisles])
    tree = shapely.STRtree(boxes)
    mouths = np.asarray(shapely.points(mouth_xy))
    to_aisle = np.min([shapely.distance(mouths, line) for line in lines], axis=0) - 1e-6
    candidates = []
    for i, aisle in enumerate(aisles):
        starts = [aisle.start, aisle.end, *_gaps_between_rows(aisle, rows)]
        for at in starts:
            for j, line in enumerate(lines):
                if i == j:
                    continue
                station = shapely.line_locate_point(line, shapely.Point(at))
                end = shapely.get_coordinates(shapely.line_interpolate_point(line, station))[0]
                length = float(np.hypot(*(end - at)))
                if 0.05 < length <= LONGEST_LINK:
                    across = abs(float((end - at) @ aisles[j].along)) / length
                    candidates.append((length, i, j, at, end, across < np.sin(2 * SAME_WAY)))
    candidates.sort(key=lambda c: c[:3])
    links: list[tuple[int, int, FloatArray, FloatArray, bool]] = []
    for _, i, j, at, end, square in candidates:
        road = shapely.LineString([at, end])
        if len(tree.query(road.buffer(ROAD_HALF_WIDTH, cap_style="flat"), predicate="intersects")):
            continue
        if any(k not in (i, j) and shapely.dwithin(road, line, LEAST_GAP) for k, line in enumerate(lines)):
            continue  # the road would lead through that aisle
        if (shapely.distance(mouths, road) < to_aisle).any():
            continue  # a slot would open to it
        same = any(
            {i, j} == {a, b}
            and min(
                float(np.hypot(*(at - p)) + np.hypot(*(end - q))),
                float(np.hypot(*(at - q)) + np.hypot(*(end - p))),
            )
            < 2 * LEAST_GAP
            for a, b, p, q, _ in links
        )
        if not same:
            links.append((i, j, at, end, square))
    return links


def _gaps_between_rows(aisle: Aisle, rows: Sequence[Row]) -> list[FloatArray]:
    """Return points on an aisle next to gaps between two collinear rows."""
    points = []
    for a, row in enumerate(rows):
        for other in rows[a + 1 :]:
            away = other.middle - row.middle
            if abs(row.along @ other.along) < np.cos(PARALLEL_ROWS) or abs(away @ row.left) > STRAIGHT:
                continue
            if abs(row.along @ aisle.along) < np.cos(PARALLEL_ROWS):
                continue
            sign = 1 if row.along @ other.along > 0 else -1
            ends = np.sort(away @ row.along + sign * np.array([other.low, other.high]))
            gap = (row.high, ends[0]) if ends[0] > row.high else (ends[1], row.low)
            if LEAST_GAP <= gap[1] - gap[0] <= ACROSS_GAP:
                middle = row.middle + (gap[0] + gap[1]) / 2 * row.along
                station = float((middle - aisle.start) @ aisle.along)
                if 0.0 < station < float(np.hypot(*(aisle.end - aisle.start))):
                    points.append(aisle.start + station * aisle.along)
    return points
