"""Errors of a survey's sessions and of its map, and their pictures."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray
from parkenv.files.file_names import file_name
from parkenv.mapping.discovery import FoundSlots, discover, score_discovery
from parkenv.mapping.inference import Prediction, SessionLog, predict
from parkenv.mapping.store import MapStore
from parkenv.mapping.survey import SessionResult, SurveySettings
from parkenv.mapping.survey_score import DISTANCE_ENDS, METHODS
from parkenv.show.tables import plural
from parkenv.studies.results import Row
from parkenv.studies.sensing.sessions import ERROR_COLUMNS, MAP_FILE, SESSION_COLUMNS
from parkenv.studies.statistics import success_columns
from parkenv.world.occupancy.arrival_window import ArrivalWindow
from parkenv.world.occupancy.process import Arrival, OccupancyModel
from parkenv.world.scenario import Scenario
from parkenv.world.week import DAY_S


def session_row(result: SessionResult) -> Row:
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
                *_pose_errors(result), *score.within_std,
            ),
            strict=True,
        )
    )  # fmt: skip


def _pose_errors(result: SessionResult) -> tuple[float, float, float]:
    """Return the root mean square error of the odometry's positions, m, that of the estimated ones, and its maximum."""
    errors = [np.hypot(*(poses - result.true_poses)[:, :2].T) for poses in (result.odometry, result.poses)]
    odometry, estimated = (float(np.sqrt((error**2).mean())) for error in errors)
    return odometry, estimated, float(errors[1].max())


def _error_columns(errors: FloatArray) -> tuple[float, ...]:
    if not len(errors):
        return (float("nan"),) * len(ERROR_COLUMNS)
    middle = np.median(errors, axis=0)
    far = float(np.quantile(errors[:, 0], 0.95))
    return float(middle[0]), far, float(middle[1]), float(np.degrees(middle[2]))


def summarize(scenario: Scenario, settings: SurveySettings, rows: Sequence[Row], map_file: Path) -> Row:
    """Return the row of `summary.json` from at least one row of `sessions.csv`."""
    with MapStore(map_file, scenario.lot, create=False) as store:
        log = store.log()
        found = score_discovery(slots_found(store, len(log.time)), scenario.lot)
    error, expected = map_error(scenario, settings.windows, log)
    parked, within = sum(r["parked"] for r in rows), [_mean(rows, f"within_{k}_std") for k in (1, 2)]
    detections = sum(r["detections"] for r in rows)
    return {
        "scenario": scenario.name,
        "rig": settings.rig,
        "detector": settings.detector,
        "weather": settings.weather or "any",
        "sessions": len(rows),
        "slots": scenario.lot.n_slots,
        "car_detection_rate": sum(r["found"] for r in rows) / max(parked, 1),
        "detection_precision": sum(r["right"] for r in rows) / max(detections, 1),
        "range_abs_error_m": {
            "median": _mean(rows, "range_error_m"),
            "p95": _mean(rows, "range_error_p95_m"),
        },
        # Of distances from single pictures, how many have the error that is stated.
        **({"range_within_std": within} if math.isfinite(within[0]) else {}),
        "car_pose": {
            name: {c: _mean(rows, prefix + c) for c in ERROR_COLUMNS}
            for name, prefix in (("fitted", ""), ("thesis", "thesis_"))
        },
        "localise": settings.localise,
        "pose_error_m": {
            "odometry": _mean(rows, "odometry_error_m"),
            "estimated": _mean(rows, "pose_error_m"),
            "max": max(r["pose_error_max_m"] for r in rows),
        },
        "slot_accuracy": _mean(rows, "slot_accuracy"),
        "slot_accuracy_seen": _mean(rows, "slot_accuracy_seen"),
        "unknown_fraction": _mean(rows, "unknown_fraction"),
        "by_weather": {
            weather: {
                "sessions": len(drives),
                "car_detection_rate": sum(r["found"] for r in drives)
                / max(sum(r["parked"] for r in drives), 1),
                "slot_accuracy": _mean(drives, "slot_accuracy"),
            }
            for weather in sorted({r["weather"] for r in rows})
            for drives in [[r for r in rows if r["weather"] == weather]]
        },
        "detection_by_distance": detection_by_distance(rows),
        "slots_found": found._asdict(),
        "occupancy_mae": error,
        "occupancy_mae_expected": expected,
        "seconds_per_frame": _mean(rows, "seconds_per_frame"),
    }


