"""Figure of a demand that follows counts: cars by hour in each car park, counted and simulated."""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil
from pathlib import Path
from typing import NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from parkenv.compiled.arrays import FloatArray
from parkenv.show.figures.picture_files import STYLE, save_picture


class CarParkDays(NamedTuple):
    """A car park over the hours of a day."""

    name: str
    capacity: float
    simulated: FloatArray  # (n_hours,) cars, mean of the days of the fleet
    followed: FloatArray  # (n_hours,) cars counted, mean of the days that the demand follows
    held_out: FloatArray  # (d, n_hours) cars counted on later days; NaN: not counted


@mpl.rc_context(STYLE)
def save_counted_demand(car_parks: Sequence[CarParkDays], hours: FloatArray, path: Path) -> None:
    """Draw the share of the places that is taken: simulated, as counted on the days followed, and on later ones."""
    columns = min(len(car_parks), 4)
    rows = ceil(len(car_parks) / columns)
    figure = Figure(figsize=(2.8 * columns + 0.6, 2.1 * rows + 0.6), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True).ravel()
    for ax, its in zip(axes, car_parks, strict=False):
        seen = its.held_out[np.isfinite(its.held_out).any(axis=1)]
        for k, day in enumerate(seen):
            ax.plot(hours, day / its.capacity, color="#999999", linewidth=0.5, alpha=0.5,
                    label="counted later, each day" if k == 0 else None)  # fmt: skip
        ax.plot(hours, its.followed / its.capacity, "--", color="#0072b2", label="counted, days followed")
        ax.plot(hours, its.simulated / its.capacity, color="#d55e00", label="simulated")
        ax.set_title(f"{its.name}, {its.capacity:.0f}", fontsize=8)
        ax.set(xlim=(hours[0] - 1, hours[-1]), ylim=(0, 1.02))
        ax.grid(visible=True)
    for ax in axes[len(car_parks) :]:
        ax.set_axis_off()
    figure.supxlabel("hour of the day", fontsize=9)
    figure.supylabel("share of the places taken", fontsize=9)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper left", ncols=3, fontsize=8)
    save_picture(figure, path)
