"""Parking on a line without return, and slots inspected in random order."""

import copy
import math
from dataclasses import dataclass
from functools import cache, partial

import numpy as np
from closed_forms import Statement, closed_form
from expected_time import observation

from parkenv.belief.slot_belief import SlotBelief
from parkenv.lots.generators import KERB_SIZE, ONE_WAY_HALF_WIDTH, kerb_rows
from parkenv.studies.episodes import EpisodeRunner
from parkenv.world.lot import PARK, Lane, ParkingLot
from parkenv.world.occupancy.process import OccupancyProcess
from parkenv.world.scenario import KMH, Scenario, SearchProblem
from parkenv.world.sensor_model import SensorModel
from parkenv.world.week import WEEK_HOURS
from planners.agent import make_agent

PITCH = KERB_SIZE[0]  # distance between slots, m
V_WALK = 4 * KMH
EQUAL_COSTS = 1e-4  # v_walk/v_drive at which a and b are equal to one in ten thousand
THESIS_SPEEDS = 0.4  # v_walk/v_drive of the thesis, 4 and 10 km/h
CHANCES = (0.5, 0.75, 0.8, 0.85, 0.9, 0.95, 0.99)
FOREVER_S = 1e12  # mean stay, s, of a world in which nothing changes
BEYOND_ASKED = 10  # slots beyond the goal for which agents are asked whether they take them


@dataclass(frozen=True)
class Line:
    q: float  # probability that a slot is taken
    ratio: float  # v_walk/v_drive
    before: int  # number of slots before the one at the goal
    beyond: int  # and beyond it

    @classmethod
    def long(cls, q, ratio):
        return cls(q, ratio, math.ceil(4.0 / (1.0 - q)), math.ceil(14.0 / (1.0 - q)))

    @property
    def n_slots(self):
        return self.before + 1 + self.beyond

    @property
    def before_s(self):
        return PITCH / V_WALK * (1.0 - self.ratio)

    @property
    def beyond_s(self):
        return PITCH / V_WALK * (1.0 + self.ratio)

    @property
    def threshold(self):
        """The farthest distance before the goal, in slots, at which a free slot is taken."""
        part = self.before_s / (self.before_s + self.beyond_s)
        return math.floor(math.log(part) / math.log(self.q))

    @property
    def mean_s(self):
        r = min(self.threshold, self.before) + 1
        a, b, free = self.before_s, self.beyond_s, 1.0 - self.q
        drive_s = (self.before + 1) * PITCH / V_WALK * self.ratio
        return drive_s + a * r - a * (1.0 - self.q**r) / free + b * self.q**r / free

    @property
    def best_failure_s(self):
        return self.before_s * (self.threshold + 0.5) * (1.0 - self.q) / self.q

    def mean_cost(self, takes):
        """Return the mean cost, s, of a rule: which free slots it takes, (n,) bool, from the first one on."""
        distance = self.before - np.arange(len(takes))
        cost_s = np.where(distance > 0, self.before_s, -self.beyond_s) * distance
        chance = np.where(takes, 1.0 - self.q, 0.0)
        reached = np.concatenate([[1.0], np.cumprod(1.0 - chance)[:-1]])
        return float((reached * chance * cost_s).sum() / (reached * chance).sum())

    def problem(self):
        kerb_y = -ONE_WAY_HALF_WIDTH
        west, east = (self.before + 0.5) * -PITCH, (self.beyond + 0.5) * PITCH
        row = kerb_rows(np.array([[west, kerb_y]]), np.array([[east, kerb_y]]), np.array([False]))[0]
        entry = np.array([[row.xy[0, 0] - PITCH, 0.0]])
        lot = ParkingLot(
            name="line",
            slot_ids=tuple(str(self.before - i) for i in range(self.n_slots)),
            **row.columns(),
            lanes=(Lane(np.array([entry[0], [east + PITCH, 0.0]]), oneway=True),),
            entries=entry,
            goals=np.array([[0.0, row.xy[0, 1]]]),
        )
        only_beside = SensorModel(view_range=0.0)
        return SearchProblem(lot=lot, v_walk=V_WALK, v_drive=V_WALK / self.ratio, sensor_model=only_beside)

    def scenario(self):
        odds, problem = math.log(self.q / (1.0 - self.q)), self.problem()
        lasting = OccupancyProcess.from_demand(np.full(self.n_slots, odds), np.zeros(WEEK_HOURS), FOREVER_S)
        fields = {name: getattr(problem, name) for name in ("lot", "v_walk", "v_drive", "sensor_model")}
        return Scenario(name="line", occupancy=lasting, **fields)


