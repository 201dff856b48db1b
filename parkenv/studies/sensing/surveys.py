"""Run surveys: record many sessions in a map file, and measure the errors of sessions and map."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray
from parkenv.errors import InputError
from parkenv.files.csv_writing import write_csv
from parkenv.files.typed_csv import NUMBER_OR_NAN, TEXT, WHOLE, Kind, typed_records, wholes
from parkenv.mapping.discovery import FoundSlots, discover, score_discovery
from parkenv.mapping.inference import SessionLog, predict
from parkenv.mapping.odometry import PoseNoise
from parkenv.mapping.store import MapStore
from parkenv.mapping.survey import SessionResult, Survey, SurveySettings
from parkenv.mapping.survey_score import DISTANCE_ENDS, METHODS
from parkenv.scenarios.build import build
from parkenv.studies.spec import BUSY, SurveySpec
from parkenv.studies.workers import HERE, Workers
from parkenv.world.occupancy.counted import CountedOccupancy
from parkenv.world.occupancy.log import weekday_of
from parkenv.world.occupancy.process import Arrival, ArrivalWindow, OccupancyModel
from parkenv.world.occupancy.recorded import RecordedOccupancy
from parkenv.world.scenario import Scenario
from parkenv.world.week import DAY_S

MAP_FILE = "map.sqlite"
"""Map of the sessions in the folder of a survey or a demo."""
Row = dict[str, Any]
Recorder = Callable[[Survey, int, int], tuple[SessionResult, Any]]
"""Drives a session, given its number and the number of perception results to keep, and records it."""

PICTURES = 4
"""Number of perception results of the first session that are kept for figures."""

ERROR_COLUMNS = ("range_error_m", "range_error_p95_m", "place_error_m", "heading_error_deg")
SESSION_COLUMNS = (
    "key", "weather", "time_s", "parked", "found", "detections", "right",
    *ERROR_COLUMNS, *(f"thesis_{name}" for name in ERROR_COLUMNS),
    "slot_accuracy", "slot_accuracy_seen", "unknown_fraction", "occupied_fraction", "seconds_per_frame",
    "cars_in_frame", "cars_detected", "odometry_error_m", "pose_error_m", "pose_error_max_m",
)  # fmt: skip


_KINDS = {
    **dict.fromkeys(("key", "weather"), TEXT),
    **dict.fromkeys(("parked", "found", "detections", "right"), WHOLE),
    **dict.fromkeys(("cars_in_frame", "cars_detected"), wholes(len(DISTANCE_ENDS))),
}
"""What a column of `sessions.csv` holds; all others hold numbers."""


@dataclass(frozen=True, eq=False)
class SurveyRun:
    """A completed survey."""

    rows: list[Row]  # one row per session, in order
    # the first session, with results for figures; None if all sessions already existed
    shown: SessionResult | None
    recorded: Any = None  # what `record` of `run_survey` made of it


def survey_of(spec: SurveySpec) -> tuple[Scenario, SurveySettings]:
    """Return the scenario and the settings of a survey specification.

    Raises:
        InputError: the scenario cannot be made.
    """
    described = spec.scenario if spec.scenario.traffic else spec.scenario.changed(traffic=BUSY)
    days = spec.scenario.arrivals.days
    settings = SurveySettings(
        rig=spec.rig or spec.scenario.rig,
        every=spec.every,
        weather=spec.weather,
        windows=tuple(ArrivalWindow.parse(hours, days) for hours in spec.hours),
        pose_noise=PoseNoise(spec.pose_noise, 0.02 * spec.pose_noise, drift=spec.odometry_drift),
        localise=spec.localise,
        seed=spec.seed,
        detector=spec.detector or spec.scenario.detector,
        picture_width=spec.picture_width,
    )
    return build(described), settings


def session_row(result: SessionResult) -> Row:
    """Return the row of a session in `sessions.csv`."""
    score = result.score
    return dict(
        zip(
            SESSION_COLUMNS,
            (
                result.session.key, result.session.weather, result.arrival.time, result.parked, result.found,
                score.detections, score.right,
                *(value for method in METHODS for value in _error_columns(score.errors(method))),
                result.slot_accuracy, result.slot_accuracy_seen, float(1.0 - result.states.in_view.mean()),
                float(result.truth.mean()), float(np.median(result.frame_s)),
                *(" ".join(map(str, counts.tolist())) for counts in score.in_frame.T),
                *_pose_errors(result),
            ),
            strict=True,
        )
    )  # fmt: skip


def _pose_errors(result: SessionResult) -> tuple[float, float, float]:
    """Return the root mean square error of the odometry's positions, m, that of the estimated ones, and its maximum."""
    odometry, estimated = (
        np.hypot(*(poses - result.true_poses)[:, :2].T) for poses in (result.odometry, result.poses)
    )
    return (
        float(np.sqrt((odometry**2).mean())),
        float(np.sqrt((estimated**2).mean())),
        float(estimated.max()),
    )


