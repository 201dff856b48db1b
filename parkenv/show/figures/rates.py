"""Figures of an occupancy process: occupancy, arrival and departure rates over the day."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from parkenv.show.figures.picture_files import STYLE, save_picture
from parkenv.world.occupancy.process import OccupancyProcess
from parkenv.world.week import DAY_S, HOUR_S

_DAYS = (("weekday", 0, "#0072b2"), ("weekend", 5, "#e69f00"))


@mpl.rc_context(STYLE)
def save_rates(process: OccupancyProcess, path: Path, *, title: str = "") -> None:
    """Draw the mean occupancy with its spread over slots, and the profiles of both rates, for each day class."""
    figure = Figure(figsize=(9.0, 3.6), layout="constrained")
    full, rates = figure.subplots(1, 2)
    hours = np.arange(0.0, 24.01, 0.25)
    for name, day, color in _DAYS:
        moments = np.stack([process.marginal(day * DAY_S + h * HOUR_S) for h in hours])
        low, middle, high = np.quantile(moments, [0.1, 0.5, 0.9], axis=1)
        full.fill_between(hours, low, high, color=color, alpha=0.18, linewidth=0)
        full.plot(hours, moments.mean(axis=1), color=color, label=f"{name}, mean")
        full.plot(hours, middle, color=color, linewidth=0.8, linestyle=":")
        for profile, style in ((process.arrival_profile, "-"), (process.departure_profile, "--")):
            event = "arrivals" if style == "-" else "departures"
            rates.stairs(
                profile[24 * day : 24 * day + 24] * HOUR_S, baseline=None, color=color, linestyle=style, linewidth=1.5,
                label=f"{event}, {name}",
            )  # fmt: skip
    full.set(
        xlabel="hour of the day",
        ylabel="fraction occupied",
        ylim=(0, 1.02),
        title="Occupancy (band: 80 % of slots)",
    )
    rates.set(
        xlabel="hour of the day",
        ylabel="per hour and slot",
        yscale="log",
        title="Arrival and departure rates",
    )
    rates.yaxis.set_major_formatter("{x:g}")
    for ax in (full, rates):
        ax.set(xlim=(0, 24), xticks=range(0, 25, 4))
        ax.grid(visible=True)
        ax.legend(fontsize=8)
    if title:
        figure.suptitle(title)
    save_picture(figure, path)
