"""Poses of a recording: of messages of poses, of a satellite receiver and its IMU, or of transforms."""

import math
from typing import Any

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


def pose_of(message: Any) -> tuple[float, ...]:
    """Return the pose of a `Pose2D`, `PoseStamped`, `PoseWithCovarianceStamped`, `Odometry` or `NavSatFix`.

    It is x, y (m; degrees of longitude and latitude), yaw (NaN where it is not known), roll and pitch, as `angles_of`.
    """
    if hasattr(message, "theta"):
        return float(message.x), float(message.y), float(message.theta), 0.0, 0.0
    if hasattr(message, "latitude"):
        return float(message.longitude), float(message.latitude), math.nan, 0.0, 0.0
    pose = message.pose if hasattr(message.pose, "position") else message.pose.pose
    return float(pose.position.x), float(pose.position.y), *angles_of(_rotation(pose.orientation)).tolist()


def _rotation(q: Any) -> Rotation:
    norm = math.hypot(q.x, q.y, q.z, q.w)
    if not _NORMS[0] <= norm <= _NORMS[1]:
        raise InputError(f"its orientation has the norm {norm:.3g}, want a quaternion of norm 1")
    return Rotation.from_quat([q.x, q.y, q.z, q.w])


def angles_of(rotation: Rotation) -> FloatArray:
    """Return yaw, roll (to the right) and pitch (upwards), (..., 3) rad."""
    return np.asarray(rotation.as_euler("ZYX")[..., [0, 2, 1]] * (1.0, 1.0, -1.0))


class FrameTree:
    """The frames of `/tf_static` and `/tf`: where each is in its parent."""

    def __init__(self) -> None:
        self._parent: dict[str, tuple[str, FloatArray]] = {}  # by frame; the first transform of each
        self._moving: dict[str, list[tuple[int, FloatArray]]] = {}  # ns and transform of frames in `/tf`

    def __contains__(self, frame: str) -> bool:
        return frame in self._frames

    @property
    def _frames(self) -> set[str]:
        return {*self._parent, *(parent for parent, _ in self._parent.values())}

    def add(self, parent: str, child: str, matrix: FloatArray) -> None:
        """Add where a frame is in another, (4, 4), unless that is known."""
        self._parent.setdefault(child, (parent, matrix))

    def add_message(self, message: Any, *, static: bool) -> None:
        for one in message.transforms:
            parent, child = (name.strip("/") for name in (one.header.frame_id, one.child_frame_id))
            at, matrix = one.transform.translation, np.eye(4)
            matrix[:3, :3] = _rotation(one.transform.rotation).as_matrix()
            matrix[:3, 3] = at.x, at.y, at.z
            if not np.isfinite(matrix).all():
                raise InputError(f"the transform of {child!r:.60} is not finite")
            self.add(parent, child, matrix)
            if not static:
                self._moving.setdefault(child, []).append((stamp_of(one, 0), matrix))

    def _upwards(self, frame: str) -> dict[str, FloatArray]:
        """Return the pose of a frame in itself and in each frame above it, (4, 4)."""
        at = np.eye(4)
        found = {frame: at}
        while (up := self._parent.get(frame)) is not None and up[0] not in found:
            frame, at = up[0], up[1] @ at
            found[frame] = at
        return found

    def between(self, base: str, frame: str) -> FloatArray | None:
        """Return the pose of a frame in `base`, (4, 4); None where they are not connected."""
        one, other = self._upwards(base), self._upwards(frame)
        common = next((above for above in one if above in other), None)
        return None if common is None else np.asarray(np.linalg.inv(one[common]) @ other[common])

    def base(self, wanted: str | None) -> str | None:
        """Return the frame of the vehicle."""
        if wanted is not None and wanted not in self:
            raise InputError(
                f"/tf has no frame {wanted!r}; it has {', '.join(sorted(self._frames)[:12]) or 'none'}"
            )
        return wanted or next((name for name in _BASES if name in self), None)

    def height(self, base: str) -> float:
        """Return the height of the vehicle's frame above the one that is on the ground, m."""
        ground = next((name for name in _GROUND if name in self), base)
        at = self.between(ground, base)
        return 0.0 if at is None else float(at[2, 3])

    def poses(self, base: str) -> tuple[list[int], FloatArray]:
        """Return the poses of the vehicle in the topmost frame, such as `map`, at the times of its own transforms."""
        chain = [one for one in self._upwards(base) if one in self._parent]
        steps = {one: sorted(self._moving[one], key=lambda step: step[0])
                 for one in chain if one in self._moving}  # fmt: skip
        if not steps:
            raise InputError(f"/tf does not say where {base!r} is, want transforms from map or odom to it")
        stamps = list(dict.fromkeys(stamp for stamp, _ in max(steps.values(), key=len)))
        at = np.eye(4)
        for one in chain:
            matrix = self._parent[one][1]
            if one in steps:
                last = np.searchsorted([stamp for stamp, _ in steps[one]], stamps, "right") - 1
                matrix = np.array([step for _, step in steps[one]])[np.maximum(last, 0)]
            at = matrix @ at
        return stamps, np.column_stack([at[:, :2, 3], angles_of(Rotation.from_matrix(at[:, :3, :3]))])


