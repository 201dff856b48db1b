"""Frames of a fleet, from above."""

import numpy as np

from parkenv.compiled.arrays import Image
from parkenv.engine.fleet import Fleet
from parkenv.show.frames.lot import HUD, HUD_MARGIN, PIXELS, LotFrames, clock, paint_goal, strip, write_line
from parkenv.show.frames.window import Window
from parkenv.show.painters.opencv import paint, text_width, write_label
from parkenv.show.scene import DISC, Color, Marks, cars, posed

SLOT: Color = (126, 130, 136)
SIZE = (4.4, 1.85)  # of a car, m
SMALLEST_CAR = 7.0  # length, px


class FleetRenderer:
    def __init__(self, fleet: Fleet) -> None:
        self.fleet = fleet
        self._frames = LotFrames(fleet.scenario.lot, smallest_slot=0.0)
        self._colors = np.full((fleet.scenario.lot.n_slots, 3), SLOT, np.uint8)
        self._key = _key()
        self.window = Window(f"parkenv: {fleet.scenario.name}")

    def frame(self) -> Image:
        """Render the present moment, (480, 640, 3) uint8 RGB, with the true occupancy: not for agents."""
        fleet, lot = self.fleet, self.fleet.scenario.lot
        own = fleet.slots["car"] >= 0
        image = self._frames.slots(np.zeros(2), self._colors, fleet.taken() & ~own)
        view = self._frames.still(np.zeros(2)).view
        parked = posed(lot.slot_xy[own], lot.slot_yaw[own])
        paint(image, view, cars(parked, "resident", SIZE, px=SMALLEST_CAR))
        for goal in sorted({scenario.goal for scenario in fleet.scenarios}):
            paint_goal(image, view, lot.goals[goal])
        paint(image, view, cars(posed(*fleet.poses()), "car", SIZE, px=SMALLEST_CAR, edge="ink"))
        line, totals = self._key.copy(), fleet.totals
        counts = (f"{totals[name]:.0f} {name}" for name in ("searching", "parked", "gone"))
        write_line(line, (clock(fleet.time), *counts))
        return np.vstack([image, line])


def _key() -> Image:
    image = strip()
    x = float(image.shape[1] - HUD_MARGIN)
    for text, color in (("parked", "resident"), ("searching", "car")):
        width = text_width(text, 13, 400)
        write_label(image, text, (x - width / 2, HUD / 2), "white", 13, 400)
        paint(image, PIXELS, [Marks(posed(np.array([x - width - 12.0, HUD / 2])), DISC, color, px=10.0)])
        x -= width + 30.0
    return image
