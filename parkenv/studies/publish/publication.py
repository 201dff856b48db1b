"""A folder with a trained model that the Hugging Face Hub takes as it is: model, model card, results, film."""

from __future__ import annotations

import shlex
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import ClassVar

import numpy as np
import yaml

from parkenv.errors import InputError
from parkenv.files.atomic_write import write_text
from parkenv.scenarios.build import build
from parkenv.scenarios.spec import ScenarioSpec
from parkenv.show.figures.picture_files import save_film
from parkenv.show.frames.fleet import FleetRenderer
from parkenv.studies.agent_spec import AgentSpec
from parkenv.studies.compare.comparison import Comparison
from parkenv.studies.fleet.study import FleetStudy
from parkenv.studies.results import Row
from parkenv.studies.runner import run
from parkenv.studies.simulate import FrameRecorder, make_search, simulate
from parkenv.studies.training.spec import FleetTrainingSpec, TrainingSpec
from parkenv.studies.trips.parking_runs import ParkingCase, park_all, park_once, parking_table
from parkenv.studies.workers import Workers
from parkenv.version import __version__
from parkenv.world.scenario import Scenario
from planners.agent import make_agent
from planners.driving.parking_agents import make_parking_agent
from planners.model_file import ModelCard
from planners.names import PARKING_PLANNER

MODEL, FILM, CARD = "model.safetensors", "replay.gif", "README.md"
_FILMED, _LONGEST = 3, 150
_FILM_S, _STEP_S = 60.0, 0.5  # s of the day of a fleet
_TOTAL = "{total_s:.1f} [{total_s_ci95[0]:.1f}, {total_s_ci95[1]:.1f}]"
_GYMNASIUM = "in [Gymnasium](https://gymnasium.farama.org) environments"


@dataclass(frozen=True, eq=False)
class Publication(ABC):
    """A model and the worlds that it is evaluated in.

    Args:
        model: the model file.
        specs: scenarios, by the name or file that a command line gives them.
        seed: first seed of the worlds.
        episodes: episodes in each scenario, days in a fleet.

    Attributes:
        command: of `parkenv`, to repeat the evaluation.
        beside: agents that act in the same worlds.
        environment: that of the evaluation.
        purpose: what the model does, and where, as a part of a sentence.
        columns: headings of the results in the model card, and formats of their cells.
    """

    model: Path
    specs: Mapping[str, ScenarioSpec]
    seed: int
    episodes: int = 500

    command: ClassVar[str]
    beside: ClassVar[tuple[str, ...]]
    environment: ClassVar[str]
    purpose: ClassVar[str]
    columns: ClassVar[Mapping[str, str]]
    options: ClassVar[Sequence[str]] = ()

    @cached_property
    def card(self) -> ModelCard:
        """Metadata of the model file."""
        return ModelCard.of_file(self.model)

    @property
    def name(self) -> str:
        """The model as an agent of a command line in the folder."""
        return f"{self.card.algorithm}:{MODEL}"

    @property
    def agents(self) -> tuple[AgentSpec, ...]:
        """The model, after those beside it."""
        return tuple(AgentSpec(name=name) for name in (*self.beside, f"{self.card.algorithm}:{self.model}"))

    @property
    def scenario(self) -> Scenario:
        """The first scenario."""
        return build(next(iter(self.specs.values())))

    @property
    def command_line(self) -> list[str]:
        """Command line that repeats the evaluation, in the folder."""
        return [
            "parkenv", self.command, "--scenario", ",".join(self.specs), "--agents",
            ",".join((*self.beside, self.name)), *self.options, "--episodes", str(self.episodes), "--seed",
            str(self.seed),
        ]  # fmt: skip

    @property
    def evaluation(self) -> str:
        """What the evaluation consists of, in sentences."""
        return (
            f"{self.episodes:,} episodes in each scenario, in the same worlds for all agents; "
            "95 % intervals in brackets."
        )

    def evaluate(self, workers: Workers) -> list[Row]:
        """Run the model and those beside it in the same worlds; return a row for each scenario and agent."""
        rows = [{"agent": row.get("agents"), **row} for row in self.rows(workers)]
        return [row | {"agent": self.name} if row["agent"] == self.agents[-1].name else row for row in rows]

    @abstractmethod
    def rows(self, workers: Workers) -> list[Row]:
        """Return the rows of the evaluation."""

    @abstractmethod
    def film(self, path: Path) -> None:
        """Film the model in the first scenario, a GIF."""

    @abstractmethod
    def usage(self) -> str:
        """Return lines of Python that use the model."""

    def metrics(self, row: Row) -> list[Row]:
        """Return the metrics of a row as the Hub specifies them."""
        low, high = row["total_s_ci95"]
        total, label = round(row["total_s"], 2), f"mean total time, s [{low:.1f}, {high:.1f}]"
        return [
            {"type": "mean_reward", "name": "mean return, s", "value": -total},
            {"type": "total_s", "name": label, "value": total},
        ]

    def metadata(self, rows: Sequence[Row]) -> Row:
        """Return the model card's metadata as the Hub specifies it, with a `model-index` of the results."""
        card, env = self.card, self.environment
        results = [
            {
                "task": {"type": "reinforcement-learning", "name": f"{card.task} for parking"},
                "dataset": {"type": env, "name": f"{env}, {row['scenario']}"},
                "metrics": self.metrics(row),
            }
            for row in rows
            if row["agent"] == self.name
        ]
        return {
            "library_name": "parkenv",
            "pipeline_tag": "reinforcement-learning",
            "tags": ["reinforcement-learning", "deep-reinforcement-learning", "parkenv", env, card.algorithm],
            "model-index": [{"name": f"{card.algorithm}-{card.task}", "results": results}],
        }

    def write_card(self, rows: Sequence[Row], path: Path, extra: str = "") -> None:
        """Write the model card: metadata in YAML, then text in Markdown.

        Args:
            rows: results of `evaluate`.
            path: the file.
            extra: further text.
        """
        card = self.card
        trained = f"`{shlex.join(card.command)}`" if card.command else "a script of its author"
        lots = ", ".join(card.scenarios) or "unknown scenarios"
        lines = [list(self.columns), ["---"] * len(self.columns)]
        lines += [[cell.format_map(row) for cell in self.columns.values()] for row in rows]
        table = "\n".join(f"| {' | '.join(cells)} |" for cells in lines)
        text = f"""---
{yaml.safe_dump(self.metadata(rows), sort_keys=False, allow_unicode=True)}---

# {card.algorithm}, trained to {card.task}

A policy that {self.purpose} of parkenv.
{card.steps:,} decisions of training on {lots}, seed {card.seed}, with parkenv {card.parkenv}, by {trained}.

![Its first episodes]({FILM})

## Results

{table}

{self.evaluation} In this folder,

```sh
{shlex.join(self.command_line)}
```

gives the same numbers with parkenv {__version__}.

## Use

`{MODEL}` holds the weights and a card, as safetensors: opening it runs no code.

```python
{self.usage()}
```
{extra}"""
        write_text(path, text)


