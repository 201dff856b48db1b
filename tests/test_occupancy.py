import copy
import json
import math
import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from parkenv.compiled.keyed_random import keyed_uniform, world_key
from parkenv.compiled.memory import address_of
from parkenv.errors import InputError
from parkenv.world.occupancy.arrival_window import ArrivalWindow
from parkenv.world.occupancy.process import Arrival, OccupancyProcess
from parkenv.world.week import HOUR_S, WEEK_S

NINE = Arrival(9 * HOUR_S)
KEY = world_key(7, 0)
QUERY = st.tuples(st.lists(st.integers(0, 19), min_size=1, max_size=6), st.floats(0, 2e5))


def constant_process(n, arrival, departure):
    return OccupancyProcess(np.ones(n), np.full(168, arrival), np.ones(n), np.full(168, departure))


def busy_process(n=20):
    rng = np.random.default_rng(0)
    return OccupancyProcess.from_demand(rng.normal(0, 2, n), rng.normal(0, 2, 168), mean_stay_s=1800)


def uniforms(key, streams, slots, indices):
    return np.array([keyed_uniform(key, a, b, c) for a, b, c in zip(streams, slots, indices, strict=True)])


def test_keyed_uniforms_are_uniform_and_their_neighbours_independent():
    n = 40_000
    zero, run = np.zeros(n, int), np.arange(n)
    base = uniforms(KEY, zero, zero, run)
    assert base.min() > 0
    assert base.max() < 1
    assert base.mean() == pytest.approx(1 / 2, abs=4 / math.sqrt(12 * n))
    assert base.var() == pytest.approx(1 / 12, abs=4 * math.sqrt(1 / 180 / n))
    assert np.histogram(base, 16, (0, 1))[0] == pytest.approx(n / 16, abs=5 * math.sqrt(n / 16))
    others = {
        "next index": uniforms(KEY, zero, zero, run + 1),
        "next slot": uniforms(KEY, zero, zero + 1, run),
        "next stream": uniforms(KEY, zero + 1, zero, run),
        "slot and index swapped": uniforms(KEY, zero, run, zero),
        "next episode": uniforms(world_key(7, 1), zero, zero, run),
    }
    for name, other in others.items():
        assert abs(np.corrcoef(base, other)[0, 1]) < 4 / math.sqrt(n), name


@given(seed=st.integers(0, 2**200), episode=st.integers(0, 2**70))
def test_world_keys_accept_big_seeds_and_tell_them_apart(seed, episode):
    keys = {int(world_key(seed + i, episode + j)) for i in range(2) for j in range(2)}
    assert len(keys) == 4
    assert world_key(seed, episode) == world_key(seed, episode)


