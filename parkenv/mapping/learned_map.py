"""A map that learns from every trip: an occupancy forecast, corrected by what searches observed."""

from collections.abc import Sequence
from itertools import groupby, product

import numpy as np
from numpy.typing import ArrayLike

from parkenv.compiled.arrays import FloatArray
from parkenv.errors import InputError
from parkenv.forecast.logistic_normal import EVEN
from parkenv.forecast.map_error import Evidence, MapError, MapErrorPrior
from parkenv.mapping.inference import RELAXATION_S, MapPrior, SessionLog
from parkenv.mapping.trips import DayMemory, Trip, state_likelihoods
from parkenv.world.occupancy.centred_logits import centred_logits
from parkenv.world.occupancy.day_error import MAX_LOGITS, DayError, nearness
from parkenv.world.occupancy.kernel import MAX_PROBABILITY, MIN_PROBABILITY
from parkenv.world.occupancy.process import Arrival, Forecast, PriorModel
from parkenv.world.week import DAY_S, HOUR_S, WEEK_S

MOST_SLOTS = 3_000  # largest lot: memory and time grow with the square of the slots
# Largest lot whose survey sessions, which observe every slot, are learned from; that takes a second a session.
MOST_SURVEYED_SLOTS = 1_000
SURVEY_ERROR = 0.03  # share of the slots that a survey session judges wrong
# Day error of a map that states none: the median of 99 car parks over two years is 0.77 logits.
USUAL_DAY = DayError(0.8)
_MEMORY = (30.0, 365.0)  # days, time constants of the drift
# Standard deviations, relative to that of the level.
_SHAPE = {"level": 1.0, "slope": 0.8, "smooth": 0.8, "own": 0.6, "hour": 0.5}


def _priors(
    scales: dict[float, float], trust: float = 1.0, shape: dict[str, float] = _SHAPE
) -> tuple[MapErrorPrior, ...]:
    return tuple(
        MapErrorPrior(
            **{part: scale * sd for part, sd in shape.items()}, memory_days=days, weight=weight, trust=trust
        )
        for (scale, weight), days in product(scales.items(), _MEMORY)
    )


# Priors for a given map: right, a little off, quite wrong, or worthless; with or without drift over weeks.
GIVEN_MAP = (*_priors({0.1: 0.3, 0.5: 0.3, 1.0: 0.25, 2.5: 0.15}), *_priors({2.0: 0.002}, trust=0.0))
NO_MAP = _priors({1.0: 0.5, 2.0: 0.5})  # priors for a lot of which nothing is known
# Priors for a lot of which survey sessions alone are known; unlike a driver's trips, they are spread over the day.
SURVEYED = _priors({1.0: 0.5, 2.0: 0.5}, shape={**_SHAPE, "hour": 1.0})


class EmptyMap(PriorModel):
    def __init__(self, n_slots: int) -> None:
        self._forecast = Forecast(np.full(n_slots, 0.5), np.full(n_slots, 1.0 / RELAXATION_S), USUAL_DAY)

    @property
    def n_slots(self) -> int:
        return len(self._forecast.p_occupied)

    def forecast(self, arrival: Arrival) -> Forecast:
        del arrival
        return self._forecast


class ReversedMap(PriorModel):
    """A wrong map: slots near the goal get the forecast of slots far from it by their walk, and the other way round."""

    def __init__(self, right: PriorModel, walk: ArrayLike) -> None:
        self._right = right
        order = np.argsort(np.asarray(walk), kind="stable")
        self._from = np.empty_like(order)
        self._from[order] = order[::-1]

    @property
    def n_slots(self) -> int:
        return self._right.n_slots

    def forecast(self, arrival: Arrival) -> Forecast:
        right = self._right.forecast(arrival)
        return Forecast(right.p_occupied[self._from], right.decay_rate[self._from], right.day_error)


def map_prior(log: SessionLog, trips: Sequence[Trip], walk: ArrayLike) -> PriorModel:
    """Return the forecast of a map file, from its survey sessions and the trips after them.

    Both go into one posterior: after few sessions the forecast is uncertain, and its day error says so; a full row near
    the goal is evidence about the unobserved slots beside it. In lots of more than 1,000 slots, sessions are counted
    instead (`MapPrior`).

    Args:
        log: the sessions.
        trips: the trips.
        walk: (n,) walk from each slot to the goal.

    Raises:
        InputError: neither sessions nor trips, or a lot that is too large to learn from trips.
    """
    if not trips and not len(log.time):
        raise InputError("the map holds no session, want at least one")
    counted = log.n_slots > MOST_SURVEYED_SLOTS and len(log.time) > 0
    if counted and not trips:
        return MapPrior(log)
    if counted:
        learned = LearnedMap(MapPrior(log), walk, GIVEN_MAP)
    else:
        learned = LearnedMap(EmptyMap(log.n_slots), walk, SURVEYED if len(log.time) else NO_MAP)
        learned.learn_sessions(log)
    learned.learn(trips)
    return learned


