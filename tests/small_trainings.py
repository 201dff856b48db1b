"""Trainings that are fast to run: few environments, small networks, short searches."""

import dataclasses

import pytest
import torch
from numba import get_num_threads

from parkenv.studies.training import configs
from parkenv.studies.training.study import TrainingStudy
from parkenv.studies.training.training import Training, save_checkpoint

get_num_threads()  # first: it sets the number that PyTorch has, too
torch.set_num_threads(1)  # tests run side by side


def make_small(patch):
    """Make the batches and rollouts of all training configs small, and searches short."""
    for name, config in list(configs.SEARCH_CONFIGS.items()):
        replay = {"learning_starts": 200, "buffer_size": 1_000}
        sizes = {"batch_size": 256, **(replay if name == "dqn" else {"n_steps": 32})}
        small = dataclasses.replace(config, n_envs=16, settings={**config.settings, **sizes})
        patch.setitem(configs.SEARCH_CONFIGS, name, small)
    patch.setattr(configs, "MIN_UPDATES", 0)
    # An untrained agent drives in circles.
    patch.setattr("parkenv.studies.training.training.MAX_STEPS", 60)


def search_training(algorithm, steps, every, places, held_out=(), episodes=4, **fields):
    """A training in places that are no files."""
    options = {"evaluate_every": every, "evaluation_episodes": episodes, **fields}
    training = Training(TrainingStudy(algorithm=algorithm, steps=steps, **options))
    training.sides = places, held_out
    return training


def stop_training(training, folder, monkeypatch):
    """Train until right before the third checkpoint: the evaluation before it is not kept."""
    saves = []

    def killed(*arguments):
        if len(saves) == 2:
            raise KeyboardInterrupt
        saves.append(arguments[0])
        save_checkpoint(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr("parkenv.studies.training.training.save_checkpoint", killed)
        with pytest.raises(KeyboardInterrupt):
            training.train(0, folder)
