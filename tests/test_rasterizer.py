"""The z-buffer against an independent ray caster, near clipping, watertight edges, any thread count."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from toy_scene import box_mesh, parked_cars, random_boxes, ray_depth, toy_scene

from sim_sensors.camera.models import PinholeCamera, camera_pose
from sim_sensors.camera.projection import project
from sim_sensors.camera.rasterizer import rasterize
from sim_sensors.mesh import Material


def plain_camera(width=160, height=120, horizontal=1.1):
    return PinholeCamera.from_field_of_view(width, height, horizontal)


def depth_of(scene, camera, pose):
    _, seen = camera.visibility(scene, pose)
    with np.errstate(divide="ignore"):
        return 1.0 / seen.inverse_depth


@pytest.mark.parametrize("seed", range(2))
def test_depth_agrees_with_a_ray_caster(seed):
    scene, camera = random_boxes(seed), plain_camera()
    generator = np.random.default_rng(seed)
    pose = camera_pose(0.0, 0.0, 1.4, *generator.uniform((-3.0, -0.3, -0.4), (3.0, 0.2, 0.4)))
    ours, theirs = depth_of(scene, camera, pose), ray_depth(scene, camera, pose)
    assert np.array_equal(np.isinf(ours), np.isinf(theirs))
    seen = np.isfinite(theirs)
    error = np.abs(ours[seen] - theirs[seen])
    assert np.median(error) < 1e-3
    assert np.mean(error > 0.01) < 0.002


def test_a_wall_beside_and_behind_the_camera_is_clipped_not_dropped():
    # One 40 m quad of two triangles passes 0.3 m to the right of the camera, from far behind to far ahead.
    scene = toy_scene([box_mesh(40.0, 0.2, 3.0, Material.STONE)], [(0, 0.0, -0.4, 0.0, 0.0)], [0])
    camera, pose = plain_camera(), camera_pose(0.0, 0.0, 1.2, 0.0)
    ours, theirs = depth_of(scene, camera, pose), ray_depth(scene, camera, pose)
    # At the right edge the wall is 0.3 m / tan(half the field of view) away.
    assert ours[60, -1] == pytest.approx(0.3 / ((159.5 - camera.cx) / camera.fx), rel=1e-4)
    same = np.isfinite(theirs)
    assert np.abs(ours[same] - theirs[same]).max() < 1e-2


@given(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), st.floats(-3.0, 3.0))
@settings(max_examples=25)
def test_no_gap_where_triangles_meet(x, z, roll):
    # A finely split wall fills the view: every pixel must be on it.
    wall = box_mesh(0.5, 90.0, 60.0, Material.STONE, splits=23)
    scene = toy_scene([wall], [(0, 8.0, 0.0, -20.0, 0.0)], [0])
    camera = plain_camera(horizontal=0.9)
    _, seen = camera.visibility(scene, camera_pose(x, 0.0, 8.0 + z, 0.0, 0.0, roll))
    assert (seen.triangle >= 0).all()


def test_glass_is_found_apart_from_what_is_behind():
    pane = box_mesh(0.01, 2.0, 2.0, Material.GLASS)
    wall = box_mesh(0.5, 9.0, 9.0, Material.STONE)
    scene = toy_scene([pane, wall], [(0, 3.0, 0.0, 0.2, 0.0), (1, 6.25, 0.0, 0.0, 0.0)], [1, 0])
    camera = plain_camera()
    _, seen = camera.visibility(scene, camera_pose(0.0, 0.0, 1.2, 0.0))
    assert 1.0 / seen.inverse_depth[60, 80] == pytest.approx(6.0, abs=1e-4)
    assert 1.0 / seen.pane_inverse_depth[60, 80] == pytest.approx(2.995, abs=1e-4)
    assert seen.n_panes[60, 80] == 2
    assert seen.pane[60, 0] == -1


def test_skipping_what_is_hidden_changes_nothing():
    scene, camera = parked_cars(), PinholeCamera.from_field_of_view()
    for yaw in (-math.pi / 2, 0.3):
        pose = camera_pose(-6.0, 0.3, 1.35, yaw, -0.04)
        triangles, seen = camera.visibility(scene, pose)
        never_hidden = triangles._replace(nearest=np.full_like(triangles.nearest, np.inf))
        down = -pose[2, :3] / pose[2, 3] / (camera.fx, camera.fy, 1.0)
        floor = np.array([down[0], down[1], down[2] - down[0] * camera.cx - down[1] * camera.cy])
        all_drawn = rasterize(never_hidden, (camera.width, camera.height), floor)
        for one, other in zip(seen, all_drawn, strict=True):
            assert np.array_equal(one, other)


def test_far_instances_are_drawn_coarse():
    fine, coarse = box_mesh(4.0, 2.0, 1.5, splits=8), box_mesh(4.0, 2.0, 1.5)
    placed = [(0, 6.0, 0.0, 0.0, 0.0), (0, 40.0, 3.0, 0.0, 0.0)]
    scene = toy_scene([fine, coarse], placed, [1, 2], coarse=[1, 1])
    camera, pose = plain_camera(640, 480), camera_pose(0.0, 0.0, 1.4, 0.0)
    near_fine, all_fine = (
        project(scene.pool, scene.instances, pose, camera.intrinsics, (640, 480), beyond)
        for beyond in (20.0, math.inf)
    )
    assert (near_fine.instance == 1).sum() < (all_fine.instance == 1).sum()
    assert (near_fine.instance == 0).sum() == (all_fine.instance == 0).sum()
