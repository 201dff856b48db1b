"""A folder with a trained model that the Hugging Face Hub takes as it is: model, model card, results, film."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import yaml

from parkenv import __version__
from parkenv.files.atomic_write import atomic_write
from parkenv.show.figures.picture_files import save_film
from parkenv.studies.agent_spec import AgentSpec
from parkenv.studies.compare.cases import rows_of
from parkenv.studies.frame_recorder import FrameRecorder
from parkenv.studies.results import Row
from parkenv.studies.simulate import make_search, simulate
from parkenv.studies.trips.parking_runs import ParkingCase, park_all, park_once, parking_table
from parkenv.studies.workers import Workers
from parkenv.world.scenario import Scenario
from planners.agent import make_agent
from planners.driving.parking_agents import make_parking_agent
from planners.model_file import SCANS_OBSERVATION, ModelCard
from planners.names import PARKING_PLANNER

MODEL, FILM, CARD = "model.safetensors", "replay.gif", "README.md"
BESIDE = ("mdp", "belief", "first-free")
"""Agents that search in the same worlds."""
_FILMED, _LONGEST = 3, 150


@dataclass(frozen=True, eq=False)
class Publication:
    """A model and the worlds that it is evaluated in.

    Args:
        model: the model file.
        scenarios: worlds, by the name or file that a command line gives them.
        episodes: episodes in each scenario.
        seed: first seed of the worlds.
    """

    model: Path
    scenarios: Mapping[str, Scenario]
    episodes: int
    seed: int

    @property
    def card(self) -> ModelCard:
        """Metadata of the model file."""
        return ModelCard.of_file(self.model)

    @property
    def name(self) -> str:
        """The model as an agent of a command line in the folder."""
        return f"{self.card.algorithm}:{MODEL}"

    @property
    def _source(self) -> str:
        return f"{self.card.algorithm}:{self.model}"

    @property
    def command(self) -> list[str]:
        """Command line that repeats the evaluation, in the folder."""
        command, beside = ("compare", BESIDE) if self.card.task == "search" else ("park", (PARKING_PLANNER,))
        return [
            "parkenv", command, "--scenario", ",".join(self.scenarios), "--agents", ",".join((*beside, self.name)),
            "--episodes", str(self.episodes), "--seed", str(self.seed),
            *(("--occupancy-levels", "none") if command == "compare" else ()),
        ]  # fmt: skip

    def evaluate(self, workers: Workers) -> list[Row]:
        """Run the model and planners in the same worlds; return a row for each scenario and agent."""
        seeds = range(self.seed, self.seed + self.episodes)
        rows: list[Row] = []
        for scenario in self.scenarios.values():
            if self.card.task == "search":
                agents = [AgentSpec(name=name) for name in (*BESIDE, self._source)]
                rows += rows_of(agents, scenario, seeds, workers)
            else:
                for agent in (PARKING_PLANNER, self._source):
                    some = park_all([ParkingCase(scenario.lot)], seeds, workers, agent)
                    total = parking_table([p.row for part in some for p in part])[-1]
                    rows.append({"scenario": scenario.name, "agent": agent, **total})
        return [row | {"agent": self.name} if row["agent"] == self._source else row for row in rows]

    def film(self, path: Path) -> None:
        """Film the model's first episodes in the first scenario, a GIF."""
        scenario = next(iter(self.scenarios.values()))
        seeds, frames = range(self.seed, self.seed + _FILMED), FrameRecorder()
        if self.card.task == "search":
            agent = make_agent(self._source, scenario)
            env = make_search(scenario, agent, render_mode="rgb_array", max_episode_steps=_LONGEST)
            for seed in seeds:
                simulate(env, agent, seed, (frames,))
            save_film(frames.frames, path, fps=4.0, colors=128)
        else:
            parker, drive = (
                make_parking_agent(self._source),
                ParkingCase(scenario.lot).environment("rgb_array"),
            )
            shown = [frame for seed in seeds for frame in park_once(drive, parker, seed, every=2).frames]
            save_film(shown, path, fps=10.0, colors=128)

    @property
    def environment(self) -> str:
        """Environment of the evaluation."""
        return "parkenv/Search-v2" if self.card.task == "search" else "parkenv/Drive-v1"

    @property
    def purpose(self) -> str:
        """What the model does, and where, as a part of a sentence."""
        does = (
            "searches a parking lot for a free slot"
            if self.card.task == "search"
            else "drives a car into a slot"
        )
        return f"{does}, in [Gymnasium](https://gymnasium.farama.org) environments"

    @property
    def evaluation(self) -> str:
        """What the evaluation consists of, a sentence."""
        return (
            f"{self.episodes:,} episodes in each scenario, in the same worlds for all agents; "
            "95 % intervals in brackets."
        )

    def table(self, rows: Sequence[Row]) -> str:
        """Return the results of `evaluate` as a table in Markdown."""
        return _table(rows)

    def usage(self) -> str:
        """Return lines of Python that use the model."""
        return _usage(self.card, next(iter(self.scenarios)))

    def metadata(self, rows: Sequence[Row]) -> Row:
        """Return the model card's metadata as the Hub specifies it, with a `model-index` of the results."""
        card, env = self.card, self.environment
        results = [
            {
                "task": {"type": "reinforcement-learning", "name": f"{card.task} for parking"},
                "dataset": {"type": env, "name": f"{env}, {row['scenario']}"},
                "metrics": _metrics(row),
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
        text = f"""---
{yaml.safe_dump(self.metadata(rows), sort_keys=False, allow_unicode=True)}---

# {card.algorithm}, trained to {card.task}

A policy that {self.purpose} of parkenv.
{card.steps:,} decisions of training on {lots}, seed {card.seed}, with parkenv {card.parkenv}, by {trained}.

![Its first episodes]({FILM})

## Results

{self.table(rows)}

{self.evaluation} In this folder,

```sh
{shlex.join(self.command)}
```

gives the same numbers with parkenv {__version__}.

## Use

`{MODEL}` holds the weights and a card, as safetensors: opening it runs no code.

```python
{self.usage()}
```
{extra}"""
        with atomic_write(path) as beside:
            beside.write_text(text, encoding="utf-8")


def _metrics(row: Row) -> list[Row]:
    if "total_s" in row:
        low, high = row["total_s_ci95"]
        return [
            {"type": "mean_reward", "name": "mean return, s", "value": round(-row["total_s"], 2)},
            {
                "type": "total_s",
                "name": f"mean total time, s [{low:.1f}, {high:.1f}]",
                "value": round(row["total_s"], 2),
            },
        ]
    low, high = row["success_ci95"]
    return [
        {"type": "success_rate", "name": f"parked [{low:.3f}, {high:.3f}]", "value": round(row["success"], 4)}
    ]


def _table(rows: Sequence[Row]) -> str:
    if "total_s" in rows[0]:
        lines = [
            "| scenario | agent | mean total time, s | parked | difference to mdp, s |",
            "|---|---|---|---|---|",
        ]
        for row in rows:
            low, high = row["total_s_ci95"]
            ends = row["difference_s_ci95"]
            apart = f"{row['difference_s']:+.1f} [{ends[0]:+.1f}, {ends[1]:+.1f}]" if ends else ""
            lines.append(
                f"| {row['scenario']} | {row['agent']} | {row['total_s']:.1f} [{low:.1f}, {high:.1f}] | "
                f"{row['parked_fraction']:.1%} | {apart} |"
            )
    else:
        lines = ["| lot | agent | parked | contacts | median time, s |", "|---|---|---|---|---|"]
        for row in rows:
            low, high = row["success_ci95"]
            lines.append(
                f"| {row['scenario']} | {row['agent']} | {row['success']:.1%} [{low:.1%}, {high:.1%}] | "
                f"{row['contacts']} | {row['time_s']:.1f} |"
            )
    return "\n".join(lines)


def _usage(card: ModelCard, scenario: str) -> str:
    if card.task == "drive":
        return f"""from planners.driving.parking_agents import make_parking_agent

agent = make_parking_agent("{card.algorithm}:{MODEL}")  # for parkenv/Drive-v1 with obstacle_map=True"""
    wrapper, env = "local_observation import LocalObservation", '"parkenv/Search-v2", scenario=scenario'
    if card.observation == SCANS_OBSERVATION:
        wrapper = "scan_observation import ScanObservation"
        env = '"parkenv/SearchSensors-v2", scenario=scenario, observation="scan", captures=1'
    return f"""import gymnasium as gym
import parkenv
from parkenv.envs.{wrapper}
from planners import make_agent

scenario = parkenv.make_scenario("{scenario}")
env = {wrapper.rpartition(" ")[2]}(gym.make({env}), k={card.k})
agent = make_agent("{card.algorithm}:{MODEL}", scenario)
observation, info = env.reset(seed=0)
action, state = agent.predict(observation)"""
