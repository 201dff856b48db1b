import gzip
import math
from dataclasses import replace
from datetime import date
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from parkenv.compiled.keyed_random import world_key
from parkenv.errors import InputError
from parkenv.world.occupancy.arrival_window import ArrivalWindow
from parkenv.world.occupancy.gaps import StateLaw, day_states
from parkenv.world.occupancy.log import OccupancyLog, day_class, weekday_of
from parkenv.world.occupancy.process import Arrival
from parkenv.world.occupancy.recorded import RecordedOccupancy, read_mapping
from parkenv.world.week import DAY_S, HOUR_S

REAL_LOG = Path(__file__).parents[2] / "shared" / "data" / "cnr_ext" / "occupancy_15_days.csv.gz"
HEADER = "datetime,camera,slot_id,weather,occupied\n"
MONDAYS = ("2024-01-01", "2024-01-08", "2024-01-15", "2024-01-22", "2024-01-29")
SATURDAYS = ("2024-01-06", "2024-01-13")


def write(tmp_path, text, name="log.csv"):
    path = tmp_path / name
    path.write_bytes(gzip.compress(text.encode()) if name.endswith(".gz") else text.encode())
    return path


def random_log(n_slots=4, days=(*MONDAYS, *SATURDAYS), seed=0, change_days=()):
    """Observations every half hour from 7 to 19; slot s is taken with the probability (s + 1) / (n + 1)."""
    rng, days = np.random.default_rng(seed), tuple(sorted(days))
    grid = np.meshgrid(range(n_slots), range(len(days)), range(24), indexing="ij")
    slot, day, step = (a.ravel() for a in grid)
    occupied = rng.random(slot.size) < (slot + 1) / (n_slots + 1)
    changed = np.isin(day, [days.index(d) for d in change_days])
    ids = tuple(f"s{i}" for i in range(n_slots))
    return OccupancyLog(ids, days, slot, day, 7 * HOUR_S + 1800.0 * step, occupied ^ changed)


def at(day, hour):
    return Arrival(weekday_of(day) * DAY_S + hour * HOUR_S, day)


@pytest.mark.parametrize("name", ["log.csv", "log.csv.gz"])
def test_a_log_is_read(tmp_path, name):
    text = HEADER + (
        "2024-01-01 07:00,1,b,sunny,1\n2024-01-01 07:00,1,a,sunny,0\n\n2024-01-01T07:30:30,2,a,,1\n"
        "2024-01-06 08:00,1,a,rainy,0\n"
    )
    log = OccupancyLog.read(write(tmp_path, text, name))
    assert (log.slot_ids, log.days) == (("b", "a"), ("2024-01-01", "2024-01-06"))
    assert [day_class(day) for day in log.days] == ["weekday", "weekend"]
    assert (log.slot.tolist(), log.day.tolist()) == ([0, 1, 1, 1], [0, 0, 0, 1])
    assert log.second.tolist() == [25_200.0, 25_200.0, 27_030.0, 28_800.0]
    assert log.occupied.tolist() == [True, False, True, False]
    assert log.recorded.tolist() == [[True, False], [True, True]]


def test_several_logs_are_one_by_date(tmp_path):
    text = "2024-01-02 07:00,1,a,sunny,0\n2024-01-02 07:00,1,b,sunny,1\n"
    later = write(tmp_path, HEADER + text, "later.csv")
    text = "2024-01-01 08:00,1,b,sunny,0\n2024-01-01 09:00,1,a,sunny,1\n"
    first = write(tmp_path, HEADER + text, "first.csv")
    log = OccupancyLog.read(later, first)
    assert (log.slot_ids, log.days) == (("a", "b"), ("2024-01-01", "2024-01-02"))
    assert (log.day.tolist(), log.slot.tolist()) == ([0, 0, 1, 1], [0, 1, 0, 1])
    assert log.occupied.tolist() == [True, False, False, True]
    other = write(tmp_path, HEADER + "2024-01-03 07:00,1,c,sunny,0\n", "other.csv")
    assert OccupancyLog.read(first, other).recorded.tolist() == [[True, False], [True, False], [False, True]]
    stays = write(tmp_path, "bay,arrival,departure\na,2024-01-03 07:00,2024-01-03 08:00\n", "stays.csv")
    with pytest.raises(InputError, match=r"stays.csv: has the columns .*, as in .*first.csv"):
        OccupancyLog.read(first, stays)


