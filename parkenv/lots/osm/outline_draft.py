"""Import a lot from outlines of parking spaces without a usable road network."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import shapely

from parkenv.compiled.arrays import FloatArray
from parkenv.errors import InputError
from parkenv.lots.draft import ImportOptions, LeftOut, LotDraft, points_in_frame
from parkenv.lots.infer.draft import draft_inferred_lot
from parkenv.lots.infer.layout import infer_lot
from parkenv.lots.infer.network import STREET, Line
from parkenv.lots.infer.spaces import rectangle_corners, spaces_from_outlines, validate_areas
from parkenv.lots.local_frame import LocalFrame
from parkenv.lots.osm.buildings import Area, find_goals
from parkenv.lots.osm.elements import OsmElement
from parkenv.lots.osm.roads import Rank, Road, closed_to_cars, whole_number
from parkenv.lots.osm.spaces import split_space, why_no_slot

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
    goal_note: str | None = None
    if not len(goals):
        goals, goal_note = find_goals(lot.slots, [e for e in elements if e.is_node], buildings, frame)
    return draft_inferred_lot(
        name,
        lot,
        spaces,
        options,
        source="amenity=parking_space",
        unit="outlines",
        left_out=left_out,
        frame=frame,
        goals=goals,
        goal_note=goal_note or "",
        walls=_exterior_rings(buildings),
        outlines=_exterior_rings(parking),
    )


def _exterior_rings(areas: Sequence[Area]) -> list[FloatArray]:
    return [
        shapely.get_coordinates(shapely.get_exterior_ring(part))
        for area in areas
        for part in shapely.get_parts(area.polygon)
    ]


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
