"""Pinhole and stereo cameras: render a scene from a pose, in given weather, to image, depth and instance ids."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import Float32Array, FloatArray
from parkenv.compiled.jit import compiled
from sim_sensors.camera.ground_texture import GroundTexture, ground_texture
from sim_sensors.camera.image_sensor import ImageSensor
from sim_sensors.camera.light_maps import LightMaps, bounding_boxes
from sim_sensors.camera.projection import ScreenTriangles, project
from sim_sensors.camera.rasterizer import FAR, Visibility, rasterize
from sim_sensors.camera.shading import shade
from sim_sensors.camera.shadows import light_maps
from sim_sensors.camera.sky import packed_sky, sky_of_view
from sim_sensors.camera.weather import Weather
from sim_sensors.errors import SensorError, require_numbers
from sim_sensors.mesh import Ground, Instances, MeshPool

_FOCAL = 520.0  # px, focal length to which `coarse_beyond` refers
_AHEAD = 12.0  # m ahead of the camera: the middle of the area that is lit in detail


class Drawable(Protocol):
    """A scene that a camera can render.

    The arrays must not change: shadows and textures made from them are cached as long as the objects exist. To change
    the scene make new `Instances`; pool and ground can be shared.
    """

    @property
    def pool(self) -> MeshPool:
        """The meshes."""

    @property
    def instances(self) -> Instances:
        """Their poses."""

    @property
    def ground(self) -> Ground:
        """The plane below."""


@dataclass(frozen=True, eq=False)
class Frame:
    """An image and its ground truth.

    Attributes:
        image: (h, w, 3) uint8, RGB.
        depth: (h, w) float32, m along the optical axis, of the first *opaque* surface at the pixel's centre: stereo
            cameras and lidar measure through glass, too. inf for the sky.
        glass_depth: (h, w) float32, m along the optical axis, of the nearest pane in front of that surface; inf where
            there is none.
        ids: (h, w) int32, `Instances.ids` of the first surface, glass included; 0 for scenery, ground and sky. A
            vehicle's pixels include its windows.
    """

    image: NDArray[np.uint8]
    depth: Float32Array
    glass_depth: Float32Array
    ids: NDArray[np.int32]


class _RenderedFrame(Frame):
    def __init__(
        self,
        image: NDArray[np.uint8],
        visibility: Visibility,
        instance: NDArray[np.int32],
        ids: NDArray[np.int32],
    ) -> None:
        self.__dict__.update(image=image, _seen=(visibility, instance, ids))

    def __getattr__(self, name: str) -> Any:
        # The truth is computed when it is first asked for.
        if name not in ("depth", "glass_depth", "ids"):
            raise AttributeError(name)
        truth = _geometry(*self.__dict__["_seen"])
        self.__dict__.update(zip(("depth", "glass_depth", "ids"), truth, strict=True))
        self.__dict__.pop("_seen", None)
        return self.__dict__[name]


@dataclass(frozen=True)
class PinholeCamera:
    """A pinhole camera without distortion. Pixel (row, column) has its centre at (column + 0.5, row + 0.5).

    Args:
        width, height: px.
        fx, fy: px, focal lengths.
        cx, cy: px, principal point.
        sensor: exposure, blur and noise.
        coarse_beyond: m, at a focal length of 520 px; objects that are smaller in the image than from there are drawn
            with coarse meshes if the pool has them.

    Raises:
        SensorError: a size is below 1, a focal length is not positive, or a value is not finite.
    """

    width: int = 640
    height: int = 480
    fx: float = 520.0
    fy: float = 520.0
    cx: float = 320.0
    cy: float = 240.0
    sensor: ImageSensor = field(default_factory=ImageSensor)
    coarse_beyond: float = 20.0

    def __post_init__(self) -> None:
        require_numbers(self, "width height", least=1)
        require_numbers(self, "fx fy", above=0.0)
        require_numbers(self, "cx cy")
        if not self.coarse_beyond >= 0.0:
            raise SensorError(f"coarse_beyond is {self.coarse_beyond} m, want at least 0")

    @classmethod
    def from_field_of_view(
        cls, width: int = 640, height: int = 480, horizontal: float = 1.1
    ) -> PinholeCamera:
        """Make a camera with square pixels and its principal point in the image centre.

        Args:
            width: px.
            height: px.
            horizontal: rad, field of view across the width, above 0 and below π.
        """
        if not 0.0 < horizontal < math.pi:
            raise SensorError(f"field of view is {horizontal} rad, want above 0 and below π")
        focal = width / 2.0 / math.tan(horizontal / 2.0)
        return cls(width, height, focal, focal, width / 2.0, height / 2.0)

    def resized(self, width: int) -> PinholeCamera:
        """Return the camera with pictures of another width, px, and the same field of view and proportions.

        Raises:
            SensorError: a width below 1.
        """
        scale = width / self.width
        height = max(1, round(self.height * scale))
        numbers = {name: getattr(self, name) * scale for name in ("fx", "fy", "cx", "cy")}
        return replace(self, width=width, height=height, **numbers)

    @property
    def intrinsics(self) -> tuple[float, float, float, float]:
        """fx, fy, cx, cy in px."""
        return self.fx, self.fy, self.cx, self.cy

    @property
    def coarse_from(self) -> float:
        """m; farther objects are drawn with coarse meshes."""
        return self.coarse_beyond * max(self.fx, self.fy) / _FOCAL

    @property
    def matrix(self) -> FloatArray:
        """(3, 3) float64, from the camera frame to homogeneous pixels."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def render(
        self, scene: Drawable, pose: FloatArray, weather: Weather | None = None, seed: int = 0
    ) -> Frame:
        """Render an image. Equal arguments give equal bytes, on any number of threads.

        The first image of a ground draws its texture (about a second); the first call after an installation compiles
        the code.

        Args:
            scene: pool, instances and ground.
            pose: (4, 4) float64, camera (x right, y down, z forward) to world; see `camera_pose`.
            weather: the light; the default is a sunny day.
            seed: seed of the sensor's noise.

        Raises:
            SensorError: the pose is not finite, not a rotation, below the ground, or inside a vehicle.
        """
        return self._exposed(scene, pose, weather or Weather(), seed, None)[0]

    def _exposed(
        self, scene: Drawable, pose: FloatArray, weather: Weather, seed: int, gain: float | None
    ) -> tuple[Frame, float]:
        pose = checked_pose(scene, pose)
        triangles, seen = self.visibility(scene, pose)
        texture, maps = _surroundings(scene, scene.instances, pose, weather)
        radiance = shade(triangles, seen, pose, self.intrinsics, weather, texture, maps)
        gain = self.sensor.gain(radiance) if gain is None else gain
        image = self.sensor.expose(radiance, seed, gain, rain=weather.rain)
        return _RenderedFrame(image, seen, triangles.instance, scene.instances.ids), gain

    def prepare(self, scene: Drawable, pose: FloatArray, weather: Weather | None = None) -> None:
        """Draw and keep what pictures from nearby poses share: texture of the ground, shadows and sky."""
        weather = weather or Weather()
        pose = checked_pose(scene, pose)
        # The shadows of what moves are drawn with each picture.
        still = scene.instances if scene.instances.still is None else scene.instances.still
        _surroundings(scene, still, pose, weather)
        sky_of_view(weather, pose[:3, :3], self.intrinsics, (self.width, self.height))
        packed_sky(weather)

    def visibility(self, scene: Drawable, pose: FloatArray) -> tuple[ScreenTriangles, Visibility]:
        """Return the visible triangle of each pixel: geometry without light."""
        size = (self.width, self.height)
        triangles = project(scene.pool, scene.instances, pose, self.intrinsics, size, self.coarse_from)
        # A ray meets the ground z = 0 where its z component times the depth equals the camera's height.
        down = -pose[2, :3] / pose[2, 3]
        floor_x, floor_y = down[0] / self.fx, down[1] / self.fy
        floor = np.array([floor_x, floor_y, down[2] - floor_x * self.cx - floor_y * self.cy])
        return triangles, rasterize(triangles, size, floor, 1.0 / FAR)


