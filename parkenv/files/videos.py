"""Read videos frame by frame, and write films."""

import math
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Self

import cv2
import numpy as np

from parkenv.compiled.arrays import Image
from parkenv.errors import InputError
from parkenv.files.atomic_write import atomic_write
from parkenv.files.images import MAX_PIXELS
from parkenv.files.limited_reading import open_limited

VIDEO_SUFFIXES = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg")
# FFmpeg reads it when it is first used; else it would write of damaged files to standard error.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
USUAL_FPS = 25.0
_MOST_FPS = 1_000.0


class VideoFrame(NamedTuple):
    number: int  # from 0
    time: float  # s since the first frame's time 0, never earlier than the frame before
    image: Image  # (h, w, 3) uint8, RGB


@dataclass(frozen=True)
class Video:
    path: Path
    width: int  # px
    height: int
    fps: float  # frames per second, 25 where the file does not say
    frames: int | None  # number of frames as the file says; None where it does not

    @property
    def name(self) -> str:
        return str(self.path)

    @property
    def file(self) -> Path:
        return self.path

    @classmethod
    def of(cls, path: Path) -> Self:
        with _opened(path) as capture:
            there, first = capture.read()
            if not there or first is None:
                raise InputError(
                    f"{path}: is not a video with readable frames, want {', '.join(VIDEO_SUFFIXES)}"
                )
            fps, count = (capture.get(key) for key in (cv2.CAP_PROP_FPS, cv2.CAP_PROP_FRAME_COUNT))
            height, width = first.shape[:2]
            return cls(
                path,
                width,
                height,
                fps if math.isfinite(fps) and 0.0 < fps <= _MOST_FPS else USUAL_FPS,
                int(count) if math.isfinite(count) and 0 < count < 1e9 else None,
            )

    def read(self, step: int = 1) -> Iterator[VideoFrame]:
        """Yield every `step`-th frame, the first one included, up to the last that can be read."""
        with _opened(self.path) as capture:
            number, last = 0, 0.0
            while capture.grab():
                if number % step == 0:
                    there, frame = capture.retrieve()
                    if not there or frame is None or frame.shape[:2] != (self.height, self.width):
                        return
                    stated = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000.0
                    # Some files have no times.
                    known = math.isfinite(stated) and (stated > last or number == 0) and stated >= 0.0
                    last = max(last, stated if known else number / self.fps)
                    yield VideoFrame(number, last, np.asarray(cv2.cvtColor(frame, cv2.COLOR_BGR2RGB)))
                number += 1


@contextmanager
def film(path: Path, size: tuple[int, int], fps: float) -> Iterator[Callable[[Image], object]]:
    """Yield a function that appends a frame, (h, w, 3) uint8, RGB, to an `.mp4`; odd last rows and columns are cut."""
    even = size[0] // 2 * 2, size[1] // 2 * 2
    with atomic_write(path) as beside:
        unfinished = beside.with_name(f"{beside.name}.mp4")  # the encoder goes by the name
        writer = cv2.VideoWriter(str(unfinished), cv2.VideoWriter.fourcc(*"mp4v"), min(fps, 240.0), even)
        try:
            if not writer.isOpened():
                raise InputError(f"{path}: cannot be written as a film of {even[0]}×{even[1]} px")
            yield lambda image: writer.write(np.ascontiguousarray(image[: even[1], : even[0], ::-1]))
            writer.release()
            unfinished.replace(beside)
        finally:
            writer.release()
            with suppress(OSError):
                unfinished.unlink()


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    with open_limited(path):  # says why a file cannot be read
        pass
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    # A path that is absolute is no address of the network.
    capture = cv2.VideoCapture(str(path.absolute()), cv2.CAP_FFMPEG)
    try:
        width, height = (capture.get(key) for key in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        if width * height > MAX_PIXELS:
            raise InputError(
                f"{path}: has frames of {width:.0f}×{height:.0f} px, want {MAX_PIXELS:,} at most"
            )
        yield capture
    finally:
        capture.release()
        cv2.utils.logging.setLogLevel(level)
