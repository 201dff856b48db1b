"""`parkenv sensors` and `parkenv fit-sensor-model`: what the simulated sensors measure, and how well."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, get_args

from pydantic import AfterValidator, Field

from parkenv.cli.options import Command
from parkenv.cli.tables import make_console, print_rows, stages
from parkenv.files.atomic_write import make_folder
from parkenv.files.known_names import WEATHERS, RigName, WeatherName
from parkenv.files.option import Inside, option, words_in
from parkenv.files.spec_file import Axis
from parkenv.scenarios.spec import scenario_spec
from parkenv.show.columns import Column
from parkenv.studies.fields import PRICES, TRAFFIC, Detector, OneScenario, Scenarios, Seed, with_traffic
from parkenv.studies.study import ExecutionSpec, counted

UP_TO = Column("up_to", "slots up to", "m")
_OBSERVATIONS = ("--sensor-model", "--view-range", *PRICES)


class Preview(Command):
    """Each figure shows the measurements of all sensors in one weather, at the place with the most parked cars.

    It shows the side camera's image with the true boxes, its depth, the stereo camera's disparity, and the laser scan
    from above.
    """

    examples = """
        parkenv sensors preview
        parkenv sensors preview --scenario street --weather dusk
        """

    scenario: Annotated[OneScenario, AfterValidator(with_traffic), Inside(without=_OBSERVATIONS)] = Field(
        scenario_spec("campus"), validate_default=True
    )
    weather: Axis[WeatherName] = option(
        get_args(WeatherName),
        f"Some of {', '.join(WEATHERS)}.",
        takes="NAME[,...]|all",
        default="all",
        parse=lambda t: WEATHERS if t == "all" else words_in(t),
    )
    seed: Seed = 0
    out: Path = option(Path("results/sensors"), "Folder for the pictures.", short="-o")

    def run(self) -> None:
        from parkenv.scenarios.build import build
        from parkenv.studies.sensing.sensor_preview import preview_sensors

        console = make_console()
        console.print(
            "The first image after an installation waits about 20 s for the renderer to be compiled."
        )
        with stages(console) as progress:
            preview_sensors(build(self.scenario), self.out, self.weather, seed=self.seed, progress=progress)
        console.print(f"Images are in {self.out}")


class FitSensorModel(Command, ExecutionSpec):
    """The rates define a sensor model for `parkenv compare --sensor-model FILE`.

    The model has the same error rates as the perception pipeline, and is a thousand times as fast.
    """

    examples = """
        parkenv fit-sensor-model --rig stereo --out stereo.json
        parkenv compare --sensor-model stereo.json
        """

    scenarios: Annotated[Scenarios, Inside(without=(*_OBSERVATIONS, *TRAFFIC))] = (
        scenario_spec("campus"),
        scenario_spec("street"),
    )
    episodes: int = option(
        20, "Episodes of each of three agents in each scenario.", short="-n", ge=1, le=1_000_000
    )
    rig: RigName | None = option(
        None, "Detector whose errors are measured.", panel="Sensors", default="the scenario's, laser"
    )
    detector: Detector = None
    weather: WeatherName | None = option(
        None, f"{', '.join(WEATHERS)}.", takes="NAME", panel="Sensors", default="drawn each time"
    )
    seed: Seed = 500_000
    out: Path = option(Path("sensor_model.json"), "The file to write.", short="-o", takes="FILE.json")

    def run(self) -> None:
        from parkenv.scenarios.build import build
        from parkenv.studies.sensing.sensor_model_fit import AGENTS, fitted_model, measure_sensors

        specs = [with_traffic(spec) for spec in self.scenarios]
        scenarios, rig = [build(spec) for spec in specs], self.rig or specs[0].rig
        make_folder(self.out.parent)
        console = make_console()
        with self.workers() as workers, stages(console, "episodes") as progress:
            total = self.episodes * len(AGENTS) * len(scenarios)
            counts = measure_sensors(
                scenarios,
                rig,
                self.episodes,
                seed=self.seed,
                weather=self.weather,
                detector=self.detector,
                workers=workers,
                on_progress=counted(progress, "Searching with simulated sensors", total),
            )
        model = fitted_model(counts)
        model.to_file(self.out)
        in_range = counts.reshape(-1, 2, 3).sum(axis=(1, 2)).tolist()
        rows = [{**asdict(band), "slots_in_range": n} for band, n in zip(model.bands, in_range, strict=True)]
        print_rows(console, f"Observations of slots, rig {rig}", rows, columns=(UP_TO,))
        console.print(f"Written: {self.out}")