@dataclass(frozen=True, eq=False)
class StereoFrame:
    """A rectified image pair: a point is in the same row, its disparity, left minus right, is fx · baseline / depth."""

    left: Frame  # frame of the left camera, with depth and ids
    right: Frame  # frame of the right camera


@dataclass(frozen=True)
class StereoCamera:
    """Two equal cameras side by side, like a Bumblebee; the pose of the pair is that of the left camera.

    Args:
        camera: the model of both cameras.
        baseline: m, position of the right camera along the left one's x axis.

    Raises:
        SensorError: the baseline is not positive and finite.
    """

    camera: PinholeCamera = field(default_factory=PinholeCamera)
    baseline: float = 0.12

    def __post_init__(self) -> None:
        require_numbers(self, "baseline", above=0.0)

    def right_pose(self, pose: FloatArray) -> FloatArray:
        """Return the pose of the right camera, (4, 4), from that of the left."""
        moved = np.array(pose, dtype=np.float64)
        moved[:3, 3] += self.baseline * moved[:3, 0]
        return moved

    def render_stereo(
        self, scene: Drawable, pose: FloatArray, weather: Weather | None = None, seed: int = 0
    ) -> StereoFrame:
        """Render both images with one exposure; arguments and errors are those of `PinholeCamera.render`.

        The images share textures, sky and shadows; their noise is independent.
        """
        weather = weather or Weather()
        left, gain = self.camera._exposed(scene, pose, weather, 2 * seed, None)
        right, _ = self.camera._exposed(scene, self.right_pose(pose), weather, 2 * seed + 1, gain)
        return StereoFrame(left, right)