def free_slots_taken(agent, problem, p_occupied, asked):
    """Drive past taken slots; beside each of the first `asked` ones, ask what the agent would do were it free."""
    lot, belief = problem.lot, SlotBelief.of_forecast(p_occupied, np.zeros(problem.lot.n_slots))
    vertex, memory = int(lot.entry_vertices[0]), None
    takes = np.zeros(asked, np.bool_)
    while vertex != asked - 1:
        action, memory = agent.predict(observation(problem, vertex, belief), memory)
        assert action != PARK, "the agent attempts a taken slot"
        assert problem.action_masks[vertex, action], "the agent waits"
        belief = belief.decay(float(problem.move_s[vertex, action]))
        vertex = int(lot.neighbors[vertex, action])
        if vertex < lot.n_slots:
            free = belief.update([vertex], [False])
            wish, _ = agent.predict(observation(problem, vertex, free), copy.deepcopy(memory))
            takes[vertex] = wish == PARK
            belief = belief.update([vertex], [True])
    return takes


def threshold_of(takes, before):
    near = takes[: before + 1][::-1]
    count = int(near.sum())
    return float(count - 1) if near[:count].all() else math.nan


def takes_of(name, line, **options):
    """Return which free slots of a line an agent takes, (n,) bool; beyond the goal it is asked for a few only."""
    problem = line.problem()
    asked = min(line.n_slots, line.before + 1 + BEYOND_ASKED)
    takes = np.ones(line.n_slots, np.bool_)
    agent = make_agent(name, problem, **options)
    takes[:asked] = free_slots_taken(agent, problem, np.full(line.n_slots, line.q), asked)
    return takes


def threshold(agent, line, **options):
    return threshold_of(takes_of(agent, line, **options), line.before)


def cost_ratio(line):
    best = np.arange(line.n_slots) >= line.before - line.threshold
    return line.mean_cost(takes_of("belief", line, day=False)) / line.mean_cost(best)


@closed_form("Parking on a line without return", "MacQueen & Miller 1960; DeGroot 1970")
def thresholds():
    r"""A car drives along a one-way lane towards its goal and past it. It sees only the slot beside it, each is taken
    with probability \(q\), independently and for good, and there is no way back. A slot \(r\) places before the goal
    costs \(ar\), one \(r\) places beyond it \(br\). Which free slots should it take?

    Beside a free slot at distance \(r\), compare it with the next free one. That one is \(J\) places further, \(P(J =
    j) = (1-q)\,q^{j-1}\), so \(E\min(J, r) = (1-q^r)/(1-q)\) and \(E\max(J-r, 0) = q^r/(1-q)\). It costs

    \[ a\,(r - E\min(J,r)) + b\,E\max(J-r,0) = ar + \frac{(a+b)\,q^r - a}{1-q}, \]

    no less than \(ar\) if and only if \(q^r \ge a/(a+b)\). If this holds at \(r\), it holds at every smaller
    distance: looking one step ahead is optimal (the monotone case of optimal stopping). In time, with slots \(d\)
    apart, driving on saves the walk but costs the drive: \(a = d\,(1/v_w - 1/v_d)\), \(b = d\,(1/v_w + 1/v_d)\), and
    \(a/(a+b) = (1 - v_w/v_d)/2\); `a = b` has \(v_w/v_d = 10^{-4}\).

    Agents drive past taken slots, and beside each one they are asked what they would do were it free. `belief` looks
    ahead at most 400 stops, so at \(q = 0.99\) its rule may cost 0.2 % more than the best one. The thesis's `mdp` plans
    to attempt one slot until it is free, which costs \(c\,q/(1-q)\) more than a slot known to be free, \(c\) the
    failure cost; the best such slot is at the goal, so it takes a free slot at \(r\) if and only if \(ar \le
    c\,q/(1-q)\). At \(c = a\,(r + \frac12)(1-q)/q\) both rules are equal; no
    \(c\) fits all \(q\).
    """
    made = []
    for q, ratio in [*((q, EQUAL_COSTS) for q in CHANCES), (0.9, THESIS_SPEEDS)]:
        line = Line.long(q, ratio)
        name = f"q = {q:g}, {'a = b' if ratio == EQUAL_COSTS else '4 and 10 km/h'}:"
        best = {"failure_s": line.best_failure_s, "gamma": 1.0}
        if q > 0.97:
            case = f"{name} belief, mean cost over the least"
            made.append(Statement(case, 1.0, partial(cost_ratio, line), 0.002, slow=True))
        else:
            found = partial(threshold, "belief", line, day=False)
            made.append(Statement(f"{name} belief, threshold", line.threshold, found))
        case = f"{name} mdp at its best failure cost, threshold"
        made.append(Statement(case, line.threshold, partial(threshold, "mdp", line, **best)))
    usual = math.floor(10.0 * 0.9 / 0.1 / line.before_s)
    case = f"{name} mdp with a failure cost of 10 s, threshold"
    return [*made, Statement(case, usual, partial(threshold, "mdp", line, failure_s=10.0, gamma=1.0))]


