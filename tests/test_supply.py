"""Supply of every kind: facilities, rules of zones, weights; counted facilities in the engine."""

import json
from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from lot_checks import refused_lot
from scipy.stats import binom, poisson
from small_lots import driven

from parkenv import InputError, make_scenario, simulate
from parkenv.engine.fleet import DriverKind, Fleet
from parkenv.engine.kernel import p_full
from parkenv.engine.records import PARKED, SEARCHING
from parkenv.lots import check_lot, grid_lot, packaged_lot, read_lot, write_lot
from parkenv.lots.draft import LotDraft
from parkenv.scenarios.spec import ScenarioSpec
from parkenv.studies.fields import AgentSpec
from parkenv.studies.fleet.drivers import policy_of
from parkenv.world.cues import Cues
from parkenv.world.demand import ConstantTime, Demand, ExponentialTime, ListedArrivals, PoissonArrivals
from parkenv.world.drive_graph import GraphError
from parkenv.world.facility import FACILITY_KINDS, KNOWN, Facility
from parkenv.world.lot import PARK, ParkingLot
from parkenv.world.occupancy.process import Arrival
from parkenv.world.occupancy.typical_week import typical_occupancy
from parkenv.world.scenario import Drivers
from parkenv.world.tariff import Hours, Price, Tariff, Zone
from parkenv.world.week import DAY_S
from planners import make_agent
from planners.heuristics.policies import POLICIES

GARAGE = Facility("P1", "garage", "inner", 40, (30.0, 12.0), gate_s=10.0, inside_s=(30.0, 90.0), known="sign")
INNER = Zone("inner", Price(2.0, charged=Hours.parse("Mo-Sa 08:00-20:00")), users=("public", "permit-a"))
PERMIT = Zone("permit", users=("permit-a",))
GREEDY = DriverKind(policy=POLICIES["greedy-drive"])
FORBIDDEN = {"inner": Zone("inner", Price(1.0)), "permit": Zone("permit", users=("permit-a",))}


def town(**changes):
    """The lot `mini` with a kerb of three slots for permits, and a garage."""
    lot, kerb = packaged_lot("mini"), Facility("kerb", "kerb", "permit")
    features = {
        "facilities": (GARAGE, kerb),
        "slot_facility": ["kerb"] * 3 + [""] * (lot.n_slots - 3),
        "zone_rules": {zone.name: zone for zone in (INNER, PERMIT)},
    }
    return replace(lot, **features | changes)


def test_a_counted_facility_is_one_slot_at_its_lane():
    lot = town()
    assert lot.slot_ids[-1] == "P1"
    assert lot.capacity.tolist() == [1] * 10 + [40]
    assert [lot.facilities[i].name for i in lot.facility_of_slot[[0, -1]]] == ["kerb", "P1"]
    assert lot.slot_zone.tolist() == ["permit"] * 3 + [""] * 7 + ["inner"]
    assert lot.classes == ("public", "permit-a")
    # People walk from its point, cars stop at its lane; what was there before stays.
    assert lot.walk_m()[-1] == pytest.approx(np.hypot(*(lot.goals[0] - GARAGE.xy)))
    plain = packaged_lot("mini")
    np.testing.assert_array_equal(lot.walk_m()[:-1], plain.walk_m())
    np.testing.assert_array_equal(lot.vertex_xy[:9], plain.vertex_xy[:9])
    assert replace(lot, name="again").slot_ids == lot.slot_ids


hours = st.lists(
    st.lists(st.integers(0, 1440), max_size=4, unique=True).map(
        lambda ends: tuple(zip(sorted(ends)[::2], sorted(ends)[1::2], strict=False))
    ),
    min_size=7,
    max_size=7,
).map(lambda days: Hours(tuple(days)))
amounts = st.integers(0, 400).map(lambda cents: cents / 100)
steps = st.lists(st.tuples(st.integers(1, 7200), amounts), max_size=3).map(
    lambda parts: tuple(
        (float(sum(p[0] for p in parts[: k + 1])), sum(p[1] for p in parts[: k + 1]))
        for k in range(len(parts))
    )
)
prices = st.builds(
    Price, amounts, steps, st.sampled_from([0.0, 900.0]), st.none() | amounts, st.none() | hours, amounts
)
names = st.text("Ga ä1", min_size=1, max_size=6)
zones = st.builds(
    Zone,
    names,
    prices,
    st.none() | hours,
    st.none() | st.floats(60.0, 1e6),
    st.lists(st.sampled_from(["public", "permit-a", "disabled"]), min_size=1, max_size=2).map(tuple),
)


