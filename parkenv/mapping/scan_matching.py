"""Localisation by scan matching: drifting odometry, corrected by what the scans see of parked cars and of the lot.

The thesis's robot had laser-based SLAM (T §5). This does with less, since the lot is known: two least-squares fits of
points to lines for each capture, each begun at what was estimated before, and weighted by how sure that was.

1. *Against the drive so far.* The scan's points are fitted to the points of the last metres driven. Parked cars are
   landmarks here, wherever they stand; no map is needed. This turns odometry into a motion that hardly drifts.
2. *Against the lot file.* The points are fitted to walls and to the outline that a car of usual size has in the middle
   of its slot. Each line is a poor landmark (nobody parks in the middle), so a fit moves the pose a little only, but
   the average over dozens of cars keeps the pose in the lot for as long as the drive takes. The pose is that of an
   iterated extended Kalman filter, whose motion comes from the first fit.

Only outlines that face the car count, as it sees no others. Points far from all lines, such as those on moving cars,
count little or not at all. With fewer than `LEAST_POINTS` the pose follows the odometry.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.compiled.jit import compiled
from parkenv.errors import require_one_of
from parkenv.files.known_names import LOCALISERS
from parkenv.mapping.odometry import between, moved
from parkenv.perception.range_scan import RangeScan
from parkenv.world.lot import Mouth, ParkingLot

REACH = 25.0  # m, farthest points used
LEAST_POINTS = 20  # of a scan that is matched
SCAN_CELL, SUBMAP_CELL = 0.25, 0.1  # m; one point of each stays, of a scan and of the points so far
SUBMAP_CAPTURES = 30  # captures whose points a scan is fitted to
NEIGHBORS = 5  # points that make a line
POINT_GATE = 0.5  # m, farthest point of a line
POINT_SD = 0.1  # m, of a point beside a line of the drive so far, with what neighbours' errors have in common
ODOMETRY_SD = (0.05, 0.1, 0.02)  # of a step of odometry: m, m per m, and rad
START_SD = (0.5, 0.5, math.radians(2.0))  # of the first pose: m, m, rad

USUAL_CAR = (4.4, 1.8)  # m, median length and width of cars
END_SD, SIDE_SD, WALL_SD = 0.35, 0.15, 0.3  # m, of ends and sides of cars, and of walls, about their lines
BEYOND = 0.3  # m that points may lie beyond the ends of a line
GATE = 3.0  # standard deviations from a line to the farthest point that may be of it
WHOLE = 4.0  # points from which a line counts fully
REPEATED = 20.0  # captures that see the same car, whose error they share

MOST_ITERATIONS = 8
SMALL = 1e-3  # m and rad; a fit ends with a change below it


class _Fit(NamedTuple):
    """What points are fitted to: which points, how far each is beside its line, m, the line's normal and the weight."""

    points: IntArray
    residual: FloatArray
    normal: FloatArray
    weight: FloatArray


# A pose, or what `PerceptionPipeline.process` asks for it.
Located = FloatArray | Callable[[Sequence[RangeScan]], FloatArray]


def make_locate(name: str, lot: ParkingLot | None) -> Callable[[FloatArray], Located]:
    """Return a function that is called with the odometry of each capture of a drive, in order."""
    require_one_of("localise", name, LOCALISERS)
    if name == "none":
        return lambda odometry: odometry
    matcher = ScanMatcher(lot)
    return lambda odometry: partial(matcher.locate, odometry)


