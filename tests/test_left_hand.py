"""Traffic that keeps to the left is the mirror image of traffic that keeps to the right."""

import dataclasses
import json

import numpy as np
import pytest
from command_line import ran
from made_maps import Map
from scipy.spatial import cKDTree
from small_lots import CAR_PARKS

from parkenv import InputError, make_scenario
from parkenv.driving.driven_lines import DrivenLines
from parkenv.engine.sensor_sampler import make_rig
from parkenv.lots import packaged_lot, read_lot, write_lot
from parkenv.lots.draft import LotDraft
from parkenv.lots.town.draft import import_town
from parkenv.world.lot import MOVES, Lane, Mouth, Turn

ACROSS = np.array([-1.0, 1.0])
SWAPPED = [MOVES.index(name) for name in ("up", "down", "right", "left")]
OTHER = np.array([Mouth.REAR, Mouth.RIGHT, Mouth.LEFT])


def mirrored(lot):
    """The mirror image of a lot, west to east, in which cars keep to the other side."""
    return dataclasses.replace(
        lot,
        slot_xy=lot.slot_xy * ACROSS,
        slot_yaw=np.pi - lot.slot_yaw,
        slot_mouth=OTHER[lot.slot_mouth],
        lanes=tuple(Lane(lane.points * ACROSS, lane.oneway, lane.speed) for lane in lot.lanes),
        entries=lot.entries * ACROSS,
        goals=lot.goals * ACROSS,
        walls=tuple(wall * ACROSS for wall in lot.walls),
        turns=tuple(Turn(turn.points * ACROSS, turn.only) for turn in lot.turns),
        left_hand=not lot.left_hand,
    )


# In `mini`, two slots are equally far from the one opposite.
@pytest.mark.parametrize("name", [name for name in CAR_PARKS if name != "mini"])
def test_its_graph_and_what_is_seen_are_mirror_images(name):
    lot = packaged_lot(name)
    image = mirrored(lot)
    np.testing.assert_allclose(image.vertex_xy, lot.vertex_xy * ACROSS, atol=1e-9)
    np.testing.assert_array_equal(image.neighbors[:, SWAPPED], lot.neighbors)
    np.testing.assert_allclose(image.edge_length[:, SWAPPED], lot.edge_length, atol=1e-9)
    for one, other in zip(make_scenario(lot).sight_lines, make_scenario(image).sight_lines, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-9)
    for line, other in zip(DrivenLines(lot).lines, DrivenLines(image).lines, strict=True):
        np.testing.assert_allclose(other.points, line.points * ACROSS, atol=1e-9)
    assert mirrored(image).left_hand is False


def test_its_kerb_side_camera_looks_to_the_left():
    ((name, _, mount),) = make_rig(None, make_scenario(mirrored(packaged_lot("mini")))).cameras
    ((_, _, usual),) = make_rig(None, make_scenario("mini")).cameras
    assert (name, mount.yaw) == ("left", -usual.yaw)


def test_it_is_kept_in_files_and_imports_turn_parked_cars(tmp_path):
    path = tmp_path / "street.geojson"
    write_lot(LotDraft.of_lot(packaged_lot("campus")).in_left_hand_traffic().lot(), path)
    lot = read_lot(path)
    assert lot.left_hand
    assert json.loads(path.read_text())["traffic"] == "left"
    along = lot.slot_mouth != Mouth.REAR
    assert (np.cos(lot.slot_yaw - lot.vertex_yaw[: lot.n_slots])[along] > 0.0).all()
    plain = packaged_lot("campus")
    np.testing.assert_allclose(lot.mouth_xy(), plain.mouth_xy(), atol=1e-9)
    assert lot.n_vertices == plain.n_vertices
    path.write_text(path.read_text().replace('"traffic": "left"', '"traffic": "middle"'))
    with pytest.raises(InputError, match="traffic is 'middle', want 'left' or 'right'"):
        read_lot(path)


def test_the_command_imports_it(tmp_path):
    write_lot(packaged_lot("mini"), tmp_path / "mini.geojson")
    ran("lot", "import", str(tmp_path / "mini.geojson"), "--left-hand", "--out", str(tmp_path / "l.geojson"))
    assert read_lot(tmp_path / "l.geojson").left_hand


@pytest.mark.parametrize("tags", [{}, {"parking:both": "lane", "parking:both:orientation": "diagonal"}])
def test_a_mirrored_town_is_its_mirror_image(tmp_path, tags):
    """A dual carriageway, whose untagged kerbs are the outer ones, a one-way and a two-way street."""
    towns = []
    for sign in (1, -1):
        place = Map()
        for x, y, kind in ((-10, 1, "tertiary"), (10, -1, "tertiary"), (60, 1, "residential")):
            ends = [(sign * -x, -y * 200), (sign * -x, 0), (sign * -x, y * 200)]
            place.way(ends, {"highway": kind, "oneway": "yes", **tags})
        place.way(
            [(sign * 100, -200), (sign * 100, 0), (sign * 100, 200)], {"highway": "residential", **tags}
        )
        for y in (-200, 0, 200):
            place.way(
                [(sign * x, y) for x in (-60, -10, 10, 100)], {"highway": "residential", "parking:both": "no"}
            )
        place.way([(sign * 100, 0), (sign * 200, 0)], {"highway": "primary", "parking:both": "no"})
        for x in (-75, -25, 20, 85, 115):
            place.box(sign * x, -190, sign * (x + 5), 190, {"building": "house"})
        path = place.write(tmp_path / f"{sign}.osm")
        town = import_town(path, left_hand=sign < 0).draft
        towns.append((town.in_left_hand_traffic() if sign < 0 else town).lot())
    right, left = towns
    assert left.n_slots == right.n_slots > 30
    apart, other = cKDTree(left.slot_xy).query(right.slot_xy * ACROSS)
    assert apart.max() < 0.05
    np.testing.assert_allclose(np.cos(left.slot_yaw[other] + right.slot_yaw - np.pi), 1.0, atol=1e-3)
    if not tags:  # no car on the median: the halves are at -10 m and 10 m, the middle of all streets at 70 m
        assert not (np.abs(left.slot_xy[:, 0] - 70.0) < 10.0).any()
