"""Image sensor: lens blur, vignetting, exposure, shot and read noise, tone curve."""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import Float32Array
from parkenv.compiled.jit import compiled
from sim_sensors.camera.rasterizer import BAND, interleaved
from sim_sensors.camera.textures import FAST, VECTOR_LOOP, Single
from sim_sensors.errors import SensorError, require_numbers

_CURVE_STEPS = 4096
_BRIGHTEST = np.float32(4.0)  # greatest input of the tone curve; a plain sRGB curve would clip at 1
_STEPS_PER_ROOT = np.float32((_CURVE_STEPS - 1) / math.sqrt(4.0))  # per square root of light
_KNEE = 0.7  # highlights above this are compressed, as in a camera's own curve
_NOISE = 1 << 20  # numbers in the noise table


@dataclass(frozen=True)
class ImageSensor:
    """Converts radiance to 8-bit images.

    Args:
        mid_grey: target mean of the automatic exposure (linear, 1 is white).
        least_gain, greatest_gain: limits of the automatic exposure.
        blur: px, standard deviation of the lens's point spread, at most 0.8.
        vignetting: fraction of the light lost in the image's corners.
        shot_noise: standard deviation at white and gain 1; proportional to the square root of light and of gain.
        read_noise: standard deviation in the dark at gain 1; proportional to the gain.

    Raises:
        SensorError: a value that is negative, not finite or out of range.
    """

    mid_grey: float = 0.19
    least_gain: float = 0.1
    greatest_gain: float = 8.0
    blur: float = 0.55
    vignetting: float = 0.22
    shot_noise: float = 0.01
    read_noise: float = 0.0008

    def __post_init__(self) -> None:
        require_numbers(self, "mid_grey least_gain greatest_gain shot_noise read_noise", least=0.0)
        require_numbers(self, "blur", least=0.0, most=0.8)
        require_numbers(self, "vignetting", least=0.0, below=1.0)
        if not 0.0 < self.least_gain <= self.greatest_gain:
            raise SensorError(
                f"least_gain {self.least_gain} and greatest_gain {self.greatest_gain} are no limits, "
                "want 0 < least <= greatest"
            )

    def gain(self, radiance: Float32Array) -> float:
        """Return the automatic exposure of an (h, w, 3) image: the factor that scales its mean to mid grey.

        It measures the green channel of every eighth pixel, clipped at white, so a low sun does not turn the street
        black.
        """
        sample = radiance[::8, ::8, 1].ravel().astype(np.float64)
        middle = len(sample) // 2
        mean = float(np.minimum(sample, 3.0 * np.partition(sample, middle)[middle]).mean())
        return min(max(self.mid_grey / max(mean, 1e-6), self.least_gain), self.greatest_gain)

    def expose(
        self, radiance: Float32Array, seed: int, gain: float, *, rain: float = 0.0
    ) -> NDArray[np.uint8]:
        """Expose an image.

        Args:
            radiance: (h, w, 3) float32, linear RGB.
            seed: seed of the noise; equal seeds give equal bytes.
            gain: exposure, from the method `gain` or chosen.
            rain: 0 to 1, strength of the streaks of falling drops.

        Returns:
            (h, w, 3) uint8, RGB.
        """
        height, width, _ = radiance.shape
        generator = np.random.default_rng(seed)
        offsets = generator.integers(0, _NOISE - 3 * width if 3 * width < _NOISE else 1, height)
        if rain > 0.0:
            radiance = radiance.copy()
            _draw_rain(radiance, rain, generator)
        variances = np.float32(self.shot_noise**2 * gain), np.float32((self.read_noise * gain) ** 2)
        image = np.empty((height, width, 3), dtype=np.uint8)
        _expose(
            radiance,
            _noise_table(),
            offsets,
            _tone_curve(),
            interleaved((height + BAND - 1) // BAND),
            _lens(self.blur, self.vignetting, (width, height)),
            np.float32(gain),
            variances,
            image,
        )
        return image


class _Lens(NamedTuple):
    side: np.float32  # weight of each neighbour in a blur of three pixels
    dark_rows: Float32Array  # (h,) and (3 w,) float32: their sum is the light lost at a channel of a pixel
    dark_columns: Float32Array


@lru_cache(maxsize=4)
def _lens(blur: float, vignetting: float, size: tuple[int, int]) -> _Lens:
    width, height = size
    per_corner = vignetting / (0.25 * (width**2 + height**2))
    columns, rows = (per_corner * (np.arange(n) + 0.5 - 0.5 * n) ** 2 for n in size)
    # A kernel of three taps with the given variance.
    return _Lens(np.float32(blur**2 / 2.0), rows.astype(np.float32), np.repeat(columns, 3).astype(np.float32))


@lru_cache(maxsize=1)
def _noise_table() -> Float32Array:
    return np.random.default_rng(43).standard_normal(_NOISE, dtype=np.float32)


@lru_cache(maxsize=1)
def _tone_curve() -> NDArray[np.int32]:
    light = np.linspace(0.0, 1.0, _CURVE_STEPS) ** 2 * _BRIGHTEST
    over = np.maximum(light - _KNEE, 0.0)
    light = np.minimum(light, _KNEE) + (1.0 - _KNEE) * (1.0 - np.exp(-over / (1.0 - _KNEE)))
    code = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1.0 / 2.4) - 0.055)
    return np.round(255.0 * np.clip(code, 0.0, 1.0)).astype(np.int32)


