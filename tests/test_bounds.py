"""Optima and lower bounds: of small lots exactly, by information relaxation, and of a day of many cars."""

import dataclasses
import itertools
import math

import numpy as np
import pytest
from expected_time import expected_time, optimum_s
from small_lots import small_lot

from parkenv import InputError, OccupancyProcess, Scenario, compare, make_scenario
from parkenv.compiled.keyed_random import world_key
from parkenv.lots import grid_lot, packaged_lot
from parkenv.scenarios.spec import scenario_specs
from parkenv.studies.episodes import EpisodeRunner
from parkenv.studies.fleet.clairvoyant_bound import ParkingDay, clairvoyant_bound_s
from parkenv.studies.fleet.day import Roads
from parkenv.studies.fleet.study import FleetStudy
from parkenv.world.occupancy.day_error import DayError
from parkenv.world.occupancy.process import Arrival, SlotLaw, World
from parkenv.world.scenario import SearchProblem
from parkenv.world.tariff import Zone
from planners import make_agent
from planners.bounds.oracle import best_slot
from planners.bounds.relaxation import SearchBound
from planners.routes import DriveRoutes

SHAPES = ((1, 4), (2, 2), (2, 3), (1, 6), (3, 2), (1, 5))


@pytest.mark.parametrize("seed", range(0, 108, 25))
def test_no_agent_takes_less_than_the_optimum(seed):
    problem, p, entry = small_lot(seed, shapes=((2, 4), (1, 7), (4, 2)))
    best = optimum_s(problem, p.astype(np.float32), entry)
    for name in ("mdp", "mdp-tuned", "belief", "greedy-goal", "greedy-drive", "first-free"):
        assert expected_time(make_agent(name, problem), problem, p, entry) >= best * (1.0 - 1e-6), name


def test_the_mean_of_searches_in_the_environment_is_the_expectation():
    """The environment follows the rules that expected times assume."""
    lot = packaged_lot("mini")
    # An hour of equilibrium at 60 %, in which nothing moves while a car searches.
    lasting = OccupancyProcess.from_demand(np.full(lot.n_slots, np.log(1.5)), np.zeros(168), 1e7)
    scenario = Scenario(name="lasting", lot=lot, occupancy=lasting, give_up_s=300.0)
    entry = int(lot.entry_vertices[0])
    agent = make_agent("belief", scenario, day=False)
    runner = EpisodeRunner(scenario, "belief", agent)
    totals = np.array([runner.run(seed).row["total_s"] for seed in range(300)])
    expected = expected_time(agent, scenario.public(), np.full(lot.n_slots, 0.6), entry)
    assert abs(totals.mean() - expected) < 4.0 * totals.std() / np.sqrt(len(totals))


def test_belief_is_within_a_percent_of_the_optimum_where_the_day_is_hidden():
    """The day has a hidden level, and on every second lot a hidden slope."""
    times = []
    for seed in range(0, 108, 13):
        problem, p, entry = small_lot(seed, ((1, 6), (2, 4), (1, 7)))
        day_error = DayError(0.8, 0.3 * (seed % 2))
        best = optimum_s(problem, p, entry, day_error)
        belief, mdp = (
            expected_time(make_agent(name, problem), problem, p, entry, day_error)
            for name in ("belief", "mdp")
        )
        # Observations hold the day error in single precision.
        assert min(belief, mdp) > best * (1 - 1e-5)
        times.append((best, belief))
    best, belief = np.mean(times, axis=0)
    assert belief < 1.01 * best


class StillWorld(World):
    """Slots that stay as they are."""

    def __init__(self, taken, p_taken):
        self.taken = np.asarray(taken)
        none = np.zeros((2, len(self.taken)))
        self._law = SlotLaw(np.asarray(p_taken), none, none, 3600.0)

    def occupied(self, slots, time):
        return self.taken[slots]

    def next_free(self, slots, time):
        return np.where(self.taken[slots], np.inf, time)

    def sojourn(self, slots, time):
        return np.ones(np.size(slots), np.int64)

    def law(self):
        return self._law


