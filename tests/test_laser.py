"""The laser: against its definition, at the edges of its domain, and its noise."""

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import laser_reference
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_sensors import SensorError
from sim_sensors.laser.footprints import NO_RETURN, WALL, ScanPlane
from sim_sensors.laser.scanner import LaserScanner

LASER = LaserScanner()
WIDE = LaserScanner(n_beams=1440, start=1.0)
SQUARE = np.array([[1, -1], [2, -1], [2, 1], [1, 1]], float)
PLANE = ScanPlane([SQUARE])
TOLERANCE_M = 2e-3
# A beam is at an edge if turning it this little changes its true range by more than the tolerance.
TURN = 2e-6


def regular_polygon(k, x=0.0, y=0.0, radius=1.0, turned=0.0, stretch=1.0):
    angle = turned + 2 * np.pi * np.arange(k) / k
    return np.column_stack([x + radius * stretch * np.cos(angle), y + radius * np.sin(angle)])


def stack(polygons, k_max=12):
    corners = np.zeros((len(polygons), k_max, 2))
    for i, polygon in enumerate(polygons):
        corners[i, : len(polygon)] = polygon
    return corners, np.array([len(p) for p in polygons], dtype=int)


def random_plane(rng, n, n_walls, extent):
    """Cars, posts and odd polygons of both orientations, and walls of every length, strewn about."""
    polygons = []
    for _ in range(n):
        k = int(rng.choice([3, 4, 4, 4, 5, 8, 12]))
        radius, turned, stretch = rng.choice([0.05, 1.0, 2.5, 6.0]), rng.uniform(0, 7), rng.uniform(0.3, 1)
        outline = regular_polygon(k, 0, 0, radius, turned, stretch)
        turn = rng.uniform(0, 7)
        outline = outline @ [[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]]
        polygons.append((outline + rng.uniform(-extent, extent, 2))[:: rng.choice([-1, 1])])
    corners, n_corners = stack(polygons)
    middle = rng.uniform(-extent, extent, (n_walls, 1, 2))
    walls = middle + rng.normal(0, rng.choice([0.5, 5, 40], (n_walls, 1, 1)), (n_walls, 2, 2))
    return ScanPlane(corners, n_corners, walls)


def compare(scanner, plane, pose):
    """Number of beams at an edge; all others agree with the definition."""
    ranges, ids = scanner.scan_with_ids(plane, pose)
    poses = ((*pose[:2], pose[2] + turn) for turn in (-TURN, 0.0, TURN))
    wanted = [laser_reference.scan(scanner, plane, turned) for turned in poses]
    true = np.array([np.minimum(r, 2 * scanner.max_range) for r, _ in wanted])
    edge = (np.ptp(true, 0) > TOLERANCE_M) | (np.abs(true[1] - scanner.max_range) < TOLERANCE_M)
    error = np.abs(np.minimum(ranges, 2 * scanner.max_range) - true[1])
    assert error[~edge].max(initial=0) <= TOLERANCE_M
    # Where two things touch, either may be named; inside two footprints, either of them.
    same = (ids == wanted[1][1]) | (true[1] == 0)
    assert (same | edge).mean() > 0.99
    assert not (np.isfinite(ranges) ^ (ids != NO_RETURN)).any()
    return int(edge.sum())


@settings(max_examples=40)
@given(
    seed=st.integers(0, 2**32),
    n=st.integers(0, 60),
    n_walls=st.integers(0, 8),
    extent=st.sampled_from([5.0, 25.0, 120.0]),
    yaw=st.floats(-10, 10),
    scanner=st.sampled_from([LASER, WIDE, LaserScanner(n_beams=1), LaserScanner(n_beams=37, step=0.1)]),
)
def test_scans_are_what_the_definition_says(seed, n, n_walls, extent, yaw, scanner):
    compare(scanner, random_plane(np.random.default_rng(seed), n, n_walls, extent), (0.0, 0.0, yaw))


@pytest.mark.parametrize("shift", [(0.0, 0.0), (413_000.25, 5_320_000.5)])
def test_few_beams_are_at_edges_in_a_large_sample_near_the_origin_and_far_from_it(shift):
    rng, edges = np.random.default_rng(1), 0
    for _ in range(5):
        plane = random_plane(rng, int(rng.integers(20, 300)), int(rng.integers(0, 20)), 60.0)
        corners, n_corners = plane.footprints
        plane = ScanPlane(corners + shift, n_corners, plane.walls + shift)
        for pose in rng.uniform((-50, -50, -4), (50, 50, 4), (5, 3)):
            edges += compare(LASER, plane, pose + np.array([*shift, 0.0]))
    assert edges < 1e-3 * 25 * LASER.n_beams


