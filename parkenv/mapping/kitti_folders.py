"""Folders of the KITTI dataset, raw and odometry, as they come: Geiger et al., IJRR 2013."""

from __future__ import annotations

from collections.abc import Callable
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
from parkenv.lots.local_frame import LocalFrame
from parkenv.mapping.drive_calibration import DriveCalibration
from parkenv.mapping.drive_sources import (
    CLOUD_SUFFIXES,
    CloudFile,
    PictureFile,
    Stream,
    Timed,
    header,
    opened,
)
from parkenv.mapping.drive_writer import RECORDED_MONDAY_S
from parkenv.mapping.lenses import OPTICAL
from parkenv.perception.monocular import RangingErrors

IMU_HEIGHT_M, CAMERA_HEIGHT_M = 0.93, 1.65  # above the road
_BASE, _IMU, _VELODYNE = "base_link", "imu_link", "velo_link"
_POS_ACCURACY = 23  # number of the column in OXTS
_POSE = "geometry_msgs/msg/PoseStamped"
_Make = Callable[[Path, Any], Any]  # of a file and a header
_Link = tuple[str, str, FloatArray]  # a frame, one in it, and its pose, (4, 4)


class KittiFolder:
    """A folder as a recording with calibration, transforms and poses; a calibration file may choose other topics."""

    calibration: DriveCalibration | None = None
    errors: RangingErrors | None = None
    frame: LocalFrame | None = None
    without_pose = 0

    def __init__(self, path: Path, read: Callable[[Path], dict[str, Stream]]) -> None:
        self._path, self._read = path, read

    def open(self) -> AbstractContextManager[tuple[dict[str, str], Messages]]:
        return opened(self._read(self._path))


def kitti_folder(path: Path) -> KittiFolder | None:
    """Return what reads a folder if it is one of KITTI: a drive, a day with one drive, or an odometry sequence."""
    if not path.is_dir():
        return None
    if (path / "calib.txt").is_file() and (path / "times.txt").is_file():
        return KittiFolder(path, _odometry)
    drives = [folder for folder in (path, *sorted(path.iterdir())) if (folder / "oxts").is_dir()]
    if len(drives) > 1:
        raise InputError(f"{path}: has {len(drives)} drives, want one of them, such as {drives[0]}")
    return KittiFolder(drives[0], _raw) if drives else None


def _raw(folder: Path) -> dict[str, Stream]:
    def calibration(name: str) -> dict[str, FloatArray]:
        places = [place / name for place in (folder, folder.parent) if (place / name).is_file()]
        if not places:
            raise InputError(
                f"{folder}: has no {name}, want KITTI's calibration of that day in it, or beside it"
            )
        return _numbers_of(places[0])

    def timed(name: str, suffixes: tuple[str, ...], make: _Make, clock: str, frame: str) -> Timed:
        files = files_in(folder / name / "data", suffixes)
        return _numbered(files, _times(folder / clock / "timestamps.txt"), make, frame) if files else []

    to_cam = calibration("calib_cam_to_cam.txt")
    turned = _matrix(_part(to_cam, "R_rect_00", 9, folder))
    velo_in_cam = turned @ _rigid(calibration("calib_velo_to_cam.txt"), folder)
    imu_in_velo = _rigid(calibration("calib_imu_to_velo.txt"), folder)
    links: list[_Link] = [(_BASE, _IMU, _raised(IMU_HEIGHT_M)), (_IMU, _VELODYNE, _inverse(imu_in_velo))]
    streams: dict[str, Stream] = {}
    for k in range(4):
        # The cameras are triggered together; the times of the second of each pair are those of its computer.
        name, clock = f"image_0{k}", f"image_0{k // 2 * 2}"
        if pictures := timed(name, SUFFIXES, PictureFile, clock, name):
            parts = {part: _part(to_cam, f"{part}_0{k}", n, folder) for part, n in _CAMERA_PARTS}
            streams |= _camera(name, pictures, parts)
            links.append((_VELODYNE, name, _inverse(_shift_of(parts["P_rect"]) @ velo_in_cam)))
    if clouds := timed("velodyne_points", CLOUD_SUFFIXES, CloudFile, "velodyne_points", _VELODYNE):
        streams["velodyne_points"] = CLOUD, clouds
    fixes = timed("oxts", (".txt",), _fix, "oxts", _IMU)
    return streams | {"oxts": (NAV_FIX, fixes), "oxts/imu": (IMU, fixes)} | _static(links)


