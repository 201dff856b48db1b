"""Compare detectors on pictures of survey drives, at the same number of false positives."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import BoolArray, FloatArray
from parkenv.compiled.keyed_random import world_key
from parkenv.mapping.route import survey_route
from parkenv.perception.detector import Detections, Detector, overlaps
from parkenv.studies.results import Row
from parkenv.world.lot_scene import LotScenes, slot_lot
from parkenv.world.scenario import Scenario
from sim_sensors.camera.weather import PRESETS, Weather
from sim_sensors.ground_truth import VehicleBoxes, vehicle_boxes
from sim_sensors.rig import SensorRig, poses_along

DISTANCES = (0.0, 6.0, 9.0, 12.0, 20.0)  # m, limits of the bins
VISIBLE = (0.3, 0.6, 0.9, 1.0001)  # limits of the bins of the visible fraction
MATCH = 0.5
"""Least intersection over union of a found box with the whole or the visible box of a car."""

LEAST_HEIGHT = 16  # px, of the cars that should be found
_EITHER = 0.3  # overlap with a car that need not be found, from which a box does not count
_SEEDS = 1 << 20


@dataclass(frozen=True, eq=False)
class DrivePicture:
    """A picture of a drive, and its cars."""

    image: NDArray[np.uint8]
    weather: str
    truth: VehicleBoxes


@dataclass(frozen=True, eq=False)
class _Matched:
    """What a detector makes of all pictures."""

    found: list[FloatArray]  # for each picture, the score at which each car is found; -1 for never
    false: FloatArray  # scores of the boxes without a car


def drive_pictures(scenario: Scenario, pictures: int, seed: int = 0) -> Iterator[DrivePicture]:
    """Take pictures at even distances along the survey's route, each weather in turn, as its camera sees them.

    Args:
        scenario: lot, cars and times of day.
        pictures: number of pictures for each weather.
        seed: 0 or more.
    """
    route, lot = survey_route(scenario.lot), slot_lot(scenario.lot)
    _, camera, mount = SensorRig.named("laser").cameras[0]
    poses = poses_along(route.path, 1.0)
    for number, preset in enumerate(PRESETS):
        key = world_key(seed, number)
        arrival = scenario.occupancy.draw_arrival(scenario.arrival, key)
        scenes = LotScenes(lot, scenario, key, scenario.occupancy.world(key, arrival))
        weather = Weather.draw(preset, int(key) % _SEEDS)
        for i in range(pictures):
            pose = poses[int((i + number / len(PRESETS)) / pictures * len(poses))]
            scene, eye = scenes.at(arrival.time, pose), mount.camera_pose(pose)
            frame = camera.render(scene, eye, weather, (int(key) + i) % _SEEDS)
            yield DrivePicture(frame.image, preset, vehicle_boxes(camera, scene, eye, frame))


def score_on_drives(
    detectors: Mapping[str, Detector],
    pictures: Sequence[DrivePicture],
    false_positives: float,
    on_picture: Callable[[], None] = lambda: None,
) -> list[Row]:
    """Return the fraction of cars that each detector finds, by weather, distance and visible fraction.

    A car counts if at least 30 % of it are visible, it is at least 16 px high and within 20 m.

    Args:
        detectors: the detectors, by name.
        pictures: the pictures, of all weathers.
        false_positives: per picture; each detector's least score is set so that it has as many.
        on_picture: called after each picture and detector.

    Returns:
        Rows with part, cars, and for each detector its recall; the first is of all cars.
    """
    wanted = [_wanted(p.truth) for p in pictures]
    matched = {}
    for name, detector in detectors.items():
        found, false = [], []
        for picture, cars in zip(pictures, wanted, strict=True):
            hits, misses = _match(_within(detector.detect(picture.image), picture.image), picture.truth, cars)
            found.append(hits)
            false.append(misses)
            on_picture()
        matched[name] = _Matched(found, np.concatenate(false))
    least = {name: _threshold(m.false, false_positives * len(pictures)) for name, m in matched.items()}
    weather = np.concatenate([[p.weather] * len(w) for p, w in zip(pictures, wanted, strict=True)])
    distance = np.concatenate([p.truth.distance[w] for p, w in zip(pictures, wanted, strict=True)])
    visible = np.concatenate([p.truth.visible_fraction[w] for p, w in zip(pictures, wanted, strict=True)])
    whole = np.concatenate([_is_whole(p)[w] for p, w in zip(pictures, wanted, strict=True)])
    hit = {name: np.concatenate(m.found) > least[name] for name, m in matched.items()}

    def row(part: str, which: NDArray[np.bool_]) -> Row:
        rates = {name: float(h[which].mean()) if which.any() else None for name, h in hit.items()}
        return {"part": part, "cars": int(which.sum())} | rates

    rows = [row("all", np.ones(len(weather), dtype=np.bool_))]
    rows += [row(preset, weather == preset) for preset in PRESETS]
    rows += [row(part, which) for _, part, which in parts_of(distance, visible)]
    clear = whole & (visible >= VISIBLE[-2])
    return [*rows, row("whole and clear", clear), row("cut by the picture's border", ~whole)]


def bins(values: FloatArray, limits: Sequence[float]) -> Iterator[tuple[float, float, BoolArray]]:
    """Yield the ends of each bin between limits, and which of n values it holds, (n,) bool."""
    for low, high in itertools.pairwise(limits):
        yield low, high, (values >= low) & (values < high)


def parts_of(distance: FloatArray, visible: FloatArray) -> Iterator[tuple[str, str, BoolArray]]:
    """Yield group, name and members of the bins of n cars by distance, m, and by visible fraction."""
    for low, high, which in bins(distance, DISTANCES):
        yield "distance", f"{low:g} to {high:g} m", which
    for low, high, which in bins(visible, VISIBLE):
        yield "visible", f"{low:.0%} to {high:.0%} visible", which


def _is_whole(picture: DrivePicture) -> NDArray[np.bool_]:
    """Return which cars do not reach the picture's border."""
    height, width = picture.image.shape[:2]
    box = picture.truth.box
    inside = (box[:, :2] > 0).all(axis=1) & (box[:, 2] < width) & (box[:, 3] < height)
    return np.asarray(inside)


