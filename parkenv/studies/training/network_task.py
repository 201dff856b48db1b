"""Training of `network` by `parkenv train network`."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from parkenv.errors import InputError
from parkenv.studies.spec import TrainingSpec
from parkenv.studies.training.made_lots import made_places, varied
from parkenv.studies.training.network_training import NETWORK, STEPS, Evaluation, NetworkTraining
from parkenv.studies.training.search_task import SearchTask
from parkenv.studies.training.training_task import Row, Status
from parkenv.world.scenario import Scenario
from planners.agent import make_agent
from planners.model_file import algorithm_class
from planners.network.policy import NetworkPolicy

VARIED_SEED = 1
"""Seed of the speeds and costs of the varied places."""
FIXED = {
    "clone": "clones belief in any case",
    "demonstrations": "labels as many decisions of belief as --steps says",
    "k": "observes the same number of slots in every lot",
    "observation": "has one of its own",
    "curriculum": "trains in all places from the beginning",
    "evaluate_every": "is evaluated after each of its stages",
}
"""Settings of other algorithms that `network` does not take, each with the reason."""


class NetworkTask(SearchTask):
    """Training of `network` in made lots, and in the given places if there are any."""

    default_algorithm = NETWORK
    default_scenarios: ClassVar[tuple[str, ...]] = ()

    def __init__(self, spec: TrainingSpec) -> None:
        super().__init__(spec)
        self.steps = spec.steps or STEPS

    @cached_property
    def _made(self) -> list[Scenario]:
        return made_places()

    @property
    def worlds(self) -> list[Scenario]:
        """Scenarios to train in: the given ones and made lots."""
        return [*super().worlds, *self._made] if self.scenarios else self._made

    def check(self) -> None:
        """See `TrainingTask`."""
        for name, reason in FIXED.items():
            if getattr(self.spec, name) is not None:
                raise InputError(f"{name} does not go with network, which {reason}")
        if self.spec.tensorboard:
            raise InputError("tensorboard does not go with network, which keeps no log")
        algorithm_class("ppo")  # raises the error of the missing extra
        for places in self.tests.values():
            for agent in self.compared:
                make_agent(agent.name, places[0], **agent.options)

    def settings(self) -> Row:
        """See `TrainingTask`."""
        return {**super().settings(), "without": list(self.spec.without or ())}

    def training(self, status: Status) -> NetworkTraining:
        """See `TrainingTask`."""
        del status
        worlds = self.worlds
        return NetworkTraining(
            self.algorithm,
            self.steps,
            self.steps,
            (*worlds, *varied(worlds, VARIED_SEED)),
            self.evaluation_seeds,
            tuple(self.held_out),
            self.spec.without or (),
        )

    def times_of(self, model: Path, places: list[Scenario]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """See `SearchTask`."""
        return Evaluation(places, self.test_seeds).times(NetworkPolicy.load(model))
