"""`parkenv calibrate` measures driving times; `parkenv trip` films a trip."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from parkenv.cli import arguments as args
from parkenv.cli.command import options_of
from parkenv.cli.study_run import run_study
from parkenv.cli.tables import make_console, make_table, print_recorded
from parkenv.errors import InputError
from parkenv.files.known_names import RigName

if TYPE_CHECKING:
    from rich.console import Console

    from parkenv.studies.runner import Result


@options_of("parkenv.studies.trips.calibration_study:CalibrationStudy")
def calibrate(
    given: dict[str, Any],
    /,
    out: Path = Path("results/calibrate"),
    *,
    trust: bool = False,
    folder: args.RunFolder,
) -> None:
    """Drive whole trips, and measure the driving speed and the cost of a failed attempt of the drive graph.

    A simulated car drives along the lanes and into slots, as the agent decides. Every seed is driven twice: with the
    scenario's observations of slots, for the speed and the manoeuvre; and without observations before an attempt, for
    failed attempts. `parkenv compare --calibrated OUT/calibrated.json` then compares agents under both costs.

    Examples:
        parkenv calibrate --scenario campus --episodes 200
        parkenv compare --calibrated results/calibrate/calibrated.json

    Options:
        out, -o (DIR): Folder for calibrated.json, trips.jsonl, summary.json and the figure.
    """
    from parkenv.cli.spec_options import given_spec
    from parkenv.studies.trips.calibration_study import CalibrationStudy

    _, study = given_spec(CalibrationStudy(), given, out, folder.resume, trust)
    run_study(study, out, args.ReportedRun(folder.resume, folder.overwrite), show_calibration)


def show_calibration(console: Console, result: Result) -> None:
    """Print the distributions and the calibration."""
    from parkenv.world.scenario import KMH

    study: Any = result.study
    cells = (
        (
            row["what"],
            str(row["n"]),
            f"{row['mean']:.2f} [{row['mean_ci95'][0]:.2f}, {row['mean_ci95'][1]:.2f}]",
            *(f"{row[name]:.2f}" if name in row else "" for name in ("median", "p95")),
        )
        for row in result.rows
    )
    console.print(make_table(study.title, ("what", "n", "mean [95 %]", "median", "p95"), cells))
    if (made := result.summary["calibrated"]) is not None:
        trips, touched, stuck = (result.summary[name] for name in ("trips", "contacts", "rescues"))
        console.print(
            f"Calibrated: driving at {made['v_drive'] / KMH:.2f} km/h, a failed attempt costs "
            f"{made['failure_s']:.1f} s, and parking takes {made['manoeuvre_s']:.1f} s that the drive graph leaves out."
            f" In {trips} trips: {touched} contacts, {stuck} times stuck."
        )


def trip(
    scenario: str | None = None,
    agents: str = "mdp",
    seed: int = 0,
    blind: bool = False,
    out: Path = Path("results/trip.gif"),
    *,
    notice: float = 2.0,
    v_drive_kmh: float | None = None,
    world: args.ObservedSearches,
    traffic: args.Traffic,
    rig: RigName | None = None,
    detector: str | None = None,
    rerun: Path | None = None,
) -> None:
    """Drive one trip from the entry into a slot, and film it from above at five times real speed.

    Examples:
        parkenv trip --scenario campus --seed 7 --blind --out trip.gif
        parkenv trip --scenario campus --rig laser --rerun trip.rrd
        parkenv trip --scenario campus --cars 6 --pedestrians 8

    Options:
        agents (NAME): The agent that searches, with any options in brackets: mdp(failure_s=90).
        seed (N >= 0): Seed of the world.
        blind: Observe no slot before an attempt to park there, so that attempts fail.
        out, -o (FILE.gif): The film.

    Costs and speeds:
        notice (M): Metres along its path at which the car notices at the latest that it would drive into a taken slot.
        v_drive_kmh (V): Speed limit on the lanes, km/h.  [default: the scenario's, 10]
    """
    from parkenv.files.atomic_write import make_folder
    from parkenv.scenarios.blind import blind_scenario
    from parkenv.scenarios.build import build
    from parkenv.show.figures.picture_files import save_film
    from parkenv.studies.trips.driven_search import DrivenSearch
    from parkenv.studies.trips.sensor_log import record_trip, require_viewer, sensor_log
    from parkenv.studies.trips.trip_film import COLORS, FPS, film_trip
    from parkenv.studies.trips.vehicle_controller import DrivingStyle
    from parkenv.world.scenario import KMH

    if out.suffix.lower() != ".gif":
        raise InputError(f"--out is {out}, want a file that ends in .gif")
    args.require_rig(rig, detector)
    if blind and rig is not None:
        raise InputError("--blind and --rig: without observations no sensors are needed; name one of the two")
    if rerun is not None:
        if rig is None:
            raise InputError("--rerun records what sensors measure: add --rig laser")
        require_viewer()
    its = build(traffic.on(world.spec(scenario)))
    speed = its.v_drive if v_drive_kmh is None else v_drive_kmh * KMH
    style = DrivingStyle(speed=speed, notice_m=notice)
    world_seen = blind_scenario(its) if blind else its
    search = DrivenSearch(world_seen, args.one_agent(agents), style=style, rig=rig, detector=detector)
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
        print_recorded(console, rerun)


def _show(console: Console, driven: Any) -> None:
    from parkenv.world.cost_terms import COST_TERMS

    end = f"parked in {driven.slot}" if driven.parked else "not parked"
    parts = (
        (driven.lanes_s, "on the lanes", False), (driven.manoeuvre_s, "manoeuvre", False),
        *((driven.costs[t.field], t.label, t.optional) for t in COST_TERMS if t.field in driven.costs),
    )  # fmt: skip
    terms = " + ".join(f"{s:.1f} s {what}" for s, what, optional in parts if s or not optional)
    console.print(f"{end}: {driven.total_s:.1f} s = {terms}")
    if driven.waited_s or driven.contacts:
        console.print(f"  {driven.waited_s:.1f} s of it behind and before others; {driven.contacts} contacts")
    for t in driven.attempts:
        console.print(
            f"  {t.slot} ({t.kind}{', ' + t.way if t.way else ''}): {t.seconds:.1f} s, {t.reason or 'parked'}"
        )
