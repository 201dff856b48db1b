"""Compare detectors on whole survey drives: cars found, slots right and the map, and what the missed cars look like."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import BoolArray, IntArray
from parkenv.errors import InputError
from parkenv.files.csv_tables import NUMBER_OR_NAN, typed_records, write_csv
from parkenv.mapping.distance_bins import DISTANCE_ENDS
from parkenv.mapping.store import MapStore
from parkenv.mapping.survey import Survey, SurveySettings
from parkenv.mapping.survey_score import CLEAR, SIDES, SIGHTING
from parkenv.studies.results import Row
from parkenv.studies.sensing.detector_drives import DISTANCES, LEAST_HEIGHT, VISIBLE, bins, parts_of
from parkenv.studies.sensing.sessions import MAP_FILE
from parkenv.studies.sensing.surveys import map_error
from parkenv.studies.statistics import rate_interval
from parkenv.world.scenario import Scenario
from sim_sensors.camera.weather import PRESETS
from sim_sensors.ground_truth import View
from sim_sensors.rig import SensorRig

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
MEASURES = ("cars", "in_pictures", "boxes", "slots", "unknown", "wrong")
TABLE_COLUMNS = (
    "rig", "detector", "group", "part",
    *(f"{m}{c}" for m in MEASURES for c in ("", "_rate", "_low", "_high")), "place_error_m", "map_error",
)  # fmt: skip


@dataclass(frozen=True)
class DetectorSurvey:
    """A detector's survey with a rig, and where its sessions are stored."""

    settings: SurveySettings
    folder: Path

    def sightings_file(self, number: int) -> Path:
        """Return the table of the sightings of a session."""
        return self.folder / "sightings" / f"{number:05d}.csv"


class SurveyedDrive(NamedTuple):
    """What is kept of one session of a detector's survey."""

    number: int  # of the session
    row: Row  # of `sessions.csv`
    sightings: Sightings


class _Seen(NamedTuple):
    """The sightings of all drives of a survey, n in all."""

    sightings: Sightings
    drive: IntArray  # (n,) row of the drive
    weather: NDArray[np.str_]  # (n,)
    wanted: BoolArray  # (n,) see `is_wanted`
    cause: IntArray  # (n,) see `causes_of`
    n_drives: int

    @classmethod
    def of(cls, survey: DetectorSurvey, drives: Sequence[SurveyedDrive]) -> Self:
        lengths = [len(drive.sightings) for drive in drives]
        every = np.concatenate([drive.sightings for drive in drives])
        weather = np.repeat([drive.row["weather"] for drive in drives], lengths)
        height, width = _picture_size(survey.settings.rig)
        cause = causes_of(every, weather, width, height)
        return cls(
            every, np.repeat(np.arange(len(drives)), lengths), weather, is_wanted(every), cause, len(drives)
        )

    def counts(self, part: BoolArray, weights: NDArray[Any] | None = None) -> list[int]:
        """Return the number of sightings of a part in each drive, or the sum of their weights."""
        weights = None if weights is None else weights[part]
        counted: list[int] = np.bincount(self.drive[part], weights, self.n_drives).astype(int).tolist()
        return counted


def comparison_table(
    scenario: Scenario, survey: DetectorSurvey, drives: Sequence[SurveyedDrive]
) -> list[Row]:
    """Return the rows of a survey in the comparison: all, by weather, distance, visible fraction, and cause.

    Rates have 95 % intervals over drives (`rate_interval`). In pictures, parked cars count that are within 20 m, 16 px
    high, and 30 % visible; boxes are those that are cars, by the car's distance, else by the measured one.

    Returns:
        Rows with `TABLE_COLUMNS`; a measure that a part does not have is None.
    """
    seen = _Seen.of(survey, drives)
    boxes, visible = seen.sightings["boxes"], seen.sightings["visible"]

    def in_pictures(part: BoolArray) -> Row:
        cars = seen.wanted & part
        return _rate("in_pictures", seen.counts(cars & (boxes > 0)), seen.counts(cars))

    def of_boxes(part: BoolArray) -> Row:
        return _rate("boxes", seen.counts(part & (visible > 0), boxes), seen.counts(part, boxes))

    def of_drives(which: Sequence[SurveyedDrive]) -> Row:
        rows = [d.row for d in which]
        slots = scenario.lot.n_slots
        right, unknown = ([r[name] for r in rows] for name in ("slot_accuracy", "unknown_fraction"))
        wrong = [1.0 - a - b for a, b in zip(right, unknown, strict=True)]

        def of_slots(name: str, shares: Sequence[float]) -> Row:
            return _rate(name, [round(share * slots) for share in shares], [slots] * len(rows))

        place = [r["place_error_m"] for r in rows if np.isfinite(r["place_error_m"])]
        return (
            _rate("cars", [r["found"] for r in rows], [r["parked"] for r in rows])
            | _rate("boxes", [r["right"] for r in rows], [r["detections"] for r in rows])
            | of_slots("slots", right)
            | of_slots("unknown", unknown)
            | of_slots("wrong", wrong)
            | {"place_error_m": float(np.mean(place)) if place else None}
        )

    with MapStore(survey.folder / MAP_FILE, scenario.lot, create=False) as store:
        error, _ = map_error(scenario, survey.settings.windows, store.log({d.row["key"] for d in drives}))
    whole = of_drives(drives) | in_pictures(np.ones(len(boxes), np.bool_)) | {"map_error": error}
    table = [("all", "all", whole)]
    table += [
        ("weather", weather, of_drives(which) | in_pictures(seen.weather == weather))
        for weather in PRESETS
        if (which := [d for d in drives if d.row["weather"] == weather])
    ]
    table += [
        (group, name, in_pictures(part) | (of_boxes(part) if group == "distance" else {}))
        for group, name, part in parts_of(seen.sightings["distance"], visible)
    ]
    of_drive = ([column[seen.drive == k] for column in seen[:5]] for k in range(len(drives)))
    never = [cause for s, _, _, wanted, causes in of_drive for cause in never_found(s, wanted, causes)]
    # `cars`: of those that were never found in a drive, those whose best picture is of this kind.
    table += [
        ("cause", name, in_pictures(seen.cause == i) | {"cars": never.count(i)})
        for i, name in enumerate(CAUSES)
    ]
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
    seen = _Seen.of(survey, drives)
    s = seen.sightings
    whole = (s["left"] > 0) & (s["top"] > 0) & (s["right"] < width) & (s["bottom"] < height)
    clear = seen.wanted & (s["visible"] >= CLEAR) & whole
    head = {"rig": survey.settings.rig, "detector": survey.settings.detector}
    table = []
    for weather in (ALL_WEATHERS, *PRESETS):
        its = clear & ((weather == ALL_WEATHERS) | (seen.weather == weather))
        for low, high, part in bins(s["distance"], (0.0, *DISTANCE_ENDS, DISTANCES[-1])):
            found, cars = seen.counts(its & part & (s["boxes"] > 0)), seen.counts(its & part)
            if sum(cars):
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


