"""Cars of a drive are joined over captures: one car, one place, with its error."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from parkenv.errors import InputError
from parkenv.mapping.car_tracks import CAR_LENGTH, CarTracks
from parkenv.perception.detector import Detections
from parkenv.perception.ground_detector import GroundDetector
from parkenv.perception.pipeline import CameraView
from parkenv.perception.range_scan import RangeScan
from parkenv.perception.ranging import LocatedCars, localize_cars
from sim_sensors.camera.models import PinholeCamera
from sim_sensors.laser.footprints import ScanPlane
from sim_sensors.rig import Mount, SensorRig

TRACK = np.column_stack([np.arange(0.0, 200.0, 0.1), np.zeros(2000)])
CAMERA = PinholeCamera.from_field_of_view(horizontal=math.pi / 2)


def outline(x, y, yaw, length, width, sides):
    """Return points every 5 cm on sides of a rectangle: l, r (flanks), f, b (ends), (k, 2) m."""
    u, v = np.arange(-length / 2, length / 2, 0.05), np.arange(-width / 2, width / 2, 0.05)
    parts = {"l": u + 0.5j * width, "r": u - 0.5j * width, "f": length / 2 + 1j * v, "b": 1j * v - length / 2}
    points = complex(x, y) + np.exp(1j * yaw) * np.concatenate([parts[side] for side in sides])
    return np.column_stack([points.real, points.imag])


def sighting(points, xy, yaw, p, eye):
    """Return a view of one car."""
    cars = LocatedCars(
        np.array([xy]), np.array([yaw % math.pi]), np.array([[4.4, 1.8]]), np.array([5.0]), np.float32([p]),
        np.array([0]), points=(points,),
    )  # fmt: skip
    scan = RangeScan(*eye, np.empty(0), np.empty(0), 40.0)
    boxes = Detections(np.array([[0.0, 0.0, 9.0, 9.0]]), np.float32([p]))
    picture = np.zeros((1, 1, 3), np.uint8)
    return CameraView("c", CAMERA, Mount(), picture, boxes, scan, None, cars, np.array([-1]))


@settings(max_examples=25, deadline=None)
@given(yaw=st.floats(0.0, 3.1), length=st.floats(4.2, 5.2), width=st.floats(1.6, 2.0))
def test_a_car_seen_from_both_its_ends_has_its_size_and_place(yaw, length, width):
    tracks, ahead = CarTracks(), np.array([math.cos(yaw), math.sin(yaw)])
    aside = np.array([ahead[1], -ahead[0]])
    for k, (along, sides) in enumerate([(-6.0, "br"), (0.0, "r"), (6.0, "fr")]):
        eye = np.array([20.0, 10.0]) + along * ahead + 4.0 * aside
        points = outline(20.0, 10.0, yaw, length, width, sides)
        tracks.add(float(k), sighting(points, (20.0, 10.0) + 0.3 * (k - 1) * ahead, yaw, 0.8, eye))
    cars = tracks.cars(TRACK)
    assert cars.sightings.tolist() == [3]
    assert np.hypot(*(cars.xy[0] - [20.0, 10.0])) < 0.15 + abs(length - CAR_LENGTH) / 2 * 0.2
    assert abs((cars.yaw[0] - yaw + math.pi / 2) % math.pi - math.pi / 2) < math.radians(3.0)
    assert cars.size[0, 0] == pytest.approx(length, abs=0.4)


def test_a_rear_alone_is_half_a_usual_car_before_its_middle():
    tracks = CarTracks()
    for k in range(3):
        points = outline(10.0, 3.0, 0.0, CAR_LENGTH, 1.8, "b")
        tracks.add(float(k), sighting(points, (10.0, 3.0), 0.0, 0.9, (0.5 * k, 3.2)))
    cars = tracks.cars(TRACK)
    assert np.allclose(cars.xy, [[10.0, 3.0]], atol=0.1)
    assert cars.std[0] > 0.25  # nobody has seen its front
    assert cars.distance[0] == pytest.approx(2.1, abs=0.1)


def test_walls_cars_on_their_way_and_unlikely_boxes_are_no_parked_cars():
    tracks = CarTracks()
    for k in range(4):
        wall = outline(30.0, 5.0, 0.0, 9.0, 0.2, "r")
        tracks.add(float(k), sighting(wall, (30.0, 5.0), 0.0, 0.9, (20.0 + k, 0.0)))
        moving = outline(60.0 + k, -5.0, 0.0, 4.4, 1.8, "bl")
        tracks.add(float(k), sighting(moving, (60.0 + k, -5.0), 0.0, 0.9, (20.0 + k, 0.0)))
        parked = outline(80.0, 5.0, 0.0, 4.4, 1.8, "br")
        tracks.add(float(k), sighting(parked, (80.0, 5.0), 0.0, 0.9, (20.0 + k, 0.0)))
    hedge = outline(100.0, 5.0, 0.0, 4.4, 1.8, "r")
    tracks.add(9.0, sighting(hedge, (100.0, 5.0), 0.0, 0.3, (95.0, 0.0)))
    assert np.allclose(tracks.cars(TRACK).xy, [[80.0, 5.0]], atol=0.2)
    tracks.add(10.0, sighting(hedge, (100.0, 5.0), 0.0, 0.3, (96.0, 0.0)))
    assert np.allclose(tracks.cars(TRACK).xy[:, 0].max(), 100.0, atol=0.2), "twice, and as long as a car"


def test_boxes_of_parts_of_a_flank_are_of_one_car():
    """The boxes end at two parts of a flank, taken for a front each; the end points go on."""
    tracks, flank = CarTracks(), outline(20.0, 5.0, 0.0, 4.4, 1.8, "r")
    for k, x in enumerate((18.6, 21.3, 19.0)):
        tracks.add(float(k), sighting(flank, (x, 6.3), math.pi / 2, 0.9, (19.0 + k, 0.0)))
    assert np.allclose(tracks.cars(TRACK).xy, [[20.0, 5.0]], atol=0.1)


def test_a_car_askew_in_a_row_takes_the_heading_of_the_row():
    tracks = CarTracks()
    for x in (0.0, 6.0, 12.0, 18.0, 24.0):
        yaw, *size = (0.5, 1.5, 1.5) if x == 12.0 else (0.0, 4.4, 1.8)
        view = sighting(outline(x, 3.0, yaw, *size, "r"), (x, 3.0), yaw, 0.9, (x - 5.0, -2.0))
        tracks.add(0.0, view)
        tracks.add(1.0, view)
    turned = np.abs((tracks.cars(TRACK).yaw + math.pi / 2) % math.pi - math.pi / 2)
    assert len(turned) == 5
    assert turned.max() < math.radians(3.0)


@pytest.mark.parametrize("at", [(0.0, 0.0), (0.8, -0.3), (-1.5, 0.5)])
def test_a_laser_beside_the_camera_locates_the_same_cars(at):
    """The camera is at the vehicle's middle and looks to the right at a car 5 m away."""
    car = np.array([[-2.2, -5.9], [2.2, -5.9], [2.2, -4.1], [-2.2, -4.1]])
    scanner, mount, vehicle = SensorRig.thesis().lasers[0][1], Mount(z=1.3, yaw=-math.pi / 2), np.zeros(3)
    ranges = scanner.scan(ScanPlane(car[None]), (*at, 0.0), None)
    scan = RangeScan(*at, scanner.angles.astype(float), ranges.astype(float), scanner.max_range)
    half = CAMERA.fx * 2.2 / 4.1
    top, bottom = (CAMERA.cy + CAMERA.fy * (1.3 - z) / 4.1 for z in (1.5, 0.0))
    box = np.array([[CAMERA.cx - half, top, CAMERA.cx + half, bottom]])
    cars = localize_cars(Detections(box, np.float32([0.9])), scan, CAMERA, mount, vehicle)
    assert np.allclose(cars.xy, [[0.0, -5.0]], atol=0.1)
    for height, cars in ((1.4, 1), (0.4, 0), (2.6, 0)):  # a car, a step before the box, and a house behind it
        high = replace(scan, tops=np.full(len(scan.angle), height))
        found = localize_cars(Detections(box, np.float32([0.9])), high, CAMERA, mount, vehicle)
        assert len(found) == cars


