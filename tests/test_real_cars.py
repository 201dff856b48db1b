"""Detection on real photographs: shipped models, made without one, on UIUC's crops; training on KITTI's."""

import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest

from parkenv.evaluation.detector_scores import score_on
from parkenv.perception.car_datasets import LabelledImage, read_crop_folder, read_uiuc_training
from parkenv.perception.detection_scores import recall_at
from parkenv.perception.detector import CarModel
from parkenv.perception.hog import Descriptor
from parkenv.perception.training import TrainingSettings, train

DATA = Path(__file__).parents[2] / "shared" / "data"
UIUC, KITTI = DATA / "uiuc_cars_train", DATA / "kitti_crops" / "vehicles_and_background.zip"
BLOCKS = 30

needs_uiuc = pytest.mark.skipif(
    not UIUC.exists(), reason="UIUC's car images, which their publisher provides, are not here"
)
needs_kitti = pytest.mark.skipif(
    not KITTI.exists(), reason="KITTI's crops, which their publisher provides, are not here"
)


def stretched(images, descriptor):
    size = (descriptor.width, descriptor.height)
    return np.stack([cv2.resize(i, size, interpolation=cv2.INTER_LINEAR) for i in images])


def area_under_curve(positive, negative):
    return float((positive[:, None] > negative[None, :]).mean())


@needs_uiuc
def test_the_shipped_side_model_knows_real_cars():
    model, crops = CarModel.load("side"), read_uiuc_training(UIUC)
    yes, no = (model.scores(stretched(c, model.descriptor)) for c in (crops.positives, crops.negatives))
    assert area_under_curve(yes, no) > 0.9985
    assert recall_at(0.01, yes, no) > 0.98
    assert recall_at(0.002, yes, no) > 0.96


@needs_uiuc
@pytest.mark.slow
def test_the_shipped_side_model_scans_real_photographs():
    """Every crop as a picture of its own, and the backgrounds at twice their size, too."""
    crops, nothing = read_uiuc_training(UIUC), np.empty((0, 4))
    images = [LabelledImage("car", c, np.array([[0.0, 0.0, 100.0, 40.0]])) for c in crops.positives]
    images += [LabelledImage("background", c, nothing) for c in crops.negatives]
    images += [LabelledImage("twice", cv2.resize(c, (200, 80)), nothing) for c in crops.negatives]
    assert score_on(CarModel.load("side"), images, "multi").row["eer"] > 0.96


def block_of(n):
    """Which block of file order each of n crops is in; those near one another are pictures of one car."""
    return np.arange(n) * BLOCKS // n


@needs_kitti
@pytest.mark.slow
def test_training_on_real_crops_generalizes_to_others(tmp_path):
    with zipfile.ZipFile(KITTI) as archive:
        archive.extractall(tmp_path)
    crops, descriptor = read_crop_folder(tmp_path), Descriptor(128, 128, "blocks")
    areas, recalls = [], []
    for seed in (10, 11, 12):
        rng = np.random.default_rng(seed)
        halves = []
        for images in (crops.positives, crops.negatives):
            held_out = np.isin(block_of(len(images)), rng.permutation(BLOCKS)[: BLOCKS // 3])
            halves.append(
                [[i for i, h in zip(images, held_out, strict=True) if h == part] for part in (0, 1)]
            )
        (cars, unseen_cars), (others, unseen_others) = halves
        # The crops are of many views and all alignments: a shifted car is still a car.
        settings = TrainingSettings(penalty=0.02, jitter=0, misaligned=0, rounds=0, seed=seed)
        model = train(cars, others, descriptor=descriptor, ends=True, settings=settings)
        yes, no = (model.scores(stretched(i, descriptor)) for i in (unseen_cars, unseen_others))
        areas.append(area_under_curve(yes, no))
        recalls.append(recall_at(0.01, yes, no))
    assert min(areas) > 0.993
    assert np.mean(recalls) > 0.94
