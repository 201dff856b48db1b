"""Detectors from ONNX files: networks that find objects in a single image, run by OpenCV."""

from __future__ import annotations

import hashlib
import math
import re
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from parkenv.compiled.arrays import Float32Array, Image
from parkenv.errors import InputError, nearest
from parkenv.files.limited_reading import read_bytes
from parkenv.files.spec_file import Several, Spec
from parkenv.perception.detector import LEAST_PROBABILITY, Detections
from parkenv.perception.hog_detector import END, END_BELOW, END_WIDEST, SIDE, as_grey, best_boxes

MAX_ONNX_BYTES = 256_000_000  # maximum size of an ONNX file
# Maximum time and address space of the process that tries an unknown network; Windows knows no such limit.
LONGEST_S, MOST_BYTES = 120, 8 << 30
_INPUT_PATTERN = r"<Input> CV_32F\w* \[(\d+ x \d+ x \d+ x \d+)\]"
_TRIAL = f"""
try:
    import resource
    resource.setrlimit(resource.RLIMIT_AS, ({MOST_BYTES}, {MOST_BYTES}))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
except (ImportError, OSError, ValueError):
    pass
import sys
import cv2, numpy
shape = [int(word) for word in sys.argv[1:]]
cv2.setNumThreads(1)
net = cv2.dnn.readNetFromONNX(numpy.frombuffer(sys.stdin.buffer.read(), numpy.uint8))
if not shape[2]:
    import re
    fixed = re.search(r"{_INPUT_PATTERN}", net.dump())
    shape[2:] = [int(word) for word in fixed[1].split(" x ")][2:] if fixed else [640, 640]
    print(*shape[2:])
net.setInput(numpy.full(shape, 0.5, numpy.float32))
net.forward(list(net.getUnconnectedOutLayersNames()))
"""
_passed: dict[tuple[str, tuple[int, ...]], tuple[int, int]] = {}
_COCO = {1: (0,), 80: (2, 5, 7)}  # cars by the number of classes: the only one, or COCO's car, bus and truck
_NEAR_LOOK = 0.6  # size of a second look at what is near
_BORDER = 114  # grey level around an image in the input
_CENTER_NUMBERS = 9
# px, of an input that follows the image: a side is a multiple of the one, at most the other
_STEP, _LONGEST = 32, 4096
# A tensor whose numbers are in another file has an entry with the key `location`, its field 1, a text of 8 bytes; a
# protobuf may write either number with more bytes than it needs.
_ELSEWHERE = re.compile(rb"(?:\x0a|\x8a\x80*\x00)(?:\x08|\x88\x80*\x00)location")
_INPUT = re.compile(_INPUT_PATTERN)


class _QuietThread:
    """OpenCV kept to the calling thread, and from writing; its settings return when the last of several calls ends."""

    def __init__(self) -> None:
        self._lock, self._calls, self._before = threading.Lock(), 0, (0, 0)

    def __enter__(self) -> None:
        with self._lock:
            self._calls += 1
            if self._calls == 1:
                self._before = cv2.getNumThreads(), cv2.utils.logging.getLogLevel()
                cv2.setNumThreads(1)
                cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._calls -= 1
            if not self._calls:
                cv2.setNumThreads(self._before[0])
                cv2.utils.logging.setLogLevel(self._before[1])


_quiet_thread = _QuietThread()

Pixels = Annotated[int, Field(ge=16, le=4096)]


