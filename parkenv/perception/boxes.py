"""Boxes in an image."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Float = TypeVar("Float", np.float32, np.float64)


def overlaps(box: NDArray[Float], others: NDArray[np.floating] | NDArray[np.integer]) -> NDArray[Float]:
    """Return the intersection over union of a box, (4,) left, top, right, bottom, with others, (n, 4)."""
    inner = np.minimum(box[2:], others[:, 2:]) - np.maximum(box[:2], others[:, :2])
    common = np.clip(inner, 0.0, None).prod(axis=1)
    area = (box[2:] - box[:2]).prod() + (others[:, 2:] - others[:, :2]).prod(axis=1)
    return np.asarray(common / np.maximum(area - common, 1e-9), dtype=box.dtype)
