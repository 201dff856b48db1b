"""A map that learns from trips: what observations say about its error, trips in the map file, and their forecast."""

import gymnasium as gym
import numpy as np
import pytest
from lot_checks import refusal

from parkenv import InputError, SensorModel, make_scenario, simulate
from parkenv.compiled.keyed_random import episode_key, seed_state
from parkenv.forecast.logistic_normal import EVEN
from parkenv.forecast.map_error import Evidence, MapError, MapErrorPrior
from parkenv.mapping.inference import MapPrior, SessionLog
from parkenv.mapping.learned_map import GIVEN_MAP, NO_MAP, EmptyMap, LearnedMap, map_prior
from parkenv.mapping.store import MapStore
from parkenv.mapping.trips import DayMemory, Trip, state_likelihoods
from parkenv.studies.episodes import TripRecorder
from parkenv.world.occupancy.process import Arrival, Forecast
from parkenv.world.week import DAY_S, HOUR_S
from planners import make_agent

MORNING = Arrival(9 * HOUR_S)
GRID = np.linspace(-15.0, 15.0, 1201)
NOISY = SensorModel(hit_rate=0.9, false_alarm_rate=0.1)


def sigmoid(x):
    return 1.0 / (1.0 + np.exp(-x))


def evidence(slots, taken):
    states = np.asarray(taken, float)
    likelihood = np.column_stack([1.0 - states, states])
    return Evidence(np.asarray(slots), np.full(len(states), 9.0), likelihood, np.ones(len(states)))


def trip(key, day, slots, taken, hit_rate=1.0, false_alarm_rate=0.0, after_s=None, hour=9):
    k = len(slots)
    return Trip(
        key, day * DAY_S + hour * HOUR_S, "", np.asarray(slots), np.arange(k) * 1.0 if after_s is None else after_s,
        np.asarray(taken, bool), np.full(k, hit_rate), np.full(k, false_alarm_rate),
    )  # fmt: skip


@pytest.mark.parametrize(("taken", "free"), [(5, 1), (0, 3), (20, 20)])
def test_the_error_of_one_slot_has_its_exact_posterior(taken, free):
    """Against numerical integration of prior times likelihood."""
    error = MapError(np.array([1.0, -1.0]), [MapErrorPrior(0.0, 0.0, 0.0, 1.5, 0.0, memory_days=1e12)])
    for state in np.random.default_rng(0).permutation([1.0] * taken + [0.0] * free):
        error.observe(evidence([0], [state]), np.full((1, 1), 0.3), (0.0, 0.0))
    density = np.exp(-0.5 * (GRID / 1.5) ** 2) * sigmoid(GRID + 0.3) ** taken * sigmoid(-GRID - 0.3) ** free
    density /= density.sum()
    mean, variance = error.predict(9.0)
    p = EVEN.expit(0.3 + mean, np.sqrt(variance))[0][0, 0]
    assert p == pytest.approx(density @ sigmoid(GRID + 0.3), abs=0.01)
    assert mean[0, 1] == 0.0
    assert variance[0, 1] == pytest.approx(1.5**2)