class ScanMatcher:
    """Follows a car through one drive, past the walls and slots of a lot, if there is one."""

    def __init__(self, lot: ParkingLot | None) -> None:
        self._edges = _NO_EDGES if lot is None else _lot_edges(lot)
        self._recent: list[FloatArray] = []
        self._odometry: FloatArray | None = None
        # Where the car is by the first fit alone, and by both with its covariance.
        self._drive, self._pose, self._covariance = np.zeros(3), np.zeros(3), np.diag(np.square(START_SD))

    def locate(self, odometry: FloatArray, scans: Sequence[RangeScan]) -> FloatArray:
        """Return the pose of the vehicle, (3,) x, y in m and yaw in rad, lot frame.

        Only changes of the odometry count, except for the first one. The scans are in the vehicle's frame.
        """
        points = np.concatenate([np.empty((0, 2)), *(_points(scan) for scan in scans)])
        sparse = _thinned(points, SCAN_CELL)
        if len(sparse) < LEAST_POINTS:
            points = sparse = np.empty((0, 2))
        if self._odometry is None:
            self._drive, self._pose = odometry.copy(), odometry.copy()
        else:
            step = between(self._odometry, odometry)
            before = self._drive
            self._drive, spread = self._along_drive(moved(before, step), step, sparse)
            self._advance(between(before, self._drive), spread)
        self._odometry = odometry.copy()
        near = _near_edges(self._edges, self._pose)
        self._pose, information = _fitted(
            self._pose, np.linalg.inv(self._covariance), sparse, lambda ends, at: _to_edges(ends, at, near)
        )
        self._covariance = np.linalg.inv(information)
        self._recent = [
            *self._recent[1 - SUBMAP_CAPTURES :],
            _placed(_thinned(points, SUBMAP_CELL), self._drive),
        ]
        return self._pose.copy()

    def _along_drive(
        self, guess: FloatArray, step: FloatArray, points: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the pose in the frame of the first fit, and the covariance of the motion in the vehicle's frame."""
        fixed, per_metre, turn = ODOMETRY_SD
        sd = fixed + per_metre * math.hypot(step[0], step[1])
        submap = _thinned(np.concatenate(self._recent), SUBMAP_CELL)
        tree = cKDTree(submap) if len(submap) else None
        pose, information = _fitted(
            guess, np.diag([sd**-2, sd**-2, turn**-2]), points, lambda ends, _: _to_points(ends, submap, tree)
        )
        back = _rotation(-guess[2])
        return pose, back @ np.linalg.inv(information) @ back.T

    def _advance(self, motion: FloatArray, spread: FloatArray) -> None:
        """Move the pose, and add the motion's covariance, (3, 3) in the vehicle's frame, to its own."""
        turned, after = _rotation(self._pose[2]), moved(self._pose, motion)
        x, y = after[:2] - self._pose[:2]
        carried = np.array([[1.0, 0.0, -y], [0.0, 1.0, x], [0.0, 0.0, 1.0]])
        self._covariance = carried @ self._covariance @ carried.T + turned @ spread @ turned.T
        self._pose = after


def _fitted(
    prior: FloatArray,
    information: FloatArray,
    points: FloatArray,
    lines: Callable[[FloatArray, FloatArray], _Fit],
) -> tuple[FloatArray, FloatArray]:
    """Fit points, (n, 2) m in the vehicle's frame, to lines by Gauss-Newton steps from a pose on.

    Return the pose, and its inverse covariance; `information` is that of the first one. `lines` returns the lines near
    points of a vehicle at a pose.
    """
    pose, total = prior, information
    for _ in range(MOST_ITERATIONS if len(points) else 0):
        ends = _placed(points, pose)
        fit = lines(ends, pose)
        arm = ends[fit.points] - pose[:2]
        n = fit.normal
        slope = np.column_stack([n, n[:, 1] * arm[:, 0] - n[:, 0] * arm[:, 1]])
        weighted = slope * fit.weight[:, None]
        total = information + weighted.T @ slope
        change = np.linalg.solve(total, information @ (prior - pose) - weighted.T @ fit.residual)
        pose = pose + change
        if np.abs(change).max() < SMALL:
            break
    return pose, total


def _to_points(ends: FloatArray, submap: FloatArray, tree: cKDTree | None) -> _Fit:
    if tree is None:
        return _Fit(np.empty(0, np.int64), np.empty(0), np.empty((0, 2)), np.empty(0))
    distance, index = map(np.asarray, tree.query(ends, k=NEIGHBORS, distance_upper_bound=POINT_GATE))
    enough = np.isfinite(distance).sum(axis=1) >= 3
    there = np.isfinite(distance[enough])[..., None]
    neighbors = submap[np.where(there[..., 0], index[enough], 0)]
    middle = (neighbors * there).sum(axis=1) / there.sum(axis=1)
    away = (neighbors - middle[:, None]) * there
    xx, xy, yy = ((away[..., i] * away[..., j]).sum(axis=1) for i, j in ((0, 0), (0, 1), (1, 1)))
    # The principal axes of the neighbours: a line is ten times as long as it is wide.
    spread = np.hypot(0.5 * (xx - yy), xy)
    straight = 0.5 * (xx + yy) - spread < 0.01 * (0.5 * (xx + yy) + spread)
    along = 0.5 * np.arctan2(2.0 * xy, xx - yy)[straight]
    normal = np.column_stack([-np.sin(along), np.cos(along)])
    points = np.flatnonzero(enough)[straight]
    residual = ((ends[points] - middle[straight]) * normal).sum(axis=1)
    return _Fit(points, residual, normal, _robust(residual, POINT_SD) / POINT_SD**2)


def _robust(residual: FloatArray, sd: FloatArray | float) -> FloatArray:
    return np.asarray((1.0 + (residual / (2.0 * sd)) ** 2) ** -2)


class _Edges(NamedTuple):
    start: FloatArray  # (n, 2) m
    along: FloatArray  # (n, 2) unit vectors
    normal: FloatArray  # (n, 2) unit vectors
    length: FloatArray  # (n,) m
    sd: FloatArray  # (n,) m
    two_sided: NDArray[np.bool_]  # (n,)


_NO_EDGES = _Edges(
    np.zeros((0, 2)), np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0), np.zeros(0), np.zeros(0, np.bool_)
)


