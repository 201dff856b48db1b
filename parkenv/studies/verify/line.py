"""Parking on a line without return: MacQueen and Miller's threshold, DeGroot's optimal stopping.

A car drives along a one-way lane past the goal. It observes a slot only when it is beside it, every slot is taken with
probability q, independently and for good, and there is no way back. A slot at distance r (in slots) before the goal
costs a·r, one at distance r beyond it b·r. Take a free slot at distance r if and only if q^r >= a/(a + b).

In time, with slots d apart: driving on saves the walk but costs the drive, so that a = d(1/v_walk - 1/v_drive) and
b = d(1/v_walk + 1/v_drive): a/(a + b) = (1 - v_walk/v_drive)/2.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from parkenv.belief.slot_belief import SlotBelief
from parkenv.compiled.arrays import FloatArray
from parkenv.lots.generators import KERB_SIZE, ONE_WAY_HALF_WIDTH, Slots, kerb_rows
from parkenv.studies.episodes import EpisodeRunner
from parkenv.studies.verify.rows import Row, Task, certain_row, mean_row
from parkenv.world.lot import PARK, Lane, ParkingLot
from parkenv.world.occupancy.process import OccupancyProcess
from parkenv.world.scenario import KMH, Scenario, SearchProblem
from parkenv.world.sensor_model import SensorModel
from parkenv.world.week import WEEK_HOURS
from planners.agent import Agent, make_agent

SOURCE = "MacQueen & Miller 1960, DeGroot 1970"
THESIS = "T §3.4, own derivation"
PITCH = KERB_SIZE[0]  # distance between slots, m
V_WALK = 4 * KMH
EQUAL_COSTS = 1e-4
"""v_walk/v_drive at which a and b are equal to one in ten thousand: the textbook's case."""
THESIS_SPEEDS = 0.4  # v_walk/v_drive of the thesis, 4 and 10 km/h
CHANCES = (0.5, 0.75, 0.8, 0.85, 0.9, 0.95, 0.99)
FOREVER_S = 1e12  # mean stay, s, of a world in which nothing changes
PIECE = 16  # slots of a piece of the line that `exact` solves at once
BEYOND_ASKED = 10  # slots beyond the goal for which agents are asked whether they take them
FARTHEST_SIGHT = 0.97
"""q from which `belief` cannot see the end: it looks ahead at most 400 stops, and extrapolates from there."""
SEARCHES = 8000  # of `exact` and of `mdp`; half as many of `belief`
BELIEF_TOLERANCE = 0.002  # share of the least mean cost by which its rule may then be worse


