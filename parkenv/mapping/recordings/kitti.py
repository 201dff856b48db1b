"""Folders of the KITTI dataset, raw and odometry, as they come: Geiger et al., IJRR 2013."""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from parkenv.compiled.arrays import FloatArray
from parkenv.errors import InputError
from parkenv.files.images import files_in, read_image
from parkenv.files.limited_reading import read_text
from parkenv.lots.local_frame import LocalFrame
from parkenv.mapping.recordings.lenses import OPTICAL, Info
from parkenv.mapping.recordings.poses import FrameTree, angles_of
from parkenv.mapping.recordings.sources import Source, Stream, opened, stream_of
from parkenv.mapping.recordings.writer import RECORDED_MONDAY_S
from parkenv.perception.monocular import RangingErrors

IMU_HEIGHT_M, CAMERA_HEIGHT_M = 0.93, 1.65  # above the road
_BASE, _IMU = "base_link", "imu_link"
_OXTS = [1, 0, 5, 3, 4]  # columns: longitude, latitude, yaw from east, roll to the right, pitch downwards
_POS_ACCURACY = 23  # column in OXTS
_CAMERA_PARTS = ("S", 2), ("K", 9), ("D", 5), ("R_rect", 9), ("S_rect", 2), ("P_rect", 12)


def kitti_folder(path: Path, frame: LocalFrame | None) -> Source | None:
    """Return what reads a folder if it is one of KITTI: a drive, a day with one drive, or an odometry sequence."""
    if not path.is_dir():
        return None
    if (path / "calib.txt").is_file() and (path / "times.txt").is_file():
        return _odometry(path)
    drives = [folder for folder in (path, *sorted(path.iterdir())) if (folder / "oxts").is_dir()]
    if len(drives) > 1:
        raise InputError(f"{path}: has {len(drives)} drives, want one of them, such as {drives[0]}")
    return _raw(drives[0], frame) if drives else None


def _raw(folder: Path, frame: LocalFrame | None) -> Source:
    def calibration(name: str) -> dict[str, FloatArray]:
        places = [place / name for place in (folder, folder.parent) if (place / name).is_file()]
        if not places:
            raise InputError(
                f"{folder}: has no {name}, want KITTI's calibration of that day in it, or beside it"
            )
        return _numbers_of(places[0])

    to_cam = calibration("calib_cam_to_cam.txt")
    turned = _matrix(_part(to_cam, "R_rect_00", 9, folder))
    velo_in_cam = turned @ _rigid(calibration("calib_velo_to_cam.txt"), folder)
    imu_in_velo = _rigid(calibration("calib_imu_to_velo.txt"), folder)
    found = _Sensors()
    found.tree.add(_BASE, _IMU, _raised(IMU_HEIGHT_M))
    found.tree.add(_IMU, "velodyne_points", _inverse(imu_in_velo))
    for k in range(4):
        # The cameras are triggered together; the times of the second of each pair are those of its computer.
        name, clock = f"image_0{k}", folder / f"image_0{k // 2 * 2}"
        if (folder / name / "data").is_dir():
            parts = {part: _part(to_cam, f"{part}_0{k}", n, folder) for part, n in _CAMERA_PARTS}
            found.add_camera(
                name, stream_of(folder / name / "data", _times(clock)), parts, "velodyne_points", velo_in_cam
            )
    if (place := folder / "velodyne_points").is_dir():
        found.streams[place.name] = stream_of(place / "data", _times(place))
    times = _times(folder / "oxts")
    files = {stamp: file for file in files_in(folder / "oxts/data", (".txt",))
             if (stamp := times.get(str(int(file.stem)) if file.stem.isdecimal() else "")) is not None}  # fmt: skip
    rows = np.array([_table(files[stamp], 30)[0] for stamp in sorted(files)]).reshape(-1, 30)
    poses = rows[:, _OXTS] * (1.0, 1.0, 1.0, 1.0, -1.0)
    if len(rows):
        frame = frame or LocalFrame.around(poses[:, :2])
        poses[:, :2] = frame.to_xy(poses[:, :2])
    std = float(np.sqrt(np.median(rows[:, _POS_ACCURACY] ** 2))) if len(rows) else 0.0
    return found.source((sorted(files), poses), frame=frame, errors=RangingErrors.of_poses(std, 0.0))


