"""Agents that drive the cars of a fleet, and its demand."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from types import FrameType
from typing import Any

from parkenv.engine.network import NetworkPolicy
from parkenv.engine.policy import CompiledPolicy
from parkenv.errors import InputError
from parkenv.studies.agent_spec import AgentSpec
from parkenv.studies.fleet.setting import COUNTED, GIVEN, times_demanded
from parkenv.studies.interruption import unsafe_to_raise
from parkenv.world.demand import (
    ConstantTime,
    Demand,
    ExponentialTime,
    FollowingArrivals,
    PoissonArrivals,
    TownDemand,
    weights_of_all,
)
from parkenv.world.scenario import Drivers, Scenario
from parkenv.world.week import HOUR_S
from planners.agent import ClairvoyantAgent, make_agent
from planners.heuristics import POLICIES
from planners.heuristics.agents import TargetAgent
from planners.model_file import LearnedAgent
from planners.names import EXPECTS_RIVALS

_WITHOUT_NETWORK_POLICY = ("recurrent-ppo",)


def policy_of(
    spec: AgentSpec, scenario: Scenario, arrivals_per_hour: float | str | None = None
) -> tuple[CompiledPolicy | None, Any]:
    """Return the compiled policy of an agent, or else the agent itself, which decides in Python.

    Heuristics and trained networks without memory are compiled. Networks of policies (ppo, maskable-ppo) draw their
    actions, as in training, so that equal cars do not all do the same; the draws follow from the world and the car.
    An agent that expects rivals gets how many cars arrive in an hour, if that is a number, as by a forecast of traffic.
    """
    if not spec.options and spec.name in POLICIES:
        return POLICIES[spec.name], None
    expects = spec.name == EXPECTS_RIVALS and not isinstance(arrivals_per_hour, str | None)
    known = {"arrivals_per_hour": arrivals_per_hour} if expects else {}
    agent = make_agent(spec.name, scenario, **known | spec.options)
    if spec.name in POLICIES and isinstance(agent, TargetAgent):
        return agent.compiled_policy(), None
    if isinstance(agent, ClairvoyantAgent):
        raise InputError(f"agent {spec.label!r} knows the future of single searches, and drives no fleet")
    if isinstance(agent, LearnedAgent) and agent.card.algorithm not in _WITHOUT_NETWORK_POLICY:
        sampled = agent.card.algorithm != "dqn"
        return network_policy(agent.model, agent.local_k, sampled=sampled, name=spec.label), None
    if isinstance(agent, LearnedAgent) or not scenario.has_rules:
        return None, agent  # learned agents observe costs themselves
    return None, AgentsByStay(spec, scenario, known)


def network_policy(policy: Any, k: int, *, sampled: bool = False, name: str = "network") -> NetworkPolicy:
    """Return a policy of stable-baselines3 or sb3-contrib, for `local` observations of k slots, as a compiled driver.

    It draws its actions if `sampled`, instead of taking the most probable one.
    """
    from torch import nn

    if hasattr(policy, "q_net"):
        parts = list(policy.q_net.q_net)
    elif hasattr(policy, "mlp_extractor") and not hasattr(policy, "lstm_actor"):
        parts = [*policy.mlp_extractor.policy_net, policy.action_net]
    else:
        parts = []
    linear = [part for part in parts if isinstance(part, nn.Linear)]
    others = {type(part).__name__.lower() for part in parts if not isinstance(part, nn.Linear)}
    if not linear or len(others) > 1 or not others <= {"tanh", "relu"}:
        raise InputError(
            f"policy is a {type(policy).__name__} with {', '.join(sorted(others)) or 'no layers'}, want a multilayer "
            "perceptron of PPO, MaskablePPO or DQN with tanh or relu"
        )
    layers = [(part.weight.detach().cpu().numpy(), part.bias.detach().cpu().numpy()) for part in linear]
    activation, masked = others.pop() if others else "tanh", type(policy).__name__.startswith("Maskable")
    return NetworkPolicy(layers, k, activation=activation, masked=masked, sampled=sampled, name=name)


def compiled_policy_of(spec: AgentSpec, scenario: Scenario) -> CompiledPolicy:
    policy, _ = policy_of(spec, scenario)
    if policy is None:
        raise InputError(f"--agents is {spec.label!r}, want a compiled one, such as usual")
    return policy


class AgentsByStay:
    """An agent in Python for each car of a fleet, which plans with what the car's own stay costs."""

    def __init__(self, spec: AgentSpec, scenario: Scenario, known: Mapping[str, Any]) -> None:
        self._spec, self._scenario, self._options = spec, scenario, {**known, **spec.options}

    def predict(self, observation: Any, state: Any = None) -> tuple[Any, Any]:
        """Return the action of the car's agent, which is made at its first decision, and the next state."""
        if state is None:
            *driver, walks = observation["driver"]
            own = self._scenario.of_driver(Drivers(*driver), walks)
            state = make_agent(self._spec.name, own, **self._options), None
        agent, memory = state
        action, memory = agent.predict(observation, memory)
        return action, (agent, memory)


