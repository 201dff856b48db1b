"""Poses of a recording: of messages of poses, of a satellite receiver and its IMU, or of transforms."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.errors import InputError
from parkenv.files.recordings import NAV_FIX, TRANSFORMS, stamp_of
from parkenv.files.tracks import Track
from parkenv.lots.local_frame import LocalFrame

GAP_S = 2.0  # longest time between two poses that a pose is interpolated between, s
_NORMS = 0.5, 1.5  # of quaternions that are taken for rounded ones of norm 1, and normalised
_SLOPE_S = 2.0  # before and after a pose: roll and pitch that last so long are those of the road
_BASES = "base_link", "base_footprint", "imu_link", "imu", "vehicle", "ego_vehicle"
_GROUND = "base_footprint", "base_link"


class Pose(NamedTuple):
    x: float  # m, or degrees of longitude
    y: float  # m, or degrees of latitude
    yaw: float  # rad; NaN where it is not known
    roll: float = 0.0  # rad, to the right
    pitch: float = 0.0  # rad, upwards


def pose_of(message: Any) -> Pose:
    """Return the pose of a `Pose2D`, `PoseStamped`, `PoseWithCovarianceStamped`, `Odometry` or `NavSatFix`."""
    if hasattr(message, "theta"):
        return Pose(float(message.x), float(message.y), float(message.theta))
    if hasattr(message, "latitude"):
        return Pose(float(message.longitude), float(message.latitude), math.nan)
    pose = message.pose if hasattr(message.pose, "position") else message.pose.pose
    return Pose(float(pose.position.x), float(pose.position.y), *_angles_of(pose.orientation))


def _angles_of(q: Any) -> tuple[float, float, float]:
    """Return yaw, roll (to the right) and pitch (upwards) of a quaternion, rad."""
    norm = math.hypot(q.x, q.y, q.z, q.w)
    if not _NORMS[0] <= norm <= _NORMS[1]:
        raise InputError(f"its orientation has the norm {norm:.3g}, want a quaternion of norm 1")
    # The same in any norm.
    yaw = math.atan2(2.0 * (q.w * q.z + q.x * q.y), q.w * q.w + q.x * q.x - q.y * q.y - q.z * q.z)
    roll = math.atan2(2.0 * (q.w * q.x + q.y * q.z), q.w * q.w - q.x * q.x - q.y * q.y + q.z * q.z)
    down = math.asin(max(-1.0, min(1.0, 2.0 * (q.w * q.y - q.z * q.x) / norm**2)))
    return yaw, roll, -down


class FrameTree:
    """The frames of `/tf_static` and `/tf`: where each is in its parent."""

    def __init__(self) -> None:
        self._parent: dict[str, tuple[str, FloatArray]] = {}  # by frame; the first transform of each
        self._moving: dict[str, list[tuple[int, FloatArray]]] = {}  # ns and transform of frames in `/tf`

    def __contains__(self, frame: str) -> bool:
        return frame in self._parent or any(parent == frame for parent, _ in self._parent.values())

    def add(self, message: Any, *, static: bool) -> None:
        for one in message.transforms:
            parent, child = (name.strip("/") for name in (one.header.frame_id, one.child_frame_id))
            at, q = one.transform.translation, one.transform.rotation
            matrix = np.eye(4)
            _angles_of(q)
            matrix[:3, :3] = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
            matrix[:3, 3] = at.x, at.y, at.z
            if not np.isfinite(matrix).all():
                raise InputError(f"the transform of {child!r:.60} is not finite")
            self._parent.setdefault(child, (parent, matrix))
            if not static:
                self._moving.setdefault(child, []).append((stamp_of(one, 0), matrix))

    def _upwards(self, frame: str) -> Iterator[str]:
        seen = set[str]()
        while frame not in seen:
            yield frame
            seen.add(frame)
            frame = self._parent.get(frame, (frame, None))[0]

    def between(self, base: str, frame: str) -> FloatArray | None:
        """Return the pose of a frame in `base`, (4, 4); None where they are not connected."""
        ups = [list(self._upwards(one)) for one in (base, frame)]
        common = next((one for one in ups[0] if one in ups[1]), None)
        if common is None:
            return None
        to_common = [np.eye(4), np.eye(4)]
        for k, chain in enumerate(ups):
            for one in chain[: chain.index(common)]:
                to_common[k] = self._parent[one][1] @ to_common[k]
        return np.asarray(np.linalg.inv(to_common[0]) @ to_common[1])

    def base(self, wanted: str | None) -> str | None:
        """Return the frame of the vehicle."""
        if wanted is not None and wanted not in self:
            frames = sorted({*self._parent, *(parent for parent, _ in self._parent.values())})
            raise InputError(f"/tf has no frame {wanted!r}; it has {', '.join(frames[:12]) or 'none'}")
        return wanted or next((name for name in _BASES if name in self), None)

    def height(self, base: str) -> float:
        """Return the height of the vehicle's frame above the one that is on the ground, m."""
        ground = next((name for name in _GROUND if name in self), base)
        at = self.between(ground, base)
        return 0.0 if at is None else float(at[2, 3])

    def poses(self, base: str) -> tuple[list[int], list[Pose]]:
        """Return the poses of the vehicle in the topmost frame, such as `map`, at the times of its own transforms."""
        chain = [one for one in self._upwards(base) if one in self._parent]
        moving = [one for one in chain if one in self._moving]
        if not moving:
            raise InputError(f"/tf does not say where {base!r} is, want transforms from map or odom to it")
        leader = max(moving, key=lambda one: len(self._moving[one]))
        steps = {one: sorted(self._moving[one], key=lambda step: step[0]) for one in moving}
        times = {one: [stamp for stamp, _ in steps[one]] for one in moving}
        stamps, poses = list[int](), list[Pose]()
        for stamp in dict.fromkeys(times[leader]):
            at = np.eye(4)
            for one in chain:
                matrix = self._parent[one][1]
                if one in steps:
                    matrix = steps[one][max(int(np.searchsorted(times[one], stamp, "right")) - 1, 0)][1]
                at = matrix @ at
            yaw, down, roll = Rotation.from_matrix(at[:3, :3]).as_euler("ZYX").tolist()
            stamps.append(stamp)
            poses.append(Pose(float(at[0, 3]), float(at[1, 3]), yaw, roll, -down))
        return stamps, poses


