"""A policy of CleanRL's `ppo.py`, unmodified, as an agent; `examples/other_learners/with_cleanrl.py` trains it.

    parkenv compare --agents "belief,examples.peers.cleanrl:PPO(file=docs/leaderboard/models/cleanrl.safetensors)"

Source: github.com/vwxyzjn/cleanrl, `cleanrl/ppo.py`, and `cleanrl_utils/evals/ppo_eval.py`, in which actions are drawn
from the policy, as in training. It has no action masks: a move without an edge waits.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load

from parkenv.engine.local_observation import NEAR_SLOTS, local_space
from parkenv.errors import InputError
from parkenv.files.limited_reading import read_bytes
from parkenv.world.lot import ACTIONS
from parkenv.world.scenario import SearchProblem
from planners.agent import predict_each

MOST_BYTES = 10_000_000
LAYERS = ("0", "2", "4")  # of the actor, with tanh between them
WIDTHS = (*local_space(NEAR_SLOTS)["local"].shape, 64, 64, len(ACTIONS))


class PPO:
    """Draws actions from the policy in a file, on the observation `local`.

    Args:
        problem: the problem.
        file: weights of the actor, `.safetensors`.
        seed: of the draws; they also depend on the first observation of the search.
    """

    name: ClassVar[str] = "cleanrl-ppo"
    local_k: ClassVar[int] = NEAR_SLOTS

    def __init__(self, problem: SearchProblem, file: str, seed: int = 0) -> None:
        del problem
        self.seed = seed
        try:
            weights = load(read_bytes(Path(file), MOST_BYTES))
            self.layers = [(weights[f"{layer}.weight"].T, weights[f"{layer}.bias"]) for layer in LAYERS]
        except (SafetensorError, KeyError) as error:
            raise InputError(f"{file}: no actor of CleanRL's ppo.py: {error}") from None
        shapes = [part.shape for layer in self.layers for part in layer]
        if shapes != [shape for a, b in pairwise(WIDTHS) for shape in ((a, b), (b,))]:
            raise InputError(f"{file}: its weights and biases are {shapes}, want layers of {WIDTHS}")

    def predict(
        self,
        observation: Mapping[str, Any],
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[Any, Any]:
        """Draw an action, or one for each environment; `state` holds the generators of random numbers."""
        del deterministic
        return predict_each(self._predict_one, observation, "local", 1, state, episode_start)

    def _predict_one(self, observation: Mapping[str, Any], rng: Any) -> tuple[int, np.random.Generator]:
        values = np.asarray(observation["local"], np.float32)
        if rng is None:
            rng = np.random.default_rng([self.seed, *values.view(np.uint32)])
        for weight, bias in self.layers[:-1]:
            values = np.tanh(values @ weight + bias)
        logits = values @ self.layers[-1][0] + self.layers[-1][1]
        return int((logits + rng.gumbel(size=len(logits))).argmax()), rng
