"""Folders of drives that a calibration file describes: its topics are names of folders and files in them.

A topic is a folder of pictures, a folder of point clouds, or an .npz file of scans. The time of each is that of the
pose with the same number of the frame, or of a table `times.csv` in the topic's folder.
"""

from __future__ import annotations

from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from parkenv.errors import InputError, naming
from parkenv.files.csv_tables import NUMBER, TEXT, Kind, typed_records
from parkenv.files.images import SUFFIXES, files_in
from parkenv.files.limited_reading import read_arrays
from parkenv.files.recordings import CLOUD, COMPRESSED_IMAGE, SCAN, Messages
from parkenv.files.tracks import read_track, stamp_in
from parkenv.lots.local_frame import LocalFrame
from parkenv.mapping.drive_calibration import DriveCalibration
from parkenv.mapping.drive_sources import CLOUD_SUFFIXES, CloudFile, PictureFile, Stream, header, opened
from parkenv.mapping.photo_options import PhotoOptions
from parkenv.mapping.photographs import POSES, errors_of_poses, frame_of, pose_stream
from parkenv.perception.monocular import RangingErrors

_TIMES = "times.csv"
_RANGES = {"ranges": 1.0, "ranges_mm": 0.001}


def is_drive_folder(path: Path, calibration: DriveCalibration | None) -> bool:
    """Whether a calibration names what is in a folder."""
    return (
        calibration is not None
        and path.is_dir()
        and any(_there(path, topic) for topic in _topics(calibration))
    )


def _topics(calibration: DriveCalibration) -> list[str]:
    pairs = [topic for pair in calibration.stereo_cameras for topic in (pair.left, pair.right)]
    single = [one.topic for one in calibration.cameras] + [one.topic for one in calibration.lasers]
    return [topic for topic in (*single, *pairs) if topic]


def _there(path: Path, topic: str) -> Path | None:
    """Return the folder or file of a topic, within the folder."""
    name = topic.strip("/").partition(":")[0]
    for place in (path / name, path / f"{name}.npz"):
        if name and ".." not in Path(name).parts and place.exists():
            return place
    return None


class DriveFolder:
    """A folder of a drive; see the module. `frame` and `own_frame` are as in `Photographs`."""

    def __init__(
        self,
        path: Path,
        calibration: DriveCalibration,
        options: PhotoOptions,
        frame: LocalFrame | None = None,
        *,
        own_frame: bool = False,
    ) -> None:
        self.path, self.without_pose = path, 0
        self.calibration: DriveCalibration | None = calibration
        self._zone_s = 3600.0 * calibration.timezone_h
        self._topics, self._pose = _topics(calibration), calibration.pose
        poses = options.poses or _there(path, calibration.pose) or path / POSES
        if not poses.is_file():
            raise InputError(f"{path}: has no poses, want {POSES} in it, or --poses FILE (.csv, .gpx)")
        self._track = read_track(poses, self._zone_s)
        with naming(poses):
            self.frame = frame_of(self._track, options, frame, own_frame)
            self._poses = pose_stream(self._track, self.frame)
        self.errors: RangingErrors | None = errors_of_poses(self._track, options)
        self._streams = {topic: self._stream(topic) for topic in self._topics}

    def open(self) -> AbstractContextManager[tuple[dict[str, str], Messages]]:
        return opened(self._streams | {self._pose: self._poses})

    def _stream(self, topic: str) -> Stream:
        place = _there(self.path, topic)
        if place is None:
            there = ", ".join(sorted(file.name for file in self.path.iterdir())[:12])
            raise InputError(f"{self.path}: has no folder or file {topic!r}; it has {there}")
        if place.is_file():
            return SCAN, self._scans(place, topic.partition(":")[2])
        kind, make = COMPRESSED_IMAGE, PictureFile
        files = files_in(place, SUFFIXES)
        if not files:
            kind, make = CLOUD, CloudFile  # type: ignore[assignment]
            files = files_in(place, CLOUD_SUFFIXES)
        if not files:
            raise InputError(f"{place}: holds no pictures and no point clouds ({', '.join(CLOUD_SUFFIXES)})")
        stamps = self._stamps(place, [file.stem for file in files])
        found = [(stamp, file) for stamp, file in zip(stamps, files, strict=True) if stamp is not None]
        if not found:
            raise InputError(
                f"{place}: no name, such as {files[0].name}, has a time; want numbers of frames as in the column "
                f"`frame` of the poses, or a table {_TIMES} of `file` and `time`"
            )
        self.without_pose += (len(files) - len(found)) * (topic == self._topics[0])
        found.sort(key=lambda one: one[0])
        return kind, [(stamp, partial(make, file, header(stamp, topic))) for stamp, file in found]

    def _stamps(self, folder: Path, names: list[str]) -> list[int | None]:
        """Return the time of each name, ns, or None."""
        table = folder / _TIMES
        if table.is_file():
            time = Kind("a time", lambda text: stamp_in(text, self._zone_s))
            kinds = {"time": time, "unix_s": time, "frame": NUMBER}
            of: dict[str, int] = {}
            for _, row in typed_records(table, lambda name: kinds.get(name, TEXT)):
                stamp = row.get("unix_s", row.get("time"))
                name = Path(row["file"]).stem if "file" in row else str(int(row.get("frame", -1)))
                if stamp is None:
                    raise InputError(f"{table}: has {', '.join(row)}, want file or frame, and time or unix_s")
                of[name] = stamp
            return [of.get(name, of.get(_number(name))) for name in names]
        track = self._track
        keys = [str(frame) for frame in track.frames] or [Path(file).stem for file in track.files]
        at = dict(zip(keys, track.stamps.tolist(), strict=False))
        return [at.get(_number(name), at.get(name)) for name in names]

    def _scans(self, file: Path, key: str) -> list[tuple[int, Any]]:
        arrays = read_arrays(file)
        name = key or next((name for name in _RANGES if name in arrays), "")
        wanted = "frame, angle_min, angle_step and ranges (m), ranges_mm, or `topic = FILE:ARRAY`"
        angles = [arrays.get(n, np.empty(0)) for n in ("angle_min", "angle_step")]
        usable = all(a.size == 1 and np.issubdtype(a.dtype, np.number) for a in angles)
        if name not in arrays or "frame" not in arrays or not usable:
            raise InputError(f"{file}: has {', '.join(sorted(arrays))}, want {wanted}")
        ranges, frames = arrays[name], arrays["frame"]
        if ranges.ndim != 2 or len(ranges) != frames.size or not np.issubdtype(ranges.dtype, np.number):
            raise InputError(f"{file}: {name} has the shape {ranges.shape}, want {frames.size} rows")
        scale = 0.001 if np.issubdtype(ranges.dtype, np.integer) else _RANGES.get(name, 1.0)
        metres = (ranges * scale).astype(np.float32)
        start, step = (float(a.item()) for a in angles)
        most = float(np.where(np.isfinite(metres), metres, 0.0).max(initial=0.0)) + 0.01
        stamps = self._stamps(file, [str(frame) for frame in frames.ravel().tolist()])

        def scan(row: int, stamp: int) -> Any:
            return SimpleNamespace(
                header=header(stamp, file.name), ranges=metres[row], angle_min=start, angle_increment=step,
                range_min=0.0, range_max=most,
            )  # fmt: skip

        return [(stamp, partial(scan, row, stamp)) for row, stamp in enumerate(stamps) if stamp is not None]


def _number(name: str) -> str:
    return str(int(name)) if name.isdecimal() else name
