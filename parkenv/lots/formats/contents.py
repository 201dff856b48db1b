"""The contents of a lot file: its valid features, and the errors of the others."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import shapely

from parkenv.compiled.arrays import FloatArray
from parkenv.lots.generators import NO_SLOTS, Slots
from parkenv.lots.local_frame import LocalFrame
from parkenv.world.drive_graph import GraphError, build_drive_graph, linestrings
from parkenv.world.facility import Facility
from parkenv.world.lot import FARTHEST, Lane, ParkingLot, Turn
from parkenv.world.tariff import Zone

KINDS = {
    "slot": ("Polygon",),
    "lane": ("LineString",),
    "entry": ("Point",),
    "goal": ("Point",),
    "wall": ("LineString", "Polygon"),
    "facility": ("Point",),
    "turn": ("LineString",),
}
"""The kinds of features, and the geometry types allowed for each."""


@dataclass(frozen=True)
class LotProblem:
    """An error or warning about a lot file; `feature` is the 0-based index in the FeatureCollection."""

    severity: Literal["error", "warning"]
    feature: int | None
    message: str

    def __str__(self) -> str:
        where = "" if self.feature is None else f"feature {self.feature}: "
        return f"{self.severity}: {where}{self.message}"


@dataclass(frozen=True)
class RawFeature:
    """A feature with a valid geometry: its parts are slices of one array of all positions."""

    number: int
    kind: str
    properties: dict[str, Any]
    parts: list[slice]
    given_id: object


def is_coordinate(value: Any) -> bool:
    """Whether a JSON value is a finite number within `FARTHEST`."""
    # Comparisons with NaN are false; a bool is an int in Python but not a number in JSON.
    return type(value) in (float, int) and abs(value) <= FARTHEST


@dataclass
class LotContents:
    """The valid features of a file; `numbers[kind]` are their feature numbers, `errors` those of the other features."""

    name: str
    found: str = ""  # what was recognised of the positions
    frame: LocalFrame | None = None  # where the lot is, of a file in degrees
    slot_ids: list[str] = field(default_factory=list)
    slots: Slots = NO_SLOTS
    lanes: list[Lane] = field(default_factory=list)
    entries: list[FloatArray] = field(default_factory=list)
    goals: list[FloatArray] = field(default_factory=list)
    walls: list[FloatArray] = field(default_factory=list)
    turns: list[Turn] = field(default_factory=list)
    left_hand: bool = False
    facilities: list[Facility] = field(default_factory=list)
    zone_rules: dict[str, Zone] = field(default_factory=dict)
    # by kind, `goal` or `entry`: the weights by purpose of each
    weights: dict[str, list[dict[str, float]]] = field(default_factory=lambda: {"entry": [], "goal": []})
    numbers: dict[str, list[int]] = field(default_factory=lambda: {kind: [] for kind in KINDS})
    errors: list[LotProblem] = field(default_factory=list)

    def columns(self) -> dict[str, Any]:
        """Return the keyword arguments of `ParkingLot`."""
        return {
            "name": self.name,
            "slot_ids": tuple(self.slot_ids),
            **self.slots.columns(),
            "lanes": tuple(self.lanes),
            "entries": np.array(self.entries),
            "goals": np.array(self.goals),
            "walls": tuple(self.walls),
            "facilities": tuple(self.facilities),
            "zone_rules": self.zone_rules,
            "goal_weights": self._weights("goal"),
            "entry_weights": self._weights("entry"),
            "turns": tuple(self.turns),
            "left_hand": self.left_hand,
        }

    def _weights(self, kind: str) -> dict[str, FloatArray]:
        """Return the weights of goals or entries by purpose, (n,) each; 0 where one has none."""
        each = self.weights[kind]
        purposes = dict.fromkeys(purpose for weights in each for purpose in weights)
        return {name: np.array([weights.get(name, 0.0) for weights in each]) for name in purposes}

    def error(self, feature: int | None, message: str) -> None:
        """Record an error of a feature, or of the file as a whole."""
        self.errors.append(LotProblem("error", feature, message))


def graph_errors(contents: LotContents) -> list[LotProblem]:
    """Return errors of the drive graph: slots, entries, turns and facilities without a lane, crowded junctions."""
    lanes = [(lane.points, lane.oneway, lane.speed) for lane in contents.lanes]
    if not lanes:
        return []
    mouth_xy = contents.slots.mouths()
    entries = np.array(contents.entries).reshape(-1, 2)
    turns = [(turn.points, turn.only) for turn in contents.turns]
    left = {
        kind: np.arange(len(its)) for kind, its in (("slot", mouth_xy), ("entry", entries), ("turn", turns))
    }
    errors = []
    while True:
        # Remove faulty features and repeat, so that all faults are found.
        try:
            build_drive_graph(
                lanes, mouth_xy[left["slot"]], entries[left["entry"]], [turns[i] for i in left["turn"]]
            )
        except GraphError as error:
            kind = error.problems[0].kind
            for problem in error.problems:
                if kind == "junction":
                    distance = shapely.distance(
                        linestrings([points for points, _, _ in lanes]), shapely.Point(problem.xy)
                    )
                    feature = contents.numbers["lane"][int(np.argmin(distance))]
                    message = f"lane: the junction {problem.message}"
                else:
                    index = left[kind][problem.index]
                    feature = contents.numbers[kind][index]
                    name = f"slot {contents.slot_ids[index]!r:.40}" if kind == "slot" else kind
                    message = f"{name} {problem.message}"
                errors.append(LotProblem("error", feature, message))
            if kind == "junction":
                return errors
            left[kind] = np.delete(left[kind], [problem.index for problem in error.problems])
        else:
            return errors or _facility_errors(contents)


def _facility_errors(contents: LotContents) -> list[LotProblem]:
    """Return the errors of facilities that are out of reach; those of other features are known."""
    if contents.errors or not contents.facilities:
        return []
    try:
        ParkingLot(**contents.columns())
    except GraphError as error:
        numbers = contents.numbers["facility"]
        return [
            LotProblem("error", numbers[problem.index], f"facility {problem.message}")
            for problem in error.problems
        ]
    return []
