"""The learned planner of manoeuvres, and scenes in which others move."""

import csv
import dataclasses
import json
import math

import numpy as np
import pytest
import shapely
from command_line import parkenv
from hypothesis import given, settings
from hypothesis import strategies as st

from parkenv.driving.crossings import Crossing, CrossingTraffic, caused_contact
from parkenv.driving.levels import level_scene
from parkenv.driving.scene_files import read_scene
from parkenv.driving.vehicle import TPCAP, VEHICLES, VehicleParameters, move_along, placed
from parkenv.errors import InputError
from parkenv.files.known_names import SCENE_LEVELS
from planners.driving import manoeuvre
from planners.driving.learned_moves import MOST_MOVES, MOVES, SHIPPED, Rollout, prepare
from planners.driving.manoeuvre import Manoeuvre, drive, park, paths_in_scene
from planners.driving.parking_agents import make_parking_agent, manoeuvre_planner
from planners.driving.path_tracking import TrackingSettings
from planners.driving.policy_interface import BEAMS, FARTHEST_M

CAR = VehicleParameters()
WALKER = Crossing("pedestrian", ((-8.0, 0.0), (8.0, 0.0)), 1.5)


@settings(max_examples=12, deadline=None)
@given(st.sampled_from(SCENE_LEVELS), st.integers(0, 1000), st.sampled_from((0.05, 0.01)), st.booleans())
def test_whatever_moves_are_made_nothing_is_touched_and_a_whole_path_ends_at_the_other_end(
    level, seed, margin, swapped
):
    scene, rng = level_scene(level, seed), np.random.default_rng(seed)
    task = prepare(scene).swapped() if swapped else prepare(scene)
    path = Rollout(task, margin)
    while not path.over:
        path.move(int(rng.choice(np.flatnonzero(path.mask))))
    poses = [tuple(task.slot)]
    for length, curvature in zip(path.lengths, path.curvatures, strict=True):
        n = max(1, math.ceil(abs(length) / 0.05))
        poses += [move_along(*poses[-1], curvature, length * i / n) for i in range(1, n + 1)]
    assert not scene.check(np.array(poses)).contact
    if path.done:
        away, turned = np.subtract(poses[-1], task.goal)[:2], poses[-1][2] - task.goal[2]
        assert math.hypot(*away) < 1e-6
        assert abs(math.remainder(turned, 2 * math.pi)) < 1e-6
    else:
        assert len(path.lengths) >= MOST_MOVES or not path.mask.any()
        assert path.mask.shape == (MOVES,)


def test_a_path_observes_the_free_distance_in_every_direction():
    scene = level_scene("oblique-complex", 3)
    seen = Rollout(prepare(scene), 0.05).seen[-BEAMS:]
    x, y, yaw = scene.vehicle.at_middle(manoeuvre.aim(scene))
    car, around = (
        shapely.Polygon(scene.vehicle.corners(manoeuvre.aim(scene))),
        shapely.union_all(scene.shapes),
    )
    for k in range(0, BEAMS, 5):
        turn = yaw + 2 * math.pi * k / BEAMS
        ray = shapely.LineString([(x, y), (x + 14 * math.cos(turn), y + 14 * math.sin(turn))])
        from_middle = (
            shapely.Point(x, y).distance(ray.intersection(around)) if ray.intersects(around) else 14.0
        )
        free = min(max(from_middle - ray.intersection(car).length, 0.0), FARTHEST_M)
        assert seen[k] == pytest.approx(1.0 / (1.0 + free), abs=1e-3)


def test_the_agents_stand_side_by_side_for_each_level(tmp_path):
    levels = ("perpendicular-normal", "oblique-moving")
    agents = ("planner", "learned", "hybrid")
    words = (
        "--levels",
        ",".join(levels),
        "--agents",
        ",".join(agents),
        "-n",
        "1",
        "--seed",
        "5",
        "--jobs",
        "1",
    )
    done = parkenv("park", *words, "--out", "out", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    found = {(row["agent"], row["level"]): row for row in summary["levels"]}
    assert set(found) == {(agent, level) for agent in agents for level in levels}
    for row in found.values():
        assert (row["scenes"], row["driven"], row["contacts"], row["success"]) == (1, 1, 0, 1.0)
    lines = list(csv.DictReader((tmp_path / "out" / "road_users.csv").open()))
    assert {line["case"] for line in lines} == {"oblique-moving-5"}
    assert (tmp_path / "out" / "manoeuvre.gif").stat().st_size > 1000


def test_a_network_refuses_a_car_that_it_has_not_learned_to_drive():
    plan = manoeuvre_planner("learned")
    for vehicle in VEHICLES.values():
        scene = level_scene("perpendicular-normal", 1, vehicle)
        assert park(scene, plan).judged.driven
    truck = dataclasses.replace(CAR, length=6.0, wheelbase=4.0)
    with pytest.raises(InputError, match="with length from"):
        park(level_scene("perpendicular-normal", 1, truck), plan)
    with pytest.raises(InputError, match="to scenes, not to drive"):
        make_parking_agent(f"maskable-ppo:{SHIPPED}")
    with pytest.raises(InputError, match="magic"):
        manoeuvre_planner("magic")


@settings(max_examples=20, deadline=None)
@given(
    st.floats(-6.0, 6.0), st.floats(-3.0, 3.0), st.floats(-3.0, 3.0), st.sampled_from(("pedestrian", "car"))
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
            patch.setattr(manoeuvre, "_has_to_wait", lambda *_: False)
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
