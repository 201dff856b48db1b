"""Detection on real photographs: shipped models, made without one, on UIUC's crops; training on KITTI's."""

import tarfile
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest

from parkenv.perception.car_datasets import Crops, LabelledImage, read_crop_folder, read_uiuc_training
from parkenv.perception.car_model import CarModel
from parkenv.perception.detection_scores import recall_on_crops, score_on
from parkenv.perception.hog import Descriptor
from parkenv.perception.training import TrainingSettings, train

BLOCKS = 20
DATA = Path(__file__).parents[2] / "shared" / "data"
UIUC, KITTI = DATA / "uiuc_cars_train", DATA / "kitti_crops" / "vehicles_and_background.zip"

needs_uiuc, needs_kitti = (
    pytest.mark.skipif(not data.exists(), reason=f"{data.name}, which its publisher provides, is not here")
    for data in (UIUC, KITTI)
)
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def uiuc(tmp_path_factory):
    folder = tmp_path_factory.mktemp("uiuc")
    with tarfile.open(UIUC / "TrainImages.tar.gz") as archive:
        archive.extractall(folder, filter="data")
    return read_uiuc_training(folder)


def halves(crops):
    """Two sets of blocks of consecutive crops, drawn at random: crops of the same car are in the same set."""
    of_block = np.random.default_rng(0).permutation(np.arange(BLOCKS) % 2)
    parts = []
    for images in vars(crops).values():
        half = of_block[np.arange(len(images)) * BLOCKS // len(images)]
        parts.append([[image for image, h in zip(images, half, strict=True) if h == part] for part in (0, 1)])
    return [Crops(*half) for half in zip(*parts, strict=True)]


def recall(model, crops):
    """The fraction of the cars found at 1 % false positives."""
    return recall_on_crops(model, crops)[0]["recall"]


@needs_uiuc
def test_the_shipped_side_model_knows_real_cars(uiuc):
    assert recall(CarModel.load("side"), uiuc) > 0.98


@needs_uiuc
def test_training_on_uiuc_generalizes_to_crops_held_out(uiuc):
    known, held_out = halves(uiuc)
    assert recall(train(known.positives, known.negatives), held_out) > 0.985


@needs_uiuc
def test_the_shipped_side_model_scans_real_photographs(uiuc):
    """Every crop as a separate image, and the backgrounds also at twice their size."""
    nothing = np.empty((0, 4))
    images = [LabelledImage("car", c, np.array([[0.0, 0.0, 100.0, 40.0]])) for c in uiuc.positives]
    images += [LabelledImage("background", c, nothing) for c in uiuc.negatives]
    images += [LabelledImage("twice", cv2.resize(c, (200, 80)), nothing) for c in uiuc.negatives]
    assert score_on(CarModel.load("side"), images, "multi")["eer"] > 0.96


@needs_kitti
def test_training_on_real_crops_generalizes_to_others(tmp_path):
    with zipfile.ZipFile(KITTI) as archive:
        archive.extractall(tmp_path)
    known, held_out = halves(read_crop_folder(tmp_path))
    # The crops are of many views and all alignments: a shifted car is still a car.
    settings = TrainingSettings(penalty=0.02, jitter=0, misaligned=0, rounds=0)
    model = train(
        known.positives, known.negatives, descriptor=Descriptor(128, 128, "blocks"), end_on=True, settings=settings
    )  # fmt: skip
    assert recall(model, held_out) > 0.965
