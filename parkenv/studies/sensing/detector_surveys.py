"""Compare detectors on whole survey drives: cars found, slots right and the map, and what the missed cars look like."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import BoolArray
from parkenv.errors import InputError
from parkenv.files.csv_tables import NUMBER_OR_NAN, typed_records, write_csv
from parkenv.mapping.distance_bins import DISTANCE_ENDS
from parkenv.mapping.store import MapStore
from parkenv.mapping.survey import Survey, SurveySettings
from parkenv.mapping.survey_score import CLEAR, SIDES, SIGHTING
from parkenv.studies.results import Row
from parkenv.studies.sensing.detector_drives import DISTANCES, LEAST_HEIGHT, VISIBLE
from parkenv.studies.sensing.sessions import MAP_FILE
from parkenv.studies.sensing.surveys import map_error
from parkenv.studies.statistics import rate_interval
from parkenv.world.scenario import Scenario
from sim_sensors.camera.weather import PRESETS
from sim_sensors.ground_truth import View
from sim_sensors.rig import SensorRig

if TYPE_CHECKING:
    from parkenv.show.figures.detectors import MissedCar

Sightings = NDArray[np.void]

FAR = 12.0
"""m, from which a car counts as far."""
ALL_WEATHERS = "all weathers"
CAUSES = {
    "fills the picture": "reaches its upper or lower border, or both sides: the car is too near to fit",
    "cut off": "reaches the picture's left or right border",
    "hidden": "less than 90 % of it are visible",
    "far": f"more than {FAR:g} m away",
    "dusk": "at dusk",
    "oblique": "seen between 30° and 60° from its axis",
    "in plain view": "none of these",
}
"""Why a car may be hard to find in a picture; the first that holds, decided by the simulated truth alone."""
MEASURES = ("cars", "in_pictures", "boxes", "slots")
TABLE_COLUMNS = (
    "rig", "detector", "group", "part",
    *(f"{m}{c}" for m in MEASURES for c in ("", "_rate", "_low", "_high")), "place_error_m", "map_error",
)  # fmt: skip


@dataclass(frozen=True)
class DetectorSurvey:
    """A detector's survey with a rig, and where its sessions are stored."""

    settings: SurveySettings
    folder: Path

    @property
    def name(self) -> str:
        """Rig and detector, for tables and figures."""
        return f"{self.settings.rig}, {self.settings.detector}"

    def sightings_file(self, number: int) -> Path:
        """Return the table of the sightings of a session."""
        return self.folder / "sightings" / f"{number:05d}.csv"


@dataclass(frozen=True, eq=False)
class SurveyedDrive:
    """What is kept of one session of a detector's survey."""

    number: int  # of the session
    row: Row  # of `sessions.csv`
    sightings: Sightings


