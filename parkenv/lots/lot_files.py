"""Recognise, read, import and check lot files, and read the packaged lots."""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from importlib import resources
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import shapely
from pydantic import ConfigDict, Field, Strict, create_model
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components, dijkstra

from parkenv.compiled.arrays import BoolArray
from parkenv.errors import InputError, naming, require
from parkenv.files.known_names import PACKAGED_LOTS
from parkenv.files.limited_reading import is_there, read_json, read_yaml, unpacked_path
from parkenv.files.spec_file import Spec
from parkenv.lots.draft import ImportOptions, LotDraft, points_in_frame
from parkenv.lots.formats.contents import LotContents, LotProblem, graph_errors
from parkenv.lots.formats.geojson import read_contents
from parkenv.lots.generators import Slots, bay_row, nearest_on_lanes
from parkenv.lots.osm.elements import holds_osm
from parkenv.world.drive_graph import GraphError, node_labels
from parkenv.world.lot import Lane, ParkingLot

FORMATS = {
    **dict.fromkeys((".yml", ".yaml"), "dragon-lake"),
    **dict.fromkeys((".osm", ".xml", ".pbf"), "osm"),
}


def lot_format(path: Path) -> str | None:
    """Return a file's format by its suffix and, for JSON, its content; None for an unknown suffix. Does not raise.

    `native` and `dragon-lake` are whole lots; of `osm`, `import_lot` derives one by rules.
    A JSON file that cannot be read counts as native: its reader then reports the error.
    """
    suffix = unpacked_path(path).suffix.lower()
    if suffix in (".json", ".geojson"):
        with suppress(InputError):
            return "osm" if holds_osm(read_json(path)) else "native"
        return "native"
    return FORMATS.get(suffix)


def load_lot(name_or_path: str | Path) -> ParkingLot:
    """Load a packaged lot by its name, or a lot file by its path.

    Raises:
        InputError: neither a packaged lot nor a file, or the file contains no valid lot (see `read_lot`).

    Examples:
        >>> load_lot("campus").n_slots
        189
    """
    if not isinstance(name_or_path, str | Path):
        raise InputError(f"lot is a {type(name_or_path).__name__}, want a packaged lot's name or a lot file")
    if str(name_or_path) in PACKAGED_LOTS:
        return packaged_lot(str(name_or_path))
    path = Path(name_or_path)
    require(is_there(path), f"{path}: no such file, nor a packaged lot ({', '.join(PACKAGED_LOTS)})")
    return read_lot(path)


# Folder with 24 real car parks, © OpenStreetMap contributors, ODbL (see its README).
PLACES = Path(__file__).parent / "places"


def packaged_lot(name: str) -> ParkingLot:
    """Load a packaged lot: campus, jam, street, mini."""
    require(name in PACKAGED_LOTS, f"no packaged lot {name!r}, want one of {', '.join(PACKAGED_LOTS)}")
    with resources.as_file(resources.files("parkenv.lots") / "packaged" / f"{name}.geojson") as path:
        return read_lot(path)


def read_lot(path: str | Path) -> ParkingLot:
    """Read a lot from native GeoJSON (`.geojson`, `.json`) or a Dragon Lake map (`.yml`).

    Slots without exact properties take their shape from their polygons (`slots_from_polygons`).
    """
    return _read_whole(Path(path))[0]


def _read_whole(path: Path) -> tuple[ParkingLot, str]:
    file_format = lot_format(path)
    if file_format == "dragon-lake":
        return dragon_lake_lot(path), ""
    contents = read_contents(path)
    if not contents.errors:
        try:
            return ParkingLot(**contents.columns()), contents.found
        except GraphError:
            pass
    errors = [*contents.errors, *graph_errors(contents)]
    first = str(errors[0]).removeprefix("error: ")
    if file_format == "osm":
        raise InputError(f"{path}: {first}; `parkenv lot import {path}` makes a lot of it")
    more = f" (and {len(errors) - 1} more; `parkenv lot check {path}` lists all)" if len(errors) > 1 else ""
    raise InputError(f"{path}: {first}{more}")