def _error_columns(errors: FloatArray) -> tuple[float, ...]:
    """Return the values of `ERROR_COLUMNS`: medians, except the second."""
    if not len(errors):
        return (float("nan"),) * len(ERROR_COLUMNS)
    middle = np.median(errors, axis=0)
    far = float(np.quantile(errors[:, 0], 0.95))
    return float(middle[0]), far, float(middle[1]), float(np.degrees(middle[2]))


def run_survey(
    scenario: Scenario,
    settings: SurveySettings,
    sessions: int,
    map_file: Path,
    *,
    workers: Workers = HERE,
    record: Recorder | None = None,
    on_session: Callable[[Row], None] = lambda _: None,
) -> SurveyRun:
    """Drive the sessions that the map file does not hold yet, and write each in one transaction.

    Args:
        scenario: the scenario.
        settings: settings of the survey.
        sessions: number of sessions.
        map_file: created if it does not exist. `sessions.csv` beside it holds the errors of each session.
        workers: where the sessions run; results do not depend on it.
        record: drives the first session, and records it; None not to record it.
        on_session: called with the row of each completed session.

    Raises:
        InputError: fewer than one session, or an unusable map file.
    """
    if sessions < 1:
        raise InputError(f"sessions is {sessions}, want at least 1")
    survey = Survey(scenario, settings)
    table = map_file.with_name("sessions.csv")
    with MapStore(map_file, scenario.lot) as store:
        rows = stored_sessions(store, table)
        wanted = [survey.key_of(k) for k in range(sessions)]
        missing = [k for k, key in enumerate(wanted) if key not in rows]
        shown = recorded = None
        for number, (result, recording) in zip(
            missing, _driven(survey, missing, workers, record), strict=True
        ):
            row = store_session(result, rows, store, table)
            if number == 0:
                shown, recorded = result, recording
            on_session(row)
    return SurveyRun([rows[key] for key in wanted], shown, recorded)


def stored_sessions(store: MapStore, table: Path) -> dict[str, Row]:
    """Return the rows of the sessions that a map file and its `sessions.csv` hold, by their keys.

    A row is written before its session: a row without a session is from an interrupted drive, which is repeated.
    """
    return {row["key"]: row for row in read_sessions(table) if store.has(row["key"])}


def store_session(result: SessionResult, rows: dict[str, Row], store: MapStore, table: Path) -> Row:
    """Add a session to `stored_sessions`, to the table and to the map; return its row."""
    row = session_row(result)
    rows[row["key"]] = row
    write_csv(table, SESSION_COLUMNS, list(rows.values()))
    if not store.has(row["key"]):
        store.add(result.session)
    return row


