"""What reads recorded drives: `RecordedDrive` makes captures of the messages of any source."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from parkenv.errors import InputError
from parkenv.files.limited_reading import read_arrays, read_bytes, read_text
from parkenv.files.recordings import Messages, open_recording
from parkenv.lots.local_frame import LocalFrame
from parkenv.mapping.drive_calibration import DriveCalibration
from parkenv.perception.monocular import RangingErrors


class Source(Protocol):
    """Messages of a drive, like those of ROS: a new format is a class of these, in `drive_formats`."""

    @property
    def calibration(self) -> DriveCalibration | None:
        """Sensors and topics, where the source knows better than the file that was given."""

    @property
    def errors(self) -> RangingErrors | None:
        """Errors of its poses; None for the usual ones."""

    @property
    def frame(self) -> LocalFrame | None:
        """Where x = y = 0 of its poses is, if they were made of degrees."""

    @property
    def without_pose(self) -> int:
        """Number of pictures that it leaves out, as no pose is of their time."""

    def open(self) -> AbstractContextManager[tuple[dict[str, str], Messages]]:
        """Return the type of each topic, and what reads messages of some in order: topic, ns of Unix time, message."""


@dataclass(frozen=True)
class Bag:
    """An MCAP file or a rosbag."""

    path: Path
    calibration: DriveCalibration | None = None
    errors: RangingErrors | None = None
    frame: LocalFrame | None = None
    without_pose: int = 0

    def open(self) -> AbstractContextManager[tuple[dict[str, str], Messages]]:
        return open_recording(self.path)


Timed = list[tuple[int, Callable[[], Any]]]  # times of messages, ns, each with what makes it
Stream = tuple[str, Timed]  # the type of a topic's messages, and they
CLOUD_SUFFIXES = (".npz", ".bin", ".txt")


@contextmanager
def opened(streams: Mapping[str, Stream]) -> Iterator[tuple[dict[str, str], Messages]]:
    """Open streams as a recording: their messages are made when they are read, in the order of their times."""

    def messages(topics: set[str]) -> Iterator[tuple[str, int, Any]]:
        chosen = [
            (stamp, topic, make)
            for topic in sorted(topics & streams.keys())
            for stamp, make in streams[topic][1]
        ]
        for stamp, topic, make in sorted(chosen, key=lambda one: one[0]):
            yield topic, stamp, make()

    yield {topic: kind for topic, (kind, _) in streams.items()}, messages


def header(stamp: int, frame: str) -> Any:
    sec, nanosec = divmod(stamp, 10**9)
    return SimpleNamespace(stamp=SimpleNamespace(sec=sec, nanosec=nanosec), frame_id=frame)


@dataclass(frozen=True)
class PictureFile:
    path: Path
    header: Any
    format: str = "file"

    @property
    def data(self) -> bytes:
        return read_bytes(self.path)


@dataclass(frozen=True)
class CloudFile:
    """A point cloud in a file: arrays `xyz` (m) or `xyz_cm` (.npz), or KITTI's four numbers a point (.bin, .txt)."""

    path: Path
    header: Any

    @property
    def xyz(self) -> NDArray[np.float32]:
        try:
            if self.path.suffix == ".npz":
                arrays = read_arrays(self.path)
                scale = 0.01 if "xyz_cm" in arrays else 1.0
                points = np.asarray(
                    arrays["xyz_cm" if "xyz_cm" in arrays else "xyz"] * np.float32(scale), np.float32
                )
            elif self.path.suffix == ".bin":
                points = np.frombuffer(read_bytes(self.path), "<f4").reshape(-1, 4)
            else:
                points = np.array(read_text(self.path).split(), dtype=np.float32).reshape(-1, 4)
            if points.ndim != 2 or points.shape[1] not in (3, 4):
                raise ValueError(f"it has the shape {points.shape}")
        except (KeyError, ValueError, TypeError) as error:
            if isinstance(error, InputError):
                raise
            wanted = "xyz or xyz_cm, (n, 3), in .npz, or four float32 a point in .bin"
            raise InputError(f"{self.path}: is no point cloud ({error}), want {wanted}") from error
        return points[:, :3]
