"""Features of a goal-conditioned policy: the goal in the car's frame and the car in the goal's frame."""

from __future__ import annotations

import torch
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

SCALE_M = 8.0  # m, the scale of coarse positions
N_FEATURES = 17


class GoalFeatures(BaseFeaturesExtractor):  # type: ignore[misc]
    """Appends the goal in the car's frame and the car in the goal's frame to the observation.

    Nothing here is learned. The features depend only on the difference between achieved and desired goal, so a policy
    generalises over positions, and hindsight goals look like slots.

    Args:
        observation_space: a `Dict` of observation, achieved_goal and desired_goal.
    """

    def __init__(self, observation_space: spaces.Dict) -> None:
        shape = observation_space["observation"].shape
        assert shape is not None
        super().__init__(observation_space, shape[0] + N_FEATURES)

    def forward(self, observations: dict[str, torch.Tensor]) -> torch.Tensor:
        """Compute the features, (n, n_observation + `N_FEATURES`)."""
        own, goal = observations["achieved_goal"], observations["desired_goal"]
        away, cosine, sine = own[:, :2] - goal[:, :2], own[:, 2:4], goal[:, 2:4]
        ahead, aside = _rotate(away, sine)  # in the goal's frame
        before, beside = _rotate(-away, cosine)  # in the car's
        along, across = _rotate(cosine, sine)  # the car's heading relative to the goal's
        speed, wanted = own[:, 4], goal[:, 4]
        distance = torch.hypot(ahead, aside)
        # Decimetres matter near the goal, metres far from it.
        fine = torch.stack(
            [
                ahead,
                aside,
                3.0 * ahead,
                3.0 * aside,
                6.0 * across,
                2.0 * distance - 1.0,
                10.0 * (speed - wanted),
            ]
        )
        coarse = [value / SCALE_M for value in (ahead, aside, before, beside)]
        pace = [speed / 2.0, wanted / 2.0, (speed - wanted) / 2.0]
        features = torch.stack(
            [*torch.tanh(fine), *coarse, along, across, *pace, torch.log1p(distance)], dim=1
        )
        return torch.cat([observations["observation"], features], dim=1)


def _rotate(points: torch.Tensor, direction: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Rotate points, (n, 2), into frames whose x axes are given, (n, 2) cosines and sines."""
    x, y, c, s = points[:, 0], points[:, 1], direction[:, 0], direction[:, 1]
    return c * x + s * y, c * y - s * x
