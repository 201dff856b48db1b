"""Figure of a discovered street: its rows, slots by state, and which of them are guesses."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.collections import PolyCollection
from matplotlib.patches import Patch

from parkenv.compiled.arrays import FloatArray
from parkenv.mapping.inference import SessionLog
from parkenv.mapping.street_slots import CAR, StreetSlots
from parkenv.show.figures.charts import key_line
from parkenv.show.figures.lot import BELIEF_MAP, draw_lot
from parkenv.show.figures.picture_files import INK, picture
from parkenv.show.painters.axes import paint
from parkenv.show.plurals import plural
from parkenv.show.scene import Lines
from parkenv.world.lot import Lane, ParkingLot

KERB, TRACK, UNSEEN = "#7030aa", "#0072b2", "#b9bec4"
_WIDTH, _HEIGHTS = 12.0, (2.2, 9.0)  # inches


def save_street(
    lot: ParkingLot, found: StreetSlots, tracks: Sequence[FloatArray], log: SessionLog, path: Path
) -> None:
    """Draw a street from above, turned so that its longer side is level; an arrow shows where north is."""
    points = np.concatenate([*tracks, lot.slot_xy])
    axis = np.linalg.eigh(np.cov(points.T))[1][:, 1]
    angle = -math.atan(axis[1] / axis[0]) if abs(axis[0]) > 1e-9 else math.pi / 2
    lot, turn = _turned(lot, angle), _turn(angle)
    x0, y0, x1, y1 = lot.bounds()
    height = float(np.clip(_WIDTH * (y1 - y0 + 16.0) / (x1 - x0 + 8.0), *_HEIGHTS))
    seen, last = log.known.any(axis=0), len(log.time) - 1 - log.known[::-1].argmax(axis=0)
    color = np.where(log.occupied[last, np.arange(lot.n_slots)][:, None], BELIEF_MAP(0.9), BELIEF_MAP(0.1))
    color[~seen] = _rgba(UNSEEN)
    guessed = found.source != CAR
    with picture(
        path, (_WIDTH, height + 0.6), "Slots of a street, discovered from the cars parked along it"
    ) as figure:
        ax = figure.add_subplot()
        draw_lot(lot, ax, slot_color=color)
        corners = lot.slot_corners()
        outlines = PolyCollection(list(corners[guessed]), facecolors="none", edgecolors=INK, linestyles=(0, (2, 1.5)),
                                  linewidths=0.9, zorder=3.0)  # fmt: skip
        ax.add_collection(outlines)
        layers = [
            Lines([track @ turn.T for track in tracks], TRACK, px=(1.2, 1.2)),
            Lines([kerb @ turn.T for kerb in found.kerbs], KERB, px=(1.6, 1.6)),
        ]
        paint(ax, layers, 2.5)
        sure = plural(int((~guessed).sum()), "slot")
        ax.set_title(f"{lot.name}: {sure} where parked cars were seen in a row, {int(guessed.sum())} guessed")
        states = {"taken when last seen": 0.9, "free when last seen": 0.1}
        key: list[Any] = [Patch(color=BELIEF_MAP(p), label=name) for name, p in states.items()]
        key += [Patch(color=UNSEEN, label="never in view")]
        key += [
            Patch(
                fill=False,
                edgecolor=INK,
                linestyle=(0, (2, 1.5)),
                label="guessed: a gap, a car alone or seen once",
            )
        ]
        key += [key_line("kerb", KERB), key_line("driven", TRACK)]
        figure.legend(handles=key, loc="outside lower left", ncols=len(key), fontsize=8)
        north = turn @ np.array([0.0, 1.0])
        arrow = {"arrowstyle": "<|-", "color": INK}
        how: dict[str, Any] = {"ha": "center", "va": "center", "color": INK, "arrowprops": arrow}
        tip = (22.0 * float(north[0]), 22.0 * float(north[1]))
        ax.annotate("N", (0.965, 0.86), tip, "axes fraction", "offset points", **how)


def _turn(angle: float) -> FloatArray:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s], [s, c]])


def _turned(lot: ParkingLot, angle: float) -> ParkingLot:
    turn = _turn(angle).T
    return replace(
        lot,
        slot_xy=lot.slot_xy @ turn,
        slot_yaw=lot.slot_yaw + angle,
        lanes=tuple(Lane(lane.points @ turn, lane.oneway, lane.speed) for lane in lot.lanes),
        entries=lot.entries @ turn,
        goals=lot.goals @ turn,
    )


def _rgba(color: str) -> FloatArray:
    from matplotlib.colors import to_rgba

    return np.array(to_rgba(color))
