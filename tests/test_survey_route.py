"""The drive past every slot."""

from itertools import pairwise

import numpy as np
import pytest

from parkenv import InputError, Lane, Mouth, ParkingLot
from parkenv.lots import packaged_lot
from parkenv.mapping.route import survey_route

LOTS = ["campus", "jam", "street"]


def legal(lot, a, b):
    return b in lot.neighbors[a]


@pytest.mark.parametrize("name", LOTS)
def test_every_slot_is_passed_on_the_right_and_the_drive_ends_where_it_began(name):
    lot = packaged_lot(name)
    for both_sides in (True, False):
        route = survey_route(lot, both_sides=both_sides)
        assert set(route.vertices.tolist()) >= set(range(lot.n_slots))
        assert route.vertices[0] == route.vertices[-1] == lot.entry_vertices[0]
        np.testing.assert_array_equal(route.path, lot.vertex_xy[route.vertices])
        assert route.length == pytest.approx(np.hypot(*np.diff(route.path, axis=0).T).sum())
    seen, way_of = set(), route.vertices
    for before, vertex, after in zip(way_of[:-2], way_of[1:-1], way_of[2:], strict=True):
        if vertex < lot.n_slots:
            way = lot.vertex_xy[after] - lot.vertex_xy[before]
            off = lot.slot_xy[vertex] - lot.vertex_xy[vertex]
            if way[0] * off[1] - way[1] * off[0] < 0.0:
                seen.add(int(vertex))
    assert seen == set(range(lot.n_slots))


@pytest.mark.parametrize("name", LOTS)
def test_lanes_are_driven_as_they_may_be_but_for_slots_on_their_left(name):
    lot = packaged_lot(name)
    free, strict = survey_route(lot), survey_route(lot, both_sides=True)
    assert all(legal(lot, a, b) for a, b in pairwise(strict.vertices))
    wrong = [(a, b) for a, b in pairwise(free.vertices) if not legal(lot, a, b)]
    assert strict.against == 0
    assert bool(wrong) == (free.against > 0)
    for a, b in wrong:
        assert legal(lot, b, a)


def test_one_aisle_is_driven_there_and_back():
    lot = packaged_lot("mini")
    route = survey_route(lot)
    x = route.path[:, 0]
    there_and_back = 2 * (x.max() - x.min())
    assert there_and_back <= route.length < there_and_back + 5.0  # a little for changing sides at the ends
    visits = np.bincount(route.vertices[route.vertices < lot.n_slots])
    assert (visits == 1).all()


def test_no_way_back_is_said():
    lanes, slot = (
        (Lane([[0.0, 0.0], [20.0, 0.0]], oneway=True),),
        ([[10.0, -5.5]], [-np.pi / 2], [5.0], [2.5]),
    )
    lot = ParkingLot("trap", ("a",), *slot, [Mouth.REAR], lanes, [[0.0, 0.0]], [[5.0, 5.0]])
    with pytest.raises(InputError, match="no drive leads from entry 0 past every slot and back"):
        survey_route(lot)
