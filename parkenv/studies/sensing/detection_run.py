"""Detect cars in image files, videos and recorded drives, and draw them."""

import math
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple

import cv2

from parkenv.errors import InputError, require
from parkenv.files.atomic_write import atomic_write, make_folder
from parkenv.files.csv_tables import write_csv
from parkenv.files.file_names import distinct_names, file_name
from parkenv.files.images import SUFFIXES as IMAGE_SUFFIXES
from parkenv.files.images import files_in, images_in, read_image
from parkenv.files.recordings import SUFFIXES as RECORDING_SUFFIXES
from parkenv.files.recordings import Footage, footage_in, is_recording
from parkenv.files.videos import VIDEO_SUFFIXES, Video, film
from parkenv.perception.detector import Detections, Detector
from parkenv.show.figures.survey import draw_detections
from parkenv.studies.results import Row
from parkenv.studies.study import Progress, counted
from sim_sensors.ground_truth import View

Film = Video | Footage

# Columns of `boxes.csv`; frame (from 0) and time_s are empty for images, visible_fraction where the detector does not
# know it.
BOX_COLUMNS = (
    "file", "frame", "time_s", "left", "top", "right", "bottom", "probability", "view", "visible_fraction",
)  # fmt: skip


class FoundCars(NamedTuple):
    images: int  # their number
    videos: list[Row]  # of each video: file, frames, seconds, fps, boxes, most_cars
    boxes: list[Row]  # rows of `boxes.csv`
    not_searched: list[Row]  # topics of recordings with pictures that are not read: file, reason


def find_cars(
    paths: Sequence[Path],
    detector: Detector,
    threshold: float,
    step: int = 1,
    folder: Path | None = None,
    progress: Progress = lambda *_: None,
) -> FoundCars:
    """Find cars in files or folders of images, videos and recorded drives.

    Of a video every `step`-th frame is looked at. Pictures, films and boxes.csv go into a folder, if there is one.
    """
    chosen, not_searched = require_readable(paths)  # a damaged one is refused before any work
    files = [source if isinstance(source, Path) else source.file for source in chosen]
    suffixes = [".png" if isinstance(source, Path) else ".mp4" for source in chosen]
    drawings = [
        file_name(f"{name}_cars", suffix)
        for name, suffix in zip(distinct_names(files), suffixes, strict=True)
    ]
    if folder is not None:
        originals = {(source if isinstance(source, Path) else source.path).resolve() for source in chosen}
        for drawing in drawings:
            if (folder / drawing).resolve() in originals:
                kind = "a video" if drawing.endswith(".mp4") else "an image"
                raise InputError(f"--out {folder}: {drawing} would replace {kind} that is searched")
        make_folder(folder)
    counts = [1 if isinstance(s, Path) else s.frames and -(-s.frames // step) for s in chosen]
    total = 0 if None in counts else sum(count or 0 for count in counts)  # 0 where it is not known
    advance = counted(progress, "Detecting", total)
    boxes: list[Row] = []
    videos: list[Row] = []
    for source, drawing in zip(chosen, drawings, strict=True):
        drawn = None if folder is None else folder / drawing
        if isinstance(source, Path):
            boxes += detect_in_image(source, detector, threshold, drawn)
            advance()
        else:
            row, in_video = detect_in_video(source, detector, threshold, step, drawn, advance)
            videos.append(row)
            boxes += in_video
    if folder is not None:
        write_csv(folder / "boxes.csv", BOX_COLUMNS, boxes)
    return FoundCars(len(chosen) - len(videos), videos, boxes, not_searched)


def require_readable(paths: Sequence[Path]) -> tuple[list[Path | Film], list[Row]]:
    """Return the images, as their paths, and the videos that are named or in the named folders, in order.

    Each camera of a recording is a video; topics with pictures that are not read are returned, too.
    """
    files: list[Path] = []
    for path in paths:
        if path.is_dir() and not is_recording(path):
            files += files_in(path, IMAGE_SUFFIXES + VIDEO_SUFFIXES + RECORDING_SUFFIXES) or images_in(path)
        else:
            files.append(path)
    found: list[Path | Film] = []
    not_searched: list[Row] = []
    for file in dict.fromkeys(files):
        if is_recording(file):
            cameras, others = footage_in(file)
            found += cameras
            not_searched += [
                {"file": f"{file}:{topic}", "reason": reason} for topic, reason in others.items()
            ]
        elif file.suffix.lower() in VIDEO_SUFFIXES:
            found.append(Video.of(file))
        else:
            read_image(file)
            found.append(file)
    return found, not_searched


def detect_in_image(file: Path, detector: Detector, threshold: float, drawn: Path | None) -> list[Row]:
    """Return the cars of at least a probability in an image, as rows of `boxes.csv`, and draw them into a PNG file."""
    image = read_image(file)
    found = _likely(detector.detect(image), threshold)
    if drawn is not None:
        colored = image if image.ndim == 3 else cv2.cvtColor(image, cv2.COLOR_GRAY2RGB)
        picture = draw_detections(colored, found)
        with atomic_write(drawn) as beside:
            beside.write_bytes(cv2.imencode(".png", picture[..., ::-1])[1].tobytes())
    return _rows(str(file), found)


def detect_in_video(
    video: Film,
    detector: Detector,
    threshold: float,
    step: int = 1,
    drawn: Path | None = None,
    on_frame: Callable[[], None] = lambda: None,
) -> tuple[Row, list[Row]]:
    """Return the rows of a video and of the cars in every `step`-th frame, and draw them into a film of equal speed."""
    boxes: list[Row] = []
    frames = most = 0
    seconds = 0.0
    with ExitStack() as stack:
        append = None
        if drawn is not None:
            append = stack.enter_context(film(drawn, (video.width, video.height), video.fps / step))
        for frame in video.read(step):
            found = _likely(detector.detect(frame.image), threshold)
            boxes += _rows(video.name, found, frame.number, frame.time)
            frames, most, seconds = frames + 1, max(most, len(found)), frame.time
            if append is not None:
                append(draw_detections(frame.image, found))
            on_frame()
        require(frames, f"{video.name}: has no frame that can be read")
    row = {"file": video.name, "frames": frames, "seconds": round(seconds + 1.0 / video.fps, 3)}
    return row | {"fps": video.fps, "boxes": len(boxes), "most_cars": most}, boxes


def _likely(found: Detections, threshold: float) -> Detections:
    return found.select(found.probability >= threshold)


def _rows(file: str, found: Detections, frame: int | None = None, time: float | None = None) -> list[Row]:
    taken = None if time is None else round(time, 4)
    views = [View(view).name.lower() for view in found.view]
    visible = [None if math.isnan(v) else round(v, 4) for v in found.visible_fraction.tolist()]
    cars = zip(found.boxes.tolist(), found.probability.tolist(), views, visible, strict=True)
    return [dict(zip(BOX_COLUMNS, (file, frame, taken, *box, *of_car), strict=True)) for box, *of_car in cars]