class OnnxSettings(Spec):
    """How a network is fed and read: the file `NAME.toml` beside `NAME.onnx`; all keys are optional."""

    layout: Literal["yolo", "centers"] | None = Field(
        None, description="How the output is read. By default as its shape says."
    )
    outputs: Several[str] | None = Field(
        None,
        min_length=1,
        max_length=100,
        description="Names of outputs: the first that fits the layout is read. By default the only one that fits.",
    )
    size: Annotated[tuple[Pixels, Pixels], Field(strict=False)] | None = Field(
        None,
        description="Width and height of the input, px. By default the file's, or 640×640 if it leaves them open.",
    )
    channels: Literal["rgb", "bgr", "grey"] = Field("rgb", description="Channels of the input.")
    mean: float = Field(0.0, ge=-1_000.0, le=1_000.0, description="Subtracted from each channel, 0 to 255.")
    std: float = Field(255.0, gt=0.0, le=1_000.0, description="Each channel is divided by it.")
    enlarge: float = Field(
        1_000.0, gt=0.0, le=1_000.0, description="Largest magnification of a small image in the input."
    )
    follow: bool = Field(
        False,
        description="Whether the input has each image's proportions instead, at the number of pixels of size and in "
        "multiples of 32 px; for the layout centers only.",
    )
    near_from: int | None = Field(
        None,
        ge=1,
        le=4096,
        description="Image and input are looked at again at 0.6 of the size, for boxes that are at least as many px "
        "high there: cars so near that they fill the picture. For the layout centers only; by default they are not.",
    )
    mirror: bool = Field(
        False,
        description="Whether to average the outputs for an image and its mirror image, if the image is smaller than "
        "the input even at the largest magnification; for the layout centers only.",
    )
    cars: Several[Annotated[int, Field(ge=0, le=100_000)]] | None = Field(
        None,
        min_length=1,
        max_length=1_000,
        description="Classes of the layout yolo that are cars, from 0. By default the only one, or COCO's car, bus and "
        "truck where there are 80.",
    )
    threshold: float = Field(
        LEAST_PROBABILITY,
        gt=0.0,
        lt=1.0,
        description="Smallest score of a box. The pipeline also uses weak boxes.",
    )
    overlap: float = Field(
        0.5,
        gt=0.0,
        le=1.0,
        description="Intersection over union from which only the better of two boxes is kept.",
    )


class Candidates(NamedTuple):
    """Boxes with scores that a network puts out, n in all."""

    boxes: NDArray[Any]  # (n, 4) px of the input: left, top, right, bottom
    score: Float32Array  # (n,) P(car)
    end_on: NDArray[np.bool_] | None = None  # (n,) whether a front or rear is more likely than a side
    view: NDArray[np.int8] | None = None  # (n,) the most likely `sim_sensors.ground_truth.View`
    visible: Float32Array | None = None  # (n,) visible fraction

    def select(self, rows: NDArray[Any]) -> Candidates:
        return Candidates(*(None if values is None else values[rows] for values in self))  # type: ignore[arg-type]

    def joined(self, others: Candidates) -> Candidates:
        pairs = zip(self, others, strict=True)
        return Candidates(*(None if a is None or b is None else np.concatenate([a, b]) for a, b in pairs))  # type: ignore[arg-type]


