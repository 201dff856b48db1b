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
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from gymnasium.wrappers import TimeLimit

from parkenv.files.csv_tables import write_csv
from parkenv.lots import city_lot, grid_lot
from parkenv.scenarios.build import make_scenario
from parkenv.scenarios.selection import seeds_by_scenario
from parkenv.studies.simulate import STEP_LIMIT, simulate
from parkenv.studies.training.curve_file import CURVE, Row, read_curve
from parkenv.studies.training.network.data import Labelled, Pairs, Place, label_searches, play_pairs
from parkenv.studies.training.network.fit import Network, fit
from parkenv.studies.training.search import SearchTraining, Times
from parkenv.studies.training.spec import NetworkTrainingSpec
from parkenv.studies.training.training import MODEL, TRAINING_SEEDS
from parkenv.world.occupancy.real_week import real_week_occupancy
from parkenv.world.occupancy.real_week_figures import DAY_ERROR
from parkenv.world.scenario import KMH, Scenario
from planners.agent import make_agent
from planners.model_file import algorithm_class
from planners.network.policy import NetworkCard, NetworkPolicy

STUDENT_DRIVES = (False, True)  # in the rounds with labels
PAIR_ROUNDS = 2
CLOSEST = 0.05  # time scales, difference of two scores that are about equal
EPOCHS, LEARNING_RATES = 8.0, (2e-3, 1e-3, 5e-4)
PAIRS_WEIGHT = 3.0
WORLDS_APART = 1_000_000  # between the first seeds of the rounds
VARIED_SEED = 1
"""Seed of the speeds and costs of the varied places."""
GRIDS = ((2, 8), (2, 20), (4, 10), (4, 25), (6, 15), (8, 12), (8, 30), (12, 20))
"""Rows of slots, and slots in a row."""
CITIES = (40, 80, 120, 160, 240, 320, 400, 500)
"""Slots along the streets of a made town."""
FULLER_THAN = (0.5, 0.7, 0.9, 0.95)
"""Shares of real car parks that are less full than the made ones, in turn."""


class NetworkTraining(SearchTraining):
    """Training of `network` in made lots, and in the given places if there are any.

    `steps` are the labelled decisions, and there are a quarter as many played pairs. Every place is trained in twice:
    as it is, and with other speeds and costs.
    """

    spec: NetworkTrainingSpec  # type: ignore[assignment]  # it is evaluated as a search agent, and learns otherwise

    @cached_property
    def sides(self) -> tuple[Sequence[Scenario], Sequence[Scenario]]:
        """See `SearchTraining`: the given places, and made ones to train in."""
        learned, held_out = super().sides if self.scenarios else ([], [])
        return [*learned, *made_places()], held_out

    @cached_property
    def places(self) -> Sequence[Scenario]:
        """Scenarios to train in, also with other speeds and costs."""
        learned = self.sides[0]
        return [*learned, *varied(learned, VARIED_SEED)]

    def check(self) -> None:
        """See `Training`."""
        algorithm_class("ppo")  # raises the error of the missing extra
        for places in self.tests.values():
            for agent in self.compared:
                make_agent(agent.name, places[0], **agent.options)

    def times_of(self, model: Path, places: Sequence[Scenario]) -> Times:
        """See `SearchTraining`."""
        policy = NetworkPolicy.load(model)
        return student_times([Place.of(place, policy) for place in places], policy, self.test_seeds)

    def train(self, seed: int, folder: Path) -> list[Row]:
        """Train with one seed; a training that has ended is not repeated."""
        folder.mkdir(parents=True, exist_ok=True)
        done = read_curve(folder / CURVE, self.columns)
        if done and (folder / MODEL).exists() and len(done) == 1 + len(STUDENT_DRIVES) + PAIR_ROUNDS:
            return done
        torch.manual_seed(seed)
        begin, curve = time.monotonic(), list[Row]()
        network = Network(NetworkCard(seed=seed, without=self.spec.without))
        sides = [
            [Place.of(scenario, network.policy()) for scenario in side]
            for side in (self.places, self.sides[1])
            if side
        ]
        places = [sides[0][i] for i in np.random.default_rng(seed).permutation(len(self.places))]
        worlds, decisions = TRAINING_SEEDS * (seed + 1), 0

        def evaluate() -> None:
            policy = network.policy()
            found = [student_times(side, policy, self.evaluation_seeds) for side in sides]
            row = {"steps": decisions, **self.metrics_of(found)}
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


def student_times(places: Sequence[Place], policy: NetworkPolicy, seeds: Sequence[int]) -> Times:
    """Let the students of some places search with a policy, which they keep; each seed draws the place of an episode.

    A search that has not ended after `STEP_LIMIT` decisions is charged `give_up_s`, as in `parkenv compare`.
    """
    infos = dict[int, Row]()
    for place, its in zip(places, seeds_by_scenario(seeds, len(places)), strict=True):
        place.student.policy = policy
        env = TimeLimit(place.env, STEP_LIMIT)
        infos |= {seed: simulate(env, place.student, seed).info for seed in its}
    times = np.array([infos[seed]["total_s"] for seed in seeds], np.float64)
    return times, np.array([infos[seed]["parked"] for seed in seeds], np.bool_)


def made_places() -> list[Scenario]:
    """Return scenarios on made lots with real weeks: car parks with rows of bays, and towns with cars along streets."""
    lots = [grid_lot(rows, columns) for rows, columns in GRIDS]
    lots += [city_lot(slots, seed=number) for number, slots in enumerate(CITIES)]
    names = [f"grid {rows} x {columns}" for rows, columns in GRIDS] + [f"town {slots}" for slots in CITIES]
    made = []
    for number, (lot, name) in enumerate(zip(lots, names, strict=True)):
        occupancy = real_week_occupancy(lot, fuller_than=FULLER_THAN[number % len(FULLER_THAN)])
        made.append(make_scenario(lot, name=name, occupancy=occupancy, day_error=DAY_ERROR))
    return made


def varied(scenarios: Sequence[Scenario], seed: int) -> list[Scenario]:
    """Return the scenarios with other speeds and costs, drawn within a factor of two of the usual ones.

    Args:
        scenarios: the scenarios.
        seed: seed of the draws.
    """
    rng = np.random.default_rng(seed)
    made = []
    for scenario in scenarios:
        drive, walk, failure = 2.0 ** rng.uniform(-0.5, 0.8, 3)
        changes = {"v_drive": 10.0 * KMH * drive, "v_walk": 4.0 * KMH * walk, "failure_s": 10.0 * failure}
        made.append(scenario.replace(**changes))
    return made
