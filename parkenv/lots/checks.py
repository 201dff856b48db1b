"""Check a lot file: errors that prevent reading it, and warnings about probable mistakes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from warnings import catch_warnings

import numpy as np
import shapely
from scipy.sparse.csgraph import connected_components, dijkstra

from parkenv.errors import InputError
from parkenv.lots.formats.contents import LotContents, LotProblem, graph_errors
from parkenv.lots.formats.dragon_lake import dragon_lake_lot
from parkenv.lots.formats.geojson import read_contents
from parkenv.lots.lot_files import LotFormat, import_lot, lot_format
from parkenv.lots.slot_polygons import nearest_on_lanes
from parkenv.world.drive_graph import node_labels
from parkenv.world.lot import Lane, ParkingLot

LANE_GAP = 1.0
"""Distance, m: a lane that ends closer to another one without a common point was probably meant to join it."""
SLOT_OVERLAP = 0.1
"""Smallest depth, m, of a reported overlap of two slots; smaller ones are drawing inaccuracies."""
GOAL_REACH = 50.0  # distance, m, from the nearest lane beyond which a goal is reported


def check_lot(path: str | Path) -> list[LotProblem]:
    """List all errors and warnings of a lot file, errors first; none for a valid file. Does not raise.

    A file with errors cannot be read. Warnings are about usable lots with probable mistakes: goals far from all lanes;
    lanes that cross or nearly touch without a common point; slots that overlap, face away from their lane, cannot be
    reached from an entry or do not lead to another slot; entries that do not lead to a slot.

    For OpenStreetMap files and lists of slots, errors state what a search still needs, and warnings what an import
    leaves out.
    """
    path = Path(path)
    file_format = lot_format(path)
    if file_format is not None and not file_format.is_complete:
        return _import_problems(path)
    if file_format is LotFormat.DRAGON_LAKE:
        try:
            dragon_lake_lot(path)
        except InputError as error:
            return [LotProblem("error", None, str(error).removeprefix(f"{path}: "))]
        return []
    with catch_warnings(record=True, action="always") as caught:
        contents = read_contents(path)
    assumed = [LotProblem("warning", None, str(w.message).removeprefix(f"{path}: ")) for w in caught]
    problems = [*contents.errors, *graph_errors(contents), *assumed, *_drawing_warnings(contents)]
    if not any(problem.severity == "error" for problem in problems):
        lot = ParkingLot(**contents.columns())
        problems += _reach_warnings(lot, contents.numbers["slot"], contents.numbers["entry"])
    return problems


def _import_problems(path: Path) -> list[LotProblem]:
    try:
        draft = import_lot(path)
    except InputError as error:
        return [LotProblem("error", None, str(error).removeprefix(f"{path}: "))]
    problems = [LotProblem("error", None, text) for text in draft.missing]
    warnings = [LotProblem("warning", None, f"left out: {left}") for left in draft.left_out]
    if not problems:
        try:
            lot = draft.lot()
        except InputError as error:
            problems.append(LotProblem("error", None, str(error)))
        else:
            warnings += _reach_warnings(lot, [None] * lot.n_slots, [None] * len(lot.entries))
    return problems + warnings


def _drawing_warnings(contents: LotContents) -> list[LotProblem]:
    def warn(feature: int, message: str) -> None:
        warnings.append(LotProblem("warning", feature, message))

    warnings: list[LotProblem] = []
    if not contents.lanes:
        return warnings
    slots, numbers = contents.slots, contents.numbers
    goals = np.array(contents.goals).reshape(-1, 2)
    to_lane = nearest_on_lanes(contents.lanes, goals)[0] - goals
    for number, distance in zip(numbers["goal"], np.hypot(to_lane[:, 0], to_lane[:, 1]), strict=True):
        if distance > GOAL_REACH:
            warn(number, f"goal: the nearest lane is {distance:.0f} m away; people walk at least that far")

    mouth = slots.mouths()
    to_lane = nearest_on_lanes(contents.lanes, mouth)[0] - mouth
    away = (to_lane * slots.outward()).sum(axis=1) < 0.0
    for i in np.flatnonzero(away).tolist():
        warn(numbers["slot"][i], f"slot {contents.slot_ids[i]!r:.40}: its mouth faces away from its lane")

    boxes = slots.boxes(shrink=SLOT_OVERLAP)
    one, other = shapely.STRtree(boxes).query(boxes, predicate="intersects")
    for i, j in zip(one[one < other], other[one < other], strict=True):
        warn(
            numbers["slot"][j],
            f"slot {contents.slot_ids[j]!r:.40} overlaps slot {contents.slot_ids[i]!r:.40} "
            f"of feature {numbers['slot'][i]}",
        )
    for lane, message in _loose_lanes(contents.lanes, numbers["lane"]):
        warn(numbers["lane"][lane], f"lane {message}")
    return warnings


def _loose_lanes(lanes: Sequence[Lane], numbers: Sequence[int]) -> Iterator[tuple[int, str]]:
    """Yield lanes that cross or end close to each other without a common point: cars cannot turn there."""
    count = [len(lane.points) for lane in lanes]
    xy = np.concatenate([lane.points for lane in lanes])
    lane_of = np.repeat(np.arange(len(lanes)), count)
    label = node_labels(xy)
    leg = np.flatnonzero(lane_of[:-1] == lane_of[1:])
    legs = np.asarray(shapely.linestrings(np.stack([xy[leg], xy[leg + 1]], axis=1)))
    tree = shapely.STRtree(legs)

    one, other = tree.query(legs, predicate="intersects")
    a, b = leg[one], leg[other]
    joined = (label[a] == label[b]) | (label[a] == label[b + 1]) | (label[a + 1] == label[b])
    apart = (a < b) & ~joined & (label[a + 1] != label[b + 1])
    at = shapely.point_on_surface(shapely.intersection(legs[one[apart]], legs[other[apart]]))
    crossed_at = np.round(shapely.get_coordinates(at), 1).tolist()
    crossings = zip(
        lane_of[b[apart]].tolist(), lane_of[a[apart]].tolist(), map(tuple, crossed_at), strict=True
    )
    for i, j, (x, y) in sorted(set(crossings)):
        crossed = "itself" if i == j else f"the lane of feature {numbers[j]}"
        yield i, f"crosses {crossed} at ({x:.1f}, {y:.1f}) m without a common point"

    last = np.cumsum(count) - 1
    ends = np.r_[last - count + 1, last]
    ends = ends[np.bincount(label)[label[ends]] == 1]
    points = np.asarray(shapely.points(xy[ends]))
    end, near = tree.query(points, predicate="dwithin", distance=LANE_GAP)
    gap = shapely.distance(points[end], legs[near])
    loose = (lane_of[ends[end]] != lane_of[leg[near]]) & (gap > 0.0)
    close = zip(lane_of[ends[end]], lane_of[leg[near]], ends[end], gap, strict=True)
    seen: set[tuple[int, int]] = set()
    for (i, j, point, distance), is_loose in zip(close, loose, strict=True):
        if is_loose and (j, point) not in seen:
            seen.add((j, point))
            yield (
                int(i),
                (
                    f"ends {distance:.2f} m from the lane of feature {numbers[j]} without a common point; "
                    "cars cannot turn there"
                ),
            )


def _reach_warnings(
    lot: ParkingLot, numbers: Sequence[int | None], entry_numbers: Sequence[int | None]
) -> Iterator[LotProblem]:
    n = lot.n_slots
    graph = lot.drive_matrix()
    reached = np.isfinite(dijkstra(graph, indices=lot.entry_vertices, min_only=True))
    # On the reversed graph: the vertices that lead to a slot, or belong to one.
    to_slot = np.isfinite(dijkstra(graph.T.tocsr(), indices=np.arange(n), min_only=True))
    _, component = connected_components(graph, connection="strong")
    slots_in = np.bincount(component[:n], minlength=component.max() + 1)
    source, target = graph.nonzero()
    leaves = (component[source] != component[target]) & to_slot[target]
    goes_on = (slots_in > 1) | (np.bincount(component[source[leaves]], minlength=len(slots_in)) > 0)
    for fault, message in (
        (~reached[:n], "cannot be reached from an entry"),
        (~goes_on[component[:n]] & (n > 1), "no other slot can be reached from it"),
    ):
        for i in np.flatnonzero(fault).tolist():
            yield LotProblem("warning", numbers[i], f"slot {lot.slot_ids[i]!r:.40}: {message}")
    for i in np.flatnonzero(~to_slot[lot.entry_vertices]).tolist():
        yield LotProblem("warning", entry_numbers[i], "entry: no slot can be reached from it")
