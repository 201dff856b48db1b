"""Folders of drives, photographs and films, with a table or a track of their poses, as sources of messages."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from parkenv.errors import InputError, naming
from parkenv.files.csv_tables import NUMBER, TEXT, Kind, typed_records
from parkenv.files.images import image_time, images_in, read_image
from parkenv.files.limited_reading import read_arrays
from parkenv.files.recordings import COMPRESSED_IMAGE, IMAGE, SCAN, open_recording
from parkenv.files.tracks import Track, read_track, stamp_in
from parkenv.files.videos import VIDEO_SUFFIXES, Video
from parkenv.lots.local_frame import LocalFrame
from parkenv.mapping.recordings.calibration import CameraSpec, DriveCalibration, MountSpec
from parkenv.mapping.recordings.kitti import kitti_folder
from parkenv.mapping.recordings.photo_options import PhotoOptions
from parkenv.mapping.recordings.sources import PictureFile, Source, Stream, number_of, opened, stream_of
from parkenv.perception.monocular import RangingErrors
from sim_sensors.camera.models import PinholeCamera

_POSES = "poses.csv"  # the poses beside the pictures, if no others are named
_GNSS_M, _TRACK_YAW = 3.0, math.radians(3.0)
_RANGES = {"ranges": 1.0, "ranges_mm": 0.001}


def source_of(
    path: Path, calibration: DriveCalibration | None, options: PhotoOptions, frame: LocalFrame | None
) -> Source:
    """Return what reads a drive: of KITTI, of a folder that the calibration describes, of photographs, or a bag.

    `frame` is where poses in degrees are; None for one around them.
    """
    kitti = kitti_folder(path, frame)
    topics = _topics(calibration) if calibration else []
    if kitti is None and calibration and path.is_dir() and any(_there(path, topic) for topic in topics):
        return _drive_folder(path, topics, calibration, options, frame)
    is_folder = path.is_dir() and not (path / "metadata.yaml").is_file()
    if kitti is None and (is_folder or path.suffix.lower() in VIDEO_SUFFIXES):
        return _photographs(path, options, calibration, frame)
    if options.changed(origin=None) != PhotoOptions():
        raise InputError(f"{path}: has poses of its own, want no options of photographs but --origin")
    return kitti or Source(partial(open_recording, path))


def _topics(calibration: DriveCalibration) -> list[str]:
    single = [one.topic for one in calibration.cameras] + [one.topic for one in calibration.lasers]
    pairs = [topic for pair in calibration.stereo_cameras for topic in (pair.left, pair.right)]
    return [topic for topic in (*single, *pairs) if topic]


def _there(path: Path, topic: str) -> Path | None:
    """Return the folder or file of a topic, within the folder."""
    name = topic.strip("/").partition(":")[0]
    for place in (path / name, path / f"{name}.npz"):
        if name and ".." not in Path(name).parts and place.exists():
            return place
    return None


def _with_poses(
    path: Path, options: PhotoOptions, calibration: DriveCalibration, frame: LocalFrame | None
) -> tuple[Track, Callable[..., Source]]:
    """Return the poses of a folder or film, and what makes a source of the rest; those without heading are left out."""
    folder = path if path.is_dir() else path.parent
    named = _there(folder, calibration.pose)
    poses = options.poses or (named if named and named.is_file() else folder / _POSES)
    if options.poses is None and not poses.is_file():
        raise InputError(
            f"{path}: has no poses, want --poses FILE (.csv, .gpx), or {_POSES} beside the pictures"
        )
    track = read_track(poses, 3600.0 * calibration.timezone_h)
    xy, frame = track.positions, (frame or LocalFrame.around(track.positions)) if track.in_degrees else None
    with naming(poses):
        xy = frame.to_xy(xy) if frame else xy
        yaw = track.headings(xy)
    known = ~np.isnan(yaw)
    found = np.column_stack([xy, yaw, np.zeros((len(yaw), 2))])[known]
    usual = _GNSS_M if track.in_degrees else 0.0
    errors = RangingErrors.of_poses(
        usual if options.pose_error is None else options.pose_error,
        _TRACK_YAW if np.isnan(track.yaw).any() else 0.0,
    )
    poses_in = track.stamps[known].tolist(), found
    return track, partial(Source, calibration=calibration, poses=poses_in, frame=frame, errors=errors)


def _drive_folder(
    path: Path,
    topics: list[str],
    calibration: DriveCalibration,
    options: PhotoOptions,
    frame: LocalFrame | None,
) -> Source:
    """Read a folder that a calibration describes: its topics are names of folders and files in it.

    A topic is a folder of pictures, a folder of point clouds, or an .npz file of scans. The time of each is that of the
    pose with the same number of the frame, or of a table `times.csv` in the topic's folder.
    """
    track, source = _with_poses(path, options, calibration, frame)
    names = [str(frame) for frame in track.frames] or [Path(file).stem for file in track.files]
    of_poses, streams = dict(zip(names, track.stamps.tolist(), strict=False)), {}
    for topic in topics:
        place = _there(path, topic)
        if place is None:
            there = ", ".join(sorted(file.name for file in path.iterdir())[:12])
            raise InputError(f"{path}: has no folder or file {topic!r}; it has {there}")
        if place.is_file():
            streams[topic] = Stream(SCAN, _scans(place, topic.partition(":")[2], of_poses))
        else:
            table = place / "times.csv"
            stamps = _stamps_in(table, 3600.0 * calibration.timezone_h) if table.is_file() else of_poses
            streams[topic] = stream_of(place, stamps)
    return source(partial(opened, streams), without_pose=streams[topics[0]].left_out)


def _stamps_in(table: Path, zone_s: float) -> dict[str, int]:
    """Return the times in a table, ns, by name of the file or number of the frame."""
    time = Kind("a time", lambda text: stamp_in(text, zone_s))
    kinds = {"time": time, "unix_s": time, "frame": NUMBER}
    found: dict[str, int] = {}
    for _, row in typed_records(table, lambda name: kinds.get(name, TEXT)):
        stamp = row.get("unix_s", row.get("time"))
        if stamp is None:
            raise InputError(f"{table}: has {', '.join(row)}, want file or frame, and time or unix_s")
        found[Path(row["file"]).stem if "file" in row else str(int(row.get("frame", -1)))] = stamp
    return found


def _scans(file: Path, key: str, stamps: dict[str, int]) -> list[tuple[int, Callable[[], Any]]]:
    arrays = read_arrays(file)
    name = key or next((name for name in _RANGES if name in arrays), "ranges")
    try:
        start, step = (float(arrays[n].item()) for n in ("angle_min", "angle_step"))
        ranges, frames = arrays[name], arrays["frame"]
    except (KeyError, ValueError, TypeError) as error:
        wanted = "frame, angle_min, angle_step and ranges (m), ranges_mm, or `topic = FILE:ARRAY`"
        raise InputError(f"{file}: has {', '.join(sorted(arrays))}, want {wanted}") from error
    if ranges.ndim != 2 or len(ranges) != frames.size or not np.issubdtype(ranges.dtype, np.number):
        raise InputError(f"{file}: {name} has the shape {ranges.shape}, want {frames.size} rows")
    scale = 0.001 if np.issubdtype(ranges.dtype, np.integer) else _RANGES.get(name, 1.0)
    metres = (ranges * scale).astype(np.float32)
    most = float(np.where(np.isfinite(metres), metres, 0.0).max(initial=0.0)) + 0.01
    scan = partial(SimpleNamespace, angle_min=start, angle_increment=step, range_min=0.0, range_max=most)
    at = [stamps.get(number_of(str(frame))) for frame in frames.ravel().tolist()]
    timed = {stamp: row for row, stamp in zip(metres, at, strict=True) if stamp is not None}
    return [(stamp, partial(scan, ranges=timed[stamp])) for stamp in sorted(timed)]


def _photographs(
    path: Path, options: PhotoOptions, calibration: DriveCalibration | None, frame: LocalFrame | None
) -> Source:
    """Read a folder of photographs or a film; `calibration` is of one camera, None for `options.fov`."""
    film = None if path.is_dir() else Video.of(path)
    files = [] if film else images_in(path)
    if calibration is None:
        height, width = (film.height, film.width) if film else read_image(files[0]).shape[:2]
        calibration = DriveCalibration(cameras=(_usual_camera(path, options, width, height),))
    if len(calibration.cameras) != 1 or calibration.stereo_cameras or calibration.lasers:
        raise InputError(f"{calibration._file or path}: want one camera, which took the pictures")
    track, source = _with_poses(path, options, calibration, frame)
    topic = calibration.cameras[0].topic
    if film:
        pictures = _Film(film, int(track.stamps[0]) + round(options.clock_offset * 1e9), options.fps)
        return source(partial(opened, {topic: Stream(IMAGE, pictures)}))
    stamps = _times(path, files, track, options, 3600.0 * calibration.timezone_h)
    timed = [(stamp, partial(PictureFile, file)) for file, stamp in stamps.items()]
    stream = Stream(COMPRESSED_IMAGE, sorted(timed, key=lambda one: one[0]))
    return source(partial(opened, {topic: stream}), without_pose=len(files) - len(timed))


@dataclass(frozen=True)
class _Film:
    """The messages of a film's pictures, each time anew."""

    film: Video
    begin: int  # ns
    fps: float | None

    def __iter__(self) -> Iterator[tuple[int, Callable[[], Any]]]:
        for frame in self.film.read():
            late = frame.time if self.fps is None else frame.number / self.fps
            h, w = frame.image.shape[:2]
            picture = partial(SimpleNamespace, encoding="rgb8", height=h, width=w, step=3 * w)
            yield self.begin + round(late * 1e9), partial(picture, data=frame.image)