class OnnxDetector:
    """A `Detector` that runs a network, single-threaded, by OpenCV's `dnn`.

    The image is put into the input as large as fits, centred on grey borders; with the setting `follow` the input is
    made for the image. One output of the network has either layout (in the layout yolo, rows of mask coefficients of a
    second output are no classes):

    - *yolo*, (1, 4 + classes, n): centre, width and height of a box in px of the input, and a score of each class, 0 to
      1, as exports of YOLOv8 and later have it;
    - *centers*, (1, 9, rows, columns): of each cell P(car), the distances from its centre to the box's left, upper,
      right and lower side in px, P(end), P(oblique) and P(side) of the view, and the visible fraction.

    Others are wrapped in a class of one's own, see `examples/ground_detector.py`. The network sees one empty image when
    the detector is made, first in a process of its own, so a file that does not fit is refused then.

    Args:
        data: the content of the file.
        name: the file, for messages.
        settings: how it is fed and read.
        is_known: whether the file is known to be whole: it is not tried in a process of its own.
    """

    concurrent = True

    def __init__(
        self, data: bytes, name: str, settings: OnnxSettings | None = None, *, is_known: bool = False
    ) -> None:
        self.settings = settings or OnnxSettings()
        self._data, self._name = data, name
        self._of_thread = threading.local()  # OpenCV's network keeps the numbers of its last run
        if _ELSEWHERE.search(data):
            raise InputError(f"{name}: keeps its weights in other files; export it as a single file")
        width, height = self.settings.size or (0, 0)
        channels = 1 if self.settings.channels == "grey" else 3
        if not is_known:
            height, width = require_runs(data, name, (1, channels, height, width))
        self._size = width or 640, height or 640
        empty = np.full((1, channels, *self._size[::-1]), 0.5, np.float32)
        self._output, shape, masks = self._choose(
            {key: one.shape for key, one in self._run_all(empty).items()}
        )
        # OpenCV runs a network with an input of another shape, and tells of its own in a description alone.
        fixed = _INPUT.search(self._of_thread.net.dump())
        if fixed and fixed[1] != " x ".join(map(str, empty.shape)):
            raise InputError(
                f"{name}: its input is {fixed[1]}, and size and channels in {sidecar_of(name)} (or their defaults) are "
                f"for {' x '.join(map(str, empty.shape))}"
            )
        self._is_centers = self._fits("centers", shape)
        if not self._is_centers:
            self._cars = self._classes_of_cars(shape, masks)

    @classmethod
    def load(
        cls, path: str | Path, threshold: float | None = None, *, is_known: bool = False
    ) -> OnnxDetector:
        """Read a network, and the settings beside it (`sidecar_of`), of which `threshold` replaces one."""
        data, beside = read_bytes(path, MAX_ONNX_BYTES), sidecar_of(path)
        settings = OnnxSettings.read(beside) if beside.is_file() else OnnxSettings()
        settings = settings if threshold is None else settings.changed(threshold=threshold)
        return cls(data, str(path), settings, is_known=is_known)

    def __getstate__(self) -> dict[str, Any]:
        return {key: value for key, value in self.__dict__.items() if key != "_of_thread"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state, _of_thread=threading.local())

    def detect(self, image: Image) -> Detections:
        decoded = self._look(image)
        if self._is_centers and self.settings.near_from:
            decoded = decoded.joined(self._look(image, _NEAR_LOOK))
        size = decoded.boxes[:, 2:] - decoded.boxes[:, :2]
        decoded = decoded.select(np.isfinite(decoded.boxes).all(axis=1) & (size > 0.0).all(axis=1))
        decoded = decoded.select(best_boxes(decoded.boxes, decoded.score, self.settings.overlap))
        boxes = decoded.boxes
        if decoded.end_on is None or decoded.visible is None:
            width, height = (boxes[:, 2:] - boxes[:, :2]).T
            return Detections(boxes, decoded.score, width < END_BELOW * height)
        return Detections(
            boxes, decoded.score, decoded.end_on, regions=_regions(boxes, decoded.end_on), view=decoded.view,
            visible_fraction=np.clip(decoded.visible, 0.0, 1.0),
        )  # fmt: skip

    def _look(self, image: Image, size: float = 1.0) -> Candidates:
        """Return the boxes, in px of the image, that the network finds at the usual size or a fraction of it."""
        fed, scale, offset, is_small = _fed(image, self.settings, self._size, self._is_centers, size)
        output = self._run(fed)
        if self._is_centers:
            if self.settings.mirror and is_small:
                # What the network puts out for the mirrored input, left and right exchanged.
                mirrored = self._run(np.ascontiguousarray(fed[..., ::-1]))
                output = 0.5 * (output + mirrored[:, [0, 3, 2, 1, *range(4, _CENTER_NUMBERS)], :, ::-1])
            found = decode_centers(output, (fed.shape[3], fed.shape[2]), self.settings.threshold)
        else:
            found = decode_yolo(output, self._cars)
        if not (np.isfinite(found.boxes).all() and np.isfinite(found.score).all()):
            raise InputError(f"{self._name}: put out numbers that are not finite, want boxes and scores")
        if len(found.score) and not (found.score.min() >= -1e-4 and found.score.max() <= 1.0 + 1e-4):
            raise InputError(
                f"{self._name}: has scores from {found.score.min():.4g} to {found.score.max():.4g}, want 0 to 1"
            )
        least = 0 if size == 1.0 else self.settings.near_from or 0
        height = found.boxes[:, 3] - found.boxes[:, 1]
        found = found.select((found.score >= self.settings.threshold) & (height >= least))
        boxes = (found.boxes.astype(np.float64) - np.tile(offset, 2)) / np.tile(scale, 2)
        return found._replace(boxes=boxes.astype(np.float32), score=np.clip(found.score, 0.0, 1.0))

    def _run(self, fed: Float32Array) -> Float32Array:
        return self._run_all(fed)[self._output]

    def _run_all(self, fed: Float32Array) -> dict[str, Float32Array]:
        own = self._of_thread
        try:
            with _quiet_thread:
                if not hasattr(own, "net"):
                    own.net = cv2.dnn.readNetFromONNX(np.frombuffer(self._data, np.uint8))
                names = list(own.net.getUnconnectedOutLayersNames())
                own.net.setInput(fed)
                # OpenCV 5 computes all outputs or none.
                outputs = [np.array(output, dtype=np.float32) for output in own.net.forward(names)]
        except cv2.error as error:
            reason = " ".join(str(error).split())
            raise InputError(
                f"{self._name}: OpenCV cannot run this network with an input of shape {fed.shape}: {reason:.300}"
            ) from error
        return dict(zip(names, outputs, strict=True))

    def _fits(self, layout: str, shape: Sequence[int]) -> bool:
        if self.settings.layout not in (None, layout):
            return False
        if layout == "centers":
            return len(shape) == 4 and tuple(shape[:2]) == (1, _CENTER_NUMBERS)
        # There are more candidates than numbers of one; others have a candidate in each row.
        likely = self.settings.layout is not None or shape[1] <= shape[2] if len(shape) == 3 else False
        return likely and shape[0] == 1 and shape[1] > 4

    def _choose(self, shapes: Mapping[str, Sequence[int]]) -> tuple[str, Sequence[int], int]:
        """Return the name and shape of the output to read, and the number of mask coefficients in it."""
        there = ", ".join(f"{name} {tuple(shape)}" for name, shape in shapes.items())
        for name in self.settings.outputs or ():
            if name not in shapes:
                raise InputError(
                    f"{sidecar_of(self._name)}: outputs has {name!r:.80}; {nearest(name, shapes)}"
                )
        named = list(dict.fromkeys(self.settings.outputs or shapes))
        fitting = [name for name in named if any(self._fits(k, shapes[name]) for k in ("yolo", "centers"))]
        if not fitting:
            wanted = {"yolo": "(1, 4 + classes, n)", "centers": "(1, 9, rows, columns)"}
            layouts = [wanted[self.settings.layout]] if self.settings.layout else wanted.values()
            raise InputError(
                f"{self._name}: puts out {there}, want {' or '.join(layouts)}; wrap it in a class of your own"
            )
        if len(fitting) > 1 and not self.settings.outputs:
            raise InputError(
                f"{self._name}: puts out {there}; write outputs = [{fitting[0]!r}], or another one, in "
                f"{sidecar_of(self._name)}"
            )
        name = fitting[0]
        masks = [int(shape[1]) for other, shape in shapes.items() if other != name and len(shape) == 4]
        return name, shapes[name], masks[0] if len(masks) == 1 and shapes[name][1] > 4 + masks[0] else 0

    def _classes_of_cars(self, shape: Sequence[int], masks: int) -> tuple[int, ...]:
        classes, beside = shape[1] - 4 - masks, sidecar_of(self._name)
        cars = self.settings.cars or _COCO.get(classes)
        if cars is None:
            raise InputError(
                f"{self._name}: has {classes} classes; write cars = [indices from 0] in {beside}"
            )
        if max(cars) >= classes:
            raise InputError(
                f"{beside}: cars has {max(cars)}, want classes of the network, 0 to {classes - 1}"
            )
        return cars


