"""Drawn scenes, and scenes in which others move."""

import dataclasses
import math

import numpy as np
import pytest
import shapely
from command_line import ran, rows_in, summary_of
from hypothesis import given, settings
from hypothesis import strategies as st

from parkenv.driving.levels import level_scene
from parkenv.driving.road_users import Crossing, CrossingTraffic, caused_contact
from parkenv.driving.scene_files import read_scene
from parkenv.driving.vehicle import TPCAP, VEHICLES, VehicleParameters, placed
from parkenv.errors import InputError
from planners.driving import manoeuvre
from planners.driving.manoeuvre import Manoeuvre, drive, park, paths_in_scene
from planners.driving.path_tracking import TrackingSettings

CAR = VehicleParameters()
WALKER = Crossing("pedestrian", ((-8.0, 0.0), (8.0, 0.0)), 1.5)


def test_levels_and_road_users_are_in_the_results(tmp_path):
    levels = ("perpendicular-normal", "oblique-moving")
    ran(f"park --levels {','.join(levels)} -n 1 --seed 5 --jobs 1 --out out", cwd=tmp_path)
    rows = summary_of(tmp_path / "out")["levels"]
    assert {(row["agent"], row["level"]) for row in rows} == {("planner", its) for its in levels}
    for row in rows:
        assert (row["scenes"], row["driven"], row["contacts"], row["success"]) == (1, 1, 0, 1.0)
    assert {row["case"] for row in rows_in(tmp_path / "out" / "road_users.csv")} == {"oblique-moving-5"}
    assert (tmp_path / "out" / "manoeuvre.gif").stat().st_size > 1000


@pytest.mark.parametrize("vehicle", VEHICLES.values(), ids=VEHICLES)
def test_every_named_car_parks(vehicle):
    assert park(level_scene("perpendicular-normal", 1, vehicle)).judged.driven


@settings(max_examples=20)
@given(
    st.floats(-6.0, 6.0), st.floats(-3.0, 3.0), st.floats(-3.0, 3.0), st.sampled_from(["pedestrian", "car"])
)
def test_road_users_never_touch_a_car_that_stands(x, y, yaw, kind):
    user = dataclasses.replace(WALKER, kind=kind, way=((-14.0, 0.0), (14.0, 0.0)))
    corners, traffic = CAR.corners(np.array([x, y, yaw])), CrossingTraffic([user])
    car, along = shapely.Polygon(corners), []
    for _ in range(400):
        traffic.advance(0.05, corners, stands=True)
        assert car.distance(shapely.Polygon(traffic.outlines[0])) > 0.0
        along.append(traffic.poses[0, 0])
    ways = shapely.MultiPoint(placed(user.outline, user.poses(np.linspace(0.0, 28.0, 99))).reshape(-1, 2))
    if car.distance(ways.convex_hull) > 0.4:
        assert along[-1] == pytest.approx(14.0)
    else:
        assert along[-1] < 14.0
        assert min(np.diff(along)) < 0.0, "it gives way in the end"


def test_only_a_car_that_moves_causes_a_contact():
    others = np.tile([2.0, 0.0, 0.0], (11, 1))[:, None]
    standing = np.tile([0.0, 0.0, 0.0], (11, 1))
    passing = np.column_stack([np.full(11, 2.0), np.linspace(-9.0, 9.0, 11), np.full(11, math.pi / 2)])
    assert not caused_contact(CAR, standing, (WALKER,), others)
    assert caused_contact(CAR, passing, (WALKER,), others)
    assert not caused_contact(CAR, passing + np.array([9.0, 0.0, 0.0]), (WALKER,), others)


def test_a_car_waits_for_others_that_it_would_touch(monkeypatch):
    hit = 0
    for seed in range(4):
        scene = level_scene("oblique-moving", seed)
        path = next(paths_in_scene(scene))
        states, others = drive(scene, path, TrackingSettings())
        assert Manoeuvre(scene, path, states, 0.0, others).judged.driven
        with monkeypatch.context() as patch:
            patch.setattr(manoeuvre, "is_blocked", lambda *_: False)
            states, others = drive(scene, path, TrackingSettings())
            hit += Manoeuvre(scene, path, states, 0.0, others).judged.contact
    assert hit >= 1


def test_a_scene_in_a_file_has_road_users(tmp_path):
    (tmp_path / "s.toml").write_text(
        'start = [50.0, 3.0, 0.0]\ntarget = [57.0, 3.0, 0.0]\nvehicle = "tpcap"\n'
        '[[crossings]]\nkind = "car"\nway = [[54.0, -20.0], [54.0, 20.0]]\nspeed_mps = 2.0\nbegins_s = 1.5\n'
    )
    scene = read_scene(tmp_path / "s.toml")
    (user,) = scene.crossings
    np.testing.assert_allclose(np.array(user.way) + scene.origin, [[54.0, -20.0], [54.0, 20.0]])
    assert (scene.vehicle, user.speed, user.begins_s) == (TPCAP, 2.0, 1.5)
    (tmp_path / "s.toml").write_text((tmp_path / "s.toml").read_text().replace("2.0\n", "-2.0\n"))
    with pytest.raises(InputError, match="speed"):
        read_scene(tmp_path / "s.toml")
