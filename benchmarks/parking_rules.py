"""Fit the rules by which a town has places where its map says none, and state their errors.

`python benchmarks/parking_rules.py NEUKOELLN_FOLDER [EXTRACT.osm.pbf ...]`

The folder holds the parking of Berlin-Neukölln (ODbL) as GeoJSON: `parking_way` (kerbs with capacities),
`streets_processed_epsg25833` (street lines) and `parking_area`; extracts of OpenStreetMap add car parks with
capacities. Kerbs are fitted on one half of the streets, by name, and judged on the other. Rules of areas are fitted
with each tenth of the car parks left out once, and judged there. The figures go into `parkenv.lots.town.supply` and
`capacity`.
"""

from __future__ import annotations

import json
import sys
import zlib
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import shapely
from pyproj import Transformer

from parkenv.compiled.arrays import BoolArray, FloatArray
from parkenv.files.limited_reading import read_json
from parkenv.lots.local_frame import LocalFrame
from parkenv.lots.osm.elements import read_map
from parkenv.lots.osm.parking import Junctions, areas_of, is_parking_area
from parkenv.lots.osm.roads import Road, road_of, whole_number
from parkenv.lots.town.supply import KINDS, PLACES_PER_METRE, RULES, levels_of, rule_of
from parkenv.world.drive_graph import linestrings

COUNTED = ("OSM", "document", "aerial imagery", "survey")
"""Sources of capacities of car parks that are no estimates."""
POINTS_EVERY = 5.0  # m, between the points of a kerb that are matched with streets
STREET_WITHIN = 40.0  # m, from a kerb, of its street
SURVEYED_WITHIN = 60.0  # m, from a kerb with places, of streets whose kerbs are known


def kerb_table(folder: Path) -> tuple[list[Road], FloatArray, FloatArray]:
    """Return the streets whose kerbs are known, m of kerb off the corners of each, and its places."""
    ways = read_json(folder / "parking_way.geojson.gz")["features"]
    lines = read_json(folder / "streets_processed_epsg25833.geojson.gz")["features"]
    to_metres = Transformer.from_crs(4326, 25833, always_xy=True).transform
    every, known = [], []
    for feature in lines:
        own = feature["properties"]
        tags = {key: value for key, value in own.items() if value is not None}
        road = road_of(own["id"], tags, np.array(feature["geometry"]["coordinates"])[:, :2])
        if isinstance(road, Road):
            every.append(road)
            known.append(own["error_output"] is None)
    junctions = Junctions(every, np.empty((0, 2)))
    free = np.zeros(len(every))
    for k in range(len(every)):
        for side in ("left", "right"):
            free[k] += sum(b - a for a, b in junctions.free_intervals(k, side))
    names = np.array([road.tags.get("name", "") for road in every])
    shapes = linestrings([road.points for road in every])
    # A kerb may stand beside several ways of its street: each of its points belongs to the nearest one of its name.
    ground = shapely.transform(
        shapely.from_geojson([json.dumps(feature["geometry"]) for feature in ways]),
        lambda lonlat: np.column_stack(to_metres(*lonlat.T)),
    )
    stations = [np.arange(0.5, max(round(line.length / POINTS_EVERY), 1)) for line in ground]
    of = np.repeat(np.arange(len(ways)), [len(at) for at in stations])
    points = shapely.line_interpolate_point(
        shapely.line_merge(ground)[of],
        np.concatenate([at / len(at) for at in stations]),
        normalized=True,
    )
    point, near = shapely.STRtree(shapes).query(points, predicate="dwithin", distance=STREET_WITHIN)
    own_name = np.array([feature["properties"]["highway:name"] or "" for feature in ways])
    away = shapely.distance(points[point], shapes[near]) + STREET_WITHIN * (
        names[near] != own_name[of[point]]
    )
    order = np.lexsort((away, point))
    _, first = np.unique(point[order], return_index=True)
    chosen = order[first]
    capacity = np.array([feature["properties"]["capacity"] or 0 for feature in ways], np.float64)
    share = capacity[of] / np.bincount(of)[of]
    places: FloatArray = np.bincount(near[chosen], share[point[chosen]], minlength=len(every)).astype(
        np.float64
    )
    # Streets of other districts have tags, but their kerbs are not in the file.
    middle = shapely.line_interpolate_point(shapes, 0.5, normalized=True)
    surveyed = shapely.dwithin(middle, shapely.union_all(ground), SURVEYED_WITHIN)
    index = np.flatnonzero((np.array(known) & surveyed) | (places > 0.0))
    return [every[k] for k in index], free[index], places[index]


def fit_kerbs(
    roads: Sequence[Road], free: FloatArray, places: FloatArray, chosen: BoolArray
) -> dict[str, float]:
    """Return places per metre of kerb by class of street, of the chosen streets."""
    kind = np.array([road.tags["highway"] for road in roads])
    return {
        name: float(places[chosen & (kind == name)].sum() / max(free[chosen & (kind == name)].sum(), 1.0))
        for name in PLACES_PER_METRE
    }


