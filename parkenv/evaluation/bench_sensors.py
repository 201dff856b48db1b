"""How fast the simulated sensors are, beside other ways to make the same measurements."""

from __future__ import annotations

import math
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

import cv2
import numpy as np
import pymunk
from numba import njit
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from parkenv.evaluation.bench_rows import BenchRow, duration, rate, seconds_each
from sim_sensors.camera import PinholeCamera, StereoCamera, camera_pose
from sim_sensors.footprints import ScanPlane
from sim_sensors.ground_truth import vehicle_boxes
from sim_sensors.laser import LaserScanner
from sim_sensors.projection import ScreenTriangles
from sim_sensors.scene import Scene
from sim_sensors.slot_scenes import scene_of_slots
from sim_sensors.weather import Weather

FloatArray = NDArray[np.float64]
Scan = Callable[[FloatArray], NDArray[Any]]

SLOT_WIDTH, SLOT_LENGTH, MODULE, MARGIN = 2.5, 5.0, 16.0, 6.0
GRID_CELL = 0.05
"""Cell, m, of the grid that the beam marcher walks."""


def sensor_rows(seed: int = 0, seconds: float = 0.6) -> list[BenchRow]:
    """Rows of `parkenv bench sensors`.

    Args:
        seed: of the lots and the noise.
        seconds: how long each figure is measured.
    """
    return laser_rows(seed, seconds) + camera_rows(seed, seconds)


def laser_rows(seed: int = 0, seconds: float = 0.6) -> list[BenchRow]:
    """Scans a second of 1081 beams on one core, exact and noisy, in a batch and one by one.

    Raises:
        AssertionError: a peer does not see what the laser sees.
    """
    rng = np.random.default_rng(seed)
    laser = LaserScanner()
    plane, draw = walled_lot(rng, 200)
    poses = draw(256)
    peers: dict[str, Scan] = {
        "marching in a grid": marching_scanner(plane, laser),
        "pymunk segment_query_first": pymunk_scanner(plane, laser),
    }
    if find_spec("embreex") is not None:
        peers["Embree"] = embree_scanner(plane, laser)
    exact = np.minimum(laser.scan_batch(plane, poses[:2]), laser.max_range)
    for name, peer in peers.items():
        seen = np.minimum([peer(pose) for pose in poses[:2]], laser.max_range)
        off = np.abs(seen - exact) > (2 * GRID_CELL if "grid" in name else 2e-3)
        if off.mean() > 0.05:
            raise AssertionError(f"{name} differs from the laser on {off.mean():.0%} of the beams")

    def singly(scan: Scan) -> float:
        return 1.0 / seconds_each(lambda i: scan(poses[i % 32]), seconds)

    theirs = {name: singly(peer) for name, peer in peers.items()}

    def batch(plane: ScanPlane, poses: FloatArray, rng: np.random.Generator | None = None) -> float:
        return len(poses) / seconds_each(lambda _: laser.scan_batch(plane, poses, rng), seconds)

    exact_batch = batch(plane, poses)
    rows = rate("laser", "200 cars, 256 at once", exact_batch, "scans/s", **theirs)
    rows += rate("laser", "200 cars, 256 at once, noise", batch(plane, poses, rng), "scans/s", **theirs)
    one = singly(lambda pose: laser.scan(plane, pose))
    rows += rate("laser", "200 cars, one by one", one, "scans/s", **theirs)
    one = singly(lambda pose: laser.scan(plane, pose, rng))
    rows += rate("laser", "200 cars, one by one, noise", one, "scans/s", **theirs)
    large, draw = walled_lot(np.random.default_rng(seed), 10_000, columns=177)
    return rows + rate(
        "laser",
        "10,000 cars, 256 at once",
        batch(large, draw(256)),
        "scans/s",
        **{"itself at 200 cars": exact_batch},
    )


def camera_rows(seed: int = 0, seconds: float = 0.6) -> list[BenchRow]:
    """Frames of 640×480 a second, on all cores. OpenCV's rasteriser draws the same triangles, already transformed."""
    scene, weather = parked_cars(seed), Weather.draw("sunny", 1)
    camera = PinholeCamera.from_field_of_view()
    poses = [camera_pose(-6.0 + 0.4 * i, 0.3, 1.35, -math.pi / 2, -0.04) for i in range(30)]
    triangles, _ = camera.visibility(scene, poses[0])
    case = f"200 cars, {len(triangles.corners):,} triangles"
    frame = camera.render(scene, poses[0], weather)
    geometry = seconds_each(lambda i: camera.visibility(scene, poses[i % 30]), seconds)
    peers = {}
    if hasattr(cv2, "triangleRasterizeDepth"):
        draw = opencv_rasterizer(triangles, (camera.width, camera.height))
        peers["cv2.triangleRasterize"] = 1e3 * seconds_each(draw, seconds)
    rows = duration("camera", f"transform, raster; {case}", 1e3 * geometry, "ms", **peers)
    whole = seconds_each(lambda i: camera.render(scene, poses[i % 30], weather, i), seconds)
    rows += rate("camera", f"colour, depth, ids; {case}", 1.0 / whole, "frames/s")
    pair = StereoCamera(camera)
    both = seconds_each(lambda i: pair.render_stereo(scene, poses[i % 30], weather, i), seconds)
    rows += rate("camera", f"stereo; {case}", 1.0 / both, "pairs/s")
    boxes = seconds_each(lambda _: vehicle_boxes(camera, scene, poses[0], frame), seconds)
    return rows + duration("camera", "true boxes of a frame", 1e3 * boxes, "ms")


