"""Detection on real photographs: shipped models, made without one, on UIUC's crops; training on KITTI's."""

import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest

from parkenv.perception.car_model import CarModel
from parkenv.perception.hog import Descriptor
from parkenv.perception.lab.car_datasets import LabelledImage, read_crop_folder, read_uiuc_training
from parkenv.perception.lab.cross_validation import FALSE_POSITIVES, cross_validated, score_on_crops
from parkenv.perception.lab.training import TrainingSettings
from parkenv.studies.sensing.detector_scores import score_on

DATA = Path(__file__).parents[2] / "shared" / "data"
UIUC, KITTI = DATA / "uiuc_cars_train", DATA / "kitti_crops" / "vehicles_and_background.zip"

needs_uiuc = pytest.mark.skipif(
    not UIUC.exists(), reason="UIUC's car images, which their publisher provides, are not here"
)
needs_kitti = pytest.mark.skipif(
    not KITTI.exists(), reason="KITTI's crops, which their publisher provides, are not here"
)


@needs_uiuc
@pytest.mark.slow
def test_the_shipped_side_model_knows_real_cars():
    score = score_on_crops(CarModel.load("side"), read_uiuc_training(UIUC), n_photos=0)
    assert score.auc > 0.9985
    assert dict(zip(FALSE_POSITIVES, score.recall, strict=True))[0.01] > 0.98
    assert dict(zip(FALSE_POSITIVES, score.recall, strict=True))[0.002] > 0.96


@needs_uiuc
@pytest.mark.slow
def test_training_on_uiuc_generalizes_to_crops_held_out():
    scores = cross_validated(read_uiuc_training(UIUC), folds=3, n_photos=0, descriptor=Descriptor(128, 64))
    assert np.mean([s.auc for s in scores]) > 0.999
    assert np.mean([s.recall[-1] for s in scores]) > 0.985


@needs_uiuc
@pytest.mark.slow
def test_the_shipped_side_model_scans_real_photographs():
    """Every crop as a separate image, and the backgrounds also at twice their size."""
    crops, nothing = read_uiuc_training(UIUC), np.empty((0, 4))
    images = [LabelledImage("car", c, np.array([[0.0, 0.0, 100.0, 40.0]])) for c in crops.positives]
    images += [LabelledImage("background", c, nothing) for c in crops.negatives]
    images += [LabelledImage("twice", cv2.resize(c, (200, 80)), nothing) for c in crops.negatives]
    assert score_on(CarModel.load("side"), images, "multi").row["eer"] > 0.96


@needs_kitti
@pytest.mark.slow
def test_training_on_real_crops_generalizes_to_others(tmp_path):
    with zipfile.ZipFile(KITTI) as archive:
        archive.extractall(tmp_path)
    # The crops are of many views and all alignments: a shifted car is still a car.
    settings = TrainingSettings(penalty=0.02, jitter=0, misaligned=0, rounds=0)
    scores = cross_validated(
        read_crop_folder(tmp_path),
        folds=2,
        n_photos=0,
        descriptor=Descriptor(128, 128, "blocks"),
        end_on=True,
        settings=settings,
    )
    assert np.mean([s.auc for s in scores]) > 0.995
    assert np.mean([s.recall[FALSE_POSITIVES.index(0.01)] for s in scores]) > 0.965