@dataclass(frozen=True)
class Line:
    """A line of slots through the goal.

    Args:
        q: probability that a slot is taken.
        ratio: v_walk/v_drive.
        before: number of slots before the one at the goal.
        beyond: number of slots beyond it; with q^beyond close to 0 the line's end does not matter.
    """

    q: float
    ratio: float
    before: int
    beyond: int

    @classmethod
    def long(cls, q: float, ratio: float) -> Line:
        """Return a line that is long enough for a given q: its end matters with a probability below 1e-6."""
        return cls(q, ratio, math.ceil(4.0 / (1.0 - q)), math.ceil(14.0 / (1.0 - q)))

    @property
    def before_s(self) -> float:
        """The cost a of a slot's distance before the goal, s."""
        return PITCH / V_WALK * (1.0 - self.ratio)

    @property
    def beyond_s(self) -> float:
        """The cost b of a slot's distance beyond the goal, s."""
        return PITCH / V_WALK * (1.0 + self.ratio)

    @property
    def threshold(self) -> int:
        """The farthest distance before the goal, in slots, at which a free slot is taken."""
        part = self.before_s / (self.before_s + self.beyond_s)
        return math.floor(math.log(part) / math.log(self.q))

    @property
    def mean_s(self) -> float:
        """Mean total time, s, from the entry, one slot before the first one, with that threshold."""
        r = min(self.threshold, self.before) + 1
        a, b, free = self.before_s, self.beyond_s, 1.0 - self.q
        drive_s = (self.before + 1) * PITCH / V_WALK * self.ratio
        return drive_s + a * r - a * (1.0 - self.q**r) / free + b * self.q**r / free

    def mean_cost(self, takes: NDArray[np.bool_]) -> float:
        """Return the mean cost, s, of a rule: which free slots it takes, (n,) bool, from the first one on."""
        distance = self.before - np.arange(len(takes))
        cost_s = np.where(distance > 0, self.before_s, -self.beyond_s) * distance
        chance = np.where(takes, 1.0 - self.q, 0.0)
        reached = np.concatenate([[1.0], np.cumprod(1.0 - chance)[:-1]])
        return float((reached * chance * cost_s).sum() / (reached * chance).sum())

    def lot(self, slots: NDArray[np.integer] | slice = slice(None), rest_s: float = 0.0) -> ParkingLot:
        """Return the lot, or a piece of it that begins at the first of `slots`.

        Args:
            slots: which slots, in driving order.
            rest_s: parking cost of the last one.
        """
        n, kerb_y = self.before + 1 + self.beyond, -ONE_WAY_HALF_WIDTH
        west, east = (self.before + 0.5) * -PITCH, (self.beyond + 0.5) * PITCH
        kerb = np.array([[west, kerb_y]]), np.array([[east, kerb_y]])
        row = kerb_rows(*kerb, np.array([False]))[0]
        numbers = np.arange(n)[slots]
        cost_s = np.zeros(len(numbers))
        cost_s[-1] = rest_s
        chosen = row[numbers]
        columns = Slots(chosen.xy, chosen.yaw, chosen.length, chosen.width, chosen.mouth, cost_s).columns()
        entry = np.array([[chosen.xy[0, 0] - PITCH, 0.0]])
        return ParkingLot(
            name="line",
            slot_ids=tuple(str(self.before - i) for i in numbers),
            **columns,
            lanes=(Lane(np.array([entry[0], [east + PITCH, 0.0]]), oneway=True),),
            entries=entry,
            goals=np.array([[0.0, row.xy[0, 1]]]),
        )

    def problem(self, lot: ParkingLot) -> SearchProblem:
        """Return the search on a lot of this line: slots are observed from beside them only."""
        return SearchProblem(
            lot=lot, v_walk=V_WALK, v_drive=V_WALK / self.ratio, sensor_model=SensorModel(view_range=0.0)
        )

    def scenario(self) -> Scenario:
        """Return the world of this line, in which nothing changes during a search."""
        lot = self.lot()
        odds = math.log(self.q / (1.0 - self.q))
        lasting = OccupancyProcess.from_demand(np.full(lot.n_slots, odds), np.zeros(WEEK_HOURS), FOREVER_S)
        problem = self.problem(lot)
        return Scenario(
            name="line",
            lot=lot,
            v_walk=problem.v_walk,
            v_drive=problem.v_drive,
            sensor_model=problem.sensor_model,
            occupancy=lasting,
        )


def free_slots_taken(
    agent: Agent, problem: SearchProblem, p_occupied: FloatArray, asked: int
) -> NDArray[np.bool_]:
    """Return which of the first `asked` slots an agent takes if they are free, given that all before were taken.

    The agent drives along the line past taken slots; beside each one it is also asked what it would do were it free.
    """
    lot, belief = problem.lot, SlotBelief.of_forecast(p_occupied, np.zeros(problem.lot.n_slots))
    vertex, memory = int(lot.entry_vertices[0]), None
    takes = np.zeros(asked, np.bool_)
    while vertex != asked - 1:
        action, memory = agent.predict(_observation(problem, vertex, belief), memory)
        assert action != PARK, "the agent attempts a taken slot"
        assert problem.action_masks[vertex, action], "the agent waits"
        belief = belief.decay(float(problem.move_s[vertex, action]))
        vertex = int(lot.neighbors[vertex, action])
        if vertex < asked:
            free = belief.update([vertex], [False])
            wish, _ = agent.predict(_observation(problem, vertex, free), copy.deepcopy(memory))
            takes[vertex] = wish == PARK
            belief = belief.update([vertex], [True])
    return takes


def _observation(problem: SearchProblem, vertex: int, belief: SlotBelief) -> dict[str, Any]:
    return {
        "vertex": np.int64(vertex),
        "time": np.array([belief.time, belief.time], dtype=np.float32),
        "action_mask": problem.action_masks[vertex],
        **belief.to_observation(),
    }


