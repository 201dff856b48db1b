"""Many cars in one lot: parity with the single search, conservation, determinism, compiled drivers, bad input."""

import itertools
import math
import pickle
import warnings

import gymnasium as gym
import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ordered_entry import ORDERED_ENTRY
from sb3_contrib import MaskablePPO
from small_lots import driven, small_lot
from stable_baselines3 import DQN, PPO
from test_counted_occupancy import counted
from test_search_reference import recorded_scenario

import parkenv
from parkenv import (
    ArrivalWindow,
    InputError,
    OccupancyLog,
    OccupancyProcess,
    RecordedOccupancy,
    Scenario,
    SensorBand,
    SensorModel,
    make_scenario,
)
from parkenv.engine.fleet import DriverKind, Fleet
from parkenv.engine.records import DUE, LEFT, PARKED, SEARCHING
from parkenv.envs.sb3 import SearchVecEnv
from parkenv.studies.fields import AgentSpec
from parkenv.studies.fleet.drivers import policy_of
from parkenv.world.demand import (
    ConstantTime,
    Demand,
    ExponentialTime,
    Headways,
    ListedArrivals,
    PoissonArrivals,
)
from parkenv.world.occupancy.process import Forecast, PriorModel
from planners.heuristics import POLICIES
from planners.model_file import save_model
from planners.routes import DriveRoutes

ALL_POLICIES = POLICIES | {ORDERED_ENTRY.name: ORDERED_ENTRY}
BANDS = SensorBand(15.0, True, 0.9, 0.8, 0.1), SensorBand(15.0, False, 0.8, 0.8, 0.2)
NOISY = SensorModel(15.0, bands=BANDS)
GREEDY = DriverKind(policy=POLICIES["greedy-drive"])


def test_no_function_for_a_record_is_compiled_for_one_that_merely_begins_like_it():
    from parkenv.engine import records
    from parkenv.world.occupancy import kernel as occupancy_kernel

    modules = (occupancy_kernel, records)
    types = {
        name: numba.from_dtype(value)
        for module in modules
        for name, value in vars(module).items()
        if isinstance(value, np.dtype) and value.names
    }
    taken_for = set()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", numba.errors.NumbaExperimentalFeatureWarning)
        for (name, one), (other_name, other) in itertools.permutations(types.items(), 2):
            if one != other and one.can_convert_to(None, other) is not None:
                taken_for.add((name, other_name))
    # Functions of shared slots take the address of the record of the fleet.
    assert taken_for == {("FLEET", "SHARED_WORLD")}


def counted_scenario():
    mini = parkenv.make_scenario("mini")
    occupancy = counted(attraction=np.linspace(1.0, -1.0, mini.lot.n_slots))
    window = ArrivalWindow((0, 1), 9 * 3600.0, 12 * 3600.0)
    return mini.replace(name="counted", occupancy=occupancy, prior=None, arrival=window)


@pytest.mark.parametrize(
    ("source", "changes"),
    [
        ("mini", {}),
        ("campus", {}),
        ("street", {}),
        ("jam", {"failure_s": 3.0}),
        ("campus", {"sensor_model": NOISY}),
        (recorded_scenario(), {}),
        (counted_scenario(), {}),
    ],
)
def test_one_car_is_the_single_search_to_the_last_bit(source, changes):
    env = gym.make("parkenv/Search-v2", scenario=source, **changes).unwrapped
    fleet = Fleet(env.scenario, Demand(Headways(1)), background="process")
    rng = np.random.default_rng(0)
    for seed in range(8):
        fleet.reset(seed)
        observation, _ = env.reset(seed=seed)
        over = False
        for _ in range(300):
            assert fleet.next_car() == 0
            assert_same(observation, fleet.observation(0))
            action = rng.choice(np.flatnonzero(observation["action_mask"]))
            observation, reward, over, _, info = env.step(action)
            fleet.act(action)
            fleet.next_car()
            outcome = fleet.outcome(0)
            assert (outcome.reward, outcome.info) == (reward, info)
            if over:
                assert_same(observation, fleet.observation(0))
                fleet.release()
                assert fleet.next_car() is None
                assert fleet.cars["total_s"][0] == info["total_s"]
                break


