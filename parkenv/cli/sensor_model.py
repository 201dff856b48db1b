"""`parkenv fit-sensor-model`: measure the error rates of the perception pipeline."""

from __future__ import annotations

from pathlib import Path

from parkenv.cli import arguments as args
from parkenv.cli.tables import make_console, make_table, progress_bar
from parkenv.files.known_names import RigName, WeatherName

SCENARIOS = "campus,street"


def fit_sensor_model(
    scenario: str | None = None,
    episodes: int = 20,
    rig: RigName | None = None,
    seed: int = 500_000,
    out: Path = Path("sensor_model.json"),
    *,
    world: args.Searches,
    detector: str | None = None,
    weather: WeatherName | None = None,
    machines: args.Machines,
) -> None:
    """Search with simulated sensors, and count how often slots are observed correctly, by distance and side.

    The rates define a sensor model for `parkenv compare --sensor-model FILE`, which makes the same errors as the
    perception pipeline, a thousand times as fast.

    Examples:
        parkenv fit-sensor-model --rig stereo --out stereo.json
        parkenv compare --sensor-model stereo.json

    Options:
        scenario (NAME|FILE|DIR[,...]): {scenarios}; scenario files (.toml), lots (.geojson), or folders.  [default:
            campus,street]
        episodes, -n (1 <= N <= 1000000): Episodes of each of three agents in each scenario.
        rig (laser|stereo|both_sides): Whose errors to measure.  [default: the scenario's, laser]
        out, -o (FILE.json): The file to write.
    """
    from parkenv.files.atomic_write import make_folder
    from parkenv.scenarios.build import build
    from parkenv.studies.fields import BUSY
    from parkenv.studies.sensing.sensor_model_fit import AGENTS, measure_sensors

    specs = [args.Traffic().on(spec, BUSY) for spec in world.specs(scenario, default=SCENARIOS)]
    scenarios = [build(spec) for spec in specs]
    make_folder(out.parent)
    console = make_console()
    with machines.workers() as workers, progress_bar(console, "episodes") as progress:
        total = episodes * len(AGENTS) * len(scenarios)
        bar = progress.add_task("Searching with simulated sensors", total=total)
        counts = measure_sensors(
            scenarios,
            rig or specs[0].rig,
            episodes,
            seed=seed,
            weather=weather,
            detector=detector,
            workers=workers,
            on_progress=lambda: progress.advance(bar),
        )
    model = counts.fitted()
    model.to_file(out)
    cells = (
        (
            f"{band.up_to:g} m",
            "right" if band.beside else "elsewhere",
            str(in_band.sum()),
            f"{band.seen_rate:.0%}",
            f"{band.hit_rate:.3f}",
            f"{band.false_alarm_rate:.3f}",
        )
        for band, in_band in zip(model.bands, counts.counts.reshape(-1, 2, 3), strict=True)
    )
    headings = ["slots up to", "side", "slots in range", "observed", "hit rate", "false-alarm rate"]
    console.print(make_table(f"Observations of slots, rig {rig or specs[0].rig}", headings, cells))
    console.print(f"Written: {out}")
