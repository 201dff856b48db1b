"""Photographs with labelled boxes, in the formats of COCO and YOLO, and crops of their cars for training."""

import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Strict

from parkenv.compiled.arrays import Image
from parkenv.errors import InputError, nearest
from parkenv.files.images import SUFFIXES, files_in, images_in, read_image
from parkenv.files.limited_reading import is_there, read_json, read_text, read_yaml
from parkenv.files.spec_file import Several, Spec
from parkenv.perception.car_datasets import Crops, LabelledImage
from parkenv.perception.hog_detector import END, END_BELOW, SIDE, as_grey
from parkenv.perception.training import cut_out

Box = tuple[float, float, float, float]

# Names of classes that count as cars: whatever takes a slot.
CAR_NAMES = ("car", "cars", "van", "truck", "bus", "pickup", "suv", "vehicle", "automobile", "motor vehicle")
LEAST_WIDTH = 36  # least width of a car that is trained on, px
LEAST_CARS = 20
_WINDOWS = 3  # windows without cars from each picture
_TOLERANCE = 2.0  # px that a box may reach outside its picture, by rounding
_NO_LABELS = re.compile(r"classes|names|readme.*|requirements|train|val|test|license.*", re.IGNORECASE)


def _below(name: str) -> str:
    if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts:
        raise ValueError("a file below the folder of the pictures")
    return name


class _Category(Spec, extra="ignore"):
    id: int | str
    name: str = ""


class _Picture(Spec, extra="ignore"):
    id: int | str
    file_name: Annotated[str, AfterValidator(_below)]


class _Label(Spec, extra="ignore"):
    image_id: int | str
    category_id: int | str
    bbox: Annotated[Box, Strict(False)]  # px: left, top, width, height
    iscrowd: int = 0


class _Coco(Spec, extra="ignore"):
    images: Several[_Picture]
    annotations: Several[_Label]
    categories: Several[_Category]


@dataclass(frozen=True, eq=False)
class LabelledPhoto:
    labelled: LabelledImage  # the grey picture, with the boxes of all cars
    single: NDArray[np.bool_]  # (n,) bool, whether a box is one car, not a crowd of them


def read_labels(path: Path, images: Path | None = None, classes: Sequence[str] = ()) -> list[LabelledPhoto]:
    """Read labelled photographs: a COCO file (`.json`), or a folder in YOLO's format.

    Of YOLO, pictures are at any depth; labels are in text files of the same names, in `labels/` in place of `images/`,
    or beside the pictures. A picture without one shows nothing. A line has the class and a box (centre, width, height)
    or a polygon, as fractions of the picture. The names of the classes are in `data.yaml` (`names`) or `classes.txt`.

    `images` is COCO's folder of the pictures, by default that of the file; `classes` are cars, by default `CAR_NAMES`.
    """
    if path.is_dir() and images is not None:
        raise InputError(
            f"{path}: is a folder in YOLO's format, which has its pictures; --images is for COCO"
        )
    photos = _read_yolo(path, classes) if path.is_dir() else _read_coco(path, images or path.parent, classes)
    if not any(len(photo.single) for photo in photos):
        raise InputError(f"{path}: none of its {len(photos)} pictures has a label of a car")
    return photos


def _read_coco(path: Path, images: Path, classes: Sequence[str]) -> list[LabelledPhoto]:
    content = read_json(path, finite=True)
    coco = _Coco.parse(content if isinstance(content, dict) else {}, str(path))
    names = {category.id: category.name for category in coco.categories}
    cars, known = _cars(names, classes, path), {picture.id for picture in coco.images}
    boxes: dict[Any, list[tuple[str, Box, bool]]] = defaultdict(list)
    for i, label in enumerate(coco.annotations):
        where = f"{path}: annotations.{i}"
        if label.category_id not in names:
            raise InputError(
                f"{where}.category_id is {label.category_id!r}, want one of {_listed(map(str, names))}"
            )
        if label.image_id not in known:
            raise InputError(f"{where}.image_id is {label.image_id!r}, which no entry of images has")
        if label.category_id in cars:
            left, top, width, height = label.bbox
            boxes[label.image_id].append((where, (left, top, left + width, top + height), not label.iscrowd))
    return [
        _photo(images / picture.file_name, boxes[picture.id], f"{path}: images.{i}")
        for i, picture in enumerate(coco.images)
    ]


def _read_yolo(folder: Path, classes: Sequence[str]) -> list[LabelledPhoto]:
    names = _yolo_names(folder)
    cars = _cars(names, classes, folder)
    pictures = {_label_of(file): file for file in images_in(folder)}
    for label in files_in(folder, (".txt",)):
        if label not in pictures and not _NO_LABELS.fullmatch(label.stem):
            raise InputError(f"{label}: labels a picture that is missing; want one of {', '.join(SUFFIXES)}")
    photos = []
    for label, file in pictures.items():
        lines = _yolo_lines(label, names) if label.is_file() else ()
        boxes = [(where, box, True) for where, class_id, box in lines if class_id in cars]
        photos.append(_photo(file, boxes, str(file), fractions=True))
    return photos


