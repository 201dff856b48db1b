"""Rendered frames of an episode."""

from __future__ import annotations

from typing import Any

import gymnasium as gym

from parkenv.studies.simulate import Observer, Step


class FrameRecorder(Observer):
    """Renders the start of an episode, every n-th step and the last one.

    Args:
        every: steps between frames.

    Attributes:
        frames: the frames of all episodes so far, from an environment with `render_mode="rgb_array"`.
    """

    def __init__(self, every: int = 1) -> None:
        self._every = every
        self.frames: list[Any] = []

    def on_reset(self, env: gym.Env[Any, Any], observation: Any) -> None:
        """Render the start."""
        del observation
        self._env, self._steps = env, 0
        self.frames.append(env.render())

    def on_step(self, step: Step) -> None:
        """Render the step, if it is its turn or the last one."""
        self._steps += 1
        if step.terminated or step.truncated or self._steps % self._every == 0:
            self.frames.append(self._env.render())
