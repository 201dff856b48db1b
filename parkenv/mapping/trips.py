"""What a car observed on a search, as it goes into the map."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray
from parkenv.errors import InputError
from parkenv.world.occupancy.decay import decay_factor
from parkenv.world.occupancy.process import Forecast


@dataclass(frozen=True, eq=False)
class Trip:
    """The observations of one search, k in all, in the order in which they were made.

    Attributes:
        key: unique name; a resumed run skips trips already stored.
        time: start of the search, s since Monday 00:00 of the map's first week; it counts on over the weeks.
        date: ISO date of the day; empty if it has none.
        slots: (k,) int64.
        after_s: (k,) float64, time of the observation, s since the start, ascending.
        taken: (k,) bool, observed states.
        hit_rate: (k,) float64, P(observed taken | taken); 1 for a parking attempt.
        false_alarm_rate: (k,) float64, P(observed taken | free); 0 for a parking attempt.
    """

    key: str
    time: float
    date: str
    slots: NDArray[np.int64]
    after_s: FloatArray
    taken: NDArray[np.bool_]
    hit_rate: FloatArray
    false_alarm_rate: FloatArray

    def __post_init__(self) -> None:
        rates = np.concatenate([self.hit_rate, self.false_alarm_rate])
        wrong = {
            "key": not self.key,
            "time": not math.isfinite(self.time),
            "slots": (self.slots < 0).any(),
            "after_s": not np.isfinite(self.after_s).all()
            or (np.diff(self.after_s, prepend=0.0) < 0.0).any(),
            "rates": not ((rates >= 0.0) & (rates <= 1.0)).all(),
        }
        for name, bad in wrong.items():
            if bad:
                raise InputError(
                    f"{name} of trip {self.key!r:.40}: want a key, finite ascending times, slots of at least 0 and "
                    "rates from 0 to 1"
                )


@dataclass(frozen=True, eq=False)
class SlotStates:
    slots: NDArray[np.int64]  # (k,) in the order of their first observations
    time: FloatArray  # (k,) of the first observation, on the clock of `Trip.time`
    likelihood: FloatArray  # (k, 2) of all observations, if the slot was free then, and if it was taken


def state_likelihoods(trip: Trip, forecast: Forecast) -> SlotStates:
    """Return what a trip says about each observed slot's state when it was first observed.

    A slot changes between its observations as a two-state Markov chain with the forecast's decay rate. Slots with
    contradictory observations are left out.
    """
    slots, first = np.unique(trip.slots, return_index=True)
    slots, first = slots[np.argsort(first)], np.sort(first)
    likelihood = np.ones((forecast.p_occupied.size, 2))
    later_s = np.full(forecast.p_occupied.size, np.nan)
    # Backward from the last observation to the first.
    for i in range(len(trip.slots) - 1, -1, -1):
        slot, of_slot = trip.slots[i], likelihood[trip.slots[i]]
        if later_s[slot] == later_s[slot]:
            stays = decay_factor(forecast.decay_rate[slot] * (later_s[slot] - trip.after_s[i]))
            p = forecast.p_occupied[slot] * (1.0 - stays) + stays * np.array([0.0, 1.0])
            of_slot = (1.0 - p) * of_slot[0] + p * of_slot[1]
        rates = np.array([trip.false_alarm_rate[i], trip.hit_rate[i]])
        likelihood[slot] = of_slot * (rates if trip.taken[i] else 1.0 - rates)
        later_s[slot] = trip.after_s[i]
    possible = likelihood[slots].sum(axis=1) > 0.0
    slots, time = slots[possible], trip.time + trip.after_s[first[possible]]
    return SlotStates(slots, time, likelihood[slots])


class DayMemory:
    """When slots were observed on earlier trips of one day.

    A slot that is taken on two trips may hold one car, not two. A later observation counts by the probability that the
    slot has changed in between, 1 - exp(-decay rate · time). If the decay rate is wrong, the map is too sure or too
    unsure of the slot, but not biased, as it would be if changes themselves were modelled.
    """

    def __init__(self, n_slots: int) -> None:
        self._time = np.full(n_slots, -np.inf)

    def add(self, states: SlotStates, forecast: Forecast) -> FloatArray:
        """Add the states of a trip; return by how much each counts, (k,), 0 to 1."""
        # Trips may overlap in time.
        apart = np.abs(states.time - self._time[states.slots])
        changed = 1.0 - np.exp(-np.minimum(forecast.decay_rate[states.slots] * apart, 700.0))
        changed[np.isinf(apart)] = 1.0
        self._time[states.slots] = states.time
        return np.asarray(changed)
