"""How each algorithm is trained: the settings that were found to do well, in one place."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

from parkenv.errors import InputError

REWARD_SCALE = 0.01
"""Returns of some -100 s become about -1."""
MAX_STEPS = 500
"""Decisions after which a search is given up in training: who is not parked by then drives in circles."""


@dataclass(frozen=True)
class Recipe:
    """Settings of one algorithm.

    Args:
        n_envs: searches at once.
        policy: stable-baselines3's word for the kind of network.
        settings: of the algorithm's constructor, by its own names.
        final_learning_rate: share of the learning rate that is left in the end; it falls in a straight line.
    """

    n_envs: int
    policy: str
    settings: Mapping[str, Any]
    final_learning_rate: float = 1.0


_ON_POLICY: dict[str, Any] = {
    "learning_rate": 1e-3,
    "n_steps": 64,
    "batch_size": 2048,
    "n_epochs": 6,
    "gamma": 0.999,
    "gae_lambda": 0.95,
    "ent_coef": 0.01,
    "policy_kwargs": {"net_arch": [128, 128]},
}

RECIPES: dict[str, Recipe] = {
    "ppo": Recipe(256, "MultiInputPolicy", _ON_POLICY, 0.05),
    "maskable-ppo": Recipe(256, "MultiInputPolicy", _ON_POLICY, 0.05),
    "recurrent-ppo": Recipe(
        128,
        "MultiInputLstmPolicy",
        {**_ON_POLICY, "policy_kwargs": {"net_arch": [128], "lstm_hidden_size": 64}},
        0.05,
    ),
    "dqn": Recipe(
        64,
        "MultiInputPolicy",
        {
            "learning_rate": 5e-4,
            "buffer_size": 200_000,
            "learning_starts": 10_000,
            "batch_size": 512,
            "train_freq": 1,
            "gradient_steps": 2,
            # Nearer to 1, driving in circles for ever counts for more than all else there is to learn.
            "gamma": 0.995,
            "target_update_interval": 2_000,
            "exploration_fraction": 0.3,
            "exploration_final_eps": 0.02,
            "policy_kwargs": {"net_arch": [128, 128]},
        },
        0.05,
    ),
}
"""Of each algorithm that learns to search."""


WAY_IN = "way-in"
"""Starts on the planner's way into the slot."""


@dataclass(frozen=True)
class Stage:
    """How hard the tasks of a level are; see `parkenv.driving.parking_task.ParkingTasks`.

    Args:
        starts: way-out or lane; or way-in: where the planner that parks would be by then, on its way from the lane.
        distance: m, least and greatest; of the way that is left for way-in.
        slack: m that are kept clear around the slot.
    """

    starts: str
    distance: tuple[float, float]
    slack: float


CURRICULUM = (
    Stage("way-out", (0.3, 1.5), 0.0),
    Stage("way-out", (1.0, 4.0), 0.0),
    Stage("way-out", (2.0, 8.0), 0.0),
    Stage("way-out", (4.0, 14.0), 0.0),
    Stage(WAY_IN, (2.0, 5.0), 0.0),
    Stage(WAY_IN, (3.0, 7.0), 0.0),
    Stage(WAY_IN, (5.0, 9.0), 0.0),
    Stage(WAY_IN, (6.0, 11.0), 0.0),
    Stage(WAY_IN, (8.0, 14.0), 0.0),
    Stage("lane", (4.0, 14.0), 0.0),
)
"""From a step before the slot to the task itself, that of `parkenv/Drive-v1` as it is.

A random drive out of a parallel slot stays in it, and teaches to put right how one stands there; what lies between the
slot and the lane is learned along the planner's way, from its end backward.
"""


@dataclass(frozen=True, kw_only=True)
class DriveRecipe(Recipe):
    """Settings of one algorithm that learns to drive into slots.

    Args:
        reward: `sparse`, with goals of hindsight; or `dense`.
        reward_scale: rewards are seconds times this.
        contact_cost: s, what a contact costs in training.
        steps: decisions of a training, unless another number is asked for.
        curriculum: levels, from the easiest to the task itself.
    """

    reward: str
    reward_scale: float
    contact_cost: float
    steps: int
    curriculum: tuple[Stage, ...] = CURRICULUM


_OFF_POLICY: dict[str, Any] = {
    "learning_rate": 1e-3,
    "buffer_size": 300_000,
    "learning_starts": 3_000,
    "batch_size": 256,
    "train_freq": 1,
    "gradient_steps": 4,
    "gamma": 0.98,
    "tau": 0.005,
    # From 1, its default, entropy counts for more than parking does, for thousands of updates: who parks gets no more.
    "ent_coef": "auto_0.02",
    "replay_buffer_kwargs": {"n_sampled_goal": 4, "goal_selection_strategy": "future"},
    "policy_kwargs": {"net_arch": [128, 128]},
}
_HINDSIGHT = DriveRecipe(
    16,
    "MultiInputPolicy",
    _OFF_POLICY,
    0.1,
    reward="sparse",
    reward_scale=0.2,
    contact_cost=30.0,
    steps=300_000,
)

# A contact has to cost more than to stand still for ever, which is 0.4 s / (1 - gamma) in sparse rewards, and about
# twice that in dense ones: for much less (60 s), who does not know how to park yet runs into something to have it over.
# For much more (100 s), the narrow way into a parallel slot is learned two or three times as slowly.
DRIVE_RECIPES: dict[str, DriveRecipe] = {
    "ppo": DriveRecipe(
        256,
        "MultiInputPolicy",
        {
            "learning_rate": 1e-3,
            "n_steps": 64,
            "batch_size": 1024,
            "n_epochs": 6,
            "gamma": 0.99,
            "gae_lambda": 0.95,
            # What is tried narrows more slowly than without.
            "ent_coef": 0.004,
            "policy_kwargs": {"net_arch": [128, 128], "log_std_init": -0.5},
        },
        0.1,
        reward="dense",
        reward_scale=0.05,
        contact_cost=75.0,
        steps=10_000_000,
    ),
    "sac": _HINDSIGHT,
    "tqc": _HINDSIGHT,
}
"""Of each algorithm that learns to drive."""

AnyRecipe = TypeVar("AnyRecipe", bound=Recipe)


def recipe_of(algorithm: str, recipes: Mapping[str, AnyRecipe], task: str) -> AnyRecipe:
    """The recipe of an algorithm.

    Args:
        algorithm: its name.
        recipes: those of the task.
        task: search or drive.

    Raises:
        InputError: there is none for it.
    """
    if algorithm not in recipes:
        raise InputError(f"ALGORITHM is {algorithm!r}, want one of {', '.join(recipes)} for {task}")
    return recipes[algorithm]
