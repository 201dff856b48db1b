"""Maps of other tools and other habits: barriers, left-hand traffic, exports that say things twice."""

import numpy as np
import pytest
from made_maps import FREIBURG, STREET, Map
from scipy.sparse.csgraph import dijkstra

from parkenv.lots.town.draft import import_town

PASSES = [
    {},
    {"barrier": "gate", "motor_vehicle": "yes"},
    {"barrier": "gate", "access": "permissive"},
    {"barrier": "bollard", "access": "no", "motorcar": "yes"},
    {"barrier": "cattle_grid"},
    {"barrier": "toll_booth"},
    {"barrier": "kerb", "kerb": "lowered"},
    {"barrier": "swing_gate", "locked": "no"},
    {"highway": "crossing", "access": "no"},
]
STOPS = [
    *({"barrier": kind} for kind in ("bollard", "block", "lift_gate", "chain", "cycle_barrier", "planter")),
    {"barrier": "bollard", "bollard": "removable", "bicycle": "yes"},
    {"barrier": "gate", "access": "private"},
    {"barrier": "entrance", "vehicle": "no"},
    {"barrier": "gate", "access": "yes", "locked": "yes"},
    {"barrier": "kerb", "kerb": "raised"},
    {"motor_vehicle": "no"},
]


def blocks(tags, at=(100, 0)):
    """Two streets side by side, joined at their ends, with a node on the first one."""
    place = Map().way([(0, 0), (100, 0)], STREET).way([(100, 0), (200, 0)], STREET)
    place.way([(0, 0), (0, 90), (200, 90), (200, 0)], STREET, name="Umweg")
    place.way([(0, 0), (-90, 0)], STREET).way([(200, 0), (290, 0)], STREET).way(
        [(100, 0), (100, -90)], STREET
    )
    place.box(150, 20, 160, 30, {"amenity": "parking", "capacity": "9"})
    place.box(60, 20, 80, 30, {"building": "house"})
    return place.node(*at, **tags)


def metres(lot, one, other):
    """The way from one place to another along the lanes, m."""
    near = [int(np.hypot(*(lot.vertex_xy - at).T).argmin()) for at in (one, other)]
    return float(dijkstra(lot.drive_matrix(), indices=near[0])[near[1]])


@pytest.mark.parametrize(("tags", "passes"), [(t, True) for t in PASSES] + [(t, False) for t in STOPS])
def test_cars_pass_no_node_that_stops_them(tmp_path, tags, passes):
    """At a junction between two ways, in each format."""
    place = blocks(tags)
    (tmp_path / "t.geojson").write_text(place.geojson())
    for path in (place.write(tmp_path / "t.osm"), tmp_path / "t.geojson"):
        town = import_town(path).draft
        lot, corner = town.lot(), FREIBURG.to_lonlat([[0, 0], [200, 0]])
        assert metres(lot, *town.frame.to_xy(corner)) == pytest.approx(200 if passes else 380, abs=5)