class PoseReader:
    """Collects the messages that poses are made of; `frame` is the lot's, None for one around the first position."""

    def __init__(self, kind: str, tree: FrameTree, base: str | None, frame: LocalFrame | None) -> None:
        self.kind, self._tree, self._base, self.frame = kind, tree, base, frame
        self.std: float = 0.0  # m, that a receiver states of its positions
        self._poses: list[Pose] = []
        self._turns: list[tuple[int, float, float, float]] = []
        self._variances: list[float] = []

    def add(self, message: Any) -> bool:
        """Add a pose; whether it is one: receivers may have no fix."""
        pose = pose_of(message)
        if self.kind == NAV_FIX:
            if int(message.status.status) < 0 or not np.isfinite(pose[:2]).all():
                return False
            if int(getattr(message, "position_covariance_type", 0)) > 0:
                self._variances.append(
                    0.5 * float(message.position_covariance[0] + message.position_covariance[4])
                )
        self._poses.append(pose)
        return True

    def add_imu(self, stamp: int, message: Any) -> None:
        q = message.orientation
        if float(message.orientation_covariance[0]) != -1.0 and (q.x, q.y, q.z, q.w) != (0.0, 0.0, 0.0, 0.0):
            self._turns.append((stamp, *_angles_of(q)))

    def poses(self, stamps: list[int]) -> tuple[list[int], FloatArray]:
        """Return the stamps, and the poses, (n, 5): x, y in m, yaw, roll, pitch in rad; where a heading is known."""
        poses = self._poses
        if self.kind in TRANSFORMS:
            if self._base is None:
                raise InputError(
                    "/tf has no frame of the vehicle, want base_link, or `base` in the calibration"
                )
            stamps, poses = self._tree.poses(self._base)
        found = np.array(poses, dtype=np.float64).reshape(-1, 5)
        if self.kind != NAV_FIX or not len(found):
            return stamps, found
        self.std = math.sqrt(float(np.median(self._variances))) if self._variances else 0.0
        self.frame = self.frame or LocalFrame(float(found[0, 0]), float(found[0, 1]))
        found[:, :2] = self.frame.to_xy(found[:, :2])
        times = np.array(stamps, np.int64)
        turns = np.array(sorted(self._turns), dtype=object)
        if len(turns):
            at = (turns[:, 0].astype(np.int64) - times[0]) / 1e9
            for column in (1, 2, 3):
                angle = np.unwrap(turns[:, column].astype(np.float64))
                found[:, 1 + column] = np.interp((times - times[0]) / 1e9, at, angle)
        else:
            begins = np.r_[True, np.diff(times) > GAP_S * 1e9]
            track = Track(times, (), found[:, :2], False, np.full(len(times), np.nan), begins)
            found[:, 2] = track.headings(found[:, :2])
        known = np.isfinite(found[:, 2])
        return times[known].tolist(), found[known]


