"""Fit and score what perception makes of cars that are about to leave, in simulated scenes.

    python tests/builders/departure_cues.py fit      in some lots; print WEIGHTS and BIAS
    python tests/builders/departure_cues.py score    in others: tables, with the rates of `--cues sensed`

Cars stay an hour. Of the moments at which a car is about to leave, those with its lamps lit and those seen from near by
are drawn more often, and weighted less. All others come from moments and places drawn at random.
"""

import itertools
import sys
from typing import NamedTuple

import gymnasium as gym
import numpy as np
from scipy.optimize import minimize

import parkenv
from parkenv import OccupancyProcess, Traffic
from parkenv.engine.sensor_sampler import Station
from parkenv.perception.departure_cues import WEIGHTS, DepartureCues, log_likelihood_ratio
from parkenv.world.cue_scene import LAMPS_S
from parkenv.world.cues import LEAD_S, Cues
from parkenv.world.occupancy.kernel import shown_s

STAY_S, P_TAKEN, HOURS = 3600.0, 0.9, 3.0
SHARE = LEAD_S / (LEAD_S + STAY_S)  # of parked cars that are about to leave
WEATHERS = ("sunny", "overcast", "low_sun", "dusk", "rain")
FIT, HELD_OUT = (("campus", "street"), 1000), (("jam", "kerbs"), 5000)  # lots, first seed
N_LEAVING, N_ELSEWHERE = 60, 30  # moments in each lot and weather
NEAR_M, BACK_M = 4.0, 1.25
CUE = 1.5  # log-likelihood ratio from which something is a cue
PENALTY = 0.03


class Rows(NamedTuple):
    """Observations of cars in slots observed taken, (n,) each."""

    features: np.ndarray  # (n, k)
    leaves: np.ndarray  # bool, whether the car is about to leave
    lit: np.ndarray  # bool, whether it does so within `LAMPS_S`
    weight: np.ndarray
    distance: np.ndarray  # m, from the searching car to the slot's vertex
    weather: np.ndarray

    def only(self, chosen):
        return Rows(*(column[chosen] for column in self))


class Scenes:
    """What is seen of the cars of one world, from any vertex at any time."""

    def __init__(self, lot, weather, seed):
        scenario, hours = parkenv.make_scenario(lot), np.ones(168)
        leaving = np.full(scenario.lot.n_slots, 1.0 / STAY_S)
        process = OccupancyProcess(leaving * P_TAKEN / (1.0 - P_TAKEN), hours, leaving, hours)
        changes = {"occupancy": process, "prior": None, "cues": Cues(), "traffic": Traffic(1, 3)}
        env = gym.make("parkenv/SearchPerception-v2", scenario=scenario.replace(**changes), weather=weather)
        env.reset(seed=seed)
        self.env, self.lot, self.weather = env.unwrapped, scenario.lot, weather
        self.state, self.cues = self.env.state, DepartureCues(scenario.lot)
        starts, viewed = self.env.scenario.slots_in_view
        self.viewed = np.split(viewed, starts[1:-1])

    def left(self, time):
        """Return how long the cars stay on, s, and which are about to leave, (n_slots,) each."""
        slots, world = np.arange(self.lot.n_slots), self.state.world
        left = world.next_free(slots, time) - time
        lead = [shown_s(self.state.key, slot, time + s, LEAD_S) for slot, s in enumerate(left.tolist())]
        return left, world.occupied(slots, time) & (left <= lead)

    def distances(self, vertex):
        return np.hypot(*(self.lot.vertex_xy[: self.lot.n_slots] - self.lot.vertex_xy[vertex]).T)

    def seen(self, time, vertex, weights):
        """Return what two captures at a vertex show of cars with a weight, (n_slots,), above 0."""
        yaw, xy = self.lot.vertex_yaw[vertex], self.lot.vertex_xy[vertex]
        back = xy - BACK_M * np.array([np.cos(yaw), np.sin(yaw)])
        way = ((time - BACK_M / self.env.scenario.v_drive, back), (time, xy))
        stations = [Station(t, np.array([*at, yaw])) for t, at in way]
        perception = self.env.perception
        results, (slots, taken) = perception.pipeline.observe(perception.sampler.sample(self.state, stations))
        slots = slots[taken & (weights[slots] > 0.0) & np.isin(slots, self.viewed[vertex])]
        left, leaves = self.left(time)
        return Rows(
            self.cues.features(results, slots), leaves[slots], leaves[slots] & (left[slots] <= LAMPS_S), weights[slots],
            self.distances(vertex)[slots], np.full(len(slots), self.weather),
        )  # fmt: skip


