"""Import a lot from outlines of parking spaces without a usable road network."""

from __future__ import annotations

from collections.abc import Sequence

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
from parkenv.lots.osm.buildings import Area, areas_of, exterior_rings, find_goals, is_building, within
from parkenv.lots.osm.elements import OsmElement
from parkenv.lots.osm.roads import Rank, Road
from parkenv.lots.osm.spaces import is_parking_area, is_space, split_space, usable_spaces

MOST_SPACES = 20_000
"""Maximum number of spaces of one lot."""
LARGEST_USUAL = 18.0  # area, m², that few parking spaces for cars exceed


def outline_draft(
    name: str,
    elements: Sequence[OsmElement],
    roads: Sequence[Road],
    frame: LocalFrame,
    options: ImportOptions,
) -> LotDraft:
    """Draft a lot from the outlines of its spaces; `parkenv.lots.infer.layout` has the rules.

    Args:
        name: the lot's name.
        elements: all elements of the map.
        roads: roads open to cars, in the lot's frame.
        frame: the lot's frame.
        options: goals, entries and bounds given by the user.
    """
    drawn = [e for e in elements if is_space(e)]
    if len(drawn) > MOST_SPACES:
        raise InputError(
            f"{len(drawn):,} parking spaces, want at most {MOST_SPACES:,} in one lot; divide it by --split or --bounds"
        )
    areas = within([Area.of(e, frame, simple=True) for e in drawn], options.box(frame))
    _refuse_swapped(areas)
    validate_areas(
        [a.element.id for a in areas], shapely.area(np.array([a.polygon for a in areas], dtype=object))
    )
    buildings, parking = (
        [a for a in areas_of(elements, frame, wanted, mended=True) if shapely.area(a.polygon)]
        for wanted in (is_building, is_parking_area)
    )
    kept, unused = usable_spaces(areas, parking, with_disabled=options.with_disabled)
    left_out: dict[str, list[str]] = {}
    for area, reason in unused:
        left_out.setdefault(reason, []).append(area.element.id)
    if not kept:
        listed = "; ".join(str(LeftOut(reason, tuple(members))) for reason, members in left_out.items())
        raise InputError(f"no parking space for cars: {listed}")
    ids, polygons = zip(*(part for a in kept for part in split_space(a.element, a.polygon, [])), strict=True)
    spaces = spaces_from_outlines(ids, np.array(polygons, dtype=object))
    obstacles = [*(a.polygon for a in buildings), *(a.polygon for a, _ in unused)]
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
        walls=exterior_rings(a.polygon for a in buildings),
        outlines=exterior_rings(a.polygon for a in parking),
    )


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
