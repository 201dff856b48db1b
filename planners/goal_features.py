"""What a network makes of goals before it learns: where the car is to go, seen from the goal and from the car."""

from __future__ import annotations

import torch
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

WIDE_M = 8.0
"""m, about which positions are scaled to one."""
N_FEATURES = 17


class GoalFeatures(BaseFeaturesExtractor):  # type: ignore[misc]
    """The observation, and the goal as seen from the car and the car as seen from the goal.

    Nothing here is learned. As only differences between the two goals count, what is learned about one place holds for
    any other, and so does hindsight: a goal of afterthought looks as a slot does.

    Args:
        observation_space: a `Dict` of observation, achieved_goal and desired_goal.
    """

    def __init__(self, observation_space: spaces.Dict) -> None:
        shape = observation_space["observation"].shape
        assert shape is not None
        super().__init__(observation_space, shape[0] + N_FEATURES)

    def forward(self, observations: dict[str, torch.Tensor]) -> torch.Tensor:
        """Features, (n, n_observation + `N_FEATURES`)."""
        own, goal = observations["achieved_goal"], observations["desired_goal"]
        away, cosine, sine = own[:, :2] - goal[:, :2], own[:, 2:4], goal[:, 2:4]
        ahead, aside = _turned(away, sine)  # in the goal's frame
        before, beside = _turned(-away, cosine)  # in the car's
        along, across = _turned(cosine, sine)  # the car's heading against the goal's
        speed, wanted = own[:, 4], goal[:, 4]
        distance = torch.hypot(ahead, aside)
        # Where it is to stop counts by the decimetre, where it is to go by the metre.
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
        coarse = [value / WIDE_M for value in (ahead, aside, before, beside)]
        pace = [speed / 2.0, wanted / 2.0, (speed - wanted) / 2.0]
        features = torch.stack(
            [*torch.tanh(fine), *coarse, along, across, *pace, torch.log1p(distance)], dim=1
        )
        return torch.cat([observations["observation"], features], dim=1)


def _turned(points: torch.Tensor, direction: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Points, (n, 2), in frames whose x axes are directions, (n, 2) cosines and sines."""
    x, y, c, s = points[:, 0], points[:, 1], direction[:, 0], direction[:, 1]
    return c * x + s * y, c * y - s * x
