"""`parkenv.lot_v0`: many cars search one lot for free slots, as a PettingZoo environment.

`env` and `raw_env` make the AEC form, which is exact: the car whose decision is next decides. `parallel_env` makes the
parallel form, which advances by ticks. Both need the extra `multi`: `pip install "parkenv[multi]"`.
"""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from dataclasses import fields
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.error import DependencyNotInstalled, ResetNeeded
from numpy.typing import NDArray

from parkenv.errors import InputError, needs_extra, require_number, require_one_of, require_whole

try:
    from pettingzoo import AECEnv, ParallelEnv
    from pettingzoo.utils import wrappers
except ImportError as error:
    raise DependencyNotInstalled(needs_extra("parkenv.lot_v0", "multi")) from error

from parkenv.engine.fleet import DriverKind, Fleet, FleetOptions
from parkenv.engine.kernel import read_step
from parkenv.engine.records import SEARCHING, TRUNCATED
from parkenv.engine.spaces import action_number
from parkenv.files.known_names import MAX_CARS
from parkenv.scenarios.build import ScenarioSource, make_scenario, require_changes
from parkenv.world.demand import Demand, Headways, TownDemand
from parkenv.world.lot import ACTIONS

if TYPE_CHECKING:
    from parkenv.show.frames.fleet import FleetRenderer

__all__ = ["LotEnv", "LotParallelEnv", "env", "parallel_env", "raw_env"]

Observation = Mapping[str, Any]
_MARGIN = 1e-6  # of a tick


class _CarsAsAgents:
    """What both forms have in common: a fleet whose cars are all decided from outside."""

    metadata: dict[str, Any] = {  # noqa: RUF012 - PettingZoo's
        "name": "lot_v0",
        "render_modes": ["human", "rgb_array"],
        "render_fps": 8,
        "is_parallelizable": False,
    }

    def __init__(
        self,
        scenario: ScenarioSource = "mini",
        cars: int = 5,
        demand: Demand | TownDemand | None = None,
        background: str = "residents",
        max_cycles: int = FleetOptions.max_steps,
        render_mode: str | None = None,
        knows: str = "own",
        **changes: Any,
    ) -> None:
        require_one_of("render_mode", render_mode, (None, *self.metadata["render_modes"]))
        if demand is None:
            require_whole("cars", cars, least=1, most=MAX_CARS)
            demand = Demand(Headways(int(cars)))
        require_whole("max_cycles", max_cycles, least=1)
        own = ("drivers", "background", "max_steps")
        known = [field.name for field in fields(FleetOptions) if field.name not in own]
        require_changes((type(self), LotEnv), changes, *known)
        options = FleetOptions(
            drivers=(DriverKind(knows=knows, shares=knows == "shared"),),
            background=background,
            max_steps=max_cycles,
            **{name: changes.pop(name) for name in known if name in changes},
        )
        # With the hidden occupancy: not for agents.
        self.fleet = Fleet(make_scenario(scenario, **changes), demand, options)
        self.scenario = self.fleet.scenario
        self.render_mode, self.max_cycles = render_mode, max_cycles
        self.possible_agents = [f"car_{i}" for i in range(demand.max_cars)]
        self.agents: list[str] = []
        self._observation_space = self.fleet.observation_space
        self._spaces: dict[str, tuple[spaces.Dict, spaces.Discrete]] = {}
        self._seed: int | None = None
        self._episode = 0
        self._renderer: FleetRenderer | None = None

    __copy__ = deepcopy

    def observation_space(self, agent: str) -> spaces.Dict:
        """Return the space of an agent's observations, always the same object; that of `parkenv/Search-v2`."""
        return self._spaces_of(agent)[0]

    def action_space(self, agent: str) -> spaces.Discrete:
        return self._spaces_of(agent)[1]

    def _spaces_of(self, agent: str) -> tuple[spaces.Dict, spaces.Discrete]:
        if agent not in self._spaces:
            own = spaces.Dict(dict(self._observation_space.items()))
            self._spaces[agent] = own, spaces.Discrete(len(ACTIONS))
        return self._spaces[agent]

    def _begin(self, seed: int | None) -> list[str]:
        if seed is not None:
            require_whole("seed", seed)
            self._seed, self._episode = int(seed), 0
        elif self._seed is None:
            self._seed = int(np.random.SeedSequence().generate_state(1)[0])
        else:
            self._episode += 1
        self.fleet.reset(self._seed, self._episode)
        return self.possible_agents[: len(self.fleet.cars)]

    def _blank_info(self, car: int) -> dict[str, Any]:
        blank = (0.0,) * 14 + (0, 0, False, False, 0)
        return read_step(int(self.fleet.cars["scenario_index"][car]), blank)[3]

    def _blank_observation(self, car: int) -> dict[str, Any]:
        boxes = {name: box for name, box in self._observation_space.items() if isinstance(box, spaces.Box)}
        blank: dict[str, Any] = {name: np.zeros(box.shape, box.dtype) for name, box in boxes.items()}
        blank["vertex"] = np.int64(self.fleet.cars["entry"][car])
        blank["p_occupied"][:] = 1.0
        parts = blank["belief"].reshape(4, -1)
        parts[0], parts[2], parts[3] = 1.0, 1.0, -1.0
        blank["step_observed"].reshape(4, -1)[0] = -1.0
        return blank

    def render(self) -> NDArray[np.uint8] | None:
        if self.render_mode is None:
            gym.logger.warn('render() does nothing without a render_mode, e.g. env(render_mode="rgb_array")')
            return None
        if self._renderer is None:
            from parkenv.show.frames.fleet import FleetRenderer

            self._renderer = FleetRenderer(self.fleet)
        frame = self._renderer.frame()
        if self.render_mode == "rgb_array":
            return frame
        self._renderer.window.show(frame, self.metadata["render_fps"])
        return None

    def close(self) -> None:
        self.agents = []
        if self._renderer is not None:
            self._renderer.window.close()
            self._renderer = None


