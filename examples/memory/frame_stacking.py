"""Frame stacking: the last eight observations of the search side by side."""

import torch
from ppo import main
from torch import nn

FRAMES = 8


def last_frames(inputs, state, begins, frames):
    """Return the last frames at each step, (T, n, frames, d), zero before the search began, and the new state."""
    seen = torch.cat([state.transpose(0, 1), inputs]).unfold(0, frames, 1).movedim(-1, 2)
    steps = torch.arange(len(inputs))[:, None]
    begun = torch.where(begins == 1, steps, -frames).cummax(0).values  # step at which the search began
    visible = steps[..., None] - torch.arange(frames - 1, -1, -1) >= begun[..., None]
    stacked = seen * visible[..., None]
    return stacked, stacked[-1, :, 1:]


class FrameStack(nn.Module):
    """The newest observations, side by side, in a layer."""

    def __init__(self, n_inputs, size=64):
        super().__init__()
        self.size, self.n_inputs = size, n_inputs
        self.layers = nn.Sequential(nn.Linear(FRAMES * n_inputs, size), nn.Tanh())

    def begin(self, n):
        """The frames before the first."""
        return torch.zeros(n, FRAMES - 1, self.n_inputs)

    def forward(self, inputs, state, begins):
        """See `ppo`."""
        stacked, state = last_frames(inputs, state, begins, FRAMES)
        return self.layers(stacked.flatten(2)), state


if __name__ == "__main__":
    main("frame-stacking", FrameStack)