def threshold_of(takes: NDArray[np.bool_], before: int) -> float:
    """Return the farthest distance before the goal at which free slots are taken; nan if a nearer one is not."""
    near = takes[: before + 1][::-1]
    count = int(near.sum())
    return float(count - 1) if near[:count].all() else math.nan


def takes_of(name: str, line: Line, **options: Any) -> NDArray[np.bool_]:
    """Return which free slots of a line an agent takes, (n,) bool; beyond the goal it is asked for a few only."""
    problem = line.problem(line.lot())
    n = problem.lot.n_slots
    asked = min(n, line.before + 1 + BEYOND_ASKED)
    p_occupied = np.full(n, line.q)
    takes = np.ones(n, np.bool_)
    takes[:asked] = free_slots_taken(make_agent(name, problem, **options), problem, p_occupied, asked)
    return takes


def exact_takes(line: Line) -> NDArray[np.bool_]:
    """Return which free slots of a line `exact` takes, (n,) bool.

    It solves lots of up to 25 slots. Without a way back, what follows a piece of the line does not depend on what was
    observed in it. So the rest of the line is one more slot, which is always free and costs as much as the rest takes.
    For pieces before the goal it is at the goal, since a car that drives on has not parked before the piece ends.
    """
    n = line.before + 1 + line.beyond
    takes = np.ones(n, np.bool_)
    rest_s, end = 0.0, n - 1
    while end > 0:
        start, rest = max(0, end - PIECE), max(end, line.before)
        numbers = np.append(np.arange(start, end), rest)
        problem = line.problem(line.lot(numbers))
        if end < n - 1:
            own_s = (rest - end) * PITCH / problem.v_drive + problem.walk_s[-1]
            problem = line.problem(line.lot(numbers, rest_s - own_s))
        agent = make_agent("exact", problem)
        p_occupied = np.append(np.full(end - start, line.q), 0.0)
        takes[start:end] = free_slots_taken(agent, problem, p_occupied, end - start)
        belief, entry = (
            SlotBelief.of_forecast(p_occupied, np.zeros(len(numbers))),
            problem.lot.entry_vertices[0],
        )
        _, memory = agent.predict(_observation(problem, int(entry), belief))
        rest_s = memory.solution.expected_s - PITCH / problem.v_drive
        end = start
    return takes


def exact_row(q: float, ratio: float) -> list[Row]:
    """Return the row of `exact` on a line."""
    line = Line.long(q, ratio)
    return [_threshold_row("exact", line, line.threshold, exact_takes(line), SOURCE)]


def belief_row(q: float, ratio: float) -> list[Row]:
    """Return the row of `belief` on a line; on the longest lines, that of the mean cost of its rule."""
    line = Line.long(q, ratio)
    takes = takes_of("belief", line, day=False)
    if q < FARTHEST_SIGHT:
        return [_threshold_row("belief", line, line.threshold, takes, SOURCE)]
    best = np.arange(len(takes)) >= line.before - line.threshold
    found = line.mean_cost(takes) / line.mean_cost(best)
    case = f"line, q = {q:g}, {_speeds(ratio)}: belief, mean cost over the least"
    return [certain_row(case, 1.0, found, SOURCE, tolerance=BELIEF_TOLERANCE)]


def mdp_row(q: float, ratio: float, failure_s: float | None = None) -> list[Row]:
    """Return the row of the thesis's planner on a line.

    It plans to drive to one slot and to attempt it until it is free, which costs failure_s·q/(1 - q) more than a slot
    known to be free. The best such slot is the one at the goal, so it takes a free slot at distance r if and only if
    a·r <= failure_s·q/(1 - q).

    Args:
        q: probability that a slot is taken.
        ratio: v_walk/v_drive.
        failure_s: failure cost, s; None: the one that makes this rule the optimum.
    """
    line = Line.long(q, ratio)
    odds = q / (1.0 - q)
    if failure_s is None:
        cost_s, expected, label = best_failure_s(line), line.threshold, "at its best failure cost"
    else:
        cost_s, expected = failure_s, math.floor(failure_s * odds / line.before_s)
        label = f"with a failure cost of {failure_s:g} s"
    takes = takes_of("mdp", line, failure_s=cost_s, gamma=1.0)
    return [_threshold_row(f"mdp {label}", line, expected, takes, SOURCE if failure_s is None else THESIS)]


