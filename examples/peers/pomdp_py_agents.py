"""Planners of pomdp-py, unmodified, as agents: they search a tree of actions and observations on `parkenv.model`.

Any command takes them from here (`pip install "parkenv[pomdp]"`):

    parkenv compare --scenario mini --agents "belief,examples.peers.pomdp_py_agents:POUCT(budget_ms=100)"

`POUCT` keeps the belief of parkenv, `POMCP` particles of its own. From a leaf of the tree a heuristic drives on to the
end of the search, in compiled code: a single action of pomdp-py's rollout.
"""

from __future__ import annotations

import contextlib
import io
import random
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import pomdp_py

from examples.rollout_agent import ModelAgent, ModelSearch
from parkenv.belief.slot_belief import SlotBelief
from parkenv.engine.model import Belief, Model, Observation, Simulations
from parkenv.errors import require_number, require_one_of, require_whole
from parkenv.world.scenario import SearchProblem
from planners.heuristics.policies import POLICIES

DEPTH = 60  # actions of the tree and its rollouts, of which the last one drives to the end of the search
N_PARTICLES = 200  # of POMCP's belief
DRIVE_ON = 5
"""The action of rollouts: drive on as the heuristic does, to the end of the search."""
_BATCH = 32  # worlds that are drawn at once


class Act(pomdp_py.Action):
    """An action, 0 to 4 as in `parkenv/Search-v2`, or `DRIVE_ON`."""

    def __init__(self, number: int) -> None:
        self.number = int(number)

    def __hash__(self) -> int:
        return self.number

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Act) and other.number == self.number


ACTS = tuple(map(Act, range(DRIVE_ON + 1)))


class Seen(pomdp_py.Observation):
    """What a step tells: where the car is, and which slots were observed free or taken."""

    def __init__(self, told: Observation | None = None) -> None:
        self.key = told and (told.vertex, told.slots.tobytes(), told.taken.tobytes())

    def __hash__(self) -> int:
        return hash(self.key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Seen) and other.key == self.key


NOTHING = Seen()
"""What is seen once the search is over."""


class World(pomdp_py.State):
    """A world with a search in it; equal to itself alone, and its own copy.

    Args:
        search: the search.
        kept: whether a step leaves this state as it is, as particles need it, and does not move it on.
        rng: draws another future for what a step leads to; None: keep the one that was drawn with the world.
    """

    def __init__(self, search: Simulations, kept: bool, rng: np.random.Generator | None = None) -> None:
        self.search, self.kept, self.rng = search, kept, rng
        self.over = bool(search.searches.records["over"][0])

    def __hash__(self) -> int:
        return id(self)

    def __eq__(self, other: object) -> bool:
        return self is other

    def __deepcopy__(self, memo: dict[int, Any]) -> World:
        return self

    def moved(self) -> Simulations:
        """Return the search to be moved on."""
        search = self.search.take(np.zeros(1, np.int64)) if self.kept else self.search
        if self.rng is not None:
            search.reseed(self.rng)
        return search


class Drawn(pomdp_py.GenerativeDistribution):
    """Worlds of a belief, drawn as they are asked for."""

    def __init__(self, model: Model, belief: Belief, rng: np.random.Generator) -> None:
        self.model, self.belief, self.rng = model, belief, rng
        self.waiting: list[Simulations] = []

    def random(self) -> World:
        """Draw a world."""
        if not self.waiting:
            drawn = self.model.sample(self.belief, self.rng, _BATCH)
            self.waiting = [drawn.one(i) for i in range(_BATCH)]
        return World(self.waiting.pop(), kept=False)


class Driving(pomdp_py.BlackboxModel):
    """The generative model: next state, observation and reward, minus seconds."""

    def __init__(self, base: str) -> None:
        self.base = POLICIES[base]

    def sample(self, state: World, action: Act) -> tuple[World, Seen, float, int]:
        """Take an action in a world; of how many steps, too: one."""
        if state.over:
            return state, NOTHING, 0.0, 1
        search = state.moved()
        if action.number == DRIVE_ON:
            cost_s = float(search.run(self.base)[0])
        else:
            cost_s = float(search.step(np.array([action.number]))[0][0])
        after = World(search, state.kept)
        after.over |= action.number == DRIVE_ON  # or stopped after very many steps
        return after, NOTHING if after.over else Seen(search.observation()), -cost_s, 1


class Allowed(pomdp_py.RolloutPolicy):
    """The actions that the graph allows; in rollouts, the heuristic."""

    def __init__(self, problem: SearchProblem) -> None:
        self.acts = [tuple(ACTS[a] for a in np.flatnonzero(mask)) for mask in problem.action_masks]

    def get_all_actions(self, state: World, history: object = None) -> tuple[Act, ...]:
        """Return the actions at the place of a car."""
        del history
        return self.acts[int(state.search.searches.records["vertex"][0])]

    def rollout(self, state: World, history: object = None) -> Act:
        """Return what goes on after the tree."""
        del state, history
        return ACTS[DRIVE_ON]


@contextlib.contextmanager
def seeded(rng: np.random.Generator) -> Iterator[None]:
    """Make Python's own generator, with which pomdp-py draws particles, depend on `rng`; then restore its state."""
    state = random.getstate()
    random.seed(int(rng.integers(2**63)))
    try:
        yield
    finally:
        random.setstate(state)