def test_camera_and_weather_may_be_absent_and_the_later_of_two_cameras_stands(tmp_path):
    text = "slot_id,occupied,datetime\na,1,2024-01-01 07:00\na,0,2024-01-01 07:00\na,0,2024-01-01 08:00\n"
    assert OccupancyLog.read(write(tmp_path, text)).occupied.tolist() == [False, False]


def replay_of(seconds, states):
    zeros = np.zeros(len(seconds), int)
    log = OccupancyLog(("a",), MONDAYS[:1], zeros, zeros, seconds, states)
    model = RecordedOccupancy(log, np.zeros(1))
    law = StateLaw(np.zeros((1, 48)), np.full(24, 1e-3))
    model._states[0] = day_states(log, np.zeros(1, int), law, np.random.default_rng(0))
    return model.world(0, at(MONDAYS[0], 0))


@settings(max_examples=50, deadline=None)
@given(
    looks=st.dictionaries(st.integers(0, 86_399), st.booleans(), min_size=1, max_size=8),
    time=st.floats(0, 9e4),
)
def test_the_replay_agrees_with_its_rule(looks, time):
    seconds = sorted(looks)
    world = replay_of(seconds, [looks[s] for s in seconds])

    def rule(time):
        """The last look, if it is near enough, or the nearest one; none if that is more than two hours away."""
        held = [s for s in seconds if s <= time][-1:]
        after = [s for s in seconds if s > time][:1]
        if held and after and after[0] - held[0] <= 7200:
            return looks[held[0]]
        near = min(held + after, key=lambda s: (abs(s - time), -s))
        return looks[near] if abs(near - time) < 7200 and time < DAY_S else None

    taken = world.occupied([0], time)[0]
    assert rule(time) in (None, taken)
    free_at = world.next_free([0], time)[0]
    assert (free_at == time) == (not taken)
    if free_at < math.inf:
        assert not world.occupied([0], free_at)[0]
    else:
        assert world.occupied([0], 2 * DAY_S)[0]


def test_mean_occupancy_weighs_time_between_the_first_and_the_last_look():
    seconds = [7 * HOUR_S, 7.5 * HOUR_S, 9 * HOUR_S, 0.0]
    log = OccupancyLog(("a", "b"), MONDAYS[:1], [0, 0, 0, 1], [0] * 4, seconds, [1, 0, 1, 1])
    assert log.mean_occupancy("weekday") == pytest.approx([0.25, math.nan], nan_ok=True)
    assert log.mean_occupancy("weekday", (7, 8))[0] == pytest.approx(0.5)
    assert np.isnan(log.mean_occupancy("weekend")).all()
    with pytest.raises(InputError, match="class of day is 'sunday'"):
        log.mean_occupancy("sunday")


def test_the_fullest_log_slots_stand_nearest_to_the_goal():
    log, walk = random_log(n_slots=8), np.array([30.0, 10.0, 20.0, 40.0])
    arrival = at(MONDAYS[0], 9)
    fullest_first = np.argsort(-log.mean_occupancy("weekday", days=np.array(log.days) != MONDAYS[0]))
    world = RecordedOccupancy(log, walk).world(0, arrival)
    day = log.days.index(MONDAYS[0])
    for lot_slot, rank in ((1, 0), (2, 2), (0, 4), (3, 6)):
        looks = (log.slot == fullest_first[rank]) & (log.day == day)
        times = log.second[looks][log.second[looks] >= arrival.time]
        replayed = [world.occupied([lot_slot], time)[0] for time in times]
        assert replayed == log.occupied[looks & (log.second >= arrival.time)].tolist()


