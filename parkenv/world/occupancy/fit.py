"""Maximum-likelihood rates of two-state chains from intermittent observations.

Counting state changes between observations misses every car that came and left in between. Here each pair of
consecutive observations enters with its exact transition probability (Kalbfleisch and Lawless, "The analysis of panel
data under a Markov assumption", JASA 1985), so the estimated rates do not depend on how often slots were observed.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import brentq, minimize
from scipy.special import expit, logit

from parkenv.compiled.arrays import BoolArray, FloatArray, IntArray
from parkenv.compiled.jit import compiled
from parkenv.errors import InputError, require, require_number
from parkenv.world.occupancy.day_error import MAX_LOGITS, DayError
from parkenv.world.occupancy.kernel import MAX_PROBABILITY, MIN_PROBABILITY
from parkenv.world.occupancy.log import Intervals, OccupancyLog
from parkenv.world.occupancy.process import OccupancyProcess
from parkenv.world.week import DAY_S, HOUR_S

# From once in 30 years to once a second; bounds for rates that the observations do not determine.
_LOG_RATE_BOUNDS = (math.log(1e-9), 0.0)
_LOG_FACTOR_BOUNDS = (-8.0, 8.0)
# Changes of state in an hour at which its own decay rate counts as much as the whole day's.
PRIOR_CHANGES = 10.0
_TINY = 1e-300
_DAY_HOURS = 24
_N_BINS = 2 * _DAY_HOURS  # hours of a weekday, hours of a weekend day
_NIGHT_MEMORY = 5.0
_MAX_PIECES = _DAY_HOURS
_MAX_SCORES = 2 * _MAX_PIECES + 2
# The day error of 99 German car parks over two years: its median, and as many days as give the prior their middle 80 %,
# 0.50 to 1.07. Of a few days, none may have been unusual.
PRIOR_LEVEL, PRIOR_DAYS = 0.77, 5.7
_FAR = 15.0  # logits
_SMALL = 1e-3  # logits
_MOMENT_S = 600.0  # a few minutes make no difference, and a log may have as many times as observations


@dataclass(frozen=True, eq=False)
class FittedProcess:
    """A process fitted to a log, and its log-likelihood."""

    # the process; its slot i is slot_ids[i], and each kind of factor has the geometric mean 1
    process: OccupancyProcess
    slot_ids: tuple[str, ...]  # the log's slots
    log_likelihood: float  # log-likelihood of all intervals, without the prior
    n_intervals: int  # number of pairs of consecutive observations used


def fit_constant_rates(dt: ArrayLike, start: ArrayLike, end: ArrayLike) -> tuple[float, float]:
    """Fit constant arrival and departure rates, 1/s, by maximum likelihood, to k pairs of observations, `dt` s apart.

    P(occupied at t+dt | x) = π + (x−π)·exp(−(λ+μ)·dt), π = λ/(λ+μ). Rates stay between 1e-9/s and 1/s; a kind
    of change that was never observed gets 1e-9/s.
    """
    dt, start, end = np.asarray(dt, float), np.asarray(start, bool), np.asarray(end, bool)
    if not dt.shape == start.shape == end.shape == (dt.size,) or not dt.size:
        raise InputError(f"intervals have shapes {dt.shape}, {start.shape}, {end.shape}, want (k,), k > 0")
    require(np.all((dt > 0) & np.isfinite(dt)), "intervals: dt: want finite seconds > 0")
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

    A pair of observations, at `start` and `end` s of the day, counts for the hour of its middle. The logarithm of an
    hour's rate is the mean of the hour's own and the whole day's, weighted by the hour's changes and `PRIOR_CHANGES`.
    """
    dt, hour = end - start, ((start + end) / 2 // HOUR_S).astype(np.int64)
    rates: FloatArray = np.full(_DAY_HOURS, math.log(sum(fit_constant_rates(dt, before, after))))
    for h in np.unique(hour):
        here = hour == h
        own = math.log(sum(fit_constant_rates(dt[here], before[here], after[here])))
        n = int((before[here] != after[here]).sum())
        rates[h] += n / (n + PRIOR_CHANGES) * (own - rates[h])
    return np.exp(rates)


@compiled
def _score(
    intervals: Intervals, k: int, rates: FloatArray, n: int, index: IntArray, score: FloatArray
) -> tuple[float, int]:
    """Return the log-probability of interval k, and m; derivatives by `theta[index[:m]]` go to `score[:m]`.

    The forward pass propagates p = P(occupied) through the pieces of constant rates, the backward pass its adjoint.
    """
    begun = np.empty(_MAX_PIECES)
    slot, first_bin = intervals.slot[k], intervals.day[k]
    start, end = intervals.start[k], intervals.end[k]
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

    The `day` of an interval is the first bin of its class: 0 on a weekday, 24 on a weekend day.

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


def fit_process(log: OccupancyLog, max_gap_s: float = 7200.0, prior_sd: float = 2.0) -> FittedProcess:
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
    """
    require_number("prior_sd", prior_sd, above=0.0)
    log = log.looks
    pairs = log.intervals(max_gap_s)
    require(pairs.slot.size, f"{log.source}: no two observations of a slot on one day within {max_gap_s:g} s")
    n = len(log.slot_ids)
    kind = log.weekend[pairs.day].astype(np.int64)
    data = pairs._replace(day=kind * _DAY_HOURS)

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
    value, _ = log_likelihood(theta, data)
    centred = _centring(n) @ theta
    # Profiles (2 sides, 2 classes of day, 24 hours), factors (2 sides, n).
    profile, factor = centred[: 2 * _N_BINS].reshape(2, 2, _DAY_HOURS), centred[2 * _N_BINS :].reshape(2, -1)
    hours = np.arange(_DAY_HOURS) * HOUR_S
    inside = (pairs.start[:, None] < hours + HOUR_S) & (pairs.end[:, None] > hours)
    observed = np.stack([inside[kind == k].any(axis=0) for k in range(2)])
    begins = log.first[:-1][np.diff(log.first) > 0]
    for k in np.unique(kind):
        resting = log.occupied[begins[log.weekend[log.day[begins]] == k]]
        # Half an observation of each state keeps the logit finite.
        at_rest = (resting.sum() + 0.5) / (resting.size + 1)
        _fill_unobserved(profile[:, k], observed[k], at_rest, factor)
        if not observed[1 - k].any():
            profile[:, 1 - k] = profile[:, k]
    rates = np.exp(profile)
    week = np.concatenate([np.tile(rates[:, 0], 5), np.tile(rates[:, 1], 2)], axis=1)
    process = OccupancyProcess(np.exp(factor[0]), week[0], np.exp(factor[1]), week[1])
    process = process.with_day_error(fit_day_error(log, process))
    return FittedProcess(process, log.slot_ids, float(value), pairs.slot.size)


def _centring(n: int) -> FloatArray:
    """Return the matrix that moves the factors' geometric mean into the profiles: only their product is determined."""
    centring = np.eye(2 * _N_BINS + 2 * n)
    for side in range(2):
        bins = slice(side * _N_BINS, (side + 1) * _N_BINS)
        slots = slice(2 * _N_BINS + side * n, 2 * _N_BINS + (side + 1) * n)
        centring[bins, slots] = 1 / n
        centring[slots, slots] -= 1 / n
    return centring


def _fill_unobserved(profile: FloatArray, observed: BoolArray, at_rest: float, factor: FloatArray) -> None:
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


def fit_day_error(log: OccupancyLog, process: OccupancyProcess) -> DayError:
    """Fit the standard deviation of the level of days around a process (method of moments).

    The shift of a day is the one at which the process expects as many observations of taken slots as there were. The
    level is the square root of the variance of the shifts over days, less the variance that they have by chance, pooled
    with that of other car parks (a scaled inverse χ² prior). Levels well above 1 come out a tenth too low, as the
    centring of days is left out. No slope: a log has no order of slots.
    """
    shifts, variances = [], []
    for day in np.unique(log.day):
        chosen = log.day == day
        rounded = np.minimum(np.round(log.second[chosen] / _MOMENT_S) * _MOMENT_S, DAY_S - 1.0)
        # A day that follows one of its own class.
        moments, which = np.unique((6 if log.weekend[day] else 1) * DAY_S + rounded, return_inverse=True)
        count = np.zeros((moments.size, process.n_slots))
        np.add.at(count, (which, log.slot[chosen]), 1.0)
        # Half an observation of each state keeps the shift finite.
        share = (log.occupied[chosen].sum() + 0.5) / (chosen.sum() + 1)
        shift = brentq(_surplus, -_FAR, _FAR, (process, moments, count, share), xtol=1e-6)
        sides = [_surplus(shift + side, process, moments, count, share) for side in (_SMALL, -_SMALL)]
        shifts.append(shift)
        variances.append(
            _variance(shift, process, moments, count) / ((sides[0] - sides[1]) / (2.0 * _SMALL)) ** 2
        )
    own = max(float(np.var(shifts, ddof=1) - np.mean(variances)), 0.0) if len(shifts) > 1 else 0.0
    days = len(shifts) - 1
    level = np.sqrt((PRIOR_DAYS * PRIOR_LEVEL**2 + days * own) / (PRIOR_DAYS + days))
    return DayError(min(level, MAX_LOGITS))


def _surplus(
    shift: float, process: OccupancyProcess, moments: FloatArray, count: FloatArray, share: float
) -> float:
    p, _ = _day(process, moments, shift)
    return float((count * p).sum() - share * count.sum())


def _variance(shift: float, process: OccupancyProcess, moments: FloatArray, count: FloatArray) -> float:
    p, remaining = _day(process, moments, shift)
    total, later = 0.0, np.zeros(process.n_slots)
    for k in range(moments.size - 1, -1, -1):
        # Two states of a slot have the covariance p(1 - p) of the earlier one, decayed.
        total += float((count[k] * p[k] * (1.0 - p[k]) * (count[k] + 2.0 * later)).sum())
        later = remaining[k] * (count[k] + later)
    return total


def _day(process: OccupancyProcess, moments: FloatArray, shift: float) -> tuple[FloatArray, FloatArray]:
    """Follow the slots of a process through a day with exp(`shift`) times its odds and arrival rates.

    It begins with the first of `moments`, (k,) s since Monday 00:00, ascending. Returns (k, n) each: P(taken), and the
    part of a difference that is left since the moment before.
    """
    now = float(moments[0])
    p = expit(logit(np.clip(process.marginal(now), MIN_PROBABILITY, MAX_PROBABILITY)) + shift)
    taken, remaining = np.empty((2, moments.size, process.n_slots))
    for k, moment in enumerate(moments):
        gathered = np.zeros(process.n_slots)
        while now < moment:
            hour = int(now // HOUR_S)
            until = min((hour + 1) * HOUR_S, float(moment))
            arrival, departure = process.factors * process.profiles[:, hour, None]
            arrival = arrival * np.exp(shift)
            total = arrival + departure
            equilibrium = arrival / np.maximum(total, np.finfo(float).tiny)
            p = equilibrium + (p - equilibrium) * np.exp(-total * (until - now))
            gathered += total * (until - now)
            now = until
        taken[k], remaining[k] = p, np.exp(-gathered)
    return taken, remaining