def _odometry(folder: Path) -> Source:
    numbers, name = _numbers_of(folder / "calib.txt"), f"{folder.name}.txt"
    wanted = [folder / "poses.txt", *(up / "poses" / name for up in (folder.parent, folder.parent.parent))]
    file = next((file for file in wanted if file.is_file()), None)
    if file is None:
        raise InputError(f"{folder}: has no poses, want {wanted[2]} or {wanted[0]}")
    times = [round((RECORDED_MONDAY_S + t) * 1e9) for t in _table(folder / "times.txt", 1)[:, 0]]
    stamps = {str(k): stamp for k, stamp in enumerate(times)}
    # Poses of camera 0, in axes ahead, left and up of its first pose.
    rows = OPTICAL @ _table(file, 12).reshape(-1, 3, 4)[: len(times)]
    turns = Rotation.from_matrix(rows[:, :, :3] @ OPTICAL.T)
    poses = np.column_stack([rows[:, :2, 3], angles_of(turns)])
    base_in_camera = _inverse(_raised(CAMERA_HEIGHT_M) @ _matrix(OPTICAL))
    found = _Sensors()
    for k in range(4):
        if (place := folder / f"image_{k}").is_dir():
            parts = {"P_rect": _part(numbers, f"P{k}", 12, folder)}
            found.add_camera(place.name, stream_of(place, stamps), parts, _BASE, base_in_camera)
    if (place := folder / "velodyne").is_dir():
        found.streams[place.name] = stream_of(place, stamps)
        in_camera = np.vstack([_part(numbers, "Tr", 12, folder).reshape(3, 4), [0.0, 0.0, 0.0, 1.0]])
        found.tree.add(_BASE, place.name, _inverse(base_in_camera) @ in_camera)
    return found.source((times[: len(poses)], poses))


class _Sensors:
    """The sensors of a folder: their messages, lenses and places."""

    def __init__(self) -> None:
        self.tree, self.streams = FrameTree(), dict[str, Stream]()
        self._infos: dict[str, Info] = {}

    def source(self, poses: tuple[list[int], FloatArray], **known: Any) -> Source:
        opens = partial(opened, self.streams)
        return Source(opens, poses=poses, tree=self.tree, infos=self._infos, **known)

    def add_camera(
        self, name: str, pictures: Stream, parts: dict[str, FloatArray], frame: str, in_camera: FloatArray
    ) -> None:
        """Add a camera, of rectified pictures if their size is that of rectified ones; `in_camera`: a frame's pose."""
        p = parts["P_rect"].reshape(3, 4)
        file = next(iter(pictures.messages))[1]().path
        height, width = read_image(file).shape[:2]
        sizes = {n: (int(parts[n][0]), int(parts[n][1])) if n in parts else (width, height)
                 for n in ("S", "S_rect")}  # fmt: skip
        at = _matrix(np.eye(3), np.asarray(np.linalg.solve(p[:, :3], p[:, 3]), dtype=np.float64)) @ in_camera
        k, d, r = p[:, :3], np.zeros(0), np.eye(3)
        if (width, height) != sizes["S_rect"]:
            k, d, r = parts["K"].reshape(3, 3), parts["D"], parts["R_rect"].reshape(3, 3)
            at = _inverse(_matrix(r)) @ at
        if (width, height) not in sizes.values():
            wanted = f"{sizes['S_rect']} or, not rectified, {sizes['S']}"
            raise InputError(f"{file}: is {width}×{height} px, want {wanted}")
        self.streams[name] = pictures
        self._infos[name] = Info((width, height), k, tuple(d.tolist()), False, r, p, sizes["S_rect"])
        self.tree.add(frame, name, _inverse(at))


def _times(folder: Path) -> dict[str, int]:
    """Return the times of a sensor by number, ns as if they were UTC: KITTI's are those of the place."""
    path = folder / "timestamps.txt"
    try:
        stamps = np.array(read_text(path).splitlines(), "datetime64[ns]").astype(np.int64)
    except ValueError as error:
        raise InputError(f"{path}: is no list of times: {error}") from error
    return {str(k): stamp for k, stamp in enumerate(stamps.tolist())}


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


def _table(path: Path, columns: int) -> FloatArray:
    try:
        rows = np.array(read_text(path).split(), dtype=np.float64).reshape(-1, columns)
    except ValueError as error:
        raise InputError(f"{path}: is no table of {columns} numbers a row: {error}") from error
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