def test_the_level_of_the_day_is_integrated_out():
    """Twelve taken slots of one day say less about the map than twelve of twelve days; both as in exact integration."""
    prior, day, n = 1.0, 1.2, 12
    probability = {}
    for days in (1, n):
        of_level = MapErrorPrior(prior, 0.0, 0.0, 0.0, 0.0, memory_days=1e12)
        error = MapError(np.linspace(1.0, -1.0, n), [of_level])
        for part in np.split(np.arange(n), days):
            error.observe(evidence(part, np.ones(len(part))), np.zeros((1, len(part))), (day, 0.0))
        level, today = GRID[:, None], GRID
        of_day = np.exp(-0.5 * (today / day) ** 2)
        of_day /= of_day.sum()
        likelihood = (sigmoid(level + today) ** (n // days) @ of_day) ** days
        density = np.exp(-0.5 * (GRID / prior) ** 2) * likelihood
        mean, variance = error.predict(9.0)
        probability[days] = float(EVEN.expit(mean, np.sqrt(variance))[0][0, 0])
        assert probability[days] == pytest.approx(density @ sigmoid(GRID) / density.sum(), abs=0.01)
    assert probability[1] < probability[n] - 0.1


def test_the_prior_that_foretold_the_observations_gains_weight():
    priors = [MapErrorPrior(0.1, 0.0, 0.0, 0.1, 0.0, 1e3), MapErrorPrior(2.0, 0.0, 0.0, 1.0, 0.0, 1e3)]
    for logit, states, winner in ((0.0, np.arange(10) % 2, 0), (-3.0, np.ones(10), 1)):
        error = MapError(np.linspace(1.0, -1.0, 20), priors)
        for day in range(4):
            logits = np.full((len(error.weights), 10), logit)
            error.observe(evidence(np.arange(0, 20, 2), np.roll(states, day)), logits, (0.5, 0.0))
        assert error.weights.max() > 0.8
        assert (error.prior_sd()[error.weights.argmax(), 0] > 1.0) == (winner == 1)


def test_a_map_without_trips_forecasts_as_before():
    scenario = make_scenario("campus")
    for base, priors in ((scenario.occupancy, GIVEN_MAP), (EmptyMap(scenario.lot.n_slots), NO_MAP)):
        before = base.forecast(MORNING)
        after = LearnedMap(base, scenario.walk_s, priors).forecast(MORNING)
        np.testing.assert_allclose(after.p_occupied, before.p_occupied, atol=2e-3)
        np.testing.assert_array_equal(after.decay_rate, before.decay_rate)
        # Planners hear that the level is less certain than a right map's.
        assert after.day_error.level > before.day_error.level


def test_an_empty_map_learns_the_level_from_half_of_the_slots_and_forgets_it():
    n, rng = 60, np.random.default_rng(0)
    learned = LearnedMap(EmptyMap(n), np.arange(n), NO_MAP)
    for day in range(10):
        slots = np.arange(0, n, 2)
        learned.learn([trip(f"{day}", day, slots, rng.random(len(slots)) < 0.9)])
    soon = learned.forecast(MORNING)
    assert soon.p_occupied[1::2].mean() == pytest.approx(0.9, abs=0.08)
    empty = LearnedMap(EmptyMap(n), np.arange(n), NO_MAP)
    assert soon.day_error.level < empty.forecast(MORNING).day_error.level
    learned.pass_time(20_000)
    np.testing.assert_allclose(learned.forecast(MORNING).p_occupied, 0.5, atol=0.01)


def test_a_map_learns_the_hours_and_the_slots_that_differ():
    """Slot 3 is taken, the others are free at nine and taken at fifteen."""
    n = 12
    learned = LearnedMap(EmptyMap(n), np.arange(n), NO_MAP)
    for day in range(8):
        for hour, level in ((9, False), (15, True)):
            taken = np.where(np.arange(n) == 3, True, level)
            learned.learn([trip(f"{day}-{hour}", day, np.arange(n), taken, hour=hour)])
    nine, fifteen = (learned.forecast(Arrival(hour * HOUR_S)).p_occupied for hour in (9, 15))
    rest = np.arange(n) != 3
    assert nine[rest].max() < 0.25 < 0.4 < nine[3]
    assert fifteen[rest].min() > 0.75


def test_later_trips_change_no_earlier_forecast_and_those_of_a_day_share_its_level_in_any_order():
    n, rng = 20, np.random.default_rng(1)
    days = [trip(f"{d}", d, rng.permutation(n)[:8], rng.random(8) < 0.7) for d in range(6)]
    forecasts = []
    for later in (days[3:], [trip("x", 9, np.arange(n), np.ones(n))]):
        learned = LearnedMap(EmptyMap(n), np.arange(n), NO_MAP)
        learned.learn(days[:3])
        forecasts.append(learned.forecast(MORNING).p_occupied)
        learned.learn(later)
    np.testing.assert_array_equal(*forecasts)
    ordered = []
    for order in (slice(None), slice(None, None, -1)):
        learned = LearnedMap(EmptyMap(n), np.arange(n), NO_MAP)
        learned.learn([trip("a", 0, days[0].slots[order], days[0].taken[order])])
        ordered.append(learned.forecast(MORNING).p_occupied)
    np.testing.assert_allclose(*ordered, atol=0.01)
    # Trips of one day share its level, so they say less than the same trips on different days.
    shared, apart = (LearnedMap(EmptyMap(n), np.arange(n), NO_MAP) for _ in range(2))
    shared.learn([trip(f"{i}", 0, np.arange(i, n, 4), np.ones(5)) for i in range(4)])
    apart.learn([trip(f"{i}", i, np.arange(i, n, 4), np.ones(5)) for i in range(4)])
    assert shared.forecast(MORNING).p_occupied.mean() < apart.forecast(MORNING).p_occupied.mean()


def test_what_a_trip_says_about_a_slot():
    """Repeated observations of one slot count as one state, which decays in between."""
    known = Forecast(np.array([0.4, 0.4]), np.array([0.0, 1e-2]))
    cases = [
        ([0], [True], [0.8 / 0.1]),
        ([0, 0], [True, False], [(0.8 * 0.2) / (0.1 * 0.9)]),
        # Slot 1 has forgotten its state after 1e4 s: the second observation says nothing about the first.
        ([1, 1], [True, False], [0.8 / 0.1]),
    ]
    for slots, taken, odds in cases:
        its = trip("a", 0, slots, taken, 0.8, 0.1, after_s=np.arange(len(slots)) * 1e4)
        states = state_likelihoods(its, known)
        assert (states.slots.tolist(), states.time.tolist()) == (slots[:1], [its.time])
        np.testing.assert_allclose(states.likelihood[:, 1] / states.likelihood[:, 0], odds, rtol=1e-9)
    assert len(state_likelihoods(trip("a", 0, [0, 0], [True, False], after_s=np.zeros(2)), known).slots) == 0


def test_a_car_that_several_drivers_see_counts_once():
    """Ten trips of a day within a slot's memory say hardly more than one, ten far apart as much as ten."""
    n, p = 12, {}
    for apart_s in (0.0, 600.0, 1e5):
        memory, known = DayMemory(n), EmptyMap(n).forecast(MORNING)
        weights = []
        for i in range(3):
            again = trip("a", 0, np.arange(n), np.ones(n), after_s=np.full(n, i * apart_s))
            weights.append(memory.add(state_likelihoods(again, known), known))
        rate = known.decay_rate[0]
        np.testing.assert_allclose(weights[0], 1.0)
        np.testing.assert_allclose(weights[1:], 1.0 - np.exp(-rate * apart_s))
    for name, hours in (("once", [9]), ("soon", 9 + np.arange(4) / 720), ("late", 9 + 3 * np.arange(4))):
        learned = LearnedMap(EmptyMap(n), np.arange(n), NO_MAP)
        learned.learn([trip(f"{hour}", 0, [3], [True], hour=hour) for hour in hours])
        p[name] = learned.forecast(MORNING).p_occupied[3]
    assert p["once"] < p["soon"] < p["once"] + 0.01 < p["late"]


def test_intervals_of_what_is_learned_hold_the_truth():
    """On days whose level differs by 1.2 logits, 90 % intervals of slots and of their mean hold about 90 %.

    A map that takes the observations of one day as independent is too sure of the mean.
    """
    n, reach, marks, day_sd = 24, 14, (1, 3, 10), 1.2
    inside = {assumed: {day: ([], []) for day in marks} for assumed in (day_sd, 0.0)}
    prior = MapErrorPrior(0.7, 0.5, 0.5, 0.6, 0.3, memory_days=1e4)
    near = np.linspace(1.0, -1.0, n)
    for seed in range(20):
        rng = np.random.default_rng(seed)
        errors = rng.multivariate_normal(np.zeros(n + 48), prior.covariance(near))
        true = errors[:n] + 0.5 * (errors[n + 8] + errors[n + 9])
        maps = {assumed: MapError(near, [prior]) for assumed in inside}
        for day in range(1, max(marks) + 1):
            slots = rng.integers(0, n - reach) + np.arange(reach)
            taken = rng.random(reach) < sigmoid(true[slots] + day_sd * rng.standard_normal())
            for assumed, error in maps.items():
                error.observe(evidence(slots, taken), np.zeros((1, reach)), (assumed, 0.0))
                if day in marks:
                    mean, variance = error.predict(9.0)
                    level = np.abs(true.mean() - mean[0].mean()) / error.common_sd(9.0)[0][0]
                    of_slots, of_level = inside[assumed][day]
                    of_slots.append(np.abs(true - mean[0]) < 1.645 * np.sqrt(variance[0]))
                    of_level.append(level < 1.645)
    for day in marks:
        of_slots, of_level = inside[day_sd][day]
        assert 0.85 < np.mean(of_slots) < 0.95
        assert 0.8 < np.mean(of_level) <= 1.0
    assert np.mean(inside[0.0][10][1]) < 0.75 < np.mean(inside[day_sd][10][1])


@pytest.mark.parametrize("sensor", [SensorModel(), NOISY, SensorModel.blind()])
def test_a_trip_holds_what_the_agent_observed(sensor):
    """With an exact sensor the observations are the truth; attempts are exact with any sensor."""
    scenario = make_scenario("jam", sensor_model=sensor)
    env = gym.make("parkenv/Search-v2", scenario=scenario)
    agent, attempts = make_agent("mdp", scenario), 0
    for seed in range(5):
        recorder = TripRecorder()
        simulate(env, agent, seed, (recorder,))
        state = env.unwrapped.state
        its = recorder.trip("a", state.arrival.time, "")
        exact = (its.hit_rate == 1.0) & (its.false_alarm_rate == 0.0)
        times = state.arrival.time + its.after_s
        true = np.array([state.world.occupied([s], t)[0] for s, t in zip(its.slots, times, strict=True)])
        agree = true == its.taken
        # The clock of the observation is float32: a slot may change within the rounding.
        assert agree[exact].mean() > 0.97
        assert set(np.flatnonzero(state.belief.observed)) <= set(np.unique(its.slots))
        attempts += exact.sum()
        if not exact[:-1].any():
            assert 0.7 < agree.mean() < 1.0
    assert attempts >= 5


def test_map_files_keep_trips(tmp_path):
    lot = make_scenario("mini").lot
    its = [trip("b", 1, [3, 1, 3], [True, False, True], 0.9, 0.2), trip("a", 0, [], [])]
    with MapStore(tmp_path / "map.sqlite", lot) as store:
        for one in its:
            store.add_trip(one)
        assert "holds a trip 'b' already" in refusal(store.add_trip, its[0])
        assert "slot 10, want slots 0 to 9" in refusal(store.add_trip, trip("c", 1, [10], [True]))
    with MapStore(tmp_path / "map.sqlite", lot, create=False) as store:
        read = store.trips()
        assert [one.key for one in read] == ["a", "b"]
        assert store.has_trip("b")
        assert not store.has_trip("c")
        for name, value in vars(its[0]).items():
            np.testing.assert_array_equal(getattr(read[1], name), value)
        assert len(store.log().time) == 0
        learned = map_prior(store.log(), read, lot.walk_m(0)).forecast(MORNING).p_occupied
    assert learned[3] > 0.5 > learned[1]


def surveyed(scenario, seeds):
    """Sessions that observe every slot exactly, on days of their own."""
    slots, arrivals, states = np.arange(scenario.lot.n_slots), [], []
    for seed in seeds:
        key = np.uint64(episode_key(seed_state(seed), 0))
        arrivals.append(scenario.occupancy.draw_arrival(scenario.arrival, key))
        states.append(scenario.occupancy.world(key, arrivals[-1]).occupied(slots, arrivals[-1].time))
    states = np.array(states)
    return SessionLog(np.array([arrival.time for arrival in arrivals]), states, np.ones_like(states))


def log_loss(prior, log):
    p = np.array([prior.forecast(Arrival(time)).p_occupied for time in log.time])
    return -np.log(np.where(log.occupied, p, 1.0 - p)).mean()


@pytest.mark.parametrize(("name", "n"), [("campus", 1), ("street", 4), ("campus", 12)])
def test_sessions_forecast_new_days_better_than_their_counts(name, n):
    scenario = make_scenario(name)
    walk, new_days = scenario.lot.walk_m(scenario.goal), surveyed(scenario, range(100, 140))
    log = surveyed(scenario, range(n))
    assert log_loss(map_prior(log, (), walk), new_days) < log_loss(MapPrior(log), new_days)


def test_trips_correct_sessions_large_lots_count_theirs_and_an_empty_map_is_refused():
    log = SessionLog(np.full(3, 9 * HOUR_S), np.zeros((3, 4), bool), np.ones((3, 4), bool))
    trips = [trip(f"{day}", day, [0, 1, 2, 3], [True] * 4) for day in range(3)]
    free, taken = (map_prior(log, its, np.arange(4.0)).forecast(MORNING).p_occupied for its in ((), trips))
    assert (free < 0.3).all()
    assert (taken > free + 0.2).all()
    log = SessionLog(np.zeros(1), np.ones((1, 1_001), bool), np.ones((1, 1_001), bool))
    assert isinstance(map_prior(log, (), np.arange(1_001.0)), MapPrior)
    empty = SessionLog(np.empty(0), np.empty((0, 4), bool), np.empty((0, 4), bool))
    assert "the map holds no session" in refusal(map_prior, empty, (), np.arange(4.0))


def test_wrong_trips_and_maps_are_refused():
    for make, message in (
        (lambda: trip("a", 0, [1, 2], [True, True], after_s=np.array([2.0, 1.0])), "after_s of trip"),
        (lambda: trip("a", 0, [1], [True], hit_rate=1.5), "rates of trip"),
        (lambda: LearnedMap(EmptyMap(3_001), np.arange(3_001)), "at most 3,000 slots"),
        (lambda: MapErrorPrior(1.0, 1.0, 1.0, 1.0, 1.0, 0.0), "memory_days is 0"),
    ):
        with pytest.raises(InputError, match=message):
            make()