def parked_cars(seed: int = 0) -> Scene:
    """200 cars in four full rows of 50 along a lane on the x axis."""
    x = 2.55 * (np.arange(50) - 24.5)
    rows = np.array([-11.2, -6.0, 6.0, 11.2])
    xy = np.stack(np.meshgrid(x, rows), -1).reshape(-1, 2)
    yaw = np.where(xy[:, 1] > 0.0, math.pi / 2, -math.pi / 2)
    lane = np.array([[x[0], 0.0], [x[-1], 0.0]])
    return scene_of_slots(xy, yaw, 5.0, 2.55, np.ones(len(xy), dtype=bool), lanes=[lane], seed=seed)


def walled_lot(
    rng: np.random.Generator, n_cars: int, columns: int = 25
) -> tuple[ScanPlane, Callable[[int], FloatArray]]:
    """A walled lot, four slots in five taken by cars of four corners, parked as people do.

    Returns:
        What a laser meets, and a function that draws poses, (n, 3), in the aisles.
    """
    modules = math.ceil(n_cars * 1.25 / (2 * columns))
    size = np.array([2 * MARGIN + SLOT_WIDTH * columns, 2 * MARGIN + MODULE * modules])
    x = MARGIN + SLOT_WIDTH * (np.arange(columns) + 0.5)
    y = np.concatenate([MARGIN + MODULE * m + np.array([2.5, 13.5]) for m in range(modules)])
    slots = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    taken = slots[rng.permutation(len(slots))[:n_cars]]
    centre = taken + rng.normal(0.0, [0.1, 0.15], (n_cars, 2))
    yaw = math.pi / 2 + rng.normal(0.0, math.radians(2.0), n_cars)
    half = np.column_stack([rng.normal(2.25, 0.12, n_cars), rng.normal(0.9, 0.03, n_cars)])
    corners = half[:, None] * np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
    turn = np.stack([np.cos(yaw), np.sin(yaw), -np.sin(yaw), np.cos(yaw)], -1).reshape(-1, 2, 2)
    room = size * np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    plane = ScanPlane(corners @ turn + centre[:, None], walls=np.stack([room, np.roll(room, -1, 0)], 1))

    def poses(n: int) -> FloatArray:
        aisle = rng.integers(0, modules, n) * MODULE + MARGIN + 8.0 + rng.uniform(-1.2, 1.2, n)
        along = rng.uniform(3.0, size[0] - 3.0, n)
        return np.column_stack([along, aisle, rng.choice([0.0, math.pi], n) + rng.normal(0.0, 0.2, n)])

    return plane, poses


def pymunk_scanner(plane: ScanPlane, laser: LaserScanner) -> Scan:
    """A segment query a beam."""
    space = pymunk.Space()
    corners, n_corners = plane.footprints
    for polygon, k in zip(corners, n_corners, strict=True):
        space.add(pymunk.Poly(space.static_body, polygon[:k].tolist()))
    for a, b in plane.walls.tolist():
        space.add(pymunk.Segment(space.static_body, a, b, 0.0))
    everything, reach = pymunk.ShapeFilter(), laser.max_range

    def scan(pose: FloatArray) -> FloatArray:
        x, y, yaw = map(float, pose)
        ranges = np.full(laser.n_beams, np.inf)
        for i, angle in enumerate((yaw + laser.angles).tolist()):
            end = (x + reach * math.cos(angle), y + reach * math.sin(angle))
            hit = space.segment_query_first((x, y), end, 0.0, everything)
            if hit is not None:
                ranges[i] = hit.alpha * reach
        return ranges

    return scan


