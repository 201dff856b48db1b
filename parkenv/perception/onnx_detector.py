"""Detectors from ONNX files: networks that find objects in a single image, run by OpenCV."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from parkenv.compiled.arrays import Float32Array, Image
from parkenv.errors import InputError
from parkenv.files.onnx_file import OnnxFile, OnnxValue, read_onnx
from parkenv.files.spec_file import Several, Spec
from parkenv.perception.car_regions import END, END_WIDEST, SIDE
from parkenv.perception.detector import LEAST_PROBABILITY, Detections
from parkenv.perception.hog_detector import as_grey, best_boxes
from parkenv.perception.onnx_outputs import (
    LAYOUTS,
    Layout,
    Scores,
    class_columns,
    decode,
    decode_centers,
    guess_layout,
    mirrored_centers,
)
from parkenv.perception.onnx_trial import require_runs

SIDECARS = (".toml", ".json")
CAR_NAMES = ("car", "cars", "van", "truck", "bus", "pickup", "suv", "vehicle", "automobile", "motor vehicle")
"""Names of classes that count as cars where the file names its classes: whatever takes a slot."""
_COCO = {1: (0,), 80: (2, 5, 7), 91: (3, 6, 8), 92: (3, 6, 8)}
"""Cars (car, bus, truck) by the number of class scores: a single class, COCO's 80, and DETR's numbering of them."""
_NAME = re.compile(r"(\d{1,6})['\"]?\s*:\s*['\"]([^'\"]{1,80})['\"]", re.ASCII)
_IMGSZ = re.compile(r"\[\s*(\d{1,5})\s*,\s*(\d{1,5})\s*\]", re.ASCII)

Pixels = Annotated[int, Field(ge=16, le=4096)]
Level = Annotated[float, Field(ge=-1_000.0, le=1_000.0)]
Scale = Annotated[float, Field(gt=0.0, le=1_000.0)]


class OnnxSettings(Spec):
    """Input and output format of a network: the file `NAME.toml` (or `.json`) beside `NAME.onnx`.

    All keys are optional: missing ones follow from the network's shapes and metadata where these are unambiguous;
    otherwise an error names the key to set.
    """

    layout: Layout | None = Field(
        None,
        description="Output of the network. yolo: (1, 4 + classes, n), box and class scores (YOLOv8 and "
        "later, RT-DETR of ultralytics); yolo5: (1, n, 5 + classes), with an objectness (YOLOv5, "
        "v7, decoded YOLOX); boxes: (1, n, 6), corners, score and class, after non-maximum "
        "suppression (YOLOv10, YOLO26, end to end); detr: scores (1, n, classes) and boxes (1, n, "
        "4) as two outputs; centers: (1, 9, rows, columns), for each cell P(car), the box's sides "
        "from its centre in px, P(end), P(oblique), P(side) of the view, visible fraction.",
    )
    outputs: Several[str] | None = Field(
        None, max_length=2, description="Names of the outputs to read; for detr, the scores first."
    )
    size: Annotated[tuple[Pixels, Pixels], Field(strict=False)] | None = Field(
        None, description="Width and height of the input, px, if the file does not fix them."
    )
    resize: Literal["letterbox", "stretch"] | None = Field(
        None,
        description="letterbox: as large as fits, centred on grey borders; stretch, the default of detr.",
    )
    enlarge: float = Field(
        1_000.0, gt=0.0, le=1_000.0, description="Largest magnification of a small image in a letterbox."
    )
    mirror: bool = Field(
        False,
        description="Whether to average the outputs for an image and its mirror image, if the image is "
        "smaller than the input even at the largest magnification; for centers only.",
    )
    pad: int = Field(114, ge=0, le=255, description="Grey level of the borders of a letterbox.")
    channels: Literal["rgb", "bgr", "grey"] | None = Field(
        None, description="rgb by default, grey for an input of one channel."
    )
    mean: Several[Level] | None = Field(
        None,
        min_length=1,
        max_length=3,
        description="Subtracted from each channel, 0 to 255; 0 by default, ImageNet's for detr.",
    )
    std: Several[Scale] | None = Field(
        None,
        min_length=1,
        max_length=3,
        description="Each channel is divided by it; 255 by default, ImageNet's for detr.",
    )
    box: Literal["center", "corners"] | None = Field(
        None,
        description="center: x, y, width, height; corners: left, top, right, bottom, the default of boxes.",
    )
    unit: Literal["pixels", "fractions"] | None = Field(
        None, description="Of the input; fractions is the default of detr."
    )
    scores: Scores | None = Field(
        None,
        description="probabilities by default; for detr, softmax (the last class is none) with 92 or 2 "
        "scores, else logits, each an independent probability.",
    )
    cars: Several[Annotated[int, Field(ge=0, le=100_000)]] | None = Field(
        None,
        min_length=1,
        max_length=1_000,
        description="Classes that are cars, from 0. By default by the names in the file (car, van, truck, bus, ...), "
        "or COCO's where it has 80 classes.",
    )
    threshold: float = Field(
        LEAST_PROBABILITY,
        gt=0.0,
        lt=1.0,
        description="Smallest score of a box. The pipeline also uses weak boxes.",
    )
    overlap: float | None = Field(
        None,
        gt=0.0,
        le=1.0,
        description="Intersection over union from which only the better of two boxes is kept; 0.5 by default, 1 for "
        "boxes.",
    )
    end_on_below: float = Field(
        1.8,
        ge=0.0,
        le=100.0,
        description="Width over height below which a box shows a car's front or rear, not its side.",
    )


class _Plan(OnnxSettings):
    """Settings of a network, none left open but the cars of a layout without classes."""

    layout: Layout
    outputs: tuple[str, ...]
    size: tuple[int, int]
    resize: Literal["letterbox", "stretch"]
    channels: Literal["rgb", "bgr", "grey"]
    mean: tuple[float, ...]
    std: tuple[float, ...]
    box: Literal["center", "corners"]
    unit: Literal["pixels", "fractions"]
    scores: Scores
    overlap: float
    grid: bool  # of yolo, whether a candidate is a column


class OnnxDetector:
    """A `Detector` that runs a network of the YOLO or DETR kind, single-threaded, by OpenCV's `dnn`.

    A grey image is given to a network for colours as three equal channels. The network sees one empty image when the
    detector is made, first in a process of its own, so a file that does not fit is refused then.

    Args:
        file: the network.
        settings: how it is fed and read; None: guessed.
        is_known: whether the file is known to be whole: it is not tried in a process of its own.

    Raises:
        InputError: OpenCV cannot run the network, or settings are missing or do not fit it.
    """

    def __init__(
        self, file: OnnxFile, settings: OnnxSettings | None = None, *, is_known: bool = False
    ) -> None:
        self._file = file
        self.settings = settings or OnnxSettings()
        self._net: Any = None
        self._plan = _planned(file, self.settings, self._run, is_known=is_known)

    @classmethod
    def load(
        cls, path: str | Path, threshold: float | None = None, *, is_known: bool = False
    ) -> OnnxDetector:
        """Read a network, and the settings beside it (`sidecar_of`).

        Args:
            path: the file, `.onnx`.
            threshold: replaces that of the settings.
            is_known: see the class.

        Raises:
            InputError: a file cannot be read, or see the class.
        """
        file, beside = read_onnx(path), sidecar_of(path)
        settings = OnnxSettings() if beside is None else OnnxSettings.read(beside)
        settings = settings if threshold is None else settings.changed(threshold=threshold)
        return cls(file, settings, is_known=is_known)

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_net": None}  # read again where it is needed

    def detect(self, image: Image) -> Detections:
        """Find the cars in an image, best first; see `Detector`.

        Raises:
            InputError: an image of another shape or dtype, or the network's numbers are no boxes and scores.
        """
        plan, name = self._plan, self._file.name
        fed, scale, offset = _fed(image, plan)
        outputs = self._run(fed, plan.outputs)
        centers = None
        if plan.layout == "centers":
            if plan.mirror and min(offset) > 0.0:
                mirrored = self._run(np.ascontiguousarray(fed[..., ::-1]), plan.outputs)
                outputs = [0.5 * (outputs[0] + mirrored_centers(mirrored[0]))]
            centers = decode_centers(outputs[0], plan.size, self.settings.threshold)
            boxes, score = centers.boxes, centers.score
        else:
            boxes, score = decode(outputs, plan.layout, plan.cars or (), plan.scores, grid=plan.grid)
        if not (np.isfinite(boxes).all() and np.isfinite(score).all()):
            raise InputError(f"{name}: put out numbers that are not finite, want boxes and scores")
        if len(score) and not (score.min() >= -1e-4 and score.max() <= 1.0 + 1e-4):
            raise InputError(
                f"{name}: has scores from {score.min():.4g} to {score.max():.4g}, want 0 to 1; for others write "
                f'scores = "logits" in {_beside(name)}'
            )
        rows = np.flatnonzero(score >= self.settings.threshold)
        boxes, score = boxes[rows].astype(np.float64), np.clip(score[rows], 0.0, 1.0)
        if plan.box == "center":
            half = 0.5 * boxes[:, 2:]
            boxes = np.hstack([boxes[:, :2] - half, boxes[:, :2] + half])
        if plan.unit == "fractions":
            boxes = boxes * np.tile(plan.size, 2)
        boxes = ((boxes - np.tile(offset, 2)) / np.tile(scale, 2)).astype(np.float32)
        size = boxes[:, 2:] - boxes[:, :2]
        drawn = np.isfinite(boxes).all(axis=1) & (size > 0.0).all(axis=1)
        boxes, score, size = boxes[drawn], score[drawn], size[drawn]
        kept = best_boxes(boxes, score, plan.overlap)
        boxes, score, size = boxes[kept], score[kept], size[kept]
        if centers is None:
            return Detections(boxes, score, size[:, 0] < self.settings.end_on_below * size[:, 1])
        rows = rows[drawn][kept]
        end_on, visible = centers.end_on[rows], np.clip(centers.visible[rows], 0.0, 1.0)
        regions = _regions(boxes, end_on)
        return Detections(
            boxes, score, end_on, regions=regions, view=centers.view[rows], visible_fraction=visible
        )

    def _run(self, fed: Float32Array, outputs: Sequence[str]) -> list[Float32Array]:
        """Return the named outputs for an input, (1, channels, height, width)."""
        threads, level = cv2.getNumThreads(), cv2.utils.logging.getLogLevel()
        cv2.setNumThreads(1)
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
        try:
            if self._net is None:
                self._net = cv2.dnn.readNetFromONNX(np.frombuffer(self._file.data, np.uint8))
            self._net.setInput(fed)
            return [np.array(o, dtype=np.float32) for o in self._net.forward(list(outputs))]
        except cv2.error as error:
            reason = " ".join(str(error).split())
            raise InputError(
                f"{self._file.name}: OpenCV cannot run this network with an input of shape {fed.shape}: {reason:.300}"
            ) from error
        finally:
            cv2.setNumThreads(threads)
            cv2.utils.logging.setLogLevel(level)


def sidecar_of(path: str | Path) -> Path | None:
    """Return the settings' file beside a network: of the same name, `.toml` or `.json`; None if there is none.

    Raises:
        InputError: there are both.
    """
    found = [file for suffix in SIDECARS if (file := Path(path).with_suffix(suffix)).is_file()]
    if len(found) > 1:
        raise InputError(f"{path}: has two files of settings, {found[0].name} and {found[1].name}, want one")
    return found[0] if found else None


def _planned(file: OnnxFile, settings: OnnxSettings, run: Any, *, is_known: bool) -> _Plan:
    """Complete the settings of a network from its shapes and metadata, and from what it makes of an empty image."""
    beside, s = _beside(file.name), settings
    value, count = _image_input(file)
    size = _input_size(file, value, s)
    channels = s.channels or ("rgb" if count == 3 else "grey")
    if (channels == "grey") != (count == 1):
        raise InputError(
            f"{beside}: channels is {channels!r}, want {'grey' if count == 1 else 'rgb or bgr'}: the input of "
            f"{Path(file.name).name} has {count}"
        )
    known = {output.name: output for output in file.outputs}
    names = tuple(known)
    for name in s.outputs or ():
        if name not in known:
            raise InputError(
                f"{beside}: outputs has {name!r}, which the network lacks; it has {', '.join(names)}"
            )
    names = s.outputs or names
    empty = np.full((1, count, size[1], size[0]), 0.5, np.float32)
    if not is_known:
        require_runs(file.data, file.name, empty.shape)
    made = dict(zip(names, run(empty, names), strict=True))
    shapes = [o.shape for o in made.values()]
    layout = s.layout or guess_layout(shapes, size)
    described = ", ".join(f"{name} {shape}" for name, shape in zip(names, shapes, strict=True))
    if layout is None:
        several = " and outputs" if len(names) > 1 else ""
        raise InputError(
            f"{file.name}: puts out {described}, of which the layout cannot be told; write "
            f'layout = "yolo", "yolo5", "boxes", "detr" or "centers"{several} in {beside}'
        )
    if layout == "detr" and len(shapes) == 2 and not s.outputs and shapes[0][-1:] == (4,):
        names, shapes = names[::-1], shapes[::-1]
    named = _class_names(file)
    grid = layout == "yolo" and len(shapes[0]) == 3 and _is_grid(shapes[0], len(named))
    try:
        classes = class_columns(layout, shapes, grid)
    except InputError as error:
        raise InputError(f"{file.name}: layout {layout!r} does not fit {described}: {error}") from error
    rule = LAYOUTS[layout]
    # Means and deviations of colours say nothing of other channels.
    usual = rule if channels == "rgb" else LAYOUTS["yolo"]
    scores: Scores = "probabilities"
    if layout == "detr":
        scores = "softmax" if classes in (2, 92) else "logits"
    means = {name: getattr(s, name) or getattr(usual, name) for name in ("mean", "std")}
    for name, values in means.items():
        if len(values) not in (1, count):
            raise InputError(
                f"{beside}: {name} has {len(values)} numbers, want 1 or {count}, one per channel"
            )
    chosen = {name: getattr(s, name) or getattr(rule, name) for name in ("resize", "box", "unit", "overlap")}
    cars = None if layout == "centers" else _cars(file, s, classes, named, beside)
    found = {
        "layout": layout,
        "outputs": names,
        "size": size,
        "channels": channels,
        "grid": grid,
        "cars": cars,
    }
    return _Plan(**dict(s) | {"scores": s.scores or scores} | means | chosen | found)


def _image_input(file: OnnxFile) -> tuple[OnnxValue, int]:
    """Return the network's only input, and its number of channels."""
    shapes = ", ".join(f"{v.name} {_shown(v.shape)}" for v in file.inputs)
    if len(file.inputs) == 1:
        (value,) = file.inputs
        if value.is_float and len(value.shape) == 4 and value.shape[0] in (1, None):
            channels = 3 if value.shape[1] is None else value.shape[1]
            if channels in (1, 3):
                return value, channels
    kind = "" if all(v.is_float for v in file.inputs) else " not of float32"
    raise InputError(
        f"{file.name}: has the input {shapes or 'none'}{kind}, want one image (1, 3 or 1, height, width) of float32"
    )