def test_a_day_on_which_a_slot_was_not_seen_is_passed_over():
    log = random_log(n_slots=2, days=MONDAYS)
    seen = ~((log.slot == 1) & (log.day == 0))
    log = replace(log, **{name: getattr(log, name)[seen] for name in ("slot", "day", "second", "occupied")})
    mapped = RecordedOccupancy(log, np.zeros(2)).mapped_log(MONDAYS[0])
    assert sorted(mapped.record.tolist()) == [0, 1 * 2 + 1]
    assert mapped.held_out == {0, 1}


def assert_only_worlds_differ(model, changed, arrival):
    """Forecasts are the same, and worlds exact opposites of each other."""
    before, after = model.forecast(arrival), changed.forecast(arrival)
    assert np.array_equal(before.p_occupied, after.p_occupied)
    assert np.array_equal(before.decay_rate, after.decay_rate)
    assert before.day_error == after.day_error
    slots = np.arange(model.n_slots)
    taken, opposite = (m.world(0, arrival).occupied(slots, arrival.time) for m in (model, changed))
    assert np.array_equal(taken, ~opposite)


@pytest.mark.parametrize("n", [2, 4, 11])
@pytest.mark.parametrize("day", [MONDAYS[0], MONDAYS[3]])
def test_the_forecast_knows_nothing_of_the_days_that_are_replayed(n, day):
    def replay(*change_days):
        return RecordedOccupancy(random_log(change_days=change_days), np.arange(float(n)))

    model, arrival = replay(), at(day, 9.2)
    held_out = [model.log.days[d] for d in model.mapped_log(arrival.day).held_out]
    assert day in held_out
    assert_only_worlds_differ(model, replay(*held_out), arrival)
    other = replay(next(d for d in MONDAYS if d not in held_out)).forecast(arrival)
    assert not np.array_equal(model.forecast(arrival).p_occupied, other.p_occupied)


@pytest.mark.parametrize("forecast_from", ["past", "rolling"])
@pytest.mark.parametrize("n", [3, 8])
def test_nothing_of_a_replayed_or_later_day_is_known_beforehand(forecast_from, n):
    days = tuple(f"2024-01-{day:02d}" for day in (1, 2, 3, 4, 8, 9, 10, 11, 12))

    def replay(*change_days):
        log = random_log(days=days, change_days=change_days)
        return RecordedOccupancy(log, np.arange(float(n)), None, date(2024, 1, 8), forecast_from)

    # Two copies of each slot replay two consecutive days; on the last one, the day before it.
    assert replay().days_in(ArrivalWindow()) == list(days[4:])
    day = "2024-01-12" if n > 4 else "2024-01-09"
    first = days.index(day) - (n > 4)
    kept = first if forecast_from == "rolling" else 4
    model, changed, arrival = replay(), replay(*days[kept:]), at(day, 9.2)
    mapped = model.mapped_log(day)
    assert mapped.held_out == {days.index(day)} | ({first} if n > 4 else set())
    assert mapped.known.tolist() == list(range(kept))
    assert np.array_equal(changed.mapped_log(day).log_slot, mapped.log_slot)
    assert_only_worlds_differ(model, changed, arrival)
    earlier = replay(days[kept - 1]).forecast(arrival)
    assert not np.array_equal(model.forecast(arrival).p_occupied, earlier.p_occupied)


def test_arrivals_are_recorded_days_of_the_window():
    model = RecordedOccupancy(random_log(), np.arange(4.0))
    window = ArrivalWindow.parse("08:00-13:00", "mon")
    arrivals = [model.draw_arrival(window, world_key(0, e)) for e in range(1000)]
    days, counts = np.unique([arrival.day for arrival in arrivals], return_counts=True)
    assert tuple(days) == MONDAYS
    assert counts == pytest.approx(200, abs=60)
    assert all(8 * HOUR_S <= arrival.time < 13 * HOUR_S for arrival in arrivals)
    saturday = model.draw_arrival(ArrivalWindow.parse("08:00-13:00", "weekend"), world_key(0, 0))
    assert saturday.day in SATURDAYS
    assert saturday.time // DAY_S == 5


