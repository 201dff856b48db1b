"""Ranging: the beams of a box, distances, a car's pose from its sides, and depths from a stereo pair."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from parkenv.lots import packaged_lot
from parkenv.mapping.route import survey_route
from parkenv.perception import ranging
from parkenv.perception.box_fit import fit_box
from parkenv.perception.detector import Detections
from parkenv.perception.range_scan import scan_from_laser, scan_from_stereo
from parkenv.world.lot_scene import slot_lot
from sim_sensors.laser.footprints import ScanPlane
from sim_sensors.rig import SensorRig, poses_along

ORIGIN = np.zeros(3)
RIG = SensorRig.thesis()
_, CAMERA, EYE = RIG.cameras[0]
_, LASER, MOUNT = RIG.lasers[0]
_, STEREO, STEREO_MOUNT = SensorRig.stereo().stereo_cameras[0]
LEAST_BEAMS, FARTHEST_M = 8, 12.0
CAR_HIGH = 1.5
END_LIMIT = math.radians(60.0)


def look(scene, pose, rng):
    """A sweep, detections as a faultless camera would make them, and the place of each one's car.

    Boxes are around the beams that end on a parked car, within the camera's image.
    """
    scan, ids = LASER.scan_with_ids(scene.scan_plane, MOUNT.in_world(pose), rng)
    off = LASER.angles - EYE.yaw
    in_image = np.abs(off) < math.atan(CAMERA.cx / CAMERA.fx)
    boxes, ends, places = [], [], []
    for car in np.unique(ids[in_image & (ids > 0) & (ids <= scene.n_vehicles)]):
        on_it = in_image & (ids == car) & np.isfinite(scan)
        if on_it.sum() < LEAST_BEAMS or np.median(scan[on_it]) > FARTHEST_M:
            continue
        column = CAMERA.cx - CAMERA.fx * np.tan(off[on_it])
        depth = np.median((scan * np.cos(off))[on_it])
        rows = CAMERA.cy + CAMERA.fy * (EYE.z - np.array([CAR_HIGH, 0.0])) / depth
        boxes.append([column.min(), rows[0], column.max(), rows[1]])
        x, y, yaw = scene.vehicle_pose[car - 1]
        angle = abs(math.atan2(y - pose[1], x - pose[0]) - yaw) % math.pi
        ends.append(min(angle, math.pi - angle) < END_LIMIT)
        places.append(int(car) - 1)
    return scan_from_laser(LASER, MOUNT, pose, scan), boxes_of(*boxes, ends=ends), places


def turned_off(yaw, true):
    """Angle between directions that are alike both ways round, rad."""
    return np.abs((yaw - true + math.pi / 2) % math.pi - math.pi / 2)


def rectangle(x, y, yaw, length, width):
    ahead, left = np.array([math.cos(yaw), math.sin(yaw)]), np.array([-math.sin(yaw), math.cos(yaw)])
    corners = [(1, 1), (-1, 1), (-1, -1), (1, -1)]
    return [[x, y] + 0.5 * (a * length * ahead + b * width * left) for a, b in corners]


def swept(*cars, pose=(0.0, 0.0, 0.0), rng=None):
    """What the laser sees of cars, each x, y, yaw, length, width."""
    plane = ScanPlane(np.array([rectangle(*car) for car in cars]))
    return scan_from_laser(LASER, MOUNT, np.array(pose), LASER.scan(plane, pose, rng))


def boxes_of(*boxes, ends=True):
    table = np.array(boxes, dtype=np.float32).reshape(-1, 4)
    sure = np.ones(len(table), dtype=np.float32)
    return Detections(table, sure, np.full(len(table), ends, dtype=bool))


def test_the_middle_of_the_image_is_the_beam_to_the_right():
    """Camera along -π/2 of the laser, first beam at -3π/4, steps of a quarter degree: beam 180 points ahead."""
    scan = swept((0.0, -5.0, 0.0, 4.0, 2.0))
    box = np.array([[CAMERA.cx - 4.0, 0.0, CAMERA.cx + 4.0, 9.0]], dtype=np.float32)
    left, right = ranging.bearings(CAMERA, EYE, ORIGIN, box)[0]
    assert left > -math.pi / 2 > right
    assert ranging.beams_between(scan, left, right).tolist() == list(range(178, 183))


@given(yaw=st.floats(-10, 10), u=st.floats(0, 639), v=st.floats(0, 639))
def test_beams_of_a_box_are_those_that_the_camera_sees_in_it(yaw, u, v):
    pose = np.array([3.0, -2.0, yaw])
    scan = scan_from_laser(LASER, MOUNT, pose, np.full(LASER.n_beams, 5.0, np.float32))
    left, right = min(u, v), max(u, v)
    margins = ranging.bearings(CAMERA, EYE, pose, np.array([[left, 0.0, right, 9.0]]))[0]
    beams = ranging.beams_between(scan, *margins)
    column = CAMERA.cx - CAMERA.fx * np.tan(LASER.angles - EYE.yaw)
    ahead = np.abs(LASER.angles - EYE.yaw) < math.pi / 2
    inside = ahead & (column > left + 1e-6) & (column < right - 1e-6)
    at_margin = ahead & ((np.abs(column - left) < 1e-5) | (np.abs(column - right) < 1e-5))
    assert set(np.flatnonzero(inside)) <= set(beams) <= set(np.flatnonzero(inside | at_margin))


def test_beams_that_pass_the_car_do_not_count():
    """The box is too wide by a half on either side: the median is the wall's, the run the car's."""
    scan = swept((0.0, -4.0, 0.0, 1.8, 2.0), (0.0, -11.0, 0.0, 60.0, 2.0))
    beams = ranging.beams_between(scan, -math.pi / 2 + 0.7, -math.pi / 2 - 0.7)
    assert ranging.median_distance(scan, beams) > 10.0
    run = ranging.car_beams(scan, beams)
    assert np.median(scan.distance[run.beams]) == pytest.approx(3.0, abs=0.1)
    assert run.cut == (False, False)


def test_a_neighbour_at_the_margin_does_not_count_and_a_run_goes_on_where_the_image_ends():
    """Something stands a metre nearer, before the car's left edge, and fills a third of the box."""
    scan = swept((0.0, -8.0, 0.0, 1.8, 4.0), (1.6, -4.0, 0.0, 2.0, 2.0))
    left, right = math.atan2(-6.0, 1.6), math.atan2(-6.0, -1.0)
    run = ranging.car_beams(scan, ranging.beams_between(scan, left, right))
    assert np.median(scan.distance[run.beams]) == pytest.approx(6.03, abs=0.03)
    assert run.cut == (False, True), "the van hides where the car ends"
    # A run goes on where the image ends.
    scan = swept((0.0, -3.6, 0.0, 4.4, 1.8))
    inside = ranging.beams_between(scan, -math.pi / 2 + 0.2, -math.pi / 2 - 0.2)
    short, whole = ranging.car_beams(scan, inside), ranging.car_beams(scan, inside, (True, True))
    assert set(short.beams) <= set(inside)
    assert set(short.run) == set(whole.beams), "the beams that go on beyond the box are known"
    assert scan.points(whole.beams[[0, -1]])[:, 0] == pytest.approx([-2.2, 2.2], abs=0.05)


