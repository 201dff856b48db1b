"""Training data of `network`: decisions labelled by `belief`, and pairs of actions played to the end."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from parkenv.belief.slot_belief import SlotBelief
from parkenv.envs.search import SavedSearch, SearchEnv
from parkenv.world.lot import PARK
from parkenv.world.scenario import Scenario
from planners.belief.agent import BeliefAgent, BeliefSearch, snapshot
from planners.belief.best_path import action_values
from planners.network.agent import NetworkAgent, NetworkSearch
from planners.network.features import ACTION_COUNT, FAILURE_COSTS, LEAST_SCALE, WAITING, Features
from planners.network.policy import NetworkPolicy

LONGEST = 200
"""Number of decisions after which a search of the training data ends: longer ones drive in circles in a full lot."""
MOST_VALUE = 6.0  # largest value of a label, in time scales
EXPLORATION = 0.15  # probability of a random action in the searches that the teacher drives


class Place(NamedTuple):
    """A lot with its environment and agents."""

    env: SearchEnv
    student: NetworkAgent
    teacher: BeliefAgent

    @classmethod
    def of(cls, scenario: Scenario, policy: NetworkPolicy) -> Self:
        """Make the environment and the agents of a scenario."""
        return cls(SearchEnv(scenario), NetworkAgent(scenario, policy), BeliefAgent(scenario))


@dataclass(frozen=True, eq=False)
class Decisions:
    """Decisions as the network observes them.

    Attributes:
        actions, tokens, allowed: see `planners.network.features.Features`, with a leading axis of n decisions.
    """

    actions: NDArray[np.float32]
    tokens: NDArray[np.float32]
    allowed: NDArray[np.bool_]

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """Concatenate sets of decisions."""
        names = (one.name for one in fields(cls))
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))

    def __len__(self) -> int:
        return len(self.allowed)


@dataclass(frozen=True, eq=False)
class Labelled(Decisions):
    """Decisions with the teacher's choices and values.

    Attributes:
        choice: (n,) int64, the teacher's action, of the network's six.
        values: (n, 6) float32, the teacher's expected times in time scales of the decision; nan where it has none.
    """

    choice: NDArray[np.int64]
    values: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Pairs(Decisions):
    """Decisions with two actions, each played to the end in the same world.

    Attributes:
        first, second: (n,) int64, the two actions.
        longer: (n,) float32, by how much longer the first search took, in time scales of the decision.
        decisions: (n,) int64, decisions of the searches that it took to play each pair.
    """

    first: NDArray[np.int64]
    second: NDArray[np.int64]
    longer: NDArray[np.float32]
    decisions: NDArray[np.int64]


def label_searches(places: Sequence[Place], decisions: int, seed: int, student_drives: bool) -> Labelled:
    """Run searches, and label each decision by the teacher.

    Args:
        places: lots; each search is in the next one, and after the last in the first again.
        decisions: minimum number of decisions to collect.
        seed: seed of the worlds and of the exploration.
        student_drives: take the student's actions; else the teacher's, and random ones now and then.
    """
    rng = np.random.default_rng(seed)
    rows: list[tuple[Any, ...]] = []
    episode = 0
    while len(rows) < decisions:
        place = places[episode % len(places)]
        observation, _ = place.env.reset(seed=seed + episode)
        episode += 1
        teacher_memory: Any = None
        memory: Any = None
        for _ in range(LONGEST):
            wanted, teacher_memory = place.teacher.predict(observation, teacher_memory)
            chosen, memory = place.student.predict(observation, memory)  # also writes the features
            features = place.student.last_features
            if features is not None:
                label = _label(place, observation, int(wanted), teacher_memory, features)
                if label is not None:
                    rows.append((*(a.copy() for a in features[:3]), *label))
            action = int(chosen) if student_drives else int(wanted)
            if not student_drives and rng.random() < EXPLORATION:
                action = int(rng.choice(np.flatnonzero(observation["action_mask"][:PARK])))
            observation, _, terminated, _, _ = place.env.step(action)
            if terminated:
                break
    return Labelled(*(np.stack(column) for column in zip(*rows, strict=True)))


def _label(
    place: Place, observation: Any, wanted: int, memory: BeliefSearch, features: Features
) -> tuple[int, NDArray[np.float32]] | None:
    """Return the teacher's choice among the network's actions, and its values in time scales."""
    lot, vertex = place.env.scenario.lot, int(observation["vertex"])
    choice = wanted if wanted == PARK or lot.neighbors[vertex, wanted] >= 0 else WAITING
    here = memory.near.index(vertex)
    if not features.allowed[choice] or here < 0 or not np.isfinite(memory.expected_s):
        return None
    moves = np.flatnonzero(features.allowed[:PARK])
    following = np.array([memory.near.index(int(lot.neighbors[vertex, a])) for a in moves])
    known = SlotBelief.of_observation(observation).take(memory.near.slots)
    graph = memory.near.planning_graph(place.env.scenario, place.teacher.failure_s)
    belief = snapshot(here, known, memory)
    values = np.full(ACTION_COUNT, np.nan)
    if (following >= 0).all() and len(moves):
        values[moves] = action_values(here, following, np.array(FAILURE_COSTS), graph, belief, memory.paths)
    values[~np.isfinite(values)] = np.nan
    values[choice] = memory.expected_s
    if features.allowed[PARK] and choice != PARK:
        p_free = float(belief.slots["p_free"][here])
        failed_s = place.env.scenario.failure_s + memory.expected_s
        values[PARK] = p_free * memory.near.cost_s[here] + (1.0 - p_free) * failed_s
    # The choice is at least as good as the others, up to the second that the teacher prefers to be safe.
    values = np.where(np.isnan(values), np.nan, np.maximum(values, values[choice]))
    return choice, np.minimum(values / _time_scale(features), MOST_VALUE).astype(np.float32)


def _time_scale(features: Features) -> float:
    """Return the time scale of a decision, s: the least expected time of the look-ahead."""
    return max(float(features.lookahead_s.min()), LEAST_SCALE)


def play_pairs(places: Sequence[Place], count: int, seed: int, closest: float) -> Pairs:
    """Play the student's two best actions to the end in the same world, at decisions where their scores are close.

    Args:
        places: lots; each search is in the next one, and after the last in the first again.
        count: number of pairs.
        seed: seed of the worlds and of the choice of decisions.
        closest: largest difference of the two scores.
    """
    rng = np.random.default_rng(seed)
    rows: list[tuple[Any, ...]] = []
    episode = 0
    while len(rows) < count:
        place = places[episode % len(places)]
        observation, _ = place.env.reset(seed=seed + episode)
        episode += 1
        memory: Any = None
        branch: _Branch | None = None
        rewards: list[float] = []
        n_close, terminated = 0, False
        while not terminated and len(rewards) < LONGEST:
            chosen, memory = place.student.predict(observation, memory)
            scores, observed = place.student.last_scores, place.student.last_features
            if scores is not None and observed is not None:
                first, second = (int(a) for a in np.argsort(-scores, kind="stable")[:2])
                if scores[first] - scores[second] < closest:
                    n_close += 1
                    # Each close decision is chosen with the same probability.
                    if rng.random() < 1.0 / n_close:
                        features = Features._make(a.copy() for a in observed)
                        saved = place.env.get_state(), observation, _forked(memory)
                        branch = _Branch(len(rewards), *saved, features, first, second)
            observation, reward, terminated, _, _ = place.env.step(int(chosen))
            rewards.append(float(reward))
        if branch is None:
            continue
        first_s = -sum(rewards[branch.step :]) + (0.0 if terminated else place.env.scenario.give_up_s)
        second_s, n_played = _play(place, branch)
        longer = np.float32((first_s - second_s) / _time_scale(branch.features))
        rows.append((*branch.features[:3], branch.first, branch.second, longer, len(rewards) + n_played))
    return Pairs(*(np.stack(column) for column in zip(*rows, strict=True)))


class _Branch(NamedTuple):
    """A decision to return to."""

    step: int
    state: SavedSearch
    observation: Any
    memory: NetworkSearch
    features: Features
    first: int
    second: int


def _forked(memory: NetworkSearch) -> NetworkSearch:
    """Copy what changes in a search; buffers and the lot are shared."""
    shared = (memory.near, memory.paths, memory.graph, memory.scratch, memory.by_cost)
    return copy.deepcopy(memory, {id(one): one for one in shared})


def _play(place: Place, branch: _Branch) -> tuple[float, int]:
    """Take the second action and follow the student to the end of the search; return the time, s, and the decisions."""
    place.env.set_state(branch.state)
    action, memory = branch.second, branch.memory  # type: int, Any
    if action == WAITING:
        action = place.student.wait(int(branch.observation["vertex"]))
    observation, reward, terminated, _, _ = place.env.step(action)
    total = -float(reward)
    for n_played in range(LONGEST):
        if terminated:
            return total, n_played
        chosen, memory = place.student.predict(observation, memory)
        observation, reward, terminated, _, _ = place.env.step(int(chosen))
        total -= float(reward)
    return total + place.env.scenario.give_up_s, LONGEST
