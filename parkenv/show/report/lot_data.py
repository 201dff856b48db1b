"""Shapes of a lot in the data of a report page."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from parkenv.driving.lot_outline import LotOutline
from parkenv.world.lot import ParkingLot


def describe_lot(lot: ParkingLot) -> dict[str, Any]:
    """Return the `lot` of `report.schema.json`: lengths in m, rounded to centimetres."""
    outline = LotOutline.of(lot)
    return {
        "name": lot.name,
        "bounds": _rounded(np.array(lot.bounds())),
        "slot_ids": list(lot.slot_ids),
        "slots": [_rounded(corners) for corners in outline.slots],
        "vertices": [_rounded(xy) for xy in lot.vertex_xy],
        "yaw": [round(float(a), 3) for a in lot.vertex_yaw],
        "paved": [[_rounded(ring) for ring in rings] for rings in outline.paved()],
        "buildings": [_rounded(points) for points in outline.buildings],
        "walls": [_rounded(points) for points in outline.walls],
        "centre_lines": [_rounded(points) for points in outline.centre_lines],
        "arrows": [_rounded(pose) for pose in outline.arrows],
        "entries": [_rounded(pose) for pose in outline.entries],
        "goals": [_rounded(xy) for xy in lot.goals],
    }


def _rounded(values: NDArray[np.float64]) -> list[float]:
    return [round(float(v), 2) for v in values.ravel()]
