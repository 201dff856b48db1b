"""Training of a learned planner on drawn scenes: the score is the fraction of held-out scenes with a path."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray
from stable_baselines3.common.vec_env.base_vec_env import VecEnv

from parkenv.driving.levels import level_scene
from parkenv.driving.scene import Scene
from parkenv.driving.vehicle import VehicleParameters
from parkenv.envs.sb3 import BatchVecEnv
from parkenv.studies.training.configs import SCENES_CONFIGS
from parkenv.studies.training.curve_file import Row
from parkenv.studies.training.drive.training import Outcome, ParkingTraining
from parkenv.studies.training.spec import ScenesTrainingSpec
from parkenv.studies.training.training import Tested
from parkenv.studies.trips.manoeuvre_study import ManoeuvreStudy, level_table
from parkenv.studies.trips.parking_runs import CHUNK
from parkenv.studies.workers import Workers
from planners.driving.learned_moves import (
    CARS,
    MARGINS,
    MOVES,
    OBSERVATION_SIZE,
    LearnedPlanner,
    Rollout,
    Task,
    prepare,
)
from planners.names import PARKING_PLANNER

Observations = dict[str, NDArray[Any]]

TIMES_TRIED = 8
"""Mean number of times that a drawn scene is tried: drawing it takes as long as some tries."""
DRAWN = 512
"""Number of drawn scenes at a time."""
FAILURE_M = 40.0
"""Cost of a path without end, m."""
CLEARANCE_M = 0.05
"""Clearance to obstacles in evaluations, m."""
PER_M = 0.1
"""Reward of a metre less."""


class ScenesEnv(VectorEnv[Observations, NDArray[Any], NDArray[Any]]):
    """A batch of paths out of slots; see `planners.driving.learned_moves`. The reward is minus the cost of the path.

    Every scene has a car of its own between the named ones, and every path a clearance of `MARGINS`.

    Args:
        num_envs: number of paths.
        levels: levels of the scenes.
    """

    metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012 - Gymnasium declares it so

    def __init__(self, num_envs: int, levels: tuple[str, ...]) -> None:
        self.num_envs, self.levels = num_envs, levels
        self.single_action_space = spaces.Discrete(MOVES)
        self.single_observation_space = spaces.Dict(
            {
                "moves": spaces.Box(-np.inf, np.inf, (OBSERVATION_SIZE,), np.float32),
                "action_mask": spaces.Box(0, 1, (MOVES,), np.int8),
            }
        )
        self._rng = np.random.default_rng(0)
        self._begun_with = self._rng.bit_generator.state
        self._tasks: list[Task] = []
        self._paths: list[Rollout] = []

    def get_state(self) -> dict[str, Any]:
        """Return what decided the paths at the last `reset`."""
        return {"rng": self._begun_with}

    def set_state(self, state: dict[str, Any]) -> None:
        """Begin all paths as at the `reset` before `get_state`."""
        self._rng.bit_generator.state = state["rng"]
        self.reset()

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[Observations, dict[str, Any]]:
        """Draw scenes anew, and begin all paths."""
        del options
        if seed is not None:
            self._rng = np.random.default_rng(seed if isinstance(seed, int) else seed[0])
        self._begun_with = self._rng.bit_generator.state
        self._tasks = []
        self._paths = [self._begun() for _ in range(self.num_envs)]
        return self._seen(), {}

    def step(
        self, actions: NDArray[Any]
    ) -> tuple[Observations, NDArray[np.float32], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Make a move in every path."""
        rewards, over = np.zeros(self.num_envs, np.float32), np.zeros(self.num_envs, np.bool_)
        final, found = np.full(self.num_envs, None, dtype=object), over.copy()
        for i, path in enumerate(self._paths):
            rewards[i] = -PER_M * path.move(int(actions[i]))
            found[i] = path.done
            if path.over:
                over[i] = True
                rewards[i] -= PER_M * FAILURE_M * (not path.done)
                final[i] = {"moves": path.seen.copy(), "action_mask": path.mask}
                self._paths[i] = self._begun()
        info = {"final_obs": final, "final_info": {"is_success": found, "_is_success": over}}
        return self._seen(), rewards, over, np.zeros_like(over), info

    def _seen(self) -> Observations:
        masks = [path.mask for path in self._paths]
        return {"moves": np.stack([path.seen for path in self._paths]), "action_mask": np.stack(masks)}

    def _begun(self) -> Rollout:
        """Begin a path that is neither whole nor stuck from the start."""
        while True:
            if len(self._tasks) < DRAWN or self._rng.random() * TIMES_TRIED < 1.0:
                task = prepare(self._drawn())
                if len(self._tasks) < DRAWN:
                    self._tasks.append(task)
                else:
                    self._tasks[self._rng.integers(DRAWN)] = task
            task = self._tasks[self._rng.integers(len(self._tasks))]
            path = Rollout(task, float(self._rng.choice(MARGINS)))
            if not path.over:
                return path

    def _drawn(self) -> Scene:
        """Draw a scene of a level, with a car of its own."""
        rng = self._rng
        car = VehicleParameters(**{name: float(rng.uniform(*ends)) for name, ends in CARS.items()})
        # Seeds far above those of evaluations, tests and comparisons.
        seed = int(rng.integers(1 << 40, 1 << 62))
        return level_scene(self.levels[rng.integers(len(self.levels))], seed, car)


