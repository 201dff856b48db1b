"""`parkenv survey`: drive past every slot and write a map file; `parkenv map`: the predictions of a map file."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.progress import Progress

from parkenv import __version__
from parkenv.cli import arguments as args
from parkenv.cli.tables import make_console, make_table
from parkenv.errors import InputError
from parkenv.scenarios.build import build

if TYPE_CHECKING:
    from parkenv.evaluation.experiments.spec import SurveySpec

MAP_FILE = "map.sqlite"


def survey(
    scenario: args.ScenarioOption = None,
    lot: args.LotOption = None,
    occupancy: args.OccupancyOption = None,
    sessions: Annotated[
        int, typer.Option("--sessions", min=1, help="Number of survey drives; the thesis made 21.")
    ] = 6,
    rig: args.SurveyRigOption = None,
    detector: args.DetectorOption = "hog",
    hours: Annotated[
        str | None,
        typer.Option(
            "--hours",
            metavar="HH:MM-HH:MM[,...]",
            help="When sessions begin; the windows are used in turn.  [default: 08:00-10:00,11:00-14:00,16:00-18:00]",
        ),
    ] = None,
    days: args.DaysOption = None,
    weather: args.WeatherOption = None,
    every: Annotated[float, typer.Option("--every", min=0.1, help="Metres between captures.")] = 1.25,
    pose_noise: Annotated[
        float, typer.Option("--pose-noise", min=0.0, help="Localisation error of the car, m.")
    ] = 0.0,
    cars: args.CarsOption = None,
    pedestrians: args.PedestriansOption = None,
    seed: args.SeedOption = 0,
    jobs: args.JobsOption = 0,
    backend: args.BackendOption = "loky",
    address: args.AddressOption = None,
    rerun: args.RerunOption = None,
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Folder for map.sqlite, pictures, summary.json.")
    ] = Path("results/survey"),
    report: args.ReportOption = False,
) -> None:
    """Drive past every slot with simulated sensors, detect the parked cars, and write the observations to a map file.

    Cars are detected in the camera images and located with the laser (or the stereo camera). A Bayes filter estimates
    the state of each slot. Every drive is one session of the map. The same command resumes an interrupted survey.

    Examples:
    * `parkenv survey --sessions 21`

    * `parkenv survey --scenario street --rig stereo --weather rain --hours 12:00-13:00`

    * `parkenv survey --scenario mini --sessions 1 --rerun drive.rrd`
    """
    from parkenv.evaluation.experiments.spec import BUSY, SurveySpec

    given = {} if hours is None else {"hours": [window.strip() for window in hours.split(",")]}
    spec = SurveySpec().changed(
        scenario=args.one_scenario(
            args.scenario_specs(
                scenario, lot=lot, occupancy=occupancy, days=days, cars=cars, pedestrians=pedestrians, traffic=BUSY
            )
        ),
        sessions=sessions, rig=rig, detector=detector, weather=weather, every=every, pose_noise=pose_noise, seed=seed,
        jobs=jobs, backend=backend, address=address, **given,
    )  # fmt: skip
    run_survey_of(spec, out, rerun=rerun, report=report)


def run_survey_of(
    spec: SurveySpec,
    out: Path,
    *,
    resume: bool = False,
    overwrite: bool = False,
    rerun: Path | None = None,
    report: bool = False,
) -> None:
    """Drive the sessions that the map in the folder does not hold yet, print errors and draw figures.

    Raises:
        InputError: the scenario cannot be made, or the folder cannot be used.
    """
    del resume
    if overwrite:
        raise InputError("--overwrite: a survey adds sessions to its map; name another folder for a new one")
    from parkenv.evaluation.experiments.results import make_folder, write_summary
    from parkenv.evaluation.experiments.spec import SPEC_FILE
    from parkenv.evaluation.experiments.surveys import (
        mean_occupancy,
        run_survey,
        slots_found,
        summarize,
        survey_of,
    )
    from parkenv.evaluation.figures.survey_pictures import (
        save_detection_reach,
        save_detections,
        save_found_slots,
        save_graph,
        save_map,
        save_session,
    )
    from parkenv.evaluation.trips.sensor_log import record_session, require_viewer, sensor_log
    from parkenv.mapping.discovery import score_discovery
    from parkenv.mapping.inference import predict
    from parkenv.mapping.store import MapStore
    from parkenv.mapping.survey import Survey

    if rerun is not None:
        require_viewer()
    its, settings = survey_of(spec)
    make_folder(out)
    spec.write(out / SPEC_FILE)
    console = make_console()
    with (
        args.workers_of(spec.jobs, spec.backend, spec.address) as workers,
        Progress(console=console, disable=not console.is_terminal) as progress,
    ):
        task = progress.add_task("Driving (compiles first after an installation)", total=spec.sessions)
        run = run_survey(
            its,
            settings,
            spec.sessions,
            out / MAP_FILE,
            workers=workers,
            on_session=lambda _: progress.advance(task),
        )
        progress.update(task, completed=spec.sessions)
    row = summarize(its, settings, run, out / MAP_FILE)
    with MapStore(out / MAP_FILE, its.lot, create=False) as store:
        log = store.log()
        found = slots_found(store, len(log.time))
    window = settings.windows[0]
    time = 86_400.0 * window.weekdays[0] + 0.5 * (window.start_s + window.end_s)
    predicted = predict(log, time)
    save_map(
        its.lot, predicted, mean_occupancy(its.occupancy, window),
        f"{its.name} after {row['sessions']} sessions", out / f"map_{its.name}.png",
    )  # fmt: skip
    title = f"{its.name}, rig {settings.rig}, {row['sessions']} sessions"
    if row["detection_by_distance"]:
        save_detection_reach(row["detection_by_distance"], title, out / f"reach_{its.name}.png")
    if run.shown is not None:
        save_detections(run.shown, out / f"detections_{its.name}.png")
        save_session(its.lot, run.shown, out / f"session_{its.name}.png")
        save_graph(its.lot, predicted, run.shown, out / f"graph_{its.name}.png")
    save_found_slots(its.lot, found, score_discovery(found, its.lot), out / f"slots_found_{its.name}.png")
    table = make_table(None, ["figure", "value"])
    for name in (
        "car_detection_rate",
        "detection_precision",
        "slot_accuracy",
        "slot_accuracy_seen",
        "unknown_fraction",
    ):
        table.add_row(name, f"{row[name]:.3f}")
    error = row["range_abs_error_m"]
    table.add_row("range_abs_error_m", f"median {error['median']:.3f}, p95 {error['p95']:.3f}")
    table.add_row(
        "occupancy_mae", f"{row['occupancy_mae']:.3f} (counts alone: {row['occupancy_mae_expected']:.3f})"
    )
    table.add_row("seconds_per_frame", f"{row['seconds_per_frame']:.4f}")
    console.print(table)
    table = make_table(None, ["weather", "sessions", "cars found", "slots right"])
    for name, its_row in row["by_weather"].items():
        rates = (f"{its_row[c]:.1%}" for c in ("car_detection_rate", "slot_accuracy"))
        table.add_row(name, str(its_row["sessions"]), *rates)
    console.print(table)
    summary = {
        "command": ["parkenv", *sys.argv[1:]],
        "version": __version__,
        "seed": spec.seed,
        "rows": [row],
    }
    write_summary(out, summary)
    console.print(f"Written: {out / MAP_FILE}, summary.json, sessions.csv and pictures")
    if report:
        from parkenv.cli.report import make_report

        make_report(out, jobs=spec.jobs, trust=True)
    if rerun is not None:
        with console.status(f"Driving the first session once more for {rerun}"):
            first = Survey(its, settings)
            with sensor_log(rerun, its.lot, first.pipeline.rig) as recording:
                record_session(first, 0, recording)
        console.print(f"Recorded: {rerun}; look at it with: rerun {rerun}")


def show_map(
    file: Annotated[Path, typer.Argument(help="A map file that parkenv survey wrote.")],
    scenario: args.ScenarioOption = None,
    lot: args.LotOption = None,
    weekday: Annotated[
        str | None, typer.Option("--weekday", help="mon to sun; over all sessions where not given.")
    ] = None,
    hour: Annotated[
        float, typer.Option("--hour", min=0.0, max=24.0, help="Hour of the day, e.g. 9.5.")
    ] = 9.0,
    slot: Annotated[str | None, typer.Option("--slot", help="Only this slot, by its id.")] = None,
    confidence: Annotated[float, typer.Option("--confidence", help="Of the interval, 0 to 1.")] = 0.9,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder for map.png, slots.csv, summary.json.")
    ] = None,
) -> None:
    """Show the predictions of a map file: how often each slot is taken.

    Examples:
    * `parkenv map results/survey/map.sqlite --weekday tue --hour 9.5`

    * `parkenv map results/survey/map.sqlite --slot A3 --out results/map`
    """
    import csv
    import io

    from parkenv.evaluation.experiments.results import make_folder, write_summary
    from parkenv.evaluation.figures.survey_pictures import save_map
    from parkenv.files.atomic_write import atomic_write
    from parkenv.mapping.inference import predict
    from parkenv.mapping.store import MapStore
    from parkenv.world.occupancy import DAY_NAMES
    from parkenv.world.week import DAY_S, HOUR_S

    its = build(args.one_scenario(args.scenario_specs(scenario, lot=lot)))
    if weekday is not None and weekday not in DAY_NAMES:
        raise InputError(f"--weekday is {weekday!r}, want one of {', '.join(DAY_NAMES)}")
    ids = its.lot.slot_ids
    if slot is not None and slot not in ids:
        raise InputError(f"--slot {slot}: lot {its.name!r} has no such slot; its first is {ids[0]!r}")
    with MapStore(file, its.lot, create=False) as store:
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
    table = make_table(
        f"{its.name}, {when}, {len(log.time)} sessions", ["slot", "P(taken)", f"{confidence:.0%}", "seen in"]
    )
    for row in sorted(rows, key=lambda r: float(str(r["p_occupied"])))[: None if slot else 12]:
        table.add_row(
            str(row["slot"]),
            f"{row['p_occupied']:.2f}",
            f"{row['low']:.2f}-{row['high']:.2f}",
            str(row["sessions"]),
        )
    console.print(table)
    if slot is None and len(rows) > 12:
        console.print(f"The {12} most likely free of {len(rows)}; --out writes all.")
    if out is None:
        return
    make_folder(out)
    save_map(its.lot, found, None, f"{its.name}, {when}", out / "map.png")
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    with atomic_write(out / "slots.csv") as beside:
        beside.write_text(text.getvalue(), encoding="utf-8")
    write_summary(
        out, {"command": ["parkenv", *sys.argv[1:]], "version": __version__, "seed": None, "rows": rows}
    )
    console.print(f"Written: {out / 'map.png'}, slots.csv, summary.json")
