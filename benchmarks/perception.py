"""Benchmark of detection and mapping, against OpenCV 4's detector and scikit-image's HOG."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.rows import Row, duration, rate, seconds_each
from parkenv.errors import InputError
from parkenv.files.limited_reading import parse_json
from parkenv.mapping.grid import OccupancyGrid
from parkenv.mapping.survey import Survey, SurveySettings
from parkenv.perception.car_model import CarModel
from parkenv.perception.hog import Descriptor
from parkenv.perception.hog_detector import HogDetector, as_grey
from parkenv.perception.pipeline import PerceptionPipeline
from parkenv.perception.range_scan import scan_from_laser
from parkenv.perception.slot_filter import SlotFilter
from parkenv.scenarios.build import make_scenario
from parkenv.world.lot_scene import slot_lot
from sim_sensors.rig import SensorRig, TimedCapture

PEERS_PYTHON = "PARKENV_BENCH_PYTHON"
"""Environment variable with the path of a Python that has `opencv-python-headless<5` and `scikit-image`: parkenv needs
OpenCV 5, which no longer has a HOGDescriptor."""

_PEERS = """
import json, sys, time
import numpy as np
image, seconds = np.load(sys.argv[1]), float(sys.argv[2])
def each(work):
    work()
    times, end = [], time.perf_counter() + seconds
    while len(times) < 3 or time.perf_counter() < end:
        start = time.perf_counter(); work(); times.append(time.perf_counter() - start)
    return float(np.median(times))
found = {}
try:
    import cv2
    cv2.setNumThreads(1)
    if hasattr(cv2, "HOGDescriptor"):
        hog = cv2.HOGDescriptor((128, 64), (16, 16), (8, 8), (8, 8), 9)
        weights = np.zeros(hog.getDescriptorSize() + 1, np.float32); weights[-1] = -3
        hog.setSVMDetector(weights)
        found["opencv"] = each(lambda: hog.detectMultiScale(image, 0, (8, 8), (0, 0), 1.2, 0))
except ImportError:
    pass
try:
    from skimage.feature import hog as skimage_hog
    found["skimage"] = each(lambda: skimage_hog(image, 9, (8, 8), (1, 1), feature_vector=False))
except ImportError:
    pass
print(json.dumps(found))
"""


def perception_rows(seed: int = 0, seconds: float = 0.6) -> list[Row]:
    """Return the rows of `python benchmarks/run.py perception`, with the peers that are installed for `PEERS_PYTHON`.

    Args:
        seed: seed of the lot.
        seconds: duration of each measurement.

    Raises:
        InputError: `PEERS_PYTHON` is not a working Python.
    """
    scenario = make_scenario("campus")
    lot = scenario.lot
    rng = np.random.default_rng(seed)
    scene = slot_lot(lot).scene(rng.random(lot.n_slots) < 0.8, seed)
    rig = SensorRig.thesis()
    pose = np.array([*lot.vertex_xy[40], lot.vertex_yaw[40]])
    capture = rig.capture(scene, pose, seed=seed)
    image = capture.images["right"].image
    grey = as_grey(image)
    peers = _peers(grey, seconds)
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        rows = _detector_rows(grey, seconds, peers)
    finally:
        cv2.setNumThreads(threads)

    pipeline, slots = PerceptionPipeline(rig, lot), SlotFilter(lot)
    captured = TimedCapture(0.0, capture)
    whole = seconds_each(lambda _: pipeline.process(captured, slots), seconds)
    rows += rate("perception", "frame to cars in the world, both models", 1.0 / whole, "frames/s")
    _, laser, mount = rig.lasers[0]
    scan = scan_from_laser(laser, mount, pose, capture.scans["laser"])
    beams = seconds_each(lambda _: slots.update_from_scan(scan), seconds)
    rows += duration("mapping", f"{laser.n_beams} beams into {lot.n_slots} slots", 1e3 * beams, "ms")
    low_x, low_y, high_x, high_y = lot.bounds()
    grid = OccupancyGrid((low_x, low_y), (high_x, high_y), 0.25)
    cars = np.array([[0.2, 3.0], [-0.3, 5.0]])
    update = seconds_each(lambda _: grid.update((pose[0], pose[1]), pose[2], 0.7, cars), seconds)
    rows += duration("mapping", "grid update, 0.25 m cells, 12 m", 1e3 * update, "ms")
    survey = Survey(make_scenario("mini"), SurveySettings(weather="sunny"))
    session = seconds_each(survey.drive, 0.0, least=1)
    return rows + rate("mapping", "sessions of mini, pictures drawn and seen", 60.0 / session, "sessions/min")


def _detector_rows(grey: NDArray[np.uint8], seconds: float, peers: dict[str, float]) -> list[Row]:
    """Measure the side model on one thread, at all sizes from the window's own upwards, as OpenCV does."""
    side = CarModel.load("side")
    plain = CarModel(side.descriptor, side.weights, -1e3, 2.0)
    detector = HogDetector((plain,), least_height=64.0, most_height=480.0, scale_step=1.2, margin=0.0)
    scan = seconds_each(lambda _: detector.detect(grey), seconds)
    opencv = {"OpenCV 4 detectMultiScale": 1.0 / peers["opencv"]} if "opencv" in peers else {}
    rows = rate(
        "perception", "640×480, 128×64 window, step 1.2, one thread", 1.0 / scan, "frames/s", **opencv
    )
    cell = Descriptor(normalization="cell")
    cells = seconds_each(lambda _: cell.features(grey), seconds)
    skimage = {"scikit-image hog": 1e3 * peers["skimage"]} if "skimage" in peers else {}
    return rows + duration("perception", "cells of 640×480, one thread", 1e3 * cells, "ms", **skimage)


def _peers(grey: NDArray[np.uint8], seconds: float) -> dict[str, float]:
    """Measure the time, s, that each installed peer takes for the image, with `PEERS_PYTHON` or else this Python."""
    python = os.environ.get(PEERS_PYTHON, sys.executable)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "image.npy"
        np.save(file, grey)
        try:
            done = subprocess.run(
                [python, "-c", _PEERS, str(file), str(seconds)], capture_output=True, text=True, check=True
            )
        except (OSError, subprocess.CalledProcessError) as error:
            raise InputError(f"{PEERS_PYTHON}={python}: does not run the peers: {error}") from error
    found: dict[str, float] = parse_json(done.stdout, "opencv")
    return found