def _input_size(file: OnnxFile, value: OnnxValue, settings: OnnxSettings) -> tuple[int, int]:
    """Return width and height of the input."""
    beside = _beside(file.name)
    _, _, height, width = value.shape
    noted = _IMGSZ.fullmatch(file.metadata.get("imgsz", "").strip()) if settings.size is None else None
    wanted = settings.size or ((int(noted[2]), int(noted[1])) if noted else (width, height))
    if wanted[0] is None or wanted[1] is None:
        raise InputError(
            f"{file.name}: its input {value.name} {_shown(value.shape)} is of any size; write "
            f"size = [640, 640] (width, height) in {beside}"
        )
    if not all(16 <= n <= 4096 for n in wanted if n is not None):
        raise InputError(f"{file.name}: its input is {wanted[0]}×{wanted[1]} px, want 16 to 4096")
    if (width or wanted[0], height or wanted[1]) != wanted:
        raise InputError(
            f"{beside}: size is {list(wanted)}, want {[width or wanted[0], height or wanted[1]]}, the input's width "
            "and height"
        )
    return wanted[0], wanted[1]


def _cars(
    file: OnnxFile, settings: OnnxSettings, classes: int | None, named: dict[int, str], beside: str
) -> tuple[int, ...]:
    """Return the classes that are cars."""
    if settings.cars is not None:
        if classes is not None and max(settings.cars) >= classes:
            raise InputError(
                f"{beside}: cars has {max(settings.cars)}, want classes of the network, 0 to {classes - 1}"
            )
        return settings.cars
    cars = tuple(i for i, name in named.items() if name.lower() in CAR_NAMES)
    if not named and classes in _COCO:
        cars = _COCO[classes]
    if not cars or (classes is not None and max(cars) >= classes):
        listed = ", ".join(f"{i} {name}" for i, name in list(named.items())[:8])
        fault = f"of its classes ({listed}) none is known as a car" if named else "does not name its classes"
        raise InputError(f"{file.name}: {fault}; write cars = [indices from 0] in {beside}")
    return cars