def slots_found(store: MapStore, sessions: int) -> FoundSlots:
    """Discover slots from the cars of all sessions in a map file, without using the lot's slots.

    Moving cars and false detections accumulate, so the least number of cars per slot grows with the sessions.
    """
    return discover(store.cars(), least=max(3, sessions // 2))


def detection_by_distance(rows: Sequence[Row]) -> list[Row]:
    """Return how often a clearly visible parked car is detected in a frame, by weather and distance.

    The rows have both ends of the bin in distance_m, and the rate with its 95 % interval (Wilson's), for every bin that
    holds a car.
    """
    counts: dict[str, NDArray[np.int64]] = {}
    for row in rows:
        cars = np.array([[int(n) for n in str(row[c]).split()] for c in ("cars_in_frame", "cars_detected")])
        counts[row["weather"]] = counts.get(row["weather"], 0) + cars
    return [
        {
            "weather": weather,
            "distance_m": [0.0 if i == 0 else DISTANCE_ENDS[i - 1], end],
            "in_frame": int(there[i]),
            "detected": int(detected[i]),
            **success_columns("rate", int(detected[i]), int(there[i])),
        }
        for weather, (there, detected) in sorted(counts.items())
        for i, end in enumerate(DISTANCE_ENDS)
        if there[i]
    ]


def draw_survey(
    scenario: Scenario, settings: SurveySettings, row: Row, shown: SessionResult | None, folder: Path
) -> None:
    """Draw the pictures of a survey, from its row of `summary.json`, into its folder, which has the map.

    `shown` is the first session, with perception results; None if it was not driven in this run.
    """
    from parkenv.show.figures import survey as pictures  # loads Matplotlib

    def path(name: str) -> Path:
        return folder / file_name(f"{name}_{scenario.name}", ".png")

    lot, window = scenario.lot, settings.windows[0]
    with MapStore(folder / MAP_FILE, lot, create=False) as store:
        log = store.log()
        found = slots_found(store, len(log.time))
    sessions = plural(row["sessions"], "session")
    predicted = draw_map(scenario, log, window, f"{scenario.name} after {sessions}", path("map"))
    if row["detection_by_distance"]:
        title = f"{scenario.name}, rig {settings.rig}, {sessions}"
        pictures.save_detection_reach(row["detection_by_distance"], title, path("reach"))
    if shown is not None:
        pictures.save_detections(shown, path("detections"))
        pictures.save_session(lot, shown, path("session"))
        if settings.localise != "none":
            pictures.save_localisation(lot, shown, path("localised"))
        pictures.save_graph(lot, predicted, shown, path("graph"))
    pictures.save_found_slots(lot, found, score_discovery(found, lot), path("slots_found"))


def draw_map(
    scenario: Scenario, log: SessionLog, window: ArrivalWindow, title: str, path: Path
) -> Prediction:
    """Draw what a map predicts for the middle of a window, beside the true probabilities; return the prediction."""
    from parkenv.show.figures.survey import save_map  # loads Matplotlib

    predicted = predict(log, DAY_S * window.weekdays[0] + 0.5 * (window.start_s + window.end_s))
    save_map(scenario.lot, predicted, mean_occupancy(scenario.occupancy, window), title, path)
    return predicted


def mean_occupancy(occupancy: OccupancyModel, window: ArrivalWindow) -> FloatArray:
    """Return the true P(taken) of every slot in the middle of a window, (n_slots,), as a reference for maps.

    For a process, this is the marginal on the window's first day; for a log or counts, the fraction of the days on
    which the slot is taken at that time.
    """
    middle = 0.5 * (window.start_s + window.end_s)
    if occupancy.recorded:
        arrivals = [Arrival(day * DAY_S + middle, date) for day, date in occupancy.arrival_days(window)]
        slots = np.arange(occupancy.n_slots)
        taken = [occupancy.world(np.uint64(0), arrival).occupied(slots, arrival.time) for arrival in arrivals]
        return np.asarray(np.mean(taken, axis=0, dtype=np.float64))
    return occupancy.forecast(Arrival(DAY_S * window.weekdays[0] + middle)).p_occupied


def map_error(scenario: Scenario, windows: Sequence[ArrivalWindow], log: SessionLog) -> tuple[float, float]:
    """Return the mean absolute error of the map's predictions in the middle of the windows, on their first days.

    And the error that is expected of raw counts, i.e. of the mean of independent draws at the middle of the window, one
    per session in the window.
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


def _mean(rows: Sequence[Row], column: str) -> float:
    finite = [r[column] for r in rows if np.isfinite(r[column])]
    return float(np.mean(finite)) if finite else math.nan