def dated(model, n, day, forecast_from="others"):
    return RecordedOccupancy(model.log, np.zeros(n), None, date(2024, 1, day), forecast_from)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda m: m.draw_arrival(ArrivalWindow.parse("08:00-09:00", "tue,sun"), 0), "no recorded day"),
        (lambda m: m.world(0, Arrival(0.0)), "Arrival.day is '', want a recorded day"),
        (lambda m: m.world(0, Arrival(DAY_S, MONDAYS[0])), "Arrival.time is 86400.0"),
        (lambda m: m.world(0, at(MONDAYS[0], 9)).occupied([0], 8 * HOUR_S), "time is 28800.0"),
        (lambda m: RecordedOccupancy(m.log, [math.nan]), "walk_m"),
        (lambda m: RecordedOccupancy(m.log, [1.0], mapping=[9]), "mapping: want"),
        (lambda m: RecordedOccupancy(m.log, [1.0], forecast_from="past"), "forecast_from is 'past'"),
        (lambda m: dated(m, 1, 1, "rolling").mapped_log(MONDAYS[0]), "want at least one before 2024-01-01"),
        (lambda m: dated(m, 1, 29).days_in(ArrivalWindow.parse("8:00-9:00", "tue")), "day from 2024-01-29"),
        (lambda m: dated(m, 9, 22, "past").mapped_log(MONDAYS[4]), "2 days of the class from 2024-01-22"),
        (lambda m: RecordedOccupancy(m.log, np.zeros(8)).forecast(at(SATURDAYS[0], 9)), "replays 2 of 2 "),
        (lambda m: RecordedOccupancy(m.log, np.zeros(80)).forecast(at(MONDAYS[0], 9)), "serve 20 slots"),
    ],
)
def test_what_a_log_cannot_serve_is_refused_in_words(make, message):
    with pytest.raises(InputError, match=message):
        make(RecordedOccupancy(random_log(), np.arange(4.0)))


def test_a_mapping_is_read_and_used(tmp_path):
    log = random_log()
    path = write(tmp_path, "log_slot_id,slot_id\ns3,B\ns0,A\ns3,C\n", "mapping.csv")
    mapping = read_mapping(path, ["A", "B", "C"], log.slot_ids, log.source)
    assert mapping.tolist() == [0, 3, 3]
    assert read_mapping(path, ["A", "B", "C", "D"], log.slot_ids[:1], "log").tolist() == [0, -1, -1, -1]
    mapped = RecordedOccupancy(log, np.array([3.0, 2.0, 1.0]), mapping).mapped_log(MONDAYS[0])
    monday, next_monday = (log.days.index(day) * 4 for day in MONDAYS[:2])
    assert mapped.record.tolist() == [monday, next_monday + 3, monday + 3]


@pytest.fixture(scope="module")
def real_log():
    if not REAL_LOG.exists():
        pytest.skip("the CNRPark-EXT log is not in shared/data")
    return OccupancyLog.read(REAL_LOG)


def test_the_real_log_shows_the_morning_fill_up(real_log):
    assert (len(real_log.slot_ids), len(real_log.days)) == (164, 15)
    assert real_log.recorded.all()
    by_hour = [np.nanmean(real_log.mean_occupancy("weekday", (hour, hour + 1))) for hour in range(7, 12)]
    assert by_hour[0] < 0.12
    assert by_hour[-1] > 0.95
    assert np.nanmean(real_log.mean_occupancy("weekend")) < 0.07


def test_forecasts_of_the_real_log_beat_the_lots_mean(real_log):
    model = RecordedOccupancy(real_log, np.random.default_rng(0).uniform(10, 200, 200))
    scores = []
    for episode in range(60):
        arrival = model.draw_arrival(ArrivalWindow(), world_key(0, episode))
        p = model.forecast(arrival).p_occupied
        truth = model.world(0, arrival).occupied(np.arange(200), arrival.time)
        scores.append([np.mean((p - truth) ** 2), np.mean((p.mean() - truth) ** 2)])
    ours, lot_mean = np.mean(scores, axis=0)
    assert ours < 0.9 * lot_mean
