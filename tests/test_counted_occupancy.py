"""Worlds that follow the counts of a car park."""

import warnings
from datetime import datetime, timedelta

import gymnasium as gym
import numpy as np
import pytest
from car_park_counts import CURVE, write_counts
from command_line import ran, refused, rows_in, summary_of
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.special import expit, logit

from parkenv import ArrivalWindow, InputError, make_scenario
from parkenv.envs.search_vector import ParkSearchVectorEnv
from parkenv.scenarios.spec import ScenarioSpec
from parkenv.world.occupancy.counted import CountedOccupancy, level_of_mean, process_of_curve
from parkenv.world.occupancy.process import Arrival

N = 120
ATTRACTION = 1.6 * np.linspace(1.0, -1.0, N) + np.random.default_rng(4).normal(0.0, 0.6, N)
MONDAY, TUESDAY = "2024-01-01", "2024-01-02"
DAY = "2024-01-29"


def counted(**changes):
    """Two equal days whose forecast is right in the mean and wrong by 0.8 logits."""
    curves = np.stack([CURVE, CURVE])
    its = {"days": (MONDAY, TUESDAY), "occupied": curves, "level": logit(curves), "attraction": ATTRACTION}
    return CountedOccupancy(**its | {"level_sd": np.full((2, 24), 0.8)} | changes)


@settings(max_examples=25)
@given(arrays(float, 24, elements=st.floats(0.0, 1.0)))
def test_the_mean_follows_any_counts(curve):
    process = process_of_curve(ATTRACTION, curve, 7200.0)
    mean = [process.marginal((hour + 1) * 3600.0).mean() for hour in range(24)]
    np.testing.assert_allclose(mean, np.clip(curve, 0.002, 0.998), atol=2e-3)


def test_popular_slots_are_fuller():
    p = process_of_curve(ATTRACTION, CURVE, 7200.0).marginal(11 * 3600.0)
    order = np.argsort(ATTRACTION)
    assert (np.diff(p[order]) >= 0).all()
    assert p[order[-1]] > 0.98 > 0.9 > p[order[0]]


def test_the_world_is_as_full_as_counted():
    occupancy = counted()
    taken = [
        occupancy.world(np.uint64(key), Arrival(10 * 3600.0, MONDAY)).occupied(np.arange(N), 10 * 3600.0)
        for key in range(200)
    ]
    assert np.mean(taken) == pytest.approx(CURVE[9], abs=0.01)


def test_the_forecast_is_the_mean_over_possible_days():
    forecast = counted().forecast(Arrival(10 * 3600.0, MONDAY))
    levels = logit(CURVE[9]) + 0.8 * np.random.default_rng(0).normal(size=100_000)
    assert forecast.p_occupied.mean() == pytest.approx(expit(levels).mean(), abs=2e-3)


def test_the_day_error_moves_the_lot_by_that_of_its_level():
    level = logit(CURVE[11])
    error = counted().forecast(Arrival(11.5 * 3600.0, MONDAY)).day_error
    middle = level_of_mean(ATTRACTION, CURVE[11])
    low, high = (logit(expit(ATTRACTION + middle + side * error.level).mean()) for side in (-1, 1))
    assert (high - low) / 2 == pytest.approx(0.8, abs=0.05)
    assert low < level < high
    assert error.slope == 0.0


def test_only_days_that_were_counted_throughout_are_replayed():
    occupied = np.stack([CURVE, CURVE])
    occupied[0, 9] = np.nan
    occupancy = counted(occupied=occupied)
    assert occupancy.days_in(ArrivalWindow(start_s=8 * 3600.0, end_s=13 * 3600.0)) == [TUESDAY]
    assert occupancy.days_in(ArrivalWindow(start_s=10 * 3600.0, end_s=13 * 3600.0)) == [MONDAY, TUESDAY]
    with pytest.raises(InputError, match="no day on sat was counted from 8:00 to 13:00"):
        occupancy.days_in(ArrivalWindow(weekdays=(5,)))
    # The gap is filled between its neighbours.
    mean = occupancy.process_of(MONDAY).marginal(10 * 3600.0).mean()
    assert mean == pytest.approx((CURVE[8] + CURVE[10]) / 2, abs=2e-3)


def test_wrong_shapes_and_days_are_refused():
    with pytest.raises(InputError, match=r"level has shape \(2, 23\), want \(2, 24\)"):
        counted(level=np.zeros((2, 23)))
    with pytest.raises(InputError, match="want a counted day"):
        counted().forecast(Arrival(0.0, "2024-01-03"))


def test_searches_meet_the_counted_days():
    lot = make_scenario("campus").lot
    occupancy = counted(attraction=np.linspace(1.6, -1.6, lot.n_slots))
    scenario = make_scenario("campus", occupancy=occupancy)
    env = gym.make("parkenv/Search-v2", scenario=scenario).unwrapped
    together, _ = ParkSearchVectorEnv(6, scenario).reset(seed=0)
    days = set()
    for seed in range(6):
        observation, _ = env.reset(seed=seed)
        arrival = env.state.arrival
        days.add(arrival.day)
        forecast = occupancy.forecast(arrival)
        np.testing.assert_array_equal(observation["p_occupied"], forecast.p_occupied.astype(np.float32))
        assert observation["day_error"][0] == np.float32(forecast.day_error.level)
        for action in np.random.default_rng(seed).integers(0, 4, 60):
            env.step(action)
        belief, world = env.state.belief, occupancy.world(env.state.key, arrival)
        for slot in np.flatnonzero(belief.observed):
            when = arrival.time + belief.time - belief.age[slot]
            assert world.occupied([slot], when)[0] == belief.observed_taken[slot]
        np.testing.assert_array_equal(together["belief"][seed][: lot.n_slots], observation["p_occupied"])
    assert days == {MONDAY, TUESDAY}


