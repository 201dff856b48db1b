"""Record data sets for offline reinforcement learning: what agents observe, do and pay, and how actions are drawn."""

from __future__ import annotations

import re
import shlex
import shutil
from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, NamedTuple

import numpy as np
from pydantic import BeforeValidator, Field

from parkenv.errors import InputError
from parkenv.files.known_names import SCENARIO_NAMES
from parkenv.files.option import Option, option
from parkenv.files.spec_file import Several
from parkenv.scenarios.spec import scenario_spec
from parkenv.studies.agent_spec import AgentItem, AgentSpec, split_agents
from parkenv.studies.fields import OneScenario, Seed, one_word
from parkenv.studies.results import KINDS, CsvTable, Results, Row
from parkenv.studies.study import Cell, Stage, Study

if TYPE_CHECKING:
    from parkenv.studies.dataset.minari_files import DatasetFile
    from parkenv.studies.dataset.recording import SearchRecorder
    from parkenv.studies.runner import Result
    from parkenv.studies.workers import Task
    from parkenv.world.scenario import Scenario

MIXED = "mixed"
MIX = ("random", "greedy-total", "mdp", "belief")
"""What takes turns in `mixed`, where it is the only policy."""
SHORT = {"greedy": "greedy-total"}
"""Agents by the names that only data sets give them."""


def _full_name(value: object) -> object:
    return SHORT.get(value, value) if isinstance(value, str) else value


class _Policy(NamedTuple):
    """A data set: the agents that take turns in its searches."""

    label: str
    agents: tuple[AgentSpec, ...]

    def __str__(self) -> str:
        return self.label

    @property
    def columns(self) -> Row:
        """Columns that identify it."""
        return {"policy": self.label}


