"""Specification of a training of search agents by reinforcement learning."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from parkenv.files.option import Inside, Option, option, words_in
from parkenv.files.spec_file import Several, require_together
from parkenv.scenarios.spec import scenario_spec
from parkenv.studies.fields import (
    SCENARIOS_TAKE,
    AgentItem,
    Level,
    ScenarioList,
    Scenarios,
    Seed,
    split_agents,
)
from parkenv.studies.study import Study

if TYPE_CHECKING:
    pass

_DAYS = Inside(only=("--day-error",))


def agents_or_none(text: str) -> list[str]:
    return [] if text == "none" else split_agents(text)


class TrainingSpec(Study):
    """What to train, in which worlds, and how it is evaluated."""

    kind: Literal["train"] = "train"
    algorithm: Literal["ppo", "maskable-ppo", "recurrent-ppo", "dqn"] = option(
        "maskable-ppo", "dqn, ppo, maskable-ppo, recurrent-ppo.", argument=True
    )
    scenarios: Annotated[
        Scenarios, Option("--scenario", takes=SCENARIOS_TAKE, parse=words_in, default="campus"), _DAYS
    ] = (scenario_spec("campus"),)
    trainings: int = option(5, "Number of trainings, one for each seed.", ge=1, le=10_000)
    seed: Seed = Field(0, description="First seed of the trainings.")
    steps: int = option(2_000_000, "Decisions of a training.", ge=1, le=10**12)
    k: int = option(5, "Slots in an observation.", panel="Learning", ge=1, le=1_000)
    evaluate_every: int | None = option(
        None,
        "Decisions between evaluations.",
        panel="Evaluation",
        default="a tenth of --steps, at most 100000",
        ge=1,
        le=10**12,
    )
    evaluation_episodes: int = option(
        256,
        "Episodes of an evaluation, in held-out worlds; the test in the end has twice as many.",
        panel="Evaluation",
        ge=2,
        le=1_000_000,
    )
    held_out: Level | None = option(
        None,
        "Hold out this share of the scenarios for evaluation, by a hash of each lot, independent of the other lots.",
        takes="0 < X < 1",
        panel="Evaluation",
        default="none",
    )
    evaluate_on: Annotated[ScenarioList | None, _DAYS] = option(
        None,
        "Hold out these places instead: evaluate on them during and after training.",
        takes=SCENARIOS_TAKE,
        panel="Evaluation",
        parse=words_in,
        default="none",
    )
    test_on: Annotated[ScenarioList | None, _DAYS] = option(
        None,
        "Scenarios to test in at the end.",
        takes=SCENARIOS_TAKE,
        panel="Evaluation",
        parse=words_in,
        default="those of the training; with held-out places, all of either side together",
    )
    agents: Annotated[
        Several[AgentItem] | None,
        Option(
            takes="NAME[,...]|none",
            panel="Evaluation",
            parse=agents_or_none,
            default="belief, mdp-tuned, mdp, first-free, greedy-drive, greedy-goal; with held-out places, belief, mdp, "
            "first-free, greedy-drive",
        ),
    ] = Field(None, max_length=1_000, description="Agents to draw for comparison.")
    tensorboard: bool = option(False, "Write logs for TensorBoard to the folder.", panel="Results")

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        require_together(
            self.held_out is None or self.evaluate_on is None, "at most one of held_out, evaluate_on"
        )
        return self

    @classmethod
    def folder(cls, given: Mapping[str, Any]) -> Path:
        return Path("results") / str(given.get("ALGORITHM", cls.model_fields["algorithm"].default))
