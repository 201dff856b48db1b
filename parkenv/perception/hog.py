"""Histograms of oriented gradients (HOG): the thesis's descriptor, and two better normalizations.

The descriptor of a window consists of its cells (T §3.2.1): 8×8 pixels per cell, nine unsigned orientations, so 1152
values for a side view of 128×64 and 2304 for a front of 128×128. Histograms are computed once per image; every window
on the grid of cells is a slice of them.

Gradients are those of the square root of the grey values (Dalal and Triggs 2005, §6.1): outlines in dark and bright
images then have similar strength, and the exposure changes only the scale.
"""

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from parkenv.compiled.arrays import Float32Array, Image
from parkenv.compiled.jit import compiled
from parkenv.errors import InputError, require_one_of

CELL = 8  # pixels along each side of a cell
ORIENTATIONS = 9  # bins over half a turn; opposite gradients count as one
NORMALIZATIONS = ("neighbors", "cell", "blocks")

_FAST: dict[str, Any] = {
    "fastmath": {"nnan", "ninf", "nsz", "arcp", "contract", "afn"},
    "error_model": "numpy",
    "nogil": True,
}
_HALF = CELL // 2
_NOISE = 25.0  # energy of a cell with sensor noise only; weaker cells are not amplified
_CLIP = 0.2  # largest value of a single orientation (L2-Hys of Dalal and Triggs)
_ROOT = np.round(np.sqrt(255.0 * np.arange(256))).astype(np.uint8)  # 255 stays 255


@dataclass(frozen=True)
class Descriptor:
    """The features of a window.

    Args:
        width, height: size of the window, px; whole cells.
        normalization: `cell`: each cell by its own energy, with as many values as in the thesis. `neighbors`: each cell
            by the energies of the four blocks of 2×2 cells that contain it, averaged; the same number of values.
            `blocks`: Dalal and Triggs (2005), each block of 2×2 cells separately, 36 values each.

    Examples:
        >>> Descriptor(128, 64).size, Descriptor(128, 128).size, Descriptor(128, 64, "blocks").size
        (1152, 2304, 3780)
    """

    width: int = 128
    height: int = 64
    normalization: str = "neighbors"

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            value = getattr(self, name)
            if not isinstance(value, int) or value < 2 * CELL or value % CELL:
                raise InputError(f"{name} is {value!r} px, want a multiple of {CELL} of at least {2 * CELL}")
        require_one_of("normalization", self.normalization, NORMALIZATIONS)

    @property
    def shape(self) -> tuple[int, int, int]:
        rows, columns = self.height // CELL, self.width // CELL
        if self.normalization == "blocks":
            return rows - 1, 4 * ORIENTATIONS, columns - 1
        return rows, ORIENTATIONS, columns

    @property
    def size(self) -> int:
        return math.prod(self.shape)

    def features(self, image: Image) -> Float32Array:
        """Compute the features of a whole image, (h, w) uint8, grey: (rows, values, columns) float32.

        Columns come last, so that compiled loops run along them. A window on the grid of cells is a slice of `shape`.
        """
        cells = cell_histograms(cv2.LUT(_checked(image), _ROOT) if image.size else image)
        normalize = {"cell": _by_cell, "neighbors": _by_neighbors, "blocks": _by_blocks}[self.normalization]
        return np.asarray(normalize(cells))

    def describe(self, crop: Image) -> Float32Array:
        """Compute the descriptor, (size,) float32, of one window, (height, width) uint8, whose border is replicated."""
        if crop.shape != (self.height, self.width):
            raise InputError(f"crop is {crop.shape}, want ({self.height}, {self.width})")
        # One more cell on each side, because a window in an image has neighbours.
        wider = cv2.copyMakeBorder(crop, CELL, CELL, CELL, CELL, cv2.BORDER_REPLICATE)
        rows, _, columns = self.shape
        return np.ascontiguousarray(self.features(wider)[1 : 1 + rows, :, 1 : 1 + columns]).reshape(-1)


def _checked(image: Image) -> Image:
    if image.ndim != 2 or image.dtype != np.uint8:
        raise InputError(f"image is {image.shape} of {image.dtype}, want (h, w) uint8")
    return image


def cell_histograms(image: Image) -> Float32Array:
    """Compute the histogram of oriented gradients of every cell, (h // 8, 9, w // 8) float32, of an image, uint8.

    Gradients are central differences; the magnitude of each is distributed, linearly by distance, over the two nearest
    orientations and the four nearest cells. Orientation k is centred at (k + 0.5)/9 of half a turn, counted from a
    gradient along the columns.
    """
    _checked(image)
    rows, columns = image.shape[0] // CELL, image.shape[1] // CELL
    if rows == 0 or columns == 0:
        return np.zeros((rows, ORIENTATIONS, columns), dtype=np.float32)
    padded = cv2.copyMakeBorder(image, 1, 1, 1, 1, cv2.BORDER_REPLICATE)
    return np.asarray(_histograms(padded, rows, columns))