def spec_of(file, mode):
    counts = {"file": str(file), "car_park": "P0"}
    occupancy = {"counts": counts, "replay_from": "2024-01-29", "forecast_from": mode}
    return ScenarioSpec.parse({"name": "counted", "lot": "mini", "occupancy": occupancy}, "test")


@pytest.mark.filterwarnings("ignore:.*readings corrected")
@pytest.mark.parametrize("mode", ["rolling", "past"])
def test_no_later_count_reaches_a_forecast(tmp_path, mode):
    first = make_scenario(spec_of(write_counts(tmp_path / "a.csv"), mode)).occupancy
    changed = write_counts(tmp_path / "b.csv", change=lambda _, day, taken: taken if day < 34 else 0.5)
    second = make_scenario(spec_of(changed, mode)).occupancy
    assert first.days == second.days
    assert first.days[0] == "2024-01-29"
    for name in ("level", "level_sd"):
        same = (getattr(first, name) == getattr(second, name)).all(axis=1)
        # The first changed day is the seventh that is replayed; it is predicted before it is counted.
        assert same[:7].all()
        assert same.all() == (mode == "past")


def test_every_car_park_is_a_scenario(tmp_path):
    file = write_counts(tmp_path / "counts.csv")
    ran(
        "compare", "--scenario", "mini", "--occupancy", file, "--car-park", "all", "--replay-from", "2024-01-29",
        "--agents", "first-free", "--episodes", "1", "--jobs", "1", "--out", tmp_path / "out",
    )  # fmt: skip
    rows = summary_of(tmp_path / "out")["rows"]
    assert [row["scenario"] for row in rows] == ["mini P0", "mini P1"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--car-park", "P9", "--replay-from", DAY], "'P9'"),
        (["--car-park", "P0", "--replay-from", "2024-01-02"], "2024-01-03"),
        ([], "has 3 car parks, want --car-park, one of P0, P1, empty"),
        (["--car-park", "P0", "--capacity", 90], "has a column 'capacity', want no --capacity"),
        (["--car-park", "P0", "--replay-from", DAY, "--forecast-from", "others"], "rolling or past"),
    ],
)
def test_what_counts_cannot_do_is_refused(tmp_path, options, message):
    file = write_counts(tmp_path / "counts.csv")
    words = ("compare", "--scenario", "mini", "--occupancy", file, *options)
    assert message in refused(*words, "--out", tmp_path / "out")


def test_a_saturday_as_usual_needs_times_free_places_and_their_number_only(tmp_path):
    table, begin = tmp_path / "export.csv", datetime(2024, 5, 1)
    hours = [begin + timedelta(hours=h) for h in range(24 * 28)]
    full = [0.9 if time.weekday() == 5 and 9 <= time.hour < 18 else 0.3 for time in hours]
    shares = zip(hours, full, strict=True)
    lines = [f"{time:%d.%m.%Y %H:%M};{120 * (1 - share):.0f}" for time, share in shares]
    table.write_text("\n".join(["Zeit;frei", *lines]), encoding="utf-8")
    words = ("compare", "--scenario", "mini", "--occupancy", table, "--days", "sat", "--hours", "11:00-15:00")
    words += ("--agents", "first-free,belief", "-n", 3, "--jobs", 1, "--out", tmp_path / "out")
    assert "want the number of places (a column capacity, or --capacity)" in refused(*words)
    ran(*words, "--capacity", 120)
    rows = rows_in(tmp_path / "out" / "episodes.csv")
    assert {row["day"] for row in rows} <= {"2024-05-04", "2024-05-11", "2024-05-18", "2024-05-25"}
    assert np.mean([float(row["occupancy"]) for row in rows]) == pytest.approx(0.9, abs=0.1)


def test_percentages_and_cleaned_readings_are_told(tmp_path):
    hours = [datetime(2024, 5, 1) + timedelta(hours=h) for h in range(24 * 7)]
    share = [100 if 9 <= time.hour < 18 else 30 for time in hours]
    lines = [f"{time:%d.%m.%Y %H:%M};{part}" for time, part in zip(hours, share, strict=True)]
    text = "\n".join(["Zeit;belegt", *lines, "01.05.2024 12:00;-3"])
    (tmp_path / "belegt.csv").write_text(text, encoding="utf-8")
    for capacity, warned in ((120, True), (100, False)):
        occupancy = {"counts": {"file": str(tmp_path / "belegt.csv"), "capacity": capacity}}
        spec = ScenarioSpec.parse({"name": "c", "lot": "mini", "occupancy": occupancy}, "test")
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            make_scenario(spec)
        told = " ".join(str(warning.message) for warning in caught)
        assert "readings corrected or left out: " in told
        assert "duplicate 1" in told
        assert ("if they are percentages, give --capacity 100" in told) == warned