def _car_of(agent: str) -> int:
    return int(agent.rpartition("_")[2])


class LotEnv(_CarsAsAgents, AECEnv[str, Observation, Any]):  # type: ignore[misc] # PettingZoo has no types
    """Many cars search one lot for free slots; the car whose decision is next decides (AEC).

    ## Description
    Cars arrive, search, compete for slots, park, stay and leave. Each car is a search as in `parkenv/Search-v2`: its
    driver knows the lot and an occupancy forecast, observes nearby slots while driving past, and wants to reach a goal
    on foot in as little time as possible. But the slots are shared: a slot that one car takes is taken for all others
    until that car leaves. An agent is a car, `car_0`, `car_1`, ... in order of arrival; every agent of `parkenv` drives
    one unchanged.

    Time is continuous. At each moment, first parked cars leave, cars arrive, and cars whose step is over observe; then
    the cars that have to decide do so one after another, in the order of these events. A decision acts at once: of two
    cars before the same free slot, the first to decide gets it, and the other one has a failed attempt.

    | | |
    |---|---|
    | Import | `from parkenv import lot_v0`; needs `pip install "parkenv[multi]"` |
    | Actions | discrete |
    | Parallel API | yes, `lot_v0.parallel_env()`, which advances by ticks |
    | Manual control | no |
    | Agents | `car_0`, ..., `car_4` by default |
    | Action shape | `Discrete(5)` |
    | Observation | `Dict` |

    ## Action space
    `Discrete(5)`: up, down, left, right, park; as in `parkenv/Search-v2`.

    ## Observation space
    The `Dict` of `parkenv/Search-v2`: `vertex`, `time`, `p_occupied`, `belief`, `day_error`, `action_mask`. It holds
    what the car knows (by default its own observations) and its forecast for its own arrival. Where parking has
    prices, `stay_s`, `Box(0, inf, (1,), float32)`, is the car's own stay, s, which it pays for.

    ## Rewards
    Minus the duration of a car's step, s, as in `parkenv/Search-v2`, given when the step is over; parking also
    subtracts the walk to the goal and the slot's parking cost. `infos[agent]` holds the parts. A car's
    return is minus its total time. One car's gain may be the others' loss: the sum over cars is the social cost.

    ## Starting state
    `reset(seed=s)` fixes arrivals, entries, goals, stays, and the cars that stand in the lot when the world begins,
    whatever the agents do. Later `reset()` calls draw further worlds of the same seed. All cars of the world are
    in `agents` from the start; the first to be selected is the first to arrive. `options` are ignored.

    ## Episode end
    - Terminated, car by car: parked; gave up, because it has observed that every slot is taken; or *balked*, because
      its search has lasted as long as its patience (in a town, without the way to its goal). Giving up and balking
      cost `give_up_s`.
    - Truncated, car by car: after `max_cycles` decisions.

    The world ends when all cars' searches are over. A parked car stays in its slot for its stay, then leaves.

    ## Arguments
    - `scenario`: as in `parkenv/Search-v2`: a name, a file, a lot, a `Scenario`.
    - `cars`: number of cars. The first arrives at a time in the scenario's arrival window, the others after it, 10 s
      apart on average; they stay for an hour on average (both exponentially distributed).
    - `demand`: a `parkenv.world.demand.Demand` instead of `cars`: Poisson or listed arrivals, stays, patience, entries,
      goals.
    - `background`: other cars that take slots: `residents`, which are parked at the start and leave once; `process`,
      the scenario's occupancy all day; `none`.
    - `max_cycles`: limit of a car's decisions.
    - `render_mode`: `rgb_array` (480, 640, 3) or `human` (needs the extra `human`).
    - `knows`: what cars know of the slots besides the forecast: `own`, their own observations; `shared`, those of all
      cars, `delay_s` later; `reserve`, the slot that a guidance system reserves for them; `full`, every slot.
    - `leave_full_lot`: whether a car that knows every slot to be taken gives up at once; otherwise at the end of its
      patience.
    - `manoeuvre_s`: above 0, cars that park, leave or stand still block their lane, and queues form.
    - `cues`, a field of the scenario: cars show that they are about to leave; one that waits at such a slot holds it.
    - `sees_cars`: whether observations have the key `cars`: the other cars in view. `parkenv.engine.fleet.Fleet`
      describes these options.
    - further keywords replace fields of the scenario, e.g. `failure_s=90.0`.

    ```python
    >>> from parkenv import lot_v0, make_agent
    >>> env = lot_v0.env(scenario="mini", cars=3)
    >>> env.reset(seed=1)
    >>> driver, memory, returns = make_agent("belief", env.unwrapped.scenario), {}, {}
    >>> for car in env.agent_iter():
    ...     observation, reward, terminated, truncated, info = env.last()
    ...     returns[car] = returns.get(car, 0.0) + reward
    ...     action = None
    ...     if not (terminated or truncated):
    ...         action, memory[car] = driver.predict(observation, memory.get(car))
    ...     env.step(action)
    >>> sorted(returns)
    ['car_0', 'car_1', 'car_2']

    ```

    ## Version history
    - v0: first version.
    """

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> None:
        del options
        self.agents = list(self._begin(seed))
        self.rewards = dict.fromkeys(self.agents, 0.0)
        self._cumulative_rewards = dict.fromkeys(self.agents, 0.0)
        self.terminations = dict.fromkeys(self.agents, False)
        self.truncations = dict.fromkeys(self.agents, False)
        self.infos: dict[str, dict[str, Any]] = {
            agent: self._blank_info(_car_of(agent)) for agent in self.agents
        }
        self._skip_agent_selection = None
        self._select()

    def _select(self) -> None:
        car = self.fleet.next_car()
        if car is None:
            assert not self.agents, "every car is selected once more when its search is over"
            return
        agent = self.agent_selection = f"car_{car}"
        outcome = self.fleet.outcome(car)
        if not outcome.begun:
            return
        self.rewards[agent], self.infos[agent] = outcome.reward, outcome.info
        state = int(self.fleet.cars["state"][car])
        self.truncations[agent] = state == TRUNCATED
        self.terminations[agent] = state not in (SEARCHING, TRUNCATED)

    def step(self, action: Any) -> None:
        if not self.agents:
            raise ResetNeeded("no car searches: call reset()")
        agent = self.agent_selection
        if self.terminations[agent] or self.truncations[agent]:
            self._was_dead_step(action)
            self.fleet.release()
        else:
            self.fleet.act(action)
            self._cumulative_rewards[agent] = 0.0
            self._clear_rewards()
        self._select()
        self._accumulate_rewards()
        if self.render_mode == "human":
            self.render()

    def observe(self, agent: str) -> Observation | None:
        car = _car_of(agent)
        if self.fleet.cars["search"][car] == 0:
            return self._blank_observation(car)
        return self.fleet.observation(car)