def test_what_no_beam_meets_has_no_distance():
    scan = scan_from_laser(LASER, MOUNT, ORIGIN, np.full(LASER.n_beams, np.inf, np.float32))
    beams = ranging.beams_between(scan, -1.0, -2.0)
    assert len(beams)
    assert math.isnan(ranging.median_distance(scan, beams))
    assert not len(ranging.car_beams(scan, beams).beams)
    for way in (ranging.localize_cars, ranging.localize_median):
        assert len(way(boxes_of([300, 200, 340, 300]), scan, CAMERA, EYE, ORIGIN)) == 0


@pytest.mark.parametrize(
    ("top", "bottom", "stands"),
    [(200, 345, True), (0, 150, False), (40, 345, False), (300, 345, False), (230, 260, False)],
    ids=["as cars do", "in the sky", "as high as a house", "as low as a kerb", "hovering"],
)
def test_what_does_not_stand_on_the_ground_as_cars_do_is_none(top, bottom, stands):
    """The car's face is 4 m away and the eye 1.3 m high, so the ground there is 104 px below the horizon."""
    scan = swept((0.0, -5.0, 0.0, 4.0, 2.0))
    found = ranging.localize_cars(boxes_of([180, top, 460, bottom], ends=False), scan, CAMERA, EYE, ORIGIN)
    assert len(found) == stands


def test_beams_end_on_the_nearest_car_of_their_boxes():
    """The car behind would stand where the one in front does: its box is not located; of a car alone it is."""
    near, far = (0.0, -5.0, 0.0, 4.0, 2.0), (0.0, -10.0, 0.0, 4.0, 2.0)
    in_front, behind = [160, 200, 480, 345], [245, 215, 395, 290]
    boxes, scan = boxes_of(behind, in_front, ends=False), swept(near, far)
    assert ranging.localize_cars(boxes, scan, CAMERA, EYE, ORIGIN).detection.tolist() == [1]
    alone = ranging.localize_cars(boxes_of(behind, ends=False), swept(far), CAMERA, EYE, ORIGIN)
    np.testing.assert_allclose(alone.xy, [[0.0, -10.0]], atol=0.2)


