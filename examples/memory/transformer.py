"""Attention over the last sixteen observations of the search (Vaswani et al. 2017), from the newest one."""

import torch
from frame_stacking import last_frames
from ppo import main
from torch import nn

FRAMES, HEADS = 16, 4


class Transformer(nn.Module):
    """One block: the newest observation attends to all in the window; then a layer, both with a way past them."""

    def __init__(self, n_inputs, size=64):
        super().__init__()
        self.size, self.n_inputs = size, n_inputs
        self.embed = nn.Linear(n_inputs, size)
        self.place = nn.Parameter(0.02 * torch.randn(FRAMES, size))
        self.attention = nn.MultiheadAttention(size, HEADS, batch_first=True)
        self.layer = nn.Sequential(
            nn.LayerNorm(size), nn.Linear(size, size), nn.GELU(), nn.Linear(size, size)
        )

    def begin(self, n):
        """The observations before the first."""
        return torch.zeros(n, FRAMES - 1, self.n_inputs)

    def forward(self, inputs, state, begins):
        """See `ppo`."""
        frames, state = last_frames(inputs, state, begins, FRAMES)
        empty = frames[..., -5:].sum(-1).flatten(0, 1) == 0  # every observation has a possible action
        keys = (self.embed(frames) + self.place).flatten(0, 1)
        newest = keys[:, -1:]
        seen = newest + self.attention(newest, keys, keys, key_padding_mask=empty, need_weights=False)[0]
        return (seen + self.layer(seen)).squeeze(1).unflatten(0, inputs.shape[:2]), state


if __name__ == "__main__":
    main("transformer", Transformer)
