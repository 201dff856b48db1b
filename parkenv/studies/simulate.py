"""Simulate one episode: an agent acts in an environment until the episode ends."""

import time
from collections.abc import MutableMapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import gymnasium as gym

from parkenv.compiled.clock import seconds_spent
from parkenv.envs.local_observation import LocalObservation
from parkenv.world.scenario import Scenario
from planners.agent import Agent, ClairvoyantAgent

# Step limit of environments that are not made by `gymnasium.make`, the same as that of `parkenv/Search-v2`.
STEP_LIMIT = 2000


class Step(NamedTuple):
    observation: Any  # observation before the decision
    action: Any  # action chosen by the agent
    memory: Any  # the agent's state after the decision; it may change with the next decision
    reward: float  # reward of the step
    next_observation: Any  # observation after the step
    terminated: bool  # whether the episode reached a terminal state
    truncated: bool  # whether the step limit ended the episode
    info: dict[str, Any]  # `info` of the step


@dataclass(frozen=True)
class EpisodeResult:
    seed: int  # seed of the world
    # `info` of the last step. A truncated search is charged the give-up penalty, see `charge_truncation`.
    info: dict[str, Any]
    truncated: bool  # whether the step limit ended the episode
    decision_s: list[float]  # wall time of each decision, s, excluding compiling and loading of compiled code
    memory: Any  # the agent's state at the end

    @property
    def steps(self) -> int:
        return len(self.decision_s)


class Observer:
    """Hooks into an episode; subclasses override what they need."""

    def on_reset(self, env: gym.Env[Any, Any], observation: Any) -> None:
        """Called after the reset, before the first decision."""

    def on_step(self, step: Step) -> None:
        """Called after each step of the environment."""


class FrameRecorder(Observer):
    """Renders the start of an episode, every n-th step and the last one.

    Args:
        every: steps between frames.

    Attributes:
        frames: the frames of all episodes so far, from an environment with `render_mode="rgb_array"`.
    """

    def __init__(self, every: int = 1) -> None:
        self._every = every
        self.frames: list[Any] = []

    def on_reset(self, env: gym.Env[Any, Any], observation: Any) -> None:
        self._env, self._steps = env, 0
        self.frames.append(env.render())

    def on_step(self, step: Step) -> None:
        self._steps += 1
        if step.terminated or step.truncated or self._steps % self._every == 0:
            self.frames.append(self._env.render())


def simulate(
    env: gym.Env[Any, Any], agent: Agent, seed: int, observers: Sequence[Observer] = ()
) -> EpisodeResult:
    """Run one episode from reset to its end.

    Args:
        env: the environment, with a step limit if the agent may never finish; see `adapt_to_agent`.
        agent: the agent; an oracle gets the hidden occupancy first.
        seed: seed of the world.
        observers: called in this order at each hook.
    """
    observation, _ = env.reset(seed=seed)
    if isinstance(agent, ClairvoyantAgent):
        state = env.unwrapped.state  # type: ignore[attr-defined]
        agent.prepare(state.world, state.time)
    for observer in observers:
        observer.on_reset(env, observation)
    memory: Any = None
    info: dict[str, Any] = {}
    decision_s: list[float] = []
    terminated = truncated = False
    while not (terminated or truncated):
        start, compiling = time.perf_counter(), seconds_spent()
        action, memory = agent.predict(observation, memory)
        # The first decision of a process may include compilation, which is not counted.
        decision_s.append(time.perf_counter() - start - (seconds_spent() - compiling))
        decided_on = observation
        observation, reward, terminated, truncated, info = env.step(action)
        step = Step(decided_on, action, memory, float(reward), observation, terminated, truncated, info)
        for observer in observers:
            observer.on_step(step)
    truncated = truncated and not terminated
    scenario = getattr(env.unwrapped, "scenario", None)
    if truncated and scenario is not None:
        info = dict(info)
        charge_truncation(info, scenario.give_up_s)
    return EpisodeResult(seed, info, truncated, decision_s, memory)


def charge_truncation(metrics: MutableMapping[str, Any], give_up_s: Any, truncated: Any = 1.0) -> None:
    """Add the give-up penalty to the metrics of truncated searches: an agent that never parks would seem cheap.

    All arguments are of one search, or arrays with one element per search.
    """
    for name in ("gave_up_s", "total_s"):
        metrics[name] = metrics[name] + truncated * give_up_s


def make_search(
    scenario: Scenario, agent: Agent, rig: str | None = None, **options: Any
) -> gym.Env[Any, Any]:
    """Make `parkenv/Search-v2`, or with a rig `parkenv/SearchPerception-v2`, as the agent observes it.

    Equal seeds give equal worlds in both.
    """
    name = "parkenv/Search-v2" if rig is None else "parkenv/SearchPerception-v2"
    options |= {} if rig is None else {"rig": rig}
    # The environments are checked by their tests; checking each again takes as long as some searches.
    env = gym.make(name, disable_env_checker=True, scenario=scenario, **options)
    return adapt_to_agent(env, agent)


def adapt_to_agent(env: gym.Env[Any, Any], agent: Agent) -> gym.Env[Any, Any]:
    k = getattr(agent, "local_k", None)
    is_local = "local" in getattr(env.observation_space, "spaces", ())
    return env if k is None or is_local else LocalObservation(env, k)