_CAMERA_PARTS = ("S", 2), ("K", 9), ("D", 5), ("R_rect", 9), ("S_rect", 2), ("P_rect", 12)


def _odometry(folder: Path) -> dict[str, Stream]:
    numbers, name = _numbers_of(folder / "calib.txt"), f"{folder.name}.txt"
    wanted = [folder / "poses.txt", *(up / "poses" / name for up in (folder.parent, folder.parent.parent))]
    poses = next((file for file in wanted if file.is_file()), None)
    if poses is None:
        raise InputError(f"{folder}: has no poses, want {wanted[2]} or {wanted[0]}")
    stamps = [round((RECORDED_MONDAY_S + t) * 1e9) for t in _table(folder / "times.txt", 1)[:, 0]]
    rows = _table(poses, 12).reshape(-1, 3, 4)
    found: Timed = [(at, partial(_camera_pose, row, at)) for at, row in zip(stamps, rows, strict=False)]
    base_in_camera = _inverse(_raised(CAMERA_HEIGHT_M) @ _matrix(OPTICAL))
    streams: dict[str, Stream] = {"poses": (_POSE, found)}
    links: list[_Link] = []
    for k in range(4):
        if files := files_in(folder / f"image_{k}", SUFFIXES):
            projection = _part(numbers, f"P{k}", 12, folder)
            streams |= _camera(
                f"image_{k}", _numbered(files, stamps, PictureFile, f"image_{k}"), {"P_rect": projection}
            )
            links.append((_BASE, f"image_{k}", _inverse(_shift_of(projection) @ base_in_camera)))
    if clouds := files_in(folder / "velodyne", CLOUD_SUFFIXES):
        streams["velodyne"] = CLOUD, _numbered(clouds, stamps, CloudFile, _VELODYNE)
        in_camera = np.vstack([_part(numbers, "Tr", 12, folder).reshape(3, 4), [0.0, 0.0, 0.0, 1.0]])
        links.append((_BASE, _VELODYNE, _inverse(base_in_camera) @ in_camera))
    return streams | _static(links)


def _camera(name: str, pictures: Timed, parts: dict[str, FloatArray]) -> dict[str, Stream]:
    """Return the streams of a camera's pictures and of its lens: rectified, if their size is that of rectified ones."""
    p, file = parts["P_rect"], pictures[0][1]().path
    height, width = read_image(file).shape[:2]
    size = width, height
    recorded, rectified = (
        (int(parts[n][0]), int(parts[n][1])) if n in parts else size for n in ("S", "S_rect")
    )
    if size not in (recorded, rectified):
        raise InputError(f"{file}: is {width}×{height} px, want {rectified} or, not rectified, {recorded}")
    k, d, r = p.reshape(3, 4)[:, :3].ravel(), np.zeros(5), np.eye(3).ravel()
    if size != rectified:
        k, d, r = parts["K"], parts["D"], parts["R_rect"]
    info = SimpleNamespace(
        header=header(0, name), width=width, height=height, k=k, d=d, r=r, p=p, rectified_size=rectified
    )
    return {
        name: (COMPRESSED_IMAGE, pictures),
        f"{name}/camera_info": (CAMERA_INFO, [(0, lambda: info)]),
    }


def _static(links: list[_Link]) -> dict[str, Stream]:
    transforms = []
    for parent, child, matrix in links:
        at = SimpleNamespace(translation=_xyz(matrix[:3, 3]), rotation=_quaternion(matrix[:3, :3]))
        transforms.append(SimpleNamespace(header=header(0, parent), child_frame_id=child, transform=at))
    return {"/tf_static": (TRANSFORMS[0], [(0, lambda: SimpleNamespace(transforms=transforms))])}