def total_times(name, line, seeds, **options):
    scenario = line.scenario()
    runner = EpisodeRunner(scenario, name, make_agent(name, scenario, **options))
    return [runner.run(seed).row["total_s"] for seed in seeds]


SHORT, LONGER = Line(0.5, THESIS_SPEEDS, 4, 20), Line(0.8, THESIS_SPEEDS, 10, 60)


@closed_form("Whole searches on the line", "The same")
def searches():
    r"""Searches in `parkenv/Search-v2` with the best threshold \(r\) take the drive from the entry and \(a\,(r + 1) +
    ((a+b)\,q^{r+1} - a)/(1-q)\) in the mean: the cost of the next free slot, seen from \(r + 1\).
    """
    cautious = {"failure_s": SHORT.best_failure_s, "gamma": 1.0}
    return [
        Statement(
            f"q = {line.q:g}, 4 and 10 km/h: {name}, mean total time of {n} searches, s",
            line.mean_s,
            partial(total_times, name, line, range(first, first + n), **options),
            slow=True,
        )
        for name, line, first, n, options in (
            ("mdp", SHORT, 8000, 1000, cautious),
            ("belief", LONGER, 0, 500, {"day": False}),
        )
    ]


SLOTS, FREE, INSPECTED = 10, (2, 3, 4, 5, 6), 3000


@cache
def inspections():
    """Return for each search how many slots were free, and how many were passed up to the first free one, (n, 2)."""
    scenario = Line(0.6, THESIS_SPEEDS, SLOTS - 1, 0).scenario()
    runner = EpisodeRunner(scenario, "greedy-drive", make_agent("greedy-drive", scenario))
    rows = (runner.run(seed).row for seed in range(INSPECTED))
    return np.array([(round(SLOTS * (1.0 - row["occupancy"])), row["slots_passed"]) for row in rows])


def passed(free):
    seen = inspections()
    return seen[seen[:, 0] == free, 1]


@closed_form("Slots inspected in random order", "Order statistics without replacement")
def random_order():
    r"""If \(m\) of \(n\) slots are free and one inspects them in random order, the mean number of inspections up to the
    first free one is \((n+1)/(m+1)\): the free slots cut the \(n - m\) taken ones into \(m + 1\) stretches of the
    same mean length, \((n-m)/(m+1)\), and the first free slot comes after the first stretch. Ten slots along a lane
    are taken with probability 0.6; given how many are free, those are a random subset, so the order of the lane is a
    random order. `greedy-drive` takes the first free one.
    """
    return [
        Statement(f"{m} of {SLOTS} slots free: inspections", (SLOTS + 1) / (m + 1), partial(passed, m))
        for m in FREE
    ]