def test_what_hides_from_the_other_point_is_left_out_of_a_scan():
    angle = np.radians(np.arange(-60.0, 60.5, 0.5))
    scan = RangeScan(0.0, 0.0, angle, np.where(np.abs(angle) < math.radians(10.0), 3.0, 10.0), 40.0)
    assert scan.seen_from(0.0, 0.0) is scan
    moved = scan.seen_from(0.0, 1.0)  # from the left, the post hides more on its right
    assert (np.diff(moved.angle) >= 0.0).all()
    assert len(moved.angle) < len(angle)
    near = moved.points(np.flatnonzero(moved.distance < 5.0))
    assert np.allclose(np.hypot(*near.T), 3.0)


def test_a_calibrated_camera_sees_no_cars_in_the_sky_or_on_its_own_bonnet():
    class Four:
        def detect(self, image):
            boxes = [[10, 190, 110, 245], [10, 10, 110, 60], [200, 330, 500, 479], [300, 190, 639, 479]]
            return Detections(np.array(boxes, float), np.full(4, 0.9, np.float32))

    camera = PinholeCamera.from_field_of_view(640, 480, math.radians(90.0))
    ground = GroundDetector(Four(), camera, Mount(z=1.3))
    found = ground.detect(np.zeros((480, 640, 3), np.uint8))
    assert found.boxes[:, 0].tolist() == [300.0]  # the near car
    with pytest.raises(InputError, match="want 640×480 as calibrated"):
        ground.detect(np.zeros((48, 64, 3), np.uint8))
