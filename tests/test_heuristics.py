"""Heuristic baselines: agents against a plain reference, compiled policies against agents, to the last bit."""

import itertools

import gymnasium as gym
import numpy as np
import pytest
from small_lots import cut_in_two, driven, features, small_lot

import parkenv
from parkenv import OccupancyProcess, Scenario, SearchProblem, SensorBand, SensorModel
from parkenv.belief.slot_belief import OBSERVED_FREE, OBSERVED_TAKEN, SlotBelief
from parkenv.engine.fleet import DriverKind, Fleet
from parkenv.world.demand import ConstantTime, Demand, ExponentialTime, Headways
from parkenv.world.lot import PARK, ParkingLot
from parkenv.world.tariff import Zone
from planners import make_agent
from planners.heuristics import POLICIES
from planners.routes import DriveRoutes

NAMES = ("greedy-goal", "greedy-drive", "greedy-total", "first-free")
COMPILED = (*NAMES, "usual")
NOISY = SensorModel(15, bands=(SensorBand(15, True, 0.9, 0.8, 0.1), SensorBand(15, False, 0.8, 0.8, 0.2)))


def reference_target(name, problem, routes, belief, vertex, previous):
    """The slot to drive to, by its definition."""
    n = problem.lot.n_slots
    seconds = routes.seconds_from(vertex)[:n]
    cost_s, reachable = problem.arrival_cost_s, np.isfinite(seconds)
    state = recent_state(belief)
    candidates = (state != OBSERVED_TAKEN) & reachable
    good = (state == OBSERVED_FREE) & (cost_s <= np.median(cost_s)) & reachable
    kept = previous >= 0 and state[previous] != OBSERVED_TAKEN
    if name == "greedy-total" and candidates.any() and not (kept and state[previous] == OBSERVED_FREE):
        return first(candidates, np.where(state == OBSERVED_FREE, 1.0, 3.0) * seconds + cost_s)
    if name == "first-free" and good.any() and not (kept and state[previous] == OBSERVED_FREE):
        return first(good, seconds)
    if kept:
        return previous
    if not candidates.any():
        others = reachable & (np.arange(n) != vertex)
        return first(others, belief.p_occupied) if others.any() else vertex
    if name == "greedy-goal" or (name == "first-free" and previous < 0):
        return first(candidates, cost_s, seconds)
    return first(candidates, seconds, cost_s) if name == "greedy-drive" else first(candidates, seconds)


def recent_state(belief):
    """What was observed of each slot, unless the belief has forgotten that it was taken."""
    decayed = (belief.p_occupied == belief.forecast) & (belief.p_observed != belief.forecast)
    return np.where((belief.state == OBSERVED_TAKEN) & decayed, 0, belief.state)


def first(slots, *keys):
    """The slot with the least keys, the second one among equals of the first one, and then the least index."""
    indices = np.flatnonzero(slots)
    return int(indices[np.lexsort([key[indices] for key in reversed(keys)])[0]])


def drive_s(problem, path):
    """Drive time along vertices."""
    neighbors, move_s = problem.lot.neighbors, problem.move_s
    return sum(move_s[u][neighbors[u] == v].min() for u, v in itertools.pairwise(path))


def random_belief(rng, problem):
    """A belief in which slots were observed at any time with sharp or dull sensors, some long ago."""
    n = problem.lot.n_slots
    belief = SlotBelief.of_forecast(rng.uniform(0.01, 0.99, n), rng.choice([1e-3, 0.5], n))
    for _ in range(rng.integers(4)):
        slots = np.flatnonzero(rng.random(n) < rng.choice([0.2, 0.6, 1.0]))
        hit, false_alarm = rng.choice([(1.0, 0.0), (0.8, 0.3)])
        belief = belief.update(slots, rng.random(len(slots)) < 0.7, hit, false_alarm)
        belief = belief.decay(rng.choice([3.0, 60.0]))
    observation = belief.to_observation()
    return SlotBelief(observation["p_occupied"], observation["belief"], float(np.float32(belief.time)))


