"""What the car holds to be true of each slot: a prior, and what it saw, growing old."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from parkenv.errors import InputError
from parkenv.occupancy import Forecast

FloatArray = NDArray[np.float64]


class SightRates(NamedTuple):
    """How well each of k slots is seen.

    Attributes:
        seen: (k,) float64, P(a slot in view is made out at all).
        hit: (k,) float64, P(looks taken | taken, seen).
        false_alarm: (k,) float64, P(looks taken | free, seen).
    """

    seen: FloatArray
    hit: FloatArray
    false_alarm: FloatArray

    def of(self, rows: slice) -> SightRates:
        """The rates of some of the slots."""
        return SightRates(self.seen[rows], self.hit[rows], self.false_alarm[rows])


@dataclass(frozen=True)
class SightBand:
    """How well slots are seen that lie at some distance, on one side.

    Args:
        up_to: m, distance from the car to the slot's vertex; the nearest band that reaches holds.
        beside: whether these are the slots on the right of a car that stands on its lane, where the thesis's camera
            looks.
        seen_rate: P(a slot in view is made out at all).
        hit_rate: P(looks taken | taken).
        false_alarm_rate: P(looks taken | free).

    Raises:
        InputError: a rate outside [0, 1], a negative distance, or looks that say nothing (equal rates).
    """

    up_to: float
    beside: bool
    seen_rate: float
    hit_rate: float
    false_alarm_rate: float

    def __post_init__(self) -> None:
        if not (self.up_to >= 0.0 and math.isfinite(self.up_to)):
            raise InputError(f"up_to is {self.up_to} m, want a finite distance of at least 0")
        _require_rates(self.hit_rate, self.false_alarm_rate)
        if not 0.0 <= self.seen_rate <= 1.0:
            raise InputError(f"seen_rate is {self.seen_rate}, want a probability")


@dataclass(frozen=True)
class SightingModel:
    """How well a slot is seen from the lane.

    Args:
        view_range: m; a slot is in view while the car is within this distance of the slot's vertex. The
            default shows the slot that the car stands at, its neighbours and those across the aisle.
        hit_rate: P(looks taken | taken).
        false_alarm_rate: P(looks taken | free).
        bands: rates by distance and side, which go before these two where a band reaches.

    Raises:
        InputError: a rate outside [0, 1], a negative range, or looks that say nothing (equal rates).
    """

    view_range: float = 6.0
    hit_rate: float = 1.0
    false_alarm_rate: float = 0.0
    bands: tuple[SightBand, ...] = ()

    def __post_init__(self) -> None:
        if not (self.view_range >= 0.0 and math.isfinite(self.view_range)):
            raise InputError(f"view_range is {self.view_range} m, want a finite distance of at least 0")
        _require_rates(self.hit_rate, self.false_alarm_rate)

    @property
    def perfect(self) -> bool:
        """Whether every look shows the truth."""
        return not self.bands and self.hit_rate == 1.0 and self.false_alarm_rate == 0.0

    def rates(self, distance: FloatArray, beside: NDArray[np.bool_]) -> SightRates:
        """The rates of slots at given distances, (k,) m, beside the car or not, (k,) bool."""
        k = len(distance)
        rates = SightRates(np.ones(k), np.full(k, self.hit_rate), np.full(k, self.false_alarm_rate))
        for band in sorted(self.bands, key=lambda band: -band.up_to):
            reached = (distance <= band.up_to) & (beside == band.beside)
            rates.seen[reached] = band.seen_rate
            rates.hit[reached] = band.hit_rate
            rates.false_alarm[reached] = band.false_alarm_rate
        return rates


def _require_rates(hit_rate: float, false_alarm_rate: float) -> None:
    for name, rate in (("hit_rate", hit_rate), ("false_alarm_rate", false_alarm_rate)):
        if not 0.0 <= rate <= 1.0:
            raise InputError(f"{name} is {rate}, want a probability")
    if hit_rate <= false_alarm_rate:
        raise InputError(
            f"hit_rate {hit_rate} is not above false_alarm_rate {false_alarm_rate}: looks would say nothing"
        )


class SlotBelief:
    """Probability that each slot is taken, from a forecast and the sightings of one search.

    A slot that was never seen keeps its forecast. After a sighting the probability is Bayes's, and from
    then on it relaxes to the forecast as a two-state chain does: p(t) = p∞ + (p_seen - p∞)·exp(-(λ+μ)t).
    So one reads off it what is known: a slot below its forecast was last seen free, above it taken.

    Args:
        forecast: prior and relaxation rate of each slot.
        time: s, when the search starts.

    Attributes:
        p_occupied: (n_slots,) float64, as of `time`.
        time: s, of the last update.
        seen: (n_slots,) bool, seen in this search.
        n_known_taken: how many slots were seen and looked taken at the last look.
    """

    def __init__(self, forecast: Forecast, time: float) -> None:
        self.prior = forecast.p_occupied
        self.rate = forecast.relaxation_rate
        self.p_occupied = forecast.p_occupied.copy()
        self.time = time
        self.seen = np.zeros(len(self.prior), dtype=np.bool_)
        self._looked_taken = np.zeros(len(self.prior), dtype=np.bool_)
        self.n_known_taken = 0

    @property
    def proven_full(self) -> bool:
        """Whether every slot has been seen in this search and looked taken at its last look."""
        return self.n_known_taken == len(self.prior)

    def relax(self, time: float) -> None:
        """Let what was seen grow old until `time`, s."""
        if time > self.time:
            _relax(self.p_occupied, self.prior, self.rate, self.seen, time - self.time)
            self.time = time

    def update(
        self,
        slots: NDArray[np.int64],
        looks_taken: NDArray[np.bool_],
        hit_rate: FloatArray,
        false_alarm_rate: FloatArray,
    ) -> None:
        """Take in one look at each of `slots`, (k,), made at `self.time`; Bayes's rule.

        Args:
            slots: (k,) int64.
            looks_taken: (k,) bool.
            hit_rate: (k,) float64, P(looks taken | taken).
            false_alarm_rate: (k,) float64, P(looks taken | free).
        """
        self.n_known_taken += _update(
            self.p_occupied,
            self.seen,
            self._looked_taken,
            slots,
            looks_taken,
            hit_rate,
            false_alarm_rate,
        )


@njit(cache=True)
def _relax(
    p: FloatArray, prior: FloatArray, rate: FloatArray, seen: NDArray[np.bool_], elapsed: float
) -> None:
    for s in range(len(p)):
        if seen[s]:
            p[s] = prior[s] + (p[s] - prior[s]) * math.exp(-rate[s] * elapsed)


@njit(cache=True)
def _update(
    p: FloatArray,
    seen: NDArray[np.bool_],
    looked_taken: NDArray[np.bool_],
    slots: NDArray[np.int64],
    looks: NDArray[np.bool_],
    hit: FloatArray,
    false_alarm: FloatArray,
) -> int:
    more_taken = 0
    for i in range(len(slots)):
        s = slots[i]
        if_taken = hit[i] if looks[i] else 1.0 - hit[i]
        if_free = false_alarm[i] if looks[i] else 1.0 - false_alarm[i]
        evidence = if_taken * p[s] + if_free * (1.0 - p[s])
        # A look that the belief held to be impossible: believe the look, as a perfect sensor's.
        p[s] = if_taken * p[s] / evidence if evidence > 0.0 else (1.0 if looks[i] else 0.0)
        seen[s] = True
        more_taken += int(looks[i]) - int(looked_taken[s])
        looked_taken[s] = looks[i]
    return more_taken
