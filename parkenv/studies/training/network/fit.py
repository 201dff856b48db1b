"""Fit the weights of `network` in PyTorch: to the teacher's values and choices, then to pairs of played actions."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from parkenv.studies.training.network.data import Labelled, Pairs
from planners.network.features import IS_SLOT, LOOKAHEAD
from planners.network.policy import NetworkCard, NetworkPolicy, feature_masks

BATCH = 256
SHARPNESS = 20.0
"""Inverse temperature of the teacher's choice, per time scale: a twentieth of the time is clearly worse."""


class Network(nn.Module):
    """The network of `planners.network.policy.NetworkPolicy`, for gradients.

    Args:
        card: sizes and parts.
    """

    def __init__(self, card: NetworkCard) -> None:
        super().__init__()
        self.card = card
        self.layers = nn.ParameterDict()
        for name, shape in card.shapes().items():
            weight = torch.zeros(shape)
            # The last layer begins at zero, so the network begins as the look-ahead alone.
            if name.endswith("weight") and not name.startswith("score_2"):
                nn.init.kaiming_uniform_(weight.T, a=5**0.5)
            self.layers[name.replace(".", "_")] = nn.Parameter(weight)
        actions, tokens = feature_masks(card.without)
        self.of_actions, self.of_tokens = torch.tensor(actions), torch.tensor(tokens)

    def _layer(self, name: str, x: Tensor) -> Tensor:
        y: Tensor = x @ self.layers[f"{name}_weight"] + self.layers[f"{name}_bias"]
        return y

    def forward(self, actions: Tensor, tokens: Tensor, allowed: Tensor) -> Tensor:
        """Score the actions, (n, 6); -1e4 for those that there are not."""
        own, tokens = actions * self.of_actions, tokens * self.of_tokens
        h = torch.relu(self._layer("token_1", tokens))
        h = torch.relu(self._layer("token_2", h))
        absent = tokens[..., IS_SLOT, None] == 0.0
        attention = torch.softmax(self._layer("attention", h) - 1e4 * absent, dim=-2)
        x = torch.cat([own, (attention * h).sum(-2), (h * ~absent).amax(-2)], -1)
        x = torch.relu(self._layer("action_1", x))
        x = torch.relu(self._layer("action_2", x))
        there = allowed[..., None]
        x = x * there
        mean = x.sum(-2, keepdim=True) / there.sum(-2, keepdim=True).clamp(min=1)
        most = x.amax(-2, keepdim=True)
        x = torch.cat([x, mean.expand_as(x), most.expand_as(x)], -1)
        score = self._layer("score_2", torch.relu(self._layer("score_1", x)))[..., 0]
        if "lookahead" not in self.card.without:
            score = score - actions[..., LOOKAHEAD]
        return torch.where(allowed, score, torch.full_like(score, -1e4))

    def policy(self) -> NetworkPolicy:
        """Return the weights for NumPy."""
        names = self.card.shapes()
        weights = {name: self.layers[name.replace(".", "_")].detach().numpy().copy() for name in names}
        return NetworkPolicy(self.card, weights)


def fit(
    network: Network,
    labelled: Labelled,
    pairs: Pairs | None,
    *,
    epochs: float,
    learning_rate: float,
    seed: int,
    pairs_weight: float = 1.0,
) -> dict[str, float]:
    """Fit a network in place.

    The loss has three parts: the cross-entropy of the teacher's choice; the Huber loss between differences of scores
    and differences of the teacher's values; and, with pairs, the squared error between differences of scores and
    differences of the times that the two actions took.

    Args:
        network: the network.
        labelled: decisions with the teacher's labels.
        pairs: played pairs.
        epochs: passes over `labelled`.
        learning_rate: learning rate at the beginning; it falls to a twentieth along a cosine.
        seed: seed of the batches.
        pairs_weight: weight of the pairs in the loss.

    Returns:
        Mean losses of the last tenth, by name.
    """
    rng, n = np.random.default_rng(seed), len(labelled)
    steps = max(1, round(epochs * n / BATCH))
    optimizer = torch.optim.Adam(network.parameters(), lr=learning_rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps, 0.05 * learning_rate)
    data = [torch.from_numpy(a) for a in (labelled.actions, labelled.tokens, labelled.allowed)]
    choice, values = torch.from_numpy(labelled.choice), torch.from_numpy(labelled.values)
    played = None if pairs is None else _tensors(pairs)
    last: dict[str, list[float]] = {"choice": [], "value": [], "pairs": []}
    order: NDArray[np.int64] = np.zeros(0, np.int64)
    for step in range(steps):
        if len(order) < BATCH:
            order = np.concatenate([order, rng.permutation(n)])
        batch, order = torch.from_numpy(order[:BATCH]), order[BATCH:]
        scores = network(*(a[batch] for a in data))
        wanted, value = choice[batch], values[batch]
        chosen = nn.functional.cross_entropy(SHARPNESS * scores, wanted)
        # By how much each action is worse than the teacher's.
        worse = (value - value.gather(1, wanted[:, None])).clamp(max=2.0)
        error = scores.gather(1, wanted[:, None]) - scores - worse
        known = torch.isfinite(worse) & data[2][batch]
        differences = nn.functional.huber_loss(
            error[known], torch.zeros(()).expand(int(known.sum())), delta=0.2
        )
        loss = chosen + 10.0 * differences
        parts = {"choice": chosen.item(), "value": differences.item()}
        if played is not None:
            batch = torch.from_numpy(rng.integers(len(played[3]), size=BATCH))
            scores = network(*(a[batch] for a in played[:3]))
            first, second = (scores.gather(1, a[batch, None])[:, 0] for a in played[3:5])
            found = nn.functional.mse_loss(second - first, played[5][batch])
            loss = loss + pairs_weight * found
            parts["pairs"] = found.item()
        optimizer.zero_grad()
        torch.autograd.backward(loss)
        nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        schedule.step()
        if step >= 0.9 * steps:
            for name, part in parts.items():
                last[name].append(part)
    return {name: float(np.mean(its)) for name, its in last.items() if its}


def _tensors(pairs: Pairs) -> list[Tensor]:
    longer = np.clip(pairs.longer, -1.0, 1.0)
    names = (pairs.actions, pairs.tokens, pairs.allowed, pairs.first, pairs.second, longer)
    return [torch.from_numpy(np.ascontiguousarray(a)) for a in names]