def _class_names(file: OnnxFile) -> dict[int, str]:
    """Return the names of the classes as exports of ultralytics have them, `{0: 'person', 2: 'car'}`."""
    return {int(i): name for i, name in _NAME.findall(file.metadata.get("names", "")[:100_000])}


def _is_grid(shape: tuple[int, ...], names: int) -> bool:
    """Whether a candidate is a column of the output: by the number of classes, or because candidates are many."""
    _, rows, columns = shape
    by_name = [rows == 4 + names, columns == 4 + names]
    return by_name[0] if by_name[0] != by_name[1] else rows <= columns


def _fed(image: Image, plan: _Plan) -> tuple[Float32Array, tuple[float, float], tuple[float, float]]:
    """Return the network's input, and scale and offset of the image in it, px."""
    grey = as_grey(image)  # checks the image
    if plan.channels == "grey":
        image = grey[..., None]
    elif image.ndim == 2:
        image = np.repeat(grey[..., None], 3, axis=2)
    elif plan.channels == "bgr":
        image = image[..., ::-1]
    (width, height), (rows, columns) = plan.size, grey.shape
    fit = (width, height)
    left = top = 0
    if plan.resize == "letterbox":
        ratio = min(width / columns, height / rows, plan.enlarge)
        fit = max(1, round(columns * ratio)), max(1, round(rows * ratio))
        left, top = (width - fit[0]) // 2, (height - fit[1]) // 2
    resized = np.ascontiguousarray(image)
    if fit != (columns, rows):
        resized = np.asarray(cv2.resize(resized, fit, interpolation=cv2.INTER_LINEAR))
    canvas = np.full((height, width, 1 if plan.channels == "grey" else 3), plan.pad, np.uint8)
    canvas[top : top + fit[1], left : left + fit[0]] = resized.reshape(fit[1], fit[0], -1)
    mean, std = (np.array(values, np.float32)[:, None, None] for values in (plan.mean, plan.std))
    fed = (canvas.transpose(2, 0, 1)[None].astype(np.float32) - mean) / std
    return np.ascontiguousarray(fed), (fit[0] / columns, fit[1] / rows), (float(left), float(top))


def _regions(boxes: Float32Array, end_on: NDArray[np.bool_]) -> Float32Array:
    """Return the windows around cars that labelled crops have, as those of the HOG models."""
    size = boxes[:, 2:] - boxes[:, :2]
    square = end_on & (size[:, 0] <= END_WIDEST * size[:, 1])
    cars = zip(boxes.astype(np.float64), square, strict=True)
    regions = [(END if end else SIDE).region(box) for box, end in cars]
    return np.array(regions, dtype=np.float32).reshape(-1, 4)


def _beside(name: str) -> str:
    """Return the name of the settings' file, for messages."""
    return str(sidecar_of(name) or Path(name).with_suffix(".toml"))


def _shown(shape: tuple[int | None, ...]) -> str:
    return f"({', '.join('any' if n is None else str(n) for n in shape)})"
