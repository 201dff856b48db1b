"""What parking costs, by zones and slots, for solvers, agents and fleets; the terms of a step add up everywhere."""

import pickle
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from command_line import ran, rows_in, summary_of
from small_lots import driven, features, lasting

from parkenv import InputError, OccupancyProcess, ParkingLot, fleet, lot_v0, make_scenario, simulate
from parkenv.engine.fleet import DriverKind, Fleet
from parkenv.engine.records import CAR, N_TERMS, SEARCH
from parkenv.envs.sb3 import SearchVecEnv
from parkenv.lots import grid_lot, packaged_lot, write_lot
from parkenv.scenarios.spec import ScenarioSpec
from parkenv.studies.episodes import EpisodeRunner
from parkenv.studies.fields import AgentSpec
from parkenv.studies.fleet.drivers import AgentsByStay, policy_of
from parkenv.studies.trips.driven_search import DrivenSearch
from parkenv.world.cost_terms import COST_FIELDS, COST_TERMS, METRICS, REWARD_TERMS
from parkenv.world.demand import ConstantTime, Demand, ExponentialTime, Headways
from parkenv.world.scenario import drive_times
from parkenv.world.tariff import NO_ZONE, Hours, Price, Tariff, Zone
from planners import make_agent
from planners.bounds.oracle import best_slot
from planners.heuristics import POLICIES
from planners.routes import DriveRoutes

DEAR_S = 600.0
SLOT_S, ZONE_S = 15.0, 30.0  # of parking: of the slot itself, and of an hour in its zone
PRICE_S = SLOT_S + ZONE_S  # of a search, which is for the expected stay of an hour
LIMIT = 60


def zoned(lot, far="", **columns):
    """The lot with the nearer half of its slots in the zone `centre`."""
    walk = lot.walk_m()
    zone = np.where(walk <= np.median(walk), "centre", far)
    return ParkingLot(**features(lot) | {"slot_zone": zone} | columns)


@pytest.fixture(scope="module")
def scenario():
    """Half of the slots in a zone with a price, on top of the costs of the lot itself."""
    plain = make_scenario("mini")
    lot = zoned(plain.lot, slot_parking_cost_s=np.arange(plain.lot.n_slots, dtype=float))
    return plain.replace(lot=lot, tariff=Tariff({"centre": 3.0}), value_of_time=10.0, stay_s=1800.0)


def test_what_parking_costs_is_price_times_stay_over_the_value_of_time(scenario):
    lot = scenario.lot
    assert lot.zones == ("centre", NO_ZONE)
    paid_s = 3.0 * 0.5 / 10.0 * 3600.0
    expected = lot.slot_parking_cost_s + paid_s * (lot.slot_zone == "centre")
    for problem in (scenario, scenario.public(), pickle.loads(pickle.dumps(scenario))):
        np.testing.assert_allclose(problem.parking_cost_s, expected)
        np.testing.assert_allclose(problem.arrival_cost_s, problem.walk_s + expected)
    free = scenario.replace(tariff=Tariff())
    assert free.parking_cost_s.tolist() == lot.slot_parking_cost_s.tolist()


def test_a_file_says_what_options_say(tmp_path):
    file = tmp_path / "town.toml"
    file.write_text('lot = "mini"\n[costs]\nprices = { other = 2 }\nvalue_of_time = 8\nstay_s = 900\n')
    assert set(make_scenario(file).parking_cost_s) == {2 * 900 / 8}
    again = ScenarioSpec.parse(ScenarioSpec.read(file).tables(), "again")
    assert again.costs == ScenarioSpec.read(file).costs


@pytest.mark.parametrize("policy", ["greedy-total", "greedy-drive"])
def test_a_car_pays_for_its_own_stay_whoever_drives(scenario, policy):
    demand, lot = Demand(Headways(12, mean_s=30.0), ExponentialTime(2400.0)), scenario.lot
    driver = DriverKind(policy=POLICIES[policy])
    cars = driven(Fleet(scenario, demand, drivers=[driver], background="none"), 1).cars
    parked = cars[cars["slot"] >= 0]
    price = np.where(lot.slot_zone == "centre", 3.0, 0.0)[parked["slot"]]
    paid_s = price * parked["stay_s"] / 10.0
    np.testing.assert_allclose(parked["parking_cost_s"], lot.slot_parking_cost_s[parked["slot"]] + paid_s)
    np.testing.assert_allclose(sum(cars[name] for name in COST_FIELDS), cars["total_s"])


