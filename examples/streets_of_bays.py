"""Draw streets between the bays of a city's register, where no map is at hand.

    python examples/streets_of_bays.py REGISTER --out streets.osm [--columns lat=LAT,lon=LON,...]
    parkenv lot import streets.osm --bays REGISTER --out kerbs.geojson

The streets are a guess from the bays' own geometry, not a map. Bays in line are a row; a street runs half-way between
two rows that face each other, or beside a single one: in line with a street further on, else 3 m to the left. Streets
in line are joined, extended to their crossings, and linked by the shortest ways into one network. All are two-way;
there are no turn restrictions, and a link may cut through a block. It takes some seconds for 4,000 bays.
"""

import argparse
import re
from collections import Counter
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
import shapely
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from shapely.ops import substring

from parkenv.lots.bays.register import read_bays
from parkenv.lots.local_frame import LocalFrame

NEIGHBOUR, IN_LINE, ROOM = (
    25.0,
    2.0,
    (2.6, 22.0),
)  # m, within a row; off its line; between cars in facing rows
KERB_DEPTH = 2.1  # m, of a parked car beside a point or a line at the kerb
BESIDE, BLOCK, EXTEND = 3.0, 130.0, 45.0  # m, from a single row; between rows of one street; up to a crossing
STEP, GRID = 12.0, 0.02  # m, between points of a street; to which all is rounded


def groups(pairs, n):
    return connected_components(
        coo_array((np.ones(len(pairs)), tuple(np.array(pairs).reshape(-1, 2).T)), (n, n))
    )[1]


def rows_of(register, frame):
    """Return rows of bays, (m, 2, 2) m from end to end, their half depths, m, and the names of their streets."""
    shapes = shapely.transform(register.shapes, frame.to_xy)
    kind, names = shapely.get_type_id(shapes), register.streets.astype(str)
    xy, is_outline = shapely.get_coordinates(shapely.centroid(shapes)), kind == 3
    pairs = cKDTree(xy).query_pairs(NEIGHBOUR, output_type="ndarray")
    pairs = pairs[(names[pairs[:, 0]] == names[pairs[:, 1]]) & (kind[pairs] != 1).all(axis=1)]
    step = xy[pairs[:, 1]] - xy[pairs[:, 0]]
    # The nearest neighbours tell the direction of a row: angles are doubled, as it has two.
    pull = np.exp(2j * np.arctan2(step[:, 1], step[:, 0])) / np.maximum(np.hypot(*step.T), 1.0) ** 3
    total = np.zeros(len(xy), complex)
    for k in (0, 1):
        np.add.at(total, pairs[:, k], pull)
    angle, depth = np.angle(total) / 2, np.full(len(xy), KERB_DEPTH)
    # Outlines are along their row or across it.
    box = shapely.get_coordinates(shapely.oriented_envelope(shapes[is_outline])).reshape(-1, 5, 2)
    sides = np.diff(box, axis=1)[:, :2]
    own, size = np.arctan2(sides[..., 1], sides[..., 0]), np.hypot(sides[..., 0], sides[..., 1])
    fits = np.where(
        (total[is_outline] == 0)[:, None], size, np.abs(np.cos(own - angle[is_outline, None]))
    ).argmax(axis=1)
    angle[is_outline] = own[np.arange(len(own)), fits]
    depth[is_outline] = size[np.arange(len(own)), 1 - fits] / 2
    along = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    off = [np.abs(along[pairs[:, k], 0] * step[:, 1] - along[pairs[:, k], 1] * step[:, 0]) for k in (0, 1)]
    turn = np.abs((along[pairs[:, 0]] * along[pairs[:, 1]]).sum(axis=1))
    row = groups(pairs[(np.maximum(*off) < IN_LINE) & (turn > 0.9)], len(xy))
    rows = []
    for k in range(row.max() + 1):
        own = np.flatnonzero(row == k)
        middle, axis = xy[own].mean(axis=0), along[own[0]]
        if len(own) > 2:
            axis = np.linalg.svd(xy[own] - middle)[2][0]
        run = (xy[own] - middle) @ axis
        ends = np.array([middle + (run.min() - 3.0) * axis, middle + (run.max() + 3.0) * axis])
        if kind[own[0]] == 1:
            ends = shapely.get_coordinates(shapes[own[0]])[[0, -1]]
        rows.append((ends, np.median(depth[own]), Counter(names[own].tolist()).most_common(1)[0][0]))
    ends, depths, streets = zip(*rows, strict=True)
    return np.array(ends), np.array(depths), streets


