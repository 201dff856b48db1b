"""Benchmark of the simulated sensors against other implementations of the same measurements."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

import cv2
import gymnasium as gym
import numpy as np
import pymunk
from numba import get_num_threads
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from benchmarks.rows import Row, duration, rate, seconds_each
from parkenv.compiled.arrays import FloatArray
from parkenv.compiled.jit import compiled
from parkenv.engine.sensor_sampler import PICTURE_WIDTH
from parkenv.world.lot import PARK
from sim_sensors.camera.ground_texture import ground_texture
from sim_sensors.camera.models import PinholeCamera, StereoCamera, camera_pose
from sim_sensors.camera.projection import ScreenTriangles, project
from sim_sensors.camera.shading import shade
from sim_sensors.camera.shadows import light_maps
from sim_sensors.camera.textures import FAST
from sim_sensors.camera.weather import Weather
from sim_sensors.ground_truth import vehicle_boxes
from sim_sensors.laser.footprints import ScanPlane
from sim_sensors.laser.scanner import LaserScanner
from sim_sensors.rig import WIDE
from sim_sensors.scene import Scene
from sim_sensors.slot_scenes import SlotLot, slot_surroundings

Scans = Callable[[FloatArray], NDArray[Any]]  # maps poses, (n, 3), to ranges, (n, n_beams), m

SLOT_WIDTH, SLOT_LENGTH, MODULE, MARGIN = 2.5, 5.0, 16.0, 6.0
GRID_CELL = 0.05  # cell size of the grid for ray marching, m
_WARM_STEPS = 5
LIT_AHEAD = 12.0  # distance of the light maps' centre in front of the camera, m, when shading is timed alone


def sensors_rows(seed: int = 0, seconds: float = 0.6) -> list[Row]:
    """Return the rows of `python benchmarks/run.py sensors`.

    Args:
        seed: seed of the lots and the noise.
        seconds: duration of each measurement.
    """
    return laser_rows(seed, seconds) + camera_rows(seed, seconds) + search_rows(seed, seconds)


def laser_rows(seed: int = 0, seconds: float = 0.6) -> list[Row]:
    """Measure scans per second of 1081 beams on one core, exact and noisy, in a batch and one by one.

    Batches are compared with batches of the peers, single scans with single scans. Peers simulate no noise.

    Raises:
        AssertionError: a peer measures other ranges than the laser.
    """
    rng = np.random.default_rng(seed)
    laser = LaserScanner()
    plane, draw = walled_lot(rng, 200)
    poses = draw(256)
    peers: dict[str, Scans] = {
        "marching in a grid": marching_scanner(plane, laser),
        "pymunk segment_query_first": pymunk_scanner(plane, laser),
    }
    if find_spec("embreex") is not None:
        peers["Embree"] = embree_scanner(plane, laser)
    exact = np.minimum(laser.scan(plane, poses[:2]), laser.max_range)
    for name, peer in peers.items():
        seen = np.minimum(peer(poses[:2]), laser.max_range)
        off = np.abs(seen - exact) > (2 * GRID_CELL if "grid" in name else 2e-3)
        if off.mean() > 0.05:
            raise AssertionError(f"{name} differs from the laser on {off.mean():.0%} of the beams")

    def batch(scans: Scans, poses: FloatArray) -> float:
        return len(poses) / seconds_each(lambda _: scans(poses), seconds)

    def singly(scans: Scans) -> float:
        return 1.0 / seconds_each(lambda i: scans(poses[i % 32 : i % 32 + 1]), seconds)

    theirs = {name: batch(peer, poses[:16]) for name, peer in peers.items()}
    exact_batch = batch(lambda poses: laser.scan(plane, poses), poses)
    rows = rate("laser", "200 cars, 256 at once", exact_batch, "scans/s", **theirs)
    noisy_batch = batch(lambda poses: laser.scan(plane, poses, rng), poses)
    rows += rate("laser", "200 cars, 256 at once, noise", noisy_batch, "scans/s", **theirs)

    theirs = {name: singly(peer) for name, peer in peers.items()}
    one = singly(lambda poses: laser.scan(plane, poses[0]))
    rows += rate("laser", "200 cars, one by one", one, "scans/s", **theirs)
    noisy_one = singly(lambda poses: laser.scan(plane, poses[0], rng))
    rows += rate("laser", "200 cars, one by one, noise", noisy_one, "scans/s", **theirs)

    large, draw = walled_lot(np.random.default_rng(seed), 10_000, columns=177)
    large_batch = batch(lambda poses: laser.scan(large, poses), draw(256))
    smaller = {"itself at 200 cars": exact_batch}
    return rows + rate("laser", "10,000 cars, 256 at once", large_batch, "scans/s", **smaller)


def camera_rows(seed: int = 0, seconds: float = 0.6) -> list[Row]:
    """Measure 640×480 frames per second, their stages, and stereo pairs, on as many cores as numba uses.

    OpenCV's rasteriser, on one core, draws the depth of the same triangles, which are already culled and projected for
    it; ours starts from the scene.
    """
    scene, weather = parked_cars(seed), Weather.draw("sunny", 1)
    camera = PinholeCamera.from_field_of_view()
    size = (camera.width, camera.height)
    poses = [camera_pose(-6.0 + 0.4 * i, 0.3, 1.35, -math.pi / 2, -0.04) for i in range(30)]
    frame = camera.render(scene, poses[0], weather)
    triangles, visibility = camera.visibility(scene, poses[0])
    ground = ground_texture(scene.ground)
    ahead = poses[0][:2, 3] + LIT_AHEAD * poses[0][:2, 2]
    maps = light_maps(scene.pool, scene.instances, weather, *ahead.tolist())

    def pose(i: int) -> FloatArray:
        return poses[i % len(poses)]

    def transform(i: int) -> object:
        return project(scene.pool, scene.instances, pose(i), camera.intrinsics, size, camera.coarse_from)

    def shaded(_: int) -> NDArray[np.float32]:
        return shade(triangles, visibility, poses[0], camera.intrinsics, weather, ground, maps)

    radiance = shaded(0)
    pair = StereoCamera(camera)
    cores = get_num_threads()
    case = f"200 cars, {len(triangles.corners):,} triangles, {cores} core{'s' if cores > 1 else ''}"

    def each(work: Callable[[int], object]) -> float:
        return seconds_each(work, seconds)

    rows = rate(
        "camera",
        f"colour, depth, ids; {case}",
        1.0 / each(lambda i: camera.render(scene, pose(i), weather, i).ids),
        "frames/s",
    )
    peers = {}
    if hasattr(cv2, "triangleRasterizeDepth"):
        peers["cv2.triangleRasterize"] = 1e3 * each(opencv_rasterizer(triangles, size))
    geometry = each(lambda i: camera.visibility(scene, pose(i)))
    rows += duration("camera", "stages: transform and raster", 1e3 * geometry, "ms", **peers)
    stages: dict[str, Callable[[int], object]] = {
        "stages: of that, transform": transform,
        "stages: shading": shaded,
        "stages: exposure and noise": lambda i: camera.sensor.expose(radiance, i, 1.0),
    }
    for name, stage in stages.items():
        rows += duration("camera", name, 1e3 * each(stage), "ms")
    both = each(lambda i: pair.render_stereo(scene, pose(i), weather, i))
    rows += rate("camera", f"stereo; {case}", 1.0 / both, "pairs/s")
    boxes = each(lambda _: vehicle_boxes(camera, scene, poses[0], frame))
    return rows + duration("camera", "true boxes of a frame", 1e3 * boxes, "ms")


def search_rows(seed: int = 0, seconds: float = 0.6, scenario: str = "campus") -> list[Row]:
    """Measure the steps per second of random drives through sensors, resets included."""
    few = 10.0 * seconds  # an episode begins with a new world, weather and sky
    rows: list[Row] = []
    drives: list[tuple[str, dict[str, Any], str]] = [
        ("SearchSensors", {"observation": "scan"}, "scans alone, up to 4 a step")
    ]
    for width in (PICTURE_WIDTH, WIDE.width):
        size, wide = f"pictures {width} px wide", {"picture_width": width}
        drives += [
            ("SearchSensors", wide, f"scans and {size}, up to 4 a step"),
            ("SearchPerception", wide, f"{size}, seen by the pipeline, up to 2 a step"),
        ]
    for name, options, case in drives:
        env: gym.Env[Any, Any] = gym.make(f"parkenv/{name}-v2", scenario=scenario, **options)
        rows += rate(
            "environment", f"{name}-v2 on {scenario}, {case}", _steps_per_second(env, seed, few), "steps/s"
        )
    return rows


def _steps_per_second(env: gym.Env[Any, Any], seed: int, seconds: float) -> float:
    rng = np.random.default_rng(seed)
    observation, _ = env.reset(seed=seed)
    n, start = -_WARM_STEPS, 0.0
    while n <= 0 or time.perf_counter() < start + seconds:
        if n == 0:
            start = time.perf_counter()
        action = rng.choice(np.flatnonzero(observation["action_mask"][:PARK]))
        observation, _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            observation, _ = env.reset()
        n += 1
    return n / (time.perf_counter() - start)


def parked_cars(seed: int = 0) -> Scene:
    """Build 200 cars in four full rows of 50 along a lane on the x axis."""
    x = 2.55 * (np.arange(50) - 24.5)
    rows = np.array([-11.2, -6.0, 6.0, 11.2])
    xy = np.stack(np.meshgrid(x, rows), -1).reshape(-1, 2)
    yaw = np.where(xy[:, 1] > 0.0, math.pi / 2, -math.pi / 2)
    lane = np.array([[x[0], 0.0], [x[-1], 0.0]])
    lot = SlotLot(xy, yaw, 5.0, 2.55, seed=seed)
    lot = dataclasses.replace(lot, surroundings=slot_surroundings(lot, [lane], seed=seed))
    return lot.scene(np.ones(len(xy), dtype=bool))


def walled_lot(
    rng: np.random.Generator, n_cars: int, columns: int = 25
) -> tuple[ScanPlane, Callable[[int], FloatArray]]:
    """Build a walled lot with 80 % of the slots taken by rectangular cars, parked with realistic deviations.

    Returns:
        The scan plane, and a function that draws poses, (n, 3), in the aisles.
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


