"""Trainings that are fast to run: few environments, small networks, short searches."""

import dataclasses

import pytest

from parkenv.studies.training import configs
from parkenv.studies.training.checkpoint import save_checkpoint
from parkenv.studies.training.drive.training import DriveTraining
from parkenv.studies.training.fleet import FleetTraining
from parkenv.studies.training.scenes import ScenesTraining
from parkenv.studies.training.search import SearchTraining
from parkenv.studies.training.spec import (
    DriveTrainingSpec,
    FleetTrainingSpec,
    ScenesTrainingSpec,
    SearchTrainingSpec,
)
from parkenv.studies.training.training import use_one_thread

use_one_thread()  # as in the workers of a study: tests run side by side

NETWORK = {"policy_kwargs": {"net_arch": [16]}}
DRIVE = {
    "ppo": {"n_steps": 32, "batch_size": 256, "n_epochs": 2},
    "sac": {"learning_starts": 800, "batch_size": 32, "gradient_steps": 1},
    "tqc": {"learning_starts": 800, "batch_size": 32, "gradient_steps": 1},
}


def make_small(patch):
    """Make the batches, rollouts and networks of all training configs small, and searches short."""
    for name in configs.SEARCH_CONFIGS:
        replay = {"learning_starts": 200, "buffer_size": 1_000}
        sizes = {"batch_size": 256, **(replay if name == "dqn" else {"n_steps": 32})}
        _change(patch, configs.SEARCH_CONFIGS, name, 16, sizes)
    for name in configs.FLEET_CONFIGS:
        _change(patch, configs.FLEET_CONFIGS, name, 8, {"n_steps": 32, "batch_size": 256})
    for name in configs.DRIVE_CONFIGS:
        _change(patch, configs.DRIVE_CONFIGS, name, 16, DRIVE[name] | NETWORK)
    for name in configs.SCENES_CONFIGS:
        _change(patch, configs.SCENES_CONFIGS, name, 8, {"n_steps": 16, "batch_size": 64} | NETWORK)
    patch.setattr("parkenv.studies.training.scenes.DRAWN", 8)
    patch.setattr(configs, "MIN_UPDATES", 0)
    # An untrained agent drives in circles.
    patch.setattr("parkenv.studies.training.search.MAX_STEPS", 60)


def _change(patch, of, name, n_envs, sizes):
    config = of[name]
    patch.setitem(of, name, dataclasses.replace(config, n_envs=n_envs, settings={**config.settings, **sizes}))


def search_training(algorithm, steps, every, places, held_out=(), episodes=4, **fields):
    """A training in places that are no files."""
    spec = SearchTrainingSpec(
        algorithm=algorithm, steps=steps, evaluate_every=every, evaluation_episodes=episodes, **fields
    )
    training = SearchTraining(spec)
    training.sides = places, held_out
    return training


def fleet_training(fleet, steps=2_048, every=1_024):
    training = FleetTraining(FleetTrainingSpec(steps=steps, evaluate_every=every, evaluation_episodes=2))
    training.fleet = fleet
    return training


def drive_training(algorithm, steps, every, lots, episodes=6):
    spec = DriveTrainingSpec(
        algorithm=algorithm, steps=steps, evaluate_every=every, evaluation_episodes=episodes
    )
    training = DriveTraining(spec)
    training.lots = lots
    return training


def scenes_training(steps, every, levels, episodes=2):
    return ScenesTraining(
        ScenesTrainingSpec(
            steps=steps, evaluate_every=every, levels=levels, evaluation_episodes=episodes, agents=()
        )
    )


def stop_training(training, folder, monkeypatch):
    """Train until right before the third checkpoint: the evaluation before it is not kept."""
    saves = []

    def killed(*arguments):
        if len(saves) == 2:
            raise KeyboardInterrupt
        saves.append(arguments[0])
        save_checkpoint(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr("parkenv.studies.training.learning.save_checkpoint", killed)
        with pytest.raises(KeyboardInterrupt):
            training.train(0, folder)
