"""The contract of a car detector: an image in, boxes with probabilities out."""

from __future__ import annotations

from typing import NamedTuple, Protocol, TypeVar, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import Float32Array, Image
from parkenv.errors import InputError
from sim_sensors.ground_truth import View

Float = TypeVar("Float", np.float32, np.float64)

# Least probability of the boxes that a detector should return. The pipeline keeps a box below `PROBABILITY` only if
# the range measurements in it fit a car on the ground.
LEAST_PROBABILITY = 0.08
PROBABILITY = 0.25  # least probability of a detection that no range measurements confirm


class Detections:
    """Cars found in one image, in any order.

    What a detector does not know: `view` is then END or SIDE as `end_on` says, and `visible_fraction` NaN.

    Args:
        boxes: (n, 4) float32, px: left, top, right, bottom of each car in image coordinates (x right, y down, origin at
            the upper left corner). Boxes may reach beyond the image.
        probability: (n,) float32, P(car) of each box, in [0, 1].
        end_on: (n,) bool, whether the car is seen from its front or rear rather than from its side; determines the
            orientation of a barely visible car. None: every car is seen from its side.
        score: (n,) float32, the detector's own scale, greater is better; None: the probabilities.
        regions: (n, 4) float32, px, the classified image region, with some background around the car, for data sets
            with such labels (UIUC). None: the boxes.
        view: (n,) int, a `sim_sensors.ground_truth.View` of each car: END, OBLIQUE or SIDE. None: not known.
        visible_fraction: (n,) float32, the fraction of each car that nothing hides, in [0, 1]; NaN where it is not
            known. None: not known of any car.

    Raises:
        InputError: an array of another shape, a number that is not finite, a box without area, or a probability or
            fraction outside [0, 1].
    """

    def __init__(
        self,
        boxes: NDArray[np.floating],
        probability: NDArray[np.floating],
        end_on: NDArray[np.bool_] | None = None,
        score: NDArray[np.floating] | None = None,
        regions: NDArray[np.floating] | None = None,
        view: NDArray[np.integer] | None = None,
        visible_fraction: NDArray[np.floating] | None = None,
    ) -> None:
        n = len(probability)
        self.boxes = _checked("boxes", boxes, (n, 4))
        self.probability = _checked("probability", probability, (n,))
        self.end_on = np.zeros(n, dtype=np.bool_) if end_on is None else np.asarray(end_on, dtype=np.bool_)
        self.score = self.probability if score is None else _checked("score", score, (n,))
        self.regions = self.boxes if regions is None else _checked("regions", regions, (n, 4))
        if self.end_on.shape != (n,):
            raise InputError(f"detections: end_on has shape {self.end_on.shape}, want ({n},)")
        if not ((self.probability >= 0.0) & (self.probability <= 1.0)).all():
            raise InputError(f"detections: probability is {self.probability.tolist()}, want 0 to 1")
        if not (self.boxes[:, 2:] > self.boxes[:, :2]).all():
            bad = int(np.flatnonzero((self.boxes[:, 2:] <= self.boxes[:, :2]).any(axis=1))[0])
            raise InputError(
                f"detections: boxes[{bad}] is {self.boxes[bad].tolist()}, want left < right and top < bottom"
            )
        self.view = np.where(self.end_on, View.END, View.SIDE).astype(np.int8)
        if view is not None:
            self.view = np.asarray(view, dtype=np.int8)
            if self.view.shape != (n,) or not np.isin(self.view, list(View)).all():
                views = ", ".join(f"{v.name} {v:d}" for v in View)
                raise InputError(f"detections: view is {self.view.tolist()}, want {n} of {views}")
        self.visible_fraction = np.full(n, np.nan, dtype=np.float32)
        if visible_fraction is not None:
            self.visible_fraction = np.asarray(visible_fraction, dtype=np.float32)
            known = self.visible_fraction[~np.isnan(self.visible_fraction)]
            if self.visible_fraction.shape != (n,) or not ((known >= 0.0) & (known <= 1.0)).all():
                raise InputError(
                    f"detections: visible_fraction is {self.visible_fraction.tolist()}, want {n} of 0 to 1 or NaN"
                )

    def __len__(self) -> int:
        return len(self.probability)

    def select(self, rows: NDArray[np.int64] | NDArray[np.bool_]) -> Detections:
        """Return some of the detections, by index or by mask."""
        return Detections(
            self.boxes[rows], self.probability[rows], self.end_on[rows], self.score[rows], self.regions[rows],
            self.view[rows], self.visible_fraction[rows],
        )  # fmt: skip


