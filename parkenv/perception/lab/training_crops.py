"""Training examples for the network `net`, made of simulated pictures by domain randomization (Tobin et al. 2017).

The cars of a picture are scaled to any size, put before other backgrounds, repainted, half hidden, and seen through
another camera, so that the network cannot learn how the renderer draws.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import Float32Array, Image
from parkenv.files.images import decode_image
from parkenv.perception.lab.backdrops import random_texture
from parkenv.perception.lab.simulated_scenes import DEPTH_STEPS, SimulatedScene
from sim_sensors.ground_truth import View

SIZES = ((320, 256), (256, 192), (480, 320))
"""Width and height of the examples of a batch, px."""
SMALL_SIZES = ((256, 192), (192, 160), (320, 256))
"""The same for the first half of the training."""
BORDER = 114  # grey level around a picture that is smaller than the network's input

_SIZE_SHARE, _SMALL_SHARE = (0.55, 0.25, 0.2), (0.5, 0.4, 0.1)
_AIMED = 0.93  # fraction of examples that are cut around a car
_NARROWEST = {View.SIDE: 30.0, View.END: 20.0, View.OBLIQUE: 26.0}  # px, cars that examples are cut around
_SCALES = (0.14, 3.0)
_LEAST_PIXELS = 60  # of a car that an example is cut around
_TEXTURE_SIZE = (480, 640)  # height and width, px
_TEXTURE_STEP = 32.0  # textures are kept in steps of a 32nd of their standard deviation
_NOISE = 1 << 21
_FOUND, _FOUND_SIZE, _FOUND_CUT = 0.3, (11, 8), 0.4
"""Least visible fraction, size in px, and fraction within the example, of a car that should be found."""


@dataclass(frozen=True, eq=False)
class Example:
    """A grey picture with the cars that a detector should find in it."""

    image: Image  # (h, w)
    boxes: Float32Array  # (n, 4) px, left, top, right, bottom of the visible part of each car
    view: NDArray[np.int64]  # (n,)
    visible: Float32Array  # (n,), visible fraction
    either: Float32Array  # (m, 4) px, boxes of cars that may be found or not: too small, hidden or cut off


def draw_size(rng: np.random.Generator, *, small: bool = False) -> tuple[int, int]:
    """Draw the size of the examples of a batch.

    Args:
        rng: random generator.
        small: only sizes at which a step is fast.
    """
    sizes, shares = (SMALL_SIZES, _SMALL_SHARE) if small else (SIZES, _SIZE_SHARE)
    return sizes[int(rng.choice(len(sizes), p=shares))]


class ExampleMaker:
    """Makes examples of simulated pictures.

    Args:
        scenes: the pictures.
        rng: random generator.
        textures: number of textures that backgrounds are cut from.
    """

    def __init__(
        self, scenes: Sequence[SimulatedScene], rng: np.random.Generator, textures: int = 160
    ) -> None:
        self._scenes, self._rng = scenes, rng
        drawn = (_clutter(_TEXTURE_SIZE, rng) * np.float32(_TEXTURE_STEP) for _ in range(textures))
        self._textures = [np.clip(texture, -127.0, 127.0).astype(np.int8) for texture in drawn]
        self._noise = rng.standard_normal(_NOISE, dtype=np.float32)

    def draw(self, size: tuple[int, int]) -> Example:
        """Make an example of one of the pictures.

        Args:
            size: width and height, px.
        """
        rng = self._rng
        scene = self._scenes[int(rng.integers(len(self._scenes)))]
        grey, car, depth, scale = _cut(scene, size, rng)
        before = _count(car)
        values = grey.astype(np.float32)
        self._repaint(values, car)
        self._change_background(values, scene, car, depth)
        if rng.random() < 0.45:
            self._hide(values, car)
        after = _count(car)
        boxes, view, visible, either = [], [], [], []
        for row in np.flatnonzero(after[1:]) + 1:
            left, top, width, height = cv2.boundingRect(cv2.compare(car, int(row), cv2.CMP_EQ))
            box = [left, top, left + width, top + height]
            seen = float(scene.visible[row - 1]) * after[row] / max(before[row], 1)
            enough = seen >= _FOUND and width >= _FOUND_SIZE[0] and height >= _FOUND_SIZE[1]
            whole = not scene.is_cut[row - 1] and before[row] >= _FOUND_CUT * scene.pixels[row] * scale
            if enough and whole:
                boxes.append(box)
                view.append(int(scene.view[row - 1]))
                visible.append(seen)
            else:
                either.append(box)
        return Example(
            self._photographed(values),
            np.array(boxes, dtype=np.float32).reshape(-1, 4),
            np.array(view, dtype=np.int64),
            np.array(visible, dtype=np.float32),
            np.array(either, dtype=np.float32).reshape(-1, 4),
        )

    def _texture(self, shape: tuple[int, ...], strength: float) -> Float32Array:
        """Return a part of a texture, (h, w)."""
        rng, (height, width) = self._rng, shape
        texture = self._textures[int(rng.integers(len(self._textures)))]
        down, across = (
            int(rng.integers(len(texture) - height + 1)),
            int(rng.integers(_TEXTURE_SIZE[1] - width + 1)),
        )
        part = texture[down : down + height, across : across + width]
        part = part[:: int(rng.choice([-1, 1])), :: int(rng.choice([-1, 1]))]
        return np.asarray(part * np.float32(strength / _TEXTURE_STEP), dtype=np.float32)

    def _repaint(self, values: Float32Array, car: Image) -> None:
        """Change brightness and contrast of some cars, and let something be reflected in them."""
        rng = self._rng
        if rng.random() < 0.5:
            gain, shift = np.ones(256, np.float32), np.zeros(256, np.float32)
            gain[1:] = np.exp(rng.uniform(-0.6, 0.5, 255))
            shift[1:] = (1.0 - gain[1:]) * rng.uniform(60.0, 160.0, 255) + rng.uniform(-30.0, 30.0, 255)
            same = rng.random(256) < 0.4
            gain[same], shift[same] = 1.0, 0.0
            values *= gain[car]
            values += shift[car]
        if rng.random() < 0.3:
            values += self._texture(car.shape, rng.uniform(2.0, 16.0)) * (car > 0)

    def _change_background(
        self, values: Float32Array, scene: SimulatedScene, car: Image, depth: Image
    ) -> None:
        """Replace the background: behind the nearest cars, or all of it."""
        rng = self._rng
        kind = rng.random()
        if kind < 0.2:
            return
        far = car == 0
        if kind < 0.8:
            clear = scene.distance[scene.visible > 0.8]
            nearest = float(clear.min()) if len(clear) else rng.uniform(6.0, 20.0)
            far &= depth > DEPTH_STEPS * math.log(max(nearest + rng.uniform(0.5, 5.0), 1.0))
        if not far.any():
            return
        texture = self._texture(car.shape, rng.uniform(8.0, 55.0))
        mean = float(values[far].mean())
        kept = rng.uniform(0.0, 1.0)
        texture += np.float32(mean * (1.0 - kept) + rng.normal(0.0, 30.0) * (1.0 - kept))
        texture += np.float32(kept) * values
        np.copyto(values, texture, where=far)

    def _hide(self, values: Float32Array, car: Image) -> None:
        """Draw posts, walls, leaves and boxes over the picture, and take the covered pixels from the cars."""
        rng = self._rng
        covered = _occluders(car.shape, rng)
        texture = self._texture(car.shape, rng.uniform(0.0, 35.0)) + np.float32(rng.uniform(10.0, 240.0))
        np.copyto(values, texture, where=covered)
        car[covered] = 0

    def _photographed(self, values: Float32Array) -> Image:
        """Take the picture with another camera: light, exposure, sharpness, noise, resolution, compression."""
        rng = self._rng
        height, width = values.shape
        if rng.random() < 0.3:  # light from one side
            ramp = np.linspace(rng.uniform(0.5, 1.0), rng.uniform(0.8, 1.3), width, dtype=np.float32)[None]
            values *= ramp if rng.random() < 0.7 else ramp[:, ::-1]
        image = cv2.LUT(np.clip(values, 0.0, 255.0).astype(np.uint8), self._exposure(values))
        if rng.random() < 0.4:  # fewer pixels
            by = rng.uniform(0.35, 0.9)
            few = (max(8, round(width * by)), max(8, round(height * by)))
            how = cv2.INTER_AREA if rng.random() < 0.7 else cv2.INTER_LINEAR
            image = cv2.resize(cv2.resize(image, few, interpolation=how), (width, height))
        if rng.random() < 0.1:  # a movement of the camera
            length = int(rng.integers(2, 7))
            image = cv2.blur(image, (length, 1) if rng.random() < 0.8 else (1, length))
        if rng.random() < 0.45:
            image = cv2.GaussianBlur(image, (0, 0), float(rng.uniform(0.3, 1.3)))
        if rng.random() < 0.25:
            strength = rng.uniform(0.4, 1.5)
            image = cv2.addWeighted(
                image, 1.0 + strength, cv2.GaussianBlur(image, (0, 0), 1.2), -strength, 0.0
            )
        if rng.random() < 0.8:
            first = int(rng.integers(_NOISE - height * width))
            noise = self._noise[first : first + height * width].reshape(height, width)
            noisy = image + noise * np.float32(255.0 * rng.uniform(0.0, 0.035))
            image = np.clip(noisy, 0.0, 255.0).astype(np.uint8)
        if rng.random() < 0.25:
            _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(20, 90))])
            image = decode_image(data.tobytes(), "example")
        return np.asarray(image, dtype=np.uint8)

    def _exposure(self, values: Float32Array) -> Image:
        """Return a grey level for each of 256: exposure, gamma, contrast."""
        rng = self._rng
        tone = np.arange(256, dtype=np.float64) / 255.0
        middle = values[int(0.3 * len(values)) : int(0.8 * len(values)) + 1 : 4, ::4]
        low, high = np.quantile(middle, [rng.uniform(0.0, 0.04), rng.uniform(0.93, 1.0)]) / 255.0
        if rng.random() < 0.75 and high - low > 0.03:
            tone = np.clip((tone - low) / (high - low), 0.0, 1.0)
        tone = tone ** math.exp(rng.uniform(-0.6, 0.4))
        tone = (tone - 0.5) * math.exp(rng.uniform(-0.9, 0.2)) + 0.5 + rng.uniform(-0.12, 0.12)
        if rng.random() < 0.02:
            tone = 1.0 - tone
        return np.clip(255.0 * tone, 0.0, 255.0).astype(np.uint8)


def _count(car: Image) -> NDArray[np.float32]:
    """Return the number of pixels of every row of cars, and of none, (256,)."""
    return np.asarray(cv2.calcHist([car], [0], None, [256], [0.0, 256.0]).ravel())


def _cut(
    scene: SimulatedScene, size: tuple[int, int], rng: np.random.Generator
) -> tuple[Image, Image, Image, float]:
    """Return picture, cars and depth at another scale, perhaps mirrored, and the scale of areas."""
    height, width = scene.grey.shape
    clear = np.flatnonzero((scene.visible > 0.5) & (scene.pixels[1:] > _LEAST_PIXELS))
    scale = math.exp(rng.uniform(math.log(0.4), math.log(2.0)))
    middle = rng.uniform(0.0, width), rng.uniform(0.3, 0.9) * height
    if len(clear) and rng.random() < _AIMED:
        aimed_at = int(rng.choice(clear))
        left, top, across, down = scene.box[aimed_at].tolist()
        view = View(scene.view[aimed_at])
        widest = (1.0 if view is View.SIDE else 0.75) * size[0]
        wanted = math.exp(rng.uniform(math.log(_NARROWEST[view]), math.log(widest)))
        scale = float(np.clip(wanted / across, *_SCALES))
        middle = left + 0.5 * across, top + 0.5 * down
    stretch = math.exp(rng.normal(0.02, 0.1))  # longer and lower cars, too
    scale_x, scale_y = scale * stretch, scale / stretch
    # The aimed-at car is anywhere in the example.
    x0 = round(middle[0] - rng.uniform(0.1, 0.9) * size[0] / scale_x)
    y0 = round(middle[1] - rng.uniform(0.15, 0.85) * size[1] / scale_y)
    x1, y1 = x0 + max(1, round(size[0] / scale_x)), y0 + max(1, round(size[1] / scale_y))
    within = max(x0, 0), max(y0, 0), min(x1, width), min(y1, height)
    if within[0] >= within[2] or within[1] >= within[3]:
        return _cut(scene, size, rng)
    fx, fy = size[0] / (x1 - x0), size[1] / (y1 - y0)
    left, right = round((within[0] - x0) * fx), max(1, round((within[2] - x0) * fx))
    top, bottom = round((within[1] - y0) * fy), max(1, round((within[3] - y0) * fy))
    part = np.s_[within[1] : within[3], within[0] : within[2]]
    fit = (max(1, right - left), max(1, bottom - top))
    enlarge = int(rng.choice([cv2.INTER_LINEAR, cv2.INTER_CUBIC, cv2.INTER_AREA]))
    how = enlarge if fx > 1.0 else int(rng.choice([cv2.INTER_AREA, cv2.INTER_AREA, cv2.INTER_LINEAR]))
    cuts = []
    for layer, flag, around in (
        (scene.grey, how, BORDER),
        (scene.car, cv2.INTER_NEAREST, 0),
        (scene.depth, cv2.INTER_NEAREST, 255),
    ):
        whole = np.full((size[1], size[0]), around, dtype=np.uint8)
        resized = cv2.resize(layer[part], fit, interpolation=flag)
        whole[top : top + fit[1], left : left + fit[0]] = resized[: size[1] - top, : size[0] - left]
        cuts.append(whole)
    if rng.random() < 0.5:
        cuts = [np.ascontiguousarray(cut[:, ::-1]) for cut in cuts]
    return cuts[0], cuts[1], cuts[2], fx * fy


def _clutter(shape: tuple[int, ...], rng: np.random.Generator) -> Float32Array:
    """Return random texture, perhaps with round shapes and lines, or of two kinds side by side."""
    texture = random_texture(shape, rng)
    height, width = shape
    if rng.random() < 0.35:
        other = random_texture(shape, rng)
        if rng.random() < 0.5:
            row = int(rng.uniform(0.2, 0.8) * height)
            texture[row:] = other[row:]
        else:
            column = int(rng.uniform(0.2, 0.8) * width)
            texture[:, column:] = other[:, column:]
    if rng.random() < 0.4:
        for _ in range(int(rng.integers(2, 16))):
            middle = int(rng.uniform(0, width)), int(rng.uniform(0, height))
            axes = int(math.exp(rng.uniform(0.7, 3.6))), int(math.exp(rng.uniform(0.7, 3.6)))
            if rng.random() < 0.5:
                axes = (axes[0], axes[0])
            thick = -1 if rng.random() < 0.5 else int(rng.integers(1, 4))
            turn = float(rng.uniform(0.0, 180.0))
            cv2.ellipse(texture, middle, axes, turn, 0.0, 360.0, float(rng.normal(0.0, 1.6)), thick)
    if rng.random() < 0.4:
        for _ in range(int(rng.integers(1, 10))):
            ends = rng.uniform(0.0, 1.0, (2, 2)) * (width, height)
            (a, b), (c, d) = ends.astype(int).tolist()
            cv2.line(texture, (a, b), (c, d), float(rng.normal(0.0, 1.6)), int(rng.integers(1, 5)))
    return texture


def _occluders(shape: tuple[int, ...], rng: np.random.Generator) -> NDArray[np.bool_]:
    """Return a mask of posts, walls, boxes and leaves."""
    height, width = shape
    mask = np.zeros(shape, dtype=np.uint8)
    for _ in range(int(rng.integers(1, 5))):
        x, y = rng.uniform(0.0, width), rng.uniform(0.2, 0.9) * height
        kind = rng.integers(4)
        if kind == 0:  # a post
            thick = max(1.0, width * rng.uniform(0.005, 0.05))
            corners = [(x, 0.0 if rng.random() < 0.5 else y), (x + thick, height)]
        elif kind == 1:  # a box, or a wall from the side
            corners = [(x, y), (x + rng.uniform(0.03, 0.35) * width, y + rng.uniform(0.05, 0.5) * height)]
        elif kind == 2:  # a low wall or hedge
            y = rng.uniform(0.5, 0.95) * height
            corners = [(x, y), (x + rng.uniform(0.2, 0.8) * width, height)]
        else:  # leaves
            for _ in range(int(rng.integers(3, 20))):
                at = rng.normal((x, y), 0.07 * width)
                axes = int(rng.uniform(1, 0.05 * width) + 1), int(rng.uniform(1, 0.04 * width) + 1)
                turn = float(rng.uniform(0.0, 180.0))
                cv2.ellipse(mask, (int(at[0]), int(at[1])), axes, turn, 0.0, 360.0, 1, -1)
            continue
        (a, b), (c, d) = corners
        cv2.rectangle(mask, (int(a), int(b)), (int(c), int(d)), 1, -1)
    return mask > 0
