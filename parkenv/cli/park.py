"""`parkenv park`: the planner parks, again and again."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from parkenv import __version__
from parkenv.cli import arguments as args
from parkenv.cli.tables import make_console, make_table
from parkenv.errors import InputError

SHOWN_FAILURES = 6


def park(
    lot: Annotated[
        str,
        typer.Option("--lot", help="Packaged lots (campus, jam, street, mini) or lot files, with commas."),
    ] = "campus,street",
    kind: Annotated[
        str, typer.Option("--kind", help="perpendicular, oblique, parallel; or all that each lot has.")
    ] = "all",
    way: Annotated[str, typer.Option("--way", help="nose-in, back-in; or both.")] = "both",
    episodes: Annotated[int, typer.Option("--episodes", min=1, help="Parkings on each lot.")] = 100,
    occupancy: Annotated[
        float, typer.Option("--occupancy", min=0.0, max=1.0, help="Share of the other slots that are taken.")
    ] = 0.85,
    slack: Annotated[
        float,
        typer.Option("--slack", min=0.0, help="Metres around the slot that are kept clear of parked cars."),
    ] = 0.0,
    seed: args.SeedOption = 0,
    jobs: args.JobsOption = 1,
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Folder for pictures, episodes.csv and summary.json.")
    ] = Path("results/park"),
) -> None:
    """Let the planner park in `parkenv/Drive-v0`: how often it does, how long it plans and drives.

    Writes a picture of one parking for each kind of slot and way of standing in it, an animation of one, and
    pictures of failures where there are any.

    Examples:
    * `parkenv park --episodes 250 --lot campus,street,jam --jobs 2`

    * `parkenv park --lot parking_map.yml --way back-in`
    """
    from parkenv.driving.parking_task import KINDS, WAYS
    from parkenv.envs.drive import lot_named
    from parkenv.evaluation.parking_pictures import save_parkings
    from parkenv.evaluation.parking_runs import (
        Parking,
        ParkingCase,
        park_all,
        park_once,
        parking_table,
        write_parkings,
    )
    from parkenv.evaluation.results import make_folder, write_summary
    from parkenv.evaluation.picture_files import save_film
    from planners.parking import ParkingAgent

    kinds = None if kind == "all" else _chosen("--kind", kind, KINDS)
    ways = WAYS if way == "both" else _chosen("--way", way, WAYS)
    cases = []
    for name in args.words("--lot", lot):
        case = ParkingCase(lot_named(name), kinds, ways, occupancy, slack)
        case.environment().close()  # complains before anything is driven
        cases.append(case)
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
    parkings: list[Parking] = []
    with progress, args.workers_of(jobs, "loky", None) as workers:
        bar = progress.add_task("Parking", total=len(cases) * episodes)
        for some in park_all(cases, seeds, workers):
            parkings += some
            progress.advance(bar, len(some))

    rows = [parking.row for parking in parkings]
    table = parking_table(rows)
    names = [case.lot.name for case in cases]
    write_parkings(rows, out / "episodes.csv")
    summary = {"command": ["parkenv", *sys.argv[1:]], "version": __version__, "seed": seed, "lots": names}
    write_summary(out, summary | {"rows": table})

    lots = {case.lot.name: case.lot for case in cases}
    kept = {(p.row["kind"], p.row["way"]): p for p in reversed(parkings) if p.row["parked"]}
    ends = [(lots[p.row["lot"]], p.state) for _, p in sorted(kept.items())]
    if ends:
        save_parkings(ends, out / "parkings.png")
        shown = max(kept.values(), key=lambda p: p.row["direction_changes"])
        case = next(c for c in cases if c.lot.name == shown.row["lot"])
        film = park_once(case.environment("rgb_array"), ParkingAgent(), shown.row["seed"], every=2)
        save_animation(film.frames, out / "parking.gif", fps=10.0)
    failures = [p for p in parkings if not p.row["parked"]]
    if failures:
        save_parkings(
            [(lots[p.row["lot"]], p.state) for p in failures[:SHOWN_FAILURES]], out / "failures.png"
        )
    _show(console, f"{', '.join(names)}: {episodes} parkings on each", table)
    for failure in failures:
        row = failure.row
        console.print(
            f"failed: {row['lot']}, seed {row['seed']}, {row['slot']} {row['way']}: {row['reason']}"
        )
    console.print(f"Episodes, summary and pictures are in {out}")


def _chosen(option: str, text: str, known: tuple[str, ...]) -> tuple[str, ...]:
    words = args.words(option, text)
    for word in words:
        if word not in known:
            raise InputError(f"{option} has {word!r}, want some of {', '.join(known)}")
    return tuple(words)


def _show(console: Any, title: str, table: list[dict[str, Any]]) -> None:
    headings = (
        "slot", "parked", "success [95 %]", "contacts", "plan ms (p95)", "drive s (p95)", "changes (p95)",
        "driven m", "turned rad",
    )  # fmt: skip
    printed = make_table(title, headings)
    for row in table:
        low, high = row["success_ci95"]
        printed.add_row(
            f"{row['kind']} {row['way']}".strip(),
            f"{row['parked']}/{row['episodes']}",
            f"{row['success']:.1%} [{low:.1%}, {high:.1%}]",
            str(row["contacts"]),
            f"{row['planning_ms']:.0f} ({row['planning_ms_p95']:.0f})",
            f"{row['time_s']:.1f} ({row['time_s_p95']:.1f})",
            f"{row['direction_changes']:.0f} ({row['direction_changes_p95']:.0f})",
            f"{row['driven_m']:.1f}",
            f"{row['turned_rad']:.1f}",
        )
    console.print(printed)
