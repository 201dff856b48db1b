"""What a car observed on a search, as it goes into the map."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from parkenv.errors import InputError
from parkenv.world.decay import decay_factor
from parkenv.world.occupancy import Forecast

FloatArray = NDArray[np.float64]


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

    Raises:
        InputError: an empty key, times that are not finite or not ascending, a negative slot, or a rate outside 0 to 1.
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
    """What a trip says about the states of the k slots that it observed, each when it was first observed.

    Attributes:
        slots: (k,) int64, in the order of their first observations.
        time: (k,) float64, time of the first observation, on the clock of `Trip.time`.
        likelihood: (k, 2) float64, probability of all observations of the slot if it was free then, and if it was
            taken.
    """

    slots: NDArray[np.int64]
    time: FloatArray
    likelihood: FloatArray


def state_likelihoods(trip: Trip, forecast: Forecast) -> SlotStates:
    """Return what a trip says about each observed slot's state when it was first observed.

    A slot changes between its observations as a two-state Markov chain with the forecast's decay rate.

    Args:
        trip: the trip.
        forecast: the forecast of all slots for the trip.

    Returns:
        The states; slots with contradictory observations are left out.
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
    """The states of slots on earlier trips of one day.

    A slot that stays taken over two trips is one car, not two: a state that was observed before says less about how
    often the slot is taken. Given the earlier state, a slot is taken with probability `stays·earlier + (1 - stays)·p`,
    which is linear in p, as a single observation's probability is.

    Args:
        n_slots: number of slots.
    """

    def __init__(self, n_slots: int) -> None:
        self._time, self._p_taken = np.full((2, n_slots), np.nan)

    def add(self, states: SlotStates, forecast: Forecast) -> FloatArray:
        """Add the states of a trip.

        Args:
            states: the states.
            forecast: the forecast of all slots for the trip.

        Returns:
            (k, 2) float64, the probability of the observations of each slot, given those of earlier trips, if the
            slot were always free, and if it were always taken but for its earlier state.
        """
        slots, if_free, if_taken = states.slots, states.likelihood[:, 0], states.likelihood[:, 1]
        seen = np.isfinite(self._time[slots])
        # The chain is reversible, so trips that overlap in time need no order.
        apart = np.abs(states.time - np.where(seen, self._time[slots], 0.0))
        stays = np.where(seen, np.exp(-forecast.decay_rate[slots] * apart), 0.0)
        kept = stays * np.where(seen, self._p_taken[slots], 0.0)
        fresh = kept + (1.0 - stays)
        p_taken = kept + (1.0 - stays) * forecast.p_occupied[slots]
        given = np.column_stack(
            [if_taken * kept + if_free * (1.0 - kept), if_taken * fresh + if_free * (1.0 - fresh)]
        )
        # A slot that never changes by the forecast has changed: the later trip says nothing about p.
        impossible = given.sum(axis=1) == 0.0
        given[impossible], p_taken[impossible] = 1.0, 0.5
        self._p_taken[slots] = if_taken * p_taken / (if_taken * p_taken + if_free * (1.0 - p_taken))
        self._time[slots] = states.time
        return given