def pymunk_scanner(plane: ScanPlane, laser: LaserScanner) -> Scans:
    """Make a scanner with one pymunk segment query per beam."""
    space = pymunk.Space()
    corners, n_corners = plane.footprints
    for polygon, k in zip(corners, n_corners, strict=True):
        space.add(pymunk.Poly(space.static_body, polygon[:k].tolist()))
    for a, b in plane.walls.tolist():
        space.add(pymunk.Segment(space.static_body, a, b, 0.0))
    everything, reach = pymunk.ShapeFilter(), laser.max_range

    def scans(poses: FloatArray) -> FloatArray:
        ranges = np.full((len(poses), laser.n_beams), np.inf)
        for row, (x, y, yaw) in zip(ranges, poses.tolist(), strict=True):
            for i, angle in enumerate((yaw + laser.angles).tolist()):
                end = (x + reach * math.cos(angle), y + reach * math.sin(angle))
                hit = space.segment_query_first((x, y), end, 0.0, everything)
                if hit is not None:
                    row[i] = hit.alpha * reach
        return ranges

    return scans


def embree_scanner(plane: ScanPlane, laser: LaserScanner) -> Scans:
    """Make a scanner that casts all beams of all poses at once against upright faces, with Intel's ray tracer."""
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

    def scans(poses: FloatArray) -> NDArray[np.float32]:
        angles = poses[:, 2:] + laser.angles
        origins = np.zeros((*angles.shape, 3), dtype=np.float32)
        origins[..., :2] = poses[:, None, :2]
        beams = np.zeros_like(origins)
        beams[..., 0], beams[..., 1] = np.cos(angles), np.sin(angles)
        far = scene.run(origins.reshape(-1, 3), beams.reshape(-1, 3), query="DISTANCE")
        far = np.asarray(far, dtype=np.float32).reshape(angles.shape)
        return np.where(far < reach, far, np.float32(np.inf))

    scans.__dict__["mesh"] = mesh  # the scene does not keep the mesh alive
    return scans