def assert_same(one, other):
    assert one.keys() == other.keys()
    for key in one:
        np.testing.assert_array_equal(one[key], other[key], strict=True)


def random_fleet(lot_seed, n_cars, background, kinds, stay_s, patience_s, options, seed):
    problem, p, _ = small_lot(lot_seed)
    process = OccupancyProcess.from_demand(np.log(p / (1 - p)), np.zeros(168), 900.0)
    names = ("lot", "v_drive", "v_walk", "give_up_s", "sensor_model")
    fields = {name: getattr(problem, name) for name in names}
    scenario = Scenario(**fields, name="small", occupancy=process)
    demand = Demand(Headways(n_cars, 20.0), ExponentialTime(stay_s), ConstantTime(patience_s))
    drivers = [DriverKind(1.0, ALL_POLICIES.get(kind), knows, shares=shares) for kind, knows, shares in kinds]
    fleet = Fleet(scenario, demand, background=background, drivers=drivers, max_steps=60, **options)
    fleet.reset(seed)
    return fleet


one_of = st.sampled_from
kinds = st.tuples(one_of([*ALL_POLICIES, "python"]), one_of("own shared reserve full".split()), st.booleans())
times = {"delay_s": one_of([5.0, 600.0]), "tick_s": one_of([0.3, 1.0]), "manoeuvre_s": one_of([3.0, 40.0])}
switches = {"leave_full_lot": st.just(False), "sees_cars": st.just(True)}
worlds = st.integers(0, 323), st.integers(1, 30), one_of(["process", "residents", "none"])
drivers = st.lists(kinds, min_size=1, max_size=3), one_of([30.0, 600.0, 1e5]), one_of([40.0, math.inf])
some_options = st.fixed_dictionaries({}, optional=times | switches)
fleets = st.tuples(*worlds, *drivers, some_options, st.integers(0, 1000))


def check_state(fleet, time):
    cars, totals = fleet.cars, fleet.totals
    assert fleet.time >= time
    assert totals["due"] + totals["searching"] + totals["parked"] + totals["gone"] == len(cars)
    parked = np.flatnonzero(cars["state"] == PARKED)
    assert len(parked) == totals["parked"]
    assert np.count_nonzero(cars["state"] == SEARCHING) == totals["searching"]
    assert np.count_nonzero(cars["state"] == DUE) == totals["due"]
    assert len(set(cars["slot"][parked])) == len(parked)
    np.testing.assert_array_equal(fleet.slots["car"][cars["slot"][parked]], parked)
    assert np.count_nonzero(fleet.slots["car"] >= 0) == len(parked)
    assert fleet.taken()[cars["slot"][parked]].all()
    return fleet.time


@settings(max_examples=45, deadline=None)
@given(fleets, st.data())
def test_cars_are_conserved_slots_hold_one_car_and_little_s_law_holds(arguments, data):
    fleet, time = random_fleet(*arguments), -math.inf
    rng = np.random.default_rng(data.draw(st.integers(0, 99)))
    while (car := fleet.next_decision()) is not None:
        time = check_state(fleet, time)
        if time == int(time) or rng.random() < 0.1:
            assert fleet.observation_space.contains(fleet.observation(car))
        fleet.act(rng.integers(5))
    time = check_state(fleet, time)
    cars, totals = fleet.cars, fleet.totals
    assert totals["due"] == totals["searching"] == 0
    # Little's law, to the bit.
    assert totals["searching_s"] == pytest.approx(np.sum(cars["ended_at"] - cars["arrival"]), abs=1e-5)
    stayed = np.minimum(cars["left_at"], fleet.time) - cars["ended_at"]
    assert totals["parked_s"] == pytest.approx(stayed[cars["slot"] >= 0].sum(), abs=1e-5)
    fleet.run([None if kind.policy else object() for kind in fleet.drivers], until=fleet.time + 300.0)
    check_state(fleet, time)
    left = cars["state"] == LEFT
    np.testing.assert_allclose(cars["left_at"][left], (cars["ended_at"] + cars["stay_s"])[left])
    searched = np.where(cars["n_steps"] > 0, cars["ended_at"] - cars["arrival"], 0.0)
    np.testing.assert_allclose(searched, cars["drive_s"] + cars["failed_s"], atol=1e-6)
    assert (cars["queued_s"] <= cars["drive_s"] + 1e-9).all()
    assert (fleet.slots["held_by"] == -1).all()