@given(
    bearing=st.floats(-1.7, -0.6), away=st.floats(4.0, 9.0), yaw=st.floats(0.0, math.pi - 0.01),
    length=st.floats(3.8, 5.0), width=st.floats(1.6, 2.0), seed=st.integers(0, 9),
)  # fmt: skip
@settings(max_examples=50)
def test_two_sides_tell_the_pose_from_anywhere(bearing, away, yaw, length, width, seed):
    x, y = away * math.cos(bearing), away * math.sin(bearing)
    ahead = abs(x * math.cos(yaw) + y * math.sin(yaw)) - 0.5 * length
    aside = abs(y * math.cos(yaw) - x * math.sin(yaw)) - 0.5 * width
    if min(ahead, aside) < 1.0:
        return  # the sensor sees one side only, or the other at a grazing angle
    scan = swept((x, y, yaw, length, width), rng=np.random.default_rng(seed))
    car = fit_box(scan.points(np.flatnonzero(np.isfinite(scan.distance))), np.zeros(2), end_on=False)
    assert turned_off(car.yaw, yaw) < math.radians(3)
    # The last half metre of a side at a grazing angle may have no return: half of that is the centre's error.
    assert math.hypot(car.x - x, car.y - y) < 0.15 + 0.5 * (abs(car.length - length) + abs(car.width - width))
    for seen, true in ((car.seen_length, length), (car.seen_width, width)):
        assert true - 0.5 < seen < true + 0.15


@pytest.mark.parametrize(("end_on", "yaw", "y"), [(True, math.pi / 2, -6.2), (False, 0.0, -4.9)])
def test_one_short_side_is_an_end_or_a_flank_as_the_detector_says(end_on, yaw, y):
    points = np.column_stack([np.linspace(-0.9, 0.9, 40), np.full(40, -4.0)])
    car = fit_box(points, np.zeros(2), end_on=end_on)
    assert turned_off(car.yaw, yaw) < 0.03
    assert (car.x, car.y) == pytest.approx((0.0, y), abs=0.03)


def test_a_car_goes_on_from_where_the_view_is_cut():
    """A flank from 1 m to 4 m ahead; its near end is real, or its far one."""
    flank = np.column_stack([np.linspace(1.0, 4.0, 60), np.full(60, -3.0)])
    for cut, x in (((False, True), 1.0 + 2.2), ((True, False), 4.0 - 2.2)):
        assert fit_box(flank, np.zeros(2), end_on=False, cut=cut).x == pytest.approx(x, abs=0.05)


@pytest.mark.parametrize("name", ["campus", "street"])
def test_fitted_cars_stand_where_the_cars_do(name):
    """Along a survey of parked cars: heading and place of the fit beside those of the thesis's way (T §4.2)."""
    lot, rng = packaged_lot(name), np.random.default_rng(1)
    scene = slot_lot(lot, 1).scene(rng.random(lot.n_slots) < 0.6)
    off = {ranging.localize_cars: [], ranging.localize_median: []}
    for pose in poses_along(survey_route(lot).path, 8.0):
        scan, found, places = look(scene, pose, rng)
        for k in range(len(found)):
            true = scene.vehicle_pose[places[k]]
            for way, errors in off.items():
                for x, y, yaw in way(found.select(np.array([k])), scan, CAMERA, EYE, pose).poses:
                    errors.append((np.hypot(x - true[0], y - true[1]), turned_off(yaw, true[2])))
    fitted, plain = (np.array(off[way]) for way in (ranging.localize_cars, ranging.localize_median))
    assert len(fitted) > 25
    assert np.median(fitted[:, 0]) < 0.3 < np.median(plain[:, 0])
    assert (fitted[:, 0] > 1.0).mean() < 0.05 < (plain[:, 0] > 1.0).mean()
    assert np.median(fitted[:, 1]) < math.radians(2) < math.radians(15) < np.median(plain[:, 1])


def test_stereo_has_the_depth_of_a_wall_and_none_without_a_match():
    """With every pixel at 6 m, objects at bumper height are hit there in every direction, and angles ascend."""
    disparities = np.full((480, 640), STEREO.camera.fx * STEREO.baseline / 6.0, np.float32)
    scan = scan_from_stereo(STEREO, STEREO_MOUNT, ORIGIN, disparities)
    assert (np.diff(scan.angle) > 0.0).all()
    assert scan.points(np.arange(len(scan.angle)))[:, 1] == pytest.approx(-6.0, abs=1e-4)
    nothing = np.full((480, 640), np.nan, np.float32)
    box = boxes_of([100, 100, 300, 300])
    assert math.isnan(ranging.median_depth(nothing, box.boxes[0], STEREO))
    assert len(ranging.localize_disparity(box, nothing, STEREO, STEREO_MOUNT, ORIGIN)) == 0
    scan = scan_from_stereo(STEREO, STEREO_MOUNT, ORIGIN, nothing)
    assert np.isnan(scan.distance).all()
    assert len(ranging.localize_cars(box, scan, STEREO.camera, STEREO_MOUNT, ORIGIN)) == 0
