"""`LotScene`: the shapes that all pictures of a lot share, and its painters."""

import numpy as np
import pytest
import shapely
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from pictures import shows_color

from parkenv.lots import packaged_lot
from parkenv.show.painters import axes, opencv
from parkenv.show.painters.opencv import MapView
from parkenv.show.scene import PALETTE, SQUARE, Areas, Lines, LotScene, Marks


def polygons(paved):
    return shapely.union_all([shapely.Polygon(rings[0], rings[1:]) for rings in paved])


@pytest.mark.parametrize("name", ["campus", "street", "mini"])
def test_asphalt_is_where_cars_drive_and_park(name):
    lot = packaged_lot(name)
    outline = LotScene.of(lot)
    kerbed, asphalt = polygons(outline.paved(apron=0.0)), polygons(outline.paved())
    assert kerbed.symmetric_difference(outline.area.around(np.zeros(2), 1e4)).area == pytest.approx(0.0)
    assert asphalt.contains(kerbed)
    assert all(asphalt.contains(shapely.Polygon(corners)) for corners in outline.slots)
    assert shapely.contains(asphalt, shapely.points(lot.vertex_xy[: lot.n_slots])).all()
    assert not any(asphalt.contains(shapely.Point(wall[0])) for wall in outline.walls)


@pytest.mark.parametrize("name", ["campus", "street", "mini"])
def test_marks_lie_on_their_lanes_and_entries_lead_in(name):
    lot = packaged_lot(name)
    outline = LotScene.of(lot)
    one_way = shapely.union_all([shapely.LineString(lane.points) for lane in lot.lanes if lane.oneway])
    assert len(outline.centre_lines) + sum(lane.oneway for lane in lot.lanes) == len(lot.lanes)
    for x, y, yaw in outline.arrows:
        ahead = shapely.Point(x + 0.1 * np.cos(yaw), y + 0.1 * np.sin(yaw))
        assert one_way.distance(shapely.Point(x, y)) < 1e-6
        assert one_way.distance(ahead) < 1e-6
    np.testing.assert_array_equal(outline.entries[:, :2], lot.entries)
    asphalt = polygons(outline.paved())
    x, y, yaw = outline.entries.T
    assert shapely.contains_xy(asphalt, x + 3.0 * np.cos(yaw), y + 3.0 * np.sin(yaw)).all()


def test_painted_lines_leave_the_mouth_open():
    lot = packaged_lot("campus")
    lines = shapely.linestrings(LotScene.of(lot).slot_lines)
    gap = shapely.distance(lines, shapely.points(lot.mouth_xy()))
    assert gap.min() > 1.0, "half a slot's width away from either side"
    np.testing.assert_allclose(shapely.length(lines), 2 * lot.slot_length + lot.slot_width)


def test_the_page_draws_the_same_shapes_to_the_centimetre():
    lot = packaged_lot("street")
    scene = LotScene.of(lot)
    page, layers = scene.data(), scene.ground()
    for layer, drawn in zip(layers, page["ground"], strict=False):
        assert drawn["color"] == layer.color
    asphalt = next(layer for layer in page["ground"] if layer["color"] == "asphalt")
    for rings, drawn in zip(scene.paved(), asphalt["areas"], strict=True):
        for ring, flat in zip(rings, drawn, strict=True):
            np.testing.assert_allclose(ring.ravel(), flat, atol=0.0051)
    np.testing.assert_allclose(scene.entries, page["ground"][-1]["marks"], atol=0.0051)
    walls = next(layer["lines"] for layer in page["ground"] if layer["color"] == "wall" and layer["lines"])
    assert len(walls) == len(lot.walls)


def test_both_painters_give_every_layer_its_colour_at_its_place():
    box = np.array([[0.0, 0.0], [8.0, 0.0], [8.0, 6.0], [0.0, 6.0]])
    hole = np.array([[5.0, 1.0], [7.0, 1.0], [7.0, 5.0], [5.0, 5.0]])
    layers = [
        Areas([[box, hole]], "asphalt"),
        Lines([np.array([[0.0, 3.0], [4.0, 3.0]])], "car", 0.8, halo="ink"),
        Marks(np.array([[2.0, 1.0, np.pi / 2], [2.0, 5.0, 0.0]]), SQUARE, ["goal", "entry"], (1.6, 0.4)),
    ]
    view = MapView.around(np.array([5.0, 3.0]), (500, 300), 50.0)
    image = np.full((300, 500, 3), 255, np.uint8)
    opencv.paint(image, view, layers)
    figure = Figure(figsize=(5.0, 3.0), dpi=100)
    ax = figure.add_axes((0, 0, 1, 1), xlim=(0, 10), ylim=(0, 6), aspect="equal")
    ax.set_axis_off()
    axes.paint(ax, layers, 1.0)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    places = {
        "asphalt": [(1.0, 4.5), (2.6, 1.0), (2.0, 5.6)],
        "white": [(6.0, 3.0), (9.0, 3.0)],
        "car": [(2.0, 3.0)],
        "goal": [(2.0, 1.6)],
        "entry": [(2.6, 5.0)],
    }
    for picture in (image, np.asarray(canvas.buffer_rgba())[..., :3]):
        for color, (x, y) in ((name, at) for name in places for at in places[name]):
            found = picture[round(50 * (6 - y)) - 1, round(50 * x)].astype(int)
            np.testing.assert_allclose(found, PALETTE[color], atol=2, err_msg=f"{x}, {y}")
        assert shows_color(picture, PALETTE["ink"]), "the halo"


def test_dashes_end_with_their_line_and_a_small_mark_is_drawn_larger():
    image = np.full((40, 200, 3), 255, np.uint8)
    view = MapView(np.eye(2), 1.0, np.zeros(2))
    line = Lines([np.array([[10.0, 10.0], [150.0, 10.0]])], "goal", px=(2.0, 2.0), dash=(10.0, 10.0))
    small = Marks(np.array([[100.0, 30.0, 0.0]]), SQUARE, "entry", (2.0, 1.0), px=20.0)
    opencv.paint(image, view, [line, small])
    row = (image[9] == PALETTE["goal"]).all(axis=1)
    assert row[[12, 148]].all()
    assert 0.4 < row[10:150].mean() < 0.7
    assert np.ptp(np.flatnonzero((image[29] == PALETTE["entry"]).all(axis=1))) == pytest.approx(20, abs=2)
    assert np.ptp(np.flatnonzero((image[:, 100] == PALETTE["entry"]).all(axis=1))) == pytest.approx(10, abs=2)
