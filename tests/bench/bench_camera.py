"""Camera throughput: `python -m tests.bench.bench_camera` prints a line a figure."""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from toy_scene import ToyScene, toy_scene

from sim_sensors.camera import PinholeCamera, StereoCamera, camera_pose
from sim_sensors.ground_texture import ground_texture
from sim_sensors.ground_truth import vehicle_boxes
from sim_sensors.light_maps import light_maps
from sim_sensors.projection import ScreenTriangles, project
from sim_sensors.shading import shade
from sim_sensors.vehicles import COARSE, DETAILED, VehicleModel
from sim_sensors.weather import Weather

Row = dict[str, str | float | None]


def camera_rows(frames: int = 30) -> list[Row]:
    """Figures of the camera at 640×480 in a lot of 200 cars.

    Args:
        frames: how many are timed for each figure; the median counts.
    """
    scene, camera, weather = parked_cars(), PinholeCamera.from_field_of_view(), Weather.draw("sunny", 1)
    poses = [camera_pose(-6.0 + 0.4 * i, 0.3, 1.35, -math.pi / 2, -0.04) for i in range(frames)]
    size = (camera.width, camera.height)

    def each(stage: Callable[[int], object]) -> float:
        stage(0)
        times = []
        for i in range(frames):
            start = time.perf_counter()
            stage(i)
            times.append(time.perf_counter() - start)
        return float(np.median(times))

    def projected(i: int) -> ScreenTriangles:
        return project(scene.pool, scene.instances, poses[i], camera.intrinsics, size, camera.coarse_beyond)

    case = f"200 cars, {len(projected(0).corners)} triangles on screen"
    seen = camera.visibility(scene, poses[0])
    maps = light_maps(scene.pool, scene.instances, weather, 0.0, -12.0)
    ground = ground_texture(scene.ground)
    radiance = shade(*seen, poses[0], camera.intrinsics, weather, ground, maps)
    frame = camera.render(scene, poses[0], weather)
    transform = each(projected)
    raster = each(lambda i: camera.visibility(scene, poses[i])) - transform
    stages = {
        "transform": transform,
        "raster": raster,
        "shade": each(lambda i: shade(*seen, poses[0], camera.intrinsics, weather, ground, maps)),
        "expose": each(lambda i: camera.sensor.expose(radiance, i, 1.0)),
        "boxes": each(lambda i: vehicle_boxes(camera, scene, poses[0], frame)),
    }
    rows = [_row("camera " + name, case, 1e3 * seconds, "ms") for name, seconds in stages.items()]
    peer = _opencv_raster(seen[0], size, frames)
    rows[1] = _row(
        "camera raster", case, 1e3 * raster, "ms", "cv2.triangleRasterize", 1e3 * peer, peer / raster
    )
    seconds = each(lambda i: camera.render(scene, poses[i], weather, i))
    rows.append(_row("camera frame", "colour, depth, ids; " + case, 1.0 / seconds, "frames/s"))
    stereo = StereoCamera(camera)
    seconds = each(lambda i: stereo.render_stereo(scene, poses[i], weather, i))
    rows.append(_row("stereo pair", case, 1.0 / seconds, "pairs/s"))
    return rows


def _row(
    part: str,
    case: str,
    value: float,
    unit: str,
    peer: str | None = None,
    peer_value: float | None = None,
    ratio: float | None = None,
) -> Row:
    return {
        "part": part, "case": case, "value": value, "unit": unit,
        "peer": peer, "peer_value": peer_value, "ratio": ratio,
    }  # fmt: skip


def _opencv_raster(triangles: ScreenTriangles, size: tuple[int, int], frames: int) -> float:
    """Seconds that OpenCV's rasteriser takes for the depth of the same triangles, moved in front of its camera."""
    if not hasattr(cv2, "triangleRasterizeDepth"):
        return math.nan
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
    times = []
    for _ in range(frames):
        buffer.fill(1.0)
        start = time.perf_counter()
        cv2.triangleRasterizeDepth(vertices, index, buffer, view, math.pi / 2, 0.05, 1000.0, settings)
        times.append(time.perf_counter() - start)
    return float(np.median(times))


def parked_cars(rows: int = 4, columns: int = 50, models: int = 40) -> ToyScene:
    """Cars nose-in on both sides of a lane along x, no space left free; far ones have coarse meshes."""
    cars = [VehicleModel.from_seed(None, seed) for seed in range(models)]
    meshes = [car.mesh(level) for level in (DETAILED, COARSE) for car in cars]
    coarse = np.tile(np.arange(models, 2 * models), 2)
    generator = np.random.default_rng(0)
    placed = [
        (generator.integers(models), (column - (columns - 1) / 2.0) * 2.55, y, 0.0, math.pi / 2)
        for y in (-6.0, -11.2, 6.0, 11.2)[:rows]
        for column in range(columns)
    ]
    return toy_scene(meshes, placed, range(1, rows * columns + 1), coarse.tolist())


if __name__ == "__main__":
    for line in camera_rows():
        sys.stdout.write(json.dumps(line) + "\n")