def _wanted(truth: VehicleBoxes) -> NDArray[np.int64]:
    high = truth.visible_box[:, 3] - truth.visible_box[:, 1] >= LEAST_HEIGHT
    return np.flatnonzero((truth.visible_fraction >= VISIBLE[0]) & high & (truth.distance < DISTANCES[-1]))


def _within(found: Detections, image: NDArray[np.uint8]) -> Detections:
    """Return the boxes that reach into the image, cut at its border as the true ones are."""
    height, width = image.shape[:2]
    boxes = np.clip(found.boxes, 0.0, np.array([width, height, width, height], np.float32))
    inside = (boxes[:, 2:] > boxes[:, :2]).all(axis=1)
    return Detections(boxes[inside], found.probability[inside])


def _match(
    found: Detections, truth: VehicleBoxes, wanted: NDArray[np.int64]
) -> tuple[FloatArray, FloatArray]:
    """Return the score at which each wanted car is found, and the scores of the boxes without a car."""
    hits, misses = np.full(len(wanted), -1.0), []
    others = np.setdiff1d(np.arange(len(truth.ids)), wanted)
    for i in np.argsort(-found.probability, kind="stable").tolist():
        box, score = found.boxes[i].astype(np.float64), float(found.probability[i])
        overlap = np.maximum(overlaps(box, truth.visible_box[wanted]), overlaps(box, truth.box[wanted]))
        overlap[hits >= 0.0] = 0.0
        best = int(overlap.argmax()) if len(overlap) else -1
        if best >= 0 and overlap[best] >= MATCH:
            hits[best] = score
        elif not (overlaps(box, truth.box[others]) > _EITHER).any():
            misses.append(score)
    return hits, np.array(misses)


def _threshold(false: FloatArray, most: float) -> float:
    """Return the score above which there are at most so many false positives."""
    ordered = np.sort(false)[::-1]
    return float(ordered[int(most)]) if len(ordered) > int(most) else 0.0