def _lot_edges(lot: ParkingLot) -> _Edges:
    kerbside = lot.slot_mouth != Mouth.REAR
    length = np.where(kerbside, np.minimum(USUAL_CAR[0], lot.slot_length), USUAL_CAR[0])
    half = 0.5 * np.column_stack([length, np.minimum(USUAL_CAR[1], lot.slot_width)])
    ahead = np.column_stack([np.cos(lot.slot_yaw), np.sin(lot.slot_yaw)])
    left = np.column_stack([-ahead[:, 1], ahead[:, 0]])
    # Counter-clockwise: rear, right side, front, left side have their outside on the right.
    corners = [
        lot.slot_xy + i * half[:, :1] * ahead + j * half[:, 1:] * left
        for i, j in ((-1, 1), (-1, -1), (1, -1), (1, 1), (-1, 1))
    ]
    lines = [*pairwise(corners), *((wall[:-1], wall[1:]) for wall in lot.walls)]
    start, end = (np.concatenate([line[k] for line in lines]) for k in (0, 1))
    spreads = np.repeat(
        [END_SD, SIDE_SD, END_SD, SIDE_SD, *[WALL_SD] * len(lot.walls)], [len(line[0]) for line in lines]
    )
    size = np.hypot(*(end - start).T)
    kept = size > 0.0
    start, along, size = start[kept], (end - start)[kept] / size[kept, None], size[kept]
    normal = np.column_stack([along[:, 1], -along[:, 0]])
    two_sided = (np.arange(len(kept)) >= 4 * lot.n_slots)[kept]
    return _Edges(start, along, normal, size, spreads[kept], two_sided)


def _near_edges(edges: _Edges, pose: FloatArray) -> _Edges:
    away = pose[:2] - edges.start
    station = np.clip((away * edges.along).sum(axis=1), 0.0, edges.length)
    near = np.hypot(*(away - station[:, None] * edges.along).T) < REACH + 1.0
    return _Edges(*(column[near] for column in edges))


def _to_edges(ends: FloatArray, pose: FloatArray, edges: _Edges) -> _Fit:
    edge, residual = _matched_edges(ends, pose[0], pose[1], edges)
    points = np.flatnonzero(edge >= 0)
    edge, residual = edge[points], residual[points]
    sd = edges.sd[edge]
    # However many points a line has, they share the error of where it is, and so do captures that see the same car.
    count = np.bincount(edge, minlength=len(edges.sd))[edge]
    share = np.minimum(count / WHOLE, 1.0) / (count * REPEATED)
    return _Fit(points, residual, edges.normal[edge], _robust(residual, sd) * share / sd**2)


@compiled
def _matched_edges(ends: FloatArray, x: float, y: float, edges: _Edges) -> tuple[IntArray, FloatArray]:
    """Return the edge that each point most probably is of, (n,), -1 for none, and how far beside it the point is, m."""
    matched = np.full(len(ends), -1, dtype=np.int64)
    residual = np.zeros(len(ends))
    best = np.full(len(ends), GATE)
    start, along, normal, length, sd, two_sided = edges
    for e in range(len(sd)):
        side = (x - start[e, 0]) * normal[e, 0] + (y - start[e, 1]) * normal[e, 1]
        if side <= 0.0 and not two_sided[e]:
            continue
        for i in range(len(ends)):
            dx, dy = ends[i, 0] - start[e, 0], ends[i, 1] - start[e, 1]
            off = dx * normal[e, 0] + dy * normal[e, 1]
            if abs(off) >= best[i] * sd[e]:
                continue
            station = dx * along[e, 0] + dy * along[e, 1]
            if -BEYOND <= station <= length[e] + BEYOND:
                best[i] = abs(off) / sd[e]
                matched[i], residual[i] = e, off
    return matched, residual


def _points(scan: RangeScan) -> FloatArray:
    with np.errstate(invalid="ignore"):
        return scan.points(np.flatnonzero(scan.distance < min(REACH, scan.max_range)))


def _thinned(points: FloatArray, cell: float) -> FloatArray:
    if not len(points):
        return points
    cells = np.floor(points / cell).astype(np.int64)
    cells -= cells.min(axis=0)
    _, first = np.unique(cells[:, 0] * (cells[:, 1].max() + 1) + cells[:, 1], return_index=True)
    return points[np.sort(first)]


def _placed(points: FloatArray, pose: FloatArray) -> FloatArray:
    return np.asarray(points @ _rotation(pose[2])[:2, :2].T + pose[:2])


def _rotation(angle: float) -> FloatArray:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
