"""Fill what a recorded day does not know of slots by the law of its forecast.

A slot is a two-state Markov chain whose P(taken) is the forecast's, and of which an observation loses its value at the
forecast's decay rate. Where the state is unknown it is drawn from this chain, given what is known before and after
(forward filtering, backward sampling, in steps of `STEP_S`). So are, on demand, all states between two looks.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from parkenv.compiled.arrays import BoolArray, FloatArray, IntArray
from parkenv.world.occupancy.log import OccupancyLog
from parkenv.world.week import DAY_PERIODS, DAY_S, HOUR_S, PERIOD_S

STEP_S = 300.0
LOOK_STEP_S = 60.0  # between two looks
_LEAST = 1e-6  # of a chance: none is impossible


class DayStates(NamedTuple):
    """States of n slots on a day: that of slot s from `from_s[k]` on, for k from `first[s]` to `first[s + 1]`."""

    first: IntArray  # (n + 1,)
    from_s: FloatArray  # (k,) float64, s of the day; 0 for the first state of a slot
    occupied: BoolArray  # (k,)


class StateLaw(NamedTuple):
    """The Markov chains of n slots on a day."""

    log_odds: FloatArray  # (n, 48) of P(taken), in the middles of the half-hours
    decay_rate: FloatArray  # (24,) 1/s, by hour


def day_states(log: OccupancyLog, record: IntArray, law: StateLaw, rng: np.random.Generator) -> DayStates:
    """Return the states of slots that replay records of a log.

    A state that was seen at a moment holds for `max_gap_s` before and after, unless another one is nearer in time.

    Args:
        log: the log.
        record: (n,) record of each slot; -1 if it has none.
        law: how states change.
        rng: draws the unknown states.
    """
    n = record.size
    slot, begin, end, taken = _known(log, record)
    grid = np.arange(0.0, DAY_S, STEP_S)
    low, high = (np.ceil(times / STEP_S).astype(np.int64) for times in (begin, end))
    state = np.full((n, grid.size), -1, np.int8)
    at = np.arange((high - low).sum()) + np.repeat(low - np.cumsum(high - low) + high - low, high - low)
    state[np.repeat(slot, high - low), at] = np.repeat(taken, high - low)
    unknown_slot, unknown_at = np.nonzero(state < 0)
    drawn = _drawn(state, law, grid, rng)[unknown_slot, unknown_at]
    slot, from_s = np.append(slot, unknown_slot), np.append(begin, grid[unknown_at])
    taken = np.append(taken, drawn)
    order = np.lexsort((from_s, slot))
    slot, from_s, taken = slot[order], from_s[order], taken[order]
    new = np.append(True, (np.diff(slot) > 0) | (taken[1:] != taken[:-1]))
    slot, from_s, taken = slot[new], np.ascontiguousarray(from_s[new]), np.ascontiguousarray(taken[new])
    return DayStates(np.searchsorted(slot, np.arange(n + 1)), from_s, taken)


def states_between_looks(
    log: OccupancyLog, record: IntArray, law: StateLaw, rng: np.random.Generator
) -> DayStates:
    """As `day_states`, of a log of looks: each holds at its moment alone, and changes come at moments of their own.

    So cars also come and leave between two looks without a trace. Moments are uniform in steps of `LOOK_STEP_S`.
    """
    grid = np.arange(0.0, DAY_S, LOOK_STEP_S)
    slot, k = _observations(log, record)
    state = np.full((record.size, grid.size), -1, np.int8)
    state[slot, np.minimum(np.round(log.second[k] / LOOK_STEP_S).astype(np.int64), grid.size - 1)] = (
        log.occupied[k]
    )
    taken = _drawn(state, law, grid, rng)
    slot, at = np.nonzero(np.diff(taken, axis=1, prepend=~taken[:, :1]))
    from_s = np.where(at > 0, (at - rng.random(at.size)) * LOOK_STEP_S, 0.0)
    return DayStates(np.searchsorted(slot, np.arange(record.size + 1)), from_s, taken[slot, at])


def _observations(log: OccupancyLog, record: IntArray) -> tuple[IntArray, IntArray]:
    """Return the observations of the records, by slot and time: slot, index in the log."""
    first = np.where(record < 0, 0, log.first[record])
    n = np.where(record < 0, 0, log.first[record + 1] - first)
    slot = np.repeat(np.arange(record.size), n)
    return slot, np.arange(slot.size) + np.repeat(first - np.cumsum(n) + n, n)


def _known(log: OccupancyLog, record: IntArray) -> tuple[IntArray, FloatArray, FloatArray, BoolArray]:
    """Return spans of known states, by slot and time: slot, begin and end, s of the day, state."""
    slot, k = _observations(log, record)
    begin, end = log.second[k], log.until[k]
    if not log.continuous and k.size:
        same = np.diff(slot) == 0
        before = np.append(-np.inf, np.where(same, end[:-1], -np.inf))
        after = np.append(np.where(same, begin[1:], np.inf), np.inf)
        held = np.maximum(np.maximum(begin - log.max_gap_s, (begin + before) / 2), 0.0)
        begin, end = (
            np.where(begin > before, held, begin),
            np.where(end < after, np.minimum(np.minimum(end + log.max_gap_s, (end + after) / 2), DAY_S), end),
        )
    return slot, begin, end, log.occupied[k]


def _drawn(state: NDArray[np.int8], law: StateLaw, grid: FloatArray, rng: np.random.Generator) -> BoolArray:
    """Return (n, g) states, the known ones among them (0 or 1; -1: unknown)."""
    period = np.clip(grid / PERIOD_S - 0.5, 0.0, DAY_PERIODS - 1.0)
    low = np.minimum(period.astype(np.int64), DAY_PERIODS - 2)
    begin, end = law.log_odds[:, low], law.log_odds[:, low + 1]
    p = expit(begin + (period - low) * (end - begin))
    left = np.exp(-law.decay_rate[(grid // HOUR_S).astype(np.int64)] * (grid[1] - grid[0]))
    # P(taken one step later), of a slot that is free and of one that is taken.
    if_free, if_taken = (
        np.clip(p[:, 1:] + (now - p[:, :-1]) * left[:-1], _LEAST, 1 - _LEAST) for now in (0.0, 1.0)
    )
    may = np.stack([state != 1, state != 0]).astype(float)  # likelihood of what is known from a step on
    for j in range(grid.size - 2, -1, -1):
        free, taken = may[:, :, j + 1]
        may[0, :, j] *= (1 - if_free[:, j]) * free + if_free[:, j] * taken
        may[1, :, j] *= (1 - if_taken[:, j]) * free + if_taken[:, j] * taken
        may[:, :, j] /= may[:, :, j].sum(axis=0)
    drawn = np.zeros(state.shape, bool)
    chance, uniform = p[:, 0], rng.random(state.shape)
    for j in range(grid.size):
        free, taken = (1 - chance) * may[0, :, j], chance * may[1, :, j]
        drawn[:, j] = uniform[:, j] * (free + taken) < taken
        if j + 1 < grid.size:
            chance = np.where(drawn[:, j], if_taken[:, j], if_free[:, j])
    return drawn
