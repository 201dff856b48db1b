"""Options and result of an import: a lot, or an incomplete lot with a list of what is missing, guessed or doubtful."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from pydantic import TypeAdapter, ValidationError
from scipy.sparse.csgraph import dijkstra

from parkenv.compiled.arrays import BoolArray, FloatArray
from parkenv.errors import InputError, require
from parkenv.files.limited_reading import read_json
from parkenv.lots.generators import Slots
from parkenv.lots.local_frame import LocalFrame
from parkenv.lots.unread import Unread
from parkenv.world.drive_graph import GraphError
from parkenv.world.facility import Facility
from parkenv.world.lot import Lane, Mouth, ParkingLot, Turn
from parkenv.world.tariff import Zone


@dataclass(frozen=True)
class QualityIssue:
    reason: str
    error_probability: float  # that it makes the lot wrong, 0 to 1

    def __str__(self) -> str:
        return f"{self.error_probability:.2f} {self.reason}"


@dataclass(frozen=True)
class Provenance:
    """Where a lot comes from: the file, what was guessed, and what may be wrong with it."""

    source: str
    guesses: tuple[str, ...] = ()  # one sentence each
    issues: tuple[QualityIssue, ...] = ()
    caution: str = ""  # what decides results and is a guess

    def document(self) -> dict[str, Any]:
        return {
            "source": self.source,
            "guesses": list(self.guesses),
            "issues": [
                {"reason": issue.reason, "error_probability": round(issue.error_probability, 3)}
                for issue in self.issues
            ],
            **({"caution": self.caution} if self.caution else {}),
        }


def combined_error_probability(issues: tuple[QualityIssue, ...]) -> float:
    return 1.0 - math.prod(1.0 - min(max(issue.error_probability, 0.0), 1.0) for issue in issues)


def read_provenance(path: Path) -> Provenance | None:
    document = read_json(path)
    origin = document.get("import") if isinstance(document, dict) else None
    if origin is None:
        return None
    try:
        return TypeAdapter(Provenance).validate_python(origin)
    except ValidationError as error:
        raise InputError(
            f"{path}: import is {origin!r:.60}, want an object with source, guesses and issues"
        ) from error


UNREACHED = "slots that cannot be reached from an entry"  # a reason for leaving out
# Degrees: a pair of numbers this close to the lot's position is a latitude and a longitude, otherwise metres.
NEAR_ON_GLOBE = 1.0

# Fields that a draft and its lot have in common.
_SHARED = (
    "name", "slot_ids", "lanes", "entries", "goals", "walls", "facilities", "zone_rules", "goal_weights",
    "entry_weights", "turns", "left_hand",
)  # fmt: skip


@dataclass(frozen=True)
class ImportOptions:
    """Goals, entries and bounds that complete or replace those of a file."""

    # walking destinations as pairs of numbers: metres east and north in the lot's frame or, for a file with latitudes
    # and longitudes, a latitude and a longitude (any pair within a degree of the lot)
    goals: tuple[tuple[float, float], ...] = ()
    entries: tuple[tuple[float, float], ...] = ()  # places where cars enter, in the same form
    # two corners, in the same form; elements outside are not read
    bounds: tuple[tuple[float, float], tuple[float, float]] | None = None
    guess_entry: bool = False  # whether an entry that the file does not show may be guessed
    guess_goal: bool = False  # the same for goals
    left_hand: bool = False  # whether cars keep to the left

    def __post_init__(self) -> None:
        for what, points in (("goal", self.goals), ("entry", self.entries), ("bounds", self.bounds or ())):
            for point in points:
                if len(point) != 2 or not np.isfinite(point).all():
                    raise InputError(f"{what} is {point!r}, want two finite numbers")

    def box(self, frame: LocalFrame) -> tuple[float, float, float, float] | None:
        if self.bounds is None:
            return None
        corners = points_in_frame(frame, self.bounds)
        (x0, y0), (x1, y1) = corners.min(axis=0).tolist(), corners.max(axis=0).tolist()
        if x1 - x0 < 1.0 or y1 - y0 < 1.0:
            raise InputError(f"bounds are {x1 - x0:.2f} × {y1 - y0:.2f} m, want an area")
        return x0, y0, x1, y1


def points_in_frame(frame: LocalFrame | None, pairs: tuple[tuple[float, float], ...]) -> FloatArray:
    """Convert pairs to metres, (n, 2), in the lot's frame; those within a degree of it are latitude and longitude."""
    points = np.array(pairs, dtype=np.float64).reshape(-1, 2)
    if frame is None or frame.origin is not None or not len(points):
        return points
    away = points - [frame.lat, frame.lon]
    away[:, 1] = (away[:, 1] + 180.0) % 360.0 - 180.0  # across the date line
    on_globe = np.all(np.abs(away) <= NEAR_ON_GLOBE, axis=1, keepdims=True)
    return np.where(on_globe, frame.to_xy(points[:, ::-1]), points)