def import_lot(path: str | Path, options: ImportOptions | None = None) -> LotDraft:
    """Draft a lot from a file of a real place.

    Supported formats are OpenStreetMap (`.osm`, `.xml`, also packed as `.gz` and `.bz2`, `.osm.pbf`,
    overpass-turbo GeoJSON; see `parkenv.lots.osm.draft`), the Dragon Lake map and native lots.
    Latitudes and longitudes are projected to metres east and north of the file's centre.

    Args:
        path: the file.
        options: goals, entries and bounds given by the user.

    Returns:
        A draft; `LotDraft.lot()` converts it to a lot, or states what is missing.

    Raises:
        InputError: the file cannot be read, contains no parking, or has an unknown format.
    """
    path = Path(path)
    options = options or ImportOptions()
    file_format = lot_format(path)
    # What infers a lot takes longer to load than a search in a finished one.
    if file_format == "osm":
        from parkenv.lots.osm.draft import osm_draft

        return osm_draft(path, options)
    require(
        file_format,
        f"{path}: unknown kind of file {path.suffix!r}, want .osm, .xml or .pbf (OpenStreetMap), .json or .geojson "
        "(overpass-turbo, a native lot) or a Dragon Lake .yml; for slot centres, see examples/02_your_own_lot.py",
    )
    require(options.bounds is None, f"{path}: bounds apply to OpenStreetMap; this file is a whole lot")
    lot, recognised = _read_whole(path)
    draft = LotDraft.of_lot(lot)
    if recognised:
        draft = replace(draft, found=(recognised, *draft.found))
    if options.goals:
        draft = replace(draft, goals=points_in_frame(None, options.goals), goal_weights={})
    if options.entries:
        draft = replace(draft, entries=points_in_frame(None, options.entries), entry_weights={})
    return draft


Metres = Annotated[float, Field(ge=-1e6, le=1e6)]
Point = Annotated[tuple[Metres, Metres], Strict(False)]


class _Part(Spec):
    model_config = ConfigDict(extra="ignore")


class _Line(_Part):
    bounds: Annotated[tuple[Point, Point], Strict(False)]


_NAMES = ("R1L", "R1R", "R2L", "R2R", "R3L", "R3R", "R4L", "R4R", "C1", "C2", "EXT")


class _Rows(_Part):
    shape: Annotated[
        tuple[Annotated[int, Field(ge=1, le=2)], Annotated[int, Field(ge=1, le=1000)]], Strict(False)
    ]


class _Area(_Part):
    bounds: Annotated[tuple[Point, Point, Point, Point], Strict(False)]
    areas: Annotated[tuple[_Rows, ...], Strict(False), Field(min_length=1)]


_WAYPOINTS = create_model("_Waypoints", __base__=_Part, **dict.fromkeys(_NAMES, (_Line, ...)))  # type: ignore[call-overload]
_MAP = create_model(
    "_Map",
    __base__=_Part,
    PARKING_AREAS=(Annotated[dict[str, _Area], Field(min_length=1)], ...),
    WAYPOINTS=(_WAYPOINTS, ...),
)


def dragon_lake_lot(path: Path) -> ParkingLot:
    """Read the Dragon Lake Parking data set's `parking_map.yml`; ids are area, row from the north, column: "A-0-13".

    Rows of an area are back to back; a single one opens to the nearer aisle. Aisles are the waypoint rows R1 to R4,
    dead ends in the east; C1 and C2 connect them. Cars enter by EXT; the goal is a door at the southern end of C2.
    """
    document = _MAP.parse(read_yaml(path), str(path))
    with naming(path):
        return _lot(document)


def _lot(document: Any) -> ParkingLot:
    lines = {name: np.array(line.bounds) for name, line in document.WAYPOINTS}
    aisle_y = np.array([lines[f"R{k}L"][0, 1] for k in (1, 2, 3, 4)])
    c1, c2 = lines["C1"][0, 0], lines["C2"][0, 0]
    outside = lines["EXT"][0]
    lanes = [Lane(np.stack([np.full(4, x), aisle_y], axis=1)) for x in (c1, c2)]
    for k, y in enumerate(aisle_y):
        stops = {c1, c2, lines[f"R{k + 1}R"][:, 0].max()} | ({outside[0]} if k == 0 else set())
        lanes.append(Lane(np.array([[x, y] for x in sorted(stops)])))
    lanes.append(Lane(np.array([outside, [outside[0], aisle_y[0]]])))

    parts: list[Slots] = []
    slot_ids: list[str] = []
    for name, area in document.PARKING_AREAS.items():
        west, south = np.min(area.bounds, axis=0)
        east, north = np.max(area.bounds, axis=0)
        n_rows, n_columns = area.areas[0].shape
        size = ((north - south) / n_rows, (east - west) / n_columns)
        opens_north = np.min(np.abs(aisle_y - north)) < np.min(np.abs(aisle_y - south))
        for row in range(n_rows):
            if n_rows == 2:
                opens_north = row == 0
            # Slots are on the left of the line of their mouths, which runs west for the northern rows.
            if opens_north:
                parts.append(bay_row((east, north), np.pi, n_columns, size=size)[::-1])
            else:
                parts.append(bay_row((west, south), 0.0, n_columns, size=size))
            slot_ids += [f"{name}-{row}-{column}" for column in range(n_columns)]
    return ParkingLot(
        name="dragon-lake",
        slot_ids=tuple(slot_ids),
        **Slots.joined(parts).columns(),
        lanes=tuple(lanes),
        entries=outside[None],
        goals=np.array([[80.0, -4.0]]),
    )