def beside(ends, others):
    """Return how far others run beside each row, (m, k) m: signed distances, overlaps (negative: gaps), and angles."""
    along = (ends[:, 1] - ends[:, 0]) / np.hypot(*(ends[:, 1] - ends[:, 0]).T)[:, None]
    to = others[None] - ends[:, None, :1]
    run = np.einsum("mkij,mj->mki", to, along)
    lateral = (along[:, None, None, 0] * to[..., 1] - along[:, None, None, 1] * to[..., 0]).mean(axis=2)
    length = np.hypot(*(ends[:, 1] - ends[:, 0]).T)[:, None]
    overlap = np.minimum(run.max(axis=2), length) - np.maximum(run.min(axis=2), 0.0)
    of = (others[:, 1] - others[:, 0]) / np.hypot(*(others[:, 1] - others[:, 0]).T)[:, None]
    return lateral, overlap, np.degrees(np.arccos(np.clip(np.abs(along @ of.T), 0.0, 1.0)))


def centre_lines(rows, depth, names):
    """Return a piece of a street beside each row, (m, 2, 2) m."""
    lateral, overlap, turn = beside(rows, rows)
    room = np.abs(lateral) - depth[:, None] - depth
    facing = (turn < 12.0) & (overlap > 6.0) & (room > ROOM[0]) & (room < ROOM[1])
    nearest = np.where(facing, np.abs(lateral), np.inf).argmin(axis=1)
    each = np.arange(len(rows))
    near = np.sign(lateral[each, nearest])
    shift = np.where(
        facing.any(axis=1), (lateral[each, nearest] + near * (depth - depth[nearest])) / 2, np.nan
    )
    along = (rows[:, 1] - rows[:, 0]) / np.hypot(*(rows[:, 1] - rows[:, 0]).T)[:, None]
    left = np.stack([-along[:, 1], along[:, 0]], axis=1)[:, None]
    known = np.isfinite(shift)
    lines = rows + np.where(known, shift, 0.0)[:, None, None] * left
    shift = np.where(known, shift, depth + BESIDE)
    if known.any() and not known.all():
        lateral, overlap, turn = beside(rows[~known], lines[known])
        room = np.abs(lateral) - depth[~known, None]
        in_line = (turn < 8.0) & (overlap > -BLOCK) & (room > 1.5) & (room < ROOM[1] / 2)
        best = np.where(in_line, -overlap, np.inf).argmin(axis=1)
        # House numbers tell the side: odd ones are all on one.
        parity = np.array(
            [int(number[1]) % 2 if (number := re.match(r"(\d+)\s", name)) else 2 for name in names]
        )
        alike = (parity[~known, None] == parity[known]) & (parity[known] < 2) & (turn < 25.0)
        away = np.linalg.norm(rows[~known].mean(axis=1)[:, None] - lines[known].mean(axis=1), axis=2)
        vote = (alike * np.exp(-away / 300.0)) @ (shift[known, None] * left[known, 0])
        side = np.where((vote * left[~known, 0]).sum(axis=1) < 0.0, -1.0, 1.0)
        shift[~known] = np.where(
            in_line.any(axis=1), lateral[np.arange(len(best)), best], side * shift[~known]
        )
    return rows + shift[:, None, None] * left


def streets_of(pieces):
    """Return streets, LineStrings: pieces in line as one, extended at both ends."""
    lateral, overlap, turn = beside(pieces, pieces)
    near = (turn < 8.0) & (overlap > -BLOCK) & (np.abs(lateral) < 3.0) & (np.abs(lateral.T) < 3.0)
    street, lines = groups(np.argwhere(near), len(pieces)), []
    for k in range(street.max() + 1):
        own = shapely.get_coordinates(shapely.segmentize(shapely.linestrings(pieces[street == k]), STEP / 3))
        axis = np.linalg.svd(own - own.mean(axis=0), full_matrices=False)[2][0]
        run = (own - own.mean(axis=0)) @ axis
        step = np.round(run / STEP).astype(int)
        points = [own[step == i].mean(axis=0) for i in np.unique(step)[1:-1]]
        line = shapely.simplify(shapely.LineString([own[run.argmin()], *points, own[run.argmax()]]), 1.5)
        lines.append(line)
    return lines


