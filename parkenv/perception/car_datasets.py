"""Labelled photographs of cars: the published UIUC car data set, and plain folders of crops."""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from parkenv.compiled.arrays import FloatArray, Image
from parkenv.errors import InputError, require_one_of
from parkenv.files.images import images_in, read_image
from parkenv.files.limited_reading import read_text
from parkenv.perception.hog_detector import as_grey

UIUC_SIZE = (100, 40)  # width and height, px, of UIUC's training crops and of its true boxes at scale 1
UIUC_TESTS = {
    "single": ("TestImages", "trueLocations.txt"),
    "multi": ("TestImages_Scale", "trueLocations_Scale.txt"),
}
_PLACE = re.compile(r"\(((?:\s*-?\d{1,6}\s*,){1,2}\s*-?\d{1,6}\s*)\)", re.ASCII)
_POSITIVE, _NEGATIVE = ("positives", "vehicles", "pos"), ("negatives", "non-vehicles", "neg")


@dataclass(frozen=True, eq=False)
class Crops:
    positives: list[Image]  # grey, uint8, with the car at the same position in each
    negatives: list[Image]  # grey, uint8, of any size


@dataclass(frozen=True, eq=False)
class LabelledImage:
    name: str  # name of the file
    image: Image  # (h, w) uint8
    boxes: FloatArray  # (n, 4) float64 px, left, top, right, bottom


def read_uiuc_training(folder: Path) -> Crops:
    images = {file.name: as_grey(read_image(file)) for file in images_in(folder / "TrainImages")}
    crops = Crops(
        *([im for name, im in images.items() if name.startswith(kind)] for kind in ("pos-", "neg-"))
    )
    if not crops.positives or not crops.negatives:
        raise InputError(
            f"{folder}: has {len(images)} other images, want TrainImages/pos-N.pgm and neg-N.pgm"
        )
    return crops


def read_uiuc_test(folder: Path, test_set: str) -> list[LabelledImage]:
    """Read a test set of UIUC's folder `CarData`, `single` or `multi`, with the published true locations."""
    require_one_of("test set", test_set, UIUC_TESTS)
    images, truth = (folder / name for name in UIUC_TESTS[test_set])
    if not truth.is_file():
        raise InputError(f"{truth}: no such file; want the folder as UIUC publishes it")
    labelled = []
    for line in read_text(truth).splitlines():
        if not line.strip():
            continue
        number, _, places = line.partition(":")
        numbers = [[int(n) for n in found.split(",")] for found in _PLACE.findall(places)]
        if (
            not re.fullmatch(r"\s*\d{1,9}\s*", number, re.ASCII)
            or _PLACE.sub("", places).strip()
            or any(len(n) != (2 if test_set == "single" else 3) for n in numbers)
        ):
            raise InputError(
                f"{truth}: line {line!r:.80}, want n: (i,j) ... with a width each in the multi-scale set"
            )
        boxes = []
        for top, left, *width in numbers:
            wide = float(width[0]) if width else float(UIUC_SIZE[0])
            boxes.append([left, top, left + wide, top + wide * UIUC_SIZE[1] / UIUC_SIZE[0]])
        file = images / f"test-{int(number)}.pgm"
        box = np.array(boxes, dtype=np.float64).reshape(-1, 4)
        labelled.append(LabelledImage(file.name, as_grey(read_image(file)), box))
    if not labelled:
        raise InputError(f"{truth}: names no image, want lines n: (i,j) ...")
    return labelled


def read_crop_folder(folder: Path) -> Crops:
    """Read a folder with `positives` and `negatives` (or `vehicles` and `non-vehicles`), images at any depth."""
    parts = []
    for names in (_POSITIVE, _NEGATIVE):
        there = [folder / name for name in names if (folder / name).is_dir()]
        if not there:
            raise InputError(f"{folder}: holds no folder {names[0]}/ (or {', '.join(names[1:])})")
        parts.append([as_grey(read_image(file)) for file in images_in(there[0])])
    return Crops(*parts)
