"""`parkenv park`: success rates and times of parking agents."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from parkenv import __version__
from parkenv.cli import arguments as args
from parkenv.cli.tables import make_console, make_table
from parkenv.cli.trust import TrustModelOption, readable_models
from parkenv.errors import InputError

if TYPE_CHECKING:
    from parkenv.evaluation.trips.parking_runs import Parking, ParkingCase
    from planners.agent import Agent

SHOWN_FAILURES = 6
SHOWN_ROWS = 20


def park(
    agents: Annotated[
        str,
        typer.Option(
            "--agents",
            metavar="NAME[,NAME...]",
            help="Parking agents, compared on the same tasks: planner, or ALGORITHM:FILE for a model of "
            "`parkenv train --env drive`.",
        ),
    ] = "planner",
    scenario: Annotated[
        str | None,
        typer.Option(
            "--scenario",
            metavar="NAME|FILE[,...]",
            help="Scenarios in whose lots the car parks: packaged ones, or scenario files.  [default: campus,street]",
        ),
    ] = None,
    lot: args.LotOption = None,
    kind: Annotated[
        str,
        typer.Option(
            "--kind", help="Kinds of slots, separated by commas: perpendicular, oblique, parallel; or all."
        ),
    ] = "all",
    way: Annotated[
        str, typer.Option("--way", help="Orientation in the slot: nose-in, back-in; or both.")
    ] = "both",
    episodes: Annotated[int, typer.Option("--episodes", "-n", min=1, help="Episodes per lot.")] = 100,
    occupancy_level: Annotated[
        float,
        typer.Option(
            "--occupancy-level", min=0.0, max=1.0, help="Fraction of the other slots that are occupied."
        ),
    ] = 0.85,
    slack: Annotated[
        float,
        typer.Option("--slack", min=0.0, help="Distance around the slot kept clear of parked cars, m."),
    ] = 0.0,
    seed: args.SeedOption = 0,
    jobs: args.JobsOption = 0,
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Output folder for pictures, episodes.csv and summary.json.")
    ] = Path("results/park"),
    trust_model: TrustModelOption = False,
) -> None:
    """Evaluate parking agents in `parkenv/Drive-v1`: success rate, planning time, driving time, manoeuvres.

    Writes pictures of one successful episode per kind of slot and orientation, an animation of one, and pictures of
    failures, if any; with several agents, into one folder per agent.

    Examples:
    * `parkenv park --episodes 250 --scenario campus,street,jam`

    * `parkenv park --agents planner,sac:results/drive-sac/seed_0/model.safetensors`

    * `parkenv park --lot parking_map.yml --way back-in`
    """
    from parkenv.driving.parking_task import KINDS, WAYS
    from parkenv.evaluation.experiments.results import make_folder, write_summary
    from parkenv.evaluation.trips.parking_runs import ParkingCase, park_all, parking_table, write_parkings
    from parkenv.scenarios.build import build
    from planners.driving.parking_agents import make_parking_agent

    kinds = None if kind == "all" else _chosen("--kind", kind, KINDS)
    ways = WAYS if way == "both" else _chosen("--way", way, WAYS)
    cases = []
    for spec in args.scenario_specs(scenario, lot=lot, default="campus,street"):
        case = ParkingCase(build(spec).lot, kinds, ways, occupancy_level, slack)
        case.environment().close()  # validates the options before the first episode
        cases.append(case)
    labels = _labels(readable_models(args.words("--agents", agents), trust_model))
    parking_agents = {label: make_parking_agent(name) for label, name in labels.items()}
    make_folder(out)
    console = make_console()
    progress = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=console,
    )
    seeds = range(seed, seed + episodes)
    parkings: dict[str, list[Parking]] = {label: [] for label in labels}
    with progress, args.workers_of(jobs, "loky", None) as workers:
        for label, name in labels.items():
            what = "Parking" if len(labels) == 1 else label
            bar = progress.add_task(what, total=len(cases) * episodes)
            for some in park_all(cases, seeds, workers, name):
                parkings[label] += some
                progress.advance(bar, len(some))

    rows = [{"agent": label, **p.row} for label, its in parkings.items() for p in its]
    table = [
        {"agent": label, **row}
        for label, its in parkings.items()
        for row in parking_table([p.row for p in its])
    ]
    names = [case.lot.name for case in cases]
    write_parkings(rows, out / "episodes.csv")
    summary = {"command": ["parkenv", *sys.argv[1:]], "version": __version__, "seed": seed, "lots": names}
    write_summary(out, summary | {"agents": labels, "rows": table})
    film = _to_film(next(iter(parkings.values())))
    for label, its in parkings.items():
        folder = out if len(labels) == 1 else out / label
        make_folder(folder)
        _picture(its, cases, parking_agents[label], film, folder)
    _show(console, f"{', '.join(names)}: {episodes} episodes per lot", table)
    for row in [row for row in rows if not row["parked"]][:SHOWN_ROWS]:
        who = f"{row['agent']}, " if len(labels) > 1 else ""
        console.print(
            f"failed: {who}{row['lot']}, seed {row['seed']}, {row['slot']} {row['way']}: {row['reason']}"
        )
    console.print(f"Episodes, summary and pictures are in {out}")


def _labels(names: list[str]) -> dict[str, str]:
    """Return a short label per agent, usable as a folder name, and the agent's full name."""
    labels: dict[str, str] = {}
    for name in names:
        word = name.partition(":")[0]
        alike = sum(known.partition(":")[0] == word for known in labels.values())
        labels[f"{word}-{alike + 1}" if alike else word] = name
    return labels