class PoseTrack:
    """The poses of a drive, by time."""

    def __init__(self, stamps: list[int], poses: FloatArray) -> None:
        self.stamps: IntArray = np.array(stamps, np.int64)
        self.poses: FloatArray = np.ascontiguousarray(poses[:, :3])  # (n, 3) x, y, yaw
        self._tilts = _without_slope(self.stamps, poses[:, 3:])

    def at(self, stamp: int) -> FloatArray | None:
        """Return the interpolated pose, (3,), at a time, ns of Unix time; None where there is none."""
        after = int(np.searchsorted(self.stamps, stamp))
        n = len(self.stamps)
        if after < n and self.stamps[after] == stamp:
            return np.array(self.poses[after], dtype=np.float64)
        if after in (0, n) or self.stamps[after] - self.stamps[after - 1] > GAP_S * 1e9:
            return None
        one, two = self.poses[after - 1], self.poses[after]
        share = (stamp - int(self.stamps[after - 1])) / int(self.stamps[after] - self.stamps[after - 1])
        turn = (two[2] - one[2] + math.pi) % (2.0 * math.pi) - math.pi
        return np.array([*(one[:2] + share * (two[:2] - one[:2])), one[2] + share * turn])

    def during(self, stamps: FloatArray) -> FloatArray:
        """Return the poses, (n, 3), at times, (n,) ns, within the drive."""
        at, late = (self.stamps - self.stamps[0]) / 1e9, (stamps - self.stamps[0]) / 1e9
        x, y, yaw = self.poses.T
        return np.column_stack([np.interp(late, at, values) for values in (x, y, np.unwrap(yaw))])

    def tilt(self, stamp: int) -> tuple[float, float]:
        """Return roll and pitch against the road, rad: against what they are in the seconds before and after."""
        if not self._tilts.any():
            return 0.0, 0.0
        late = (stamp - self.stamps[0]) / 1e9
        at = (self.stamps - self.stamps[0]) / 1e9
        return float(np.interp(late, at, self._tilts[:, 0])), float(np.interp(late, at, self._tilts[:, 1]))

    def moved(self, stamp: int, pose: FloatArray) -> FloatArray | None:
        """Return where the vehicle was at a time, (3,), in its frame at `pose`."""
        then = self.at(stamp)
        return None if then is None else within(pose, then)


def within(pose: FloatArray, other: FloatArray) -> FloatArray:
    """Return one pose, (..., 3), in the frame of another, (3,)."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    x, y, yaw = np.moveaxis(other - pose, -1, 0)
    return np.stack([c * x + s * y, c * y - s * x, (yaw + math.pi) % (2.0 * math.pi) - math.pi], axis=-1)


def _without_slope(stamps: IntArray, tilts: FloatArray) -> FloatArray:
    if not np.abs(tilts).max(initial=0.0) > 1e-6:
        return np.zeros_like(tilts)
    low = np.searchsorted(stamps, stamps - round(_SLOPE_S * 1e9))
    high = np.searchsorted(stamps, stamps + round(_SLOPE_S * 1e9), "right")
    total = np.vstack([np.zeros(2), np.cumsum(np.unwrap(tilts, axis=0), axis=0)])
    return np.asarray(np.unwrap(tilts, axis=0) - (total[high] - total[low]) / (high - low)[:, None])