def test_who_stays_long_drives_to_where_it_is_free():
    """Between a near zone and a free one far away, the indifferent stay is that whose price is worth the walk."""
    lot = zoned(grid_lot(1, 20), far="far")
    nobody = OccupancyProcess.from_demand(np.full(lot.n_slots, -50.0), np.zeros(168))
    scenario = make_scenario(lot, occupancy=nobody, tariff=Tariff({"centre": 2.0}), value_of_time=12.0)
    drive_s = drive_times(scenario, int(lot.entry_vertices[0]))
    way_s, centre = drive_s + scenario.walk_s, lot.slot_zone == "centre"
    worth_s = way_s[~centre].min() - way_s[centre].min()
    assert worth_s > 0.0
    indifferent_s = worth_s * 12.0 / 2.0
    for stay_s, zone in ((0.98 * indifferent_s, "centre"), (1.02 * indifferent_s, "far")):
        driver = DriverKind(policy=POLICIES["greedy-total"], knows="full")
        demand = Demand(Headways(1), ConstantTime(stay_s))
        cars = driven(Fleet(scenario, demand, background="none", drivers=[driver]), 0).cars
        assert lot.slot_zone[cars["slot"][0]] == zone
        # The same indifference in the value of time, for a fixed stay.
        dear = scenario.replace(stay_s=indifferent_s, value_of_time=12.0 * indifferent_s / stay_s)
        slot = EpisodeRunner(dear, "oracle", make_agent("oracle", dear)).run(0).row["slot"]
        assert lot.slot_zone[lot.slot_ids.index(slot)] == zone


def test_revenue_is_price_times_stay_of_the_parked_cars(tmp_path):
    file = tmp_path / "zones.geojson"
    write_lot(zoned(packaged_lot("mini")), file)
    result = fleet(
        scenarios=[{"lot": str(file), "costs": {"prices": {"centre": 3.0}}, "arrivals": {"hours": "08:00-09:00"}}],
        arrivals_per_hour=(12.0,), knows=("own",), days=2, folder=tmp_path / "run",
    )  # fmt: skip
    (row,), study = result.rows, result.study
    assert row["agents"] == "greedy-total"
    assert sum(row[name] for name in COST_FIELDS) == pytest.approx(row["total_s"])
    revenue, paid, n_parked = [], [], []
    for day in range(2):
        day_fleet, agents = study.fleet(*study.fleet_settings)
        cars = driven(day_fleet, study.seed, day, agents=agents).cars
        parked = cars[cars["slot"] >= 0]
        inside = study.built["zones"].lot.slot_zone[parked["slot"]] == "centre"
        revenue.append(3.0 * parked["stay_s"][inside].sum() / 3600.0)
        paid.append(revenue[-1] / len(cars))
        n_parked.append([inside.sum(), (~inside).sum()])
    centre, other = result.summary["zones"]
    assert (centre["zone"], centre["slots"]) == ("centre", 5)
    assert (other["zone"], other["paid_a_day"]) == (NO_ZONE, 0.0)
    assert centre["paid_a_day"] == pytest.approx(np.mean(revenue))
    assert [centre["parked_a_day"], other["parked_a_day"]] == np.mean(n_parked, axis=0).tolist()
    assert row["paid"] == pytest.approx(np.mean(paid))
    lines = rows_in(tmp_path / "run" / "blocks.csv")
    assert sum(float(line["paid"]) for line in lines) == pytest.approx(sum(revenue))


def test_agents_in_python_know_their_own_stay(scenario):
    """A car whose driver decides in Python drives as the compiled one does."""
    policy, agent = policy_of(AgentSpec.of("greedy-total"), scenario)
    assert agent is None
    python = AgentsByStay(AgentSpec.of("greedy-total"), scenario, {})
    demand, slots = Demand(Headways(8, mean_s=30.0), ExponentialTime(2400.0)), []
    for kind, agents in ((DriverKind(policy=policy), None), (DriverKind(), [python])):
        its = Fleet(scenario, demand, drivers=[kind], background="none")
        slots.append(driven(its, 3, agents=agents).cars["slot"].tolist())
    assert slots[0] == slots[1]


def test_prices_are_added_to_those_of_paid_zones_and_set_by_hours():
    """Their hours, free minutes and limits stay; zones that cost nothing, or have another name, keep their prices."""
    day = Hours.parse("Mo-Fr 08:00-20:00")
    paid = Zone("kerb paid Mo-Fr", Price(2.0, free_s=900.0, charged=day), max_stay_s=7200.0)
    steps = Zone("kerb steps", Price(4.0, steps=((3600.0, 1.0), (7200.0, 3.0))))
    others = Zone("kerb free"), Zone("garage", Price(2.0))
    tariff = Tariff({"kerb*": "+1"})
    assert tariff.priced(paid) == replace(paid, price=Price(3.0, free_s=900.0, charged=day))
    assert tariff.priced(steps).price == Price(5.0, steps=((3600.0, 2.0), (7200.0, 5.0)))
    assert tuple(map(tariff.priced, others)) == others
    assert Tariff({"garage": "+0.5"}).priced(others[1]).price == Price(2.5)
    with pytest.raises(InputError, match="no paid zone 'lot"):
        Tariff({"lot*": "+1"}).require_zones([paid, *others], "town")
    zone = Tariff({"near": "1 @ 08:00-12:00; 3 @ 12:00-15:00"}).priced(Zone("near", Price(9.0)))
    begin = np.array([7.0, 11.5, 16.0]) * 3600.0
    assert zone.price.raised(1.0).amount(begin, 7200.0).tolist() == [2.0, 7.0, 0.0]
    with pytest.raises(InputError, match="hourly"):
        Price(1.0, hourly=zone.price.hourly)


