"""Where the people of a town go: buildings and points of interest as weights of demand, in some hundred goals.

A building attracts by its floor area: its outline times its levels (tagged, or usual for its kind), and a shop,
restaurant, office or the like that is mapped as a point by a nominal area. What kind of building or point attracts whom
is `BUILDINGS` and `POINTS`; a building of unknown kind is a dwelling, unless a point within it says otherwise. Weights
are thousands of square metres; all that is near each other becomes one goal.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import shapely

from parkenv.compiled.arrays import FloatArray
from parkenv.errors import with_extra
from parkenv.lots.local_frame import LocalFrame
from parkenv.lots.osm.areas import Area
from parkenv.lots.osm.elements import OsmElement
from parkenv.lots.town.supply import levels_of

PURPOSES = ("residents", "commuters", "shoppers", "visitors", "deliveries")
MOST_GOALS = 100
APART = 40.0  # m, least distance of goals in a small map, on average
STREET_WITHIN = 300.0  # m, from the streets of a town, of what attracts anybody
WALK_WITHIN = 500.0  # m, from car parks whose drivers alone are wanted
LEAST_AREA = 30.0  # m², of buildings that anybody lives in
DWELLING = {"residents": 1.0, "visitors": 0.05, "deliveries": 0.05}
WORK = {"commuters": 1.0, "visitors": 0.1, "deliveries": 0.1}
SHOP = {"shoppers": 1.0, "commuters": 0.2, "deliveries": 0.4}
LEISURE = {"visitors": 1.0, "commuters": 0.1, "deliveries": 0.1}
PUBLIC = {"visitors": 0.5, "commuters": 0.5, "deliveries": 0.05}
BUILDINGS: dict[str, tuple[float, dict[str, float]]] = {
    **dict.fromkeys(
        ("house", "detached", "semidetached_house", "terrace", "bungalow", "farm"), (2.0, DWELLING)
    ),
    **dict.fromkeys(("yes", "residential", "block"), (2.0, DWELLING)),
    **dict.fromkeys(("apartments", "dormitory"), (4.0, DWELLING)),
    **dict.fromkeys(("office", "commercial", "government"), (3.0, WORK)),
    **dict.fromkeys(
        ("industrial", "manufacture", "warehouse"), (1.0, {"commuters": 0.3, "deliveries": 0.05})
    ),
    **dict.fromkeys(("retail", "supermarket", "kiosk", "mall"), (1.0, SHOP)),
    **dict.fromkeys(
        ("hotel", "cinema", "theatre", "stadium", "sports_hall", "sports_centre"), (2.0, LEISURE)
    ),
    **dict.fromkeys(("school", "kindergarten", "university", "college", "hospital"), (2.0, PUBLIC)),
    **dict.fromkeys(("public", "civic", "church", "train_station", "fire_station"), (1.0, PUBLIC)),
}
"""Usual levels of a `building`, and whom a square metre of its floor attracts; of others nobody."""
POINTS: dict[str, tuple[float, dict[str, float]]] = {
    "shop": (150.0, SHOP),
    "office": (200.0, WORK),
    "craft": (150.0, WORK),
    "healthcare": (200.0, PUBLIC),
    "tourism": (300.0, LEISURE),
    "leisure": (300.0, LEISURE),
    **dict.fromkeys(("restaurant", "pub", "bar", "cafe", "fast_food", "nightclub"), (150.0, LEISURE)),
    **dict.fromkeys(
        ("cinema", "theatre", "library", "community_centre", "place_of_worship"), (400.0, LEISURE)
    ),
    **dict.fromkeys(("bank", "post_office", "pharmacy", "marketplace"), (200.0, SHOP)),
    **dict.fromkeys(("doctors", "dentist", "clinic", "hospital", "townhall", "courthouse"), (300.0, PUBLIC)),
    **dict.fromkeys(("school", "kindergarten", "university", "college"), (500.0, PUBLIC)),
}
"""Nominal floor, m², of a point with a key (`shop`, `office`, ...) or an `amenity`, and whom it attracts."""
QUIET = {
    "tourism": ("information", "artwork", "viewpoint"),
    "leisure": ("garden", "pitch", "playground", "park"),
}
"""Values of keys that no car comes for."""


def find_goals(
    elements: Sequence[OsmElement],
    buildings: Sequence[Area],
    frame: LocalFrame,
    streets: shapely.STRtree,
    beside: FloatArray | None = None,
) -> tuple[FloatArray, dict[str, FloatArray]]:
    """Return at most `MOST_GOALS` goals, (n, 2) m, and their weights by purpose, (n,) each; none without buildings.

    What is farther than `STREET_WITHIN` from all streets does not count, nor what is farther than `WALK_WITHIN` from
    all points `beside`, (k, 2) m, if there are any.
    """
    xy, weight = _sources(elements, buildings, frame)
    near = np.unique(streets.query(shapely.points(xy), predicate="dwithin", distance=STREET_WITHIN)[0])
    if beside is not None:
        walk = shapely.distance(shapely.multipoints(beside), shapely.points(xy[near]))
        near = near[walk <= WALK_WITHIN]
    xy, weight = xy[near], weight[near]
    if not len(xy):
        return np.empty((0, 2)), {}
    # Every purpose counts alike where goals lie, however large its numbers are.
    share = (weight / np.maximum(weight.sum(axis=0), 1e-9)).sum(axis=1)
    used = share > 0.0
    xy, weight, share = xy[used], weight[used], share[used]
    extent = float(np.prod(np.ptp(xy, axis=0) + 1.0))
    count = min(MOST_GOALS, len(np.unique(np.round(xy), axis=0)), max(int(extent / APART**2), 1))
    label = _clusters(xy, share, count)
    total = np.bincount(label, share, minlength=count)
    kept = np.flatnonzero(total > 0.0)
    goals = np.stack(
        [np.bincount(label, share * axis, minlength=count)[kept] / total[kept] for axis in xy.T], axis=1
    )
    weights = {
        purpose: np.round(np.bincount(label, weight[:, k], minlength=count)[kept] / 1e3, 3)
        for k, purpose in enumerate(PURPOSES)
    }
    return goals, {purpose: values for purpose, values in weights.items() if values.any()}


def _clusters(xy: FloatArray, share: FloatArray, count: int) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    with with_extra("a town", "osm"):
        from sklearn.cluster import KMeans

    found = KMeans(count, n_init=1, max_iter=30, random_state=0).fit(xy, sample_weight=share)
    return np.asarray(found.labels_, np.int64)


def _sources(
    elements: Sequence[OsmElement], buildings: Sequence[Area], frame: LocalFrame
) -> tuple[FloatArray, FloatArray]:
    """Return where anything attracts people, (n, 2) m, and how much, (n, n_purposes) m² of floor."""
    positions: list[FloatArray] = []
    rows: list[list[float]] = []

    def add(at: FloatArray, floor: float, kind: Mapping[str, float]) -> None:
        positions.append(at)
        rows.append([floor * kind.get(purpose, 0.0) for purpose in PURPOSES])

    area = shapely.area([a.polygon for a in buildings])
    middle = shapely.get_coordinates(shapely.point_on_surface([a.polygon for a in buildings]))
    own = {a.element.id for a in buildings}
    points = [(e, found) for e in elements if e.id not in own and (found := _point_of(e.tags)) is not None]
    here = np.array([frame.to_xy(e.lines[0]).mean(axis=0) for e, _ in points]).reshape(-1, 2)
    tree = shapely.STRtree([a.polygon for a in buildings])
    spoken_for = set(tree.query(shapely.points(here), predicate="intersects")[1].tolist())
    for (_, (floor, attracts)), at in zip(points, here, strict=True):
        add(at, floor, attracts)
    for k, building in enumerate(buildings):
        tags = building.element.tags
        levels, attracts = BUILDINGS.get(tags["building"], (1.0, {}))
        floor = float(area[k]) * (levels_of(tags) or levels)
        point = _point_of(tags)
        if point is not None:
            attracts = point[1]
        elif tags["building"] == "yes" and k in spoken_for:
            floor *= 0.5  # shops below, dwellings above
        if attracts and area[k] >= LEAST_AREA:
            add(middle[k], floor, attracts)
    return np.array(positions).reshape(-1, 2), np.array(rows).reshape(-1, len(PURPOSES))


def _point_of(tags: Mapping[str, str]) -> tuple[float, dict[str, float]] | None:
    if found := POINTS.get(tags.get("amenity", "")):
        return found
    for key in ("shop", "office", "craft", "healthcare", "tourism", "leisure"):
        if tags.get(key, "no") not in ("no", "vacant", *QUIET.get(key, ())):
            return POINTS[key]
    return None