@settings(max_examples=40)
@given(
    rules=st.lists(zones, min_size=1, max_size=3, unique_by=lambda zone: zone.name),
    counted=st.lists(
        st.builds(
            Facility,
            name=names.map(lambda name: f"P {name}"),
            kind=st.sampled_from(list(FACILITY_KINDS)),
            capacity=st.integers(1, 999),
            xy=st.tuples(st.floats(-50.0, 80.0), st.floats(-50.0, 50.0)),
            gate_s=st.floats(0.0, 60.0),
            inside_s=st.tuples(st.floats(0.0, 60.0), st.floats(0.0, 600.0)),
            known=st.sampled_from(KNOWN),
            delay_s=st.floats(0.0, 600.0),
        ),
        max_size=3,
        unique_by=lambda facility: facility.name,
    ),
    weights=st.dictionaries(names, st.floats(0.0, 1e6), max_size=2),
)
def test_towns_are_read_back_to_the_bit(tmp_path, rules, counted, weights):
    grid = grid_lot(2, 4)
    lot = replace(
        grid,
        slot_zone=[rules[0].name] + [""] * 7,
        slot_facility=["", "row", "row"] + [""] * 5,
        facilities=(*counted, Facility("row", "lot", rules[-1].name)),
        zone_rules={zone.name: zone for zone in rules},
        goal_weights={name: [weight] for name, weight in weights.items()},
        entry_weights={name: [weight] for name, weight in weights.items()},
    )
    path = tmp_path / "lot.geojson"
    write_lot(lot, path)
    assert read_lot(path) == lot
    assert LotDraft.of_lot(lot).lot() == lot
    assert not [problem for problem in check_lot(path) if problem.severity == "error"]


