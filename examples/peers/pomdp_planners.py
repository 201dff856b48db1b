"""POMCP of POMDPPlanners, unmodified, on `parkenv.model`: a process for `examples/peers/in_another_environment.py`.

    CLASHES/bin/pip install POMDPPlanners==0.2.0 "setuptools<80" && CLASHES/bin/pip install parkenv
    CLASHES/bin/python examples/peers/pomdp_planners.py --simulations 50

Source: github.com/yaacovpariente/POMDPPlanners. Its planner searches a tree of actions and observations (Silver and
Veness 2010). A further action drives on to the end of the search as a heuristic does, as in
`examples/peers/pomdp_py_agents.py`; else its rollouts, which are random, would not end.
"""

from __future__ import annotations

import argparse
import json
import random
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from POMDPPlanners.core.belief import WeightedParticleBelief
from POMDPPlanners.core.environment import DiscreteActionsEnvironment, SpaceInfo, SpaceType
from POMDPPlanners.planners.mcts_planners.pomcp import POMCP

import parkenv
from parkenv.lots import load_lot
from parkenv.world.scenario import SearchProblem
from parkenv.world.sensor_model import SensorModel
from planners.heuristics.policies import POLICIES

DRIVE_ON = 5  # the action that ends a search as the heuristic does
BASE = POLICIES["greedy-total"]
PARTICLES = 100


class Parking(DiscreteActionsEnvironment):
    """A search as the library's environment: its states are simulated searches, `parkenv.engine.model.Simulations`."""

    def __init__(self, rng: np.random.Generator) -> None:
        discrete = SpaceInfo(SpaceType.DISCRETE, SpaceType.DISCRETE)
        super().__init__(discount_factor=1.0, name="parking", space_info=discrete)
        self._rng = rng

    def get_actions(self) -> list[int]:
        """Return all actions; a move without an edge waits."""
        return list(range(DRIVE_ON + 1))

    def is_terminal(self, state: Any) -> bool:
        """Return whether the car has parked or given up."""
        return state is None or bool(state.over[0])

    def sample_next_step(self, state: Any, action: int) -> tuple[Any, Any, float]:
        """Return next state, observation and reward, minus seconds."""
        after = state.take(np.zeros(1, np.int64))
        after.reseed(self._rng)
        if action == DRIVE_ON:
            return None, None, -float(after.run(BASE)[0])
        (cost_s,), (over,) = after.step(np.array([action]))
        seen = after.observation()
        return (
            after,
            None if over else (seen.vertex, seen.slots.tobytes(), seen.taken.tobytes()),
            -float(cost_s),
        )

    def is_equal_observation(self, observation1: Any, observation2: Any) -> bool:
        """Compare what was seen."""
        return bool(observation1 == observation2)

    def _unused(self, *args: Any, **options: Any) -> Any:
        raise NotImplementedError("POMCP draws steps and initial states as a whole")

    state_transition_model = observation_model = reward = initial_state_dist = initial_observation_dist = (
        _unused
    )


def problem_of(told: dict[str, Any]) -> SearchProblem:
    """Return the problem; its graph has the same numbers on both sides of the pipe."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "lot.geojson"
        file.write_text(json.dumps(told["lot"]), encoding="utf-8")
        problem = SearchProblem(
            lot=load_lot(file), sensor_model=SensorModel(**told["sensor"]), **told["fields"]
        )
    if problem.lot.neighbors.tolist() != told["graph"]["neighbors"]:
        raise SystemExit("the lot has another drive graph here: want the same parkenv on both sides")
    return problem


def main() -> None:
    """Answer line by line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--simulations", type=int, default=50, help="for a decision")
    parser.add_argument("--exploration-s", type=float, default=10.0, help="weight of the confidence bound")
    options = parser.parse_args()
    answers, sys.stdout = sys.stdout, sys.stderr  # what libraries print is no answer
    model = planner = rng = None
    for line in sys.stdin:
        message = json.loads(line)
        if "problem" in message:
            rng, model = np.random.default_rng(message["seed"]), parkenv.model(problem_of(message["problem"]))
            random.seed(message["seed"])
            np.random.seed(message["seed"])  # noqa: NPY002 - the library draws with both
            planner = POMCP(
                Parking(rng), discount_factor=1.0, depth=30, exploration_constant=options.exploration_s, name="pomcp",
                n_simulations=options.simulations,
            )  # fmt: skip
            answer: dict[str, Any] = {"ready": True}
        else:
            seen = {name: np.array(values, np.float32) for name, values in message["observation"].items()}
            seen["vertex"] = seen["vertex"].astype(np.int64)
            worlds = model.sample(model.initial_belief(seen), rng, PARTICLES)
            particles = [worlds.one(i) for i in range(PARTICLES)]
            belief = WeightedParticleBelief(particles, np.full(PARTICLES, -np.log(PARTICLES)))
            action = int(planner.action(belief)[0][0])
            if action == DRIVE_ON or not message["observation"]["action_mask"][action]:
                action = int(worlds.choose(BASE)[0])
            answer = {"action": action}
        answers.write(json.dumps(answer) + "\n")
        answers.flush()


if __name__ == "__main__":
    main()