def test_the_marginal_solves_its_differential_equation_and_repeats_weekly():
    process = busy_process()
    for time in (1.0, 3.5 * HOUR_S, 100.3 * HOUR_S):
        arrival, departure = process.factors * process.profiles[:, int(time // HOUR_S), None]
        p, step = process.marginal(time), 0.01
        slope = (process.marginal(time + step) - process.marginal(time - step)) / (2 * step)
        assert slope == pytest.approx(arrival * (1 - p) - departure * p, rel=1e-4, abs=1e-10)
        assert process.marginal(time + WEEK_S) == pytest.approx(p, abs=1e-12)


def test_a_slow_chain_needs_the_whole_week_for_its_marginal():
    # Nothing is forgotten in a week, so the time average of the rates decides.
    arrival = np.zeros(168)
    arrival[:42] = 4e-12
    process = OccupancyProcess(np.ones(1), arrival, np.ones(1), np.full(168, 3e-12))
    assert process.marginal(50 * HOUR_S)[0] == pytest.approx(1 / 4, abs=1e-5)


def test_holding_times_skip_the_hours_in_which_nobody_leaves():
    departure = np.zeros(168)
    departure[17] = 1e-2
    process = OccupancyProcess(np.full(500, 1.0), np.full(168, 1e-2), np.ones(500), departure)
    world = process.world(KEY, NINE)
    taken = np.flatnonzero(world.occupied(np.arange(500), NINE.time))
    freed = world.next_free(taken, NINE.time)
    assert np.all((freed % WEEK_S >= 17 * HOUR_S) & (freed % WEEK_S <= 18 * HOUR_S))


def test_without_rates_a_state_lasts_for_ever():
    never_left = constant_process(50, 1e-3, 0.0).world(KEY, NINE)
    assert never_left.occupied(np.arange(50), 100 * WEEK_S).all()
    assert np.all(never_left.next_free(np.arange(50), NINE.time) == np.inf)
    frozen = constant_process(50, 0.0, 0.0)
    assert np.all(frozen.marginal(0.0) == 0.5)
    world = frozen.world(KEY, NINE)
    first = world.occupied(np.arange(50), NINE.time)
    assert np.array_equal(world.occupied(np.arange(50), 100 * WEEK_S), first)
    assert np.array_equal(world.next_free(np.arange(50), NINE.time), np.where(first, np.inf, NINE.time))


@settings(max_examples=60)
@given(queries=st.lists(QUERY, min_size=1, max_size=12), data=st.data())
def test_answers_do_not_depend_on_the_order_of_looks(queries, data):
    process = busy_process()
    world = process.world(KEY, NINE)

    def answers(world, query):
        slots, after = query
        time = NINE.time + after
        return world.occupied(slots, time).tolist(), world.next_free(slots, time).tolist()

    expected = [answers(process.world(KEY, NINE), query) for query in queries]
    for i in data.draw(st.permutations(range(len(queries)))):
        assert answers(world, queries[i]) == expected[i]
    for twin in (copy.deepcopy(world), pickle.loads(pickle.dumps(world))):
        assert [answers(twin, query) for query in queries] == expected


@settings(max_examples=60)
@given(after=st.floats(0, 2e5), key=st.integers(0, 2**64 - 1))
def test_a_slot_is_free_from_next_free_on_and_not_before(after, key):
    world, slots, time = busy_process().world(np.uint64(key), NINE), np.arange(20), NINE.time + after
    free_at = world.next_free(slots, time)
    assert np.all(free_at >= time)
    assert np.array_equal(free_at == time, ~world.occupied(slots, time))
    for slot, at in zip(slots, free_at, strict=True):
        assert not world.occupied([slot], at)[0]
        assert at == time or world.occupied([slot], (time + at) / 2)[0]


def test_forecast_is_the_clipped_marginal():
    process = OccupancyProcess([1.0, 0.0, 1.0], np.full(168, 1e-4), [1.0, 1.0, 0.0], np.full(168, 1e-4))
    assert process.forecast(NINE).p_occupied == pytest.approx([0.5, 0.001, 0.999])


def test_from_demand_has_the_demanded_equilibrium():
    process = OccupancyProcess.from_demand([-1.0, 0.0, 2.0], np.full(168, 0.5), mean_stay_s=3600)
    assert process.marginal(5e5) == pytest.approx(1 / (1 + np.exp(-np.array([-0.5, 0.5, 2.5]))))
    assert process.departure_profile == pytest.approx(1 / 3600)


@pytest.mark.parametrize("target", [0.02, 0.5, 0.97])
def test_at_mean_occupancy_hits_its_target_and_keeps_the_order_of_slots(target):
    process = busy_process()
    shifted = process.at_mean_occupancy(target, NINE.time)
    assert shifted.marginal(NINE.time).mean() == pytest.approx(target, abs=1e-6)
    ratio = shifted.arrival_factor / process.arrival_factor
    assert ratio == pytest.approx(ratio[0])


def test_a_file_gives_the_same_process_back(tmp_path):
    path, process = tmp_path / "process.json", busy_process()
    process.to_file(path)
    assert np.array_equal(OccupancyProcess.from_file(path).factors, process.factors)
    assert np.array_equal(OccupancyProcess.from_file(path).profiles, process.profiles)
    assert [p.name for p in tmp_path.iterdir()] == ["process.json"]


def change(**fields):
    return lambda content: content | fields


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (change(format="other"), '"format": "parkenv-occupancy-process"'),
        (change(version=2), "version is 2, want 1"),
        (change(colour="red"), "missing or unknown fields: colour"),
        (lambda c: {k: v for k, v in c.items() if k != "arrival_factor"}, "missing or unknown fields"),
        (change(arrival_profile=[1e-4]), r"arrival_profile has shape \(1,\), want \(168,\)"),
        (change(arrival_factor=[1.0] * 19 + [-1.0]), r"arrival_factor\[19\] is -1.0, want a finite number"),
        (change(arrival_factor=[[1.0], 2.0]), "arrival_factor is .*want numbers"),
        (change(arrival_factor=[1e12] * 20), "want factor .* profile <= 1000"),
        (lambda c: [], "want an occupancy process, a JSON object"),
    ],
)
def test_a_bad_file_is_refused_by_name(tmp_path, spoil, message):
    path = tmp_path / "process.json"
    busy_process().to_file(path)
    path.write_text(json.dumps(spoil(json.loads(path.read_text()))))
    with pytest.raises(InputError, match=rf"process\.json: .*{message}"):
        OccupancyProcess.from_file(path)


def test_arrivals_are_uniform_over_the_window():
    window, process = ArrivalWindow.parse("08:00-09:30", days="mon,sat"), busy_process()
    times = np.array([process.draw_arrival(window, world_key(1, e)).time for e in range(4000)])
    days, seconds = np.divmod(times, 86_400)
    assert set(days) == {0.0, 5.0}
    assert (days == 0).mean() == pytest.approx(0.5, abs=0.04)
    assert seconds.min() >= 8 * HOUR_S
    assert seconds.max() < 9.5 * HOUR_S
    assert seconds.mean() == pytest.approx(8.75 * HOUR_S, abs=120)
    assert abs(np.corrcoef(days, seconds)[0, 1]) < 0.07


def test_window_parse():
    assert ArrivalWindow.parse("08:00-13:00") == ArrivalWindow()
    assert ArrivalWindow.parse("0:00-24:00", "all") == ArrivalWindow(tuple(range(7)), 0.0, 86_400.0)
    assert ArrivalWindow.parse("10:00-10:00", "weekend").draw_second(KEY) == 10 * HOUR_S


@pytest.mark.parametrize("slot", [-1, 20])
def test_a_slot_that_is_not_there_is_an_index_error(slot):
    with pytest.raises(IndexError, match="slot index out of range"):
        busy_process().world(KEY, NINE).occupied([slot], NINE.time)


def test_a_process_is_mapped_to_another_lot_fullest_nearest():
    process = OccupancyProcess.from_demand(np.array([-1.0, 2.0, 0.5]), np.zeros(168))
    walk = np.array([90.0, 10.0, 50.0, 70.0, 20.0, 30.0])
    laid = process.mapped_to_lot(walk)
    fullness = laid.marginal(0.0)
    assert laid.n_slots == 6
    assert (np.diff(fullness[np.argsort(walk)]) <= 1e-12).all()
    np.testing.assert_allclose(np.unique(fullness), np.unique(process.marginal(0.0)))


def test_addresses_of_arrays_of_another_type_are_refused():
    """Compiled code would misread them."""
    assert address_of(np.zeros(3), np.float64) > 0
    for wrong in (np.zeros(3, np.float32), np.zeros((3, 2))[:, 0]):
        with pytest.raises(TypeError, match=r"want .*float64"):
            address_of(wrong, np.float64)