def best_failure_s(line: Line) -> float:
    """Return a failure cost, s, with which the thesis's planner has the threshold of the line."""
    return line.before_s * (line.threshold + 0.5) * (1.0 - line.q) / line.q


def _threshold_row(agent: str, line: Line, expected: int, takes: NDArray[np.bool_], source: str) -> Row:
    case = f"line, q = {line.q:g}, {_speeds(line.ratio)}: {agent}, threshold"
    return certain_row(case, expected, threshold_of(takes, line.before), source)


def _speeds(ratio: float) -> str:
    return "a = b" if ratio == EQUAL_COSTS else "4 and 10 km/h"


def searches_row(name: str, line: Line, episodes: int, seed: int, **options: Any) -> list[Row]:
    """Return the row of the mean total time of searches on a line in `parkenv/Search-v2`."""
    scenario = line.scenario()
    runner = EpisodeRunner(scenario, name, make_agent(name, scenario, **options))
    total_s = [runner.run(s).row["total_s"] for s in range(seed, seed + episodes)]
    case = f"line, q = {line.q:g}, {_speeds(line.ratio)}: {name}, mean total time of {episodes} searches, s"
    return [mean_row(case, line.mean_s, total_s, SOURCE)]


def _line(seed: int) -> list[Task]:
    short, longer = Line(0.5, THESIS_SPEEDS, 4, 20), Line(0.8, THESIS_SPEEDS, 10, 60)
    cautious = {"failure_s": best_failure_s(short), "gamma": 1.0}
    return [
        *(partial(row, q, EQUAL_COSTS) for row in (exact_row, belief_row, mdp_row) for q in CHANCES),
        partial(exact_row, 0.9, THESIS_SPEEDS),
        partial(belief_row, 0.9, THESIS_SPEEDS),
        partial(mdp_row, 0.9, THESIS_SPEEDS),
        partial(mdp_row, 0.9, THESIS_SPEEDS, 10.0),
        partial(searches_row, "exact", short, SEARCHES, seed),
        partial(searches_row, "mdp", short, SEARCHES, seed + 8000, **cautious),
        partial(searches_row, "belief", longer, SEARCHES // 2, seed, day=False),
    ]


# Slots inspected in random order

SLOTS = 10
TAKEN = 0.6  # probability that a slot is taken: all numbers of free slots from 2 to 6 are frequent
FREE = (2, 3, 4, 5, 6)
INSPECTED = 24_000  # searches


def inspections(first: int, episodes: int) -> list[tuple[int, int]]:
    """Return for each search how many slots were free, and how many were inspected up to the first free one.

    All slots are equally likely to be free, so given how many are, those are a random subset: slots in the order of the
    lane are slots in random order. `greedy-drive` inspects one after the other.
    """
    scenario = Line(TAKEN, THESIS_SPEEDS, SLOTS - 1, 0).scenario()
    runner = EpisodeRunner(scenario, "greedy-drive", make_agent("greedy-drive", scenario))
    rows = (runner.run(seed).row for seed in range(first, first + episodes))
    return [(round(SLOTS * (1.0 - row["occupancy"])), row["slots_passed"]) for row in rows]


def inspection_rows(seed: int) -> list[Row]:
    """Return a row for each number of free slots, all from the same searches.

    If m of n slots are free, (n + 1)/(m + 1) are inspected until a free one: the m free slots cut the other n - m into
    m + 1 stretches. In a random order all stretches have the same mean length, (n - m)/(m + 1), and the first free slot
    comes right after the first stretch.
    """
    found = np.array(inspections(seed, INSPECTED))
    return [
        mean_row(
            f"inspections, {m} of {SLOTS} slots free: greedy-drive",
            (SLOTS + 1) / (m + 1),
            found[found[:, 0] == m, 1],
            "order statistics without replacement",
        )
        for m in FREE
    ]


CASES: dict[str, Callable[[int], list[Task]]] = {
    "line": _line,
    "inspections": lambda seed: [partial(inspection_rows, seed)],
}
"""The tasks of each case, from the first seed."""
