"""Training of `network` by `parkenv train network`."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from parkenv.studies.training.made_lots import made_places, varied
from parkenv.studies.training.network_training import Evaluation, NetworkTraining
from parkenv.studies.training.search_task import SearchTask
from parkenv.studies.training.spec import NetworkTrainingSpec
from parkenv.studies.training.training_task import Row, Status
from parkenv.world.scenario import Scenario
from planners.agent import make_agent
from planners.model_file import algorithm_class
from planners.network.policy import NetworkPolicy

VARIED_SEED = 1
"""Seed of the speeds and costs of the varied places."""


class NetworkTask(SearchTask):
    """Training of `network` in made lots, and in the given places if there are any."""

    spec: NetworkTrainingSpec

    @cached_property
    def _made(self) -> list[Scenario]:
        return made_places()

    @property
    def worlds(self) -> list[Scenario]:
        """Scenarios to train in: the given ones and made lots."""
        return [*super().worlds, *self._made] if self.scenarios else self._made

    def check(self) -> None:
        """See `TrainingTask`."""
        algorithm_class("ppo")  # raises the error of the missing extra
        for places in self.tests.values():
            for agent in self.compared:
                make_agent(agent.name, places[0], **agent.options)

    def settings(self) -> Row:
        """See `TrainingTask`."""
        return {**super().settings(), "without": list(self.spec.without)}

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
            self.spec.without,
        )

    def times_of(self, model: Path, places: list[Scenario]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """See `SearchTask`."""
        return Evaluation(places, self.test_seeds).times(NetworkPolicy.load(model))