def test_faces_end_on_close_by_behind_or_not_there_are_as_by_definition():
    around = ScanPlane([SQUARE * [1, 40]])  # spans more than the blind sector when behind
    for yaw in np.linspace(-math.pi, math.pi, 17):
        for scanner in (LASER, WIDE, replace(WIDE, start=-7.0)):
            assert compare(scanner, around, (0.0, 0.0, yaw)) < 8
    for distance in (1e-4, 0.01, 0.3, 29.99, 31.0):
        wall = ScanPlane(np.empty((0, 4, 2)), walls=[[[distance, -60], [distance, 60]]])
        for yaw in (0.0, 0.4, math.pi / 2, 3.0):
            compare(LASER, wall, (0.0, 0.0, yaw))
    wall = ScanPlane(np.empty((0, 4, 2)), walls=[[[1, 0], [3, 0]]])
    ranges = LASER.scan(wall, (0, 0, 0))
    assert np.isinf(np.delete(ranges, 540)).all()
    assert compare(LASER, ScanPlane([SQUARE]), (0.0, 1.0, 0.0)) <= 4
    rng = np.random.default_rng(6)
    for x, thickness in zip(rng.uniform(1, 29, 50), 10 ** rng.uniform(-5.9, -3, 50), strict=True):
        sliver = ScanPlane([[[x, 0], [x + 4, 0], [x + 4, thickness], [x, thickness]]])
        assert LASER.scan(sliver, (0, rng.choice([0.0, thickness]), 0)).all()
    for plane in (ScanPlane(np.empty((0, 4, 2))), ScanPlane([SQUARE], [0]), ScanPlane([SQUARE + 1000])):
        ranges, ids = LASER.scan_with_ids(plane, (0, 0, 0), np.random.default_rng(0))
        assert np.isinf(ranges).all()
        assert (ids == NO_RETURN).all()
        assert LASER.scan(plane, np.empty((0, 3))).shape == (0, 1081)


def test_no_beam_slips_through_the_joints_of_a_closed_room():
    outline = regular_polygon(900, radius=9.0)
    plane = ScanPlane(np.empty((0, 4, 2)), walls=np.stack([outline, np.roll(outline, -1, 0)], 1))
    poses = np.random.default_rng(0).uniform((-6, -6, -4), (6, 6, 4), (200, 3))
    assert np.isfinite(LASER.scan(plane, poses)).all()


def test_ids_name_what_was_hit():
    plane = ScanPlane([SQUARE, SQUARE + np.array([3, 0])], ids=[7, 9], walls=[[[8, -60], [8, 60]]])
    ahead = LaserScanner(n_beams=3, start=-1.2, step=1.2)
    ranges, ids = ahead.scan_with_ids(plane, (0, 0, 0))
    assert (ids.tolist(), ranges[1]) == ([WALL, 7, WALL], 1.0)


def test_inside_a_footprint_the_lens_is_covered():
    plane = ScanPlane(*stack([regular_polygon(8), SQUARE + np.array([3, 0])]), ids=[4, 5])
    ranges, ids = LASER.scan_with_ids(plane, (0.2, 0.1, 0))
    assert not ranges.any()
    assert (ids == 4).all()
    # In the circle around a slim footprint, but not in the footprint.
    compare(LASER, ScanPlane([SQUARE * [0.1, 9]]), (0.05, 0.5, 0.0))


def test_changing_one_footprint_is_as_building_anew():
    rng = np.random.default_rng(5)
    plane = random_plane(rng, 150, 5, 60.0)
    corners, n_corners = plane.footprints
    for step in range(200):
        i, k = int(rng.integers(150)), int(rng.choice([0, 3, 4, 8, 12]))
        new = regular_polygon(k, *rng.uniform(-70, 70, 2), rng.choice([1.0, 2.0, 12.0]))
        corners[i] = 0
        corners[i, :k], n_corners[i] = new, k
        if step % 2:
            plane.replace(i, new if k else None)
        else:
            before = LASER.scan(plane, (0, 0, 0))
            plane, old = plane.with_footprint(i, new if k else None), plane
            np.testing.assert_array_equal(LASER.scan(old, (0, 0, 0)), before)
        if step % 20 == 19:
            anew = ScanPlane(corners, n_corners, plane.walls)
            poses = rng.uniform((-60, -60, -4), (60, 60, 4), (5, 3))
            np.testing.assert_allclose(LASER.scan(plane, poses), LASER.scan(anew, poses), atol=1e-4)