class ScenesTraining(ParkingTraining):
    """Training of a learned planner."""

    spec: ScenesTrainingSpec
    evaluated_by = ("env", "levels", "evaluation_episodes")
    configs = SCENES_CONFIGS
    value = "length_m"

    @cached_property
    def kinds(self) -> tuple[str, ...]:
        """The kinds of slots in the levels."""
        return tuple(dict.fromkeys(map(_kind, self.spec.levels)))

    @property
    def tests(self) -> dict[str, str]:
        """See `Training`: one for each level."""
        return {level: level for level in self.spec.levels}

    def make_env(self) -> BatchVecEnv:
        """Make a batch of paths."""
        return BatchVecEnv(ScenesEnv(self.config.n_envs, self.spec.levels))

    def before_checkpoint(self, model: Any) -> None:
        """Begin all paths anew: a checkpoint then needs no more than the state of the random numbers."""
        model._last_obs = model.env.reset()
        model._last_episode_starts = np.ones(model.n_envs, dtype=np.bool_)

    @cached_property
    def _held_out(self) -> list[tuple[str, Task]]:
        return [
            (level, prepare(level_scene(level, seed)))
            for level in self.spec.levels
            for seed in self.evaluation_seeds
        ]

    def outcomes(self, policy: Any, env: VecEnv) -> dict[str, Outcome]:
        """Plan in the held-out scenes, with the likeliest moves, at one clearance."""
        del env
        paths = [Rollout(task, CLEARANCE_M) for _, task in self._held_out]
        LearnedPlanner(policy).go_on(paths)
        kinds = np.array([_kind(level) for level, _ in self._held_out])
        done = np.array([path.done for path in paths])
        length = np.array([float(np.abs(path.lengths).sum()) for path in paths])
        return {kind: Outcome(done[kinds == kind], length[kinds == kind]) for kind in self.kinds}

    def description(self) -> dict[str, Any]:
        """Return levels and settings for the model file."""
        return {"scenarios": self.spec.levels, "settings": self.settings_of_model()}

    def evaluate_planners(self, workers: Workers) -> dict[str, float]:
        """See `Training`: the success rate in each kind of slot."""
        rows = level_table(
            self._driven(PARKING_PLANNER, self.spec.levels, self.evaluation_seeds, workers),
            _kind,
        )
        return {row["level"]: row["success"] for row in rows}

    def test_planners(self, name: str, workers: Workers) -> list[Row]:
        """See `Training`."""
        rows = level_table(self._driven(PARKING_PLANNER, (name,), self.test_seeds, workers), _level)
        return [row | {"scenario": name} for row in rows]

    def test(self, model: Path, workers: Workers) -> Tested:
        """See `Training`: planned and driven."""
        rows = self._driven(f"{self.algorithm}:{model}", self.spec.levels, self.test_seeds, workers)
        (total,) = level_table(rows, lambda _: "all")
        own = {name: total[name] for name in ("success", "success_ci95", "contacts", "time_s")}
        return Tested(
            "levels", own, [{"test_scenario": row["level"], **row} for row in level_table(rows, _level)]
        )

    def _driven(self, agent: str, levels: Sequence[str], seeds: range, workers: Workers) -> list[Row]:
        """Let an agent plan and drive in scenes."""
        study = ManoeuvreStudy(levels=tuple(levels), agents=(agent,), episodes=len(seeds), seed=seeds.start)
        (cell,) = study.cells()
        parts = [cell.items[i : i + CHUNK] for i in range(0, len(cell.items), CHUNK)]
        rows = workers.in_order([partial(study.run, cell.work, part) for part in parts])
        return [row for some in rows for row in some]

    @property
    def title(self) -> str:
        """See `Training`."""
        return f"{self.evaluation_episodes} held-out scenes of each level"


def _level(case: str) -> str:
    """Return the level of a drawn scene by its name."""
    return case.rpartition("-")[0]


def _kind(level: str) -> str:
    return level.partition("-")[0]