@dataclass
class TreeSearch(ModelSearch):
    """Memory of an episode: that of every planner on the model, pomdp-py's planner, and what it has just seen."""

    planner: Any = None
    agent: Any = None
    seen: Seen | None = None


class POUCT(ModelAgent):
    """POUCT (Silver and Veness 2010): upper confidence bounds in a tree, in worlds drawn from parkenv's belief.

    Args:
        problem: the problem.
        budget_ms: time for a decision, ms.
        simulations: number of simulations for a decision instead, with which the same seed gives the same actions.
        exploration_s: weight of the confidence bound, s: about how much the totals of actions differ.
        base: the heuristic of rollouts, one of `planners.heuristics.policies`.
        seed: of the worlds.
    """

    name: ClassVar[str] = "pouct"
    planner: ClassVar[Any] = pomdp_py.POUCT

    def __init__(
        self,
        problem: SearchProblem,
        budget_ms: float = 100.0,
        simulations: int | None = None,
        exploration_s: float = 10.0,
        base: str = "greedy-total",
        seed: int = 0,
    ) -> None:
        super().__init__(problem, seed)
        require_number("budget_ms", budget_ms, above=0.0)
        require_number("exploration_s", exploration_s, least=0.0)
        require_one_of("base", base, POLICIES)
        if simulations is not None:
            require_whole("simulations", simulations, least=1)
        limit = {"planning_time": budget_ms / 1e3} if simulations is None else {"num_sims": simulations}
        self.options = {"exploration_const": exploration_s, **limit}
        self.allowed, self.driving = Allowed(self.problem), Driving(base)

    def begin(self, observation: Any, belief: SlotBelief) -> TreeSearch:
        """See `ModelAgent`."""
        return TreeSearch(**vars(super().begin(observation, belief)))

    def decide(self, observation: Any, belief: SlotBelief, memory: TreeSearch) -> int:
        """See `ModelAgent`."""
        memory.seen = Seen(Observation.of(observation))
        with seeded(memory.rng):
            return super().decide(observation, belief, memory)

    def choose(self, actions: np.ndarray, memory: TreeSearch) -> int:
        """Go on with the part of the tree below what was seen, and plan."""
        if not self.goes_on(memory):
            memory.planner = self.planner(
                max_depth=DEPTH, discount_factor=1.0, num_visits_init=0, value_init=0.0,
                rollout_policy=self.allowed, **self.options,
            )  # fmt: skip
            memory.agent = pomdp_py.Agent(
                self.first_belief(memory), self.allowed, blackbox_model=self.driving
            )
        try:
            number = memory.planner.plan(memory.agent).number
        except AttributeError:
            if memory.agent.tree is not None:
                raise
            number = DRIVE_ON  # there was no time for a single simulation
        if number == DRIVE_ON or number not in actions:
            number = self.model.sample(memory.belief, memory.rng).choose(self.driving.base)[0]
        return int(number)

    def first_belief(self, memory: TreeSearch) -> Any:
        """Return the belief for a new tree."""
        return Drawn(self.model, memory.belief, memory.rng)

    def goes_on(self, memory: TreeSearch) -> bool:
        """Cut the tree to what is below the last action and what was seen then; return whether anything is left."""
        if memory.agent is None or memory.agent.tree is None or memory.action is None:
            return False
        act = ACTS[memory.action]
        memory.agent.update_history(act, memory.seen)
        node = memory.agent.tree[act]
        if node is None or not self.foreseen(node[memory.seen]):
            return False
        self.cut(memory, act)
        return True

    def foreseen(self, node: Any) -> bool:
        """Return whether a part of the tree is there."""
        return node is not None

    def cut(self, memory: TreeSearch, act: Act) -> None:
        """Go to the part of the tree below an action and what was seen then."""
        memory.planner.update(memory.agent, act, memory.seen)
        memory.agent.set_belief(self.first_belief(memory))


class POMCP(POUCT):
    """POMCP (Silver and Veness 2010): POUCT with the belief of its own particles, those of the tree that agree.

    Where none of them has foreseen what is observed, it starts again with worlds of parkenv's belief.
    """

    name: ClassVar[str] = "pomcp"
    planner: ClassVar[Any] = pomdp_py.POMCP

    def first_belief(self, memory: TreeSearch) -> Any:
        """See `POUCT`."""
        drawn = self.model.sample(memory.belief, memory.rng, N_PARTICLES)
        return pomdp_py.Particles([World(drawn.one(i), kept=True) for i in range(N_PARTICLES)])

    def foreseen(self, node: Any) -> bool:
        """See `POUCT`; the first simulation that comes to a node leaves no particle there."""
        return node is not None and len(node.belief) > 0

    def cut(self, memory: TreeSearch, act: Act) -> None:
        """See `POUCT`."""
        with contextlib.redirect_stdout(io.StringIO()):  # it prints how many particles it adds
            memory.planner.update(
                memory.agent,
                act,
                memory.seen,
                state_transform_func=lambda world: World(world.search, True, memory.rng),
            )
