"""What an agent is, and how to make one by name."""

from __future__ import annotations

import inspect
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, ClassVar, Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from parkenv.errors import InputError
from parkenv.files.user_class import file_of_class, load_class
from parkenv.world.scenario import Scenario, SearchProblem
from planners.learned import ALGORITHMS

Observation = Mapping[str, Any]
Memory = TypeVar("Memory")


class Agent(Protocol):
    """Whatever decides: planners, strategies and stable-baselines3's models alike."""

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[Any, Any]:
        """Choose an action for an observation; hand the returned state back at the next call."""
        ...


class SearchAgent(ABC, Generic[Memory]):
    """Base of the agents for `parkenv/Search-v1`: one decision at a time, batches handled here.

    An agent object holds what it knows of the problem and never changes; what it remembers of an episode
    travels in `state`, so one object may serve many episodes at once.
    """

    name: ClassVar[str]

    def __init__(self, problem: SearchProblem) -> None:
        # Handed a whole scenario, an agent keeps the part that it may know.
        self.problem = problem.public() if isinstance(problem, Scenario) else problem

    @abstractmethod
    def begin(self, observation: Observation) -> Memory:
        """What to remember when an episode starts with this observation."""

    @abstractmethod
    def decide(self, observation: Observation, memory: Memory) -> int:
        """The action for this observation; `memory` may be written to."""

    def predict(
        self,
        observation: Observation,
        state: Sequence[Memory] | Memory | None = None,
        episode_start: NDArray[np.bool_] | Sequence[bool] | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[np.int64], Sequence[Memory] | Memory]:
        """stable-baselines3's interface: single observations, or batches of them with a leading axis.

        Args:
            observation: from `parkenv/Search-v1` or a vector of them.
            state: what the last call returned; None at the start.
            episode_start: for each environment, whether its episode has just begun. With None, it has
                where there is no state.
            deterministic: accepted for the interface; these agents make no distinction.

        Returns:
            The action, () or (n_envs,) int64, and the state to hand back.
        """
        del deterministic
        if np.ndim(observation["vertex"]) == 0:
            starts = state is None or (episode_start is not None and bool(np.any(episode_start)))
            memory: Memory = self.begin(observation) if starts else state  # type: ignore[assignment]
            return np.asarray(self.decide(observation, memory), dtype=np.int64), memory
        n = len(observation["vertex"])
        memories: list[Any] = [None] * n if state is None else list(state)  # type: ignore[arg-type]
        actions = np.empty(n, dtype=np.int64)
        for i in range(n):
            single = {key: values[i] for key, values in observation.items()}
            if memories[i] is None or (episode_start is not None and episode_start[i]):
                memories[i] = self.begin(single)
            actions[i] = self.decide(single, memories[i])
        return actions, memories


# Modules are named, not imported: a strategy needs no sparse solver, and nobody pays for torch unasked.
_AGENTS: dict[str, tuple[str, str]] = {
    "mdp": ("planners.thesis.replanning", "ReplanningAgent"),
    "mdp-static": ("planners.thesis.replanning", "StaticAgent"),
    "greedy-goal": ("planners.greedy", "GreedyGoalAgent"),
    "greedy-drive": ("planners.greedy", "GreedyDriveAgent"),
    "first-free": ("planners.greedy", "FirstFreeAgent"),
    "random": ("planners.greedy", "RandomAgent"),
    "oracle": ("planners.bounds.oracle", "OracleAgent"),
    "belief": ("planners.belief.agent", "BeliefAgent"),
    "mdp-tuned": ("planners.thesis.tuning", "TunedAgent"),
    "exact": ("planners.bounds.exact", "ExactAgent"),
}

SMALL_LOTS_ONLY = ("exact",)
"""Agents that refuse lots over a certain size and looks that may err."""
AGENT_NAMES = tuple(name for name in _AGENTS if name not in SMALL_LOTS_ONLY)
"""Agents for lots of any kind and size."""


def require_sight(name: str, problem: SearchProblem) -> None:
    """Refuse problems in which no slot is made out before somebody tries to park there.

    Args:
        name: of the agent that refuses.
        problem: how slots are seen.

    Raises:
        InputError: nothing is seen.
    """
    if not problem.sensor_rates.seen.any():
        raise InputError(
            f"{name} plans on what it sees from the lane, and here slots are seen only by trying; take mdp"
        )


def make_agent(name: str, scenario: Scenario | SearchProblem, **options: Any) -> Agent:
    """Make an agent that knows the scenario's public part: lot, goal, speeds and costs.

    Args:
        name: one of `AGENT_NAMES` or `SMALL_LOTS_ONLY`; `ALGORITHM:FILE` for a model of `parkenv train`, such as
            `ppo:models/ppo.zip`; or `MODULE:CLASS` for an agent of your own, such as `my_agents:Patient`: a class whose
            first argument is the problem. The module is looked for in the working directory, too.
        scenario: the scenario; what stands in its slots is kept from the agent.
        options: the agent's own, such as `failure_s=5.0` of "mdp".

    Raises:
        InputError: an unknown name or option; the message lists the known ones.
    """
    before, colon, after = name.partition(":")
    if colon and before in ALGORITHMS:
        if options:
            raise InputError(f"agent {name!r} has no options; got {', '.join(options)}")
        learned: Agent = import_module("planners.learned").LearnedAgent(scenario, before, after)
        return learned
    agent: Callable[..., Agent]
    if colon:
        agent = load_class(
            name,
            "agent",
            "predict(observation, state, episode_start, deterministic)",
            alternatives=f"; nor is it an algorithm ({', '.join(ALGORITHMS)})",
        )
        scenario = scenario.public() if isinstance(scenario, Scenario) else scenario
    elif name in _AGENTS:
        module, class_name = _AGENTS[name]
        agent = getattr(import_module(module), class_name)
    else:
        others = "ALGORITHM:FILE for a trained model, MODULE:CLASS for your own"
        raise InputError(f"unknown agent {name!r}; known: {', '.join(_AGENTS)}, {others}")
    known = [p for p in inspect.signature(agent).parameters if p != "problem"]
    for option in options:
        if option not in known:
            raise InputError(f"agent {name!r} has no option {option!r}; known: {', '.join(known) or 'none'}")
    return agent(scenario, **options)


def agent_file(name: str) -> Path | None:
    """The file that an agent comes from: a trained model, or the module of an agent of your own.

    Args:
        name: as `make_agent` takes it, which has made an agent of it before.

    Returns:
        None for the agents that come with the package.
    """
    before, colon, after = name.partition(":")
    if not colon:
        return None
    if before in ALGORITHMS:
        return Path(after)
    return file_of_class(name)
