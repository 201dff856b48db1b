"""Folders of the KITTI dataset, raw and odometry, as they come: Geiger et al., IJRR 2013."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from parkenv.compiled.arrays import FloatArray
from parkenv.errors import InputError
from parkenv.files.images import SUFFIXES, files_in, read_image
from parkenv.files.limited_reading import read_text
from parkenv.files.recordings import CAMERA_INFO, CLOUD, COMPRESSED_IMAGE, IMU, NAV_FIX, TRANSFORMS, Messages
from parkenv.mapping.drive_calibration import DriveCalibration
from parkenv.mapping.drive_sources import CLOUD_SUFFIXES, CloudFile, PictureFile, Stream, header, opened
from parkenv.mapping.drive_writer import RECORDED_MONDAY_S
from parkenv.mapping.lenses import OPTICAL
from parkenv.perception.monocular import RangingErrors

IMU_HEIGHT_M, CAMERA_HEIGHT_M = 0.93, 1.65  # above the road
_IMU, _VELODYNE, _BASE = "imu_link", "velo_link", "base_link"
_POS_ACCURACY = 23  # number of the column in OXTS
_POSE = "geometry_msgs/msg/PoseStamped"
_Timed = list[tuple[int, Callable[[], Any]]]  # ns, and what makes the message
_CALIBRATIONS = "calib_cam_to_cam.txt", "calib_velo_to_cam.txt", "calib_imu_to_velo.txt"


def kitti_folder(path: Path) -> KittiFolder | None:
    """Return what reads a folder if it is one of KITTI: a drive, a day with one drive, or an odometry sequence."""
    if not path.is_dir():
        return None
    if (path / "calib.txt").is_file() and (path / "times.txt").is_file():
        return KittiFolder(path, _odometry)
    if (path / "oxts").is_dir() and any(path.glob("image_0?")):
        return KittiFolder(path, _raw)
    drives = [folder for folder in sorted(path.iterdir()) if (folder / "oxts").is_dir()]
    if len(drives) > 1:
        raise InputError(f"{path}: has {len(drives)} drives, want one of them, such as {drives[0]}")
    return KittiFolder(drives[0], _raw) if drives else None


class KittiFolder:
    """A folder as a recording with calibration, transforms and poses; a calibration file may choose other topics."""

    errors: RangingErrors | None = None
    without_pose = 0

    def __init__(self, path: Path, read: Callable[[Path], dict[str, Stream]]) -> None:
        self.path, self._read = path, read
        self.calibration: DriveCalibration | None = None

    def open(self) -> AbstractContextManager[tuple[dict[str, str], Messages]]:
        return opened(self._read(self.path))


def _raw(folder: Path) -> dict[str, Stream]:
    places = {
        name: next((p / name for p in (folder, folder.parent) if (p / name).is_file()), None)
        for name in _CALIBRATIONS
    }
    if missing := [name for name, place in places.items() if place is None]:
        raise InputError(
            f"{folder}: has no {missing[0]}, want KITTI's calibration of that day in it, or beside it"
        )
    to_cam, velo_to_cam, imu_to_velo = (_numbers_of(place) for place in places.values() if place)
    streams: dict[str, Stream] = {}
    first_rotation = np.eye(4)
    first_rotation[:3, :3] = _part(to_cam, "R_rect_00", 9, folder).reshape(3, 3)
    velo_in_cam = first_rotation @ _rigid(velo_to_cam, folder)
    links = [
        (_BASE, _IMU, _raised(IMU_HEIGHT_M)),
        (_IMU, _VELODYNE, np.linalg.inv(_rigid(imu_to_velo, folder))),
    ]
    for place in sorted(folder.glob("image_0?")):
        k = place.name[-2:]
        if not (place / "data").is_dir():
            continue
        # The cameras are triggered together; KITTI's times of the second of each pair are those of its computer.
        own = folder / f"image_0{int(k) // 2 * 2}" / "timestamps.txt"
        files = files_in(place / "data", SUFFIXES)
        streams[place.name] = COMPRESSED_IMAGE, _of_files(files, own, partial(_picture, place.name))
        if not files:
            raise InputError(f"{place / 'data'}: holds no pictures")
        projection = _part(to_cam, f"P_rect_{k}", 12, folder).reshape(3, 4)
        links.append((_VELODYNE, place.name, np.linalg.inv(_shift_of(projection) @ velo_in_cam)))
        size = _size_of(files[0])
        raw, rectified = (
            tuple(int(v) for v in _part(to_cam, f"{n}_{k}", 2, folder)) for n in ("S", "S_rect")
        )
        if size not in (raw, rectified):
            raise InputError(
                f"{files[0]}: is {size[0]}×{size[1]} px, want {rectified} or, not rectified, {raw}"
            )
        lens = (projection[:, :3], np.zeros(5), np.eye(3))
        if size == raw:
            parts = (
                _part(to_cam, f"{n}_{k}", n_of, folder) for n, n_of in (("K", 9), ("D", 5), ("R_rect", 9))
            )
            lens = tuple(parts)  # type: ignore[assignment]
        streams |= _info(place.name, size, lens, projection, rectified)
    clouds = files_in(folder / "velodyne_points" / "data", CLOUD_SUFFIXES)
    if clouds:
        times = folder / "velodyne_points" / "timestamps.txt"
        streams["velodyne_points"] = CLOUD, _of_files(clouds, times, partial(_cloud, _VELODYNE))
    fixes = _of_files(files_in(folder / "oxts" / "data", (".txt",)), folder / "oxts" / "timestamps.txt", _fix)
    # Both are of one file, which is read for each.
    streams["oxts"] = NAV_FIX, fixes
    streams["oxts/imu"] = IMU, fixes
    return streams | _static(links)


def _odometry(folder: Path) -> dict[str, Stream]:
    calibration = _numbers_of(folder / "calib.txt")
    number = folder.name
    wanted = [
        folder / "poses.txt",
        folder.parent / "poses" / f"{number}.txt",
        folder.parent.parent / "poses" / f"{number}.txt",
    ]
    place = next((file for file in wanted if file.is_file()), None)
    if place is None:
        raise InputError(f"{folder}: has no poses, want {wanted[2]} or {wanted[0]}")
    stamps = [round((RECORDED_MONDAY_S + t) * 1e9) for t in _table(folder / "times.txt", 1)[:, 0]]
    poses = _table(place, 12).reshape(-1, 3, 4)
    streams: dict[str, Stream] = {
        "poses": (
            _POSE,
            [(stamp, partial(_camera_pose, pose, stamp)) for stamp, pose in zip(stamps, poses, strict=False)],
        )
    }
    links = []
    base_in_camera = np.linalg.inv(_raised(CAMERA_HEIGHT_M) @ _turn(OPTICAL))
    for place in sorted(folder.glob("image_?")):
        files = files_in(place, SUFFIXES)
        projection = _part(calibration, f"P{place.name[-1]}", 12, folder).reshape(3, 4)
        if not files:
            continue
        streams[place.name] = COMPRESSED_IMAGE, _numbered(files, stamps, partial(_picture, place.name))
        links.append((_BASE, place.name, np.linalg.inv(_shift_of(projection) @ base_in_camera)))
        lens = (projection[:, :3], np.zeros(5), np.eye(3))
        streams |= _info(place.name, _size_of(files[0]), lens, projection, None)
    if clouds := files_in(folder / "velodyne", CLOUD_SUFFIXES):
        streams["velodyne"] = CLOUD, _numbered(clouds, stamps, partial(_cloud, _VELODYNE))
        in_camera = np.vstack([_part(calibration, "Tr", 12, folder).reshape(3, 4), [0.0, 0.0, 0.0, 1.0]])
        links.append((_BASE, _VELODYNE, np.linalg.inv(base_in_camera) @ in_camera))
    return streams | _static(links)


def _static(links: list[tuple[str, str, FloatArray]]) -> dict[str, Stream]:
    parts = [_transform(*link) for link in links]
    return {"/tf_static": (TRANSFORMS[0], [(0, lambda: SimpleNamespace(transforms=parts))])}


def _transform(parent: str, child: str, matrix: FloatArray) -> Any:
    x, y, z = matrix[:3, 3].tolist()
    turned = SimpleNamespace(
        translation=SimpleNamespace(x=x, y=y, z=z), rotation=_quaternion(Rotation.from_matrix(matrix[:3, :3]))
    )
    return SimpleNamespace(header=header(0, parent), child_frame_id=child, transform=turned)


def _quaternion(rotation: Rotation) -> Any:
    return SimpleNamespace(**dict(zip("xyzw", rotation.as_quat().tolist(), strict=True)))


def _info(
    topic: str, size: tuple[int, ...], lens: tuple[FloatArray, ...], projection: FloatArray, rectified: Any
) -> dict[str, Stream]:
    k, d, r = lens
    info = SimpleNamespace(
        header=header(0, topic), width=size[0], height=size[1], distortion_model="plumb_bob",
        k=k.ravel(), d=d.ravel(), r=r.ravel(), p=projection.ravel(), rectified_size=rectified or size,
    )  # fmt: skip
    return {f"{topic}/camera_info": (CAMERA_INFO, [(0, lambda: info)])}


def _picture(frame: str, file: Path, stamp: int) -> PictureFile:
    return PictureFile(file, header(stamp, frame))


def _cloud(frame: str, file: Path, stamp: int) -> CloudFile:
    return CloudFile(file, header(stamp, frame))


def _fix(file: Path, stamp: int) -> Any:
    """Return an OXTS record as both a `NavSatFix` and an `Imu`: yaw from east, roll to the right, pitch downwards."""
    row = _table(file, None)[0]
    if len(row) <= _POS_ACCURACY:
        raise InputError(f"{file}: has {len(row)} numbers, want OXTS's 30")
    std = float(row[_POS_ACCURACY])
    covariance = np.diag([std**2, std**2, std**2]).ravel()
    return SimpleNamespace(
        header=header(stamp, _IMU), latitude=float(row[0]), longitude=float(row[1]), altitude=float(row[2]),
        status=SimpleNamespace(status=0), position_covariance=covariance, position_covariance_type=2,
        orientation=_quaternion(Rotation.from_euler("ZYX", row[[5, 4, 3]])), orientation_covariance=np.zeros(9),
    )  # fmt: skip


def _camera_pose(matrix: FloatArray, stamp: int) -> Any:
    """Return the pose of camera 0, (3, 4), in axes ahead, left and up of its first pose."""
    x, y, z = (OPTICAL @ matrix[:, 3]).tolist()
    turned = _quaternion(Rotation.from_matrix(OPTICAL @ matrix[:, :3] @ OPTICAL.T))
    return SimpleNamespace(
        header=header(stamp, "map"),
        pose=SimpleNamespace(position=SimpleNamespace(x=x, y=y, z=z), orientation=turned),
    )


def _numbered(files: list[Path], stamps: list[int], make: Callable[[Path, int], Any]) -> _Timed:
    """Return the messages of files that are named by the index of their times; those that do not rise are left out."""
    found: _Timed = []
    for file in files:
        if not (file.stem.isdecimal() and int(file.stem) < len(stamps)):
            raise InputError(
                f"{file}: has no time, want a name that is a number below {len(stamps)}, that of times"
            )
        stamp = stamps[int(file.stem)]
        if not found or stamp > found[-1][0]:
            found.append((stamp, partial(make, file, stamp)))
    return found


def _of_files(files: list[Path], times: Path, make: Callable[[Path, int], Any]) -> _Timed:
    return _numbered(files, list(_times(times)), make)


def _times(path: Path) -> Iterator[int]:
    """Yield the times of a file, ns as if they were UTC: KITTI's are those of the place."""
    for number, line in enumerate(read_text(path).split("\n"), 1):
        if not line.strip():
            continue
        date, _, fraction = line.strip().partition(".")
        try:
            seconds = round(datetime.fromisoformat(date).replace(tzinfo=UTC).timestamp())
            yield seconds * 10**9 + int(f"{fraction:0<9}"[:9])
        except ValueError as error:
            raise InputError(f"{path}: line {number} is {line!r:.60}, want a time") from error