def sample(lot, weather, seed):
    """Yield what is seen of cars about to leave, and of others."""
    scenes, rng = Scenes(lot, weather, seed), np.random.default_rng(seed)
    n, begin = scenes.lot.n_slots, scenes.state.arrival.time + 60.0
    moments, times = [], begin + rng.uniform(0.0, HOURS * 3600.0, 40_000)
    for time in times:
        left, leaves = scenes.left(time)
        for slot in np.flatnonzero(leaves & ((left <= LAMPS_S) | (rng.random(n) < 0.3))):
            near = scenes.distances(slot) <= NEAR_M
            views = np.array([slot in viewed for viewed in scenes.viewed[:n]])
            chosen = views & (near == (rng.random() < 0.5))
            if chosen.any():
                weight = chosen.sum() / views.sum() * (1.0 if left[slot] <= LAMPS_S else 1.0 / 0.3)
                vertex = int(rng.choice(np.flatnonzero(chosen)))
                moments.append((time, vertex, weight * (np.arange(n) == slot)))
        if len(moments) >= N_LEAVING:
            break
    moments += [(time, int(rng.integers(n)), ~scenes.left(time)[1] * 1.0) for time in times[:N_ELSEWHERE]]
    for moment in sorted(moments, key=lambda moment: moment[0]):
        yield scenes.seen(*moment)


def rows_of(lots, first):
    """Draw scenes of some lots; in each kind of weather of each, a usual share of cars is about to leave."""
    parts = []
    for i, (lot, weather) in enumerate(itertools.product(lots, WEATHERS)):
        rows = Rows(*map(np.concatenate, zip(*sample(lot, weather, first + i), strict=True)))
        share = np.where(rows.leaves, SHARE, 1.0 - SHARE)
        parts.append(rows._replace(weight=rows.weight * share / _of_kind(rows)))
    return Rows(*map(np.concatenate, zip(*parts, strict=True)))


def _of_kind(rows):
    """Return the weight of all that leave for those that do, and of all others for the others, (n,)."""
    return np.where(rows.leaves, rows.weight @ rows.leaves, rows.weight @ ~rows.leaves)


def fit(rows):
    """Fit a logistic model in which no cue speaks against a departure; return its weights and bias.

    Both kinds of cars count equally, so that the log-odds are the log-likelihood ratio.
    """
    x, sign = np.column_stack([rows.features, np.ones(len(rows.leaves))]), np.where(rows.leaves, 1.0, -1.0)
    weight = rows.leaves.sum() * rows.weight / _of_kind(rows)
    penalty = np.append(np.full(len(WEIGHTS), PENALTY), 0.0)

    def loss(w):
        margin = sign * (x @ w)
        slope = x.T @ (-weight * sign / (1.0 + np.exp(margin)))
        return weight @ np.logaddexp(0.0, -margin) + penalty @ w**2, slope + 2.0 * penalty * w

    bounds = [(None, None) if name == "picture" else (0.0, None) for name in WEIGHTS]
    best = minimize(loss, np.zeros(x.shape[1]), jac=True, bounds=[*bounds, (None, None)]).x
    return best[:-1], float(best[-1])


def rates(rows, ratio):
    """Return hit rate, hit rate of cars that are lit, false-alarm rate, and precision of the thresholded cue."""
    cue = ratio > CUE
    hit, lit, false_alarm = (
        np.average(cue[of], weights=rows.weight[of]) if of.any() else np.nan
        for of in (rows.leaves, rows.lit, ~rows.leaves)
    )
    return hit, lit, false_alarm, np.average(rows.leaves, weights=rows.weight * cue) if cue.any() else np.nan


def brier_skill(rows, ratio):
    """Return the part of the Brier score of the usual share that P(about to leave) saves, and that probability."""
    p = 1.0 / (1.0 + np.exp(-ratio) * (1.0 - SHARE) / SHARE)
    missed = [np.average((rows.leaves - said) ** 2, weights=rows.weight) for said in (p, SHARE)]
    return 1.0 - missed[0] / missed[1], p


def score(rows, ratio):
    groups = [(weather, rows.weather == weather) for weather in WEATHERS]
    for low, high in itertools.pairwise((0.0, 4.0, 8.0, 17.0)):
        groups.append((f"{low:g} to {high:g} m", (rows.distance >= low) & (rows.distance < high)))
    print(
        f"{'':12}{'cars':>7}{'leave':>7}{'hit':>8}{'hit lit':>8}{'false':>8}{'prec.':>8}{'Brier skill':>12}"
    )
    for name, chosen in [*groups, ("all", np.full(len(ratio), True))]:
        part, its = rows.only(chosen), ratio[chosen]
        hit, lit, false_alarm, precision = rates(part, its)
        counts = f"{len(its):7}{part.leaves.sum():7}{hit:8.3f}{lit:8.3f}{false_alarm:8.4f}{precision:8.3f}"
        print(f"{name:12}{counts}{brier_skill(part, its)[0]:12.3f}")
    p = brier_skill(rows, ratio)[1]
    for low, high in itertools.pairwise((0.0, 0.005, 0.01, 0.03, 0.1, 0.3, 1.0)):
        inside = (p >= low) & (p < high)
        if inside.any():
            said, true = (np.average(v[inside], weights=rows.weight[inside]) for v in (p, rows.leaves))
            print(f"P {low:g} to {high:g}: {inside.sum()} observations, said {said:.4f}, true {true:.4f}")


if __name__ == "__main__":
    seen = rows_of(*(FIT if sys.argv[1] == "fit" else HELD_OUT))
    ratios = log_likelihood_ratio(seen.features)
    if sys.argv[1] == "fit":
        weights, bias = fit(seen)
        print(dict(zip(WEIGHTS, weights.round(2).tolist(), strict=True)), round(bias, 2))
        ratios = seen.features @ weights + bias
    score(seen, ratios)
