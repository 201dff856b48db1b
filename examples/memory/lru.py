"""A linear recurrent unit (Orvieto et al. 2023): a diagonal, stable, complex linear recurrence between two layers."""

import math

import torch
from ppo import main
from torch import nn


class LRU(nn.Module):
    """State x ← λ x + γ B u, with |λ| < 1; features from its real and imaginary parts and the input."""

    def __init__(self, n_inputs, size=64, n_states=32):
        super().__init__()
        self.size, self.n_states = size, n_states
        radius = torch.rand(n_states) * 0.19 + 0.8  # memories of some steps up to a hundred
        self.log_decay = nn.Parameter(torch.log(-torch.log(radius)))
        self.angle = nn.Parameter(torch.rand(n_states) * math.pi / 10)
        self.enter = nn.Linear(n_inputs, 2 * n_states)
        self.leave = nn.Sequential(nn.Linear(2 * n_states + n_inputs, size), nn.Tanh())

    def begin(self, n):
        """An empty memory."""
        return torch.zeros(n, self.n_states, 2)

    def forward(self, inputs, state, begins):
        """See `ppo`."""
        radius = torch.exp(-torch.exp(self.log_decay))
        decay = torch.polar(radius, self.angle)
        gain = torch.sqrt(1.0 - radius.square())  # keeps the state's size
        entered = torch.view_as_complex(self.enter(inputs).unflatten(-1, (self.n_states, 2))) * gain
        now, states = torch.view_as_complex(state.contiguous()), []
        for new, fresh in zip(entered, begins, strict=True):
            now = decay * now * (1.0 - fresh)[:, None] + new
            states.append(now)
        parts = torch.view_as_real(torch.stack(states)).flatten(2)
        return self.leave(torch.cat([parts, inputs], dim=-1)), torch.view_as_real(now)


if __name__ == "__main__":
    main("lru", LRU)