def _times(
    path: Path, files: list[Path], track: Track, options: PhotoOptions, zone_s: float
) -> dict[Path, int]:
    """Return the stamps of photographs; those that the table of poses does not name are left out."""
    late = round(options.clock_offset * 1e9)
    if track.files:
        stamp_of = dict(zip(track.files, track.stamps.tolist(), strict=True))
        if len(stamp_of) < len(track.files):
            raise InputError(f"{path}: a picture has two poses, want one")
        names = {file.relative_to(path).as_posix(): file for file in files}
        if lost := sorted(stamp_of.keys() - names.keys()):
            raise InputError(f"{path}: has no picture {lost[0]!r:.80}, of which there is a pose")
        return {names[name]: stamp for name, stamp in stamp_of.items()}
    if options.fps is not None:
        begin = int(track.stamps[0]) + late
        return {file: begin + round(k / options.fps * 1e9) for k, file in enumerate(files)}
    taken = {}
    for file in files:
        try:
            taken[file] = stamp_in(image_time(file) or "", zone_s) + late
        except ValueError as error:
            raise InputError(
                f"{file}: has no Exif time, want one, --fps, or a column `file` in the poses"
            ) from error
    return taken


def _usual_camera(path: Path, options: PhotoOptions, width: int, height: int) -> CameraSpec:
    if options.fov is None:
        raise InputError(f"{path}: nothing says what the camera is; want --calibration or --fov")
    camera = PinholeCamera.from_field_of_view(width, height, math.radians(options.fov))
    numbers = {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    mount = dict(zip(("z", "yaw", "pitch"), options.mount, strict=True))
    parsed = MountSpec.parse(mount, dict.fromkeys(mount, "--mount"))
    return CameraSpec(name="camera", mount=parsed, **numbers)