class PoseReader:
    """Collects the messages that poses are made of; `frame` is the lot's, None for one around the first position."""

    def __init__(self, kind: str, tree: FrameTree, base: str | None, frame: LocalFrame | None) -> None:
        self.kind, self._tree, self._base, self.frame = kind, tree, base, frame
        self.std: float = 0.0  # m, that a receiver states of its positions
        self._poses: list[tuple[float, ...]] = []
        self._turns: dict[int, FloatArray] = {}
        self._variances: list[float] = []

    def add(self, message: Any) -> bool:
        """Add a pose; whether it is one: receivers may have no fix."""
        pose = pose_of(message)
        if self.kind == NAV_FIX:
            if int(message.status.status) < 0 or not np.isfinite(pose[:2]).all():
                return False
            if int(message.position_covariance_type) > 0:
                self._variances.append(
                    0.5 * float(message.position_covariance[0] + message.position_covariance[4])
                )
        self._poses.append(pose)
        return True

    def add_imu(self, stamp: int, message: Any) -> None:
        q = message.orientation
        if float(message.orientation_covariance[0]) != -1.0 and (q.x, q.y, q.z, q.w) != (0.0, 0.0, 0.0, 0.0):
            self._turns[stamp] = angles_of(_rotation(q))

    def poses(self, stamps: list[int]) -> tuple[list[int], FloatArray]:
        """Return the stamps, and the poses, (n, 5): x, y in m, yaw, roll, pitch in rad; where a heading is known."""
        if self.kind in TRANSFORMS:
            if self._base is None:
                raise InputError(
                    "/tf has no frame of the vehicle, want base_link, or `base` in the calibration"
                )
            return self._tree.poses(self._base)
        found = np.array(self._poses, dtype=np.float64).reshape(-1, 5)
        if self.kind != NAV_FIX or not len(found):
            return stamps, found
        self.std = math.sqrt(float(np.median(self._variances))) if self._variances else 0.0
        self.frame = self.frame or LocalFrame(float(found[0, 0]), float(found[0, 1]))
        found[:, :2] = self.frame.to_xy(found[:, :2])
        times = np.array(stamps, np.int64)
        if self._turns:
            at = np.array(sorted(self._turns), np.int64)
            angles = np.unwrap([self._turns[stamp] for stamp in at.tolist()], axis=0)
            for column in range(3):
                found[:, 2 + column] = np.interp(
                    (times - times[0]) / 1e9, (at - times[0]) / 1e9, angles[:, column]
                )
        else:
            begins = np.r_[True, np.diff(times) > GAP_S * 1e9]
            track = Track(times, (), found[:, :2], False, np.full(len(times), np.nan), begins)
            found[:, 2] = track.headings(found[:, :2])
        known = np.isfinite(found[:, 2])
        return times[known].tolist(), found[known]


class PoseTrack:
    """The poses of a drive, by time."""

    def __init__(self, stamps: IntArray, poses: FloatArray) -> None:
        self.stamps = stamps
        self.poses: FloatArray = np.ascontiguousarray(poses[:, :3])  # (n, 3) x, y, yaw
        self._tilts = _without_slope(stamps, poses[:, 3:])

    def at(self, stamps: IntArray) -> FloatArray:
        """Return the interpolated poses, (n, 3), at times, (n,) ns of Unix time; NaN where there is none."""
        later = np.searchsorted(self.stamps, stamps, "right")
        before, after = np.maximum(later - 1, 0), np.minimum(later, len(self.stamps) - 1)
        late, gap = stamps - self.stamps[before], self.stamps[after] - self.stamps[before]
        share = (late / np.maximum(gap, 1))[:, None]
        one, two = self.poses[before], self.poses[after]
        turn = (two[:, 2:] - one[:, 2:] + math.pi) % (2.0 * math.pi) - math.pi
        found = np.hstack([one[:, :2] + share * (two[:, :2] - one[:, :2]), one[:, 2:] + share * turn])
        found[(late != 0) & ((late < 0) | (gap == 0) | (gap > GAP_S * 1e9))] = np.nan
        return found

    def tilt(self, stamp: int) -> FloatArray:
        """Return roll and pitch against the road, rad: against what they are in the seconds before and after."""
        at = (self.stamps - self.stamps[0]) / 1e9
        return np.array([np.interp((stamp - self.stamps[0]) / 1e9, at, tilt) for tilt in self._tilts.T])


def placed(pose: FloatArray, other: FloatArray) -> FloatArray:
    """Return in the world what is at `other` in the frame of `pose`; both are (..., 3) x, y, yaw."""
    (x, y, yaw), (ahead, left, turn) = np.moveaxis(pose, -1, 0), np.moveaxis(other, -1, 0)
    c, s = np.cos(yaw), np.sin(yaw)
    return np.stack([x + c * ahead - s * left, y + s * ahead + c * left, yaw + turn], axis=-1)


def _without_slope(stamps: IntArray, tilts: FloatArray) -> FloatArray:
    if not np.abs(tilts).max(initial=0.0) > 1e-6:
        return np.zeros_like(tilts)
    low = np.searchsorted(stamps, stamps - round(_SLOPE_S * 1e9))
    high = np.searchsorted(stamps, stamps + round(_SLOPE_S * 1e9), "right")
    total = np.vstack([np.zeros(2), np.cumsum(np.unwrap(tilts, axis=0), axis=0)])
    return np.asarray(np.unwrap(tilts, axis=0) - (total[high] - total[low]) / (high - low)[:, None])