@compiled(**_FAST)
def _gradients(
    above: Image, row: Image, below: Image, magnitude: Float32Array, weighted_bin: Float32Array
) -> None:
    one_bin = np.float32(ORIENTATIONS / math.pi)
    for x in range(len(magnitude)):
        gx = np.float32(np.int32(row[x + 2]) - np.int32(row[x]))
        gy = np.float32(np.int32(below[x + 1]) - np.int32(above[x + 1]))
        ax, ay = abs(gx), abs(gy)
        t = min(ax, ay) / (max(ax, ay) + np.float32(1e-9))
        s = t * t
        # Arc tangent on [0, 1] to 1e-5 (Abramowitz and Stegun 4.4.49): a hundredth of a thousandth of a bin.
        angle = t * (
            np.float32(0.9998660)
            + s
            * (
                np.float32(-0.3302995)
                + s * (np.float32(0.1801410) + s * (np.float32(-0.0851330) + s * np.float32(0.0208351)))
            )
        )
        angle = np.float32(0.5 * math.pi) - angle if ay > ax else angle
        angle = np.float32(math.pi) - angle if gx * gy < np.float32(0.0) else angle
        m = math.sqrt(gx * gx + gy * gy)
        magnitude[x] = m
        weighted_bin[x] = m * (angle * one_bin - np.float32(0.5))


@compiled(**_FAST)
def _share(m: np.float32, q: np.float32, k: np.float32) -> np.float32:
    return max(np.float32(0.0), m - abs(q - m * k))


@compiled(**_FAST)
def _bin_rows(
    m: Float32Array, q: Float32Array, first: np.float32, upper: Float32Array, lower: Float32Array
) -> None:
    """Add four rows of gradients to every bin of the cells whose centres lie above and below them.

    `m` and `q`, (4, w), are magnitudes, and magnitudes times bins; `first` is the weight of the first row for the cells
    below, which grows by 1/8 a row. The sums `upper` and `lower`, (9, 4 + w + 4), are changed in place.
    """
    step = np.float32(1.0 / CELL)
    f0, f1, f2, f3 = first, first + step, first + step + step, first + step + step + step
    m0, m1, m2, m3 = m[0], m[1], m[2], m[3]
    q0, q1, q2, q3 = q[0], q[1], q[2], q[3]
    # Orientations wrap at half a turn: the first and the last bin are neighbours.
    for i in range(ORIENTATIONS + 2):
        center = i if i <= ORIENTATIONS else -1
        a, b = upper[center % ORIENTATIONS], lower[center % ORIENTATIONS]
        bin_ = np.float32(center)
        for x in range(len(m0)):
            v0 = _share(m0[x], q0[x], bin_)
            v1 = _share(m1[x], q1[x], bin_)
            v2 = _share(m2[x], q2[x], bin_)
            v3 = _share(m3[x], q3[x], bin_)
            down = f0 * v0 + f1 * v1 + f2 * v2 + f3 * v3
            a[_HALF + x] += v0 + v1 + v2 + v3 - down
            b[_HALF + x] += down


@compiled(**_FAST)
def _pool(sums: Float32Array, tent: Float32Array, out: Float32Array) -> None:
    for k in range(ORIENTATIONS):
        for c in range(out.shape[1]):
            total = np.float32(0.0)
            for i in range(2 * CELL):
                total += sums[k, c * CELL + i] * tent[i]
            out[k, c] = total


@compiled(**_FAST)
def _histograms(padded: Image, rows: int, columns: int) -> Float32Array:
    width = columns * CELL
    out = np.zeros((rows, ORIENTATIONS, columns), dtype=np.float32)
    upper = np.zeros((ORIENTATIONS, _HALF + width + _HALF), dtype=np.float32)
    lower = np.zeros_like(upper)
    m = np.empty((_HALF, width), dtype=np.float32)
    q = np.empty((_HALF, width), dtype=np.float32)
    tent = np.empty(2 * CELL, dtype=np.float32)
    for i in range(2 * CELL):
        tent[i] = 1.0 - abs((i + 0.5) / CELL - 1.0)
    # Half a cell at a time: the centres of cells lie between rows 3 and 4, 11 and 12, and so on.
    for half in range(2 * rows):
        top = half * _HALF
        for j in range(_HALF):
            y = top + j
            _gradients(padded[y], padded[y + 1], padded[y + 2], m[j], q[j])
        if half % 2 == 1:
            row = half // 2
            if row > 0:
                _pool(upper, tent, out[row - 1])
            upper, lower = lower, upper
            lower[:] = 0.0
            _bin_rows(m, q, np.float32(0.5 / CELL), upper, lower)
        else:
            _bin_rows(m, q, np.float32((_HALF + 0.5) / CELL), upper, lower)
    _pool(upper, tent, out[rows - 1])
    return out