def test_a_scenario_changes_the_rules_of_zones():
    ring = {"price": "1 @ 08:00-12:00; 3 @ 12:00-20:00", "users": ["public", "permit-a"], "max_stay_s": 7200}
    plain, changed = (make_scenario({"base": "town", "zones": its}).lot for its in ({}, {"ring": ring}))
    price = changed.zone_rules["ring"].price.amount(np.array([10.0, 11.0, 18.0]) * 3600.0, 7200.0)
    assert price.tolist() == [2.0, 4.0, 6.0]
    assert changed.zone_rules["ring"].max_stay_s == 7200.0
    assert changed.zone_rules["ring"].hours == plain.zone_rules["ring"].hours
    assert changed.zone_rules["outer"] == plain.zone_rules["outer"]


def empty_lot(lot):
    return lasting(lot, np.zeros(lot.n_slots, bool), said=-0.5)


def parked_at(name, scenario):
    row = EpisodeRunner(scenario, name, make_agent(name, scenario)).run(0).row
    return scenario.lot.slot_ids.index(row["slot"])


def priced(lot, cost_s):
    return ParkingLot(**{**features(lot), "slot_parking_cost_s": cost_s})


@pytest.mark.parametrize(
    "name", "mdp mdp-static mdp-tuned belief oracle greedy-goal greedy-total first-free".split()
)
def test_agents_park_elsewhere_where_that_pays(name):
    lot = packaged_lot("mini")
    chosen = parked_at(name, empty_lot(lot))
    # The chosen half of the lot is expensive.
    walk_m = lot.walk_m()
    near = walk_m <= np.median(walk_m) if walk_m[chosen] <= np.median(walk_m) else walk_m > np.median(walk_m)
    dear = empty_lot(priced(lot, np.where(near, DEAR_S, 0.0)))
    assert not near[parked_at(name, dear)]
    # The same price for all slots changes nothing.
    assert parked_at(name, empty_lot(priced(lot, np.full(lot.n_slots, DEAR_S)))) == chosen


def test_the_bound_counts_prices():
    rng, lot = np.random.default_rng(4), packaged_lot("campus")
    scenario = replace(
        empty_lot(priced(lot, rng.uniform(0.0, 120.0, lot.n_slots))),
        occupancy=OccupancyProcess.from_demand(np.full(lot.n_slots, 2.0), np.zeros(168), 600.0),
    )
    env = gym.make("parkenv/Search-v2", scenario=scenario)
    for seed in range(5):
        env.reset(seed=seed)
        state, routes = env.unwrapped.state, DriveRoutes(scenario)
        drive_s = routes.seconds_from(state.vertex)[: lot.n_slots]
        free_at = [float(state.world.next_free([s], state.time + d)[0]) for s, d in enumerate(drive_s)]
        total_s = np.array(free_at) - state.time + scenario.walk_s + scenario.lot.slot_parking_cost_s
        best = best_slot(scenario, routes, state.world, state.vertex, state.time)
        assert best.total_s == pytest.approx(total_s.min())
        # The oracle waits in whole steps.
        reached_s = simulate(env, make_agent("oracle", scenario), seed).info["total_s"]
        assert best.total_s - 1e-6 <= reached_s <= best.total_s + 2 * scenario.wait_s


def test_a_comparison_shows_what_parking_cost(tmp_path):
    lot = packaged_lot("mini")
    write_lot(priced(lot, np.where(np.arange(lot.n_slots) % 2 == 0, 30.0, 5.0)), tmp_path / "dear.geojson")
    done = ran(
        "compare", "--lot", tmp_path / "dear.geojson", "--agents", "mdp,greedy-goal", "--episodes", 5,
        "--day-error", 0, "--occupancy-levels", "none", "--no-figures", "--out", tmp_path / "run",
    )  # fmt: skip
    assert "parking" in done.stdout
    for row in summary_of(tmp_path / "run")["rows"]:
        assert 4.0 < row["parking_cost_s"] <= 30.0
        assert row["total_s"] == pytest.approx(sum(row[name] for name in COST_FIELDS))