def _fix(file: Path, head: Any) -> Any:
    """Return an OXTS record as both a `NavSatFix` and an `Imu`: yaw from east, roll to the right, pitch downwards."""
    row = _table(file, None)[0]
    if len(row) <= _POS_ACCURACY:
        raise InputError(f"{file}: has {len(row)} numbers, want OXTS's 30")
    return SimpleNamespace(
        header=head, latitude=float(row[0]), longitude=float(row[1]), status=SimpleNamespace(status=0),
        position_covariance=np.full(9, float(row[_POS_ACCURACY]) ** 2), position_covariance_type=2,
        orientation=_quaternion(Rotation.from_euler("ZYX", row[[5, 4, 3]]).as_matrix()),
        orientation_covariance=np.zeros(9),
    )  # fmt: skip


def _camera_pose(matrix: FloatArray, stamp: int) -> Any:
    """Return the pose of camera 0, (3, 4), in axes ahead, left and up of its first pose."""
    turned = _quaternion(OPTICAL @ matrix[:, :3] @ OPTICAL.T)
    at = SimpleNamespace(position=_xyz(OPTICAL @ matrix[:, 3]), orientation=turned)
    return SimpleNamespace(header=header(stamp, "map"), pose=at)


def _xyz(values: FloatArray) -> Any:
    return SimpleNamespace(**dict(zip("xyz", values.tolist(), strict=True)))


def _quaternion(rotation: FloatArray) -> Any:
    return SimpleNamespace(
        **dict(zip("xyzw", Rotation.from_matrix(rotation).as_quat().tolist(), strict=True))
    )


def _numbered(files: list[Path], stamps: list[int], make: _Make, frame: str) -> Timed:
    """Return the messages of files that are named by the index of their times; those that do not rise are left out."""
    found: Timed = []
    for file in files:
        if not (file.stem.isdecimal() and int(file.stem) < len(stamps)):
            raise InputError(f"{file}: has no time, want a name that is a number below {len(stamps)}")
        stamp = stamps[int(file.stem)]
        if not found or stamp > found[-1][0]:
            found.append((stamp, partial(make, file, header(stamp, frame))))
    return found


def _times(path: Path) -> list[int]:
    """Return the times of a file, ns as if they were UTC: KITTI's are those of the place."""
    stamps = []
    for number, line in enumerate(read_text(path).splitlines(), 1):
        date, _, fraction = line.strip().partition(".")
        try:
            seconds = round(datetime.fromisoformat(date).replace(tzinfo=UTC).timestamp())
            stamps.append(seconds * 10**9 + int(f"{fraction:0<9}"[:9]))
        except ValueError as error:
            raise InputError(f"{path}: line {number} is {line!r:.60}, want a time") from error
    return stamps


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
    found = parts.get(name)
    if found is None or found.size != size or not np.isfinite(found).all():
        raise InputError(f"{folder}: its calibration has no {name} of {size} numbers")
    return found


def _table(path: Path, columns: int | None) -> FloatArray:
    try:
        numbers = np.array(read_text(path).split(), dtype=np.float64)
        rows = numbers.reshape(-1, columns or len(numbers))
    except ValueError as error:
        raise InputError(f"{path}: is no table of numbers: {error}") from error
    if not rows.size or not np.isfinite(rows).all():
        raise InputError(f"{path}: has no rows, or numbers that are not finite")
    return rows


def _matrix(
    rotation: FloatArray, translation: FloatArray | tuple[float, ...] = (0.0, 0.0, 0.0)
) -> FloatArray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation.reshape(3, 3), translation
    return matrix


def _rigid(parts: dict[str, FloatArray], folder: Path) -> FloatArray:
    return _matrix(_part(parts, "R", 9, folder), _part(parts, "T", 3, folder))


def _raised(height: float) -> FloatArray:
    return _matrix(np.eye(3), (0.0, 0.0, height))


def _inverse(matrix: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.inv(matrix), dtype=np.float64)


def _shift_of(projection: FloatArray) -> FloatArray:
    """Return what takes points from the first camera's frame to that of a projection, (4, 4)."""
    p = projection.reshape(3, 4)
    return _matrix(np.eye(3), np.asarray(np.linalg.solve(p[:, :3], p[:, 3]), dtype=np.float64))
