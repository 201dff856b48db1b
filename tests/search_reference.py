"""The search of `parkenv/Search-v2` in plain Python: the specification that the compiled kernels must agree with."""

import math

import numpy as np

from parkenv import OccupancyProcess
from parkenv.compiled import keyed_random
from parkenv.world.lot import PARK
from parkenv.world.occupancy.centred_logits import centred_logits
from parkenv.world.occupancy.log import weekday_of


def day_factor(process, key, slot, p):
    """Factor of the odds of a slot with the forecast `p` on the day of the world."""
    if not process.day_error:
        return 1.0
    radius = math.sqrt(-2.0 * math.log(keyed_random.keyed_uniform(key, keyed_random.DAY_STREAM, 0, 0)))
    angle = 2.0 * math.pi * keyed_random.keyed_uniform(key, keyed_random.DAY_STREAM, 0, 1)
    near = 0.0 if process.nearness is None else process.nearness[slot]
    shift = process.day_error.level * radius * math.cos(angle)
    shift += process.day_error.slope * radius * math.sin(angle) * near
    centre = centred_logits(p, process.day_error.deviations(near))
    return math.exp(shift + centre - math.log(p / (1.0 - p)))


def process_taken(process, key, arrival, slot, time):
    """Whether a slot of a process is taken: draw the state at the arrival, then sojourn after sojourn.

    A sojourn ends when the hazard gathered since its begin, the integral of factor times profile, reaches an
    exponential random number. The day changes the odds at the arrival, and the arrival rates.
    """
    p = process.marginal(arrival)[slot]
    odds = p / (1.0 - p) * day_factor(process, key, slot, p)
    taken = keyed_random.keyed_uniform(key, keyed_random.OCCUPANCY_STREAM, slot, 0) < odds / (1.0 + odds)
    now, sojourn = arrival, 1
    while True:
        factor, profile = (
            (process.departure_factor[slot], process.departure_profile)
            if taken
            else (process.arrival_factor[slot], process.arrival_profile)
        )
        left = -math.log(keyed_random.keyed_uniform(key, keyed_random.OCCUPANCY_STREAM, slot, sojourn))
        while True:  # hour by hour, in which the rate is constant
            rate, hour_ends = factor * profile[int(now // 3600) % 168], (now // 3600 + 1) * 3600
            if not taken:
                since = max(now // 3600 * 3600.0, arrival)
                rate *= day_factor(process, key, slot, process.marginal(since)[slot])
            if rate * (hour_ends - now) >= left:
                now += left / rate
                break
            left -= rate * (hour_ends - now)
            now = hour_ends
            if now > time:
                break
        if now > time:
            return taken
        taken, sojourn = not taken, sojourn + 1


def recorded_taken(occupancy, arrival, slot, time):
    """Whether a slot of a replayed log is taken: the last of its states that has begun."""
    states = occupancy.day_states(arrival.day)
    own = slice(*states.first[slot : slot + 2])
    before = np.flatnonzero(states.from_s[own] <= time - weekday_of(arrival.day) * 86_400.0)
    return bool(states.occupied[own][before[-1]])


class ReferenceSearch:
    """One episode: state, `step`, and what the environment should observe and report."""

    def __init__(self, scenario, seed, episode=0):
        self.scenario, self.key = scenario, keyed_random.world_key(seed, episode)
        self.arrival = scenario.occupancy.draw_arrival(scenario.arrival, self.key)
        self.time = self.arrival.time
        entries = scenario.lot.entry_vertices
        if scenario.entry is not None:
            entries = entries[[scenario.entry]]
        self.vertex = int(
            entries[int(keyed_random.keyed_uniform(self.key, keyed_random.ENTRY_STREAM, 0, 0) * len(entries))]
        )
        known = scenario.forecast(self.arrival)
        self.forecast, self.decay_rate = known.p_occupied, known.decay_rate
        self.day_error = [known.day_error.level, known.day_error.slope]
        self.p_observed = self.forecast.copy()
        self.observed_at = np.full(len(self.forecast), -1.0)
        self.observed_taken = np.zeros(len(self.forecast), dtype=bool)
        self.step_observed = []
        self.passed = set()
        self.parked = self.over = False
        self.metrics = dict.fromkeys(
            ("drive_s", "failed_s", "walk_s", "parking_cost_s", "gave_up_s", "driven_m", "walked_m"), 0.0
        )
        self.failed_parks = 0

    def taken(self, slot):
        """The truth, now."""
        occupancy = self.scenario.occupancy
        if isinstance(occupancy, OccupancyProcess):
            return process_taken(occupancy, self.key, self.arrival.time, slot, self.time)
        return recorded_taken(occupancy, self.arrival, slot, self.time)

    def p_occupied(self):
        """Belief now: the last observation, decayed to the forecast."""
        age = np.where(self.observed_at < 0.0, 0.0, self.time - self.arrival.time - self.observed_at)
        return self.forecast + (self.p_observed - self.forecast) * np.exp(-self.decay_rate * age)

    def set_belief(self, slot, taken, p):
        """Record an observation of a slot, made now."""
        self.observed_taken[slot], self.p_observed[slot] = taken, p
        self.observed_at[slot] = self.time - self.arrival.time

    def step(self, action):
        """Take an action; return the terms of the reward."""
        scenario, lot, slot = self.scenario, self.scenario.lot, self.vertex
        terms = dict.fromkeys(("drive", "failed", "walk", "parking", "gave_up"), 0.0)
        self.step_observed = []
        if action < PARK and lot.neighbors[self.vertex, action] >= 0:
            length = lot.edge_length[self.vertex, action]
            terms["drive"] = length / scenario.v_drive
            self.metrics["driven_m"] += length
            self.vertex = int(lot.neighbors[self.vertex, action])
        elif action == PARK and slot < lot.n_slots:
            taken = self.taken(slot)
            self.set_belief(slot, taken, float(taken))
            self.step_observed.append((slot, taken, 1.0, 0.0))
            if taken:
                terms["failed"] = scenario.failure_s
                self.failed_parks += 1
            else:
                self.parked = True
                self.metrics["walked_m"] = lot.walk_m(scenario.goal)[slot]
                terms["walk"] = self.metrics["walked_m"] / scenario.v_walk
                terms["parking"] = lot.slot_parking_cost_s[slot]
        else:
            terms["drive"] = scenario.wait_s
        self.time += terms["drive"] + terms["failed"]
        if not self.parked:
            self.observe()
        full = bool((self.observed_taken & (self.observed_at >= 0.0)).all())
        if full:
            terms["gave_up"] = scenario.give_up_s
        self.over = self.parked or full
        for name, cost in terms.items():
            self.metrics["parking_cost_s" if name == "parking" else f"{name}_s"] += cost
        return {name: -cost for name, cost in terms.items()}

    def observe(self):
        """Observe the slots that are near enough and visible, some of them wrongly."""
        starts, slots = self.scenario.slots_in_view
        rows = range(starts[self.vertex], starts[self.vertex + 1])
        rates = self.scenario.sensor_rates
        if self.vertex < self.scenario.lot.n_slots:
            self.passed.add(self.vertex)
        for row in rows:
            slot, hit, false_alarm = int(slots[row]), rates.hit[row], rates.false_alarm[row]
            if not self.scenario.sensor_model.perfect:
                if keyed_random.keyed_uniform(self.key, keyed_random.VIEW_STREAM, slot, 0) >= rates.seen[row]:
                    continue
                error = keyed_random.keyed_uniform(
                    self.key, keyed_random.OBSERVATION_STREAM, slot, int(self.time * 1000.0)
                )
                taken = error < (hit if self.taken(slot) else false_alarm)
            else:
                taken = self.taken(slot)
            p = self.p_occupied()[slot]
            if_taken, if_free = (hit, false_alarm) if taken else (1.0 - hit, 1.0 - false_alarm)
            evidence = if_taken * p + if_free * (1.0 - p)
            self.set_belief(slot, taken, if_taken * p / evidence if evidence > 0.0 else float(taken))
            self.step_observed.append((slot, taken, hit, false_alarm))

    def observation(self):
        """What `parkenv/Search-v2` should observe."""
        most = 1 + max(np.diff(self.scenario.slots_in_view[0]))
        unused = [(-1, 0, 0, 0)] * (most - len(self.step_observed))
        return {
            "vertex": self.vertex,
            "time": np.array([self.time, self.time - self.arrival.time]),
            "p_occupied": self.p_occupied(),
            "belief": np.concatenate([self.forecast, self.decay_rate, self.p_observed, self.observed_at]),
            "step_observed": np.array([*self.step_observed, *unused], float).T.ravel(),
            "day_error": self.day_error,
            "action_mask": np.append(
                self.scenario.lot.neighbors[self.vertex] >= 0, self.vertex < self.scenario.lot.n_slots
            ),
        }

    def info(self):
        """The metrics that the environment should report."""
        costs = ("drive_s", "failed_s", "walk_s", "parking_cost_s", "gave_up_s")
        return self.metrics | {
            "total_s": sum(self.metrics[name] for name in costs),
            "failed_parks": self.failed_parks,
            "slots_passed": len(self.passed),
            "parked": self.parked,
        }