def test_orientation_and_corners_on_a_straight_edge_do_not_matter():
    with_midpoints = np.insert(SQUARE, [1, 2], [[1.5, -1], [2, 0]], axis=0)
    pose = (-1.0, 0.3, 0.2)
    wanted = LASER.scan(ScanPlane([SQUARE]), pose)
    np.testing.assert_allclose(LASER.scan(ScanPlane([SQUARE[::-1]]), pose), wanted, atol=1e-6)
    np.testing.assert_allclose(LASER.scan(ScanPlane([with_midpoints]), pose), wanted, atol=1e-6)


def test_noise_has_the_spread_and_the_losses_that_were_asked_for():
    plane = ScanPlane(np.empty((0, 4, 2)), walls=[[[5, -90], [5, 90]]])
    scanner = LaserScanner(n_beams=201, start=-0.5, step=0.005, noise_sd=0.03, dropout=0.1)
    noisy = scanner.scan(plane, np.zeros((2000, 3)), np.random.default_rng(0)).astype(float)
    error, kept = noisy - scanner.scan(plane, (0, 0, 0)), np.isfinite(noisy)
    assert 1 - kept.mean() == pytest.approx(0.1, abs=2e-3)
    assert error[kept].mean() == pytest.approx(0, abs=3e-4)
    assert error[kept].std() == pytest.approx(0.03, rel=0.01)
    assert np.mean(np.abs(error[kept]) < 0.03) == pytest.approx(0.6827, abs=4e-3)
    # Neighbouring beams and successive scans are independent.
    filled = np.where(kept, error, 0.0)
    assert abs(np.corrcoef(filled[:, :-1].ravel(), filled[:, 1:].ravel())[0, 1]) < 0.01
    assert abs(np.corrcoef(filled[:-1].ravel(), filled[1:].ravel())[0, 1]) < 0.01

    # Ranges stay between zero and the maximum.
    plane = ScanPlane([SQUARE], walls=[[[-29.9, -90], [-29.9, 90]]])
    noisy = replace(WIDE, noise_sd=5.0, dropout=0.0).scan(plane, np.zeros((50, 3)), np.random.default_rng(0))
    finite = noisy[np.isfinite(noisy)]
    assert (finite.min(), finite.max()) == (0.0, 30.0)
    assert np.isinf(replace(LASER, dropout=1.0).scan(plane, (0, 0, 0), np.random.default_rng(0))).all()


def test_equal_seeds_give_equal_scans_on_any_number_of_threads():
    rng = np.random.default_rng(8)
    plane = random_plane(rng, 100, 4, 40.0)
    poses = rng.uniform((-30, -30, -4), (30, 30, 4), (64, 3))
    alone = LASER.scan(plane, poses, np.random.default_rng(3))
    with ThreadPoolExecutor(4) as pool:
        for scans in pool.map(lambda _: LASER.scan(plane, poses, np.random.default_rng(3)), range(8)):
            np.testing.assert_array_equal(scans, alone)
    np.testing.assert_array_equal(LASER.scan(plane, poses[5]), LASER.scan(plane, poses)[5])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: PLANE.replace(1, SQUARE), "index is 1, want 0 to 0"),
        (lambda: PLANE.replace(0, regular_polygon(9)), "corners has 9 rows, want at most 4"),
        (lambda: PLANE.replace(0, [[0, 0], [4, 0], [1, 1], [0, 4]]), "want a convex outline"),
        (lambda: LASER.scan(ScanPlane([SQUARE]), (0, math.nan, 0)), r"poses\[1\] is nan, want a finite"),
        (lambda: LASER.scan(ScanPlane([SQUARE]), (0, 0)), r"poses has shape \(2,\), want \(3\)"),
    ],
)
def test_bad_input_is_named_and_a_refused_change_changes_nothing(make, message):
    with pytest.raises(SensorError, match=message):
        make()
    np.testing.assert_array_equal(PLANE.footprints[0][0], SQUARE)