def summarize(scenario: Scenario, settings: SurveySettings, run: SurveyRun, map_file: Path) -> Row:
    """Return the row of `summary.json`."""
    with MapStore(map_file, scenario.lot, create=False) as store:
        log = store.log()
        found = score_discovery(slots_found(store, len(log.time)), scenario.lot)
    error, expected = map_error(scenario, settings.windows, log)
    parked = sum(r["parked"] for r in run.rows)
    detections = sum(r["detections"] for r in run.rows)
    return {
        "scenario": scenario.name,
        "rig": settings.rig,
        "detector": settings.detector,
        "weather": settings.weather or "any",
        "sessions": len(run.rows),
        "slots": scenario.lot.n_slots,
        "car_detection_rate": sum(r["found"] for r in run.rows) / max(parked, 1),
        "detection_precision": sum(r["right"] for r in run.rows) / max(detections, 1),
        "range_abs_error_m": {
            "median": _mean(run.rows, "range_error_m"),
            "p95": _mean(run.rows, "range_error_p95_m"),
        },
        "car_pose": {
            name: {c: _mean(run.rows, prefix + c) for c in ERROR_COLUMNS}
            for name, prefix in (("fitted", ""), ("thesis", "thesis_"))
        },
        "localise": settings.localise,
        "pose_error_m": {
            "odometry": _mean(run.rows, "odometry_error_m"),
            "estimated": _mean(run.rows, "pose_error_m"),
            "max": max(r["pose_error_max_m"] for r in run.rows),
        },
        "slot_accuracy": _mean(run.rows, "slot_accuracy"),
        "slot_accuracy_seen": _mean(run.rows, "slot_accuracy_seen"),
        "unknown_fraction": _mean(run.rows, "unknown_fraction"),
        "by_weather": {
            weather: {
                "sessions": len(its),
                "car_detection_rate": sum(r["found"] for r in its) / max(sum(r["parked"] for r in its), 1),
                "slot_accuracy": _mean(its, "slot_accuracy"),
            }
            for weather in sorted({r["weather"] for r in run.rows})
            for its in [[r for r in run.rows if r["weather"] == weather]]
        },
        "detection_by_distance": detection_by_distance(run.rows),
        "slots_found": found._asdict(),
        "occupancy_mae": error,
        "occupancy_mae_expected": expected,
        "seconds_per_frame": _mean(run.rows, "seconds_per_frame"),
    }


