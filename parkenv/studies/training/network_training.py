"""Training of `network`: clone `belief` (its values and its choices), then improve on it by playing pairs of actions.

1. The teacher, `belief`, drives, with a random action now and then, and labels every decision.
2. The network drives, and the teacher labels every decision (DAgger): so it learns what to do where it goes itself.
3. Twice, the network's two best actions are played to the end in the same world, at decisions where their scores are
   about equal, and the network learns which of them took longer. The teacher takes no part in this. Both actions meet
   the same world, so the difference has little noise (common random numbers).
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from gymnasium.wrappers import TimeLimit
from numpy.typing import NDArray

from parkenv.envs.search import SearchEnv
from parkenv.errors import InputError
from parkenv.files.csv_writing import write_csv
from parkenv.scenarios.places import seeds_by_place
from parkenv.studies.simulate import STEP_LIMIT, simulate
from parkenv.studies.statistics import mean_interval
from parkenv.studies.training.curve_file import CURVE, Row, read_curve
from parkenv.studies.training.rl_training import MODEL, TRAINING_SEEDS, AnyTraining
from parkenv.studies.training.search_training import HELD_OUT, METRICS
from parkenv.world.scenario import Scenario
from planners.network.agent import NetworkAgent
from planners.network.policy import NetworkCard, NetworkPolicy, Part

STUDENT_DRIVES = (False, True)  # in the rounds with labels
PAIR_ROUNDS = 2
CLOSEST = 0.05  # time scales, difference of two scores that are about equal
EPOCHS, LEARNING_RATES = 8.0, (2e-3, 1e-3, 5e-4)
PAIRS_WEIGHT = 3.0
WORLDS_APART = 1_000_000  # between the first seeds of the rounds


@dataclass(frozen=True, eq=False)
class NetworkTraining(AnyTraining):
    """Training of `network`; `steps` are the labelled decisions, and there are a quarter as many played pairs.

    Args:
        places: scenarios to train in.
        evaluation_seeds: seeds of the evaluations.
        held_out: further places to evaluate in, never trained on.
        without: parts of the network to leave out.
    """

    places: tuple[Scenario, ...]
    evaluation_seeds: range
    held_out: tuple[Scenario, ...] = ()
    without: tuple[Part, ...] = ()

    @property
    def metrics(self) -> tuple[str, ...]:
        """Mean total time, s, with its 95 % interval, and the share of searches that parked; also held out."""
        return METRICS + (HELD_OUT if self.held_out else ())

    def train(self, seed: int, folder: Path, *, tensorboard: bool = False) -> list[Row]:
        """Train with one seed; a training that has ended is not repeated.

        Raises:
            InputError: a log for TensorBoard is wanted.
        """
        if tensorboard:
            raise InputError("--tensorboard: a training of network keeps no log, want another algorithm")
        folder.mkdir(parents=True, exist_ok=True)
        done = read_curve(folder / CURVE, self.columns)
        if done and (folder / MODEL).exists() and len(done) == 1 + len(STUDENT_DRIVES) + PAIR_ROUNDS:
            return done
        return self._train(seed, folder)

    def _train(self, seed: int, folder: Path) -> list[Row]:
        import torch

        from parkenv.studies.training.network_data import (
            Labelled,
            Pairs,
            Place,
            label_searches,
            play_pairs,
        )
        from parkenv.studies.training.network_fit import Network, fit

        torch.manual_seed(seed)
        begin, curve = time.monotonic(), list[Row]()
        network = Network(NetworkCard(seed=seed, without=self.without))
        order = np.random.default_rng(seed).permutation(len(self.places))
        places = [Place.of(self.places[i], network.policy()) for i in order]
        worlds, decisions = TRAINING_SEEDS * (seed + 1), 0

        sides = (self.places, self.held_out) if self.held_out else (self.places,)
        evaluations = [Evaluation(side, self.evaluation_seeds) for side in sides]

        def evaluate() -> None:
            for place in places:
                place.student.policy = network.policy()
            found: list[float] = []
            for evaluation in evaluations:
                times, parked = evaluation.times(network.policy())
                found += [*mean_interval(times), float(parked.mean())]
            row = {"steps": decisions, **dict(zip(self.metrics, found, strict=True))}
            curve.append({**row, "wall_s": time.monotonic() - begin})

        evaluate()
        parts = list[Labelled]()
        for k, student_drives in enumerate(STUDENT_DRIVES):
            half = max(1, self.steps // len(STUDENT_DRIVES))
            parts.append(label_searches(places, half, worlds + WORLDS_APART * k, student_drives))
            decisions += len(parts[-1])
            fit(
                network,
                Labelled.joined(parts),
                None,
                epochs=EPOCHS,
                learning_rate=LEARNING_RATES[k],
                seed=seed,
            )
            evaluate()
        labelled, played = Labelled.joined(parts), list[Pairs]()
        for k in range(PAIR_ROUNDS):
            seed_of_pairs = worlds + WORLDS_APART * (len(STUDENT_DRIVES) + k)
            played.append(play_pairs(places, max(1, self.steps // 8), seed_of_pairs, CLOSEST))
            decisions += int(played[-1].decisions.sum())
            fit(
                network, labelled, Pairs.joined(played), epochs=EPOCHS, learning_rate=LEARNING_RATES[2],
                seed=seed, pairs_weight=PAIRS_WEIGHT,
            )  # fmt: skip
            evaluate()
        card = network.card.model_copy(
            update={
                "trained_on": tuple(dict.fromkeys(scenario.name for scenario in self.places)),
                "decisions": decisions,
                "settings": {
                    "labelled": self.steps, "pairs": sum(map(len, played)), "closest": CLOSEST,
                    "epochs": EPOCHS, "learning_rates": list(LEARNING_RATES), "pairs_weight": PAIRS_WEIGHT,
                },
                "results": {name: curve[-1][name] for name in self.metrics},
                "command": self.command,
            }
        )  # fmt: skip
        NetworkPolicy(card, network.policy().weights).save(folder / MODEL)
        write_csv(folder / CURVE, list(curve[0]), curve)
        return curve


class Evaluation:
    """Searches in some places, to run a network in again and again.

    Args:
        places: scenarios, of which each seed draws one.
        seeds: one episode each.
    """

    def __init__(self, places: Sequence[Scenario], seeds: Sequence[int]) -> None:
        self._seeds = seeds
        self._places = [
            (TimeLimit(SearchEnv(place), STEP_LIMIT), NetworkAgent(place), its)
            for place, its in zip(places, seeds_by_place(seeds, len(places)), strict=True)
            if its
        ]

    def times(self, policy: NetworkPolicy) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Run the episodes; return their total times, (n,) s, and whether the car parked, (n,) bool.

        A search that has not ended after `STEP_LIMIT` decisions is charged `give_up_s`, as in `parkenv compare`.
        """
        times, parked = dict[int, float](), dict[int, bool]()
        for env, agent, seeds in self._places:
            agent.policy = policy
            for seed in seeds:
                info = simulate(env, agent, seed).info
                times[seed], parked[seed] = float(info["total_s"]), bool(info["parked"])
        found = [times[seed] for seed in self._seeds], [parked[seed] for seed in self._seeds]
        return np.array(found[0]), np.array(found[1])
