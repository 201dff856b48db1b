"""Photographs or a film, and poses, as a recording: `RecordedDrive` reads them as it reads the messages of one."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from parkenv.compiled.arrays import IntArray
from parkenv.errors import InputError, naming
from parkenv.files.images import image_time, images_in, read_image
from parkenv.files.recordings import IMAGE, POSE_2D, Messages
from parkenv.files.tracks import Track, read_track, stamp_in
from parkenv.files.videos import VIDEO_SUFFIXES, Video
from parkenv.lots.local_frame import LocalFrame
from parkenv.mapping.drive_calibration import CameraSpec, DriveCalibration, MountSpec
from parkenv.mapping.drive_sources import PictureFile, Stream
from parkenv.mapping.photo_options import PhotoOptions
from parkenv.perception.monocular import RangingErrors
from sim_sensors.camera.models import PinholeCamera

POSES = "poses.csv"  # the poses beside the pictures, if no others are named
_GNSS_M, _TRACK_YAW = 3.0, math.radians(3.0)


def is_photographs(path: Path) -> bool:
    """Whether a path is named like a film, or is a folder that is no rosbag."""
    return path.suffix.lower() in VIDEO_SUFFIXES or (path.is_dir() and not (path / "metadata.yaml").is_file())


class Photographs:
    """A folder of photographs or a film, with poses.

    `calibration` is of one camera, None for `options.fov`, `frame` that of a lot whose file has degrees, `errors` those
    of the poses. The table of poses does not name `without_pose` of the photographs. Of poses in degrees, `frame` is
    where the origin is; with `own_frame`, their middle if nothing else says where.
    """

    def __init__(
        self,
        path: Path,
        options: PhotoOptions,
        calibration: DriveCalibration | None = None,
        frame: LocalFrame | None = None,
        *,
        own_frame: bool = False,
    ) -> None:
        self.path, self._options = path, options
        self._film = None if path.is_dir() else Video.of(path)
        self._files = images_in(path) if path.is_dir() else []
        if calibration is None:
            calibration = DriveCalibration(cameras=(self._usual_camera(),))
        if len(calibration.cameras) != 1 or calibration.stereo_cameras or calibration.lasers:
            raise InputError(f"{calibration._file or path}: want one camera, which took the pictures")
        self.calibration: DriveCalibration | None = calibration
        self._pose, self._picture = calibration.pose, calibration.cameras[0].topic
        self._zone_s = 3600.0 * calibration.timezone_h
        poses = options.poses or (path if path.is_dir() else path.parent) / POSES
        if options.poses is None and not poses.is_file():
            raise InputError(
                f"{path}: has no poses, want --poses FILE (.csv, .gpx), or {POSES} beside the pictures"
            )
        self.track = read_track(poses, self._zone_s)
        with naming(poses):
            self.frame = frame_of(self.track, options, frame, own_frame)
            self._poses = pose_stream(self.track, self.frame)
        self.errors: RangingErrors | None = errors_of_poses(self.track, options)
        pictures = len(self._files)
        self._stamps = self._times() if self._film is None else None
        self.without_pose = pictures - len(self._files)

    @contextmanager
    def open(self) -> Iterator[tuple[dict[str, str], Messages]]:
        pose, picture = self._pose, self._picture

        def messages(topics: set[str]) -> Iterator[tuple[str, int, Any]]:
            if pose in topics:
                for stamp, make in self._poses[1]:
                    yield pose, stamp, make()
            if picture in topics:
                for stamp, message in self._pictures():
                    yield picture, stamp, message

        yield {pose: POSE_2D, picture: IMAGE}, messages

    def _pictures(self) -> Iterator[tuple[int, Any]]:
        if self._stamps is not None:
            for k in np.argsort(self._stamps, kind="stable").tolist():
                yield int(self._stamps[k]), PictureFile(self._files[k], None)
            return
        begin, fps = int(self.track.stamps[0]), self._options.fps
        for frame in self._film.read() if self._film is not None else ():
            late = (frame.time if fps is None else frame.number / fps) + self._options.clock_offset
            h, w = frame.image.shape[:2]
            image = SimpleNamespace(encoding="rgb8", height=h, width=w, step=3 * w, data=frame.image)
            yield begin + round(late * 1e9), image

    def _times(self) -> IntArray:
        """Return the stamps of the photographs; those that the table of poses does not name are left out."""
        late = self._options.clock_offset
        if self.track.files:
            stamp_of = dict(zip(self.track.files, self.track.stamps.tolist(), strict=True))
            if len(stamp_of) < len(self.track.files):
                raise InputError(f"{self.path}: a picture has two poses, want one")
            names = {file: file.relative_to(self.path).as_posix() for file in self._files}
            self._files = [file for file in self._files if names[file] in stamp_of]
            if len(self._files) < len(stamp_of):
                lost = sorted(stamp_of.keys() - names.values())[0]
                raise InputError(f"{self.path}: has no picture {lost!r:.80}, of which there is a pose")
            return np.array([stamp_of[names[file]] for file in self._files], np.int64)
        if self._options.fps is not None:
            each = np.arange(len(self._files)) / self._options.fps + late
            return np.asarray(self.track.stamps[0] + np.round(each * 1e9).astype(np.int64))
        taken = []
        for file in self._files:
            try:
                taken.append(stamp_in(image_time(file) or "", self._zone_s) + round(late * 1e9))
            except ValueError as error:
                raise InputError(
                    f"{file}: has no Exif time, want one, --fps, or a column `file` in the poses"
                ) from error
        return np.array(taken, np.int64)

    def _usual_camera(self) -> CameraSpec:
        if self._options.fov is None:
            raise InputError(f"{self.path}: nothing says what the camera is; want --calibration or --fov")
        if self._film is None:
            height, width = read_image(self._files[0]).shape[:2]
        else:
            height, width = self._film.height, self._film.width
        camera = PinholeCamera.from_field_of_view(width, height, math.radians(self._options.fov))
        numbers = {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
        mount = dict(zip(("z", "yaw", "pitch"), self._options.mount, strict=True))
        parsed = MountSpec.parse(mount, dict.fromkeys(mount, "--mount"))
        return CameraSpec(name="camera", mount=parsed, **numbers)


def frame_of(
    track: Track, options: PhotoOptions, frame: LocalFrame | None, own_frame: bool
) -> LocalFrame | None:
    """Return the frame of a track in degrees: `--origin`, that of the lot, or its own around its middle."""
    if not track.in_degrees:
        return None
    if options.origin is not None:
        lat, lon = options.origin
        return LocalFrame(lon, lat)
    if frame is None and not own_frame:
        raise InputError("is in degrees, and the lot in metres; want --origin LAT,LON of its x = y = 0")
    return frame or LocalFrame.around(track.positions)


def pose_stream(track: Track, frame: LocalFrame | None) -> Stream:
    """Return the poses of a track as messages; pictures at one without a heading are left out."""
    xy = track.positions if frame is None else frame.to_xy(track.positions)
    poses = np.column_stack([xy, track.headings(xy)]).tolist()
    return POSE_2D, [
        (stamp, partial(SimpleNamespace, x=x, y=y, theta=yaw))
        for stamp, (x, y, yaw) in zip(track.stamps.tolist(), poses, strict=True)
        if not math.isnan(yaw)
    ]


def errors_of_poses(track: Track, options: PhotoOptions) -> RangingErrors:
    usual = _GNSS_M if track.in_degrees else 0.0
    return RangingErrors.of_poses(
        usual if options.pose_error is None else options.pose_error,
        _TRACK_YAW if np.isnan(track.yaw).any() else 0.0,
    )