class LearnedMap(PriorModel):
    """A map, corrected by trips.

    The forecast is the mean over days of the corrected map; its day error holds the day's own and what is still unknown
    of the error that all slots share.

    Args:
        base: the map before any trip.
        walk: (n,) walk from each slot to the goal.
        priors: how far that map may be off.
    """

    def __init__(
        self, base: PriorModel, walk: ArrayLike, priors: Sequence[MapErrorPrior] = GIVEN_MAP
    ) -> None:
        if base.n_slots > MOST_SLOTS:
            raise InputError(
                f"a map that learns from trips has at most {MOST_SLOTS:,} slots, this lot has {base.n_slots:,}"
            )
        self._base = base
        self._nearness = nearness(walk)
        self._error = MapError(self._nearness, priors)
        self._day: int | None = None

    @property
    def n_slots(self) -> int:
        return self._base.n_slots

    def pass_time(self, day: int) -> None:
        """Let the map age until a day, counted from the first Monday; earlier days change nothing."""
        if self._day is not None and day > self._day:
            self._error.pass_days(day - self._day)
        self._day = day if self._day is None else max(day, self._day)

    def learn(self, trips: Sequence[Trip]) -> None:
        for day, trips_of_day in groupby(trips, key=lambda trip: int(trip.time // DAY_S)):
            self.pass_time(day)
            self._add_day(list(trips_of_day))

    def learn_sessions(self, log: SessionLog) -> None:
        """Add survey sessions; each counts as a day of its own, and as older than any trip, since none has a date."""
        rates = np.array([[SURVEY_ERROR, 1.0 - SURVEY_ERROR], [1.0 - SURVEY_ERROR, SURVEY_ERROR]])
        for time, occupied, known in zip(log.time, log.occupied, log.known, strict=True):
            slots = np.flatnonzero(known)
            hours, weight = np.full(len(slots), time / HOUR_S), np.ones(len(slots))
            base = self._base.forecast(Arrival(time))
            likelihood = rates[(~occupied[slots]).astype(np.int64)]
            self._observe(Evidence(slots, hours, likelihood, weight), base.p_occupied[slots], base.day_error)

    def forecast(self, arrival: Arrival) -> Forecast:
        base, hour = self._base.forecast(arrival), arrival.time / HOUR_S
        p_taken, mean_logits = [], []
        mean, variance = self._error.predict(hour)
        day = base.day_error.deviations(self._nearness)
        parts = (self._error.trust, self._error.prior_sd(), mean, variance)
        for trust, prior_sd, error, error_variance in zip(*parts, strict=True):
            logits = trust * centred_logits(base.p_occupied, np.hypot(prior_sd, day)) + error
            p_taken.append(EVEN.expit(logits, np.sqrt(error_variance + day**2))[0])
            mean_logits.append(logits)
        weights = self._error.weights
        p = np.clip(weights @ np.array(p_taken), MIN_PROBABILITY, MAX_PROBABILITY)
        return Forecast(
            p, base.decay_rate, self._day_error(base.day_error, weights, np.array(mean_logits), hour)
        )

    def _add_day(self, trips: Sequence[Trip]) -> None:
        slots, hours, likelihood, weight, p, day_error = [], [], [], [], [], DayError()
        memory = DayMemory(self.n_slots)
        for trip in trips:
            base = self._base.forecast(Arrival(trip.time % WEEK_S, trip.date))
            states = state_likelihoods(trip, base)
            slots.append(states.slots)
            likelihood.append(states.likelihood)
            weight.append(memory.add(states, base))
            hours.append(np.full(len(states.slots), trip.time / HOUR_S))
            p.append(base.p_occupied[states.slots])
            day_error = base.day_error
        evidence = Evidence(*map(np.concatenate, (slots, hours, likelihood, weight)))
        self._observe(evidence, np.concatenate(p), day_error)

    def _observe(self, evidence: Evidence, p: FloatArray, day_error: DayError) -> None:
        """Add the observations of a day; p is the base map's P(taken) of their slots."""
        day = day_error.deviations(self._nearness[evidence.slots])
        deviation = np.hypot(self._error.prior_sd()[:, evidence.slots], day)
        logits = self._error.trust[:, None] * centred_logits(p, deviation)
        self._error.observe(evidence, logits, (day_error.level, day_error.slope))

    def _day_error(self, day: DayError, weights: FloatArray, logits: FloatArray, hour: float) -> DayError:
        level_sd, slope_sd = self._error.common_sd(hour)
        rise = self._nearness / max(float(self._nearness @ self._nearness), 1e-12)
        both = []
        for own, unknown, of_priors in (
            (day.level, level_sd, logits.mean(axis=1)),
            (day.slope, slope_sd, logits @ rise),
        ):
            apart = of_priors - weights @ of_priors
            both.append(min(float(np.sqrt(own**2 + weights @ (unknown**2 + apart**2))), MAX_LOGITS))
        return DayError(*both)