def comparison_table(
    scenario: Scenario, survey: DetectorSurvey, drives: Sequence[SurveyedDrive]
) -> list[Row]:
    """Return the rows of a survey in the comparison: all, by weather, distance, visible fraction, and cause.

    Rates have 95 % intervals over drives (`rate_interval`). In pictures, parked cars count that are within 20 m, 16 px
    high, and 30 % visible; boxes are those that are cars, by the car's distance, else by the measured one.

    Returns:
        Rows with `TABLE_COLUMNS`; a measure that a part does not have is None.
    """
    height, width = _picture_size(survey.settings.rig)
    wanted = [is_wanted(d.sightings) for d in drives]
    causes = [causes_of(d.sightings, d.row["weather"], width, height) for d in drives]
    everything = [np.ones(len(d.sightings), dtype=np.bool_) for d in drives]

    def in_pictures(parts: Sequence[BoolArray]) -> Row:
        cars = [w & p for w, p in zip(wanted, parts, strict=True)]
        found = [int((d.sightings["boxes"][c] > 0).sum()) for d, c in zip(drives, cars, strict=True)]
        return _rate("in_pictures", found, [int(c.sum()) for c in cars])

    def boxes(parts: Sequence[BoolArray]) -> Row:
        counts = [
            (
                int(d.sightings["boxes"][p & (d.sightings["visible"] > 0)].sum()),
                int(d.sightings["boxes"][p].sum()),
            )
            for d, p in zip(drives, parts, strict=True)
        ]
        return _rate("boxes", *zip(*counts, strict=True))

    def drive_measures(which: Sequence[SurveyedDrive]) -> Row:
        rows = [d.row for d in which]
        slots = scenario.lot.n_slots
        place = [r["place_error_m"] for r in rows if np.isfinite(r["place_error_m"])]
        return (
            _rate("cars", [r["found"] for r in rows], [r["parked"] for r in rows])
            | _rate("boxes", [r["right"] for r in rows], [r["detections"] for r in rows])
            | _rate("slots", [round(r["slot_accuracy"] * slots) for r in rows], [slots] * len(rows))
            | {"place_error_m": float(np.mean(place)) if place else None}
        )

    with MapStore(survey.folder / MAP_FILE, scenario.lot, create=False) as store:
        log = store.log({d.row["key"] for d in drives})
    table = [("all", "all", drive_measures(drives) | in_pictures(everything))]
    table[0][2]["map_error"] = map_error(scenario, survey.settings.windows, log)[0]
    for weather in PRESETS:
        which = [d for d in drives if d.row["weather"] == weather]
        of_it = [np.full(len(d.sightings), d.row["weather"] == weather) for d in drives]
        if which:
            table.append(("weather", weather, drive_measures(which) | in_pictures(of_it)))
    for low, high in itertools.pairwise(DISTANCES):
        within = [(d.sightings["distance"] >= low) & (d.sightings["distance"] < high) for d in drives]
        table.append(("distance", f"{low:g} to {high:g} m", in_pictures(within) | boxes(within)))
    for low, high in itertools.pairwise(VISIBLE):
        within = [(d.sightings["visible"] >= low) & (d.sightings["visible"] < high) for d in drives]
        table.append(("visible", f"{low:.0%} to {high:.0%} visible", in_pictures(within)))
    names = list(CAUSES)
    never = [never_found(d, w, c) for d, w, c in zip(drives, wanted, causes, strict=True)]
    for i, name in enumerate(names):
        row = in_pictures([c == i for c in causes])
        # `cars`: of those that were never found in a drive, those whose best picture is of this kind.
        missed = sum(int((best == i).sum()) for best in never)
        table.append(("cause", name, row | {"cars": missed}))
    empty = dict.fromkeys(TABLE_COLUMNS)
    head = {"rig": survey.settings.rig, "detector": survey.settings.detector}
    return [empty | head | {"group": group, "part": part} | row for group, part, row in table]


def reach_table(survey: DetectorSurvey, drives: Sequence[SurveyedDrive]) -> list[Row]:
    """Return how often a car that is whole in a picture and mostly visible is found in it, by weather and distance.

    Returns:
        Rows with rig, detector, weather (the first are of all), distance_m (both ends of the bin), cars, and rate with
        its 95 % interval (low, high), for every bin with a car.
    """
    height, width = _picture_size(survey.settings.rig)
    clear = [
        is_wanted(s) & (s["visible"] >= CLEAR) & (s["left"] > 0) & (s["top"] > 0)
        & (s["right"] < width) & (s["bottom"] < height)
        for s in (d.sightings for d in drives)
    ]  # fmt: skip
    head = {"rig": survey.settings.rig, "detector": survey.settings.detector}
    table = []
    for weather in (ALL_WEATHERS, *PRESETS):
        its = [
            d.sightings[c]
            for d, c in zip(drives, clear, strict=True)
            if weather in (ALL_WEATHERS, d.row["weather"])
        ]
        for low, high in itertools.pairwise((0.0, *DISTANCE_ENDS, DISTANCES[-1])):
            within = [s[(s["distance"] >= low) & (s["distance"] < high)] for s in its]
            cars = [len(s) for s in within]
            if sum(cars):
                found = [int((s["boxes"] > 0).sum()) for s in within]
                interval = dict(zip(("rate", "low", "high"), rate_interval(found, cars), strict=True))
                place = {"weather": weather, "distance_m": [low, high], "cars": sum(cars)}
                table.append(head | place | interval)
    return table


