"""A published model that was trained in a fleet: its results beside compiled drivers, and its film."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Self

import numpy as np

from parkenv.errors import InputError
from parkenv.scenarios.spec import ScenarioSpec
from parkenv.show.figures.picture_files import save_film
from parkenv.show.frames.fleet import FleetRenderer
from parkenv.studies.agent_spec import AgentSpec
from parkenv.studies.fleet.study import FleetStudy
from parkenv.studies.fleet.tables import summarize_days
from parkenv.studies.publish.publication import MODEL, Publication
from parkenv.studies.results import Row
from parkenv.studies.training.spec import FleetTrainingSpec
from parkenv.studies.workers import Workers

BESIDE = ("greedy-drive", "first-free")
"""Drivers of every car on the same days."""
_FILM_S, _STEP_S = 60.0, 0.5  # s of the day


@dataclass(frozen=True, eq=False)
class FleetPublication(Publication):
    """A model that drives every car of a fleet, and the days that it is evaluated on.

    Args:
        fleets: lot, demand, days and seed; its last agent is the model.
    """

    fleets: FleetStudy

    @classmethod
    def of_training(
        cls, spec: FleetTrainingSpec, model: Path, scenarios: Mapping[str, ScenarioSpec], days: int, seed: int
    ) -> Self:
        """Return the publication of a model with the demand of its training.

        Raises:
            InputError: there is not one scenario.
        """
        if len(scenarios) != 1:
            raise InputError(f"--scenario names {len(scenarios)} scenarios, want one for a model of a fleet")
        ((name, scenario),) = scenarios.items()
        fleets = FleetStudy().changed(
            arrivals_per_hour=(spec.arrivals_per_hour,), knows=(spec.knows,), stay_s=spec.stay_s,
            patience_s=spec.patience_s, scenario=scenario, days=days, seed=seed,
            agents=tuple(AgentSpec(name=each) for each in BESIDE),
        )  # fmt: skip
        made = cls(model, {name: fleets.built}, days, seed, fleets)
        agents = (*fleets.agents, AgentSpec(name=made._source))
        return cls(model, made.scenarios, days, seed, fleets.changed(agents=agents))

    @property
    def command(self) -> list[str]:
        """See `Publication`."""
        its = self.fleets
        return [
            "parkenv", "fleet", "--scenario", *self.scenarios, "--agents", ",".join((*BESIDE, self.name)),
            "--arrivals-per-hour", f"{its.arrivals_per_hour[0]:g}", "--stay-min", f"{its.stay_s / 60.0:g}",
            "--patience-min", f"{its.patience_s / 60.0:g}", "--knows", *its.knows,
            "--episodes", str(its.days), "--seed", str(its.seed),
        ]  # fmt: skip

    def evaluate(self, workers: Workers) -> list[Row]:
        """See `Publication`."""
        tasks = [
            partial(self.fleets.run_day, setting, day)
            for setting in self.fleets.fleet_settings
            for day in range(self.fleets.days)
        ]
        days = list(workers.in_order(tasks))
        n = self.fleets.days
        rows = summarize_days([days[first : first + n] for first in range(0, len(days), n)])
        names = dict.fromkeys((self._source,), self.name)
        return [row | {"agent": names.get(row["agents"], row["agents"])} for row in rows]

    def film(self, path: Path) -> None:
        """Film a minute of the first day, in the middle of its arrivals."""
        fleet, agents = self.fleets.fleet(self.fleets.fleet_settings[-1])
        fleet.reset(self.fleets.seed, 0)
        window, renderer = self.fleets.built.arrival, FleetRenderer(fleet)
        middle = fleet.begin + (window.end_s - window.start_s) / 2.0
        frames = []
        for second in np.arange(0.0, _FILM_S, _STEP_S):
            fleet.run(agents, until=middle + second)
            frames.append(renderer.frame())
        save_film(frames, path, fps=10.0, colors=64)

    @property
    def environment(self) -> str:
        """See `Publication`."""
        return "parkenv.lot_v0"

    @property
    def purpose(self) -> str:
        """See `Publication`."""
        return (
            "drives cars which compete for the free slots of one parking lot, in the "
            "[PettingZoo](https://pettingzoo.farama.org) world"
        )

    @property
    def evaluation(self) -> str:
        """See `Publication`."""
        its = self.fleets
        return (
            f"Every car has the same driver, and knows `{its.knows[0]}`; {its.arrivals_per_hour[0]:g} cars an hour, "
            f"{its.days:,} days, the same for all drivers; 95 % intervals over days in brackets. "
            f"The model was trained as the driver of: {self.card.settings['fleet']}."
        )

    def table(self, rows: Sequence[Row]) -> str:
        """See `Publication`."""
        lines = [
            "| scenario | driver of every car | mean total time, s | search time, s | found no slot |",
            "|---|---|---|---|---|",
        ]
        for row in rows:
            low, high = row["total_s_ci95"]
            lines.append(
                f"| {row['scenario']} | {row['agent']} | {row['total_s']:.1f} [{low:.1f}, {high:.1f}] | "
                f"{row['search_s']:.1f} | {row['balked_fraction']:.1%} |"
            )
        return "\n".join(lines)

    def usage(self) -> str:
        """See `Publication`."""
        return f"""import parkenv
from parkenv.engine.fleet import DriverKind, Fleet
from parkenv.studies.agent_spec import AgentSpec
from parkenv.studies.fleet.drivers import demand_in, policy_of

scenario = parkenv.make_scenario("{next(iter(self.scenarios))}")
demand = demand_in(scenario, {self.fleets.arrivals_per_hour[0]:g}, {self.fleets.stay_s:g}, {self.fleets.patience_s:g})
policy, _ = policy_of(AgentSpec(name="{self.card.algorithm}:{MODEL}"), scenario)
kind = DriverKind(policy=policy, knows="{self.fleets.knows[0]}")
fleet = Fleet(scenario, demand, drivers=[kind], leave_full_lot=False)
fleet.reset(seed=0)
fleet.run()
print(fleet.cars["total_s"].mean(), "s")"""
