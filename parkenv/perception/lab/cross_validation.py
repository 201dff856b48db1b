"""Cross-validation of training on one set of crops."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from parkenv.errors import InputError
from parkenv.perception.car_model import CarModel
from parkenv.perception.hog_detector import HogDetector
from parkenv.perception.lab.car_datasets import Crops
from parkenv.perception.lab.detection_scores import RecallPrecision, recall_at, recall_precision
from parkenv.perception.lab.made_photos import SIZES, made_photos
from parkenv.perception.lab.training import train

BLOCKS = 30
"""Number of blocks of consecutive files; images of the same car are neighbours and should share a block."""
FALSE_POSITIVES = (0.001, 0.002, 0.01)
MADE_PHOTOS = 150
"""Number of made photographs per fold."""
_Image = NDArray[np.uint8]


@dataclass(frozen=True)
class CropScore:
    """Scores of a model on held-out crops.

    Attributes:
        auc: area under the curve of true against false positives.
        recall: fraction of the cars found at each false-positive rate of `FALSE_POSITIVES`.
        n_cars, n_others: number of crops.
        equal_error: equal-error rate on photographs made of them, with cars of many sizes; nan without any.
    """

    auc: float
    recall: tuple[float, ...]
    n_cars: int
    n_others: int
    equal_error: float


def score_on_crops(model: CarModel, crops: Crops, seed: int = 0, n_photos: int = MADE_PHOTOS) -> CropScore:
    """Score a model on crops, each resized to its window, and on photographs made of them with this seed."""
    from sklearn.metrics import roc_auc_score

    scores = [scores_of(model, images) for images in (crops.positives, crops.negatives)]
    labels = np.repeat([1, 0], [len(s) for s in scores])
    return CropScore(
        float(roc_auc_score(labels, np.concatenate(scores))),
        tuple(recall_at(rate, scores[0], scores[1]) for rate in FALSE_POSITIVES),
        len(scores[0]),
        len(scores[1]),
        score_on_made_photos(model, crops, n_photos, seed).equal_error if n_photos else math.nan,
    )


def scores_of(model: CarModel, images: Sequence[_Image]) -> NDArray[np.float64]:
    """Return a model's score of each crop, resized to its window, (n,)."""
    window = (model.descriptor.width, model.descriptor.height)
    resized = np.stack([cv2.resize(i, window, interpolation=cv2.INTER_LINEAR) for i in images])
    return model.scores(resized).astype(np.float64)


def score_on_made_photos(model: CarModel, crops: Crops, n: int, seed: int = 0) -> RecallPrecision:
    """Search photographs made of the crops for cars of all sizes, and smaller and larger ones.

    Args:
        model: a model that has not been trained on the crops.
        crops: aligned crops of cars, and images without cars.
        n: number of photographs.
        seed: seed of the photographs.
    """
    photos = made_photos(crops, n, seed)
    height = crops.positives[0].shape[0]
    detector = HogDetector.for_evaluation(model, 0.8 * SIZES[0] * height, 1.2 * SIZES[1] * height)
    found = [detector.detect(photo.image) for photo in photos]
    return recall_precision(
        [f.regions for f in found], [f.score for f in found], [photo.boxes for photo in photos]
    )


def cross_validated(
    crops: Crops,
    *,
    folds: int = 5,
    seed: int = 0,
    n_photos: int = MADE_PHOTOS,
    progress: Callable[[str], None] = lambda _: None,
    **training: Any,
) -> list[CropScore]:
    """Cross-validate over blocks of consecutive files: each block is held out once.

    Args:
        crops: crops of cars and of others.
        folds: number of models to train.
        seed: seed of the assignment of blocks to folds.
        n_photos: number of photographs made of the crops of each fold, which take longer to search than the crops.
        progress: called with a line for each fold.
        **training: arguments of `train`.

    Raises:
        InputError: fewer than two folds, more folds than blocks, or fewer crops than blocks.
    """
    if not 2 <= folds <= BLOCKS:
        raise InputError(f"folds is {folds}, want 2 to {BLOCKS}")
    for name in ("positives", "negatives"):
        if len(getattr(crops, name)) < BLOCKS:
            raise InputError(f"{len(getattr(crops, name))} {name}, want at least {BLOCKS} to cross-validate")
    fold_of = np.random.default_rng(seed).permutation(np.arange(BLOCKS) % folds)
    scores = []
    for fold in range(folds):
        progress(f"fold {fold + 1} of {folds}")
        model = train(
            _part(crops.positives, fold_of, fold, False),
            _part(crops.negatives, fold_of, fold, False),
            **training,
        )
        held_out = replace(
            crops,
            positives=_part(crops.positives, fold_of, fold, True),
            negatives=_part(crops.negatives, fold_of, fold, True),
        )
        scores.append(score_on_crops(model, held_out, seed + fold, n_photos))
    return scores


def _part(images: Sequence[_Image], fold_of: NDArray[np.int64], fold: int, inside: bool) -> list[_Image]:
    block = np.arange(len(images)) * BLOCKS // len(images)
    return [i for i, b in zip(images, block, strict=True) if (fold_of[b] == fold) == inside]
