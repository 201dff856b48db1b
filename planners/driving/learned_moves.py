"""A learned planner of manoeuvres: a network chooses the moves out of the slot, a Reeds-Shepp curve is their end.

As in hybrid A*, the path begins at the slot and is driven in reverse. As in Jiang, Li, Zhang, Shen, Yin and Wang,
"HOPE: a reinforcement learning-based hybrid policy path planner for diverse parking scenarios" (2024), moves that would
touch something are masked, and the path ends as soon as a Reeds-Shepp curve leads to the other end without a contact.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray
from parkenv.compiled.jit import compiled
from parkenv.driving.scene import Scene
from parkenv.driving.vehicle import VEHICLES, move_along
from parkenv.errors import InputError
from planners.driving.car_path import CarPath
from planners.driving.clearance import Clearance, clearance, room_at
from planners.driving.hybrid_astar import WINDOW_M
from planners.driving.manoeuvre import SEARCH, aim, paths_in_scene
from planners.driving.path_shortening import shorten_path
from planners.driving.policy_interface import BEAMS, Outlines, PolicyInterface, free_distances
from planners.driving.reeds_shepp import Words, distance_between, words_buffer
from planners.driving.reeds_shepp_shots import DriveCosts, cheapest_shot, free_length

INTERFACE = "moves-1"
"""Version of the layout of observation and action; models of another version are refused."""
STEERINGS = np.linspace(-1.0, 1.0, 7)
LONGEST_M, SHORT_M, SHORTEST_M = 1.5, 0.3, 0.01
"""Lengths of a move, m: at most, of a short one at most, and at least."""
WAYS = 2 * len(STEERINGS)
MOVES = 2 * WAYS
"""Number of actions: forward and backward, with every steering; until the car would touch something, or short."""
OBSERVATION_SIZE = 13 + WAYS + BEAMS
MOST_MOVES = 40
"""Greatest number of moves before the curve in training."""
PLANNED_MOVES = 120
"""Likewise of a plan."""
DETOUR_M = 20.0
"""By how much a curve may cost more than the cheapest without obstacles, m."""
MARGINS = (0.1, 0.05, 0.02, 0.01)
"""Clearances to obstacles, m, that are tried in order; less where start or target are closer."""
TRIES, TEMPERATURE = 8, 3.0
"""Paths from either end for each of them, and by how much flatter than learned the drawn moves are distributed."""
FITS = ("length", "width", "wheelbase", "rear_overhang", "max_steering")
"""Parameters of a car that a path depends on."""
CARS = {name: (min(v), max(v)) for name in FITS for v in [[getattr(c, name) for c in VEHICLES.values()]]}
"""Their least and greatest values in training: those of the named cars."""

SHIPPED = Path(__file__).with_name("models") / "moves.safetensors"
"""The model that comes with the package."""

_ROOM_M = 0.01  # that is left at either end


class Task(NamedTuple):
    """A scene, prepared for moves out of its slot."""

    space: Clearance
    slot: FloatArray  # (3,) where the moves begin
    goal: FloatArray  # (3,) where the curve has to end: the scene's start; or the other way round
    outlines: Outlines
    body: FloatArray  # see `PolicyInterface`
    car: FloatArray  # (5,) `FITS`, scaled to about one
    room: float  # m, at the ends
    radius: float  # m
    outward: bool = True  # whether the path leads out of the slot

    def swapped(self) -> Task:
        """Return the same task, begun at the other end."""
        return self._replace(slot=self.goal, goal=self.slot, outward=not self.outward)


def prepare(scene: Scene) -> Task:
    """Prepare a scene."""
    vehicle, around, slot = scene.vehicle, scene.obstacles, aim(scene)
    ends = np.stack([scene.start[:2], slot[:2]])
    low, high = ends.min(axis=0) - WINDOW_M, ends.max(axis=0) + WINDOW_M
    space = clearance(vehicle, around.corners, around.n_corners, low, high)
    room = min(room_at(space, *map(float, pose), MARGINS[0] + _ROOM_M) for pose in (scene.start, slot))
    car = [2.0 * (getattr(vehicle, name) - low) / (high - low) - 1.0 for name, (low, high) in CARS.items()]
    return Task(
        space,
        np.array(slot),
        np.array(scene.start),
        Outlines.of(space.corners, space.n_corners, space.circle),
        PolicyInterface(vehicle).body,
        np.array(car),
        max(room - _ROOM_M, 0.0),
        vehicle.turning_radius * (1.0 + SEARCH.reserve),
    )


class Rollout:
    """Moves out of the slot of a task.

    Args:
        task: the task.
        margin: clearance to obstacles, m.
        most: greatest number of moves.

    Attributes:
        seen: (`OBSERVATION_SIZE`,) float32, what the network observes.
        mask: (`MOVES`,) int8, which moves are possible; none if the car is stuck.
        done: whether the path is whole.
        lengths, curvatures: the moves so far, and the curve, m and 1/m.
        cost: of them, m.
    """

    def __init__(self, task: Task, margin: float, most: int = MOST_MOVES) -> None:
        self.task, self._most = task, most
        self.costs = DriveCosts(task.radius, min(margin, task.room), SEARCH.change_m, SEARCH.steer_m)
        self.seen = np.zeros(OBSERVATION_SIZE, dtype=np.float32)
        self._pose, self._last = task.slot.copy(), np.zeros(2)
        self._free = np.zeros(WAYS)
        self.lengths: list[float] = []
        self.curvatures: list[float] = []
        self.cost = self._look()

    @property
    def over(self) -> bool:
        """Whether the path is whole, too long, or the car is stuck."""
        return self.done or len(self.lengths) >= self._most or not self.mask.any()

    def move(self, action: int) -> float:
        """Make a move; return its cost, m, and that of the curve if there is one."""
        way = action % WAYS
        length, share = float(self._free[way]), float(STEERINGS[way // 2])
        if action >= WAYS:
            length = math.copysign(min(abs(length), SHORT_M), length)
        cost = abs(length) + self.costs.steer_m * abs(share - self._last[1])
        cost += self.costs.change_m * (self._last[0] * length < 0.0)
        self.lengths.append(length)
        self.curvatures.append(share / self.costs.radius)
        self._pose[:] = move_along(*self._pose.tolist(), self.curvatures[-1], length)
        self._last[:] = math.copysign(1.0, length), share
        cost += self._look()
        self.cost += cost
        return float(cost)

    def _look(self) -> float:
        task = self.task
        lengths, curvatures, cost = _look(
            task.space, self._pose, task.goal, self._last, self.costs, task.outlines, task.body, task.car,
            self._free, self.seen,
        )  # fmt: skip
        self.done = len(lengths) > 0
        free = np.abs(self._free)
        self.mask = np.concatenate([free >= SHORTEST_M, free > SHORT_M]).astype(np.int8)
        self.lengths += lengths.tolist()
        self.curvatures += curvatures.tolist()
        return cost if self.done else 0.0


@compiled(error_model="numpy")
def _look(
    space: Clearance,
    pose: FloatArray,
    goal: FloatArray,
    last: FloatArray,
    costs: DriveCosts,
    outlines: Outlines,
    body: FloatArray,
    car: FloatArray,
    free: FloatArray,
    seen: NDArray[np.float32],
) -> tuple[FloatArray, FloatArray, float]:
    """Look for a curve to the goal; fill the observation and how far, m, the car may move in each way if there is none.

    Returns:
        Lengths, m, curvatures, 1/m, and cost, m, of the curve; empty if there is none.
    """
    x, y, yaw = pose
    words = Words(*words_buffer())
    c, s = math.cos(yaw), math.sin(yaw)
    dx, dy, turn = goal[0] - x, goal[1] - y, goal[2] - yaw
    along, across = c * dx + s * dy, c * dy - s * dx
    shortest = distance_between(along, across, turn, costs.radius, costs.change_m, words)
    word, cost = cheapest_shot(space, x, y, yaw, goal, costs, last[0], last[1], shortest + DETOUR_M, words)
    if word >= 0:
        n = words.n_pieces[word]
        return words.piece[word, :n] * costs.radius, words.turn[word, :n] / costs.radius, cost
    for i in range(len(STEERINGS)):
        for back in range(2):
            most = LONGEST_M * (1.0 - 2.0 * back)
            curvature = STEERINGS[i] / costs.radius
            free[2 * i + back] = free_length(space, x, y, yaw, curvature, most, costs.margin)
    seen[:5] = car
    seen[5], seen[6], seen[7], seen[8] = along / 10.0, across / 10.0, math.cos(turn), math.sin(turn)
    seen[9] = shortest / 20.0
    seen[10], seen[11], seen[12] = last[0], last[1], 10.0 * costs.margin
    for i in range(len(free)):
        seen[13 + i] = abs(free[i]) / LONGEST_M
    middle = np.array([x + space.middle * c, y + space.middle * s])
    free_distances(middle, yaw, outlines, body, seen[13 + len(free) :])
    return np.empty(0), np.empty(0), math.inf


class LearnedPlanner:
    """Plans manoeuvres with a network.

    Args:
        policy: a policy of sb3-contrib's MaskablePPO.
        tries: paths that are drawn from either end for each clearance where the likeliest ones fail.
        finish: let hybrid A* plan where the network's paths cannot be driven.
    """

    def __init__(self, policy: Any, tries: int = TRIES, *, finish: bool = False) -> None:
        self._policy, self._tries, self._finish = policy, tries, finish

    @classmethod
    def load(cls, algorithm: str, path: str | os.PathLike[str], *, finish: bool = False) -> LearnedPlanner:
        """Load a model of `parkenv train --env scenes`.

        Raises:
            InputError: the file is no such model.
        """
        from planners.model_file import load_model

        return cls(load_model(algorithm, path, "scenes", INTERFACE)[1], finish=finish)

    def paths(self, scene: Scene) -> Iterator[CarPath]:
        """Yield paths from a scene's start to its target: the cheapest with each clearance, the largest first.

        Raises:
            InputError: the car is not between those of the training.
        """
        for name, (low, high) in CARS.items():
            value = getattr(scene.vehicle, name)
            if not low <= value <= high:
                raise InputError(
                    f"the network is made for vehicles with {name} from {low:g} to {high:g}, this one has {value:g}"
                )
        task = prepare(scene)
        for margin in dict.fromkeys(min(margin, task.room) for margin in MARGINS):
            for tries in (1, self._tries):
                ends = (task, task.swapped()) * tries
                tried = [Rollout(end, margin, PLANNED_MOVES) for end in ends]
                self.go_on(tried, rivals=True)
                best = min(tried, key=lambda path: (not path.done, path.cost))
                if best.done:
                    break
            if best.done:
                way = np.array(best.lengths), np.array(best.curvatures)
                lengths, curvatures = shorten_path(task.space, best.task.slot, *way, best.costs)
                path = CarPath(best.task.slot, lengths, curvatures, 0, margin, scene.vehicle)
                yield path.reversed(scene.start) if best.task.outward else path
        if self._finish:
            yield from paths_in_scene(scene)

    def go_on(self, paths: Sequence[Rollout], *, rivals: bool = False) -> None:
        """Make the likeliest moves in all paths until they are over.

        Of `rivals` the cheapest is wanted: all but the first two make drawn moves, and the dearer ones end early.
        """
        draws, best = np.random.default_rng(0), math.inf
        while True:
            going = [i for i, path in enumerate(paths) if not path.over and path.cost < best]
            if not going:
                break
            likely = self._likely([paths[i] for i in going])
            if rivals:
                noise = draws.gumbel(size=(len(paths), MOVES))
                noise[:2] = 0.0
                likely += TEMPERATURE * noise[going]
            for i, action in zip(going, likely.argmax(axis=1).tolist(), strict=True):
                paths[i].move(action)
                if rivals and paths[i].done:
                    best = min(best, paths[i].cost)

    def _likely(self, paths: Sequence[Rollout]) -> FloatArray:
        """Return the logarithm of the probability of each move, (n, `MOVES`)."""
        import torch

        masks = np.stack([path.mask for path in paths])
        seen = {"moves": np.stack([path.seen for path in paths]), "action_mask": masks}
        with torch.no_grad():
            shown, _ = self._policy.obs_to_tensor(seen)
            made = self._policy.get_distribution(shown, action_masks=masks)
            logits: FloatArray = made.distribution.logits.numpy().astype(np.float64)
        return logits