def _to_film(parkings: list[Parking]) -> dict[str, Any] | None:
    """Return the row of the successful episode with the most direction changes; None without success."""
    parked = [p.row for p in _one_of_each(parkings)]
    return max(parked, key=lambda row: row["direction_changes"], default=None)


def _one_of_each(parkings: list[Parking]) -> list[Parking]:
    """Return the first success per kind of slot and orientation."""
    kept = {(p.row["kind"], p.row["way"]): p for p in reversed(parkings) if p.row["parked"]}
    return [kept[key] for key in sorted(kept)]


def _picture(
    parkings: list[Parking],
    cases: list[ParkingCase],
    agent: Agent,
    film: dict[str, Any] | None,
    folder: Path,
) -> None:
    """Write pictures of successes and failures, and an animation of the episode `film`."""
    from parkenv.evaluation.figures.parking_pictures import save_parkings
    from parkenv.evaluation.figures.picture_files import save_film
    from parkenv.evaluation.trips.parking_runs import park_once

    lots = {case.lot.name: case.lot for case in cases}
    failures = [p for p in parkings if not p.row["parked"]][:SHOWN_FAILURES]
    for shown, name in ((_one_of_each(parkings), "parkings.png"), (failures, "failures.png")):
        if shown:
            save_parkings([(lots[p.row["lot"]], p.state) for p in shown], folder / name)
    if film is not None:
        case = next(case for case in cases if case.lot.name == film["lot"])
        frames = park_once(case.environment("rgb_array"), agent, film["seed"], every=2).frames
        save_film(frames, folder / "parking.gif", fps=10.0)


def _chosen(option: str, text: str, known: tuple[str, ...]) -> tuple[str, ...]:
    words = args.words(option, text)
    for word in words:
        if word not in known:
            raise InputError(f"{option} has {word!r}, want some of {', '.join(known)}")
    return tuple(words)


def _show(console: Any, title: str, table: list[dict[str, Any]]) -> None:
    headings = (
        "agent", "slot", "parked", "success [95 %]", "contacts", "plan ms (p95)", "drive s (p95)", "changes (p95)",
        "driven m", "turned rad",
    )  # fmt: skip
    printed = make_table(title, headings)
    for row in table:
        low, high = row["success_ci95"]
        printed.add_row(
            row["agent"],
            f"{row['kind']} {row['way']}".strip(),
            f"{row['parked']}/{row['episodes']}",
            f"{row['success']:.1%} [{low:.1%}, {high:.1%}]",
            str(row["contacts"]),
            _pair(row, "planning_ms", 0),
            _pair(row, "time_s", 1),
            _pair(row, "direction_changes", 0),
            _known(row["driven_m"], 1),
            _known(row["turned_rad"], 1),
        )
    console.print(printed)


def _pair(row: dict[str, Any], name: str, digits: int) -> str:
    """Format a median with its 95th percentile; empty for agents without the quantity, e.g. planning time."""
    median, p95 = (_known(row[key], digits) for key in (name, f"{name}_p95"))
    return median and f"{median} ({p95})"


def _known(value: float, digits: int) -> str:
    return "" if value != value else f"{value:.{digits}f}"
