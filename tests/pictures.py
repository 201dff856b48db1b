"""What a picture shows."""

from pathlib import Path

import numpy as np
from matplotlib.colors import to_rgb
from PIL import Image


def share_of_color(picture, color, within=6):
    """Share of the pixels of a picture, an array or a file, that have a colour, of Matplotlib or RGB."""
    if isinstance(picture, Path):
        picture = np.asarray(Image.open(picture).convert("RGB"))
    rgb = np.round(255 * np.array(to_rgb(color))) if isinstance(color, str) else np.array(color)
    return float((np.abs(picture.astype(int) - rgb).max(axis=-1) <= within).mean())


def shows_color(picture, color, within=6):
    """Whether more than a few pixels of a picture have a colour."""
    return share_of_color(picture, color, within) > 1e-4