def demand_in(
    scenario: Scenario, per_hour: float | str, stay_s: float, patience_s: float
) -> Demand | TownDemand:
    """Return the demand of a number of cars an hour in the hours of a scenario.

    Args:
        scenario: its hours of arrival are meant.
        per_hour: cars an hour; of a scenario with a demand of its own, in the mean over its hours, for the purposes
            that it has. Or `given`: that demand; `counted`: as many as make the lot as full as it is in the scenario's
            world; or so many times the demand of a scenario that has one, and else of the counted one, such as `1.2x`.
        stay_s: mean of the exponentially distributed stays, s, unless the scenario has a demand.
        patience_s: search time after which a car goes elsewhere, s, unless the scenario has a demand.

    In a lot with weights, cars choose entries and goals by these; else they go to the scenario's goal.
    """
    window, own = scenario.arrival, scenario.demand
    if window.end_s <= window.start_s:
        raise InputError(
            f"the arrivals of {scenario.name!r} are at one time, want hours in which cars arrive; "
            "set --hours, e.g. 08:00-12:00"
        )
    if own is None and per_hour == GIVEN:
        raise InputError(f"scenario {scenario.name!r} has no demand of its own, want cars an hour")
    if own is not None and per_hour != COUNTED:
        if isinstance(per_hour, str):
            return own.scaled(times_demanded(per_hour))
        return own.scaled(per_hour * (window.end_s - window.start_s) / HOUR_S / own.expected)
    stay = ExponentialTime(stay_s)
    arrivals: PoissonArrivals | FollowingArrivals
    if isinstance(per_hour, str):
        arrivals = FollowingArrivals(scenario.occupancy, window, stay, times_demanded(per_hour))
    else:
        arrivals = PoissonArrivals(per_hour, window.start_s, window.end_s)
    entries = weights_of_all(scenario.lot.entry_weights) if scenario.entry is None else ()
    goals = weights_of_all(scenario.lot.goal_weights)
    return Demand(arrivals, stay, ConstantTime(patience_s), entry_weights=entries, goal_weights=goals)


_RETRY_S = 0.05  # time until the signal is sent again if raising an exception was not safe, s


class LimitedAgent:
    """An agent whose decisions raise an error after a time.

    The error comes from a timer's signal, which Python handles between two of its instructions. So compiled code that
    never returns is not stopped.
    """

    def __init__(self, agent: Any, limit_s: float) -> None:
        main = threading.current_thread() is threading.main_thread()
        if not hasattr(signal, "setitimer") or not main:
            where = "this thread" if hasattr(signal, "setitimer") else "this operating system"
            raise InputError(f"--decision-limit needs a timer signal, which {where} does not get")
        self._agent, self._limit_s = agent, limit_s

    def __getattr__(self, name: str) -> Any:
        return getattr(self._agent, name)

    def predict(self, observation: Any, state: Any = None) -> tuple[Any, Any]:
        """Return the agent's action and its next state.

        Raises:
            TimeoutError: the agent took longer than its limit.
        """
        with _raising_after(self._limit_s):
            action, state = self._agent.predict(observation, state)
        return action, state


@contextmanager
def _raising_after(limit_s: float) -> Iterator[None]:
    def stop(number: int, frame: FrameType | None) -> None:
        del number
        if unsafe_to_raise(frame):
            signal.setitimer(signal.ITIMER_REAL, _RETRY_S)
            return
        signal.setitimer(signal.ITIMER_REAL, limit_s)  # once more, for an agent that catches the error
        raise TimeoutError(f"no decision within {limit_s:g} s")

    before = signal.signal(signal.SIGALRM, stop)
    try:
        try:
            signal.setitimer(signal.ITIMER_REAL, limit_s)
            yield
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
    finally:
        # The signal may have come just before the timer was stopped.
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
