"""The interface of agents, and a factory that makes agents by name."""

import inspect
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, ClassVar, Generic, Protocol, TypeVar, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from parkenv.belief.slot_belief import SlotBelief
from parkenv.errors import InputError, nearest, require
from parkenv.files.user_class import file_of_class, load_class
from parkenv.world.occupancy.process import World
from parkenv.world.scenario import SearchProblem
from planners.names import AGENTS, ALGORITHMS, FILE_AGENTS, HUMAN, NETWORK

Observation = Mapping[str, Any]
Memory = TypeVar("Memory")


class Agent(Protocol):
    """Interface of planners, heuristic baselines and stable-baselines3 models."""

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[Any, Any]:
        """Return an action for an observation, and the state to pass to the next call."""


@runtime_checkable
class ClairvoyantAgent(Protocol):
    """An agent that knows the hidden occupancy of each episode. The oracle is the only one in this package."""

    def prepare(self, world: World, time: float) -> None:
        """Receive the world of the next episode and its start time, s since Monday 00:00."""


class SearchAgent(ABC, Generic[Memory]):
    """Base class of the agents for `parkenv/Search-v2`.

    A subclass decides on one observation at a time, from the belief that the observation contains; this class handles
    batches. An agent object does not change: the memory of an episode is in `state`, so one object can serve many
    episodes at once.
    """

    name: ClassVar[str]

    def __init__(self, problem: SearchProblem) -> None:
        # From a whole scenario, keep the public part only.
        self.problem = problem.public()

    @abstractmethod
    def begin(self, observation: Observation, belief: SlotBelief) -> Memory:
        """Return the memory for an episode that starts with this observation and the belief that it contains."""

    @abstractmethod
    def decide(self, observation: Observation, belief: SlotBelief, memory: Memory) -> int:
        """Choose the action; `memory`, that of this episode, may be changed in place."""

    def predict(
        self,
        observation: Observation,
        state: Sequence[Memory] | Memory | None = None,
        episode_start: NDArray[np.bool_] | Sequence[bool] | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[np.int64], Sequence[Memory] | Memory]:
        """Choose actions for one observation or a batch with a leading axis (stable-baselines3's interface).

        Args:
            observation: from `parkenv/Search-v2` or a vector of them.
            state: returned by the previous call; None at the start.
            episode_start: for each environment, whether its episode has just begun. With None, episodes begin where
                `state` is None.
            deterministic: part of the interface; ignored by these agents.

        Returns:
            The action, () or (n_envs,) int64, and the state to pass to the next call.
        """
        if not isinstance(observation, Mapping) or "vertex" not in observation:
            keys = (
                ", ".join(map(str, observation))
                if isinstance(observation, Mapping)
                else type(observation).__name__
            )
            raise InputError(
                f'observation holds {keys:.120}, want the dictionary of parkenv/Search-v2 with observation="full"'
            )
        return predict_each(self._predict_one, observation, "vertex", 0, state, episode_start)

    def _predict_one(
        self, observation: Observation, memory: Memory | None
    ) -> tuple[NDArray[np.int64], Memory]:
        belief = belief_for_decision(observation)
        if memory is None:
            memory = self.begin(observation, belief)
        return np.asarray(self.decide(observation, belief, memory), dtype=np.int64), memory

    def wait(self, vertex: int) -> int:
        """Return a move without an edge, which waits; the shortest move if all four have edges."""
        missing = np.flatnonzero(self.problem.lot.neighbors[vertex] < 0)
        return int(missing[0]) if len(missing) else int(self.problem.move_cost_s[vertex].argmin())

    def plan_preview(self, observation: Observation, action: int, memory: Memory) -> tuple[int, ...]:
        """Return the vertices ahead, in order, right after `predict` chose `action`; none if there is no plan.

        Args:
            observation: the last argument of `predict`.
            action: the action that it chose.
            memory: the state that `predict` returned.
        """
        return ()


def predict_each(
    predict_one: Callable[[Observation, Any], tuple[Any, Any]],
    observation: Observation,
    key: str,
    n_axes: int,
    state: Any,
    episode_start: Any,
) -> tuple[Any, Any]:
    """Predict for one observation, whose entry `key` has `n_axes`, or for each of a batch; without a state at a start.

    Return the actions, one or with a leading axis, and the states.
    """
    if np.ndim(observation[key]) == n_axes:
        starts = episode_start is not None and bool(np.any(episode_start))
        return predict_one(observation, None if starts else state)
    n = len(observation[key])
    states = [None] * n if state is None else list(state)
    actions = []
    for i in range(n):
        single = {name: values[i] for name, values in observation.items()}
        starts = episode_start is not None and bool(episode_start[i])
        action, states[i] = predict_one(single, None if starts else states[i])
        actions.append(action)
    return np.array(actions), states


