"""Paint the layers of a scene on the axes of a figure (Matplotlib); its pixels are points of 1/72 inch."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PathCollection, PolyCollection
from matplotlib.patches import Rectangle
from matplotlib.path import Path as Outline
from matplotlib.patheffects import Normal, Stroke

from parkenv.show.scene import HALO_PX, PALETTE, Areas, Layer, Lines, Paint, Rings, placed_shape

_STEP = 0.01


def paint(ax: Axes, layers: Sequence[Layer], zorder: float) -> None:
    """Add layers to axes with an equal aspect and their final limits and size, on which widths depend."""
    scale = points_per_m(ax)
    for i, layer in enumerate(layers):
        style: dict[str, Any] = {"zorder": zorder + _STEP * i, "alpha": layer.opacity}
        if isinstance(layer, Areas):
            rings = [_outline(polygon) for polygon in layer.polygons]
            edge = "none" if layer.edge is None else _paint(layer.edge)
            style |= {"facecolors": _paint(layer.color), "edgecolors": edge, "linewidths": layer.edge_px}
            if rings:
                ax.add_collection(PathCollection(rings, **style))
        elif isinstance(layer, Lines):
            width = float(np.clip(layer.width * scale, *layer.px))
            style |= {"colors": _paint(layer.color), "linewidths": width, "capstyle": "round"}
            if layer.dash is not None:
                style |= {"linestyles": (0, tuple(part / width for part in layer.dash)), "capstyle": "butt"}
            if layer.halo is not None:
                halo = Stroke(linewidth=width + HALO_PX, foreground=_paint(layer.halo))
                style["path_effects"] = [halo, Normal()]
            ax.add_collection(LineCollection(list(layer.lines), joinstyle="round", **style))
        else:
            corners = placed_shape(layer.shape, layer.poses, layer.sizes(1.0, layer.px / scale))
            edge, width = ("none", 0.0) if layer.edge is None else (_paint(layer.edge), layer.edge_px)
            style |= {"facecolors": _paint(layer.color), "edgecolors": edge, "linewidths": width}
            ax.add_collection(PolyCollection(list(corners), **style))


def _outline(polygon: Rings) -> Outline:
    """Return a polygon whose holes run against its outer ring, since Matplotlib fills by the winding number."""
    ways = []
    for i, ring in enumerate(polygon):
        x, y = ring.T
        clockwise = float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) < 0.0
        turned = ring[::-1] if clockwise == (i == 0) else ring
        ways.append(Outline(np.vstack([turned, turned[:1]]), closed=True))
    return Outline.make_compound_path(*ways)


def _paint(color: Paint) -> Any:
    if isinstance(color, str):
        return _paint(PALETTE[color]) if color in PALETTE else color
    if isinstance(color, tuple) and all(isinstance(part, int) for part in color):
        return tuple(float(part) / 255.0 for part in color)
    return [_paint(each) if isinstance(each, str | tuple) else each for each in color]


def points_per_m(ax: Axes) -> float:
    box = ax.get_window_extent()
    across, down = np.ptp(ax.get_xlim()), np.ptp(ax.get_ylim())
    return float(min(box.width / across, box.height / down)) / ax.figure.dpi * 72


def draw_scale_bar(ax: Axes, x: float, y: float, width: float, ink: str) -> None:
    power = 10.0 ** np.floor(np.log10(width / 6))
    length = power * max(step for step in (1, 2, 5) if step * power <= width / 6)
    thickness = 0.005 * width
    for left, face in ((x, ink), (x + length / 2, "white")):
        half = Rectangle((left, y), length / 2, thickness, facecolor=face, edgecolor=ink, linewidth=0.7)
        ax.add_patch(half)
    end = x + length, y + thickness / 2
    ax.annotate(f"{length:g} m", end, (5, 0), textcoords="offset points", va="center", color=ink)
