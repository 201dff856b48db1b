"""What reads recorded drives: `RecordedDrive` makes captures of the messages of any source."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from functools import partial
from heapq import merge
from itertools import repeat
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray
from parkenv.errors import InputError
from parkenv.files.images import SUFFIXES, files_in
from parkenv.files.limited_reading import read_arrays, read_bytes, read_text
from parkenv.files.recordings import CLOUD, COMPRESSED_IMAGE, Messages
from parkenv.lots.local_frame import LocalFrame
from parkenv.mapping.recordings.calibration import DriveCalibration
from parkenv.mapping.recordings.lenses import Info
from parkenv.mapping.recordings.poses import FrameTree
from parkenv.perception.monocular import RangingErrors

CLOUD_SUFFIXES = (".npz", ".bin", ".txt")


@dataclass(frozen=True, eq=False)
class Source:
    """Messages of a drive, like those of ROS, and what is known beside them.

    A new format is a function that returns one, in `drive_folders.source_of`. `open` returns the type of each topic,
    and what reads messages of some in order: topic, ns of Unix time, message. Messages without header are of the frame
    that is called like their topic.
    """

    open: Callable[[], AbstractContextManager[tuple[dict[str, str], Messages]]]
    calibration: DriveCalibration | None = None  # sensors and topics, where it knows better than a file
    poses: tuple[list[int], FloatArray] | None = None  # ns, and (n, 5) as of `PoseReader`; None: in messages
    frame: LocalFrame | None = None  # where x = y = 0 of its poses is, if they were made of degrees
    errors: RangingErrors | None = None  # of its poses; None for the usual ones
    without_pose: int = 0  # pictures that it leaves out, as no pose is of their time
    tree: FrameTree = field(default_factory=FrameTree)
    infos: Mapping[str, Info] = field(default_factory=dict)  # lenses by topic


class Stream(NamedTuple):
    kind: str  # the type of the messages
    messages: Iterable[tuple[int, Callable[[], Any]]]  # times, ns, rising, each with what makes the message
    left_out: int = 0  # files without a time


@contextmanager
def opened(streams: Mapping[str, Stream]) -> Iterator[tuple[dict[str, str], Messages]]:
    """Open streams as a recording: their messages are made when they are read, in the order of their times."""

    def messages(topics: set[str]) -> Iterator[tuple[str, int, Any]]:
        chosen = (zip(repeat(topic), streams[topic].messages) for topic in sorted(topics & streams.keys()))
        for topic, (stamp, make) in merge(*chosen, key=lambda one: one[1][0]):
            yield topic, stamp, make()

    yield {topic: stream.kind for topic, stream in streams.items()}, messages


def stream_of(folder: Path, stamps: Mapping[str, int]) -> Stream:
    """Return the pictures or point clouds in a folder, with the times, ns, of their numbers or names."""
    for kind, make, suffixes in (
        (COMPRESSED_IMAGE, PictureFile, SUFFIXES),
        (CLOUD, CloudFile, CLOUD_SUFFIXES),
    ):
        if files := files_in(folder, suffixes):
            at = {file: stamps.get(number_of(file.stem), stamps.get(file.stem)) for file in files}
            timed = {stamp: partial(make, file) for file, stamp in at.items() if stamp is not None}
            if not timed:
                raise InputError(
                    f"{folder}: no name, such as {files[0].name}, has a time; want numbers of frames as in the column "
                    "`frame` of the poses, or a table times.csv of `file` and `time`"
                )
            return Stream(kind, [(stamp, timed[stamp]) for stamp in sorted(timed)], len(files) - len(timed))
    raise InputError(f"{folder}: holds no pictures and no point clouds ({', '.join(CLOUD_SUFFIXES)})")


def number_of(name: str) -> str:
    return str(int(name)) if name.isdecimal() else name


@dataclass(frozen=True)
class PictureFile:
    path: Path
    format: str = "file"

    @property
    def data(self) -> bytes:
        return read_bytes(self.path)


@dataclass(frozen=True)
class CloudFile:
    """A point cloud in a file: arrays `xyz` (m) or `xyz_cm` (.npz), or KITTI's four numbers a point (.bin, .txt)."""

    path: Path

    @property
    def xyz(self) -> NDArray[np.float32]:
        file = self.path
        try:
            if file.suffix == ".npz":
                arrays = read_arrays(file)
                name, scale = ("xyz_cm", 0.01) if "xyz_cm" in arrays else ("xyz", 1.0)
                points = np.asarray(arrays[name] * np.float32(scale), np.float32)
            else:
                numbers = (
                    np.frombuffer(read_bytes(file), "<f4")
                    if file.suffix == ".bin"
                    else read_text(file).split()
                )
                points = np.array(numbers, np.float32).reshape(-1, 4)
            if points.ndim != 2 or points.shape[1] not in (3, 4):
                raise ValueError(f"it has the shape {points.shape}")
        except (KeyError, ValueError, TypeError) as error:
            if isinstance(error, InputError):
                raise
            wanted = "xyz or xyz_cm, (n, 3), in .npz, or four float32 a point in .bin"
            raise InputError(f"{file}: is no point cloud ({error}), want {wanted}") from error
        return points[:, :3]