class DetectorErrors(NamedTuple):
    """How often a detector misses a car, and how its boxes differ from a car's outline: left, top, right, bottom.

    By default those of a network, as measured with `net` in simulated drives.
    """

    missed: float = 0.05  # fraction of cars that are whole in a picture and hidden by no box
    missed_on_streets: float = 0.15  # the same in pictures of real streets (KITTI, 6 to 15 m)
    # mean and standard deviations, fractions of the car's height in the image
    shift: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    std: tuple[float, float, float, float] = (0.06, 0.04, 0.06, 0.045)

    @property
    def on_streets(self) -> DetectorErrors:
        """Those in pictures of real streets."""
        return self._replace(missed=self.missed_on_streets)

    def corrected(self, boxes: NDArray[np.floating]) -> NDArray[np.float64]:
        shift = np.array(self.shift)
        height = (boxes[:, 3] - boxes[:, 1]) / (1.0 + shift[3] - shift[1])
        return np.asarray(boxes - height[:, None] * shift, dtype=np.float64)


class Detector(Protocol):
    """Finds cars in camera images.

    A detector that misses more cars than a network, or whose boxes are less tight, has an attribute `errors`
    (`DetectorErrors`), which mapping from pictures alone uses. One that may be called in several threads at once has
    `concurrent = True`.

    A custom detector is a class with this method and a constructor without arguments. Its name is `MODULE:CLASS`
    wherever a detector is expected: `parkenv survey --detector my_detectors:Mine`,
    `gym.make("parkenv/SearchPerception-v2", detector="my_detectors:Mine")`.

    The method must not depend on earlier calls: images of several cameras and episodes arrive in any order.
    """

    def detect(self, image: Image) -> Detections:
        """Find the cars in one image.

        Args:
            image: (h, w, 3) uint8, RGB, row 0 at the top; (h, w) uint8 if grey. It must not be changed.

        Returns:
            One box per car (without overlapping boxes of the same car), with at least `LEAST_PROBABILITY`.
        """
        ...


class GroundBand(NamedTuple):
    """Where the boxes of cars on the ground lie in the images of a camera without roll.

    A box of height h has its lower edge between `horizon` + `least`·h and `horizon` + `most`·h.
    """

    horizon: float  # px, row of the horizon, below the image's upper edge
    least: float
    most: float

    @classmethod
    def of(
        cls, horizon: float, eye: float, off_ground: float, top: tuple[float, float], least_height: float
    ) -> GroundBand:
        """Return the band of boxes whose lower edge is within `off_ground` of the ground, m, the upper at `top`.

        The camera is `eye` above the ground, m, and the two edges at least `least_height` apart.
        """
        most = (eye + off_ground) / max(top[0] + off_ground, least_height)
        return cls(horizon, (eye - off_ground) / (top[1] - off_ground), most)


@runtime_checkable
class BandDetector(Protocol):
    """A detector that is faster if it knows where in the image the cars can be."""

    def detect_on_ground(self, image: Image, band: GroundBand) -> Detections: ...


def detect_in(detector: Detector, image: Image, band: GroundBand) -> Detections:
    """Find the cars in an image; a detector that can do so looks only where they can be."""
    return (
        detector.detect_on_ground(image, band)
        if isinstance(detector, BandDetector)
        else detector.detect(image)
    )


def _checked(name: str, values: NDArray[np.floating], shape: tuple[int, ...]) -> Float32Array:
    array = np.asarray(values, dtype=np.float32)
    if array.shape != shape or not np.isfinite(array).all():
        raise InputError(f"detections: {name} has shape {array.shape}, want {shape} finite numbers")
    return array


def overlaps(box: NDArray[Float], others: NDArray[np.floating] | NDArray[np.integer]) -> NDArray[Float]:
    """Return the intersection over union of a box, (4,) left, top, right, bottom, with others, (n, 4)."""
    inner = np.minimum(box[2:], others[:, 2:]) - np.maximum(box[:2], others[:, :2])
    common = np.clip(inner, 0.0, None).prod(axis=1)
    area = (box[2:] - box[:2]).prod() + (others[:, 2:] - others[:, :2]).prod(axis=1)
    return np.asarray(common / np.maximum(area - common, 1e-9), dtype=box.dtype)
