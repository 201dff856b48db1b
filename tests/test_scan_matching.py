"""Drifting odometry, and scans matched to the drive so far and to the lot."""

import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from test_survey import halves

from parkenv import Traffic, make_scenario
from parkenv.mapping.odometry import PoseNoise, between, moved
from parkenv.mapping.scan_matching import ScanMatcher
from parkenv.mapping.survey import Survey, SurveySettings
from parkenv.perception.range_scan import RangeScan, scan_from_laser
from parkenv.world.lot_scene import slot_lot
from sim_sensors.rig import SensorRig, poses_along

_, LASER, MOUNT = SensorRig.thesis().lasers[0]
HERE = np.zeros(3)


@pytest.fixture(scope="module")
def drive():
    """Two aisles of `campus`, three quarters of their slots taken: the lot, true poses, and a scan at each."""
    lot = make_scenario("campus").lot
    scene = slot_lot(lot).scene(np.arange(lot.n_slots) % 4 != 1, 3)
    corners = [(-20.0, 16.0), (0.0, 16.0), (0.0, 0.0), (104.0, 0.0), (98.0, 16.0), (0.0, 16.0)]
    poses, rng = poses_along(corners, 2.0), np.random.default_rng(0)
    scans = [scan_from_laser(LASER, MOUNT, HERE, LASER.scan(scene.scan_plane, pose, rng)) for pose in poses]
    return lot, poses, scans


def located(lot, odometry, scans):
    matcher = ScanMatcher(lot)
    return np.array([matcher.locate(pose, [scan]) for pose, scan in zip(odometry, scans, strict=True)])


def position_error(estimated, poses):
    return np.hypot(*(estimated - poses)[:, :2].T)


def test_the_drift_of_odometry_is_as_stated():
    path = np.column_stack([np.arange(0.0, 101.0), np.zeros((101, 2))])
    ends = np.array([PoseNoise(drift=0.02).estimated(path, np.random.default_rng(s))[-1] for s in range(400)])
    along, across = ends[:, 0] - 100.0, ends[:, 1]
    assert np.sqrt((along**2 + across**2).mean()) == pytest.approx(2.0, rel=0.1)
    assert (along**2).mean() / (along**2 + across**2).mean() == pytest.approx(1 / 3, rel=0.2)
    drifted = PoseNoise(drift=0.02).estimated(path, np.random.default_rng(0))
    np.testing.assert_array_equal(drifted[0], path[0])
    np.testing.assert_array_equal(drifted, PoseNoise(drift=0.02).estimated(path, np.random.default_rng(0)))


def test_motions_between_poses_add_up():
    one, two = np.array([3.0, -2.0, 3.0]), np.array([1.0, 4.0, -3.0])
    motion = between(one, two)
    assert abs(motion[2]) < 0.3  # across the seam at pi
    again = moved(one, motion)
    np.testing.assert_allclose(again[:2], two[:2])
    assert math.cos(again[2] - two[2]) == pytest.approx(1.0)


@pytest.mark.parametrize("drift", [0.0, 0.05])
def test_matching_undoes_the_drift_and_hardly_worsens_true_poses(drive, drift):
    lot, poses, scans = drive
    odometry = PoseNoise(drift=drift).estimated(poses, np.random.default_rng(4))
    estimated = located(lot, odometry, scans)
    assert position_error(odometry, poses).max() >= 40 * drift
    assert np.sqrt((position_error(estimated, poses) ** 2).mean()) < 0.1
    assert position_error(estimated, poses).max() < 0.25
    turned = ((estimated - poses)[:, 2] + math.pi) % (2 * math.pi) - math.pi
    assert np.degrees(np.abs(turned).max()) < 0.5


def test_a_wrong_start_is_put_right(drive):
    lot, poses, scans = drive
    off = poses + np.array([0.4, -0.4, 0.02])
    estimated = located(lot, off, scans)
    assert position_error(estimated, poses)[0] > 0.3
    assert position_error(estimated, poses)[40:].max() < 0.2


def test_without_points_the_pose_follows_the_odometry(drive):
    lot, poses, scans = drive
    for distance in (np.inf, np.nan):
        made = partial(RangeScan, 0.0, 0.0)
        blind = [made(s.angle, np.full(len(s.angle), distance), s.max_range) for s in scans[:30]]
        np.testing.assert_allclose(located(lot, poses[:30], blind)[:, :2], poses[:30, :2], atol=1e-9)
    np.testing.assert_allclose(ScanMatcher(lot).locate(poses[0], []), poses[0])


def test_moving_cars_do_not_carry_the_pose_along(drive):
    lot, poses, scans = drive
    odometry = PoseNoise(drift=0.02).estimated(poses, np.random.default_rng(4))
    ahead = []
    for scan in scans:  # a car drives ahead at the same speed: 40 degrees of every scan stand still
        distance = scan.distance.copy()
        front = np.abs(scan.angle) < math.radians(20.0)
        distance[front] = np.minimum(distance[front], 4.0 / np.cos(scan.angle[front]))
        ahead.append(RangeScan(scan.x, scan.y, scan.angle, distance, scan.max_range))
    assert position_error(located(lot, odometry, ahead), poses).max() < 0.4


def test_a_survey_knows_where_its_car_was():
    options = {"every": 6.0, "weather": "overcast", "pose_noise": PoseNoise(drift=0.05), "seed": 3}
    settings = SurveySettings(localise="scan-matching", **options)
    scenario, _ = halves(traffic=Traffic())
    result = Survey(scenario, settings).drive(0)
    errors = [position_error(p, result.true_poses) for p in (result.odometry, result.poses)]
    assert errors[1].mean() < errors[0].mean()
    assert len(result.car_captures) == len(result.session.cars) > 0
    keys = {
        Survey(scenario, replace(settings, **change)).key_of(0)
        for change in ({}, {"localise": "none"}, {"pose_noise": PoseNoise()})
    }
    assert len(keys) == 3
    assert result.session.key in keys
