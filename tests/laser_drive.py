"""Drives past parked cars with the thesis's laser, and detections as a faultless camera would make them."""

import math

import numpy as np

from parkenv.perception.detector import Detections
from parkenv.perception.range_scan import scan_from_laser
from sim_sensors.rig import SensorRig

_RIG = SensorRig.thesis()
_, CAMERA, EYE = _RIG.cameras[0]
_, LASER, MOUNT = _RIG.lasers[0]
LEAST_BEAMS, FARTHEST_M = 8, 12.0
CAR_HIGH = 1.5
END_LIMIT = math.radians(60.0)


def look(scene, pose, believed=None, rng=None):
    """A sweep from a pose, taken to be at `believed`, detections, and the place of each one's car."""
    scan, ids = LASER.scan_with_ids(scene.scan_plane, MOUNT.in_world(pose), rng)
    sweep = scan_from_laser(LASER, MOUNT, pose if believed is None else believed, scan)
    found, places = seen_cars(scene, pose, scan, ids)
    return sweep, found, places


def seen_cars(scene, pose, scan, ids):
    """Boxes around the beams that end on a parked car, within the camera's image."""
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
    boxes = np.array(boxes, dtype=np.float32).reshape(-1, 4)
    sure = np.ones(len(boxes), dtype=np.float32)
    return Detections(boxes, sure, np.array(ends, dtype=bool)), np.array(places, dtype=int)


def turned_off(yaw, true):
    """Angle between directions that are alike both ways round, rad."""
    return np.abs((yaw - true + math.pi / 2) % math.pi - math.pi / 2)