def _surroundings(
    scene: Drawable, instances: Instances, pose: FloatArray, weather: Weather
) -> tuple[GroundTexture, LightMaps]:
    x, y = pose[:2, 3] + _AHEAD * pose[:2, 2]
    return ground_texture(scene.ground), light_maps(scene.pool, instances, weather, float(x), float(y))


def camera_pose(
    x: float, y: float, z: float, yaw: float, pitch: float = 0.0, roll: float = 0.0
) -> FloatArray:
    """Return the camera-to-world matrix of a camera that points along `yaw`.

    Args:
        x: m, world frame.
        y: m.
        z: m, above the ground.
        yaw: rad, counter-clockwise from x, of the optical axis.
        pitch: rad, positive upwards.
        roll: rad, about the optical axis, positive when the camera tilts to the right.

    Returns:
        (4, 4) float64; columns are the camera's right, down and forward axes, and its position.
    """
    values = (x, y, z, yaw, pitch, roll)
    if not all(math.isfinite(value) for value in values):
        raise SensorError(f"camera pose is {values}, want finite numbers")
    forward = np.array([math.cos(yaw) * math.cos(pitch), math.sin(yaw) * math.cos(pitch), math.sin(pitch)])
    level = np.array([math.sin(yaw), -math.cos(yaw), 0.0])
    steep = np.cross(forward, level)
    pose = np.eye(4)
    pose[:3, 0] = math.cos(roll) * level + math.sin(roll) * steep
    pose[:3, 1] = math.cos(roll) * steep - math.sin(roll) * level
    pose[:3, 2] = forward
    pose[:3, 3] = (x, y, z)
    return pose


def checked_pose(scene: Drawable, pose: FloatArray) -> FloatArray:
    pose = np.ascontiguousarray(pose, dtype=np.float64)
    if pose.shape != (4, 4):
        raise SensorError(f"camera pose has shape {pose.shape}, want (4, 4)")
    if not np.isfinite(pose).all():
        raise SensorError(f"camera pose is {pose.tolist()}, want finite numbers")
    rotation = pose[:3, :3]
    if np.abs(rotation.T @ rotation - np.eye(3)).max() > 1e-5 or np.linalg.det(rotation) < 0.0:
        raise SensorError(f"camera pose has axes {rotation.tolist()}, want a rotation")
    if pose[2, 3] <= 0.0:
        raise SensorError(f"camera height is {pose[2, 3]} m, want above the ground, z = 0")
    vehicle = _vehicle_around(scene, pose[:3, 3])
    if vehicle > 0:
        raise SensorError(
            f"camera position {pose[:3, 3].tolist()} is inside vehicle {vehicle}, want it outside"
        )
    return pose


def _vehicle_around(scene: Drawable, point: FloatArray) -> int:
    instances, pool = scene.instances, scene.pool
    away = np.abs(instances.pose[:, :2] - point[:2]).max(axis=1)
    near = np.flatnonzero((away < pool.radius[instances.mesh]) & (instances.ids > 0))
    if len(near) == 0:
        return 0
    box = bounding_boxes(pool)[instances.mesh[near]]
    offset = point - instances.pose[near, :3]
    cosine, sine = np.cos(instances.pose[near, 3]), np.sin(instances.pose[near, 3])
    ahead, left = cosine * offset[:, 0] + sine * offset[:, 1], cosine * offset[:, 1] - sine * offset[:, 0]
    local = np.column_stack([ahead, left, offset[:, 2]])
    inside = ((local > box[:, :3]) & (local < box[:, 3:])).all(axis=1)
    return int(instances.ids[near[np.argmax(inside)]]) if inside.any() else 0


@compiled(nogil=True)
def _geometry(
    visibility: Visibility, instance: NDArray[np.int32], ids: NDArray[np.int32]
) -> tuple[Float32Array, Float32Array, NDArray[np.int32]]:
    height, width = visibility.triangle.shape
    depth = np.empty((height, width), dtype=np.float32)
    glass = np.empty((height, width), dtype=np.float32)
    seen = np.empty((height, width), dtype=np.int32)
    infinite = np.float32(np.inf)
    one = np.float32(1.0)
    for y in range(height):
        for x in range(width):
            inverse = visibility.inverse_depth[y, x]
            depth[y, x] = one / inverse if inverse > 0 else infinite
            pane = visibility.pane[y, x]
            glass[y, x] = one / visibility.pane_inverse_depth[y, x] if pane >= 0 else infinite
            t = pane if pane >= 0 else visibility.triangle[y, x]
            seen[y, x] = ids[instance[t]] if t >= 0 else 0
    return depth, glass, seen
