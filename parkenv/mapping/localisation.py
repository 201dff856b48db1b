"""What corrects the pose that a car's odometry reports: nothing, or scan matching."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

from parkenv.compiled.arrays import FloatArray
from parkenv.errors import require_one_of
from parkenv.files.known_names import LOCALISERS
from parkenv.mapping.scan_matching import ScanMatcher
from parkenv.perception.range_scan import RangeScan
from parkenv.world.lot import ParkingLot

Located = FloatArray | Callable[[Sequence[RangeScan]], FloatArray]
"""A pose, or what `PerceptionPipeline.process` asks for it."""


def make_locate(name: str, lot: ParkingLot) -> Callable[[FloatArray], Located]:
    """Return a function that is called with the odometry of each capture of a drive, in order.

    Args:
        name: `none` or `scan-matching`.
        lot: the lot that the car is in.
    """
    require_one_of("localise", name, LOCALISERS)
    if name == "none":
        return lambda odometry: odometry
    matcher = ScanMatcher(lot)
    return lambda odometry: partial(matcher.locate, odometry)
