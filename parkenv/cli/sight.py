"""`parkenv fit-sensor-model`: how well the stack sees, as a model for the environment without sensors."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from parkenv.cli import arguments as args
from parkenv.cli.tables import make_console, make_table
from parkenv.scenarios.build import make_scenario


def fit_sight(
    scenario: Annotated[
        str, typer.Option("--scenario", metavar="NAME[,NAME...]", help="Where to look.")
    ] = "campus,street",
    rig: Annotated[
        str, typer.Option("--rig", help="laser: a camera and a 270° laser; stereo: a stereo pair alone.")
    ] = "laser",
    searches: Annotated[
        int, typer.Option("--searches", "-n", min=1, help="Of each of three agents in each scenario.")
    ] = 20,
    arrival: args.ArrivalOption = None,
    days: args.DaysOption = None,
    weather: Annotated[
        str | None,
        typer.Option("--weather", help="sunny, overcast, low_sun, dusk, rain; drawn where not given."),
    ] = None,
    seed: args.SeedOption = 500_000,
    jobs: args.JobsOption = 0,
    backend: args.BackendOption = "loky",
    address: args.AddressOption = None,
    out: Annotated[Path, typer.Option("--out", "-o", help="The JSON file to write.")] = Path("sight.json"),
) -> None:
    """Search through the sensors, and count how often the stack is right about slots, by distance and side.

    The rates become a sensor model: `parkenv compare --sensor-model FILE` then sees as the stack does, at a thousandth
    of the cost.

    Example:
    * `parkenv fit-sensor-model --rig stereo --out stereo.json`
    """
    from parkenv.evaluation.experiments.sensor_model_fit import AGENTS, measure_sensors
    from parkenv.world.traffic import Traffic

    scenarios = [
        make_scenario(spec, traffic=Traffic(cars=3, pedestrians=5))
        for spec in args.scenario_specs(scenario, arrival=arrival, days=days)
    ]
    console = make_console()
    with args.workers_of(jobs, backend, address) as workers, Progress(
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(),
        console=console, disable=not console.is_terminal,
    ) as progress:  # fmt: skip
        bar = progress.add_task(
            "Searching through the sensors", total=searches * len(AGENTS) * len(scenarios)
        )
        counts = measure_sensors(
            scenarios,
            rig,
            searches,
            seed=seed,
            weather=weather,
            workers=workers,
            on_progress=lambda: progress.advance(bar),
        )
    model = counts.fitted()
    model.to_file(out)
    table = make_table(
        f"What the stack says of slots, rig {rig}",
        ["slots up to", "side", "looks", "told", "taken, said taken", "free, said taken"],
    )
    for band, seen in zip(model.bands, counts.counts.reshape(-1, 2, 3), strict=True):
        table.add_row(
            f"{band.up_to:g} m",
            "right" if band.beside else "elsewhere",
            str(seen.sum()),
            f"{band.seen_rate:.0%}",
            f"{band.hit_rate:.3f}",
            f"{band.false_alarm_rate:.3f}",
        )
    console.print(table)
    console.print(f"Written: {out}")
