"""`parkenv fit-sensor-model`: measure the error rates of the perception pipeline."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from parkenv.cli import arguments as args
from parkenv.cli.tables import make_console, make_table
from parkenv.scenarios.build import build


def fit_sensor_model(
    scenario: Annotated[
        str,
        typer.Option("--scenario", metavar="NAME|FILE[,...]", help="Scenarios to search in."),
    ] = "campus,street",
    rig: args.SurveyRigOption = None,
    episodes: Annotated[
        int,
        typer.Option("--episodes", "-n", min=1, help="Searches of each of three agents in each scenario."),
    ] = 20,
    arrival: args.ArrivalOption = None,
    days: args.DaysOption = None,
    weather: args.WeatherOption = None,
    seed: args.SeedOption = 500_000,
    jobs: args.JobsOption = None,
    backend: args.BackendOption = None,
    address: args.AddressOption = None,
    out: Annotated[Path, typer.Option("--out", "-o", help="The JSON file to write.")] = Path(
        "sensor_model.json"
    ),
) -> None:
    """Search with simulated sensors, and count how often slots are observed correctly, by distance and side.

    The rates define a sensor model for `parkenv compare --sensor-model FILE`, which makes the same errors as the
    perception pipeline, a thousand times as fast.

    Example:
    * `parkenv fit-sensor-model --rig stereo --out stereo.json`
    """
    from parkenv.evaluation.experiments.sensor_model_fit import AGENTS, measure_sensors
    from parkenv.evaluation.experiments.spec import BUSY

    specs = [
        spec if spec.traffic else spec.changed(traffic=BUSY)
        for spec in args.scenario_specs(scenario, arrival=arrival, days=days)
    ]
    scenarios = [build(spec) for spec in specs]
    rig = args.rig_of(rig) or specs[0].rig
    console = make_console()
    with args.workers_of(jobs, backend, address) as workers, Progress(
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(),
        console=console, disable=not console.is_terminal,
    ) as progress:  # fmt: skip
        bar = progress.add_task(
            "Searching with simulated sensors", total=episodes * len(AGENTS) * len(scenarios)
        )
        counts = measure_sensors(
            scenarios,
            rig,
            episodes,
            seed=seed,
            weather=weather,
            workers=workers,
            on_progress=lambda: progress.advance(bar),
        )
    model = counts.fitted()
    model.to_file(out)
    table = make_table(
        f"Observations of slots, rig {rig}",
        ["slots up to", "side", "slots in range", "observed", "hit rate", "false-alarm rate"],
    )
    for band, in_band in zip(model.bands, counts.counts.reshape(-1, 2, 3), strict=True):
        table.add_row(
            f"{band.up_to:g} m",
            "right" if band.beside else "elsewhere",
            str(in_band.sum()),
            f"{band.seen_rate:.0%}",
            f"{band.hit_rate:.3f}",
            f"{band.false_alarm_rate:.3f}",
        )
    console.print(table)
    console.print(f"Written: {out}")