def causes_of(
    sightings: Sightings, weather: str | NDArray[np.str_], width: int, height: int
) -> NDArray[np.int64]:
    """Return the index in `CAUSES` of each sighting, in pictures of this size, px, of one weather or of one each."""
    s = sightings
    left, right = s["left"] <= 0, s["right"] >= width
    holds = np.broadcast_arrays(
        (s["top"] <= 0) | (s["bottom"] >= height) | (left & right),
        left | right,
        s["visible"] < VISIBLE[-2],
        s["distance"] > FAR,
        np.asarray(weather) == "dusk",
        s["view"] == View.OBLIQUE,
        True,
    )
    return np.asarray(np.argmax(holds, axis=0), dtype=np.int64)


def never_found(sightings: Sightings, wanted: BoolArray, causes: IntArray) -> NDArray[np.int64]:
    """Return, for each car in a drive's pictures that was never located in its slot, the cause of its best one."""
    s = sightings
    there = np.unique(s["slot"][wanted])
    missed = np.setdiff1d(there, s["slot"][(s["placed"] > 0) & (s["slot"] >= 0)])
    return np.array([causes[wanted & (s["slot"] == slot)].max() for slot in missed], dtype=np.int64)


class Miss(NamedTuple):
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
    seen, rng = _Seen.of(survey, drives), np.random.default_rng(seed)
    chosen = []
    for i, cause in enumerate(CAUSES):
        cars = {}
        missed = seen.wanted & (seen.sightings["boxes"] == 0) & (seen.cause == i)
        for k, drive in enumerate(drives):
            for row in rng.permutation(np.flatnonzero(missed & (seen.drive == k))).tolist():
                car = seen.sightings[row]
                cars[drive.number, int(car["slot"])] = Miss(drive.number, drive.row["weather"], cause, car)
        misses = list(cars.values())
        chosen += [misses[k] for k in rng.permutation(len(misses))[:number].tolist()]
    return chosen


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
    from parkenv.show.figures.detectors import MissedCar, save_misses

    chosen = [choose_misses(survey, its, number, seed) for survey, its in zip(surveys, drives, strict=True)]
    of_rig = itertools.groupby(zip(surveys, chosen, strict=True), lambda s: s[0].settings.rig)
    for rig, group in of_rig:
        sheets = list(group)
        wanted = {miss.picture for _, cars in sheets for miss in cars}
        pictures = pictures_of(scenario, sheets[0][0].settings, wanted)
        for survey, cars in sheets:
            detector, by_cause = survey.settings.detector, dict[str, list[MissedCar]]()
            for row in table:
                if (row["rig"], row["detector"], row["group"]) != (rig, detector, "cause"):
                    continue
                cause, there = row["part"], row["in_pictures"]
                missed = round(there * (1.0 - row["in_pictures_rate"])) if there else 0
                by_cause[f"{cause} ({CAUSES[cause]}): {missed:,} of {there:,} missed"] = [
                    MissedCar(
                        pictures[miss.picture],
                        [float(miss.sighting[side]) for side in SIDES],
                        float(miss.sighting["distance"]),
                        float(miss.sighting["visible"]),
                        miss.weather,
                    )
                    for miss in cars
                    if miss.cause == cause
                ]
            title = f"Cars that {detector} missed in pictures of {scenario.name}, rig {rig}"
            save_misses(by_cause, title, folder / f"misses_{survey.folder.name}.png")


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