class DatasetStudy(Study):
    """Data sets for offline reinforcement learning, one for each policy, in Minari's format."""

    table: ClassVar = CsvTable(
        keys=("policy", "seed"),
        columns=("agent", "steps", "total_s", "parked", "truncated"),
        kinds={**KINDS, "policy": KINDS["agent"]},
        lists=None,
    )
    block: ClassVar = 50
    doing: ClassVar = "Recording"
    writing: ClassVar = "Writing data sets"
    heading: ClassVar = "Data sets recorded"

    kind: Literal["dataset"] = "dataset"
    scenario: Annotated[
        OneScenario, Option("SCENARIO", takes="NAME|FILE", parse=one_word, argument=True, default="campus")
    ] = scenario_spec("campus")
    policies: Annotated[
        Several[Annotated[AgentItem, BeforeValidator(_full_name)]],
        Field(
            min_length=1,
            max_length=100,
            description="Agents as in `parkenv compare`, with a data set for each; greedy is greedy-total; mixed "
            f"alternates between the others, or {', '.join(MIX)}.",
        ),
        Option("--policy", takes="NAME[,...]", parse=split_agents, default="mixed"),
    ] = (AgentSpec(name=MIXED),)
    steps: int = option(100_000, "Steps of each data set, as whole searches.", ge=1, le=100_000_000)
    epsilon: float = option(
        0.0, "Take a random action with this probability, as off-policy evaluation needs.", ge=0.0, le=1.0
    )
    observation: Literal["local", "occupancy", "full"] = option(
        "local", "Recorded observation of `parkenv/Search-v2`; `local` has 86 numbers on any lot."
    )
    seed: Seed = 0

    @property
    def agents(self) -> tuple[AgentSpec, ...]:
        """All agents that search."""
        named = tuple(policy for policy in self.policies if policy.name != MIXED)
        return named or tuple(AgentSpec(name=name) for name in MIX)

    @cached_property
    def works(self) -> list[_Policy]:
        """The data sets."""
        return [
            _Policy(policy.label, self.agents if policy.name == MIXED else (policy,))
            for policy in self.policies
        ]

    @cached_property
    def built(self) -> Scenario:
        """The scenario."""
        from parkenv.scenarios.build import build

        return build(self.scenario)

    @cached_property
    def recorders(self) -> dict[str, SearchRecorder]:
        """The agents by their labels."""
        from parkenv.studies.dataset.recording import SearchRecorder

        given = self.observation, self.epsilon
        return {agent.label: SearchRecorder(self.built, agent, *given) for agent in self.agents}

    def check(self) -> None:
        """See `Study`."""
        from parkenv.studies.compare.cases import check_worlds
        from parkenv.studies.dataset.minari_files import require_minari

        require_minari()
        for policy in self.policies:
            if policy.name == MIXED and policy.options:
                raise InputError(f"policy is {policy.label!r}, want mixed without options")
        names = [self._name(work) for work in self.works]
        if repeated := [name for name in names if names.count(name) > 1]:
            raise InputError(f"two policies would be {repeated[0]!r}, want names that differ in letters")
        assert self.recorders
        check_worlds(self.built, range(self.seed, self.seed + self.block))

    def settings(self) -> Row:
        """See `Study`."""
        from parkenv.studies.fingerprints import search_settings

        mixed = [agent.label for agent in self.agents] if MIXED in map(str, self.works) else None
        return search_settings(self, "epsilon", "observation", "seed") | ({"mixed": mixed} if mixed else {})

    def run(self, work: _Policy, items: Sequence[int]) -> list[Row]:
        """See `Study`: rows with the recorded search, and those of a mixture by the agent whose turn it is."""
        rows, n = [], len(work.agents)
        for turn, agent in enumerate(work.agents):
            its = [seed for seed in items if seed % n == turn]
            for search in self.recorders[agent.label].searches(its) if its else ():
                truncated = bool(search.arrays["truncations"][-1])
                total_s = truncated * self.built.give_up_s - float(search.arrays["rewards"].sum())
                row = {"policy": work.label, "seed": search.seed, "agent": agent.label, "search": search}
                row |= {"steps": len(search.arrays["actions"]), "total_s": total_s}
                rows.append(row | {"parked": search.parked, "truncated": truncated})
        return sorted(rows, key=lambda row: int(row["seed"]))

    def prepare(self, results: Results, *, continues: bool) -> None:
        """See `Study`: what is recorded and in no file runs again."""
        from parkenv.studies.dataset.minari_files import PARTS, TORN, episodes_in, seeds_in

        for torn in results.path.glob(f"{TORN}*"):
            shutil.rmtree(torn, ignore_errors=True)
        if not continues:
            for folder in (PARTS, Path(self._name(self.works[0])).parent):
                shutil.rmtree(results.path / folder, ignore_errors=True)
            return
        for work in self.works:
            kept = set(range(self.seed, self.seed + episodes_in(results.path, self._name(work))))
            for _, seeds in seeds_in(results.path / PARTS / self._name(work)):
                kept |= set(seeds)
            rows = results.rows(self.table)
            results.drop([key for key in rows if key[0] == work.label and key[1] not in kept], self.table)

    def keep(self, work: _Policy, rows: Sequence[Row], results: Results) -> None:
        """See `Study`: write the searches into a file, until all are there."""
        from parkenv.studies.dataset.minari_files import PARTS, write_part

        write_part(results.path / PARTS / self._name(work), [row.pop("search") for row in rows])

    def stages(self, results: Results) -> Iterator[Stage]:
        """See `Study`: a block of searches, then most of those that seem to be missing, until the steps are there."""
        n = dict.fromkeys(self.works, self.block)
        while n:
            yield Stage(self.doing, self, [Cell(work, self._seeds(k)) for work, k in n.items()])
            more = {}
            for work, k in n.items():
                done = int(self._steps(results, work, k).sum())
                if done < self.steps:
                    missing = 0.9 * (self.steps - done) * k / done
                    more[work] = k + self.block * max(1, int(missing / self.block))
            n = more

    def summarise(self, results: Results) -> Row:
        """See `Study`."""
        from parkenv.studies.statistics import columns_of

        found = []
        for work in self.works:
            rows = results.of(self, Cell(work, self._seeds(self._count(results, work))))
            if not rows:
                continue
            total_s = np.array([row["total_s"] for row in rows])
            mean, half = total_s.mean(), 1.96 * total_s.std() / np.sqrt(len(rows))
            found.append(
                {
                    "scenario": self.scenario.title,
                    "policy": work.label,
                    "dataset": self._name(work),
                    "episodes": len(rows),
                    "steps": sum(row["steps"] for row in rows),
                    **columns_of("total_s", (float(mean), float(mean - half), float(mean + half))),
                    "parked_fraction": float(np.mean([row["parked"] for row in rows])),
                    "truncated_fraction": float(np.mean([row["truncated"] for row in rows])),
                }
            )
        return {"rows": found}

    def outputs(self, result: Result) -> list[Task[object]]:
        """See `Study`: the data sets."""
        return [self._dataset(result, work).write for work in self.works]

    def _dataset(self, result: Result, work: _Policy) -> DatasetFile:
        from parkenv.studies.dataset.minari_files import DatasetFile

        results, name, spec = result.results, self._name(work), self.scenario
        packaged = spec.title in SCENARIO_NAMES and spec == scenario_spec(spec.title)
        about = {
            "policy": work.label,
            "agents": [agent.label for agent in work.agents],
            "epsilon": self.epsilon,
            "scenario": spec.title,
            "command": shlex.join(results.command),
        }
        env = {"scenario": spec.title if packaged else spec.tables(), "observation": self.observation}
        n = self._count(results, work)
        # Minari measures what stands at an absolute path only.
        return DatasetFile(results.path.absolute(), name, n, self.seed, env, about)

    def _seeds(self, n: int) -> range:
        return range(self.seed, self.seed + n)

    def _name(self, work: _Policy) -> str:
        """Return Minari's name of a data set, such as `parkenv/campus/mdp-failure_s-90-v0`."""
        words = (
            re.sub(r"[^\w-]+", "-", text).strip("-") or "-" for text in (self.scenario.title, work.label)
        )
        return f"parkenv/{'/'.join(words)}-v0"

    def _steps(self, results: Results, work: _Policy, n: int) -> Any:
        """Return the steps of the first n searches, as far as there are any."""
        return np.array([row["steps"] for row in results.of(self, Cell(work, self._seeds(n)))], np.int64)

    def _count(self, results: Results, work: _Policy) -> int:
        """Return how many searches the data set has: the fewest, in the order of their seeds, with enough steps."""
        recorded = sum(key[0] == work.label for key in results.rows(self.table))
        return int(np.searchsorted(np.cumsum(self._steps(results, work, recorded)), self.steps)) + 1