@settings(max_examples=10, deadline=None)
@given(fleets)
def test_equal_seeds_give_equal_runs_and_demand_does_not_depend_on_drivers(arguments):
    runs = []
    for background, kinds in ((None, None), (None, None), ("none", [("random", "own", False)])):
        changed = list(arguments)
        changed[2], changed[3] = background or arguments[2], kinds or arguments[3]
        fleet, rng = random_fleet(*changed), np.random.default_rng(0)
        while fleet.next_decision() is not None:
            fleet.act(rng.integers(5))
        runs.append(fleet.cars.copy())
    same = [name for name in runs[0].dtype.names if name != "search"]
    np.testing.assert_array_equal(runs[0][same], runs[1][same])
    for name in ("arrival", "entry", "stay_s"):
        np.testing.assert_array_equal(runs[0][name], runs[2][name])


def test_the_first_car_at_a_slot_has_it_and_the_second_fails():
    class Park:
        def predict(self, observation, state=None):

            routes, vertex = DriveRoutes(scenario), int(observation["vertex"])
            return (4 if vertex == 0 else routes.move_toward(vertex, 0)), state

    scenario = parkenv.make_scenario("mini")
    demand = Demand(ListedArrivals((36000.0, 36000.0)), ConstantTime(15.0))
    first, second = driven(Fleet(scenario, demand, background="none"), 0, agents=[Park()]).cars
    assert (first["failed_parks"], second["failed_parks"]) == (0, 2)
    assert first["slot"] == second["slot"] == 0
    assert second["ended_at"] - first["ended_at"] == pytest.approx(2 * scenario.failure_s)
    assert first["left_at"] == first["ended_at"] + 15.0


def test_residents_leave_when_they_did_and_do_not_come_back(tmp_path):
    fleet = Fleet("campus", Demand(PoissonArrivals(1.0, 0.0, 86400.0)), drivers=[GREEDY])
    fleet.reset(2)
    before = fleet.taken()
    fleet.run(until=fleet.begin + 5 * 3600.0)
    standing = fleet.taken() & (fleet.slots["car"] < 0)
    assert 0 < standing.sum() < before.sum()
    assert not (standing & ~before).any()
    scenario, path = parkenv.make_scenario("mini"), tmp_path / "log.csv"
    ends = [15 + k % 3 for k in range(scenario.lot.n_slots)]
    path.write_text("bay,arrival,departure\n" + "".join(
        f"{k},{day} {begin:02}:00,{day} {end:02}:00\n"
        for day in ("2024-03-05", "2024-03-06") for k in range(len(ends)) for begin, end in ((7, ends[k]), (19, 21))
    ))  # fmt: skip
    log = RecordedOccupancy(OccupancyLog.read(path), scenario.walk_s, np.arange(len(ends)))
    fleet = Fleet(scenario.replace(occupancy=log), Demand(Headways(1, 1.0)))
    fleet.reset(0)
    midnight = fleet.begin - fleet.begin % 86_400.0
    np.testing.assert_allclose(fleet.slots["leaves_at"] - midnight, 3600.0 * np.array(ends), atol=1.0)


def test_goals_and_entries_are_drawn_by_weight():
    scenario = parkenv.make_scenario("campus")
    n_goals, n_entries = len(scenario.lot.goals), len(scenario.lot.entries)
    to, by = (1.0,) * (n_goals - 1) + (2.0,), (1.0,) + (0.0,) * (n_entries - 1)
    demand = Demand(Headways(300), goal_weights=to, entry_weights=by)
    fleet = Fleet(scenario, demand, drivers=[GREEDY])
    fleet.reset(0)
    assert set(fleet.cars["entry"]) == {scenario.lot.entry_vertices[0]}
    assert np.mean(fleet.cars["scenario_index"] == n_goals - 1) == pytest.approx(2 / (n_goals + 1), abs=0.1)