def require_runs(data: bytes, name: str, shape: tuple[int, ...]) -> tuple[int, int]:
    """Check in another process, once for each network, that OpenCV runs it: it does not survive every damaged file.

    Returns the rows and columns of its input: those of `shape`, or where they are 0 the file's.
    """
    key = hashlib.sha256(data).hexdigest(), shape
    if key in _passed:
        return _passed[key]
    # -I: the process finds installed packages, and nothing in the working folder.
    command = [sys.executable, "-I", "-c", _TRIAL, *map(str, shape)]
    try:
        done = subprocess.run(command, input=data, capture_output=True, timeout=LONGEST_S, check=False)
    except subprocess.TimeoutExpired as error:
        raise InputError(f"{name}: takes more than {LONGEST_S} s for an image of shape {shape}") from error
    if done.returncode:
        lines = done.stderr.decode(errors="replace").strip().splitlines()
        # An exception ends with 1, a crash with a signal.
        reason = lines[-1] if lines and done.returncode == 1 else "it crashes; is the file whole?"
        raise InputError(
            f"{name}: OpenCV cannot run this network with an input of shape {shape}: {reason:.300}"
        )
    rows, columns = map(int, done.stdout.split()[-2:]) if not shape[2] else shape[2:]
    _passed[key] = rows, columns
    return _passed[key]