def means(problem, p_taken, entry, most_states=4_000):
    """The optimum, the bound and the clairvoyant bound, over all worlds that there are."""
    routes, bound, mean, clairvoyant = DriveRoutes(problem), SearchBound(problem, most_states), 0.0, 0.0
    for taken in itertools.product((False, True), repeat=problem.lot.n_slots):
        world = StillWorld(taken, p_taken)
        chance = np.prod(np.where(taken, p_taken, 1.0 - p_taken))
        mean += chance * bound.of_world(world, entry, 0.0)
        best = best_slot(problem, routes, world, entry, 0.0).total_s
        clairvoyant += chance * min(best, problem.give_up_s)
    return optimum_s(problem, p_taken, entry), mean, clairvoyant


def test_it_is_between_the_clairvoyant_bound_and_the_optimum_and_lower_in_coarser_groups():
    best, bound, clairvoyant = np.array([means(*small_lot(seed, SHAPES)) for seed in range(12)]).T
    assert (bound <= best + 1e-3).all()
    assert (best - bound).mean() < 0.25 * (best - clairvoyant).mean()
    problem, p_taken, entry = small_lot(4, SHAPES)
    best, fine, clairvoyant = means(problem, p_taken, entry)
    _, coarse, _ = means(problem, p_taken, entry, most_states=1)
    assert coarse <= fine + 1e-3 <= best + 2e-3
    assert coarse >= clairvoyant - 1e-3


def test_the_law_of_a_world_is_that_of_its_slots_on_its_day():
    scenario = make_scenario("campus")
    model, slots = scenario.occupancy, np.arange(scenario.lot.n_slots)
    arrival = Arrival(36_000.0 - 100.0)  # the hour ends on the way
    taken, after, stayed = [], [], []
    for seed in range(300):
        world = model.world(world_key(seed, 0), arrival)
        law, here = world.law(), world.occupied(slots, arrival.time)
        taken.append((here - law.p_taken).mean())
        after.append((world.occupied(slots, arrival.time + 900.0) - law.p_taken_after(900.0)).mean())
        stays = law.stays(0.0, 900.0)
        stayed.append(((world.next_free(slots, arrival.time) > arrival.time + 900.0) - stays)[here].mean())
    for differences in (taken, after, stayed):
        assert abs(np.mean(differences)) < 4.0 * np.std(differences) / np.sqrt(len(differences))
        assert np.std(differences) < 0.06


def test_it_is_compared_with_agents_and_drives_no_car():
    run = compare(agents=["bound", "belief"], scenarios=["mini"], episodes=8, jobs=1, figures=False)
    rows = {row["agent"]: row for row in run.rows}
    assert rows["belief"]["gap_to_bound"] == rows["belief"]["total_s"] / rows["bound"]["total_s"] - 1.0
    assert rows["belief"]["leads"]
    assert not rows["bound"]["leads"]
    with pytest.raises(InputError, match="bound"):
        SearchBound(make_scenario("mini")).predict({})


def test_a_driver_who_may_park_nowhere_gives_up():
    rules = {"permits": Zone("permits", users=("permit-a",))}
    lot = dataclasses.replace(grid_lot(1, 4), slot_zone=np.full(4, "permits"), zone_rules=rules)
    problem = SearchProblem(lot=lot, give_up_s=600.0)
    assert SearchBound(problem).of_world(StillWorld([False] * 4, np.zeros(4)), 0, 0.0) == 600.0


def best_schedule_s(day):
    n_cars, slots = len(day.arrival), range(len(day.cost_s))

    def total_s(places):
        groups = [[car for car in range(n_cars) if places[car] == slot] for slot in slots]
        orders = [[in_order_s(day, s, order) for order in itertools.permutations(groups[s])] for s in slots]
        return day.give_up_s * places.count(-1) + sum(map(min, orders))

    return min(map(total_s, itertools.product((-1, *slots), repeat=n_cars)))


def in_order_s(day, slot, cars):
    free_from, total = day.free_from[slot], 0.0
    for car in cars:
        parks_at = max(free_from, day.arrival[car] + day.drive_s[day.entry[car], slot])
        if parks_at > day.arrival[car] + day.patience_s[car]:
            return math.inf
        price_s = day.zone_cost_s[car, day.zone[slot]]
        total += parks_at - day.arrival[car] + day.cost_s[slot] + price_s
        free_from = parks_at + day.stay_s[car]
    return total