@pytest.mark.parametrize("name", NAMES)
def test_agents_decide_as_the_definition_of_their_rule(name):
    rng, decisions = np.random.default_rng(1), 0
    for seed in range(20):
        problem = small_lot(seed)[0]
        if seed % 10 == 9:
            problem = SearchProblem(lot=cut_in_two())
        routes, agent = DriveRoutes(problem), make_agent(name, problem)
        entry = int(problem.lot.entry_vertices[0])
        for _ in range(25):
            vertex, target = entry, -1
            memory = agent.begin({}, None)
            for _ in range(3):
                belief = random_belief(rng, problem)
                target = reference_target(name, problem, routes, belief, vertex, target)
                action = agent.decide({"vertex": vertex}, belief, memory)
                assert memory.target == target
                path = (vertex, *agent.plan_preview({"vertex": vertex}, action, memory))
                assert path[-1] == target
                assert drive_s(problem, path) == pytest.approx(routes.seconds_from(vertex)[target])
                assert problem.lot.neighbors[vertex, action] == path[1] if len(path) > 1 else action == PARK
                decisions += 1
                if action == PARK:
                    break
                vertex = int(problem.lot.neighbors[vertex, action])
    assert decisions > 1000


def one_way_places(problem):
    """Runs of slots between junctions, for a lot of one-way streets in one zone."""
    neighbors, n = problem.lot.neighbors, problem.lot.n_slots
    places = []
    for v in neighbors[n:][neighbors[n:] >= 0].tolist():
        run = []
        while v < n:
            run.append(v)
            (v,) = neighbors[v][neighbors[v] >= 0].tolist()
        places += [run] if run else []
    return places


