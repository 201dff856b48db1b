"""What an import has made of a file so far: a lot, or what a lot still lacks."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import dijkstra

from parkenv.errors import InputError
from parkenv.lots.generators import Slots
from parkenv.lots.local_frame import LocalFrame
from parkenv.world.drive_graph import GraphError
from parkenv.world.lot import Lane, ParkingLot

FloatArray = NDArray[np.float64]

NEAR_ON_GLOBE = 1.0
"""Degrees: a pair of numbers this near to a place on the globe is a latitude and a longitude, else metres."""


@dataclass(frozen=True)
class LeftOut:
    """What an import did not use: why, and the names that these have in the file."""

    reason: str
    ids: tuple[str, ...]

    def __str__(self) -> str:
        shown = ", ".join(self.ids[:5]) + (", ..." if len(self.ids) > 5 else "")
        return f"{self.reason}: {len(self.ids)} ({shown})"


@dataclass(frozen=True, eq=False)
class LotDraft:
    """Slots, lanes, entries and goals that were found; any may be missing.

    Args:
        name: the lot's name.
        slot_ids: n_slots names.
        slots: their geometry, lot frame.
        slot_source: n_slots words that say what each was made from.
        lanes: centre lines.
        entries: (n_entries, 2) m.
        goals: (n_goals, 2) m.
        walls: (k, 2) m each.
        outlines: (k, 2) m each, areas that the file calls parking; for pictures.
        found: what there is, a line each, for a reader.
        left_out: what was not used.
        missing: what must be known before a search can run, a sentence each that says how to give it.
        frame: where the lot's frame lies on the globe; None if the file does not say.
        loose: (k, 2) m, centres of slots of which no more is known; for pictures.
    """

    name: str
    slot_ids: tuple[str, ...]
    slots: Slots
    slot_source: tuple[str, ...]
    lanes: tuple[Lane, ...]
    entries: FloatArray
    goals: FloatArray
    walls: tuple[FloatArray, ...] = ()
    outlines: tuple[FloatArray, ...] = ()
    found: tuple[str, ...] = ()
    left_out: tuple[LeftOut, ...] = ()
    missing: tuple[str, ...] = ()
    frame: LocalFrame | None = None
    loose: FloatArray = field(default_factory=lambda: np.empty((0, 2)))

    @classmethod
    def of_lot(cls, lot: ParkingLot) -> LotDraft:
        """A lot that lacks nothing."""
        return cls(
            name=lot.name,
            slot_ids=lot.slot_ids,
            slots=Slots.of_lot(lot),
            slot_source=("the lot file",) * lot.n_slots,
            lanes=lot.lanes,
            entries=lot.entries,
            goals=lot.goals,
            walls=lot.walls,
            found=(f"{lot.n_slots} slots and {len(lot.lanes)} lanes of a lot file",),
        )

    def lot(self) -> ParkingLot:
        """The lot.

        Raises:
            InputError: something is missing, or the parts do not fit together; the message says what.
        """
        if self.missing:
            raise InputError("; ".join(self.missing))
        try:
            return ParkingLot(
                name=self.name,
                slot_ids=self.slot_ids,
                **self.slots.columns(),
                lanes=self.lanes,
                entries=self.entries,
                goals=self.goals,
                walls=self.walls,
            )
        except GraphError as error:
            problem = error.problems[0]
            what = f"slot {self.slot_ids[problem.index]!r}" if problem.kind == "slot" else problem.kind
            raise InputError(f"{what} {problem.message}") from error

    def searchable(self) -> LotDraft:
        """Without the slots that no way leads to from an entry; these are listed as left out.

        What is missing or does not fit stays as it is.
        """
        try:
            lot = self.lot()
        except InputError:
            return self
        far = ~np.isfinite(dijkstra(lot.drive_matrix(), indices=lot.entry_vertices, min_only=True))
        lost = far[: lot.n_slots]
        if not lost.any() or lost.all():
            return self
        kept = np.flatnonzero(~lost)
        ids = tuple(self.slot_ids[i] for i in np.flatnonzero(lost))
        return replace(
            self,
            slot_ids=tuple(self.slot_ids[i] for i in kept),
            slots=self.slots[kept],
            slot_source=tuple(self.slot_source[i] for i in kept),
            left_out=(*self.left_out, LeftOut("slots that no way leads to from an entry", ids)),
        )


@dataclass(frozen=True)
class Wishes:
    """What a user says about a place that its file does not, or better.

    Args:
        goals: pairs of numbers, each metres east and north in the lot's frame, or, for a file with latitudes
            and longitudes, a latitude and a longitude: whatever lies within a degree of the place.
        entries: the same, where cars come in.
        bounds: two corners, in the same way; what lies outside is not read.
        with_disabled: whether slots for disabled drivers count as slots.
    """

    goals: tuple[tuple[float, float], ...] = ()
    entries: tuple[tuple[float, float], ...] = ()
    bounds: tuple[tuple[float, float], tuple[float, float]] | None = None
    with_disabled: bool = False

    def __post_init__(self) -> None:
        for what, points in (("goal", self.goals), ("entry", self.entries), ("bounds", self.bounds or ())):
            for point in points:
                if len(point) != 2 or not np.isfinite(point).all():
                    raise InputError(f"{what} is {point!r}, want two finite numbers")

    def box(self, frame: LocalFrame | None) -> tuple[float, float, float, float] | None:
        """Least x and y, greatest x and y, m, of the bounds.

        Raises:
            InputError: bounds without an area.
        """
        if self.bounds is None:
            return None
        corners = points_in(frame, self.bounds)
        (x0, y0), (x1, y1) = corners.min(axis=0).tolist(), corners.max(axis=0).tolist()
        if x1 - x0 < 1.0 or y1 - y0 < 1.0:
            raise InputError(f"bounds are {x1 - x0:.2f} × {y1 - y0:.2f} m, want an area")
        return x0, y0, x1, y1


def points_in(frame: LocalFrame | None, pairs: tuple[tuple[float, float], ...]) -> FloatArray:
    """Metres, (n, 2), of pairs that are metres, or latitude and longitude within a degree of the frame's middle."""
    points = np.array(pairs, dtype=np.float64).reshape(-1, 2)
    if frame is None or not len(points):
        return points
    on_globe = np.all(np.abs(points - [frame.lat, frame.lon]) <= NEAR_ON_GLOBE, axis=1, keepdims=True)
    return np.where(on_globe, frame.to_xy(points[:, ::-1]), points)
