"""Record survey drives capture by capture for the replay of a report."""

import base64
import io
import math
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image as PillowImage

from parkenv.mapping.grid import OccupancyGrid
from parkenv.mapping.survey import SessionResult, Survey, SurveyFrame
from parkenv.perception.pipeline import CameraView, PerceptionResult
from parkenv.show.scene import LotScene
from sim_sensors.rig import poses_along

PICTURE_WIDTH = 480  # width of recorded camera frames, px
JPEG_QUALITY = 68
SCAN_REACH = 16.0  # maximum length of recorded beams, m
MOST_FRAMES = 120
LEVELS = 15  # shades of the occupancy grid

Recording = dict[str, Any]


def record_drive(
    survey: Survey, number: int, pictures: int = 0, most_frames: int = MOST_FRAMES
) -> tuple[SessionResult, Recording]:
    captures = len(poses_along(survey.route.path, survey.settings.every))
    step = max(1, math.ceil(captures / most_frames))
    frames: list[Recording] = []
    count, first_time = 0, 0.0
    known = np.full(survey.scenario.lot.n_slots, -1)
    taken = np.zeros(survey.scenario.lot.n_slots, dtype=np.bool_)

    def watch(frame: SurveyFrame) -> None:
        nonlocal count, first_time, known, taken
        first_time = first_time if count else frame.result.captured.time
        if count % step == 0 or count == captures - 1:
            states = frame.slots.states()
            now = np.where(states.in_view, np.round(255 * states.p_occupied), -1).astype(np.int64)
            frames.append(
                {
                    **_frame(frame, first_time),
                    "belief": _changes(known, now),
                    "truth": _changes(taken.astype(np.int64), frame.truth.astype(np.int64)),
                }
            )
            known, taken = now, frame.truth.copy()
        count += 1

    result = survey.drive(number, pictures=pictures, on_frame=watch)
    grid = result.grid
    rows, columns = grid.log_odds.shape
    return result, {
        "lot": LotScene.of(survey.scenario.lot).data(),
        "drive": {
            "key": result.session.key,
            "scenario": survey.scenario.name,
            "weather": result.session.weather.replace("_", " "),
            "rig": result.session.rig,
            "day": result.arrival.day,
            "time_s": round(float(result.arrival.time), 1),
            "captures": captures,
            "slot_accuracy": result.slot_accuracy,
            "found": result.found,
            "parked": result.parked,
            "grid": {
                "x": grid.low[0],
                "y": grid.low[1],
                "width": 2 * (columns // 2) * grid.cell,
                "height": 2 * (rows // 2) * grid.cell,
            },
            "frames": frames,
        },
    }


def _frame(frame: SurveyFrame, first_time: float) -> Recording:
    result = frame.result
    x, y, yaw = (round(float(v), 3) for v in result.vehicle)
    view = result.views[0]
    return {
        "t": round(result.captured.time - first_time, 2),
        "pose": [x, y, yaw],
        "picture": _jpeg(view.image),
        "boxes": _boxes(view),
        "cars": [
            [round(float(v), 2) for v in (*xy, yaw, *size)]
            for its in result.views
            for xy, yaw, size in zip(its.cars.xy, its.cars.yaw, its.cars.size, strict=True)
        ],
        "scan": _scan(result),
        "map": _grid_png(frame.grid),
    }


def _boxes(view: CameraView) -> list[list[float]]:
    """List, per box: left, top, right, bottom as fractions of the image; probability; is a front or rear; is ranged."""
    height, width = view.image.shape[:2]
    boxes = []
    for i, (left, top, right, bottom) in enumerate(view.detections.boxes.tolist()):
        p = float(view.detections.probability[i])
        box = (left / width, top / height, right / width, bottom / height, p)
        end_on, ranged = int(view.detections.end_on[i]), int(i in view.cars.detection)
        boxes.append([*(round(v, 3) for v in box), end_on, ranged])
    return boxes


def _scan(result: PerceptionResult) -> list[int]:
    """List the end points of beams relative to the car, in decimetres, x and y alternating."""
    x, y, _ = result.vehicle
    points = [
        scan.points(np.flatnonzero(np.nan_to_num(scan.distance, nan=np.inf) < SCAN_REACH))[::2]
        for scan in result.scans
    ]
    away = np.concatenate(points) - [x, y] if points else np.empty((0, 2))
    whole: list[int] = np.round(10 * away).astype(np.int64).ravel().tolist()
    return whole


def _changes(before: NDArray[np.int64], now: NDArray[np.int64]) -> list[int]:
    changed = np.flatnonzero(before != now)
    pairs: list[int] = np.stack([changed, now[changed]], axis=1).ravel().tolist()
    return pairs


def _jpeg(image: NDArray[np.uint8]) -> str:
    height = round(image.shape[0] * PICTURE_WIDTH / image.shape[1])
    small = cv2.resize(image, (PICTURE_WIDTH, height), interpolation=cv2.INTER_AREA)
    content = io.BytesIO()
    PillowImage.fromarray(small).save(content, "JPEG", quality=JPEG_QUALITY, optimize=True)
    return data_uri("image/jpeg", content.getvalue())


def _grid_png(grid: OccupancyGrid) -> str:
    rows, columns = (2 * (n // 2) for n in grid.log_odds.shape)
    blocks = (rows // 2, 2, columns // 2, 2)
    p = grid.probability[:rows, :columns].reshape(blocks).max(axis=(1, 3))
    seen = grid.seen[:rows, :columns].reshape(blocks).any(axis=(1, 3))
    shade = np.where(seen, 1 + np.round((LEVELS - 1) * p), 0).astype(np.uint8)[::-1]
    picture = PillowImage.fromarray(shade)
    picture.putpalette(_PALETTE)
    content = io.BytesIO()
    picture.save(content, "PNG", optimize=True, bits=4, transparency=_OPACITY)
    return data_uri("image/png", content.getvalue())


_COLORS = np.linspace([150.0, 190.0, 215.0], [112.0, 48.0, 170.0], LEVELS)
# Transparent, then from pale blue to dark violet.
_PALETTE = [0, 0, 0, *np.round(_COLORS).astype(int).ravel().tolist()]
# Opacity of each colour: slots are visible through free cells.
_OPACITY = bytes([0, *np.round(np.linspace(50, 235, LEVELS)).astype(int).tolist()])


def data_uri(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"
