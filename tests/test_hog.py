"""The descriptor: against plain numpy, by its counts, and as a correlation."""

import numpy as np
import pytest

from parkenv.perception.hog import CELL, ORIENTATIONS, Descriptor, cell_histograms, correlate


def plain_histograms(image):
    """Pixel by pixel, in double precision."""
    padded = np.pad(image.astype(float), 1, mode="edge")
    gx = padded[1:-1, 2:] - padded[1:-1, :-2]
    gy = padded[2:, 1:-1] - padded[:-2, 1:-1]
    magnitude = np.hypot(gx, gy)
    place = np.mod(np.arctan2(gy, gx), np.pi) / np.pi * ORIENTATIONS - 0.5
    rows, columns = image.shape[0] // CELL, image.shape[1] // CELL
    cells = np.zeros((rows + 2, ORIENTATIONS, columns + 2))
    for y in range(rows * CELL):
        row = (y + 0.5) / CELL - 0.5
        for x in range(columns * CELL):
            column, k = (x + 0.5) / CELL - 0.5, int(np.floor(place[y, x]))
            for dk, wk in ((0, 1 - (place[y, x] - k)), (1, place[y, x] - k)):
                for dr, wr in ((0, 1 - (row - np.floor(row))), (1, row - np.floor(row))):
                    for dc, wc in ((0, 1 - (column - np.floor(column))), (1, column - np.floor(column))):
                        r, c = int(np.floor(row)) + dr + 1, int(np.floor(column)) + dc + 1
                        cells[r, (k + dk) % ORIENTATIONS, c] += wk * wr * wc * magnitude[y, x]
    return cells[1:-1, :, 1:-1]


def test_histograms_are_those_of_plain_numpy():
    noise = np.random.default_rng(0).integers(0, 256, (43, 61), dtype=np.uint8)
    expected, found = plain_histograms(noise), cell_histograms(noise)
    assert found.shape == (5, 9, 7)
    assert cell_histograms(np.zeros((5, 90), np.uint8)).shape == (0, 9, 11)
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-4 * expected.max())


@pytest.mark.parametrize("normalization", ["cell", "neighbors", "blocks"])
def test_exposure_hardly_matters(normalization):
    rng = np.random.default_rng(2)
    crop = np.kron(rng.integers(10, 80, (16, 32)), np.ones((4, 4))).astype(np.uint8)
    descriptor = Descriptor(128, 64, normalization)
    a, b = descriptor.describe(crop), descriptor.describe((3 * crop).astype(np.uint8))
    assert np.abs(a - b).max() < 0.02
    assert np.isfinite(descriptor.describe(np.full((64, 128), 9, np.uint8))).all()


@pytest.mark.parametrize("normalization", ["cell", "neighbors", "blocks"])
def test_correlation_is_the_dot_product_with_every_window(normalization):
    rng = np.random.default_rng(3)
    image = rng.integers(0, 256, (100, 220), dtype=np.uint8)
    descriptor = Descriptor(128, 64, normalization)
    features = descriptor.features(image)
    weights = rng.normal(size=descriptor.shape).astype(np.float32)
    scores = correlate(features, weights)
    rows, _, columns = descriptor.shape
    assert scores.shape == (features.shape[0] - rows + 1, features.shape[2] - columns + 1)
    windows = np.lib.stride_tricks.sliding_window_view(features, descriptor.shape)[:, 0]
    np.testing.assert_allclose(scores, np.einsum("yxrbc,rbc->yx", windows, weights), rtol=0, atol=1e-3)
    assert correlate(features[:3], weights).size == 0


def test_a_window_in_the_middle_is_the_crops_own_description():
    rng, descriptor = np.random.default_rng(4), Descriptor(128, 64)
    image = np.pad(rng.integers(0, 256, (64, 128), dtype=np.uint8), 16, mode="edge")
    window = descriptor.features(image)[2:10, :, 2:18]
    alone = descriptor.describe(image[16:-16, 16:-16]).reshape(descriptor.shape)
    # Cells at the border have neighbours beyond it, which are only guessed from the crop.
    np.testing.assert_allclose(window[1:-1, :, 1:-1], alone[1:-1, :, 1:-1], atol=1e-5)
    np.testing.assert_allclose(window, alone, atol=0.05)
