"""Figure for checking the import of a town: streets, places by kind and by what they are known from, entries, goals."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PathCollection
from matplotlib.figure import Figure

from parkenv.lots.town.draft import TownDraft
from parkenv.show.figures.lot import ENTRY, GOAL, GROUND, INK
from parkenv.show.figures.picture_files import STYLE, save_picture

KERB_COLORS = {"tag": "#225588", "drawn": "#4477aa", "rule": "#8fb8d8"}
"""Colour of a slot by what its capacity is known from."""
COUNTED_COLORS = {"lot": "#228833", "garage": "#aa3377", "kerb": "#4477aa"}
STREET = "#8a8a84"
SPACE_M2 = 60.0  # m² of a counted facility's disc for each place: twice the room of a parked car


@mpl.rc_context(STYLE)
def save_town_picture(town: TownDraft, path: str | Path) -> None:
    """Draw a town to a PNG file: slots are dots, counted facilities discs by capacity, hollow where a rule says it."""
    draft = town.draft
    points = np.concatenate([lane.points for lane in draft.lanes])
    low, high = points.min(axis=0), points.max(axis=0)
    size = np.maximum(high - low, 50.0) * 1.06
    inch = 14.0 / max(size[0], 1.4 * size[1])
    width, height = size * inch
    figure = Figure(figsize=(width + 0.8, height + 1.2))
    ax = figure.add_axes(
        (0.6 / (width + 0.8), 0.85 / (height + 1.2), width / (width + 0.8), height / (height + 1.2))
    )
    middle = (low + high) / 2
    ax.set(xlim=middle[0] + size[0] * np.array([-0.5, 0.5]), ylim=middle[1] + size[1] * np.array([-0.5, 0.5]))
    ax.set_facecolor(GROUND)
    ax.tick_params(labelsize=8)
    ax.set_xlabel("m", fontsize=8)
    _draw(town, ax, 72.0 * inch)
    places = sum(row["capacity"] for row in town.facilities)
    by_rule = sum(row["capacity"] for row in town.facilities if row["capacity_from"] == "rule")
    ax.set_title(
        f"{draft.name}: {places:,} places, {by_rule:,} of them by rule, in {len(town.facilities):,} facilities",
        loc="left",
        fontsize=10,
    )
    handles, labels = ax.get_legend_handles_labels()
    columns = max(min(len(labels), int(width / 1.3)), 1)
    legend = figure.legend(handles, labels, loc="lower left", ncols=columns, fontsize=8)
    for handle in legend.legend_handles:
        if isinstance(handle, PathCollection):
            handle.set_sizes([40.0])
    save_picture(figure, path)


def _draw(town: TownDraft, ax: Axes, points_per_m: float) -> None:
    draft = town.draft
    source = {row["name"]: row["capacity_from"] for row in town.facilities}
    ax.add_collection(LineCollection([lane.points for lane in draft.lanes], colors=STREET, linewidths=0.5))
    sources = np.array([source.get(name, "rule") for name in draft.slots.facility.tolist()])
    dot = np.clip((5.0 * points_per_m) ** 2, 1.2, 30.0)
    for name, color in KERB_COLORS.items():
        xy = draft.slots.xy[sources == name]
        if len(xy):
            ax.scatter(xy[:, 0], xy[:, 1], s=dot, color=color, linewidths=0, label=f"slots, {name}")
    for kind, color in COUNTED_COLORS.items():
        for known in (True, False):
            mine = [
                facility
                for facility in draft.facilities
                if facility.is_counted
                and facility.kind == kind
                and (source.get(facility.name.partition(",")[0], "rule") != "rule") is known
            ]
            if mine:
                xy = np.array([facility.xy for facility in mine])
                ax.scatter(
                    xy[:, 0],
                    xy[:, 1],
                    s=np.maximum(np.array([f.capacity for f in mine]) * SPACE_M2 * points_per_m**2, 4.0),
                    facecolors=color if known else "none",
                    edgecolors=color,
                    linewidths=0.9,
                    alpha=0.85,
                    label=f"{kind}s, {'tag' if known else 'rule'}",
                    zorder=4,
                )
    total = sum(draft.goal_weights.values(), np.zeros(len(draft.goals)))
    share = total / max(float(total.max(initial=0.0)), 1e-9)
    traffic = next(iter(draft.entry_weights.values()), np.ones(len(draft.entries)))
    for label, xy, sizes, marker, color, edge in (
        ("goals", draft.goals, 12.0 + 90.0 * share, "*", GOAL, "none"),
        ("entries", draft.entries, 20.0 + 6.0 * traffic, "^", ENTRY, INK),
    ):
        ax.scatter(
            xy[:, 0], xy[:, 1], s=sizes, marker=marker, color=color, edgecolors=edge, linewidths=0.5, label=label,
            zorder=5,
        )  # fmt: skip
