"""Find the car parks of a town: groups of parking spaces, each with the roads and buildings around it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import shapely

from parkenv.compiled.arrays import FloatArray
from parkenv.errors import InputError, naming
from parkenv.lots.draft import ImportOptions, LotDraft
from parkenv.lots.osm.draft import draft_of_map, map_frame
from parkenv.lots.osm.elements import OsmElement, place_name, read_map
from parkenv.lots.osm.spaces import is_space
from parkenv.world.drive_graph import component_labels

SAME_CAR_PARK = 22.0
"""Distance, m, between spaces up to which they belong to one car park: a street with verges, or two aisles."""
AROUND = 60.0  # distance, m, from the spaces of a car park within which roads and buildings belong to it
LEAST_SPACES = 10  # number of spaces of the smallest car park, by default
MOST_IN_TOWN = 300_000
"""Maximum number of spaces in one file."""


@dataclass(frozen=True, eq=False)
class CarPark:
    """What became of one car park of a town."""

    name: str
    spaces: int  # number of outlines
    draft: LotDraft | None  # its lot
    reason: str = ""  # why there is none


def import_car_parks(
    path: str | Path, options: ImportOptions, least: int = LEAST_SPACES
) -> Iterator[CarPark]:
    """Yield the car parks of a town, the largest first.

    Args:
        path: an OpenStreetMap file with outlines of parking spaces.
        options: whether entries and goals may be guessed, and which spaces count.
        least: number of spaces below which a group of spaces is no car park.
    """
    path = Path(path)
    place = read_map(path)
    with naming(path):
        parts = list(split_town(place_name(path), place.elements, least))
    for name, part in parts:
        count = sum(map(is_space, part))
        try:
            draft = draft_of_map(name, replace(place, elements=part), options, place.positions.frame)
            draft.lot()
        except InputError as error:
            yield CarPark(name, count, None, str(error))
        else:
            yield CarPark(name, count, draft)


def split_town(
    name: str, elements: Sequence[OsmElement], least: int
) -> Iterator[tuple[str, list[OsmElement]]]:
    """Yield the name and the elements of each group of at least `least` spaces, the largest first."""
    spaces = [e for e in elements if is_space(e)]
    if not spaces:
        raise InputError("no amenity=parking_space in it, want their outlines to find car parks")
    if len(spaces) > MOST_IN_TOWN:
        raise InputError(f"{len(spaces):,} parking spaces, want at most {MOST_IN_TOWN:,} in one file")
    frame = map_frame(spaces)
    shapes = np.array([_hull(e, frame.to_xy(np.concatenate(e.lines))) for e in spaces], dtype=object)
    near = shapely.STRtree(shapes).query(shapes, predicate="dwithin", distance=SAME_CAR_PARK)
    label = component_labels(near.T, len(spaces))
    size = np.bincount(label)
    first = np.array([int(np.flatnonzero(label == k)[0]) for k in range(len(size))])
    chosen = [k for k in np.lexsort((first, -size)).tolist() if size[k] >= least]
    if not chosen:
        raise InputError(
            f"{len(spaces)} parking spaces in groups of at most {size.max()}, want a group of {least}"
        )
    others = [e for e in elements if not is_space(e)]
    around = np.array([_hull(e, frame.to_xy(np.concatenate(e.lines))) for e in others], dtype=object)
    tree = shapely.STRtree(around)
    digits = len(str(len(chosen)))
    for number, k in enumerate(chosen, start=1):
        members = np.flatnonzero(label == k)
        ground = shapely.union_all(shapes[members])
        around_it: list[int] = np.sort(tree.query(ground, predicate="dwithin", distance=AROUND)).tolist()
        yield (
            f"{name}-{number:0{digits}d}",
            [spaces[i] for i in members.tolist()] + [others[i] for i in around_it],
        )


def _hull(element: OsmElement, xy: FloatArray) -> shapely.Geometry:
    """Return a shape that is valid for every element."""
    if element.tags.get("highway") and not element.is_node:
        return shapely.LineString(xy)
    return shapely.convex_hull(shapely.MultiPoint(xy))