def slots_found(store: MapStore, sessions: int) -> FoundSlots:
    """Discover slots from the cars of all sessions in a map file, without using the lot's slots.

    Moving cars and false detections accumulate, so the least number of cars per slot grows with the sessions.
    """
    return discover(store.cars(), least=max(3, sessions // 2))


def detection_by_distance(rows: Sequence[Row]) -> list[Row]:
    """Return how often a clearly visible parked car is detected in a frame, by weather and distance.

    Args:
        rows: rows of sessions.

    Returns:
        Rows with weather, distance_m (both ends of the bin), in_frame, detected, rate and its 95 % interval
        (Wilson's), for every bin that holds a car.
    """
    from scipy.stats import binomtest

    counts: dict[str, NDArray[np.int64]] = {}
    for row in rows:
        found = np.array([[int(n) for n in str(row[c]).split()] for c in ("cars_in_frame", "cars_detected")])
        counts[row["weather"]] = counts.get(row["weather"], 0) + found
    result = []
    for weather, (there, detected) in sorted(counts.items()):
        for i, end in enumerate(DISTANCE_ENDS):
            if there[i]:
                test = binomtest(int(detected[i]), int(there[i])).proportion_ci(method="wilson")
                result.append(
                    {
                        "weather": weather,
                        "distance_m": [0.0 if i == 0 else DISTANCE_ENDS[i - 1], end],
                        "in_frame": int(there[i]),
                        "detected": int(detected[i]),
                        "rate": float(detected[i] / there[i]),
                        "rate_ci95": [float(test.low), float(test.high)],
                    }
                )
    return result


def mean_occupancy(occupancy: OccupancyModel, window: ArrivalWindow) -> FloatArray:
    """Return the true P(taken) of every slot in the middle of a window, (n_slots,), as a reference for maps.

    For a process, this is the marginal on the window's first day; for a log or counts, the fraction of the days on
    which the slot is taken at that time.
    """
    middle = 0.5 * (window.start_s + window.end_s)
    if isinstance(occupancy, RecordedOccupancy | CountedOccupancy):
        arrivals = [Arrival(weekday_of(day) * DAY_S + middle, day) for day in occupancy.days_in(window)]
        slots = np.arange(occupancy.n_slots)
        taken = [occupancy.world(np.uint64(0), arrival).occupied(slots, arrival.time) for arrival in arrivals]
        return np.asarray(np.mean(taken, axis=0, dtype=np.float64))
    return occupancy.forecast(Arrival(DAY_S * window.weekdays[0] + middle)).p_occupied


def map_error(scenario: Scenario, windows: Sequence[ArrivalWindow], log: SessionLog) -> tuple[float, float]:
    """Return the mean absolute error of the map's predictions, and the error expected of raw counts.

    Args:
        scenario: the scenario with the true occupancy.
        windows: time windows of the sessions; the map predicts the middle of each, on its first day.
        log: the map's sessions.

    Returns:
        Mean over slots and windows of |predicted - true|; and the expected error of raw counts, i.e. of the mean of
        independent draws at the middle of the window, one per session in the window.
    """
    errors, chances = [], []
    hour = log.time % DAY_S
    for window in windows:
        time = DAY_S * window.weekdays[0] + 0.5 * (window.start_s + window.end_s)
        draws = int(((hour >= window.start_s) & (hour <= window.end_s)).sum())
        true = mean_occupancy(scenario.occupancy, window)
        errors.append(np.abs(predict(log, time).p_occupied - true))
        # Mean absolute deviation of a binomial proportion (normal approximation).
        chances.append(np.sqrt(2.0 / np.pi * true * (1.0 - true) / max(draws, 1)))
    return float(np.mean(errors)), float(np.mean(chances))


def _driven(
    survey: Survey, numbers: Sequence[int], workers: Workers, record: Recorder | None
) -> Iterator[tuple[SessionResult, Any]]:
    """Yield the sessions in order, each with its recording."""
    if workers.in_process or len(numbers) < 2:
        for k in numbers:
            yield _drive(survey, k, record)
        return
    yield from workers.in_order(
        [partial(_drive_apart, survey.scenario, survey.settings, k, record) for k in numbers]
    )


def _drive(survey: Survey, number: int, record: Recorder | None) -> tuple[SessionResult, Any]:
    """Drive a session; the first one with results for figures, and recorded."""
    if number == 0 and record is not None:
        return record(survey, number, PICTURES)
    return survey.drive(number, pictures=PICTURES if number == 0 else 0), None


_KEPT: dict[str, Survey] = {}


def _drive_apart(
    scenario: Scenario, settings: SurveySettings, number: int, record: Recorder | None
) -> tuple[SessionResult, Any]:
    """Drive a session in a worker process, which keeps the survey for the next session."""
    name = repr((scenario.name, settings))
    if name not in _KEPT:
        _KEPT.clear()
        _KEPT[name] = Survey(scenario, settings)
    return _drive(_KEPT[name], number, record)


def _mean(rows: Sequence[Row], column: str) -> float:
    """Return the mean over all sessions with a finite value; NaN if there is none."""
    finite = [r[column] for r in rows if np.isfinite(r[column])]
    return float(np.mean(finite)) if finite else math.nan


def read_sessions(path: Path) -> list[Row]:
    """Read the rows of `sessions.csv`; none if there is no file.

    Raises:
        InputError: the file is damaged, or not of this version.
    """
    rows = []
    for line, row in typed_records(path, _kind_of, SESSION_COLUMNS):
        there, detected = ([int(n) for n in row[name].split()] for name in ("cars_in_frame", "cars_detected"))
        if any(some > most for some, most in zip(detected, there, strict=True)):
            raise InputError(
                f"{path}: line {line}: cars_detected is {row['cars_detected']!r:.80}, want at most cars_in_frame, "
                f"{row['cars_in_frame']!r:.80}"
            )
        rows.append(row)
    return rows


def _kind_of(column: str) -> Kind:
    return _KINDS.get(column, NUMBER_OR_NAN)
