"""Occupancy probability of each slot from survey sessions (T §3.3.3), by hour of the week (T §6)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, logit
from scipy.stats import beta

from parkenv.compiled.arrays import FloatArray
from parkenv.errors import InputError
from parkenv.world.occupancy.kernel import MAX_PROBABILITY, MIN_PROBABILITY
from parkenv.world.occupancy.process import Arrival, Forecast, PriorModel
from parkenv.world.week import DAY_S, HOUR_S

# Prior weights, in sessions, of the slot's mean and of the lot's mean at the same hour.
SLOT_WEIGHT, LOT_WEIGHT = 4.0, 6.0
# Default decay time of an observation, s: 1/(λ+μ) for a mean stay and a mean vacancy of one hour each.
RELAXATION_S = 1800.0
OTHER_WEEKDAY = 0.85
"""Weight of a session on another day of the same kind (weekday or weekend).

In leave-one-day-out tests on CNRPark-EXT, values from 0.7 to 1 predict equally well and lower ones worse: a Monday
predicts a Tuesday as well as another Tuesday does.
"""
CONFIDENCE = 0.9  # probability of the interval of a prediction
_HOUR_WIDTH = 1.0


@dataclass(frozen=True, eq=False)
class SessionLog:
    time: FloatArray  # (k,) s since Monday 00:00
    occupied: NDArray[np.bool_]  # (k, n_slots) bool
    known: NDArray[np.bool_]  # (k, n_slots) bool, whether the slot was observed

    def __post_init__(self) -> None:
        shapes = self.time.shape, self.occupied.shape, self.known.shape
        if self.occupied.ndim != 2 or shapes[1] != shapes[2] or len(self.time) != len(self.occupied):
            raise InputError("sessions: {} times, {} states and {} views do not go together".format(*shapes))

    @property
    def n_slots(self) -> int:
        return int(self.occupied.shape[1])


@dataclass(frozen=True, eq=False)
class Prediction:
    p_occupied: FloatArray
    low: FloatArray  # and `high`: bounds of the credible interval of P(occupied)
    high: FloatArray
    sessions: NDArray[np.int64]  # number of sessions in which the slot was observed


def counted(log: SessionLog) -> FloatArray:
    """Return the thesis's prediction, (n_slots,): N_occupied / (N_occupied + N_free), or 0.5 (eq. 3.10-3.12)."""
    seen = log.known.sum(axis=0)
    return np.where(seen > 0, (log.occupied & log.known).sum(axis=0) / np.maximum(seen, 1), 0.5)


def predict(log: SessionLog, time: float | None = None) -> Prediction:
    """Predict the occupancy of every slot at a time of the week, or over all sessions.

    Counts back off from specific to general: the slot at this hour of this weekday; the slot at this hour on days of
    the same kind (`OTHER_WEEKDAY`); then, each as a Beta prior worth a few sessions, the slot at all hours shifted by
    the lot's occupancy at this hour, the lot at this hour, the lot. So one session is enough for a first estimate, and
    more sessions refine it.

    The time is in s since Monday 00:00; None: all sessions with equal weight.
    """
    if not len(log.time):
        raise InputError("the map holds no session, want at least one")
    taken, known = (log.occupied & log.known).astype(np.float64), log.known.astype(np.float64)
    lot_mean = (taken.sum() + 1.0) / (known.sum() + 2.0)
    weight = np.ones(len(log.time)) if time is None else _alike(log.time, time)
    at_hour = (weight @ taken.sum(axis=1) + LOT_WEIGHT * lot_mean) / (weight @ known.sum(axis=1) + LOT_WEIGHT)
    slot_mean = (taken.sum(axis=0) + SLOT_WEIGHT * lot_mean) / (known.sum(axis=0) + SLOT_WEIGHT)
    # Over all sessions, the slot's mean already contains its counts: only the lot's prior must be added.
    base = np.full(log.n_slots, lot_mean)
    if time is not None:
        base = expit(logit(slot_mean) + logit(at_hour) - logit(lot_mean))
    a = weight @ taken + SLOT_WEIGHT * base
    b = weight @ known + SLOT_WEIGHT - a
    tail = 0.5 * (1.0 - CONFIDENCE)
    return Prediction(
        a / (a + b),
        np.asarray(beta.ppf(tail, a, b)),
        np.asarray(beta.ppf(1.0 - tail, a, b)),
        known.sum(axis=0).astype(np.int64),
    )


@dataclass(frozen=True, eq=False)
class MapPrior(PriorModel):
    """A map as the `prior` of a `Scenario`.

    Args:
        log: the sessions.
        relaxation_s: s, decay time of observations.
    """

    log: SessionLog
    relaxation_s: float = RELAXATION_S

    @property
    def n_slots(self) -> int:
        """Number of slots."""
        return self.log.n_slots

    def forecast(self, arrival: Arrival) -> Forecast:
        """Return the map's prediction for the arrival."""
        p = np.clip(predict(self.log, arrival.time).p_occupied, MIN_PROBABILITY, MAX_PROBABILITY)
        return Forecast(p, np.full(self.n_slots, 1.0 / self.relaxation_s))


def _alike(then: FloatArray, time: float) -> FloatArray:
    """Return the weights of sessions for a prediction at another time, 0 to 1, by weekday, kind of day and hour."""
    day, today = np.floor(then / DAY_S) % 7, np.floor(time / DAY_S) % 7
    same = np.where(day == today, 1.0, np.where((day >= 5) == (today >= 5), OTHER_WEEKDAY, 0.0))
    apart = np.abs(then % DAY_S - time % DAY_S) / HOUR_S
    apart = np.minimum(apart, 24.0 - apart)
    return np.asarray(same * np.exp(-0.5 * (apart / _HOUR_WIDTH) ** 2))