def test_usual_heads_for_the_place_of_the_lowest_index():
    problem = parkenv.make_scenario("street").public()
    routes, agent, rng = DriveRoutes(problem), make_agent("usual", problem), np.random.default_rng(2)
    places, n = one_way_places(problem), problem.lot.n_slots
    for vertex in rng.integers(n, problem.lot.n_vertices, 60).tolist():
        belief, seconds = random_belief(rng, problem), routes.seconds_from(vertex)
        state = recent_state(belief)
        indices = {s: seconds[s] + problem.arrival_cost_s[s] for s in np.flatnonzero(state == OBSERVED_FREE)}
        seen = belief.state != 0
        level = (1.0 + np.sum(belief.state == OBSERVED_FREE)) / (1.0 + np.sum(1.0 - belief.forecast[seen]))
        for run in places:
            if unseen := [s for s in run if state[s] == 0]:
                middle = run[(run.index(unseen[0]) + run.index(unseen[-1])) // 2]
                p = float(belief.forecast[middle])
                q = 1.0 - (p / (p + (1.0 - p) * level)) ** len(unseen)
                drive = (seconds[unseen[0]] + seconds[unseen[-1]]) / 2.0
                indices[unseen[-1]] = problem.arrival_cost_s[middle] + drive / q
        memory = agent.begin({"vertex": vertex}, belief)
        action = agent.decide({"vertex": vertex}, belief, memory)
        assert indices[memory.target] == pytest.approx(min(indices.values()))
        path = (vertex, *agent.plan_preview({"vertex": vertex}, action, memory))
        assert path[-1] == memory.target
        assert drive_s(problem, path) == pytest.approx(seconds[memory.target])


def test_usual_tries_every_full_street_once_before_it_gives_up():
    scenario = parkenv.make_scenario("street")
    n = scenario.lot.n_slots
    worlds = (OccupancyProcess.from_demand(np.full(n, level), np.zeros(168), 1800.0) for level in (0.5, 12.0))
    forecast, full = worlds
    scenario = scenario.replace(occupancy=full, prior=forecast)
    place = {slot: i for i, run in enumerate(one_way_places(scenario.public())) for slot in run}
    agent, env = make_agent("usual", scenario), gym.make("parkenv/Search-v2", scenario=scenario)
    for seed in range(3):
        observation, _ = env.reset(seed=seed)
        state, over, tried = None, False, []
        while not over:
            action, state = agent.predict(observation, state)
            if not tried or tried[-1] != state.target:
                tried.append(state.target)
            observation, _, over, truncated, _ = env.step(action)
            assert not truncated
        seen = [place[slot] for slot in tried]
        assert len(seen) > 10
        assert len(set(seen)) == len(seen)


@pytest.mark.parametrize("name", COMPILED)
def test_nobody_heads_for_a_slot_that_is_not_allowed(name):
    lot = parkenv.make_scenario("campus").lot
    zone = np.where(np.arange(lot.n_slots) % 5 == 0, "open", "permits")
    rules = {"open": Zone("open"), "permits": Zone("permits", users=("permit-a",))}
    lot = ParkingLot(**features(lot) | {"slot_zone": zone, "zone_rules": rules})
    scenario = parkenv.make_scenario("campus").replace(lot=lot)
    for policy, agents in ((POLICIES[name], None), (None, [make_agent(name, scenario)])):
        fleet = Fleet(scenario, Demand(Headways(8)), background="none", drivers=[DriverKind(policy=policy)])
        slots = driven(fleet, 1, agents=agents).cars["slot"]
        assert (slots >= 0).all()
        assert (slots % 5 == 0).all()


def random_world(seed):
    """A small lot, cars that compete for it, what they know, and options of the fleet."""
    rng = np.random.default_rng([5, seed])
    problem, p, _ = small_lot(seed)
    process = OccupancyProcess.from_demand(np.log(p / (1 - p)), np.zeros(168), rng.choice([20.0, 900.0]))
    fields = {name: getattr(problem, name) for name in ("lot", "v_drive", "v_walk", "give_up_s")}
    sensor = NOISY if seed % 3 == 0 else problem.sensor_model
    scenario = Scenario(**fields, name="small", occupancy=process, sensor_model=sensor)
    demand = Demand(Headways(int(rng.integers(1, 12)), 10.0), ExponentialTime(300.0), ConstantTime(400.0))
    kind = {"knows": ("own", "shared", "full", "reserve")[seed % 4], "shares": True}
    background = ("process", "residents")[seed // 4 % 2]
    return scenario, demand, kind, {"background": background, "max_steps": 120, "leave_full_lot": False}


@pytest.mark.parametrize("name", COMPILED)
def test_a_compiled_policy_decides_as_its_agent_in_every_situation(name):
    decisions = 0
    for seed in range(24):
        scenario, demand, kind, options = random_world(seed)
        runs = []
        for policy in (POLICIES[name], None):
            fleet = Fleet(scenario, demand, drivers=[DriverKind(policy=policy, **kind)], **options)
            fleet.keep_steps()
            runs.append(driven(fleet, seed, agents=None if policy else [make_agent(name, scenario)]))
        compiled, planned = runs
        np.testing.assert_array_equal(compiled.steps, planned.steps)
        for field in ("slot", "state", "ended_at", "n_steps", "failed_parks"):
            np.testing.assert_array_equal(compiled.cars[field], planned.cars[field])
        decisions += int(compiled.totals["decisions"])
    assert decisions > 2500


def test_a_policy_takes_the_options_of_its_agent():
    scenario = parkenv.make_scenario("campus")
    agent, slots = make_agent("first-free", scenario, within_m=150.0), []
    for kind, agents in ((DriverKind(policy=agent.compiled_policy()), None), (DriverKind(), [agent])):
        fleet = Fleet(scenario, Demand(Headways(20, 30.0)), drivers=[kind])
        slots.append(driven(fleet, 3, agents=agents).cars["slot"].tolist())
    assert slots[0] == slots[1]