class LotParallelEnv(_CarsAsAgents, ParallelEnv[str, Observation, Any]):  # type: ignore[misc]
    """Many cars search one lot for free slots; all cars that have to decide at a tick do so at once (parallel).

    World, actions, observations and rewards are those of `LotEnv`, but every duration and every arrival is rounded up
    to whole ticks after the beginning of the world; the time lost counts as drive time. Where ticks divide all times,
    this form and `LotEnv` give the same searches.

    A step of the environment is a tick. Cars under way, and cars that have not arrived, are in `agents`, too: the
    `action_mask` in their observation is all 0, and their action is ignored. The reward of a car's step is given at the
    tick at which it ends. Of several cars that decide at the same tick, those act first whose steps ended first.

    `agents` are the cars whose search is not over: a car leaves them when it has parked, gave up or balked
    (terminated), and all leave them after `max_cycles` ticks (truncated).

    Args:
        scenario: see `LotEnv`.
        cars: number of cars.
        tick_s: length of a tick, s.
        options: further options of `LotEnv`; `max_cycles` is the number of ticks after which all cars are truncated.

    Examples:
        >>> from parkenv import lot_v0
        >>> env = lot_v0.parallel_env(scenario="mini", cars=5, tick_s=1.0)
        >>> observations, infos = env.reset(seed=0)
        >>> [int(observations[car]["action_mask"].any()) for car in env.agents]
        [1, 0, 0, 0, 0]
    """

    metadata = _CarsAsAgents.metadata | {"is_parallelizable": True}

    def __init__(
        self, scenario: ScenarioSource = "mini", cars: int = 5, tick_s: float = 1.0, **options: Any
    ) -> None:
        require_number("tick_s", tick_s, above=0.0)
        super().__init__(scenario, cars, tick_s=tick_s, **options)
        self.tick_s = float(tick_s)
        self._observations: dict[str, dict[str, Any]] = {}
        self._infos: dict[str, dict[str, Any]] = {}
        self._deciding: set[str] = set()
        self._tick = 0

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Observation], dict[str, dict[str, Any]]]:
        del options
        self.agents = list(self._begin(seed))
        self._observations = {agent: self._blank_observation(_car_of(agent)) for agent in self.agents}
        self._infos = {agent: self._blank_info(_car_of(agent)) for agent in self.agents}
        self._tick = 0
        self._advance({}, {})
        return _copies(self._observations), _copies(self._infos)

    def step(
        self, actions: dict[str, Any]
    ) -> tuple[
        dict[str, Observation], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]
    ]:
        """Carry out the actions of the cars that have to decide, and go on to the next tick.

        Raises:
            ResetNeeded: no car searches.
            InputError: a car that has to decide has no action, or a wrong one; the world has not changed.
        """
        if not self.agents:
            raise ResetNeeded("no car searches: call reset()")
        if not isinstance(actions, Mapping):
            raise InputError(
                f"actions are {actions!r:.60}, want one of each car that has to decide, by its name"
            )
        for agent in self.agents:
            if agent not in self._deciding:
                continue
            if agent not in actions:
                raise InputError(f"actions lack {agent}, want one of each car that has to decide")
            action_number(actions[agent])
        rewards = dict.fromkeys(self.agents, 0.0)
        over = dict.fromkeys(self.agents, False)
        self._act(actions, rewards, over)
        self._tick += 1
        self._advance(rewards, over)
        cut = self._tick >= self.max_cycles
        truncated = {agent: cut and not over[agent] for agent in self.agents}
        results = _copies(self._observations), rewards, over, truncated, _copies(self._infos)
        self.agents = [agent for agent in self.agents if not (over[agent] or truncated[agent])]
        self._observations = {agent: self._observations[agent] for agent in self.agents}
        self._infos = {agent: self._infos[agent] for agent in self.agents}
        if self.render_mode == "human":
            self.render()
        return results

    @property
    def _now(self) -> float:
        return self.fleet.begin + (self._tick + _MARGIN) * self.tick_s

    def _act(self, actions: dict[str, Any], rewards: dict[str, float], over: dict[str, bool]) -> None:
        while (car := self.fleet.next_car(self._now)) is not None:
            agent = f"car_{car}"
            if self.fleet.cars["state"][car] == SEARCHING:
                self.fleet.act(actions[agent])
                mask = np.zeros_like(self._observations[agent]["action_mask"])
                self._observations[agent] = self._observations[agent] | {"action_mask": mask}
            else:
                if not over.get(agent, True):
                    self._report(car, rewards, over)
                self.fleet.release()

    def _advance(self, rewards: dict[str, float], over: dict[str, bool]) -> None:
        self.fleet.next_car(self._now)
        self._deciding = set()
        for car in self.fleet.ready_cars():
            self._report(car, rewards, over)
            if self.fleet.cars["state"][car] == SEARCHING:
                self._deciding.add(f"car_{car}")

    def _report(self, car: int, rewards: dict[str, float], over: dict[str, bool]) -> None:
        agent, outcome = f"car_{car}", self.fleet.outcome(car)
        self._observations[agent] = self.fleet.observation(car)
        if outcome.begun:
            rewards[agent], self._infos[agent] = outcome.reward, outcome.info
            over[agent] = int(self.fleet.cars["state"][car]) not in (SEARCHING, TRUNCATED)


def _copies(of_agents: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Copy observations or infos, some of which are handed out again at later ticks."""
    return {
        agent: {name: value.copy() if isinstance(value, np.ndarray) else value for name, value in own.items()}
        for agent, own in of_agents.items()
    }


raw_env, parallel_env = LotEnv, LotParallelEnv  # the AEC form without wrappers, and the parallel form


def env(**options: Any) -> wrappers.OrderEnforcingWrapper[str, Observation, Any]:
    """Make the AEC form with PettingZoo's checks of actions and of the order of calls; options see `LotEnv`."""
    return wrappers.OrderEnforcingWrapper(wrappers.AssertOutOfBoundsWrapper(raw_env(**options)))