def belief_for_decision(observation: Observation) -> SlotBelief:
    """Return the belief that an agent decides on; a car of a guidance system keeps to the slot reserved for it."""
    belief = SlotBelief.of_observation(observation)
    is_guided = "reserved" in observation and observation["reserved"].min() >= 0
    return belief.with_reservation(observation["reserved"]) if is_guided else belief


def require_observations(name: str, problem: SearchProblem) -> None:
    """Raise an `InputError` for the agent `name` if the problem's sensor can never observe a slot from the lane."""
    require(
        problem.sensor_rates.seen.any(),
        f"{name} plans on observations, and this sensor model has none; take mdp",
    )


def make_agent(name: str, scenario: SearchProblem, **options: Any) -> Agent:
    """Make an agent that knows the scenario's public part: lot, goal, speeds and costs.

    Args:
        name: one of `planners.names.AGENTS`; `ALGORITHM:FILE` for a model of `parkenv train`, such as
            `ppo:ppo.safetensors`; `network:FILE` for other weights of `network`; `human:FILE` for the scores of a
            game; or `MODULE:CLASS` for your own agent, such as `my_agents:Patient`: a class whose first argument is
            the problem. The module may be in the working directory.
        scenario: the scenario; its hidden occupancy is not passed to the agent.
        options: options of the agent, such as `failure_s=5.0` for "mdp".

    Raises:
        InputError: an unknown name or option; the message lists the known ones.
    """
    require(isinstance(name, str), f"agent is {name!r:.60}, want a name, such as 'mdp'")
    before, colon, after = name.partition(":")
    if colon and before in (*ALGORITHMS, HUMAN):
        require(not options, f"agent {name!r} has no options; got {', '.join(options)}")
        if before == HUMAN:
            return _loaded("planners.human", "HumanAgent")(scenario, after)
        return _loaded("planners.model_file", "LearnedAgent")(scenario, before, after)
    if colon and before == NETWORK:
        options, name, colon = {"weights": after, **options}, NETWORK, ""
    agent, known = _class_of(name), agent_options(name)
    if colon:
        scenario = scenario.public()
    for option in options:
        require(option in known, f"agent {name!r} has no option {option!r}; {nearest(option, known)}")
    try:
        return agent(scenario, **options)
    except InputError:
        raise
    except Exception as error:
        # A user's class may raise anything, ours if the value of an option has a wrong type.
        if not colon and not options:
            raise
        given = ", ".join(f"{option}={value!r:.60}" for option, value in options.items())
        raise InputError(f"{name}({given}) cannot be made: {type(error).__name__}: {error}") from error


def agent_options(name: str) -> tuple[str, ...]:
    """Return the names of the options that an agent has; none if it comes from a file.

    Examples:
        >>> agent_options("oracle")
        ()
    """
    before, colon, _ = name.partition(":")
    if colon and before in FILE_AGENTS:
        return ()
    return tuple(inspect.signature(_class_of(name)).parameters)[1:]


def _class_of(name: str) -> Callable[..., Agent]:
    if ":" in name:
        wanted = "predict(observation, state, episode_start, deterministic)"
        known = f"; nor is it an algorithm ({', '.join(FILE_AGENTS)})"
        own: Callable[..., Agent] = load_class(name, "agent", wanted, alternatives=known)
        return own
    require(
        name in AGENTS,
        f"unknown agent {name!r}; {nearest(name, AGENTS)}, ALGORITHM:FILE for a trained model, MODULE:CLASS for "
        "your own",
    )
    return _loaded(*AGENTS[name])


def _loaded(module: str, class_name: str) -> Callable[..., Agent]:
    kind: Callable[..., Agent] = getattr(import_module(module), class_name)
    return kind


def shown_name(name: str) -> str:
    """Return the name of an agent for tables: the attribute `name` of a user's class, if it has one."""
    before, colon, _ = name.partition(":")
    if not colon or before in FILE_AGENTS:
        return name
    own = getattr(load_class(name, "agent", "predict"), "name", None)
    return own if isinstance(own, str) and own else name


def agent_file(name: str) -> Path | None:
    """Return the file that defines an agent that `make_agent` has made: a trained model, or a user's module."""
    before, colon, after = name.partition(":")
    if not colon:
        return None
    if before in FILE_AGENTS:
        return Path(after)
    return file_of_class(name)
