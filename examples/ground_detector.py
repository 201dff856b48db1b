"""Detectors of your own: one by colour alone, without training, and one that runs a network of any layout.

`GroundDetector`: cars are what stands on the road. The road directly in front of the camera gives the colour of the
ground. In each column of the image the lowest pixels of another colour are the foot of an obstacle; neighbouring
columns with feet at the same height are one obstacle; and its foot tells its distance, hence its height in the image.
After Ulrich and Nourbakhsh, "Appearance-based obstacle detection with monocular color vision" (AAAI 2000).

    parkenv survey --scenario mini --sessions 1 --detector examples.ground_detector:GroundDetector

`NetworkDetector`: a network that parkenv does not read by itself, run by OpenCV; here one that suppresses non-maxima
and puts out (1, n, 6): corners in px of the input, score and class (YOLO26, YOLOv10: `yolo export format=onnx`). For
others change `boxes_of`.

    parkenv detect photos/ --detector examples.ground_detector:NetworkDetector
"""

import cv2
import numpy as np

from parkenv import make_scenario
from parkenv.mapping.survey import Survey, SurveySettings
from parkenv.perception.detector import LEAST_PROBABILITY, Detections

SCALE = 4  # the image is searched at a quarter of its resolution
FOOT_ROWS = 5  # pixels of another colour above each other that make an obstacle
CAR_TOP = 0.15  # how far a car's roof is above the horizon, as a fraction of its foot's depth below it
PROBABILITY = 0.5  # of every box: colour gives no degrees

NETWORK, SIZE = "yolo26n.onnx", 640  # the network's file, and the side of its square input, px
CARS = (2, 5, 7)  # the classes that are cars: COCO's car, bus and truck


class GroundDetector:
    """Implements `parkenv.perception.detector.Detector`, for a level camera at eye height."""

    def detect(self, image):
        """Find obstacles of a car's shape in an image, (h, w, 3) uint8 RGB."""
        if image.ndim == 2:
            image = cv2.cvtColor(image, cv2.COLOR_GRAY2RGB)
        small = cv2.resize(image, None, fx=1 / SCALE, fy=1 / SCALE, interpolation=cv2.INTER_AREA)
        foot = self.foot_rows(cv2.cvtColor(cv2.medianBlur(small, 5), cv2.COLOR_RGB2LAB).astype(np.float32))
        horizon = small.shape[0] / 2
        boxes = []
        for columns in obstacles(foot, horizon):
            bottom = float(np.median(foot[columns]))
            below = bottom - horizon
            if 0.5 * below < len(columns) < 4.5 * below:
                boxes.append((columns[0], horizon - CAR_TOP * below, columns[-1] + 1, bottom))
        boxes = SCALE * np.array(boxes, dtype=np.float32).reshape(-1, 4)
        width, height = boxes[:, 2] - boxes[:, 0], boxes[:, 3] - boxes[:, 1]
        return Detections(boxes, np.full(len(boxes), PROBABILITY), end_on=width < 1.9 * height)

    def foot_rows(self, lab):
        """Return the row at which the ground ends in each column of a CIELAB image, (w,); 0 if it does not."""
        height = len(lab)
        road = lab[-height // 12 :].reshape(-1, 3)
        colour = np.median(road, axis=0)
        spread = np.maximum(1.5 * np.median(np.abs(road - colour), axis=0), (6.0, 2.0, 2.0))
        other = (np.abs(lab - colour) > 4.0 * spread).any(axis=2)[height // 2 + 1 :]
        # True where this pixel and the next ones above it are not ground; slot lines are too thin for that.
        solid = np.all([other[k : len(other) - FOOT_ROWS + 1 + k] for k in range(FOOT_ROWS)], axis=0)
        lowest = len(solid) - 1 - np.argmax(solid[::-1], axis=0)
        return np.where(solid.any(axis=0), height // 2 + 1 + lowest + FOOT_ROWS, 0)


def obstacles(foot, horizon):
    """Yield runs of neighbouring columns whose feet are at nearly the same row, well below the horizon."""
    run = []
    for column, row in enumerate(foot):
        if run and abs(row - foot[run[-1]]) > 2 + 0.08 * (foot[run[-1]] - horizon):
            yield run
            run = []
        if row > horizon + 5:
            run.append(column)
    if run:
        yield run


class NetworkDetector:
    """Runs a network on one thread; the file is trusted."""

    def __init__(self):
        cv2.setNumThreads(1)
        self.network = cv2.dnn.readNetFromONNX(NETWORK)

    def detect(self, image):
        """Find cars in an image, (h, w, 3) uint8 RGB."""
        if image.ndim == 2:
            image = cv2.cvtColor(image, cv2.COLOR_GRAY2RGB)
        height, width = image.shape[:2]
        scale = SIZE / max(height, width)
        canvas = np.full((SIZE, SIZE, 3), 114, np.uint8)
        small = cv2.resize(image, (round(width * scale), round(height * scale)))
        canvas[: small.shape[0], : small.shape[1]] = small
        self.network.setInput(canvas.transpose(2, 0, 1)[None].astype(np.float32) / 255)
        boxes, score = self.boxes_of(self.network.forward())
        width, height = (boxes[:, 2:] - boxes[:, :2]).T
        return Detections(boxes / scale, score, end_on=width < 1.8 * height)

    def boxes_of(self, output):
        """Return left, top, right and bottom of cars, (n, 4) px of the input, and their probabilities, (n,)."""
        rows = output[0]
        rows = rows[np.isin(rows[:, 5].round(), CARS) & (rows[:, 4] > LEAST_PROBABILITY)]
        return rows[:, :4], rows[:, 4]


if __name__ == "__main__":
    scenario = make_scenario("mini")
    for name in ("hog", f"{__name__}:{GroundDetector.__name__}"):
        result = Survey(scenario, SurveySettings(every=3.0, weather="overcast", detector=name)).drive(0)
        found, score = f"{result.found} of {result.parked} parked cars", result.score
        print(f"{name}: found {found}; {score.right} of {score.detections} detections were right")