@pytest.fixture(scope="module")
def costly():
    """A lot where every slot has a cost, its zone a price, and where a failed attempt is likely."""
    plain = make_scenario("mini")
    lot = ParkingLot(**features(plain.lot) | {"slot_parking_cost_s": np.full(plain.lot.n_slots, SLOT_S)})
    tariff = Tariff({"other": 12.0 * ZONE_S / 3600.0})
    return replace(plain, lot=lot, failure_s=7.0, tariff=tariff, value_of_time=12.0)


def check_sums(info, parked=True, of_many=False):
    """The terms of an episode, as `info` names them, are its total; of many cars each pays for its own stay."""
    assert set(METRICS) <= set(info)
    assert sum(info[name] for name in COST_FIELDS) == pytest.approx(info["total_s"])
    if parked:
        assert info["parked"]
        paid_s = info["parking_cost_s"]
        assert paid_s > SLOT_S if of_many else paid_s == pytest.approx(PRICE_S)


def tries(mask, rng):
    """A random action that the graph has, mostly parking where there is a slot."""
    return 4 if mask[4] and rng.random() < 0.7 else int(rng.choice(np.nonzero(mask)[0]))


@pytest.mark.parametrize(
    ("name", "options", "searches"),
    [
        ("Search-v2", {}, 3),
        ("SearchSensors-v2", {"observation": "scan"}, 3),
        pytest.param("SearchPerception-v2", {"captures": 1, "picture_width": 160}, 1, marks=pytest.mark.slow),
    ],
)
def test_single_searches(costly, name, options, searches):
    env = gym.make(f"parkenv/{name}", scenario=costly, **options)
    rng, seen = np.random.default_rng(0), set()
    for seed in range(searches):
        observation, _ = env.reset(seed=seed)
        returned, over, sums = 0.0, False, dict.fromkeys(REWARD_TERMS, 0.0)
        while not over:
            action = tries(observation["action_mask"], rng)
            observation, reward, terminated, truncated, info = env.step(action)
            assert sum(info[name] for name in REWARD_TERMS) == pytest.approx(reward)
            check_sums(info, parked=bool(terminated and info["parked"]))
            returned, over = returned + reward, terminated or truncated
            sums = {term: sums[term] - info[term] for term in REWARD_TERMS}
        assert info["total_s"] == pytest.approx(-returned)
        for term in COST_TERMS:
            assert info[term.field] == pytest.approx(sums[f"reward_{term.name}"])
        seen |= {term.name for term in COST_TERMS if info[term.field]}
    assert {"drive", "walk", "parking"} <= seen


def test_batches_as_stable_baselines3_has_them(costly):
    venv = SearchVecEnv(4, costly, max_episode_steps=LIMIT)
    venv.seed(0)
    venv.reset()
    rng, ended = np.random.default_rng(0), 0
    for _ in range(200):
        actions = np.array([tries(mask, rng) for mask in venv.action_masks()])
        _, rewards, done, infos = venv.step(actions)
        for i in np.flatnonzero(done):
            assert sum(infos[i][name] for name in REWARD_TERMS) == pytest.approx(rewards[i])
            check_sums(infos[i], parked=infos[i]["parked"])
            assert infos[i]["episode"]["r"] == pytest.approx(-infos[i]["total_s"])
            ended += int(infos[i]["parked"])
    assert ended > 10


@pytest.mark.filterwarnings("ignore")
def test_many_cars_as_agents(costly):
    env = lot_v0.env(scenario=costly, cars=6)
    env.reset(seed=0)
    rng, returns, parked = np.random.default_rng(0), {}, 0
    for car in env.agent_iter():
        observation, _, terminated, truncated, info = env.last()
        if info:
            returns[car] = returns.get(car, 0.0) + sum(info[name] for name in REWARD_TERMS)
            check_sums(info, parked=info["parked"], of_many=True)
        if terminated or truncated:
            assert info["total_s"] == pytest.approx(-returns[car])
            parked += int(info["parked"])
            env.step(None)
        else:
            env.step(tries(observation["action_mask"], rng))
    assert parked > 0


def test_driven_trips(costly):
    trip = DrivenSearch(costly).run(seed=1)
    assert trip.parked
    assert trip.costs["parking_cost_s"] == pytest.approx(PRICE_S)
    assert set(trip.costs) == set(COST_FIELDS) - {"drive_s"}
    assert trip.total_s == pytest.approx(trip.lanes_s + trip.manoeuvre_s + sum(trip.costs.values()))


@pytest.mark.parametrize("record", [SEARCH, CAR])
def test_records_hold_every_term_in_order(record):
    one = np.zeros(1, record)
    one["costs"] = np.arange(N_TERMS) + 1.0
    assert [one[name][0] for name in COST_FIELDS] == [i + 1.0 for i in range(N_TERMS)]