def _draw_rain(radiance: Float32Array, rain: float, generator: np.random.Generator) -> None:
    height, width, _ = radiance.shape
    count = int(rain * 500 * height * width / (640 * 480))
    column = generator.uniform(0, width, count)
    row = generator.uniform(-20, height, count)
    length = generator.uniform(0.01, 0.05, count) * height
    lean = generator.normal(0.04, 0.02)
    strength = generator.uniform(0.02, 0.09, count) * float(radiance[::8, ::8].mean())
    _streaks(radiance, column, row, length, lean, strength)


@compiled(nogil=True)
def _streaks(
    radiance: Float32Array,
    column: NDArray[np.float64],
    row: NDArray[np.float64],
    length: NDArray[np.float64],
    lean: float,
    strength: NDArray[np.float64],
) -> None:
    height, width, _ = radiance.shape
    for i in range(column.shape[0]):
        for y in range(max(0, int(row[i])), min(height, int(row[i] + length[i]))):
            x = int(column[i] + lean * (y - row[i]))
            if 0 <= x < width:
                for channel in range(3):
                    radiance[y, x, channel] += strength[i]


@compiled(fastmath=FAST, nogil=True)
def _expose(
    radiance: Float32Array,
    noise: Float32Array,
    offsets: NDArray[np.int64],
    curve: NDArray[np.int32],
    order: NDArray[np.int64],
    lens: _Lens,
    gain: np.float32,
    variances: tuple[np.float32, np.float32],
    image: NDArray[np.uint8],
) -> None:
    height, width, _ = radiance.shape
    n = 3 * width
    flat = radiance.reshape(height, n)
    codes = image.reshape(height, n)
    for task in range(order.shape[0]):
        # The row, blurred from top to bottom, with a pixel more at both ends.
        padded = np.empty(n + 6, dtype=np.float32)
        for y in range(order[task] * BAND, min(height, order[task] * BAND + BAND)):
            _blur(flat[max(y - 1, 0)], flat[y], flat[min(y + 1, height - 1)], lens.side, padded)
            bright = gain * (np.float32(1.0) - lens.dark_rows[y])
            _encode(
                padded, lens, bright, gain, noise[offsets[y] : offsets[y] + n], variances, curve, codes[y]
            )


@compiled(**VECTOR_LOOP)
def _blur(
    above: Float32Array, here: Float32Array, below: Float32Array, side: Single, padded: Float32Array
) -> None:
    n = here.shape[0]
    middle = 1.0 - 2.0 * side
    for i in range(n):
        padded[i + 3] = middle * here[i] + side * (above[i] + below[i])
    for channel in range(3):
        padded[channel] = padded[channel + 3]
        padded[n + 3 + channel] = padded[n + channel]


@compiled(**VECTOR_LOOP)
def _encode(
    padded: Float32Array,
    lens: _Lens,
    bright: Single,
    gain: Single,
    drawn: Float32Array,
    variances: tuple[np.float32, np.float32],
    curve: NDArray[np.int32],
    codes: NDArray[np.uint8],
) -> None:
    """Blur a row from left to right, darken its ends, add the noise drawn for it, and apply the tone curve."""
    shot_variance, read_variance = variances
    middle = 1.0 - 2.0 * lens.side
    for i in range(codes.shape[0]):
        light = middle * padded[i + 3] + lens.side * (padded[i] + padded[i + 6])
        light *= bright - gain * lens.dark_columns[i]
        light += drawn[i] * np.sqrt(shot_variance * max(light, 0.0) + read_variance)
        step = np.int32(_STEPS_PER_ROOT * np.sqrt(min(max(light, 0.0), _BRIGHTEST)) + 0.5)
        codes[i] = curve[np.uint64(step)]