@compiled(**_FAST)
def _by_cell(cells: Float32Array) -> Float32Array:
    rows, values, columns = cells.shape
    out = np.empty_like(cells)
    scale = np.empty(columns, dtype=np.float32)
    for y in range(rows):
        scale[:] = _NOISE * _NOISE
        for k in range(values):
            for x in range(columns):
                scale[x] += cells[y, k, x] * cells[y, k, x]
        for x in range(columns):
            scale[x] = np.float32(1.0) / math.sqrt(scale[x])
        for k in range(values):
            for x in range(columns):
                out[y, k, x] = cells[y, k, x] * scale[x]
    return out


@compiled(**_FAST)
def _block_scales(cells: Float32Array) -> Float32Array:
    """Return 1/norm of the 2×2 cells around each corner, (rows + 1, columns + 1); border cells count twice."""
    rows, values, columns = cells.shape
    energy = np.zeros((rows + 2, columns + 2), dtype=np.float32)
    for y in range(rows):
        for k in range(values):
            for x in range(columns):
                energy[y + 1, x + 1] += cells[y, k, x] * cells[y, k, x]
    energy[0] = energy[1]
    energy[rows + 1] = energy[rows]
    energy[:, 0] = energy[:, 1]
    energy[:, columns + 1] = energy[:, columns]
    scale = np.empty((rows + 1, columns + 1), dtype=np.float32)
    for y in range(rows + 1):
        for x in range(columns + 1):
            total = energy[y, x] + energy[y, x + 1] + energy[y + 1, x] + energy[y + 1, x + 1]
            scale[y, x] = np.float32(1.0) / math.sqrt(total + np.float32(_NOISE * _NOISE))
    return scale


@compiled(**_FAST)
def _by_neighbors(cells: Float32Array) -> Float32Array:
    rows, values, columns = cells.shape
    scale = _block_scales(cells)
    out = np.empty_like(cells)
    clip = np.float32(_CLIP)
    quarter = np.float32(0.25)
    for y in range(rows):
        a = scale[y]
        b = scale[y + 1]
        for k in range(values):
            for x in range(columns):
                v = cells[y, k, x]
                total = min(v * a[x], clip) + min(v * a[x + 1], clip)
                out[y, k, x] = quarter * (total + min(v * b[x], clip) + min(v * b[x + 1], clip))
    return out


@compiled(**_FAST)
def correlate(features: Float32Array, weights: Float32Array) -> Float32Array:
    """Return the dot product of the weights with every window of the features, both (rows, values, columns) float32.

    Empty where the window is larger.
    """
    height, width = weights.shape[0], weights.shape[2]
    rows, columns = features.shape[0] - height + 1, features.shape[2] - width + 1
    out = np.zeros((max(rows, 0), max(columns, 0)), dtype=np.float32)
    if columns <= 0:
        return out
    for y in range(rows):
        line = out[y]
        for i in range(height):
            for k in range(features.shape[1]):
                source = features[y + i, k]
                j = 0
                # Four columns of the window at a time: a quarter of the loads and stores of the line.
                while j + 4 <= width:
                    w0, w1 = weights[i, k, j], weights[i, k, j + 1]
                    w2, w3 = weights[i, k, j + 2], weights[i, k, j + 3]
                    for x in range(columns):
                        line[x] += (
                            w0 * source[x + j]
                            + w1 * source[x + j + 1]
                            + w2 * source[x + j + 2]
                            + w3 * source[x + j + 3]
                        )
                    j += 4
                while j < width:
                    w0 = weights[i, k, j]
                    for x in range(columns):
                        line[x] += w0 * source[x + j]
                    j += 1
    return out


@compiled(**_FAST)
def _by_blocks(cells: Float32Array) -> Float32Array:
    rows, values, columns = cells.shape
    out = np.empty((max(rows - 1, 0), 4 * values, max(columns - 1, 0)), dtype=np.float32)
    scale = _block_scales(cells)
    clip = np.float32(_CLIP)
    norm = np.empty(max(columns - 1, 0), dtype=np.float32)
    for y in range(rows - 1):
        norm[:] = 1e-6
        for corner in range(4):
            dy, dx = corner // 2, corner % 2
            for k in range(values):
                for x in range(columns - 1):
                    v = min(cells[y + dy, k, x + dx] * scale[y + 1, x + 1], clip)
                    out[y, corner * values + k, x] = v
                    norm[x] += v * v
        for x in range(columns - 1):
            norm[x] = np.float32(1.0) / math.sqrt(norm[x])
        for k in range(4 * values):
            for x in range(columns - 1):
                out[y, k, x] *= norm[x]
    return out
