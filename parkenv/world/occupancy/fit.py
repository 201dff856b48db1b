"""Maximum-likelihood rates of two-state chains from intermittent observations.

Counting state changes between observations misses every car that came and left in between. Here each pair of
consecutive observations enters with its exact transition probability (Kalbfleisch and Lawless, "The analysis of panel
data under a Markov assumption", JASA 1985), so the estimated rates do not depend on how often slots were observed.
"""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import brentq, minimize
from scipy.special import expit

from parkenv.compiled.arrays import BoolArray, FloatArray, IntArray
from parkenv.compiled.jit import compiled
from parkenv.errors import InputError, require_number
from parkenv.world.occupancy.day_error_fit import fit_day_error
from parkenv.world.occupancy.process import OccupancyProcess
from parkenv.world.week import HOUR_S

if TYPE_CHECKING:
    from parkenv.world.occupancy.log import OccupancyLog

# From once in 30 years to once a second; bounds for rates that the observations do not determine.
_LOG_RATE_BOUNDS = (math.log(1e-9), 0.0)
_LOG_FACTOR_BOUNDS = (-8.0, 8.0)
PRIOR_CHANGES = 10.0
"""Changes of state in an hour at which its own decay rate counts as much as the whole day's."""
_TINY = 1e-300
_DAY_HOURS = 24
_N_BINS = 2 * _DAY_HOURS  # hours of a weekday, hours of a weekend day
_NIGHT_MEMORY = 5.0
_MAX_PIECES = _DAY_HOURS
_MAX_SCORES = 2 * _MAX_PIECES + 2


@dataclass(frozen=True, eq=False)
class FittedProcess:
    """A process fitted to a log, with standard errors and log-likelihood."""

    # the process; its slot i is slot_ids[i], and each kind of factor has the geometric mean 1
    process: OccupancyProcess
    slot_ids: tuple[str, ...]  # the log's slots
    log_likelihood: float  # log-likelihood of all intervals, without the prior
    n_intervals: int  # number of pairs of consecutive observations used
    arrival_factor_se: FloatArray  # (n,) float64, standard error of the factor's natural logarithm
    # (168,) float64, the same for the profile; NaN in hours that were never observed
    arrival_profile_se: FloatArray
    departure_factor_se: FloatArray  # (n,) float64, as for arrivals
    departure_profile_se: FloatArray  # (168,) float64, as for arrivals


def fit_constant_rates(dt: ArrayLike, start: ArrayLike, end: ArrayLike) -> tuple[float, float]:
    """Fit constant arrival and departure rates, 1/s, by maximum likelihood.

    P(occupied at t+dt | x) = π + (x−π)·exp(−(λ+μ)·dt), π = λ/(λ+μ). Rates stay between 1e-9/s and 1/s; a kind
    of change that was never observed gets 1e-9/s.

    Args:
        dt: (k,) float64, s, > 0, time between two observations.
        start: (k,) bool, taken at the first observation.
        end: (k,) bool, taken at the second.
    """
    dt, start, end = np.asarray(dt, float), np.asarray(start, bool), np.asarray(end, bool)
    if not dt.shape == start.shape == end.shape == (dt.size,) or not dt.size:
        raise InputError(f"intervals have shapes {dt.shape}, {start.shape}, {end.shape}, want (k,), k > 0")
    if not np.all((dt > 0) & np.isfinite(dt)):
        raise InputError("intervals: dt: want finite seconds > 0")
    gaps, which = np.unique(dt, return_inverse=True)
    n = np.bincount(which * 4 + start * 2 + end, minlength=4 * gaps.size).reshape(-1, 2, 2).T
    (stay_free, leave), (take, stay) = n  # n[end, start, gap]

    def loss(log_rates: FloatArray) -> tuple[float, FloatArray]:
        rate = np.exp(log_rates)
        total = rate.sum()
        share = rate / total  # equilibrium: P(occupied), P(free)
        moved = -np.expm1(-total * gaps)
        value, by_share, by_total = 0.0, np.zeros(2), 0.0
        for side, flipped, stayed in ((0, take, stay_free), (1, leave, stay)):
            p = share[side] * moved
            value -= np.sum(flipped * np.log(p + _TINY) + stayed * np.log1p(-p))
            by_p = stayed / (1 - p) - flipped / (p + _TINY)
            by_share[side] = np.sum(by_p * moved)
            by_total += np.sum(by_p * share[side] * gaps * (1 - moved))
        # share = rate / total, so both shares depend on both rates.
        by_rate = by_total + (by_share - by_share @ share) / total
        return value / dt.size, by_rate * rate / dt.size

    # Observed changes per second hardly exceed the true rates. So the start lies below the plateau where observations
    # are so rare relative to the rates that their order carries no information.
    flips, watched = np.array([take.sum(), leave.sum()]), n.sum(axis=0) @ gaps
    lowest, highest = np.exp(_LOG_RATE_BOUNDS)
    first = np.log(np.clip(flips / np.maximum(watched, gaps[0]), lowest, highest))
    optimum = minimize(
        loss, first, jac=True, method="L-BFGS-B", bounds=[_LOG_RATE_BOUNDS] * 2, options={"ftol": 1e-12}
    )
    arrival, departure = np.exp(optimum.x)
    return float(arrival), float(departure)


