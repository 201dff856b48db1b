"""Style of all figures, and functions that save them."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image

from parkenv.files.atomic_write import atomic_write

DPI = 150
CAPTION = "Description"  # key of the caption in the metadata of a PNG
# All settings, so that none of a user's `matplotlibrc` are left, which may want LaTeX.
STYLE: dict[Any, Any] = {
    **{name: value for name, value in mpl.rcParamsDefault.items() if name not in ("backend", "interactive")},
    "font.family": "DejaVu Sans",
    "font.size": 9.0,
    "axes.titlesize": 9.0,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#666666",
    "axes.axisbelow": True,
    "grid.color": "#dddddd",
    "grid.linewidth": 0.7,
    "legend.frameon": False,
    "legend.fontsize": 9.0,
    "xtick.color": "#444444",
    "ytick.color": "#444444",
    "figure.titlesize": 11.0,
    "text.parse_math": False,  # a $ in a name is a $
}

INK = "#181b1f"


@contextmanager
def picture(
    path: str | Path, size: tuple[float, float], caption: str = "", layout: Any = "constrained"
) -> Iterator[Figure]:
    """Yield a figure, of a size in inches, and write it as a PNG when the block ends; see `save_picture`."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=size, layout=layout)
        yield figure
        save_picture(figure, path, caption)


def save_picture(figure: Figure, path: str | Path, caption: str = "") -> None:
    with mpl.rc_context(STYLE), atomic_write(path) as beside:
        figure.savefig(beside, format="png", dpi=DPI, metadata={CAPTION: caption} if caption else None)


def save_film(
    frames: Sequence[NDArray[np.uint8]], path: str | Path, *, fps: float, colors: int | None = None
) -> None:
    """Write frames, RGB (h, w, 3), as a looping GIF, atomically.

    All have one palette of so many `colors`, which keeps rare ones (for drawings); None: each its own (photographs).
    """
    pictures = [Image.fromarray(frame) for frame in frames]
    if colors is not None:
        palette = _palette(np.concatenate([*frames[:: max(1, len(frames) // 6)], frames[-1]]), colors)
        pictures = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
    with atomic_write(path) as beside:
        pictures[0].save(
            beside,
            format="GIF",
            save_all=True,
            append_images=pictures[1:],
            duration=round(1000 / fps),
            loop=0,
            optimize=colors is not None,  # store only what changes
        )


def _palette(image: NDArray[np.uint8], n: int) -> Image.Image:
    picture = Image.fromarray(image)
    counted: Any = picture.getcolors(picture.width * picture.height)
    frequent = [color for _, color in sorted(counted, key=lambda seen: (-seen[0], seen[1]))[: n // 2]]
    spread = picture.quantize(n - len(frequent), Image.Quantize.MAXCOVERAGE).getpalette() or []
    palette = Image.new("P", (1, 1))
    palette.putpalette([*chain.from_iterable(frequent), *spread])
    return palette