def judge_kerbs(roads: Sequence[Road], free: FloatArray, places: FloatArray, rule: dict[str, float]) -> str:
    """Say how well a rule tells the places of streets: in total, and by named street."""
    expected = np.array([rule.get(road.tags["highway"], 0.0) for road in roads]) * free
    names = [road.tags.get("name", road.id) for road in roads]
    _, street = np.unique(names, return_inverse=True)
    by_street = [np.bincount(street, values) for values in (expected, places)]
    correlation = np.asarray(np.corrcoef(by_street))[0, 1]
    return (
        f"{expected.sum():,.0f} of {places.sum():,.0f} places ({expected.sum() / places.sum() - 1:+.1%}), "
        f"correlation by street {correlation:.2f} ({len(by_street[0])} streets)"
    )


def car_parks(folder: Path, extracts: Iterable[Path]) -> dict[str, FloatArray]:
    """Return area, m², levels (0: unknown) and counted places of car parks, (n, 3) by rule."""
    rows: dict[str, list[tuple[float, float, float]]] = {name: [] for name in RULES}
    for feature in read_json(folder / "parking_area.geojson.gz")["features"]:
        own = feature["properties"]
        rule = KINDS.get(own["parking"], "surface" if own["parking"] == "surface" else "")
        if rule and own["source:capacity"] in COUNTED and own["capacity"]:
            rows[rule].append((own["area"], own["parking:levels"] or 0.0, own["capacity"]))
    for path in extracts:
        parking = [e for e in read_map(path).elements if is_parking_area(e) and not e.is_node and not e.cut]
        frame = LocalFrame.around(np.concatenate([line for e in parking for line in e.lines]))
        for area in areas_of(parking, frame, is_parking_area, mended=True):
            tags, size = area.element.tags, float(shapely.area(area.polygon))
            capacity = whole_number(tags.get("capacity"))
            if capacity and size and tags.get("parking", "surface") in ("surface", *KINDS):
                rows[rule_of(tags)].append((size, levels_of(tags) or 0.0, capacity))
    return {name: np.array(found).reshape(-1, 3) for name, found in rows.items()}


def fit_areas(name: str, parks: FloatArray) -> tuple[float, float, float]:
    """Return the factor, the power and the usual levels of a rule; only the power of open car parks is free."""
    levels = RULES[name].levels
    known = parks[:, 1] > 0.0
    if name == "multi-storey" and known.any():
        of_level = parks[known, 2].sum() / (parks[known, 0] * parks[known, 1]).sum()
        levels = float(parks[:, 2].sum() / (parks[:, 0].sum() * of_level))
    floor = parks[:, 0] * np.where(known, parks[:, 1], levels)
    power = float(np.polyfit(np.log(floor), np.log(parks[:, 2]), 1)[0]) if name == "surface" else 1.0
    return float(parks[:, 2].sum() / (floor**power).sum()), power, levels


def judge_areas(name: str, parks: FloatArray) -> str:
    """Say how far a rule is off on car parks that it was not fitted to."""
    fold, expected = np.arange(len(parks)) % 10, np.zeros(len(parks))
    for k in range(10):
        here = fold == k
        if here.any() and not here.all():
            factor, power, levels = fit_areas(name, parks[~here])
            floor = parks[here, 0] * np.where(parks[here, 1] > 0.0, parks[here, 1], levels)
            expected[here] = factor * floor**power
    off = np.abs(expected - parks[:, 2]) / parks[:, 2]
    return (
        f"{expected.sum():,.0f} of {parks[:, 2].sum():,.0f} places ({expected.sum() / parks[:, 2].sum() - 1:+.1%}), "
        f"half of {len(parks)} car parks within {np.median(off):.0%}"
    )


def main(arguments: Sequence[str]) -> None:
    """Print the rules, and how well they tell what is known."""
    folder = Path(arguments[0])
    roads, free, places = kerb_table(folder)
    # Whole streets are in one half: by a checksum of their names.
    half = np.array([zlib.crc32(road.tags.get("name", road.id).encode()) % 2 == 0 for road in roads])
    lines = [f"kerbs, all: {fit_kerbs(roads, free, places, np.ones(len(roads), bool))}"]
    lines.append(f"rule in use: {judge_kerbs(roads, free, places, PLACES_PER_METRE)}")
    for chosen in (half, ~half):
        rule = fit_kerbs(roads, free, places, chosen)
        rest = np.flatnonzero(~chosen)
        lines.append(
            f"fitted on the other half: {judge_kerbs([roads[k] for k in rest], free[rest], places[rest], rule)}"
        )
    for name, parks in car_parks(folder, map(Path, arguments[1:])).items():
        if len(parks) > 1:
            factor, power, levels = fit_areas(name, parks)
            lines.append(
                f"{name}: {factor:.4f} places of a m² to the power {power:.4f}, {levels:.1f} levels, typical "
                f"{np.median(parks[:, 2]):.0f}; left out: {judge_areas(name, parks)}"
            )
    sys.stdout.write("\n".join(lines) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