def fit_hourly_decay_rates(
    start: FloatArray, end: FloatArray, before: BoolArray, after: BoolArray
) -> FloatArray:
    """Fit the sum of arrival and departure rate in each hour of the day, (24,), 1/s, by maximum likelihood.

    A pair of observations counts for the hour of its middle. The logarithm of an hour's rate is the mean of the hour's
    own and the whole day's, weighted by the hour's changes and `PRIOR_CHANGES`.

    Args:
        start: (k,) float64, s of the day, first observation of a pair; k > 0.
        end: (k,) float64, s of the day, second one.
        before: (k,) bool, taken at start.
        after: (k,) bool, taken at end.
    """
    dt, hour = end - start, ((start + end) / 2 // HOUR_S).astype(np.int64)
    rates: FloatArray = np.full(_DAY_HOURS, math.log(sum(fit_constant_rates(dt, before, after))))
    for h in np.unique(hour):
        here = hour == h
        own = math.log(sum(fit_constant_rates(dt[here], before[here], after[here])))
        n = int((before[here] != after[here]).sum())
        rates[h] += n / (n + PRIOR_CHANGES) * (own - rates[h])
    decay_rates: FloatArray = np.exp(rates)
    return decay_rates


class Intervals(NamedTuple):
    """Pairs of consecutive observations of a slot on one day, (k,) each."""

    slot: IntArray
    first_bin: IntArray  # 0 on a weekday, 24 on a weekend day
    start: FloatArray  # s of the day
    end: FloatArray  # s of the day, > start
    before: BoolArray  # taken at start
    after: BoolArray  # taken at end


@compiled
def _score(
    intervals: Intervals, k: int, rates: FloatArray, n: int, index: IntArray, score: FloatArray
) -> tuple[float, int]:
    """Return the log-probability of interval k, and m; derivatives by `theta[index[:m]]` go to `score[:m]`.

    The forward pass propagates p = P(occupied) through the pieces of constant rates, the backward pass its adjoint.
    """
    begun = np.empty(_MAX_PIECES)
    slot, first_bin, start, end = (
        intervals.slot[k],
        intervals.first_bin[k],
        intervals.start[k],
        intervals.end[k],
    )
    hour = int(start // HOUR_S)
    at_arrival, at_departure = 2 * _N_BINS + slot, 2 * _N_BINS + n + slot
    pieces = 0
    p = 1.0 if intervals.before[k] else 0.0
    while start < end:
        stop = min((hour + pieces + 1) * HOUR_S, end)
        bin_ = first_bin + hour + pieces
        arrival = rates[bin_] * rates[at_arrival]
        total = arrival + rates[_N_BINS + bin_] * rates[at_departure]
        begun[pieces] = p
        p += (arrival / total - p) * -math.expm1(-total * (stop - start))
        # Keep the piece's duration for the backward pass.
        score[2 * pieces] = stop - start
        start = stop
        pieces += 1
    after = intervals.after[k]
    seen = max(p if after else 1.0 - p, _TINY)
    adjoint = 1.0 / seen if after else -1.0 / seen
    score[2 * pieces] = 0.0
    score[2 * pieces + 1] = 0.0
    index[2 * pieces] = at_arrival
    index[2 * pieces + 1] = at_departure
    for back in range(pieces):
        i = pieces - 1 - back
        bin_ = first_bin + hour + i
        duration = score[2 * i]
        arrival = rates[bin_] * rates[at_arrival]
        departure = rates[_N_BINS + bin_] * rates[at_departure]
        total = arrival + departure
        remaining = math.exp(-total * duration)
        by_total = adjoint * duration * remaining * (arrival / total - begun[i])
        by_share = adjoint * -math.expm1(-total * duration) / (total * total)
        by_arrival = (by_total + by_share * departure) * arrival
        by_departure = (by_total - by_share * arrival) * departure
        index[2 * i] = bin_
        index[2 * i + 1] = _N_BINS + bin_
        score[2 * i] = by_arrival
        score[2 * i + 1] = by_departure
        score[2 * pieces] += by_arrival
        score[2 * pieces + 1] += by_departure
        adjoint *= remaining
    return math.log(seen), 2 * pieces + 2


@compiled
def log_likelihood(theta: FloatArray, intervals: Intervals) -> tuple[float, FloatArray]:
    """Return the log-likelihood of intervals between observations, and its gradient (compiled).

    `theta`, (96 + 2n,), holds natural logarithms: arrival profile in 1/s (24 hours of a weekday, 24 of a weekend day),
    departure profile in the same order, arrival factors (n,), departure factors (n,).
    """
    rates = np.exp(theta)
    n = (theta.size - 2 * _N_BINS) // 2
    index, score = np.empty(_MAX_SCORES, np.int64), np.empty(_MAX_SCORES)
    value, gradient = 0.0, np.zeros(theta.size)
    for k in range(intervals.slot.size):
        log_p, m = _score(intervals, k, rates, n, index, score)
        value += log_p
        for i in range(m):
            gradient[index[i]] += score[i]
    return value, gradient


@compiled
def _information(theta: FloatArray, intervals: Intervals) -> FloatArray:
    """Return the empirical Fisher information: the sum of the outer products of the intervals' scores."""
    rates = np.exp(theta)
    n = (theta.size - 2 * _N_BINS) // 2
    index, score = np.empty(_MAX_SCORES, np.int64), np.empty(_MAX_SCORES)
    information = np.zeros((theta.size, theta.size))
    for k in range(intervals.slot.size):
        _, m = _score(intervals, k, rates, n, index, score)
        for i in range(m):
            for j in range(m):
                information[index[i], index[j]] += score[i] * score[j]
    return information


def fit_process(log: "OccupancyLog", max_gap_s: float = 7200.0, prior_sd: float = 2.0) -> FittedProcess:
    """Fit an `OccupancyProcess` and its day error to a log by maximum likelihood.

    A rate is a factor per slot times a profile per hour, with one profile for weekdays and one for weekend days. All
    pairs of consecutive observations on a day at most `max_gap_s` apart are used, split exactly at full hours. A weak
    log-normal prior keeps the rates of slots and hours without changes from going to zero: the median of each profile
    value is the constant rate of its class of day, that of each factor is 1, and the standard deviation of the
    logarithm is `prior_sd`.

    Hours that were never observed: between observed hours, the nearest observed one applies (the earlier one of two
    equally near). Before a day's first and after its last observed hour, the lot relaxes to the mean state of the days'
    first observations, fast enough that e⁻⁵ of the evening's state is left in the morning: the night is unknown, but
    the morning is right. A class of day that was never observed gets the other's profile.

    The level of the day error is that of days around the process; it has no slope, as a log has no order of slots.

    Args:
        log: the observations.
        max_gap_s: s, longest interval used.
        prior_sd: no unit, standard deviation of the logarithms under the prior.
    """
    require_number("prior_sd", prior_sd, above=0.0)
    pairs = log.intervals(max_gap_s)
    if not pairs.slot.size:
        raise InputError(f"{log.source}: no two observations of a slot on one day within {max_gap_s:g} s")
    n = len(log.slot_ids)
    kind = log.weekend[pairs.day].astype(np.int64)
    data = Intervals(pairs.slot, kind * _DAY_HOURS, pairs.start, pairs.end, pairs.before, pairs.after)

    constant = np.zeros((2, 2))  # log rates: arrival and departure, on weekdays and weekend days
    for k in np.unique(kind):
        used = kind == k
        dt = pairs.end[used] - pairs.start[used]
        constant[:, k] = np.log(fit_constant_rates(dt, pairs.before[used], pairs.after[used]))
    centre = np.concatenate([np.repeat(constant.ravel(), _DAY_HOURS), np.zeros(2 * n)])

    def loss(theta: FloatArray) -> tuple[float, FloatArray]:
        value, gradient = log_likelihood(theta, data)
        off = (theta - centre) / prior_sd
        return 0.5 * off @ off - value, off / prior_sd - gradient

    bounds = [_LOG_RATE_BOUNDS] * (2 * _N_BINS) + [_LOG_FACTOR_BOUNDS] * (2 * n)
    theta: FloatArray = minimize(
        loss, centre, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 1000, "ftol": 1e-10}
    ).x
    covariance = np.linalg.inv(_information(theta, data) + np.eye(theta.size) / prior_sd**2)
    value, _ = log_likelihood(theta, data)

    centred = _centring(n)
    profile, factor = _split(centred @ theta)
    profile_se, factor_se = _split(np.sqrt(np.diag(centred @ covariance @ centred.T)))
    observed = _observed_hours(kind, pairs.start, pairs.end)
    profile_se[:, ~observed] = np.nan
    begins = log.first[:-1][np.diff(log.first) > 0]
    for k in np.unique(kind):
        resting = log.occupied[begins[log.weekend[log.day[begins]] == k]]
        # Half an observation of each state keeps the logit finite.
        at_rest = (resting.sum() + 0.5) / (resting.size + 1)
        _fill_unobserved(profile[:, k], observed[k], at_rest, factor)
        if not observed[1 - k].any():
            profile[:, 1 - k] = profile[:, k]
    week, week_se = _week(np.exp(profile)), _week(profile_se)
    process = OccupancyProcess(np.exp(factor[0]), week[0], np.exp(factor[1]), week[1])
    process = process.with_day_error(fit_day_error(log, process))
    errors = factor_se[0], week_se[0], factor_se[1], week_se[1]
    return FittedProcess(process, log.slot_ids, float(value), pairs.slot.size, *errors)


def _split(theta: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Profiles (2 sides, 2 classes of day, 24 hours) and factors (2 sides, n)."""
    return theta[: 2 * _N_BINS].reshape(2, 2, _DAY_HOURS).copy(), theta[2 * _N_BINS :].reshape(2, -1)


def _centring(n: int) -> FloatArray:
    """Return the matrix that moves the factors' geometric mean into the profiles: only their product is determined."""
    centring = np.eye(2 * _N_BINS + 2 * n)
    for side in range(2):
        bins = slice(side * _N_BINS, (side + 1) * _N_BINS)
        slots = slice(2 * _N_BINS + side * n, 2 * _N_BINS + (side + 1) * n)
        centring[bins, slots] = 1 / n
        centring[slots, slots] -= 1 / n
    return centring


def _observed_hours(kind: IntArray, start: FloatArray, end: FloatArray) -> BoolArray:
    """Return whether any interval overlaps each hour of each class of day, (2, 24) bool."""
    hours = np.arange(_DAY_HOURS) * HOUR_S
    inside = (start[:, None] < hours + HOUR_S) & (end[:, None] > hours)
    return np.stack([inside[kind == k].any(axis=0) for k in range(2)])


def _fill_unobserved(profile: FloatArray, observed: BoolArray, at_rest: float, factor: FloatArray) -> None:
    """Fill in the log rates (2, 24) of unobserved hours of one class of day; `fit_process` describes the rule."""
    hours = np.flatnonzero(observed)
    for hour in np.flatnonzero(~observed):
        profile[:, hour] = profile[:, hours[np.argmin(np.abs(hours - hour))]]
    night = (np.arange(_DAY_HOURS) < hours[0]) | (np.arange(_DAY_HOURS) > hours[-1])
    odds = factor[0] - factor[1]

    def excess(shift: float) -> float:
        return float(expit(odds + shift).mean()) - at_rest

    reach = float(np.abs(odds).max()) + 50.0
    # The previous day may be of the other class, so the relaxation happens in the hours after midnight.
    duration = HOUR_S * (hours[0] or _DAY_HOURS - 1 - hours[-1] or 1)
    profile[1, night] = math.log(_NIGHT_MEMORY / duration * (1 - at_rest))
    profile[0, night] = profile[1, night] + brentq(excess, -reach, reach)


def _week(by_class: FloatArray) -> FloatArray:
    """Convert (2, 2, 24) by class of day to (2, 168) by hour of the week."""
    return np.concatenate([np.tile(by_class[:, 0], 5), np.tile(by_class[:, 1], 2)], axis=1)