@given(price=prices, begin=st.integers(0, 10080), stay=st.integers(0, 5 * 1440))
def test_a_price_is_what_counting_minutes_gives(price, begin, stay):
    """Against a driver who looks at the tariff table each minute."""
    days = 1 if price.daily_cap is None else -(-stay // 1440)
    total = 0.0
    for day in range(days):
        minutes = stay if price.daily_cap is None else min(1440, stay - 1440 * day)
        charged = 0
        for minute in range(begin + 1440 * day, begin + 1440 * day + minutes):
            spans = price.charged.days[minute // 1440 % 7] if price.charged else ((0, 1440),)
            charged += any(a <= minute % 1440 < b for a, b in spans)
        paid_s = max(60.0 * charged - price.free_s, 0.0)
        rest = paid_s - price.steps[-1][0] if price.steps else paid_s
        cost = next((p for limit, p in price.steps if paid_s <= limit), None) if paid_s else 0.0
        if cost is None:
            cost = (price.steps[-1][1] if price.steps else 0.0) + price.per_hour * max(rest, 0.0) / 3600.0
        total += cost if price.daily_cap is None else min(cost, price.daily_cap)
    amount = price.amount(60.0 * begin, np.array([60.0 * stay]), 2.0)
    np.testing.assert_allclose(amount, [total + 2.0 * price.per_kwh], atol=1e-9)


def test_prices_by_hours_are_read_back(tmp_path):
    by_hours = "2 @ Mo-Sa 08:00-12:00; 1234.5678 @ Mo-Sa 12:00-20:00; 3 @ Tu 20:00-21:00; 0 @ Su 09:00-12:00"
    price = Price.parse(by_hours)
    lot = replace(grid_lot(2, 4), zone_rules={"a": Zone("a", price)}, slot_zone=["a"] * 8)
    write_lot(lot, tmp_path / "a.geojson")
    again = read_lot(tmp_path / "a.geojson").zone_rules["a"].price
    begin = 3600.0 * np.arange(7 * 24)
    np.testing.assert_allclose(again.amount(begin, 5400.0), price.amount(begin, 5400.0), rtol=1e-12)
    assert price.amount(0.0, np.inf) == Price(1.0, daily_cap=8.0).amount(3600.0, np.inf) == np.inf
    assert Price().amount(0.0, np.inf) == 0.0
    assert Price.parse("0 @ 08:00-12:00").amount(0.0, np.inf) == 0.0


def test_who_may_park_where_and_when():
    """The row of a driver is infinite where class, hours or longest stay forbid to park."""
    charged, hours = map(Hours.parse, ("Mo-Fr 08:00-18:00", "Mo-Sa 06:00-22:00"))
    loading = Zone("inner", Price(6.0, charged=charged), hours, 3600.0)
    scenario = make_scenario(town(zone_rules={"inner": loading, "permit": PERMIT}))
    assert scenario.lot.zones == ("inner", "other", "permit")
    assert scenario.has_rules
    assert not make_scenario("mini").has_rules
    spec = ScenarioSpec.parse({"lot": "mini", "arrivals": {"hours": "12:00-14:00", "days": "sat"}}, "test")
    assert make_scenario(spec).priced_at_s == 5 * DAY_S + 13 * 3600.0
    monday, permit = 9 * 3600.0, scenario.class_bits(["permit-a"])
    row = scenario.zone_cost_s(Drivers([1800.0, 1800.0, 7200.0], [monday, 0.0, monday], 12.0, [1, permit, 1]))
    np.testing.assert_allclose(row, [[900.0, 0.0, np.inf], [np.inf, 0.0, 0.0], [np.inf, 0.0, np.inf]])
    # Outside the charged hours, neither price nor limit counts.
    evening = scenario.zone_cost_s(Drivers(7200.0, 18.5 * 3600.0, 12.0, 1))
    assert evening.tolist() == [0.0, 0.0, np.inf]
    free = scenario.replace(tariff=Tariff({"inner": 0.0}), stay_s=1800.0)
    assert free.parking_cost_s[-1] == 0.0
    assert free.replace(walk_back=True).walk_s[-1] == 2 * free.walk_s[-1]
    with pytest.raises(InputError, match="did you mean 'permit-a'"):
        scenario.replace(classes=("permit",))


ERRORS = json.loads(Path(__file__).with_name("bad_towns.json").read_text(encoding="utf-8"))
"""Kinds of features, changes of them, and what is said of each."""


@pytest.mark.parametrize(("kind", "changes", "message"), ERRORS)
def test_a_wrong_town_is_refused_in_one_line(tmp_path, kind, changes, message):
    path = tmp_path / "town.geojson"
    write_lot(town(), path)
    document = json.loads(path.read_text())
    if kind == "zone":
        document["zones"]["inner"] |= changes
    else:
        changed = next(f for f in document["features"] if f["properties"]["kind"] == kind)
        if "at" in changes:
            changed["geometry"]["coordinates"] = changes["at"]
        else:
            changed["properties"] |= changes
    path.write_text(json.dumps(document))
    assert message in refused_lot(read_lot, path)
    assert any(message in str(problem) for problem in check_lot(path))


def test_a_facility_that_no_entry_leads_to_is_named():
    away = replace(packaged_lot("mini").lanes[0], points=np.array([[0.0, 100.0], [30.0, 100.0]]))
    lot, far = packaged_lot("mini"), replace(GARAGE, zone="", xy=(10.0, 105.0))
    with pytest.raises(GraphError, match="facility 0: 'P1' cannot be reached from an entry"):
        replace(lot, lanes=(*lot.lanes, away), facilities=(far,))
    draft = LotDraft.of_lot(replace(lot, lanes=(*lot.lanes, away)))
    kept = replace(draft, facilities=(far, replace(GARAGE, name="P2", zone=""))).searchable()
    assert [facility.name for facility in kept.facilities] == ["P2"]
    assert (kept.left_out[0].ids, kept.lot().slot_ids[-1]) == (("P1",), "P2")


def garage_alone(**facility):
    grid = grid_lot(1, 1)
    fields = {"zone": "", "capacity": 5, "gate_s": 0.0, "inside_s": (0.0, 0.0), "xy": (1.0, 5.0)}
    garage, empty = replace(GARAGE, **fields | facility), np.zeros(0)
    lot = ParkingLot(
        "garage", (), empty, empty, empty, empty, empty, grid.lanes, grid.entries, grid.goals, facilities=(garage,)
    )  # fmt: skip
    return make_scenario(lot)


def run(scenario, demand, kind=GREEDY, **options):
    return driven(Fleet(scenario, demand, background="none", drivers=[kind], **options), 3)


def parked_in(fleet, slot):
    cars = fleet.cars
    return np.count_nonzero((cars["slot"] == slot) & np.isin(cars["state"], (PARKED, SEARCHING)))


def test_cars_stand_in_line_before_the_barrier():
    scenario = garage_alone(gate_s=20.0, inside_s=(30.0, 80.0))
    fleet = run(scenario, Demand(ListedArrivals((0.0, 1.0, 2.0, 3.0)), ConstantTime(7200.0)))
    cars, inside_s = fleet.cars, 30.0 + 50.0 * np.arange(4) / 5
    # Each passes 20 s after the one before it, and drives on inside as far as that is full.
    np.testing.assert_allclose(np.diff(cars["ended_at"] - inside_s), 20.0)
    np.testing.assert_allclose(cars["queued_s"], 19.0 * np.arange(4))
    np.testing.assert_allclose(cars["drive_s"], cars["ended_at"] - cars["arrival"])
    np.testing.assert_allclose(cars["total_s"], cars["drive_s"] + cars["walk_s"])
    assert cars["ended_at"][0] - cars["arrival"][0] == pytest.approx(50.0, abs=15.0)
    assert scenario.enter_s.tolist() == [20.0 + 55.0]
    fleet.run(until=cars["ended_at"][0] + 7200.0)
    assert fleet.counts().tolist() == [3]


@pytest.mark.parametrize("gate_s", [0.0, 15.0])
def test_every_car_is_somewhere(gate_s):
    """Counts of facilities are those of the cars in them, and never above capacity; cars are conserved."""
    garage = replace(GARAGE, capacity=6, gate_s=gate_s, zone="")
    other = replace(GARAGE, name="P2", capacity=2, xy=(5.0, 9.0), zone="", known="nothing")
    lot = town(facilities=(garage, other), slot_facility=(), zone_rules={})
    demand = Demand(PoissonArrivals(60.0, 0.0, 6 * 3600.0), ExponentialTime(900.0), ConstantTime(240.0))
    fleet = Fleet(make_scenario(lot), demand, background="none", drivers=[GREEDY], leave_full_lot=False)
    fleet.reset(seed=2)
    full = 0
    for minute in range(4, 480, 4):
        fleet.run(until=fleet.begin + 60.0 * minute)
        totals, counts = fleet.totals, fleet.counts()
        assert sum(totals[name] for name in ("due", "searching", "parked", "gone")) == len(fleet.cars)
        assert [parked_in(fleet, slot) for slot in range(lot.n_slots)] == counts.tolist()
        assert (counts <= lot.capacity).all()
        assert (fleet.taken() == (counts == lot.capacity)).all()
        full += counts[-2] == 6
    assert 0 < full < 119
    assert fleet.cars["failed_parks"].sum() > 0
    assert (np.sort(fleet.cars["state"]) > SEARCHING).all()


def test_cars_may_stand_there_when_the_world_begins():
    scenario = make_scenario(town(zone_rules={}))
    fleet = run(scenario, Demand(ListedArrivals((60.0,)), ConstantTime(600.0), parked=30))
    cars = fleet.cars
    assert np.count_nonzero(cars["parked_at"] >= 0) == 30
    np.testing.assert_array_equal(cars["slot"][:30], cars["parked_at"][:30])
    assert (cars["total_s"][:30] == 0.0).all()
    counts = fleet.counts()
    assert counts[10] > 0
    assert counts.sum() == fleet.totals["parked"]
    fleet.run(until=fleet.begin + 601.0)
    np.testing.assert_allclose(cars["left_at"][:30], fleet.begin + cars["stay_s"][:30])
    assert fleet.counts().sum() == 1


@pytest.mark.parametrize("agent", "first-free greedy-drive greedy-total greedy-goal mdp belief".split())
def test_nobody_parks_where_the_driver_may_not(agent):
    """In fleets with compiled policies and agents in Python, and in single searches."""
    scenario = make_scenario(town(zone_rules=FORBIDDEN))
    arrivals = PoissonArrivals(60.0, 8 * 3600.0, 10 * 3600.0)
    demand = Demand(arrivals, ExponentialTime(900.0), ConstantTime(600.0))
    policy, own = policy_of(AgentSpec(name=agent), scenario)
    fleet = Fleet(scenario, demand, background="none", drivers=[DriverKind(policy=policy)])
    driven(fleet, 1, agents=[own])
    zones = np.array(scenario.lot.zones)[scenario.lot.zone_of_slot[fleet.cars["slot"]]]
    parked = fleet.cars["slot"] >= 0
    assert parked.sum() > 20
    assert "permit" not in zones[parked]
    assert np.isfinite(fleet.cars["total_s"]).all()
    env = gym.make("parkenv/Search-v2", scenario=scenario)
    driver = make_agent(agent, scenario)
    for seed in range(5):
        result = simulate(env, driver, seed)
        assert not result.info["parked"] or scenario.lot.slot_zone[env.unwrapped.state.vertex] != "permit"


def parks_at(env, slot):
    while (vertex := env.unwrapped.state.vertex) != slot:
        env.step(way_to(env.unwrapped.scenario.lot, vertex, slot))
    return env.step(PARK)


@pytest.mark.parametrize("cues", [None, Cues(lead_s=1e6, moving_s=600.0)])
def test_forbidden_slots_are_as_good_as_taken(cues):
    scenario = make_scenario(town(zone_rules=FORBIDDEN)).replace(cues=cues)
    env = gym.make("parkenv/Search-v2", scenario=scenario)
    observation, _ = env.reset(seed=0)
    forbidden = scenario.lot.slot_zone == "permit"
    rng = np.random.default_rng(0)
    for _ in range(60):
        assert (observation["p_occupied"][forbidden] == 1.0).all()
        observation, *_ = env.step(int(rng.choice(np.flatnonzero(observation["action_mask"][:4]))))
    observation, _ = env.reset(seed=0)
    assert (observation["p_occupied"][forbidden] == 1.0).all()
    assert (observation["p_occupied"][~forbidden] < 1.0).all()
    assert scenario.action_masks[:10, PARK].tolist() == (~forbidden[:10]).tolist()
    assert np.isinf(scenario.arrival_cost_s[forbidden]).all()
    # An attempt there is no attempt: the car waits.
    _, reward, terminated, _, info = parks_at(env, 0)
    assert (terminated, reward, info["failed_parks"]) == (False, -scenario.wait_s, 0)
    allowed = gym.make("parkenv/Search-v2", scenario=scenario.replace(classes=("permit-a",)))
    assert (allowed.reset(seed=0)[0]["p_occupied"] < 1.0).all()


def test_a_single_search_takes_as_long_inside_as_agents_expect():
    scenario = garage_alone(gate_s=20.0, inside_s=(30.0, 80.0))
    # A week in which nobody else comes.
    scenario = scenario.replace(walk_back=True, occupancy=typical_occupancy(scenario.lot, demand=-40.0))
    env = gym.make("parkenv/Search-v2", scenario=scenario)
    env.reset(seed=1)
    _, reward, terminated, _, info = parks_at(env, 0)
    assert terminated
    assert info["parked"]
    assert -reward == pytest.approx(scenario.arrival_cost_s[0])
    assert info["reward_drive"] == -75.0


def test_a_typical_week_fills_a_facility_as_often_as_all_of_its_spaces():
    """In the fullest hour, and with the rates of the first car that leaves."""
    lot = town(zone_rules={})
    week, spaces = make_scenario(lot).occupancy, typical_occupancy(lot)
    hour = Arrival((24.0 + 11.5) * 3600.0)
    p, each = week.forecast(hour), spaces.forecast(hour)
    np.testing.assert_array_equal(p.p_occupied[:10], each.p_occupied[:10])
    assert p.p_occupied[10] == pytest.approx(each.p_occupied[10] ** 40, rel=0.25)
    assert week.departure_factor[10] == 40.0 * spaces.departure_factor[10]


def test_the_walk_back_counts_for_those_who_mind_it():
    scenario = make_scenario(town(zone_rules={}))
    fleets = [
        run(scenario, Demand(ListedArrivals((0.0, 60.0)), ConstantTime(600.0), walks_back=back))
        for back in (False, True)
    ]
    there, back = (fleet.cars for fleet in fleets)
    assert there["slot"].tolist() == back["slot"].tolist()
    np.testing.assert_allclose(back["walk_s"], 2.0 * there["walk_s"])
    np.testing.assert_allclose(back["walked_m"], 2.0 * there["walked_m"])


@pytest.mark.parametrize("capacity", [20, 300])
@pytest.mark.parametrize("age", [0.01, 0.1, 1.0])
def test_a_count_tells_how_full_it_will_be(capacity, age):
    """Against the exact law of M/M/∞: those that stay are binomial, those that come Poisson."""
    for load in (0.9, 1.0):
        mean, stay = load * capacity, np.exp(-age)
        long_run = float(poisson.sf(capacity - 1, mean))
        for count in (capacity // 2, capacity - 2, capacity):
            left = binom.pmf(np.arange(count + 1), count, stay)
            exact = left @ poisson.sf(capacity - 1 - np.arange(count + 1), mean * (1.0 - stay))
            assert p_full(long_run, count, capacity, age) == pytest.approx(exact, abs=0.06)
        assert p_full(long_run, capacity - 1, capacity, 0.0) == 0.0
        assert p_full(long_run, capacity, capacity, 0.0) == 1.0
        assert p_full(long_run, 0, capacity, 50.0) == pytest.approx(long_run, abs=1e-6)


def first_belief(known, count, delay_s=0.0):
    garage = replace(GARAGE, zone="", capacity=5, known=known, delay_s=delay_s, gate_s=0.0)
    scenario = make_scenario(town(facilities=(garage,), slot_facility=(), zone_rules={}))
    times = (*(1e-3 * i for i in range(count)), 100.0)
    fleet = Fleet(scenario, Demand(ListedArrivals(times), ConstantTime(36000.0)), background="none")
    fleet.reset()
    while (car := fleet.next_decision()) != count:
        slot = scenario.lot.n_slots - 1
        vertex = int(fleet.observation(car)["vertex"])
        fleet.act(PARK if vertex == slot else way_to(scenario.lot, vertex, slot))
    observation = fleet.observation(car)
    return float(observation["p_occupied"][-1]), float(observation["belief"].reshape(4, -1)[0, -1])


def way_to(lot, vertex, target):
    from scipy.sparse.csgraph import dijkstra

    metres = dijkstra(lot.drive_matrix().T.tocsr(), indices=target)
    moves = [a for a in range(4) if lot.neighbors[vertex, a] >= 0]
    return min(moves, key=lambda a: lot.edge_length[vertex, a] + metres[lot.neighbors[vertex, a]])


def test_a_live_count_is_known_everywhere():
    for known in ("nothing", "sign"):
        p, forecast = first_belief(known, 5)
        assert p == forecast
    nearly, forecast = first_belief("live", 3)
    full, _ = first_belief("live", 5)
    assert nearly < forecast < full
    assert full < 1.0
    # It is published every hour: what has happened since is not known.
    assert first_belief("live", 5, delay_s=3600.0)[0] < 0.1