def sidecar_of(path: str | Path) -> Path:
    return Path(path).with_suffix(".toml")


def decode_yolo(output: Float32Array, cars: Sequence[int]) -> Candidates:
    """Return all candidates of an output, (1, 4 + classes, n); P(car) is the greatest score of the given classes."""
    rows = output[0].T
    centre, half = rows[:, :2].astype(np.float64), 0.5 * rows[:, 2:4].astype(np.float64)
    return Candidates(np.hstack([centre - half, centre + half]), rows[:, 4:][:, list(cars)].max(axis=1))


def decode_centers(output: Float32Array, size: tuple[int, int], threshold: float) -> Candidates:
    """Return the cells that score higher than their neighbours, in an output of the layout `centers`.

    The width and height of the input are in px.
    """
    cells = output[0]
    # Above the cells before it and not below those after it: of equal neighbours one is left.
    before = np.ones((3, 3), np.uint8)
    before[1, 1:] = before[2] = 0
    after = np.ascontiguousarray(before[::-1, ::-1])
    score = np.ascontiguousarray(cells[0])
    top = (score > _highest(score, before)) & (score >= _highest(score, after))
    row, column = np.nonzero(top & (score >= threshold))
    left, above, right, below, end, oblique, side, visible = cells[1:, row, column]
    x = (column + np.float32(0.5)) * np.float32(size[0] / score.shape[1])
    y = (row + np.float32(0.5)) * np.float32(size[1] / score.shape[0])
    boxes = np.stack([x - left, y - above, x + right, y + below], axis=1).astype(np.float32)
    view = np.argmax([end, oblique, side], axis=0).astype(np.int8)
    return Candidates(boxes, score[row, column], end > side, view, visible)


def _highest(score: Float32Array, neighbours: NDArray[np.uint8]) -> Float32Array:
    highest = cv2.dilate(score, neighbours, borderType=cv2.BORDER_CONSTANT, borderValue=-1.0)
    return np.asarray(highest, dtype=np.float32)


def _fed(
    image: Image, settings: OnnxSettings, size: tuple[int, int], is_centers: bool, part: float
) -> tuple[Float32Array, tuple[float, float], tuple[float, float], bool]:
    """Return the input, the image's scale and place in it, and whether it is smaller even as large as it may be.

    With a `part` below 1 all is smaller by it.
    """
    grey = as_grey(image)  # checks the image
    if settings.channels == "grey":
        image = grey[..., None]
    elif image.ndim == 2:
        image = np.repeat(grey[..., None], 3, axis=2)
    elif settings.channels == "bgr":
        image = image[..., ::-1]
    (width, height), (rows, columns) = size, grey.shape
    largest = min(width / columns, height / rows)
    follows = is_centers and (settings.follow or part < 1.0)
    if settings.follow and is_centers:
        largest = min(math.sqrt(width * height / (columns * rows)), _LONGEST / max(columns, rows))
    ratio = part * min(largest, settings.enlarge)
    fit = max(1, round(columns * ratio)), max(1, round(rows * ratio))
    if follows:
        width, height = (_STEP * math.ceil(n / _STEP) for n in fit)
    left, top = (width - fit[0]) // 2, (height - fit[1]) // 2
    resized = np.ascontiguousarray(image)
    if fit != (columns, rows):
        resized = np.asarray(cv2.resize(resized, fit, interpolation=cv2.INTER_LINEAR))
    canvas = np.full((height, width, image.shape[2]), _BORDER, np.uint8)
    canvas[top : top + fit[1], left : left + fit[0]] = resized.reshape(fit[1], fit[0], -1)
    fed = (canvas.transpose(2, 0, 1)[None].astype(np.float32) - np.float32(settings.mean)) / np.float32(
        settings.std
    )
    scale, offset = (fit[0] / columns, fit[1] / rows), (float(left), float(top))
    return np.ascontiguousarray(fed), scale, offset, settings.enlarge < largest


def _regions(boxes: Float32Array, end_on: NDArray[np.bool_]) -> Float32Array:
    size = boxes[:, 2:] - boxes[:, :2]
    cars = zip(boxes.astype(np.float64), end_on & (size[:, 0] <= END_WIDEST * size[:, 1]), strict=True)
    regions = [(END if end else SIDE).region(box) for box, end in cars]
    return np.array(regions, dtype=np.float32).reshape(-1, 4)