@dataclass(frozen=True)
class LeftOut:
    """Elements that an import did not use: the reason, and their ids in the file."""

    reason: str
    ids: tuple[str, ...]

    @classmethod
    def by_reason(cls, listed: Mapping[str, Iterable[str]]) -> tuple[Self, ...]:
        return tuple(cls(reason, tuple(ids)) for reason, ids in listed.items() if ids)

    @property
    def shown(self) -> str:
        return ", ".join(self.ids[:5]) + (", ..." if len(self.ids) > 5 else "")

    def __str__(self) -> str:
        return f"{self.reason}: {len(self.ids)} ({self.shown})"


@dataclass(frozen=True, eq=False)
class LotDraft:
    """Slots, lanes, entries and goals found in a file; any may be missing."""

    name: str  # the lot's name
    slot_ids: tuple[str, ...]  # n_slots names
    slots: Slots  # their geometry, lot frame
    slot_source: tuple[str, ...]  # n_slots names of the source of each slot
    lanes: tuple[Lane, ...]  # centre lines
    entries: FloatArray  # (n_entries, 2) m
    goals: FloatArray  # (n_goals, 2) m
    walls: tuple[FloatArray, ...] = ()  # (k, 2) m each
    outlines: tuple[FloatArray, ...] = ()  # (k, 2) m each, parking areas in the file; for figures
    found: tuple[str, ...] = ()  # one line per finding
    guesses: tuple[str, ...] = ()  # one sentence per thing that the file does not say
    issues: tuple[QualityIssue, ...] = ()  # what may be wrong with the result
    left_out: tuple[LeftOut, ...] = ()  # elements that were not used
    unread: tuple[Unread, ...] = ()  # values of tags that could not be read
    missing: tuple[str, ...] = ()  # one sentence per missing part that a search needs, with how to provide it
    frame: LocalFrame | None = None  # geographic frame of the lot; None if the file has none
    facilities: tuple[Facility, ...] = ()  # counted ones need no slot here
    zone_rules: Mapping[str, Zone] = field(default_factory=dict)
    goal_weights: Mapping[str, FloatArray] = field(default_factory=dict)  # by purpose, (n_goals,)
    entry_weights: Mapping[str, FloatArray] = field(default_factory=dict)  # by purpose, (n_entries,)
    turns: tuple[Turn, ...] = ()  # those that cars may not make, or that are the only ones
    left_hand: bool = False  # whether cars keep to the left

    @classmethod
    def of_lot(cls, lot: ParkingLot) -> Self:
        return cls(
            **{name: getattr(lot, name) for name in _SHARED},
            slots=Slots.of_lot(lot),
            slot_source=("the lot file",) * lot.n_slots,
            found=(f"slots: {lot.n_slots}, lanes: {len(lot.lanes)}, of a lot file",),
        )

    def lot(self) -> ParkingLot:
        try:
            return self._lot()
        except GraphError as error:
            problem = error.problems[0]
            what = f"slot {self.slot_ids[problem.index]!r}" if problem.kind == "slot" else problem.kind
            raise InputError(f"{what} {problem.message}") from error

    def _lot(self) -> ParkingLot:
        require(not self.missing, "; ".join(self.missing))
        return ParkingLot(**{name: getattr(self, name) for name in _SHARED}, **self.slots.columns())

    def searchable(self) -> Self:
        """Return the draft without slots and facilities that no entry leads to; an incomplete one unchanged."""
        try:
            lot = self._lot()
        except GraphError as error:
            if error.problems[0].kind != "facility":
                return self
            names = tuple(self.facilities[problem.index].name for problem in error.problems)
            lost = np.isin(self.slots.facility, names)
            return self._without(lost, LeftOut("facilities that no entry leads to", names)).searchable()
        except InputError:
            return self
        far = ~np.isfinite(dijkstra(lot.drive_matrix(), indices=lot.entry_vertices, min_only=True))
        lost = far[: len(self.slot_ids)]
        if not lost.any() or lost.all():
            return self
        ids = tuple(self.slot_ids[i] for i in np.flatnonzero(lost))
        return self._without(lost, LeftOut(UNREACHED, ids))

    def in_left_hand_traffic(self) -> Self:
        """Return the draft where cars keep to the left, and those parked along a lane head the way of its traffic."""
        draft = replace(self, left_hand=True)
        try:
            lot = draft._lot()
        except InputError:
            return draft
        slots, along = self.slots, np.cos(self.slots.yaw - lot.vertex_yaw[: len(self.slots)])
        turned = (slots.mouth != Mouth.REAR) & (along < 0.0)
        # Heading the other way, its left side is the right one.
        mouth = np.where(turned, Mouth.LEFT + Mouth.RIGHT - slots.mouth, slots.mouth).astype(np.int8)
        return replace(draft, slots=replace(slots, yaw=slots.yaw + np.pi * turned, mouth=mouth))

    def _without(self, lost: BoolArray, left_out: LeftOut) -> Self:
        kept = np.flatnonzero(~lost)
        slots = self.slots[kept]
        named = set(slots.facility.tolist())
        return replace(
            self,
            slot_ids=tuple(self.slot_ids[i] for i in kept),
            slots=slots,
            slot_source=tuple(self.slot_source[i] for i in kept),
            left_out=(*self.left_out, left_out),
            facilities=tuple(
                facility
                for facility in self.facilities
                if (facility.is_counted and facility.name not in left_out.ids) or facility.name in named
            ),
        )