def crops_of(
    photos: Sequence[LabelledPhoto], *, end_on: bool, seed: int = 0
) -> tuple[Crops, list[LabelledImage]]:
    """Cut cars and windows without cars out of labelled photographs.

    Cars seen from the side are boxes at least `END_BELOW` times as wide as high, fronts and rears are narrower ones;
    those of the other kind, cut off by the picture's border, or less than `LEAST_WIDTH` px wide are left out. Crops are
    aligned as those of the packaged models; false positives are mined from all pictures, which are returned, too.
    """
    car = END if end_on else SIDE
    rng = np.random.default_rng(seed)
    positives: list[Image] = []
    negatives: list[Image] = []
    for photo in photos:
        image, boxes = photo.labelled.image, photo.labelled.boxes
        height, width = image.shape
        for box in boxes[photo.single]:
            size = box[2:] - box[:2]
            inside = (box[:2] > 1.0).all() and box[2] < width - 1.0 and box[3] < height - 1.0
            if inside and size[0] >= LEAST_WIDTH and (size[0] < END_BELOW * size[1]) == end_on:
                region = car.region(box)
                shape = (max(round(region[2] - region[0]), 8), max(round(region[3] - region[1]), 8))
                positives.append(cut_out(image, region.tolist(), shape))
        for _ in range(_WINDOWS):
            window = rng.uniform(0.15, 0.6) * min(height, width / car.aspect)
            window_size = np.array([car.aspect * window, window])
            at = rng.uniform(0.0, 1.0, 2) * (np.array([width, height]) - window_size)
            low, high = boxes[:, :2] - at, boxes[:, 2:] - at
            if window >= 16.0 and not ((low < window_size) & (high > 0.0)).all(axis=1).any():
                place = [*at, *(at + window_size)]
                negatives.append(cut_out(image, place, (round(window_size[0]), round(window))))
    if len(positives) < LEAST_CARS or not negatives:
        seen = "from the front or rear" if end_on else "from the side"
        raise InputError(
            f"the labels have {len(positives)} whole cars seen {seen} of at least {LEAST_WIDTH} px, and "
            f"{len(negatives)} windows without cars; want at least {LEAST_CARS} and 1"
        )
    return Crops(positives, negatives), [photo.labelled for photo in photos]


def _photo(
    file: Path, boxes: Sequence[tuple[str, Box, bool]], where: str, *, fractions: bool = False
) -> LabelledPhoto:
    if not (is_there(file) and file.is_file()):
        raise InputError(f"{where}: there is no picture at {file}")
    image = as_grey(read_image(file))
    height, width = image.shape
    corners = np.array([box for _, box, _ in boxes], dtype=np.float64).reshape(-1, 4)
    if fractions:
        corners *= [width, height, width, height]
    for (label, *_), (left, top, right, bottom) in zip(boxes, corners.tolist(), strict=True):
        inside = (
            min(left, top) >= -_TOLERANCE and right <= width + _TOLERANCE and bottom <= height + _TOLERANCE
        )
        if not (inside and left < right and top < bottom):
            raise InputError(
                f"{label}: box {left:.6g}, {top:.6g} to {right:.6g}, {bottom:.6g} is not inside {file.name} of "
                f"{width}×{height} px"
            )
    corners = np.clip(corners, 0.0, [width, height, width, height])
    single = np.array([alone for *_, alone in boxes], dtype=np.bool_)
    return LabelledPhoto(LabelledImage(file.name, image, corners), single)


def _cars(names: dict[Any, str], classes: Sequence[str], source: Path) -> set[Any]:
    for wanted in classes:
        if wanted not in names.values():
            raise InputError(f"{source}: has no class {wanted!r}; {nearest(wanted, names.values())}")
    cars = {k for k, name in names.items() if (name in classes if classes else name.lower() in CAR_NAMES)}
    if not cars:
        raise InputError(
            f"{source}: of its classes ({_listed(names.values())}) none is known as a car; name some by --classes"
        )
    return cars


def _listed(names: Iterable[str]) -> str:
    return ", ".join(names)[:300]


def _yolo_names(folder: Path) -> dict[Any, str]:
    data, plain = folder / "data.yaml", folder / "classes.txt"
    if plain.is_file() and not data.is_file():
        return dict(enumerate(line.strip() for line in read_text(plain).splitlines() if line.strip()))
    if not data.is_file():
        raise InputError(f"{folder}: has neither data.yaml with names nor classes.txt, want YOLO's format")
    content = read_yaml(data)
    names = content.get("names") if isinstance(content, dict) else None
    listed = dict(enumerate(names)) if isinstance(names, list) else names
    if not (isinstance(listed, dict) and all(isinstance(name, str) for name in listed.values())):
        raise InputError(f"{data}: names is {names!r:.60}, want a list of the classes' names")
    return listed


def _label_of(picture: Path) -> Path:
    beside = picture.with_suffix(".txt")
    parts = list(beside.parts)
    if "images" in parts and not beside.is_file():
        parts[len(parts) - 1 - parts[::-1].index("images")] = "labels"
    return Path(*parts)


def _yolo_lines(label: Path, names: dict[Any, str]) -> Iterator[tuple[str, int, Box]]:
    """Yield where a line stands, its class, and the box, or that around its polygon, as fractions."""
    for number, line in enumerate(read_text(label).splitlines(), start=1):
        words = line.split()
        if not words:
            continue
        where = f"{label}: line {number}"
        try:
            class_id, values = int(words[0]), np.array([float(word) for word in words[1:]])
        except ValueError:
            class_id, values = -1, np.zeros(0)
        if len(values) not in (4, *range(6, 20_000, 2)) or not np.isfinite(values).all():
            raise InputError(f"{where}: {line!r:.60}, want class, x, y, width and height as fractions")
        if class_id not in names:
            known = _listed(f"{k} {v}" for k, v in names.items())
            raise InputError(f"{where}: class is {words[0]}, want one of {known}")
        points = values.reshape(-1, 2)
        if len(points) == 2:
            middle, half = points[0], 0.5 * points[1]
            points = np.stack([middle - half, middle + half])
        (left, top), (right, bottom) = points.min(axis=0).tolist(), points.max(axis=0).tolist()
        yield where, class_id, (left, top, right, bottom)
