"""`parkenv survey`: drive past every slot and write a map file; `parkenv map`: the predictions of a map file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from parkenv.cli import arguments as args
from parkenv.cli.command import options_of
from parkenv.cli.study_run import run_study
from parkenv.cli.tables import make_console, make_table, print_recorded, progress_bar, save_summary
from parkenv.errors import InputError, nearest
from parkenv.files.known_names import LocaliserName
from parkenv.show.plurals import plural

if TYPE_CHECKING:
    from rich.console import Console

    from parkenv.studies.runner import Result
    from parkenv.studies.sensing.survey_study import SurveyStudy

MOST_ROWS = 12
"""Slots in the table of a map; files have all."""


@options_of("parkenv.studies.sensing.survey_study:SurveyStudy", "--sensor-model", "--view-range")
def survey(
    given: dict[str, Any],
    /,
    out: Path = Path("results/survey"),
    *,
    rerun: Path | None = None,
    record: Path | None = None,
    trust: bool = False,
    folder: args.ReportedRun,
) -> None:
    """Drive past every slot with simulated sensors, and write which slots are taken to a map file.

    Parked cars are detected in the camera images and located with the laser (or the stereo camera). A Bayes filter
    estimates the state of each slot. Every drive is one session of the map. Sessions are added to the map in --out: the
    same command goes on with an interrupted survey, with or without --resume.

    Examples:
        parkenv survey --sessions 21
        parkenv survey --scenario street --rig stereo --weather rain
        parkenv survey --hours 12:00-13:00 --days weekend
        parkenv survey --odometry-drift 0.02 --localise scan-matching
        parkenv survey --scenario mini --sessions 1 --rerun drive.rrd

    Options:
        out, -o (DIR): Folder for map.sqlite, pictures and summary.json.

    Results:
        record (FILE.mcap): Also record images, scans and poses of the first session (extra bags), for `parkenv
            map-drive`.  [default: none]
    """
    from parkenv.cli.spec_options import given_spec
    from parkenv.studies.results import SPEC_FILE
    from parkenv.studies.sensing.survey_study import SurveyStudy

    _, study = given_spec(SurveyStudy(), given, out, folder.resume and (out / SPEC_FILE).exists(), trust)
    run_survey(study, out, folder, rerun, record)


def run_survey(
    study: SurveyStudy,
    out: Path,
    folder: args.ReportedRun,
    rerun: Path | None = None,
    record: Path | None = None,
) -> None:
    """Run a survey, print its errors, and record its first session on request.

    Raises:
        InputError: the scenario cannot be made, or the folder cannot be used.
        KeyboardInterrupt: the run was interrupted; finished sessions are in the folder.
    """
    from parkenv.mapping.recorded_drive import record_drive, require_recordable
    from parkenv.studies.trips.sensor_log import record_session, require_viewer, sensor_log

    if rerun is not None:
        require_viewer()
    if record is not None:
        require_recordable(record)
    run_study(study, out, folder, show)
    console = make_console()
    if rerun is not None:
        with (
            console.status(f"Driving the first session once more for {rerun}"),
            sensor_log(rerun, study.built.lot, study.survey.pipeline.rig) as recording,
        ):
            record_session(study.survey, 0, recording)
        print_recorded(console, rerun)
    if record is not None:
        with console.status(f"Driving the first session once more for {record}"):
            record_drive(study.survey, 0, record)
        console.print(f"Recorded: {record}; map it with: parkenv map-drive {record}")


def show(console: Console, result: Result) -> None:
    """Print the errors of a survey."""
    for row in result.rows:
        error, pose = row["range_abs_error_m"], row["pose_error_m"]
        rates = (
            "car_detection_rate",
            "detection_precision",
            "slot_accuracy",
            "slot_accuracy_seen",
            "unknown_fraction",
        )
        figures = [
            *((name, f"{row[name]:.3f}") for name in rates),
            ("range_abs_error_m", f"median {error['median']:.3f}, p95 {error['p95']:.3f}"),
            (
                "occupancy_mae",
                f"{row['occupancy_mae']:.3f} (counts alone: {row['occupancy_mae_expected']:.3f})",
            ),
            ("seconds_per_frame", f"{row['seconds_per_frame']:.4f}"),
        ]
        if pose["odometry"] > 0.0 or row["localise"] != "none":
            text = f"{pose['estimated']:.2f}, at most {pose['max']:.2f} (odometry: {pose['odometry']:.2f})"
            figures.append(("pose_error_m", text))
        console.print(make_table(None, ["figure", "value"], figures))
        by_weather = (
            (name, str(r["sessions"]), f"{r['car_detection_rate']:.1%}", f"{r['slot_accuracy']:.1%}")
            for name, r in row["by_weather"].items()
        )
        console.print(make_table(None, ["weather", "sessions", "cars found", "slots right"], by_weather))


def map_drive(
    recording: Path,
    /,
    scenario: str | None = None,
    calibration: Path | None = None,
    every: float = 0.0,
    out: Path = Path("results/drive"),
    *,
    lot: str | None = None,
    detector: str | None = None,
    localise: LocaliserName = "none",
) -> None:
    """Map a recorded drive: images, scans and poses of a car of your own become a session of a map file.

    A recording of `parkenv survey --record` says which sensors it has; for any other a calibration file says so.

    Examples:
        parkenv survey --scenario mini --sessions 1 --record drive.mcap
        parkenv map-drive drive.mcap --scenario mini --out results/drive
        parkenv map-drive bag.mcap --lot lot.geojson --calibration car.toml

    Options:
        recording (FILE|DIR): An MCAP file, or a rosbag of ROS 2 (folder, .db3) or of ROS 1 (.bag); extra bags.
        calibration (FILE): Sensors, mounts and topics (.toml).  [default: those of the recording]
        every (M >= 0): Least distance between captures, m.
        localise (none|scan-matching): scan-matching: the poses are odometry that drifts; correct it.
        out, -o (DIR): Folder for map.sqlite, to which the session is added, map.png and summary.json.
    """
    from parkenv.files.atomic_write import make_folder
    from parkenv.mapping.drive_calibration import DriveCalibration
    from parkenv.mapping.inference import predict
    from parkenv.mapping.recorded_drive import RecordedDrive
    from parkenv.mapping.recorded_drive import map_drive as mapped
    from parkenv.mapping.store import MapStore
    from parkenv.perception.detector_registry import make_detector
    from parkenv.scenarios.build import build
    from parkenv.show.figures.survey import save_map

    its = build(args.World(lot=lot).spec(scenario))
    finder = make_detector(detector or its.detector)
    console = make_console()
    with console.status(f"Reading {recording}"):
        drive = RecordedDrive(recording, None if calibration is None else DriveCalibration.read(calibration))
    make_folder(out)
    with MapStore(out / "map.sqlite", its.lot) as store, progress_bar(console, "captures") as progress:
        if store.has(drive.key):
            raise InputError(f"{out / 'map.sqlite'}: holds the drive {drive.key!r} already")
        task = progress.add_task("Mapping", total=None)
        found = mapped(drive, its.lot, finder, every, lambda: progress.advance(task), localise)
        store.add(found.session)
        log = store.log()
    states = found.states
    row = {
        "recording": str(recording),
        "key": drive.key,
        "captures": found.frames,
        "slots": its.lot.n_slots,
        "seen": int(states.in_view.sum()),
        "taken": int((states.occupied & states.in_view).sum()),
        "cars_located": len(found.session.cars),
        "corrected_m": round(found.corrected_m, 3),
    }
    save_map(its.lot, predict(log, found.session.time), None, f"{its.name}: {drive.key}", out / "map.png")
    save_summary(out, None, [row])
    console.print(make_table(None, ["figure", "value"], ((name, str(value)) for name, value in row.items())))
    console.print(f"Written: {out / 'map.sqlite'}, map.png, summary.json")


DayName = Literal["mon", "tue", "wed", "thu", "fri", "sat", "sun"]


def show_map(
    map_file: Path,
    /,
    scenario: str | None = None,
    weekday: DayName | None = None,
    hour: float = 9.0,
    slot: str | None = None,
    confidence: float = 0.9,
    out: Path | None = None,
    lot: str | None = None,
) -> None:
    """Show the predictions of a map file: how often each slot is taken.

    Examples:
        parkenv map results/survey/map.sqlite --weekday tue --hour 9.5
        parkenv map results/survey/map.sqlite --slot A3 --out results/map

    Options:
        map_file (FILE): A map file that `parkenv survey` wrote.
        weekday (DAY): mon, tue, ..., sun.  [default: the mean over all sessions]
        hour (0 <= H <= 24): Hour of the day, with --weekday.
        slot (ID): Only this slot.  [default: all]
        confidence (P): Of the interval, 0 to 1.
        out, -o (DIR): Folder for map.png, slots.csv, summary.json.  [default: none]
    """
    from parkenv.files.atomic_write import make_folder
    from parkenv.files.csv_tables import write_csv
    from parkenv.mapping.inference import predict
    from parkenv.mapping.store import MapStore
    from parkenv.scenarios.build import build
    from parkenv.show.figures.survey import save_map
    from parkenv.world.occupancy.arrival_window import DAY_NAMES
    from parkenv.world.week import DAY_S, HOUR_S

    its = build(args.World(lot=lot).spec(scenario))
    ids = its.lot.slot_ids
    if slot is not None and slot not in ids:
        hint = nearest(slot, ids) if len(ids) <= MOST_ROWS else nearest(slot, ids).partition("known:")[0]
        raise InputError(
            f"--slot {slot}: lot {its.name!r} has no such slot; {hint or f'its first is {ids[0]!r}'}"
        )
    with MapStore(map_file, its.lot, create=False) as store:
        log = store.log()
    time = None if weekday is None else DAY_NAMES.index(weekday) * DAY_S + min(hour * HOUR_S, DAY_S - 1.0)
    found = predict(log, time, confidence=confidence)
    rows = [
        {
            "slot": name,
            "p_occupied": float(found.p_occupied[i]),
            "low": float(found.low[i]),
            "high": float(found.high[i]),
            "sessions": int(found.sessions[i]),
        }
        for i, name in enumerate(ids)
        if slot in (None, name)
    ]
    console = make_console()
    when = "over all sessions" if weekday is None else f"{weekday} {int(hour):02d}:{int(hour % 1 * 60):02d}"
    cells = (
        (str(r["slot"]), f"{r['p_occupied']:.2f}", f"{r['low']:.2f}-{r['high']:.2f}", str(r["sessions"]))
        for r in sorted(rows, key=lambda r: float(str(r["p_occupied"])))[:MOST_ROWS]
    )
    title = f"{its.name}, {when}, {plural(len(log.time), 'session')}"
    console.print(make_table(title, ["slot", "P(taken)", f"{confidence:.0%}", "seen in"], cells))
    if len(rows) > MOST_ROWS:
        console.print(f"The {MOST_ROWS} most likely free of {len(rows)}; --out writes all.")
    if out is None:
        return
    make_folder(out)
    save_map(its.lot, found, None, f"{its.name}, {when}", out / "map.png")
    write_csv(out / "slots.csv", list(rows[0]), rows)
    save_summary(out, None, rows)
    console.print(f"Written: {out / 'map.png'}, slots.csv, summary.json")
