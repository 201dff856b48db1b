"""`LotOutline`: the shapes that all drawings of a lot share."""

import numpy as np
import pytest
import shapely

from parkenv.driving.lot_outline import LotOutline
from parkenv.lots import packaged_lot
from parkenv.show.report.lot_data import describe_lot


def polygons(paved):
    return shapely.union_all([shapely.Polygon(rings[0], rings[1:]) for rings in paved])


@pytest.mark.parametrize("name", ["campus", "jam", "street", "mini"])
def test_asphalt_is_where_cars_drive_and_park(name):
    lot = packaged_lot(name)
    outline = LotOutline.of(lot)
    kerbed, asphalt = polygons(outline.paved(apron=0.0)), polygons(outline.paved())
    assert kerbed.symmetric_difference(outline.area.around(np.zeros(2), 1e4)).area == pytest.approx(0.0)
    assert asphalt.contains(kerbed)
    assert all(asphalt.contains(shapely.Polygon(corners)) for corners in outline.slots)
    stops = shapely.points(lot.vertex_xy[: lot.n_slots])
    assert shapely.contains(asphalt, stops).all()
    assert not any(asphalt.contains(shapely.Point(wall[0])) for wall in outline.walls)


@pytest.mark.parametrize("name", ["campus", "street", "mini"])
def test_marks_lie_on_their_lanes_and_entries_lead_in(name):
    lot = packaged_lot(name)
    outline = LotOutline.of(lot)
    one_way = shapely.union_all([shapely.LineString(lane.points) for lane in lot.lanes if lane.oneway])
    assert len(outline.centre_lines) + sum(lane.oneway for lane in lot.lanes) == len(lot.lanes)
    for x, y, yaw in outline.arrows:
        ahead = shapely.Point(x + 0.1 * np.cos(yaw), y + 0.1 * np.sin(yaw))
        assert one_way.distance(shapely.Point(x, y)) < 1e-6
        assert one_way.distance(ahead) < 1e-6
    np.testing.assert_array_equal(outline.entries[:, :2], lot.entries)
    asphalt = polygons(outline.paved())
    onward = outline.entries[:, :2] + 3.0 * np.stack(
        [np.cos(outline.entries[:, 2]), np.sin(outline.entries[:, 2])], 1
    )
    assert shapely.contains(asphalt, shapely.points(onward)).all()


def test_painted_lines_leave_the_mouth_open():
    lot = packaged_lot("campus")
    outline = LotOutline.of(lot)
    lines = shapely.linestrings(outline.slot_lines)
    gap = shapely.distance(lines, shapely.points(lot.mouth_xy()))
    assert gap.min() > 1.0, "half a slot's width away from either side"
    sides = shapely.length(lines)
    np.testing.assert_allclose(sides, 2 * lot.slot_length + lot.slot_width)


def test_the_page_draws_the_same_shapes_to_the_centimetre():
    lot = packaged_lot("street")
    outline, page = LotOutline.of(lot), describe_lot(lot)
    for rings, drawn in zip(outline.paved(), page["paved"], strict=True):
        for ring, flat in zip(rings, drawn, strict=True):
            np.testing.assert_allclose(ring.ravel(), flat, atol=0.0051)
    np.testing.assert_allclose(outline.entries, page["entries"], atol=0.0051)
    assert len(page["buildings"]) + len(page["walls"]) == len(lot.walls)
