"""A gated recurrent unit (Cho et al. 2014)."""

import torch
from ppo import main
from torch import nn


class GRU(nn.Module):
    """A recurrent layer whose state is forgotten where a search begins."""

    def __init__(self, n_inputs, size=64):
        super().__init__()
        self.size = size
        self.cell = nn.GRUCell(n_inputs, size)

    def begin(self, n):
        """An empty memory."""
        return torch.zeros(n, self.size)

    def forward(self, inputs, state, begins):
        """See `ppo`."""
        features = []
        for now, fresh in zip(inputs, begins, strict=True):
            state = self.cell(now, state * (1.0 - fresh)[:, None])
            features.append(state)
        return torch.stack(features), state


if __name__ == "__main__":
    main("gru", GRU)