def random_day(rng):
    n_cars, n_slots, n_entries = rng.integers(1, 5), rng.integers(1, 4), rng.integers(1, 3)
    free_from = rng.uniform(0.0, 900.0, n_slots)
    free_from[rng.random(n_slots) < 0.5] = -math.inf
    free_from[rng.random(n_slots) < 0.1] = math.inf
    drive_s = rng.uniform(5.0, 60.0, (n_entries, n_slots))
    drive_s[rng.random(drive_s.shape) < 0.1] = math.inf
    return ParkingDay(
        arrival=np.sort(rng.uniform(0.0, 900.0, n_cars)) + rng.choice([0.0, 1e6]),
        stay_s=rng.exponential(rng.choice([200.0, 2000.0]), n_cars),
        patience_s=np.full(n_cars, rng.choice([50.0, 400.0, math.inf])),
        entry=rng.integers(0, n_entries, n_cars),
        drive_s=drive_s,
        cost_s=rng.uniform(5.0, 120.0, n_slots),
        free_from=free_from,
        zone=rng.integers(0, 2, n_slots),
        zone_cost_s=rng.uniform(0.0, 200.0, (n_cars, 2)) * rng.choice([0.0, 1.0]),
        give_up_s=float(rng.choice([200.0, 1800.0])),
    )


@pytest.mark.slow
def test_it_is_never_above_the_best_schedule_of_a_tiny_day():
    rng = np.random.default_rng(1)
    days = [random_day(rng) for _ in range(45)]
    ratios = np.array([clairvoyant_bound_s(day) / best_schedule_s(day) for day in days])
    assert (ratios <= 1.0).all()
    assert np.median(ratios) > 0.95


def test_without_competition_it_is_the_time_of_each_car_alone():
    day = ParkingDay(
        arrival=np.array([0.0, 10_000.0]), stay_s=np.full(2, 600.0), patience_s=np.full(2, math.inf),
        entry=np.array([0, 1]), drive_s=np.array([[10.0, 20.0], [20.0, 10.0]]), cost_s=np.array([30.0, 30.0]),
        free_from=np.full(2, -math.inf), zone=np.zeros(2, np.int64), zone_cost_s=np.zeros((2, 1)),
        give_up_s=900.0,
    )  # fmt: skip
    assert clairvoyant_bound_s(day) == pytest.approx(80.0)
    later = day._replace(arrival=day.arrival + 5e5, free_from=day.free_from + 5e5)
    assert clairvoyant_bound_s(later) == pytest.approx(80.0)
    assert clairvoyant_bound_s(day._replace(free_from=np.full(2, math.inf))) == pytest.approx(1800.0)


@pytest.mark.parametrize(
    ("stay_s", "give_up_s", "least_s", "best_s"),
    [(math.inf, 900.0, 60.0, 930.0), (600.0, 100.0, 100.0, 130.0)],
)
def test_a_stay_may_end_after_the_day(stay_s, give_up_s, least_s, best_s):
    day = ParkingDay(
        arrival=np.array([0.0, 5.0]), stay_s=np.full(2, stay_s), patience_s=np.full(2, 600.0),
        entry=np.zeros(2, np.int64), drive_s=np.array([[10.0]]), cost_s=np.array([20.0]),
        free_from=np.array([-math.inf]), zone=np.zeros(1, np.int64), zone_cost_s=np.zeros((2, 1)), give_up_s=give_up_s,
    )  # fmt: skip
    assert least_s < clairvoyant_bound_s(day) <= best_schedule_s(day) == best_s


@pytest.mark.parametrize("knows", ["own", "reserve", "full"])
def test_no_fleet_is_below_it(knows):
    (scenario,) = scenario_specs("mini")
    scenario = scenario.changed(arrivals={"hours": "08:00-09:00", "days": "weekdays"})
    scenario = scenario.changed(costs={"prices": {} if knows == "own" else {"other": 1.0}})
    study = FleetStudy().changed(scenario=scenario, knows=(knows,), arrivals_per_hour=(8.0, 40.0))
    roads = Roads(study.built["mini"])
    for setting in study.fleet_settings:
        for day in range(2):
            fleet, agents = study.fleet(setting)
            fleet.reset(2, day)
            bound_s = clairvoyant_bound_s(roads.parking_day(fleet))
            fleet.run(agents)
            assert roads.alone_s(fleet).sum() - 1e-4 <= bound_s <= fleet.cars["total_s"].sum()
