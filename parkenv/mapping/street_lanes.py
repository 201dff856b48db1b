"""Lanes of an unknown street, along the drives or from a map, and the lot that they and discovered slots make."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import shapely
from scipy.spatial import cKDTree

from parkenv.compiled.arrays import BoolArray, FloatArray, IntArray
from parkenv.errors import InputError, naming, require
from parkenv.lots.generators import Slots, nearest_on_lanes
from parkenv.lots.infer.network import Line, limit_junctions, noded
from parkenv.lots.local_frame import LocalFrame
from parkenv.lots.osm.elements import read_map
from parkenv.lots.osm.roads import clipped_roads, read_roads
from parkenv.mapping.street_slots import GAP, LONE_CAR, StreetSlots
from parkenv.world.drive_graph import SLOT_REACH, component_labels, node_labels
from parkenv.world.lot import Lane, ParkingLot

_STEP_M = 1.0
_SAME_STREET_M = 5.0  # m, within which two passes in the same or the opposite direction are of one street
_PARALLEL = math.cos(math.radians(30.0))
_TURNING_M = 25.0  # m of the way between two passes, at least
_SMOOTH_M = 5.0
_SHORTEST_M = 8.0  # of a street that is driven
_STRAIGHT_M = 0.2  # m, by which a lane may differ from the track
_STREETS_AROUND_M = 40.0
_AHEAD_M = 30.0  # m beyond the end of a drive, up to where its street is taken to go straight on
_DIRECTION_M = 10.0  # m of a lane that show its direction, and on which it moves aside
_MOST_SHIFT_M = 4.0
_KERB_M = SLOT_REACH + 5.0  # m from a lane, farthest kerb
_NEAR_M = 10.0  # m between the track and the streets that are driven


def driven_lanes(tracks: Sequence[FloatArray]) -> list[Lane]:
    """Return two-way lanes along the tracks, (k, 2) m each; a street that is driven several times has one lane."""
    lines = [shapely.LineString(track) for track in tracks if len(track) > 1]
    parts = [shapely.get_coordinates(shapely.line_interpolate_point(line, np.arange(0.0, line.length, _STEP_M)))
             for line in lines if line.length > _STEP_M]  # fmt: skip
    if not parts:
        raise InputError(f"the drives have no track, want one of more than {_STEP_M:g} m")
    xy = np.concatenate(parts)
    way = np.concatenate([np.gradient(part, axis=0) for part in parts])
    way /= np.maximum(np.hypot(way[:, :1], way[:, 1:]), 1e-9)
    run = np.concatenate([1e6 * k + _STEP_M * np.arange(len(part)) for k, part in enumerate(parts)])
    before = np.full(len(xy), -1)  # the point of an earlier pass beside each
    for i, near in enumerate(cKDTree(xy).query_ball_point(xy, _SAME_STREET_M, return_sorted=True)):
        alike = way[near] @ way[i]
        # What leads back is another pass; what leads on is the same until a while has passed.
        later = run[i] - run[near] > np.where(alike < 0.0, 0.0, _TURNING_M)
        passes = np.array(near)[later & (np.abs(alike) > _PARALLEL) & (before[near] < 0)]
        if len(passes):
            before[i] = passes[np.hypot(*(xy[passes] - xy[i]).T).argmin()]
    centre = _between_passes(xy, way, before)
    new = np.flatnonzero(before < 0)
    streets = []
    for k in np.split(new, np.flatnonzero(np.diff(run[new]) != _STEP_M) + 1):
        # It begins and ends in the lane of the pass beside it, or where it turns back beside itself.
        around = [
            j for j in (k[0] - 1, k[-1] + 1) if 0 <= j < len(xy) and abs(run[j] - run[k]).min() <= _STEP_M
        ]
        joins = {j > k[0]: before[[j]] for j in around}
        last, own = int(joins[True][0]) if True in joins else -1, k
        if k[0] <= last and k[-1] - last < _TURNING_M / _STEP_M:
            own = k[: (last - k[0] + len(k)) // 2 + 1]
            del joins[True]
        points = centre[np.concatenate([joins.get(False, k[:0]), own, joins.get(True, k[:0])])]
        if len(own) * _STEP_M >= _SHORTEST_M or len(new) == len(k):
            simple = shapely.LineString(points).simplify(_STRAIGHT_M, preserve_topology=False)
            streets.append(Line(shapely.get_coordinates(simple)))
    return limit_junctions([Lane(line.points) for line in noded(streets)])


def _between_passes(xy: FloatArray, way: FloatArray, before: IntArray) -> FloatArray:
    """Return the points of first passes, moved half-way to the others beside them: traffic keeps to its side."""
    again = np.flatnonzero(before >= 0)
    first = before[again]
    left = np.stack([-way[:, 1], way[:, 0]], axis=1)
    aside = ((xy[again] - xy[first]) * left[first]).sum(axis=1)
    count = np.bincount(first, minlength=len(xy))
    shift = 0.5 * np.bincount(first, aside, len(xy)) / np.maximum(count, 1)
    # Points that no point of the other pass is nearest to are like those around.
    window = np.ones(2 * round(_SMOOTH_M / _STEP_M) + 1)
    known = np.convolve((count > 0) * 1.0, window, "same")
    return xy + (np.convolve(shift, window, "same") / np.maximum(known, 1.0))[:, None] * left


def mapped_lanes(file: Path, frame: LocalFrame, tracks: Sequence[FloatArray]) -> list[Lane]:
    """Return the lanes of the streets of a map that are around the tracks and connected to what was driven.

    Raises:
        InputError: the map cannot be read, or has no street where the drives went.
    """
    path = shapely.MultiLineString([track for track in tracks if len(track) > 1])
    with naming(file):
        roads = read_roads(read_map(file).elements, frame, {})
        around = path.buffer(_STREETS_AROUND_M)
        lines = [Line(part.points, part.oneway) for part in clipped_roads(roads, around)]
        pieces = noded(lines) if lines else []
        shapes = [shapely.LineString(piece.points) for piece in pieces]
        driven = np.array([path.buffer(_NEAR_M).intersection(shape).length for shape in shapes])
        if not len(pieces) or not driven.any():
            raise InputError(
                f"has no street within {_NEAR_M:g} m of the drives: are the poses in its degrees?"
            )
        ends = node_labels(np.concatenate([piece.points[[0, -1]] for piece in pieces])).reshape(-1, 2)
        part = component_labels(ends, int(ends.max()) + 1)[ends[:, 0]]
        kept = part == np.bincount(part, driven).argmax()
        lanes = [Lane(p.points, p.one_way) for p, keep in zip(pieces, kept, strict=True) if keep]
        return limit_junctions(lanes)


def lane_ends(lanes: Sequence[Lane]) -> FloatArray:
    """Return where cars come from, (n, 2) m: the ends of lanes that lead nowhere else; of a loop one of its points."""
    ends = np.concatenate([lane.points[[0, -1]] for lane in lanes])
    label = node_labels(ends)
    leads_in = np.array([end for lane in lanes for end in (True, not lane.oneway)])
    part = component_labels(label.reshape(-1, 2), int(label.max()) + 1)[label]
    open_ends = leads_in & (np.bincount(label)[label] == 1)
    closed = [np.flatnonzero(part == p)[0] for p in np.unique(part) if not open_ends[part == p].any()]
    return np.asarray(ends[np.sort(np.r_[np.flatnonzero(open_ends), np.array(closed, np.int64)])])


def _fitted(lanes: Sequence[Lane], slots: Slots) -> list[Lane]:
    """Return driven lanes that reach the slots seen from them.

    In a wide street they move aside towards rows that are too far away, as the drive was on one side of it; where a
    drive began or ended, they go straight on.
    """
    ends = np.concatenate([lane.points[[0, -1]] for lane in lanes])
    is_open = (np.bincount(node_labels(ends))[node_labels(ends)] == 1).reshape(-1, 2)
    mouths, fitted = slots.mouths(), []
    shapes = np.array([shapely.LineString(lane.points) for lane in lanes])
    for i, (lane, opens) in enumerate(zip(lanes, is_open, strict=True)):
        others = shapely.MultiLineString(np.delete(shapes, i).tolist())
        # An end near another lane is a junction that the drive has not passed.
        opens = opens & ~shapely.dwithin(others, shapely.points(lane.points[[0, -1]]), SLOT_REACH)
        points = _shifted(lane.points, mouths, opens)
        for is_last in np.flatnonzero(opens).tolist():
            points = points if is_last else points[::-1]
            line = shapely.LineString(points)
            back = shapely.get_coordinates(line.interpolate(max(line.length - _DIRECTION_M, 0.0)))[0]
            way = (points[-1] - back) / np.hypot(*(points[-1] - back))
            ahead, aside = np.stack([way, [-way[1], way[0]]]) @ (mouths - points[-1]).T
            further = ahead[(ahead > 1.0) & (ahead < _AHEAD_M) & (np.abs(aside) < SLOT_REACH)]
            if len(further):
                points = np.concatenate([points, [points[-1] + further.max() * way]])
            points = points if is_last else points[::-1]
        fitted.append(Lane(points, lane.oneway))
    return fitted


def _shifted(points: FloatArray, mouths: FloatArray, is_open: BoolArray) -> FloatArray:
    if not len(mouths):
        return points
    line = shapely.LineString(points)
    run = np.linspace(0.0, line.length, max(round(line.length / 5.0), 1) + 1)
    at = shapely.get_coordinates(shapely.line_interpolate_point(line, run))
    way = np.gradient(at, axis=0)
    way /= np.hypot(way[:, :1], way[:, 1:])
    left = np.stack([-way[:, 1], way[:, 0]], axis=1)
    step = mouths[None] - at[:, None]
    ahead, aside = ((step * axis[:, None]).sum(axis=2) for axis in (way, left))
    missing = (np.abs(aside) - SLOT_REACH + 0.5).clip(0.0) * (np.abs(ahead) < _DIRECTION_M)
    missing[missing > _MOST_SHIFT_M] = 0.0
    k = np.arange(len(at)), missing.argmax(axis=1)
    shift = np.sign(aside[k]) * missing[k]
    if not shift.any():
        return points
    # Ends that other lanes share stay where they are.
    shift[[0, -1]] *= is_open
    return np.asarray(at + shift[:, None] * left)


def street_lot(
    name: str, found: StreetSlots, lanes: Sequence[Lane], *, fit: bool = True
) -> tuple[ParkingLot, StreetSlots]:
    """Make a lot of slots and lanes; return it and its slots: those that a lane reaches and, if guessed, none crosses.

    Cars enter at the ends of the lanes; the goal is the middle of the slots. With `fit`, the lanes are where drives
    went, and may move and go on to reach the slots that were seen from them.

    Raises:
        InputError: no slot is left.
    """
    lanes = _fitted(lanes, found.select(found.source != LONE_CAR).slots) if fit else lanes
    mouths, lines = found.slots.mouths(), shapely.MultiLineString([lane.points for lane in lanes])
    reached = np.hypot(*(nearest_on_lanes(lanes, mouths)[0] - mouths).T) < SLOT_REACH - 0.01
    crossed = shapely.intersects(found.slots.boxes(), lines) & (found.source == GAP)
    kerbs = shapely.intersection([shapely.LineString(kerb) for kerb in found.kerbs], lines.buffer(_KERB_M))
    parts = [shapely.get_coordinates(part) for part in shapely.get_parts(kerbs) if part.length > 0.0]
    found = replace(found.select(reached & ~crossed), kerbs=tuple(parts))
    require(
        len(found) > 0, f"no parked car was located within {SLOT_REACH:g} m of the street: no slot was found"
    )
    lot = ParkingLot(
        name=name,
        slot_ids=tuple(map(str, range(1, len(found) + 1))),
        **found.slots.columns(),
        lanes=tuple(lanes),
        entries=lane_ends(lanes),
        goals=found.slots.xy.mean(axis=0)[None],
    )
    return lot, found