def network(lines, bays):
    """Return the parts between crossings of one connected network, LineStrings; links to it keep clear of bays."""
    whole = []
    for line in lines:
        xy = shapely.get_coordinates(line)
        first, last = (d / np.hypot(*d) for d in (xy[0] - xy[1], xy[-1] - xy[-2]))
        whole.append(shapely.LineString([xy[0] + EXTEND * first, *xy, xy[-1] + EXTEND * last]))
    tree, cut = shapely.STRtree(whole), []
    for k, line in enumerate(whole):
        others = np.setdiff1d(tree.query(line, predicate="intersects"), [k])
        met = shapely.get_coordinates(shapely.intersection(line, np.array(whole)[others]))
        at = shapely.line_locate_point(line, shapely.points(met))
        cut.append(substring(line, min([EXTEND, *at]), max([line.length - EXTEND, *at])))
    while True:
        parts = shapely.get_parts(shapely.union_all(cut, grid_size=GRID))
        group = groups(ends_of(parts), ends_of(parts).max() + 1)[ends_of(parts)[:, 0]]
        _, group = np.unique(group, return_inverse=True)
        if group.max() == 0:
            return parts
        here, there = (shapely.union_all(parts[is_here]) for is_here in (group == 0, group != 0))
        links = shapely.shortest_line(shapely.points(shapely.get_coordinates(here)), there)
        through = shapely.STRtree(bays).query(links, predicate="dwithin", distance=1.0)[0]
        cost = shapely.length(links) * np.where(np.isin(np.arange(len(links)), through), 5.0, 1.0)
        cut = [*parts, links[cost.argmin()]]


def ends_of(parts):
    """Return the numbers of the nodes at both ends of each part, (n, 2)."""
    ends = np.stack([shapely.get_coordinates(shapely.get_point(parts, k)) for k in (0, -1)], axis=1)
    keys = np.round(ends.reshape(-1, 2) / GRID).astype(int)
    return np.unique(keys, axis=0, return_inverse=True)[1].reshape(-1, 2)


def write_osm(path, parts, names, frame):
    numbers, nodes, ways = {}, [], []
    for k, (part, name) in enumerate(zip(parts, names, strict=True), start=1):
        refs = []
        for lon, lat in frame.to_lonlat(shapely.get_coordinates(part)).round(7).tolist():
            if (lon, lat) not in numbers:
                numbers[lon, lat] = len(numbers) + 1
                nodes.append(f'<node id="{len(numbers)}" lat="{lat:.7f}" lon="{lon:.7f}"/>')
            refs.append(f'<nd ref="{numbers[lon, lat]}"/>')
        tags = f'<tag k="highway" v="residential"/><tag k="name" v={quoteattr(name)}/>'
        ways.append(f'<way id="{k}">{"".join(refs)}{tags}</way>')
    path.write_text("\n".join(['<osm version="0.6">', *nodes, *ways, "</osm>"]), encoding="utf-8")


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument(
        "register", type=Path, nargs="?", default=Path("bays.csv"), help="default: a made one"
    )
    parser.add_argument("--out", type=Path, default=Path("streets.osm"))
    parser.add_argument("--columns", help="as of `parkenv lot import --bays`")
    given = parser.parse_args()
    if not given.register.exists():
        made = [(48.0, 7.85 + 1e-4 * k) for k in range(9)] + [(48.0002 + 7e-5 * k, 7.8512) for k in range(9)]
        lines = (f"{k},{lat:.6f},{lon:.6f}" for k, (lat, lon) in enumerate(made))
        given.register.write_text("\n".join(["bay_id,lat,lon", *lines]))
    register = read_bays(given.register, given.columns)
    frame = LocalFrame.around(shapely.get_coordinates(shapely.centroid(register.shapes)))
    rows, depth, names = rows_of(register, frame)
    pieces = centre_lines(rows, depth, names)
    parts = network(streets_of(pieces), shapely.transform(register.shapes, frame.to_xy))
    nearest = shapely.STRtree(shapely.linestrings(pieces)).nearest(
        shapely.line_interpolate_point(parts, 0.5, normalized=True)
    )
    titles = [re.sub(r"^\d+\s+|\s+between\s.*", "", names[k]) for k in nearest]
    write_osm(given.out, parts, titles, frame)
    print(
        f"{len(register.ids)} bays in {len(rows)} rows, {shapely.length(parts).sum() / 1e3:.1f} km of streets"
    )


if __name__ == "__main__":
    main()