# Distance, m: a lane that ends closer to another one without a common point was probably meant to join it.
LANE_GAP = 1.0
# Smallest depth, m, of a reported overlap of two slots; smaller ones are drawing inaccuracies.
SLOT_OVERLAP = 0.1
GOAL_REACH = 50.0  # distance, m, from the nearest lane beyond which a goal is reported


def check_lot(path: str | Path) -> list[LotProblem]:
    """List all errors and warnings of a lot file, errors first; none for a valid file. Does not raise.

    A file with errors cannot be read. Warnings are about usable lots with probable mistakes: goals far from all lanes;
    lanes that cross or nearly touch without a common point; slots that overlap, face away from their lane, cannot be
    reached from an entry or do not lead to another slot; entries that do not lead to a slot; dead ends.

    For OpenStreetMap files, errors state what a search still needs, and warnings what an import leaves out.
    """
    path = Path(path)
    file_format = lot_format(path)
    try:
        if file_format not in (None, "native"):
            return _import_problems(path)
    except InputError as error:
        return [LotProblem("error", None, str(error).removeprefix(f"{path}: "))]
    contents = read_contents(path)
    problems = [*contents.errors, *graph_errors(contents), *_drawing_warnings(contents)]
    if not any(problem.severity == "error" for problem in problems):
        lot = ParkingLot(**contents.columns())
        problems += _reach_warnings(lot, contents.numbers["slot"], contents.numbers["entry"])
        problems += (LotProblem("warning", None, text) for text in dead_ends(lot))
    return problems


def _import_problems(path: Path) -> list[LotProblem]:
    draft = import_lot(path)
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
    one, other = lane_of[ends[end]], lane_of[leg[near]]
    loose = np.flatnonzero((one != other) & (gap > 0.0))
    _, first = np.unique(np.stack([other, ends[end]])[:, loose], axis=1, return_index=True)
    for k in loose[np.sort(first)].tolist():
        far = f"ends {gap[k]:.2f} m from the lane of feature {numbers[other[k]]}"
        yield int(one[k]), f"{far} without a common point; cars cannot turn there"


def _reach(lot: ParkingLot) -> tuple["csr_array[np.float64]", BoolArray, BoolArray]:
    """Return the drive graph, and the vertices that an entry leads to, and that lead to a slot or belong to one."""
    graph = lot.drive_matrix()
    reached = dijkstra(graph, indices=lot.entry_vertices, min_only=True)
    to_slot = dijkstra(graph.T.tocsr(), indices=np.arange(lot.n_slots), min_only=True)
    return graph, np.isfinite(reached), np.isfinite(to_slot)


def dead_ends(lot: ParkingLot) -> Iterator[str]:
    """Name places from which no lane leads on, or none to a slot, although cars get there."""
    graph, reached, to_slot = _reach(lot)
    exits = np.diff(graph.tocsr().indptr) == 0
    for vertex in np.flatnonzero(reached & (exits | ~to_slot)).tolist():
        x, y = lot.vertex_xy[vertex]
        what = "no lane leads on" if exits[vertex] else "no slot can be reached any more"
        yield f"one-way lanes have a dead end at ({x:.1f}, {y:.1f}) m: {what}"


def _reach_warnings(
    lot: ParkingLot, numbers: Sequence[int | None], entry_numbers: Sequence[int | None]
) -> Iterator[LotProblem]:
    n = lot.n_slots
    graph, reached, to_slot = _reach(lot)
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
