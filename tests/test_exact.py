"""The exact optimum: closed forms, brute force, no agent below it, limits."""

import itertools
from functools import cache

import numpy as np
import pytest
from expected_time import expected_time
from small_lots import small_lot

from parkenv import (
    InputError,
    OccupancyProcess,
    Scenario,
    SensorModel,
    make_scenario,
)
from parkenv.lots import packaged_lot
from parkenv.studies.episodes import EpisodeRunner
from parkenv.world.occupancy.day_error import DayError
from planners import make_agent
from planners.bounds.exact import ExactSolution

BLIND = SensorModel(view_range=0.0)


def brute_force(problem, p, entry):
    """The same optimum with nothing left out: single moves to where something new is seen, no reduction."""
    lot, n = problem.lot, problem.lot.n_slots
    starts, slots = problem.slots_in_view
    view = [frozenset(slots[starts[v] : starts[v + 1]].tolist()) for v in range(lot.n_vertices)]

    def reach(vertex, seen):
        seconds, done = {vertex: 0.0}, set()
        again = problem.wait_s if (lot.neighbors[vertex] < 0).any() else np.inf
        while rest := {v: s for v, s in seconds.items() if v not in done}:
            v = min(rest, key=rest.get)
            done.add(v)
            if view[v] - seen and v != vertex:
                continue
            for m in range(4):
                u = int(lot.neighbors[v, m])
                if u == vertex:
                    again = min(again, seconds[v] + problem.move_s[v, m])
                elif u >= 0:
                    seconds[u] = min(seconds.get(u, np.inf), seconds[v] + problem.move_s[v, m])
        if view[vertex] - seen:
            seconds[vertex] = again
        return seconds

    @cache
    def value(vertex, seen, free):
        if len(seen) == n and not free:
            return problem.give_up_s
        seconds = reach(vertex, seen)
        best = min((seconds[s] + problem.arrival_cost_s[s] for s in free if s in seconds), default=np.inf)
        for v, drive in seconds.items():
            new = sorted(view[v] - seen)
            if not new:
                continue
            total = drive
            for outcome in itertools.product((True, False), repeat=len(new)):
                chance = np.prod(np.where(outcome, 1.0 - p[new], p[new]))
                revealed = frozenset(itertools.compress(new, outcome))
                total += chance * value(v, seen | frozenset(new), free | revealed)
            best = min(best, total)
        return best

    return value(entry, frozenset(), frozenset())


@pytest.mark.parametrize("seed", range(0, 108, 9))
def test_the_reductions_lose_nothing(seed):
    problem, p, entry = small_lot(seed, shapes=((2, 3), (1, 6), (3, 2)))
    assert ExactSolution(problem, p, entry).expected_s == pytest.approx(
        brute_force(problem, p, entry), rel=1e-9
    )


@pytest.mark.parametrize("seed", range(0, 108, 25))
def test_the_agent_takes_as_long_as_it_says_and_nobody_takes_less(seed):
    problem, p, entry = small_lot(seed, shapes=((2, 4), (1, 7), (4, 2)))
    best = ExactSolution(problem, p.astype(np.float32), entry).expected_s
    assert expected_time(make_agent("exact", problem), problem, p, entry) == pytest.approx(best, rel=1e-6)
    for name in ("mdp", "mdp-tuned", "belief", "greedy-goal", "greedy-drive", "first-free"):
        assert expected_time(make_agent(name, problem), problem, p, entry) >= best * (1.0 - 1e-6), name


def test_the_mean_of_searches_in_the_environment_is_the_expectation():
    """The environment follows the rules that the dynamic program assumes."""
    lot = packaged_lot("mini")
    # An hour of equilibrium at 60 %, in which nothing moves while a car searches.
    lasting = OccupancyProcess.from_demand(np.full(lot.n_slots, np.log(1.5)), np.zeros(168), 1e7)
    scenario = Scenario(name="lasting", lot=lot, occupancy=lasting, give_up_s=300.0)
    entry = int(lot.entry_vertices[0])
    runner = EpisodeRunner(scenario, "exact", make_agent("exact", scenario))
    totals = np.array([runner.run(seed).row["total_s"] for seed in range(300)])
    expected = ExactSolution(scenario, np.full(lot.n_slots, 0.6), entry).expected_s
    assert abs(totals.mean() - expected) < 4.0 * totals.std() / np.sqrt(len(totals))


def test_the_agent_copes_with_cars_that_come_and_go():
    scenario = make_scenario("mini")
    busy = scenario.replace(occupancy=scenario.occupancy.at_mean_occupancy(0.9, 10 * 3600.0))
    runner = EpisodeRunner(busy, "exact", make_agent("exact", busy))
    rows = [runner.run(seed).row for seed in range(20)]
    assert all(row["parked"] or row["gave_up_s"] > 0.0 for row in rows)
    assert not any(row["truncated"] for row in rows)


def test_what_is_too_large_or_uncertain_is_refused_with_the_limit():
    problem, p, entry = small_lot(2)
    for make, message in (
        (lambda: make_agent("exact", make_scenario("campus")), "25 slots"),
        (
            lambda: make_agent("exact", make_scenario("mini", sensor_model=SensorModel(hit_rate=0.9))),
            "errors",
        ),
        (lambda: ExactSolution(problem, p, entry, most_states=500), "500"),
        (lambda: ExactSolution(problem, p[:3], entry), "12"),
    ):
        with pytest.raises(InputError, match=message):
            make()


def test_it_goes_on_from_what_it_knows():
    """Knowing where a free slot is can only help; knowing that a slot is taken is worth the time it saves."""
    problem, p, entry = small_lot(1)
    n = len(p)
    blind = ExactSolution(problem, p, entry).expected_s
    slot = int(problem.walk_s.argmin())
    seen = np.arange(n) == slot
    with_free = ExactSolution(problem, p, entry, seen, seen).expected_s
    with_taken = ExactSolution(problem, p, entry, seen, np.zeros(n, dtype=bool)).expected_s
    assert with_free < blind < with_taken
    assert with_taken * p[slot] + with_free * (1.0 - p[slot]) <= blind


def test_a_hidden_day_is_solved_exactly_and_belief_is_within_a_percent_of_it():
    """The day has a hidden level, and on every second lot a hidden slope."""
    times = []
    for seed in range(0, 108, 13):
        problem, p, entry = small_lot(seed, ((1, 6), (2, 4), (1, 7)))
        day_error = DayError(0.8, 0.3 * (seed % 2))
        best = ExactSolution(problem, p, entry, day_error=day_error).expected_s
        exact, belief, mdp = (
            expected_time(make_agent(name, problem), problem, p, entry, day_error)
            for name in ("exact", "belief", "mdp")
        )
        # Observations hold the day error in single precision.
        assert exact == pytest.approx(best, rel=1e-5)
        assert min(belief, mdp) > best * (1 - 1e-5)
        times.append((exact, belief))
    exact, belief = np.mean(times, axis=0)
    assert belief < 1.01 * exact