def embree_scanner(plane: ScanPlane, laser: LaserScanner) -> Scan:
    """All beams at once against upright faces, by Intel's ray tracer."""
    import embreex.mesh_construction as meshes
    from embreex.rtcore_scene import EmbreeScene

    corners, n_corners = plane.footprints
    ends = [
        np.stack([c[:k], np.roll(c[:k], -1, axis=0)], axis=1) for c, k in zip(corners, n_corners, strict=True)
    ]
    side = np.concatenate([*ends, plane.walls])
    low, high = np.full((len(side), 1), -1.0), np.full((len(side), 1), 1.0)
    a0, b0, b1, a1 = (np.hstack([side[:, end], z]) for end, z in ((0, low), (1, low), (1, high), (0, high)))
    triangles = np.concatenate([np.stack([a0, b0, b1], axis=1), np.stack([a0, b1, a1], axis=1)])
    scene = EmbreeScene()
    mesh = meshes.TriangleMesh(scene, triangles.astype(np.float32))
    reach = np.float32(laser.max_range)

    def scan(pose: FloatArray) -> NDArray[np.float32]:
        angle = pose[2] + laser.angles
        origins = np.tile(np.array([pose[0], pose[1], 0.0], dtype=np.float32), (laser.n_beams, 1))
        beams = np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1).astype(np.float32)
        far = np.asarray(scene.run(origins, beams, query="DISTANCE"), dtype=np.float32)
        return np.where(far < reach, far, np.float32(np.inf))

    scan.__dict__["mesh"] = mesh  # the scene does not keep it alive
    return scan


@njit(cache=True)
def _march(
    clearance: FloatArray,
    cell: float,
    x: float,
    y: float,
    cosine: FloatArray,
    sine: FloatArray,
    reach: float,
    ranges: FloatArray,
) -> None:
    """Step along each beam by the distance to the nearest taken cell until there is none to step."""
    rows, columns = clearance.shape
    for i in range(len(ranges)):
        r = 0.0
        while r < reach:
            row, column = int((y + r * sine[i]) / cell), int((x + r * cosine[i]) / cell)
            if not (0 <= row < rows and 0 <= column < columns):
                r = reach
                break
            step = clearance[row, column]
            if step == 0.0:
                break
            r += step
        ranges[i] = r if r < reach else np.inf


def marching_scanner(plane: ScanPlane, laser: LaserScanner) -> Scan:
    """Ray marching in the distance transform of an occupancy grid, the method of the f1tenth simulator."""
    corners, n_corners = plane.footprints
    width, height = plane.walls.reshape(-1, 2).max(0)
    taken = np.zeros((int(height / GRID_CELL) + 1, int(width / GRID_CELL) + 1), dtype=np.bool_)
    taken[[0, -1]] = taken[:, [0, -1]] = True
    for polygon, k in zip(corners, n_corners, strict=True):
        (left, low), (right, high) = (
            np.floor(f(polygon[:k], 0) / GRID_CELL).astype(int) for f in (np.min, np.max)
        )
        column, row = np.meshgrid(np.arange(left, right + 1), np.arange(low, high + 1))
        away = ((np.stack([column, row], -1) + 0.5) * GRID_CELL)[:, :, None] - polygon[:k]
        edge = np.roll(polygon[:k], -1, 0) - polygon[:k]
        taken[row, column] |= (edge[:, 0] * away[..., 1] - edge[:, 1] * away[..., 0] > 0.0).all(-1)
    clearance = np.asarray(distance_transform_edt(~taken), dtype=np.float64) * GRID_CELL
    ranges = np.empty(laser.n_beams)

    def scan(pose: FloatArray) -> FloatArray:
        angle = pose[2] + laser.angles
        _march(clearance, GRID_CELL, pose[0], pose[1], np.cos(angle), np.sin(angle), laser.max_range, ranges)
        return ranges.copy()

    return scan


def opencv_rasterizer(triangles: ScreenTriangles, size: tuple[int, int]) -> Callable[[int], object]:
    """Draws the depth of the same triangles with OpenCV, moved in front of its own camera."""
    corners = triangles.corners.reshape(-1, 3, 2).astype(np.float64)
    plane = triangles.inverse_depth[:, None, :]
    depth = 1.0 / np.maximum((corners * plane[..., :2]).sum(axis=2) + plane[..., 2], 1e-3)
    focal = size[1] / 2.0
    x = (corners[..., 0] - size[0] / 2.0) / focal * depth
    y = (corners[..., 1] - size[1] / 2.0) / focal * depth
    vertices = np.stack([x, -y, -depth], axis=2).reshape(-1, 3).astype(np.float32)
    index = np.arange(len(vertices), dtype=np.int32).reshape(-1, 3)
    view = np.eye(4, dtype=np.float32)
    buffer = np.empty((size[1], size[0]), dtype=np.float32)
    settings = cv2.TriangleRasterizeSettings()
    settings.setCullingMode(cv2.RASTERIZE_CULLING_NONE)

    def draw(_: int) -> None:
        buffer.fill(1.0)
        cv2.triangleRasterizeDepth(vertices, index, buffer, view, math.pi / 2, 0.05, 1000.0, settings)

    return draw