class SearchPublication(Publication):
    """A model that searches."""

    command = "compare"
    beside = ("mdp", "belief", "first-free")
    environment = "parkenv/Search-v2"
    purpose = f"searches a parking lot for a free slot, {_GYMNASIUM}"
    columns: ClassVar = {
        "scenario": "{scenario}",
        "agent": "{agent}",
        "mean total time, s": _TOTAL,
        "parked": "{parked_fraction:.1%}",
        "difference to mdp, s": "{difference_s:+.1f} [{difference_s_ci95[0]:+.1f}, {difference_s_ci95[1]:+.1f}]",
    }
    options = ("--occupancy-levels", "none")

    def rows(self, workers: Workers) -> list[Row]:
        """See `Publication`."""
        made = {"agents": self.agents, "scenarios": [*self.specs.values()], "episodes": self.episodes}
        return run(Comparison(figures=False).changed(seed=self.seed, **made), workers=workers).rows

    def film(self, path: Path) -> None:
        """See `Publication`: the first episodes."""
        frames = FrameRecorder()
        agent = make_agent(self.agents[-1].name, self.scenario)
        env = make_search(self.scenario, agent, render_mode="rgb_array", max_episode_steps=_LONGEST)
        for seed in range(self.seed, self.seed + _FILMED):
            simulate(env, agent, seed, (frames,))
        save_film(frames.frames, path, fps=4.0, colors=128)

    def usage(self) -> str:
        """See `Publication`."""
        wrapper, env = "local_observation import LocalObservation", '"parkenv/Search-v2", scenario=scenario'
        return f"""import gymnasium as gym
import parkenv
from parkenv.envs.{wrapper}

scenario = parkenv.make_scenario("{next(iter(self.specs))}")
env = {wrapper.rpartition(" ")[2]}(gym.make({env}), k={self.card.k})
agent = parkenv.make_agent("{self.name}", scenario)
observation, info = env.reset(seed=0)
action, state = agent.predict(observation)"""


class DrivePublication(Publication):
    """A model that drives into slots."""

    command = "park"
    beside = (PARKING_PLANNER,)
    environment = "parkenv/Drive-v1"
    purpose = f"drives a car into a slot, {_GYMNASIUM}"
    columns: ClassVar = {
        "lot": "{scenario}",
        "agent": "{agent}",
        "parked": "{success:.1%} [{success_ci95[0]:.1%}, {success_ci95[1]:.1%}]",
        "contacts": "{contacts}",
        "median time, s": "{time_s:.1f}",
    }

    def rows(self, workers: Workers) -> list[Row]:
        """See `Publication`."""
        rows, seeds = [], range(self.seed, self.seed + self.episodes)
        for scenario in map(build, self.specs.values()):
            for agent in self.agents:
                parts = park_all([ParkingCase(scenario.lot)], seeds, workers, agent.name)
                total = parking_table([parking.row for part in parts for parking in part])[-1]
                rows.append({"scenario": scenario.name, "agent": agent.name, **total})
        return rows

    def film(self, path: Path) -> None:
        """See `Publication`: the first episodes."""
        agent = make_parking_agent(self.agents[-1].name)
        env = ParkingCase(self.scenario.lot).environment("rgb_array")
        seeds = range(self.seed, self.seed + _FILMED)
        frames = [frame for seed in seeds for frame in park_once(env, agent, seed, every=2).frames]
        save_film(frames, path, fps=10.0, colors=128)

    def usage(self) -> str:
        """See `Publication`."""
        return f"""from planners.driving.parking_agents import make_parking_agent

agent = make_parking_agent("{self.name}")  # for parkenv/Drive-v1 with obstacle_map=True"""

    def metrics(self, row: Row) -> list[Row]:
        """See `Publication`."""
        low, high = row["success_ci95"]
        name, value = f"parked [{low:.3f}, {high:.3f}]", round(row["success"], 4)
        return [{"type": "success_rate", "name": name, "value": value}]


