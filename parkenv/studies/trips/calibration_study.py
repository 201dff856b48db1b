"""Drive whole trips, with and without observations of slots, to calibrate the search environment."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import cached_property, partial
from typing import TYPE_CHECKING, ClassVar, Literal, Self

from pydantic import model_validator

from parkenv.errors import InputError
from parkenv.files.file_names import file_name
from parkenv.files.known_names import OBSERVED, UNOBSERVED
from parkenv.files.option import option
from parkenv.scenarios.spec import Speed, scenario_spec
from parkenv.show.tables import plural
from parkenv.studies.fields import AgentSpec, Detector, OneAgent, OneScenario, Rig, Seed, Vehicle, require_rig
from parkenv.studies.results import Results, Row, Table, search_settings
from parkenv.studies.study import Cell, Labelled, Study
from parkenv.studies.workers import Task

if TYPE_CHECKING:
    from parkenv.studies.trips.driven_car import DrivingStyle
    from parkenv.studies.trips.driven_search import DrivenSearch
    from parkenv.world.scenario import Scenario

CALIBRATED = "calibrated.json"


class CalibrationStudy(Study):
    """A simulated car drives along the lanes and into slots, as the agent decides. Every seed is driven twice.

    The drive with the scenario's observations of slots gives the speed and the duration of the manoeuvre; the drive
    without observations before an attempt gives the cost of failed attempts. `parkenv compare --calibrated
    OUT/calibrated.json` then compares agents under both costs.
    """

    table: ClassVar = Table("trips.jsonl", ("slots", "seed"))
    block: ClassVar = 5
    doing: ClassVar = "Driving"
    unit: ClassVar = "trips"
    shown: ClassVar = {"rows": ("what", "n", "mean", "median", "p95")}
    writes: ClassVar = "calibrated.json, trips.jsonl, summary.json and the figure"
    examples: ClassVar = """
        parkenv calibrate --scenario campus --episodes 200
        parkenv compare --calibrated results/calibrate/calibrated.json
        """

    kind: Literal["calibrate"] = "calibrate"
    scenario: OneScenario = scenario_spec("campus")
    agent: OneAgent = AgentSpec(name="mdp")
    seed: Seed = 0
    notice_m: float = option(
        2.0,
        "Distance along the path at which the car notices at the latest that its slot is taken, m.",
        name="--notice",
        takes="M",
        panel="Costs and speeds",
        ge=0.0,
        le=1_000.0,
    )
    v_drive_kmh: Speed | None = option(
        None,
        "Speed limit on the lanes, km/h.",
        takes="V",
        panel="Costs and speeds",
        default="the scenario's, 10",
    )
    vehicle: Vehicle = None
    rig: Rig = None
    detector: Detector = None
    episodes: int = option(
        100, "Trips with observations, and as many without.", short="-n", ge=1, le=1_000_000
    )

    @model_validator(mode="after")
    def _seen(self) -> Self:
        require_rig(self.rig, self.detector)
        return self

    @cached_property
    def built(self) -> Scenario:
        from parkenv.scenarios.build import build

        return build(self.scenario)

    @cached_property
    def style(self) -> DrivingStyle:
        from parkenv.studies.trips.driven_car import DrivingStyle

        return DrivingStyle(speed=self.speed_limit, notice_m=self.notice_m)

    @property
    def speed_limit(self) -> float:
        from parkenv.world.scenario import KMH

        return self.built.v_drive if self.v_drive_kmh is None else self.v_drive_kmh * KMH

    def search(self, slots: str) -> DrivenSearch:
        from parkenv.scenarios.selection import blind_scenario
        from parkenv.studies.trips.driven_search import DrivenSearch

        scenario, rig = (self.built, self.rig) if slots == OBSERVED else (blind_scenario(self.built), None)
        return DrivenSearch(
            scenario, self.agent, style=self.style, rig=rig, detector=self.detector, vehicle=self.vehicle
        )

    def check(self) -> None:
        self.search(OBSERVED)

    def settings(self) -> Row:
        driving = {"agent": self.agent.label, "style": dataclasses.asdict(self.style)}
        car = {"vehicle": dataclasses.asdict(self.vehicle)} if self.vehicle else {}
        return search_settings(self, "rig") | driving | car

    def cells(self) -> list[Cell]:
        seeds = range(self.seed, self.seed + self.episodes)
        return [Cell(Labelled({"slots": slots}), seeds) for slots in (OBSERVED, UNOBSERVED)]

    def run(self, work: Labelled, items: Sequence[int]) -> list[Row]:
        from parkenv.studies.trips.driven_search import trip_row

        search = self.search(work.columns["slots"])
        return [work.columns | trip_row(search.run(seed)) for seed in items]

    def label(self, work: Labelled) -> str:
        return f"{self.agent.label} in {self.built.name}"

    def summarise(self, results: Results) -> Row:
        from parkenv.studies.trips.driven_search import calibrate

        rows, calibrated, table = self.all_rows(results), None, list[Row]()
        try:
            calibration, table = calibrate(rows, self.built, self.speed_limit)
            calibrated = dataclasses.asdict(calibration)
        except InputError:
            if len(rows) == 2 * self.episodes:
                raise
        return {
            **self.settings(),
            "trips": len(rows),
            "contacts": sum(row["contacts"] for row in rows),
            "rescues": sum(row["rescues"] for row in rows),
            "calibrated": calibrated,
            "rows": table,
        }

    @classmethod
    def findings(cls, summary: Row) -> list[str]:
        measured = summary["calibrated"]
        return [
            f"Calibrated: driving at {3.6 * measured['v_drive']:.2f} km/h, a failed attempt costs "
            f"{measured['failure_s']:.1f} s, and parking takes {measured['manoeuvre_s']:.1f} s that the drive graph "
            f"leaves out. In {summary['trips']} trips: {summary['contacts']} contacts, {summary['rescues']} times "
            "stuck."
        ]

    @property
    def title(self) -> str:
        trips = plural(self.episodes, "trip")
        return f"{self.built.name}: {trips} with and as many without observations, by {self.agent.label}"

    def outputs(self, results: Results, summary: Row) -> list[Task[object]]:
        from parkenv.scenarios.calibration import Calibration
        from parkenv.studies.trips.driven_search import save_distributions

        picture = results.path / file_name(f"calibration_{self.built.name}", ".png")
        rows = self.all_rows(results)
        return [
            partial(Calibration(**summary["calibrated"]).to_file, results.path / CALIBRATED),
            partial(save_distributions, rows, self.speed_limit, self.title, picture),
        ]
