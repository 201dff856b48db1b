"""Import a lot from outlines of parking spaces without a usable road network."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import shapely

from parkenv.compiled.arrays import FloatArray
from parkenv.errors import InputError
from parkenv.lots.draft import ImportOptions, LeftOut, LotDraft, points_in_frame
from parkenv.lots.infer.layout import KERB_WIDTH, InferredLot, infer_lot
from parkenv.lots.infer.network import STREET, Line
from parkenv.lots.infer.openings import least_aisle
from parkenv.lots.infer.spaces import Spaces, rectangle_corners, spaces_from_outlines, validate_areas
from parkenv.lots.local_frame import LocalFrame
from parkenv.lots.osm.buildings import Area, find_goals
from parkenv.lots.osm.elements import OsmElement
from parkenv.lots.osm.roads import Rank, Road, closed_to_cars, whole_number
from parkenv.lots.osm.spaces import split_space, why_no_slot
from parkenv.lots.quality import QualityIssue
from parkenv.world.drive_graph import SLOT_REACH

MOST_SPACES = 20_000
"""Maximum number of spaces of one lot."""
MOST_LOST = 0.2
"""Largest fraction of the spaces that an import may leave out because no aisle reaches them."""
LARGEST_USUAL = 18.0  # area, m², that few parking spaces for cars exceed
SHARE_UNSURE = 0.35  # certainty below which the open side of a row counts as a guess
TWO_WAY_WIDTH, ONE_WAY_WIDTH = 4.5, 2.8
"""Least width, m, of a two-way and of a one-way aisle."""


def outline_draft(
    path: Path,
    elements: Sequence[OsmElement],
    roads: Sequence[Road],
    frame: LocalFrame,
    options: ImportOptions,
) -> LotDraft:
    """Draft a lot from the outlines of its spaces; `parkenv.lots.infer.layout` has the rules.

    Args:
        path: the file, for messages.
        elements: all elements of it.
        roads: roads open to cars, in the lot's frame.
        frame: the lot's frame.
        options: goals, entries and bounds given by the user.

    Raises:
        InputError: an outline that is open, crosses itself or lies on another, an area that is no space's, too many
            spaces, spaces of which no lot can be made, or nothing left of them.
    """
    try:
        return _draft(path.stem, elements, roads, frame, options)
    except InputError as error:
        text = str(error)
        raise InputError(text if text.startswith(f"{path}: ") else f"{path}: {text}") from error


def _draft(
    name: str,
    elements: Sequence[OsmElement],
    roads: Sequence[Road],
    frame: LocalFrame,
    options: ImportOptions,
) -> LotDraft:
    drawn = [e for e in elements if e.tags.get("amenity") == "parking_space" and not e.is_node]
    refuse_number(len(drawn))
    box = options.box(frame)
    areas = [area for e in drawn if (area := _area(e, frame)) is not None and _is_within(area.polygon, box)]
    _refuse_swapped(areas)
    validate_areas(
        [a.element.id for a in areas], shapely.area(np.array([a.polygon for a in areas], dtype=object))
    )
    buildings = _shapes(elements, frame, lambda e: e.tags.get("building", "no") != "no")
    parking = _shapes(elements, frame, lambda e: e.tags.get("amenity") == "parking")
    private = [a.polygon for a in parking if closed_to_cars(a.element.tags)]

    left_out: dict[str, list[str]] = {}
    ids: list[str] = []
    polygons: list[shapely.Geometry] = []
    unused: list[shapely.Geometry] = []
    for area in areas:
        reason = why_no_slot(area.element.tags, area.polygon, private, with_disabled=options.with_disabled)
        if reason is not None:
            left_out.setdefault(reason, []).append(area.element.id)
            unused.append(area.polygon)
            continue
        count = whole_number(area.element.tags.get("capacity")) or 1
        parts = split_space(area.polygon, count, [])
        ids += [area.element.id] if count == 1 else [f"{area.element.id}-{k + 1}" for k in range(count)]
        polygons += parts
    if not polygons:
        raise InputError(f"no parking space for cars: {_listed(left_out)}")
    spaces = spaces_from_outlines(ids, np.array(polygons, dtype=object))
    obstacles = [*(a.polygon for a in buildings), *unused]
    entries, goals = (points_in_frame(frame, given) for given in (options.entries, options.goals))
    lines = [Line(road.points, road.oneway, STREET if road.rank is Rank.STREET else -1) for road in roads]
    lot = infer_lot(spaces, obstacles, lines, entries)
    for reason, members in lot.left_out.items():
        left_out[reason] = [spaces.ids[i] for i in members]
    lost = sum(len(members) for members in lot.left_out.values())
    if lost > MOST_LOST * len(spaces):
        raise InputError(
            f"{lost} of {len(spaces)} spaces have no aisle: "
            f"{_listed({r: [spaces.ids[i] for i in m] for r, m in lot.left_out.items()})}"
        )
    goal_note = "as given"
    if not len(goals):
        nodes = [e for e in elements if e.is_node]
        found, note = find_goals(lot.slots, nodes, buildings, frame)
        goals, goal_note = (found, note or "") if len(found) else (lot.goal, "on the side of the entry")
        if not options.guess_goal and not len(found):
            goals = goals[:0]
    kept_entries = (
        lot.entries if len(entries) or options.guess_entry or lot.entry is None else lot.entries[:0]
    )
    return LotDraft(
        name=name,
        slot_ids=tuple(spaces.ids[i] for i in lot.index),
        slots=lot.slots,
        slot_source=("amenity=parking_space",) * len(lot.index),
        lanes=lot.lanes,
        entries=kept_entries,
        goals=goals,
        walls=tuple(
            shapely.get_coordinates(shapely.get_exterior_ring(part))
            for a in buildings
            for part in shapely.get_parts(a.polygon)
        ),
        outlines=tuple(
            shapely.get_coordinates(shapely.get_exterior_ring(part))
            for a in parking
            for part in shapely.get_parts(a.polygon)
        ),
        found=tuple(_found(lot, spaces, frame)),
        guesses=tuple(_guesses(lot, options, goal_note)),
        issues=tuple(_issues(lot, spaces, len(areas), options)),
        left_out=tuple(LeftOut(reason, tuple(members)) for reason, members in left_out.items()),
        missing=tuple(_missing(lot, kept_entries, goals)),
        frame=frame,
    ).searchable()


def refuse_number(count: int) -> None:
    """Raise an error for more spaces than one lot may have."""
    if count > MOST_SPACES:
        raise InputError(
            f"{count:,} parking spaces, want at most {MOST_SPACES:,} in one lot; divide it by --split or --bounds"
        )


def _area(element: OsmElement, frame: LocalFrame) -> Area | None:
    """Return an element with its outline; None for a relation without an area."""
    if not element.is_closed:
        raise InputError(f"{element.id}: its outline is open, want its first position again at the end")
    polygon = shapely.Polygon(frame.to_xy(element.lines[0]))
    if not polygon.is_valid:
        reason = shapely.is_valid_reason(polygon).split("[")[0]
        raise InputError(f"{element.id}: its outline is not a simple one: {reason}")
    return Area(element, polygon)


def _refuse_swapped(areas: Sequence[Area]) -> None:
    """Raise an error if the spaces have the size of parked cars only with latitude and longitude exchanged."""
    if not areas:
        return
    lonlat = [area.element.lines[0] for area in areas]
    if np.abs(np.concatenate(lonlat)).max() > 89.0:
        return
    (size, skew), (other_size, other_skew) = (
        _plausibility(positions) for positions in (lonlat, [line[:, ::-1] for line in lonlat])
    )
    if (size < 0.3 and other_size > 0.6) or (skew > 0.12 and other_skew < 0.06 and other_size > 0.6):
        lon, lat = lonlat[0][0].tolist()
        raise InputError(
            f"{areas[0].element.id} is at {lat:.4f}, {lon:.4f}, where few spaces have the size of a car, want "
            "positions at which they have (are latitude and longitude swapped?)"
        )


def _plausibility(outlines: Sequence[FloatArray]) -> tuple[float, float]:
    """Return the fraction of outlines, (k, 2) degrees, of a parked car's size, and their typical skew.

    The skew is the cosine of the angle between two sides: 0 for a rectangle.
    """
    frame = LocalFrame.around(np.concatenate(outlines))
    fits, skew = [], []
    for outline in outlines:
        polygon = shapely.Polygon(frame.to_xy(outline))
        if shapely.area(polygon) < 0.1:
            continue
        one, other = np.diff(rectangle_corners(polygon)[:3], axis=0)
        width, length = sorted((float(np.hypot(*one)), float(np.hypot(*other))))
        fits.append(1.8 < width < 3.3 and 4.0 < length < 6.4 and width * length < LARGEST_USUAL)
        corners = shapely.get_coordinates(shapely.simplify(polygon, 0.2))
        if len(corners) == 5:
            one, other = np.diff(corners[:3], axis=0)
            skew.append(abs(float(one @ other)) / float(np.hypot(*one) * np.hypot(*other)))
    return float(np.mean(fits)) if fits else 0.0, float(np.median(skew)) if skew else 0.0


def _shapes(elements: Sequence[OsmElement], frame: LocalFrame, wanted: object) -> list[Area]:
    """Return the areas of elements, mended where they cross themselves."""
    found = []
    for element in elements:
        if element.is_node or not element.is_closed or not wanted(element):  # type: ignore[operator]
            continue
        parts = [shapely.make_valid(shapely.Polygon(frame.to_xy(line))) for line in element.lines]
        holes = [shapely.make_valid(shapely.Polygon(frame.to_xy(line))) for line in element.holes]
        shape = shapely.union_all(parts).difference(shapely.union_all(holes))
        polygons = [p for p in shapely.get_parts(shape) if p.geom_type == "Polygon" and p.area > 0.0]
        if polygons:
            found.append(Area(element, shapely.union_all(polygons)))
    return found


def _is_within(polygon: shapely.Geometry, box: tuple[float, float, float, float] | None) -> bool:
    return box is None or bool(shapely.contains(shapely.box(*box), shapely.point_on_surface(polygon)))


def _listed(left_out: dict[str, list[str]]) -> str:
    return "; ".join(str(LeftOut(reason, tuple(members))) for reason, members in left_out.items())


def _found(lot: InferredLot, spaces: Spaces, frame: LocalFrame) -> Iterator[str]:
    rows = lot.rows
    kinds = {"kerbside": 0, "oblique": 0, "perpendicular": 0}
    for part in rows:
        slant = np.degrees(part.row.slant)
        kinds["kerbside" if slant < 15 else "oblique" if slant < 75 else "perpendicular"] += 1
    listed = ", ".join(f"{count} {kind}" for kind, count in kinds.items() if count)
    yield f"{len(lot.index)} slots of {len(spaces)} outlines, in {len(rows)} rows: {listed}"
    wide = [aisle.width for aisle in lot.aisles if aisle.width < 2 * SLOT_REACH]
    width = f", {min(wide):.1f} to {max(wide):.1f} m wide" if wide else ""
    yield f"{len(lot.aisles)} aisles{width}, {len(lot.connections)} connections, {len(lot.lanes)} lanes"
    yield f"frame: metres east and north of {frame.lat:.7f}, {frame.lon:.7f}"


def _guesses(lot: InferredLot, options: ImportOptions, goal_note: str) -> Iterator[str]:
    unsure = [part for part in lot.rows if part.certainty < SHARE_UNSURE]
    yield (
        f"open sides of {len(lot.rows)} rows: where the ground in front is free and rows share aisles"
        + (f"; {len(unsure)} could open to either side" if unsure else "")
    )
    if lot.aisles:
        yield f"{len(lot.aisles)} aisles along the rows' fronts"
    if lot.connections:
        far = max(shapely.LineString(c.points).length for c in lot.connections)
        yield f"{len(lot.connections)} connections through free ground, the longest {far:.0f} m"
    narrow = sum(c.clearance < TWO_WAY_WIDTH / 2 - 0.05 for c in lot.connections)
    if narrow:
        yield f"{narrow} connections narrower than {TWO_WAY_WIDTH:g} m, two-way nevertheless"
    one_way = sum(aisle.one_way != 0 for aisle in lot.aisles) - len(lot.two_way)
    if one_way:
        yield f"{one_way} aisles one-way by the slant of their spaces"
    if lot.two_way:
        yield f"{len(lot.two_way)} aisles two-way against the slant of their spaces: no other way leads back"
    if lot.widened:
        yield f"{lot.widened} kerbside spaces narrower than {KERB_WIDTH:g} m, widened towards the lane"
    if lot.entry is not None and not options.entries and options.guess_entry:
        x, y = lot.entries[0].tolist()
        yield f"entry at {x:.1f}, {y:.1f} m: {lot.entry.reason}"
    if not options.goals and goal_note:
        yield f"goal: {goal_note}"


def _issues(lot: InferredLot, spaces: Spaces, drawn: int, options: ImportOptions) -> Iterator[QualityIssue]:
    n = len(spaces)
    unsure = sum(
        len(part.row) * (SHARE_UNSURE - part.certainty) / SHARE_UNSURE
        for part in lot.rows
        if part.certainty < SHARE_UNSURE
    )
    if unsure:
        yield QualityIssue("rows could open to either side", min(0.6, 0.6 * float(unsure) / n + 0.02))
    lost = sum(len(members) for members in lot.left_out.values()) + drawn - n
    if lost > 0:
        yield QualityIssue("outlines left out", min(0.5, 1.5 * lost / max(drawn, 1)))
    reach = [shapely.LineString(c.points).length for c in lot.connections]
    far = sum(length for length in reach if length > 40.0)
    if far:
        yield QualityIssue("long connections through unknown ground", min(0.4, 0.002 * far + 0.05))
    narrow = sum(c.clearance < TWO_WAY_WIDTH / 2 - 0.05 for c in lot.connections)
    if narrow:
        yield QualityIssue("narrow connections", min(0.3, 0.05 * narrow))
    if lot.two_way:
        yield QualityIssue("oblique rows on two-way aisles", 0.15)
    tight = sum(
        len(part.row) for part in lot.rows if np.median(part.view.clear) < least_aisle(part.row) + 0.4
    )
    if tight:
        yield QualityIssue("narrow aisles", min(0.4, 0.5 * tight / n))
    if lot.entry is not None and not options.entries:
        yield QualityIssue("the entry is a guess", 0.05 + 0.1 * (1.0 - lot.entry.certainty))


def _missing(lot: InferredLot, entries: FloatArray, goals: FloatArray) -> Iterator[str]:
    if not len(entries):
        x, y = lot.entries[0].tolist()
        yield f"no entry: the file has no road; give one by --entry X,Y, or --entry auto for {x:.1f},{y:.1f}"
    if not len(goals):
        x, y = lot.goal[0].tolist()
        yield (
            f"no goal: the file has no building; give the place that people walk to by --goal X,Y, or --goal auto for "
            f"{x:.1f},{y:.1f}"
        )