def is_wanted(sightings: Sightings) -> BoolArray:
    """Return which sightings are parked cars that should be found, as in `score_on_drives`."""
    s = sightings
    high = s["bottom"] - s["top"] >= LEAST_HEIGHT
    wanted = (s["slot"] >= 0) & (s["visible"] >= VISIBLE[0]) & high & (s["distance"] < DISTANCES[-1])
    return np.asarray(wanted)


def causes_of(sightings: Sightings, weather: str, width: int, height: int) -> NDArray[np.int64]:
    """Return the index in `CAUSES` of each sighting, in pictures of this size, px."""
    s = sightings
    left, right = s["left"] <= 0, s["right"] >= width
    holds = [
        (s["top"] <= 0) | (s["bottom"] >= height) | (left & right),
        left | right,
        s["visible"] < VISIBLE[-2],
        s["distance"] > FAR,
        np.full(len(s), weather == "dusk"),
        s["view"] == View.OBLIQUE,
        np.ones(len(s), dtype=np.bool_),
    ]
    return np.asarray(np.argmax(holds, axis=0), dtype=np.int64)


def never_found(drive: SurveyedDrive, wanted: BoolArray, causes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return, for each car that stood in pictures but was never located in its slot, the cause of its best one."""
    s = drive.sightings
    there = np.unique(s["slot"][wanted])
    missed = np.setdiff1d(there, s["slot"][(s["placed"] > 0) & (s["slot"] >= 0)])
    return np.array([causes[wanted & (s["slot"] == slot)].max() for slot in missed], dtype=np.int64)


@dataclass(frozen=True, eq=False)
class Miss:
    """A parked car in a picture that a detector missed."""

    session: int
    weather: str
    cause: str  # one of `CAUSES`
    sighting: np.void

    @property
    def picture(self) -> tuple[int, int, int]:
        """Session, capture and camera."""
        return self.session, int(self.sighting["capture"]), int(self.sighting["camera"])


def choose_misses(
    survey: DetectorSurvey, drives: Sequence[SurveyedDrive], number: int, seed: int = 0
) -> list[Miss]:
    """Choose missed cars at random, up to `number` of each cause, each car once in a drive."""
    height, width = _picture_size(survey.settings.rig)
    rng = np.random.default_rng(seed)
    chosen = []
    for i, cause in enumerate(CAUSES):
        cars = {}
        for drive in drives:
            s, weather = drive.sightings, drive.row["weather"]
            missed = is_wanted(s) & (s["boxes"] == 0) & (causes_of(s, weather, width, height) == i)
            for row in rng.permutation(np.flatnonzero(missed)).tolist():
                cars[drive.number, int(s["slot"][row])] = Miss(drive.number, weather, cause, s[row])
        misses = list(cars.values())
        chosen += [misses[k] for k in rng.permutation(len(misses))[:number].tolist()]
    return chosen


def missed_by_cause(
    misses: Sequence[Miss],
    pictures: Mapping[tuple[int, int, int], NDArray[np.uint8]],
    rows: Sequence[Row],
) -> dict[str, list[MissedCar]]:
    """Return missed cars for a contact sheet, by cause; the headings say how many there are in all.

    Args:
        misses: the cars.
        pictures: from `pictures_of`.
        rows: rows of the group `cause` of the comparison.
    """
    from parkenv.show.figures.detectors import MissedCar  # loads Matplotlib

    sheet: dict[str, list[MissedCar]] = {}
    for row in rows:
        cause = row["part"]
        missed = round(row["in_pictures"] * (1.0 - row["in_pictures_rate"])) if row["in_pictures"] else 0
        heading = f"{cause} ({CAUSES[cause]}): {missed:,} of {row['in_pictures']:,} missed"
        sheet[heading] = [
            MissedCar(
                pictures[miss.picture],
                [float(miss.sighting[side]) for side in SIDES],
                float(miss.sighting["distance"]),
                float(miss.sighting["visible"]),
                miss.weather,
            )
            for miss in misses
            if miss.cause == cause
        ]
    return sheet


def pictures_of(
    scenario: Scenario, settings: SurveySettings, pictures: Collection[tuple[int, int, int]]
) -> dict[tuple[int, int, int], NDArray[np.uint8]]:
    """Draw pictures of survey drives once more.

    Args:
        scenario: the scenario.
        settings: settings of the survey.
        pictures: session, capture and camera of each.
    """
    survey = Survey(scenario, settings)
    drawn: dict[tuple[int, int, int], NDArray[np.uint8]] = {}
    for session, of_session in itertools.groupby(sorted(pictures), lambda picture: picture[0]):
        drive = survey.draw(session)
        for i, of_capture in itertools.groupby(of_session, lambda picture: picture[1]):
            _, capture = drive.capture(i)
            frames = [*capture.images.values(), *(pair.left for pair in capture.pairs.values())]
            drawn |= {picture: frames[picture[2]].image for picture in of_capture}
    return drawn


def draw_misses(
    scenario: Scenario,
    surveys: Sequence[DetectorSurvey],
    drives: Sequence[Sequence[SurveyedDrive]],
    number: int,
    seed: int,
    table: Sequence[Row],
    folder: Path,
) -> None:
    """Draw a contact sheet of missed cars for each survey; rigs draw their pictures once for all detectors.

    Args:
        scenario: the scenario.
        surveys: the surveys, those of a rig one after the other.
        drives: the drives of each.
        number: number of missed cars of each cause.
        seed: seed of the choice.
        table: rows of `comparison_table`.
        folder: where the sheets go.
    """
    from parkenv.show.figures.detectors import save_misses

    chosen = [choose_misses(survey, its, number, seed) for survey, its in zip(surveys, drives, strict=True)]
    of_rig = itertools.groupby(zip(surveys, chosen, strict=True), lambda s: s[0].settings.rig)
    for _, group in of_rig:
        sheets = list(group)
        wanted = {miss.picture for _, cars in sheets for miss in cars}
        pictures = pictures_of(scenario, sheets[0][0].settings, wanted)
        for survey, cars in sheets:
            rig, detector = survey.settings.rig, survey.settings.detector
            rows = [r for r in table if (r["rig"], r["detector"], r["group"]) == (rig, detector, "cause")]
            title = f"Cars that {detector} missed in pictures of {scenario.name}, rig {rig}"
            missed = missed_by_cause(cars, pictures, rows)
            save_misses(missed, title, folder / f"misses_{survey.folder.name}.png")


def _rate(measure: str, right: Sequence[int], total: Sequence[int]) -> Row:
    rate, low, high = rate_interval(right, total)
    values = (int(sum(total)), rate, low, high) if sum(total) else (0, None, None, None)
    return dict(zip((measure, *(f"{measure}_{c}" for c in ("rate", "low", "high"))), values, strict=True))


def _picture_size(rig: str) -> tuple[int, int]:
    its = SensorRig.named(rig)
    camera = [*(c for _, c, _ in its.cameras), *(pair.camera for _, pair, _ in its.stereo_cameras)][0]
    return camera.height, camera.width


def write_sightings(path: Path, sightings: Sightings) -> None:
    """Write the sightings of a session as CSV."""
    names = SIGHTING.names or ()
    write_csv(path, names, (dict(zip(names, row, strict=True)) for row in sightings.tolist()))


def read_sightings(path: Path) -> Sightings:
    """Read the records of `write_sightings`.

    Raises:
        InputError: the file is missing, damaged, or not of this version.
    """
    if not path.exists():
        raise InputError(
            f"{path}: is missing; delete the folder {path.parents[1]} to drive its sessions again"
        )
    names = SIGHTING.names or ()
    rows = [tuple(row.values()) for _, row in typed_records(path, lambda _: NUMBER_OR_NAN, names)]
    return np.array(rows, dtype=SIGHTING)
