"""`parkenv calibrate` measures driving times; `parkenv trip` films a trip."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from parkenv import __version__
from parkenv.cli import arguments as args
from parkenv.cli.run_folder import run_folder
from parkenv.cli.tables import make_console, make_table
from parkenv.errors import InputError
from parkenv.files.file_names import file_name
from parkenv.scenarios.build import build

AgentOption = Annotated[
    str,
    typer.Option(
        "--agent",
        metavar="NAME",
        help="The agent that searches, with options in brackets: mdp(failure_s=90).",
    ),
]
NoticeOption = Annotated[
    float,
    typer.Option(
        "--notice-m",
        help="Metres on along its path, where the car notices at the latest that it would drive into a taken slot.",
    ),
]
SpeedOption = Annotated[
    float | None,
    typer.Option(
        "--v-drive-kmh", metavar="V", help="Speed limit on the lanes, km/h.  [default: the scenario's]"
    ),
]


def calibrate(
    scenario: args.ScenarioOption = None,
    episodes: Annotated[
        int,
        typer.Option("--episodes", "-n", min=1, help="Trips with observations, and as many without."),
    ] = 100,
    agent: AgentOption = "mdp",
    notice_m: NoticeOption = 2.0,
    v_drive_kmh: SpeedOption = None,
    rig: args.RigOption = None,
    cars: args.CarsOption = None,
    pedestrians: args.PedestriansOption = None,
    seed: args.SeedOption = 0,
    jobs: args.JobsOption = None,
    backend: args.BackendOption = None,
    address: args.AddressOption = None,
    out: Annotated[
        Path,
        typer.Option(
            "--out", "-o", help="Folder for calibrated.json, trips.jsonl, summary.json, the figure."
        ),
    ] = Path("results/calibrate"),
    resume: Annotated[bool, typer.Option("--resume", help="Go on with the trips in --out.")] = False,
) -> None:
    """Drive whole trips, and measure the parameters of the drive graph: driving speed and cost of a failed attempt.

    A simulated car drives along the lanes and into slots, as the agent decides. Every seed is driven twice: with the
    scenario's observations of slots, for the speed and the manoeuvre; and without observations before an attempt, for
    failed attempts. `parkenv compare --calibrated OUT/calibrated.json` then compares agents under both costs.

    Examples:
    * `parkenv calibrate --scenario campus --episodes 200 --jobs 2 --out results/calibrate`

    * `parkenv compare --calibrated results/calibrate/calibrated.json`
    """
    from parkenv.evaluation.experiments.agent_spec import AgentSpec
    from parkenv.evaluation.experiments.experiment import agent_fingerprints, fingerprints, flat_tables
    from parkenv.evaluation.experiments.results import write_summary
    from parkenv.evaluation.trips.calibration import (
        TripFolder,
        TripPlan,
        drive_trips,
        save_distributions,
    )
    from parkenv.evaluation.trips.calibration import calibrate as calibration_of
    from parkenv.evaluation.trips.driven_search import DrivenSearch
    from parkenv.evaluation.trips.lot_driver import DrivingStyle
    from parkenv.world.scenario import KMH

    spec = args.one_scenario(args.scenario_specs(scenario, cars=cars, pedestrians=pedestrians))
    its = build(spec)
    speed = its.v_drive if v_drive_kmh is None else v_drive_kmh * KMH
    style = DrivingStyle(speed=speed, notice_m=notice_m)
    rig = args.rig_of(rig)
    DrivenSearch(its, agent, style=style, rig=rig)  # raises an error before anything is driven
    with run_folder(out, "the same command with --resume"):
        settings = {
            "version": __version__, "scenario": its.name,
            "scenarios": {its.name: flat_tables(spec.model_dump(mode="json"))},
            "files": fingerprints(spec.files()), "agent": agent, "style": dataclasses.asdict(style),
            "rig": rig,
            "traffic": dataclasses.asdict(its.traffic), "agent files": agent_fingerprints([AgentSpec.of(agent).name]),
        }  # fmt: skip
        folder = TripFolder(out, settings, resume=resume)
        console = make_console()
        progress = Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("trips"),
            TimeRemainingColumn(),
            console=console,
        )
        seeds = range(seed, seed + episodes)
        with progress, args.workers_of(jobs, backend, address) as workers:
            bar = progress.add_task("Driving", total=2 * episodes)
            rows = drive_trips(
                TripPlan(its, agent, style, rig), seeds, folder, workers, lambda n: progress.advance(bar, n)
            )
        made, table = calibration_of(rows, its, speed)
        made.to_file(out / "calibrated.json")
        touched, stuck = (sum(row[name] for row in rows) for name in ("contacts", "rescues"))
        write_summary(
            out,
            {
                "command": ["parkenv", *sys.argv[1:]],
                "version": __version__,
                "seed": seed,
                **settings,
                "trips": len(rows),
                "contacts": touched,
                "rescues": stuck,
                "calibrated": dataclasses.asdict(made),
                "rows": table,
            },
        )
        title = f"{its.name}: {episodes} trips with and {episodes} without observations of slots, by {agent}"
        save_distributions(rows, speed, title, out / file_name(f"calibration_{its.name}", ".png"))
        printed = make_table(title, ("what", "n", "mean [95 %]", "median", "p95"))
        for row in table:
            low, high = row["mean_ci95"]
            printed.add_row(
                row["what"],
                str(row["n"]),
                f"{row['mean']:.2f} [{low:.2f}, {high:.2f}]",
                f"{row['median']:.2f}" if "median" in row else "",
                f"{row['p95']:.2f}" if "p95" in row else "",
            )
        console.print(printed)
        console.print(
            f"Calibrated: driving at {made.v_drive / KMH:.2f} km/h, a failed attempt costs {made.failure_s:.1f} s, and "
            f"parking takes {made.manoeuvre_s:.1f} s that the drive graph leaves out. In {len(rows)} trips: "
            f"{touched} contacts, {stuck} times stuck."
        )
        console.print(f"Calibration, trips, summary and figure are in {out}")


def trip(
    scenario: args.ScenarioOption = None,
    agent: AgentOption = "mdp",
    blind: Annotated[
        bool,
        typer.Option(
            "--blind", help="Observe no slot before an attempt to park there, so that attempts fail."
        ),
    ] = False,
    notice_m: NoticeOption = 2.0,
    rig: args.RigOption = None,
    cars: args.CarsOption = None,
    pedestrians: args.PedestriansOption = None,
    seed: args.SeedOption = 0,
    out: Annotated[Path, typer.Option("--out", "-o", help="The film, a GIF.")] = Path("results/trip.gif"),
    rerun: args.RerunOption = None,
) -> None:
    """Drive one trip from the entry into a slot, and film it from above at five times real speed.

    Examples:
    * `parkenv trip --scenario campus --seed 7 --blind --out trip.gif`

    * `parkenv trip --scenario campus --rig laser --rerun trip.rrd`

    * `parkenv trip --scenario campus --cars 6 --pedestrians 8`
    """
    from parkenv.evaluation.experiments.compare import blind_scenario
    from parkenv.evaluation.experiments.results import make_folder
    from parkenv.evaluation.figures.picture_files import save_film
    from parkenv.evaluation.figures.trip_pictures import COLORS, FPS, film_trip
    from parkenv.evaluation.trips.driven_search import DrivenSearch
    from parkenv.evaluation.trips.lot_driver import DrivingStyle
    from parkenv.evaluation.trips.sensor_log import record_trip, require_viewer, sensor_log

    if out.suffix.lower() != ".gif":
        raise InputError(f"--out is {out}, want a file that ends in .gif")
    if blind and rig is not None:
        raise InputError("--blind and --rig: without observations no sensors are needed; name one of the two")
    if rerun is not None:
        if rig is None:
            raise InputError("--rerun records what sensors measure: add --rig laser")
        require_viewer()
    spec = args.one_scenario(args.scenario_specs(scenario, cars=cars, pedestrians=pedestrians))
    its = build(spec)
    style = DrivingStyle(notice_m=notice_m)
    search = DrivenSearch(blind_scenario(its) if blind else its, agent, style=style, rig=args.rig_of(rig))
    make_folder(out.parent)
    console = make_console()
    with console.status("Driving and drawing"):
        driven, frames = film_trip(search, seed)
        save_film(frames, out, fps=FPS, colors=COLORS)
    _show(console, driven)
    console.print(f"The film is {out}")
    if rerun is not None:
        assert search.env.perception is not None
        with (
            console.status(f"Driving once more for {rerun}"),
            sensor_log(rerun, its.lot, search.env.perception.sampler.rig) as recording,
        ):
            record_trip(search, seed, recording)
        console.print(f"Recorded: {rerun}; look at it with: rerun {rerun}")


def _show(console: Any, driven: Any) -> None:
    end = f"parked in {driven.slot}" if driven.parked else "not parked"
    console.print(
        f"{end}: {driven.total_s:.1f} s = {driven.lanes_s:.1f} s on the lanes + {driven.manoeuvre_s:.1f} s manoeuvre + "
        f"{driven.failed_s:.1f} s failed + {driven.walk_s:.1f} s walk"
        + (f" + {driven.parking_cost_s:.1f} s parking cost" if driven.parking_cost_s else "")
        + (f" + {driven.gave_up_s:.1f} s give-up penalty" if driven.gave_up_s else "")
    )
    if driven.waited_s or driven.contacts:
        console.print(f"  {driven.waited_s:.1f} s of it behind and before others; {driven.contacts} contacts")
    for t in driven.attempts:
        console.print(
            f"  {t.slot} ({t.kind}{', ' + t.way if t.way else ''}): {t.seconds:.1f} s, {t.reason or 'parked'}"
        )
