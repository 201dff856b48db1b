"""Figures of parking manoeuvres from above."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image as PillowImage

from parkenv.compiled.arrays import Image
from parkenv.driving.drive_state import DriveState
from parkenv.files.atomic_write import atomic_write
from parkenv.show.frames.drive import DriveRenderer
from parkenv.world.lot import ParkingLot

COLUMNS = 2
GAP = 6
"""Space between pictures, px."""
_SIZE = (480, 640, 3)


def save_parkings(ends: Sequence[tuple[ParkingLot, DriveState]], path: Path) -> None:
    """Write a PNG of the final states and driven paths of parking episodes, two per row."""
    pictures = [DriveRenderer(lot).frame(state) for lot, state in ends]
    save_sheet(pictures, path)


def save_sheet(pictures: Sequence[Image], path: Path) -> None:
    """Write pictures, (480, 640, 3) each, as one PNG."""
    rows = -(-len(pictures) // COLUMNS)
    height, width, _ = _SIZE
    sheet = np.full((rows * (height + GAP) - GAP, COLUMNS * (width + GAP) - GAP, 3), 255, dtype=np.uint8)
    for i, picture in enumerate(pictures):
        top, left = i // COLUMNS * (height + GAP), i % COLUMNS * (width + GAP)
        sheet[top : top + height, left : left + width] = picture
    with atomic_write(path) as beside:
        PillowImage.fromarray(sheet).save(beside, format="PNG")