def test_a_forecast_computed_in_python_reaches_every_car():
    scenario = parkenv.make_scenario("mini")

    class Prior(PriorModel):
        n_slots = scenario.lot.n_slots

        def forecast(self, arrival):
            return Forecast(np.full(self.n_slots, 0.25), np.full(self.n_slots, 1e-3))

    fleet = Fleet(scenario.replace(prior=Prior()), Demand(Headways(3, 1.0)))
    fleet.reset(0)
    seen = set()
    while len(seen) < 3:
        car = fleet.next_decision()
        seen.add(car)
        assert (fleet.observation(car)["belief"][: scenario.lot.n_slots] == 0.25).all()
        fleet.act(4)


def test_a_copy_has_the_same_options_and_world():
    fleet = Fleet("mini", Demand(Headways(3)), background="none", tick_s=0.5)
    assert len(pickle.loads(pickle.dumps(fleet)).cars) == 0
    fleet.reset(0)
    copy = pickle.loads(pickle.dumps(fleet))
    assert (copy.begin, copy.options) == (fleet.begin, fleet.options)
    np.testing.assert_array_equal(copy.cars["arrival"], fleet.cars["arrival"])


class Raises:
    def predict(self, observation, state=None):
        raise RuntimeError("out of fuel")


def test_weights_that_do_not_fit_are_refused():
    for options, words in (
        ({"demand": Demand(goal_weights=(1.0,) * 9)}, "Demand.goal_weights has 9 numbers"),
        ({"drivers": [DriverKind(0.0)]}, "all weights are 0"),
    ):
        with pytest.raises(InputError, match=words):
            Fleet("mini", **options)


def test_an_agent_that_raises_stops_the_run_and_names_the_car():
    fleet = Fleet("mini", Demand(Headways(2)))
    with pytest.raises(gym.error.ResetNeeded):
        fleet.next_decision()
    fleet.reset(0)
    with pytest.raises(InputError, match=r"want an agent for it"):
        fleet.run()
    with pytest.raises(InputError, match=r"car 0: its agent raised RuntimeError at 0.0 s: out of fuel"):
        fleet.run([Raises()])
    assert fleet.next_decision() == 0
    with pytest.raises(InputError, match="action is 7"):
        fleet.act(7)


MINI = make_scenario("mini")
DEMAND = Demand(PoissonArrivals(60.0, 8 * 3600, 8.5 * 3600), ExponentialTime(480.0), ConstantTime(300.0))


def small(algorithm):
    policy, venv = {"net_arch": [16, 8]}, SearchVecEnv(3, "mini")
    return algorithm("MultiInputPolicy", venv, seed=0, device="cpu", policy_kwargs=policy)


@pytest.mark.parametrize(("name", "algorithm"), [("ppo", PPO), ("maskable-ppo", MaskablePPO), ("dqn", DQN)])
def test_a_trained_model_drives_every_car_by_its_own_observation(name, algorithm, tmp_path):
    model = small(algorithm)
    path = tmp_path / "model.safetensors"
    save_model(model, path)
    none, agent = policy_of(AgentSpec(name=f"{name}:{path}"), MINI)
    assert none is None
    fleet = Fleet(MINI, DEMAND, drivers=[DriverKind()], max_steps=60, leave_full_lot=False)
    fleet.reset(3)
    while (car := fleet.next_decision()) is not None:
        observation = fleet.local_observation(car)
        masks = {"action_masks": observation["action_mask"]} if algorithm is MaskablePPO else {}
        fleet.act(model.predict(observation, deterministic=True, **masks)[0])
    expected = fleet.cars[["total_s", "n_steps", "slot"]].copy()
    actual = driven(fleet, 3, agents=[agent]).cars[["total_s", "n_steps", "slot"]]
    np.testing.assert_array_equal(actual, expected)
