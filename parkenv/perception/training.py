"""Train a car model from aligned crops of cars, images without cars, and mined hard negatives."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from parkenv.compiled.arrays import Float32Array, Image
from parkenv.errors import InputError, require_number, require_whole, with_extra
from parkenv.perception.car_datasets import LabelledImage
from parkenv.perception.car_model import CarModel
from parkenv.perception.detector import overlaps
from parkenv.perception.hog import Descriptor
from parkenv.perception.hog_detector import HogDetector, best_boxes

CAR_OVERLAP = 0.25
_LEAST = 20
_PER_IMAGE = 5  # largest number of hard negatives from one image per round
_FOLDS = 5
_SHIFT = 0.015  # largest shift of a copy, as a fraction of the window
_RESIZE = 0.025  # largest change of a copy's size, as a fraction
_NO_CARS = np.empty((0, 4))


@dataclass(frozen=True)
class TrainingSettings:
    penalty: float = 0.03  # C of the support vector machine
    rounds: int = 3  # rounds of hard-negative mining, each on another part of the images
    jitter: int = 4  # number of shifted and scaled copies of each positive
    misaligned: int = 2  # number of misaligned crops of each positive that become negatives
    enlarged: float = 2.0  # false positives are mined in crops enlarged so much, too; 0: none
    seed: int = 0  # seed of the jitter and the solver

    def __post_init__(self) -> None:
        require_number("penalty", self.penalty, above=0.0)
        for name in ("rounds", "jitter", "misaligned", "seed"):
            require_whole(name, getattr(self, name))
        if not (self.enlarged == 0.0 or 1.0 <= self.enlarged <= 8.0):
            raise InputError(f"enlarged is {self.enlarged}, want 0 or 1 to 8")


def train(
    positives: Sequence[Image],
    negatives: Sequence[Image],
    *,
    descriptor: Descriptor | None = None,
    end_on: bool = False,
    settings: TrainingSettings | None = None,
    trained_on: str = "",
    progress: Callable[[str], None] = lambda _: None,
) -> CarModel:
    """Train a model; equal arguments give bitwise equal weights on one machine.

    All crops are mirrored, and positives are jittered; windows with half a car are negatives from the start. In each
    following round the model scans the negative images, and its false positives join the negatives (Dalal and Triggs
    2005): so do those in the enlarged crops of cars and of others, for a model that has only seen whole cars finds
    small ones in the parts of a large one. Probabilities are calibrated on cross-validated scores (Platt 1999).

    Crops are grey, uint8; positives, at least 20, are filled by aligned cars, and resized to the descriptor's window.
    """
    if len(positives) < _LEAST or not negatives:
        raise InputError(
            f"{len(positives)} positives and {len(negatives)} negatives, want at least {_LEAST} and 1"
        )
    settings = settings or TrainingSettings()
    descriptor = descriptor or Descriptor()
    aspect = positives[0].shape[1] / positives[0].shape[0]
    rng = np.random.default_rng(settings.seed)
    size = (descriptor.width, descriptor.height)

    progress(f"describing {len(positives)} positives")
    jittered = [_moved(p, size, rng) for p in positives for _ in range(settings.jitter)]
    cars = [cv2.resize(p, size, interpolation=_how(p, size)) for p in positives] + jittered
    cars += [np.ascontiguousarray(c[:, ::-1]) for c in cars]
    beside = [_beside(p, size, rng) for p in positives for _ in range(settings.misaligned)]
    plain = [cv2.resize(n, size, interpolation=_how(n, size)) for n in negatives]
    yes = np.stack([descriptor.describe(c) for c in cars])
    others = beside + plain
    others += [np.ascontiguousarray(c[:, ::-1]) for c in others]
    no = np.stack([descriptor.describe(c) for c in others])

    model = CarModel(
        descriptor,
        np.zeros(descriptor.shape, np.float32),
        0.0,
        aspect,
        (0.0, 0.0, 1.0, 1.0),
        (1.0, 0.0),
        end_on,
        trained_on,
    )
    images = [LabelledImage("", n, _NO_CARS) for n in negatives]
    images += _enlarged(positives, negatives, settings.enlarged)
    for round_number in range(settings.rounds + 1):
        progress(f"round {round_number}: {len(yes)} positives, {len(no)} negatives")
        weights, bias = _svm(yes, no, settings)
        model = replace(model, weights=weights.reshape(descriptor.shape), bias=bias)
        if round_number == settings.rounds:
            break
        hard = mined(model, images[round_number :: settings.rounds])
        if not len(hard):
            progress(f"round {round_number}: no false positives are left")
            break
        no = np.concatenate([no, hard])
    progress("calibrating scores")
    return replace(model, calibration=_calibration(yes, no, settings))


def _enlarged(positives: Sequence[Image], negatives: Sequence[Image], by: float) -> list[LabelledImage]:
    if not by:
        return []

    def larger(image: Image) -> Image:
        return np.asarray(cv2.resize(image, None, fx=by, fy=by, interpolation=cv2.INTER_CUBIC))

    others = [LabelledImage("", larger(n), _NO_CARS) for n in negatives]
    cars = [larger(crop) for crop in positives]
    boxes = [np.array([[0.0, 0.0, *image.shape[::-1]]]) for image in cars]
    return others + [LabelledImage("", image, box) for image, box in zip(cars, boxes, strict=True)]


def mined(model: CarModel, images: Sequence[LabelledImage]) -> Float32Array:
    """Mine hard negatives: descriptors, (n, size), of the false positives with the highest scores in each image.

    Windows that overlap a labelled car by more than `CAR_OVERLAP` are skipped.
    """
    window = model.descriptor
    size = (window.width, window.height)
    descriptors = [np.empty((0, window.size), dtype=np.float32)]
    for labelled in images:
        image = labelled.image
        least = min(image.shape[0], image.shape[1] / model.region_aspect, 40.0)
        scan = HogDetector(
            (model,), least_height=max(8.0, 0.8 * least), scale_step=1.15, threshold=0.4, margin=0.1
        )
        seen = scan.scan(model, image)
        seen = seen.select(np.argsort(-seen.score, kind="stable")[: 40 * _PER_IMAGE])
        for car in labelled.boxes:
            seen = seen.select(overlaps(car, seen.boxes) <= CAR_OVERLAP)
        seen = seen.select(best_boxes(seen.regions, seen.score, 0.6)[:_PER_IMAGE])
        descriptors += [
            window.describe(cut_out(image, region, size))[None] for region in seen.regions.tolist()
        ]
    return np.concatenate(descriptors)


def _svm(yes: Float32Array, no: Float32Array, settings: TrainingSettings) -> tuple[Float32Array, float]:
    with with_extra("training a car model", "fit"):
        from sklearn.svm import LinearSVC
        from threadpoolctl import threadpool_limits

    machine = LinearSVC(
        C=settings.penalty, loss="hinge", random_state=settings.seed, max_iter=3_000, tol=1e-3
    )
    x = np.concatenate([yes, no]).astype(np.float64)
    with threadpool_limits(1):
        machine.fit(x, np.r_[np.ones(len(yes)), np.zeros(len(no))])
    return machine.coef_[0].astype(np.float32), float(machine.intercept_[0])


def _calibration(yes: Float32Array, no: Float32Array, settings: TrainingSettings) -> tuple[float, float]:
    from sklearn.linear_model import LogisticRegression

    # Copies of a car are a fixed number of rows apart; blocks keep most of them together.
    scores, labels = [], []
    for fold in range(_FOLDS):
        in_yes, in_no = (np.arange(len(x)) * _FOLDS // len(x) == fold for x in (yes, no))
        weights, bias = _svm(yes[~in_yes], no[~in_no], settings)
        for x, label in ((yes[in_yes], 1), (no[in_no], 0)):
            scores.append(x @ weights + bias)
            labels.append(np.full(len(x), label))
    fit = LogisticRegression(C=1e3).fit(np.concatenate(scores)[:, None], np.concatenate(labels))
    # The last digits depend on the number of threads; rounding gives equal files for equal training.
    return round(float(fit.coef_[0, 0]), 6), round(float(fit.intercept_[0]), 6)


def _how(image: Image, size: tuple[int, int]) -> int:
    return int(cv2.INTER_AREA if image.shape[1] > size[0] and image.shape[0] > size[1] else cv2.INTER_LINEAR)


def cut_out(image: Image, region: Sequence[float], size: tuple[int, int]) -> Image:
    """Cut a region, px, left, top, right, bottom, out of an image, resize it; the border is replicated outside."""
    left, top, right, bottom = region
    scale_x, scale_y = (right - left) / size[0], (bottom - top) / size[1]
    moved = np.array([[scale_x, 0.0, left + 0.5 * scale_x - 0.5], [0.0, scale_y, top + 0.5 * scale_y - 0.5]])
    if scale_x > 1.0 and scale_y > 1.0:
        # When shrinking, average first: fine texture would alias to false gradients.
        image = np.asarray(
            cv2.resize(image, None, fx=1.0 / scale_x, fy=1.0 / scale_y, interpolation=cv2.INTER_AREA)
        )
        moved = np.array([[1.0, 0.0, left / scale_x], [0.0, 1.0, top / scale_y]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpAffine(image, moved, size, flags=flags, borderMode=cv2.BORDER_REPLICATE))


def _shifted(crop: Image, size: tuple[int, int], dx: float, dy: float, grow: float) -> Image:
    height, width = crop.shape
    ends = (dx - grow) * width, (dy - grow) * height, (1.0 + dx + grow) * width, (1.0 + dy + grow) * height
    return cut_out(crop, ends, size)


def _moved(crop: Image, size: tuple[int, int], rng: np.random.Generator) -> Image:
    dx, dy = rng.uniform(-_SHIFT, _SHIFT, 2)
    return _shifted(crop, size, dx, dy, rng.uniform(-_RESIZE, _RESIZE) / 2.0)


def _beside(crop: Image, size: tuple[int, int], rng: np.random.Generator) -> Image:
    """Return a window with part of the car, or with the car too large or too small: a negative."""
    kind = rng.integers(3)
    if kind == 0:
        grow, (dx, dy) = 0.0, rng.uniform(0.22, 0.6, 2) * rng.choice([-1.0, 1.0], 2) * [1.0, rng.random()]
    elif kind == 1:
        grow, (dx, dy) = -rng.uniform(0.25, 0.35), rng.uniform(-0.3, 0.3, 2)
    else:
        grow, (dx, dy) = rng.uniform(0.25, 0.5), rng.uniform(-0.2, 0.2, 2)
    return _shifted(crop, size, dx, dy, grow)