@compiled(fastmath=FAST)
def _march(
    clearance: NDArray[np.float32],
    per_cell: float,
    poses: FloatArray,
    cosine: FloatArray,
    sine: FloatArray,
    reach: float,
    ranges: FloatArray,
) -> None:
    """Step along each beam by the distance to the nearest occupied cell until that distance is zero."""
    rows, columns = clearance.shape
    for k in range(len(poses)):
        x, y = poses[k, 0], poses[k, 1]
        for i in range(ranges.shape[1]):
            r = 0.0
            while r < reach:
                row = int((y + r * sine[k, i]) * per_cell)
                column = int((x + r * cosine[k, i]) * per_cell)
                if not (0 <= row < rows and 0 <= column < columns):
                    r = reach
                    break
                step = clearance[row, column]
                if step == 0.0:
                    break
                r += step
            ranges[k, i] = r if r < reach else np.inf


def marching_scanner(plane: ScanPlane, laser: LaserScanner) -> Scans:
    """Make a scanner by ray marching in the distance transform of an occupancy grid, as in the f1tenth simulator."""
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
    # Single precision halves the memory traffic of look-ups.
    clearance = np.asarray(distance_transform_edt(~taken) * GRID_CELL, dtype=np.float32)

    def scans(poses: FloatArray) -> FloatArray:
        angles = poses[:, 2:] + laser.angles
        ranges = np.empty(angles.shape)
        _march(clearance, 1.0 / GRID_CELL, poses, np.cos(angles), np.sin(angles), laser.max_range, ranges)
        return ranges

    return scans


def opencv_rasterizer(triangles: ScreenTriangles, size: tuple[int, int]) -> Callable[[int], object]:
    """Return a function that draws the depth of the same triangles with OpenCV, transformed for its camera."""
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