@dataclass(frozen=True, eq=False)
class FleetPublication(Publication):
    """A model that drives every car of a fleet, with the demand of its training.

    Raises:
        InputError: there is not one scenario.
    """

    episodes: int = 16
    trained: FleetTrainingSpec = field(default_factory=FleetTrainingSpec)

    command = "fleet"
    beside = ("greedy-drive", "first-free")
    environment = "parkenv.lot_v0"
    purpose = (
        "drives cars which compete for the free slots of one parking lot, in the "
        "[PettingZoo](https://pettingzoo.farama.org) world"
    )
    columns: ClassVar = {
        "scenario": "{scenario}",
        "driver of every car": "{agent}",
        "mean total time, s": _TOTAL,
        "search time, s": "{search_s:.1f}",
        "found no slot": "{balked_fraction:.1%}",
    }

    def __post_init__(self) -> None:
        if len(self.specs) != 1:
            raise InputError(f"--scenario names {len(self.specs)} scenarios, want one for a model of a fleet")

    @cached_property
    def study(self) -> FleetStudy:
        """The days."""
        its = self.trained
        return FleetStudy(figures=False).changed(
            arrivals_per_hour=(its.arrivals_per_hour,), knows=(its.knows,), stay_s=its.stay_s,
            patience_s=its.patience_s, scenario=next(iter(self.specs.values())), days=self.episodes, seed=self.seed,
            agents=self.agents,
        )  # fmt: skip

    @property
    def options(self) -> Sequence[str]:  # type: ignore[override]
        """See `Publication`."""
        its = self.trained
        return (
            "--arrivals-per-hour", f"{its.arrivals_per_hour:g}", "--stay-min", f"{its.stay_s / 60.0:g}",
            "--patience-min", f"{its.patience_s / 60.0:g}", "--knows", its.knows,
        )  # fmt: skip

    @property
    def evaluation(self) -> str:
        """See `Publication`."""
        its = self.trained
        return (
            f"Every car has the same driver, and knows `{its.knows}`; {its.arrivals_per_hour:g} cars an hour, "
            f"{self.episodes:,} days, the same for all drivers; 95 % intervals over days in brackets. "
            f"The model was trained as the driver of: {self.card.settings['fleet']}."
        )

    def rows(self, workers: Workers) -> list[Row]:
        """See `Publication`."""
        return run(self.study, workers=workers).rows

    def film(self, path: Path) -> None:
        """See `Publication`: a minute of the first day, in the middle of its arrivals."""
        fleet, agents = self.study.fleet(self.study.fleet_settings[-1])
        fleet.reset(self.seed, 0)
        window, renderer = fleet.scenario.arrival, FleetRenderer(fleet)
        middle = fleet.begin + (window.end_s - window.start_s) / 2.0
        frames = []
        for second in np.arange(0.0, _FILM_S, _STEP_S):
            fleet.run(agents, until=middle + second)
            frames.append(renderer.frame())
        save_film(frames, path, fps=10.0, colors=64)

    def usage(self) -> str:
        """See `Publication`."""
        its = self.trained
        return f"""import parkenv
from parkenv.engine.fleet import DriverKind, Fleet
from parkenv.studies.agent_spec import AgentSpec
from parkenv.studies.fleet.drivers import demand_in, policy_of

scenario = parkenv.make_scenario("{next(iter(self.specs))}")
demand = demand_in(scenario, {its.arrivals_per_hour:g}, {its.stay_s:g}, {its.patience_s:g})
policy, _ = policy_of(AgentSpec(name="{self.name}"), scenario)
kind = DriverKind(policy=policy, knows="{its.knows}")
fleet = Fleet(scenario, demand, drivers=[kind], leave_full_lot=False)
fleet.reset(seed=0)
fleet.run()
print(fleet.cars["total_s"].mean(), "s")"""


def kind_of(model: Path, trained: TrainingSpec | None) -> Callable[..., Publication]:
    """Return the class of the publication of a model; one of a training in a fleet is evaluated in fleets."""
    if isinstance(trained, FleetTrainingSpec):
        return partial(FleetPublication, trained=trained)
    return SearchPublication if ModelCard.of_file(model).task == "search" else DrivePublication