def _numbers_of(path: Path) -> dict[str, FloatArray]:
    parts = {}
    for line in read_text(path).splitlines():
        name, _, text = line.partition(":")
        try:
            parts[name.strip()] = np.array(text.split(), dtype=np.float64)
        except ValueError:
            continue  # a date, such as that of the calibration
    return parts


def _part(parts: dict[str, FloatArray], name: str, size: int, folder: Path) -> FloatArray:
    found = parts.get(name, parts.get(f"{name}_velo_cam" if name == "Tr" else name))
    if found is None or found.size != size or not np.isfinite(found).all():
        raise InputError(f"{folder}: its calibration has no {name} of {size} numbers")
    return found


def _table(path: Path, columns: int | None) -> FloatArray:
    text = read_text(path)
    try:
        numbers = np.array(text.split(), dtype=np.float64)
        rows = numbers.reshape(-1, columns or len(numbers))
    except ValueError as error:
        raise InputError(f"{path}: is no table of {columns or ''} numbers: {error}") from error
    if not len(rows) or not np.isfinite(rows).all():
        raise InputError(f"{path}: has no rows, or numbers that are not finite")
    return rows


def _rigid(parts: dict[str, FloatArray], folder: Path) -> FloatArray:
    matrix = _turn(_part(parts, "R", 9, folder).reshape(3, 3))
    matrix[:3, 3] = _part(parts, "T", 3, folder)
    return matrix


def _turn(rotation: FloatArray) -> FloatArray:
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    return matrix


def _raised(height: float) -> FloatArray:
    matrix = np.eye(4)
    matrix[2, 3] = height
    return matrix


def _shift_of(projection: FloatArray) -> FloatArray:
    """Return what takes points from the first camera's frame to that of a projection, (4, 4)."""
    matrix = np.eye(4)
    matrix[:3, 3] = np.linalg.solve(projection[:, :3], projection[:, 3])
    return matrix


def _size_of(file: Path) -> tuple[int, int]:
    height, width = read_image(file).shape[:2]
    return width, height
