"""Charts as data: lines, names at their ends, panels and grids of panels, each with one renderer (Matplotlib)."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import PercentFormatter
from matplotlib.typing import ColorType

from parkenv.compiled.arrays import FloatArray
from parkenv.show.figures.picture_files import STYLE

Row = Mapping[str, Any]
Style = Mapping[str, Any]  # arguments of Matplotlib's artists
Mark = Callable[[Axes], object]  # something that draws itself on axes
# Colours of series, distinguishable with any colour vision.
COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
GREY = "#999999"
BOLD: Style = {"weight": "bold"}
PERCENT = PercentFormatter(1.0)


@dataclass(frozen=True, eq=False)
class Line:
    x: Any
    y: Any
    color: str
    style: Mapping[str, Any] = field(default_factory=dict)
    band: tuple[Any, Any] | None = None  # its lower and upper ends
    opacity: float = 0.2  # of the band
    interval: FloatArray | None = None  # (2, n), distances of its ends from y

    def __call__(self, ax: Axes) -> None:
        if self.band is not None:
            ax.fill_between(self.x, *self.band, color=self.color, alpha=self.opacity, linewidth=0)
        if self.interval is not None:
            ax.errorbar(self.x, self.y, self.interval, color=self.color, **self.style)
        else:
            ax.plot(self.x, self.y, color=self.color, **self.style)


def level(y: float, color: str, **style: Any) -> Mark:
    return lambda ax: ax.axhline(y, color=color, **style)


class Panel(NamedTuple):
    marks: Sequence[Mark]
    title: str = ""
    axes: Mapping[str, Any] = {}  # of `Axes.set`
    grid: Any = "both"  # axis with a grid; "" for none
    legend: Style | None = None  # of `Axes.legend`; None for none
    percent: str = ""  # axes of fractions that are shown in percent
    title_style: Mapping[str, Any] = {}

    def draw(self, ax: Axes) -> None:
        for mark in self.marks:
            mark(ax)
        ax.set(**self.axes)
        ax.set_title(self.title, **self.title_style)
        for name in self.percent:
            getattr(ax, f"{name}axis").set_major_formatter(PERCENT)
        if self.grid:
            ax.grid(visible=True, axis=self.grid)
        if self.legend is not None:
            ax.legend(**self.legend)


def draw_panels(
    panels: Sequence[Panel],
    size: tuple[float, float],
    columns: int = 0,
    title: str = "",
    *,
    share: str = "",
    label: Mapping[str, Any] = {},
    key: Sequence[Any] = (),
    key_style: Mapping[str, Any] = {},
    bold: bool = False,
) -> Figure:
    """Draw panels in a grid of so many columns, or 0: all panels in a row; the size of the figure is in inches.

    Panels `share` the axes "x" and "y"; or "column": x within each column. A `label` `x` stands below the lowest panel
    of each column, `y` beside the first of each row. The `key` has the handles of a legend below all panels.
    """
    columns = columns or len(panels)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=size, layout="constrained")
        shared: dict[str, Any] = (
            {"sharex": "col"} if share == "column" else {"sharex": "x" in share, "sharey": "y" in share}
        )
        axes = figure.subplots(-(-len(panels) // columns), columns, squeeze=False, **shared)
        for ax in axes.flat[len(panels) :]:
            ax.remove()
        for i, (ax, panel) in enumerate(zip(axes.flat, panels, strict=False)):
            panel.draw(ax)
            if "x" in label and i + columns >= len(panels):
                ax.tick_params(labelbottom=True)
                ax.set_xlabel(label["x"])
            if "y" in label and i % columns == 0:
                ax.set_ylabel(label["y"])
        if key:
            figure.legend(handles=key, **({"loc": "outside lower center"} | dict(key_style)))
        if title:
            figure.suptitle(title, x=0.01, ha="left", weight="bold" if bold else "normal")
    return figure


def legend_columns(labels: Sequence[str], width: float, most: int) -> int:
    length = np.array([0.5 + 0.065 * len(label) for label in labels])
    fits = (
        n
        for n in range(most, 1, -1)
        if sum(part.max(initial=0.0) for part in np.array_split(length, n)) <= width
    )
    return next(fits, 1)


def key_line(label: str, color: ColorType, **style: Any) -> Line2D:
    return Line2D([], [], color=color, label=label, **style)


def spread(heights: Sequence[float], gap: float) -> FloatArray:
    """Move ascending heights at least `gap` apart, as little as possible, and not above 1 if they fit."""
    apart = np.array(heights, dtype=np.float64)
    for i in range(1, len(apart)):
        apart[i] = max(apart[i], apart[i - 1] + gap)
    apart[-1:] = np.minimum(apart[-1:], max(1.0, gap * (len(apart) - 1)))
    for i in range(len(apart) - 2, -1, -1):
        apart[i] = min(apart[i], apart[i + 1] - gap)
    return apart
