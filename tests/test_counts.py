"""Counts of car parks: their faults, each cleaned and counted."""

from datetime import UTC, date, datetime, timedelta, timezone
from pathlib import Path
from zoneinfo import ZoneInfo

import numpy as np
import pytest
from car_park_counts import write_counts
from command_line import ran, refused, summary_of
from lot_checks import refusal
from scipy.special import logit

from parkenv import InputError
from parkenv.forecast.counts import Counts
from parkenv.forecast.event_table import is_counts
from parkenv.forecast.slot_comparison import OURS
from parkenv.forecast.typical_week_fit import usual_days

CAPACITY = 200
FIRST = date(2024, 3, 1)
KEYS = ("model", "log_loss", "brier", "crps", "coverage_90", "days", "car_parks")


def free_places(days=60, rng=None):
    """Free places (days, 24) of a car park that fills by day."""
    rng = rng or np.random.default_rng(5)
    mean = 150 - 110 * np.exp(-(((np.arange(24) - 13) / 4.0) ** 2))
    return np.clip(mean + rng.normal(0.0, 6.0, (days, 24)), 1, CAPACITY - 1).round()


def rows_of(free, name="centre", capacity=CAPACITY):
    """Rows of a file; NaN has none."""
    midnight = datetime(FIRST.year, FIRST.month, FIRST.day)
    return [
        f"{name},{capacity},{midnight + timedelta(days=d, hours=h):%Y-%m-%dT%H:%M},{free[d, h]:.0f}"
        for d in range(len(free))
        for h in range(24)
        if np.isfinite(free[d, h])
    ]


def read(tmp_path, rows, header="car_park,capacity,hour,free", **options):
    path = tmp_path / "counts.csv"
    path.write_text("\n".join([header, *rows]) + "\n")
    return Counts.read(path, **options)


def faults_of(counts, *left_out):
    """The faults of the first car park, but for those of the calendar."""
    return {n: k for n, k in counts.faults[0].items() if k and n not in ("summer_time", *left_out)}


def test_clean_counts_are_kept(tmp_path):
    free = free_places()
    counts = read(tmp_path, rows_of(free))
    np.testing.assert_allclose(counts.occupied[0], 1 - free / CAPACITY)
    np.testing.assert_array_equal(counts.seen, counts.occupied)
    assert (counts.days[0], len(counts.days), counts.weekday[0]) == (FIRST, 60, 4)
    assert (faults_of(counts), counts.idle()) == ({}, {})


MORNING, WEEK = (40, slice(10, 13)), slice(40, 47)
FAULTS = {
    # Where days from 40 on have which free places, how many hours that is, by which rule, and what it becomes.
    "negative": (MORNING, -3, 3, "negative", 1.0),
    "far below 0": (MORNING, -50, 3, "negative", np.nan),
    "above the capacity": (MORNING, CAPACITY + 5, 3, "above_capacity", 0.0),
    "far above the capacity": (MORNING, 9999, 3, "above_capacity", np.nan),
    "gap": (MORNING, np.nan, 3, "gap", np.nan),
    "a week stuck": (WEEK, 97, 7 * 24, "stuck", np.nan),
    "hours stuck": ((40, slice(8, 20)), 97, 12, "stuck", np.nan),
    "a week stuck at full": (WEEK, 0, 7 * 24, "stuck", np.nan),
}


@pytest.mark.parametrize("what", FAULTS)
def test_each_fault_is_cleaned_and_counted(tmp_path, what):
    free, (where, value, expected, rule, becomes) = free_places(), FAULTS[what]
    free[where] = value
    counts = read(tmp_path, rows_of(free))
    # A neighbour may be equal.
    assert faults_of(counts, *({"gap"} - {rule}))[rule] in (expected, expected + 1)
    np.testing.assert_array_equal(counts.occupied[0, 40, 10:13], becomes)
    np.testing.assert_allclose(counts.occupied[0, :40], 1 - free[:40] / CAPACITY)
    np.testing.assert_allclose(counts.occupied[0, 48:], 1 - free[48:] / CAPACITY)


def test_a_car_park_may_be_closed_on_sundays(tmp_path):
    free = free_places(70)
    free[2::7] = free[1::7, -1:]  # from Saturday night on
    counts = read(tmp_path, rows_of(free))
    # Once a few have been seen, they are not taken for a fault.
    assert np.isfinite(counts.occupied[0, 58::7]).all()


@pytest.mark.parametrize(
    ("stated", "rule", "expected", "in_force"),
    [((200, 120), "capacity_changed", 1, 120), ((60, 60), "capacity_estimated", 59, 155)],
)
def test_the_capacity_may_change_or_be_wrong(tmp_path, stated, rule, expected, in_force):
    free = np.minimum(free_places(), stated[1] if rule == "capacity_changed" else 180)
    rows = rows_of(free[:30], capacity=stated[0])
    rows += [row.replace(",200,", f",{stated[1]},") for row in rows_of(free, capacity=200)[30 * 24 :]]
    counts = read(tmp_path, rows)
    assert counts.faults[0][rule] == pytest.approx(expected, abs=2)
    assert counts.capacity[0, -1] == pytest.approx(in_force, rel=0.1)
    assert np.isfinite(counts.occupied[0, 35:]).mean() > 0.95


def test_summer_time_and_duplicates(tmp_path):
    """In Berlin the clocks go forward on 31 March and back on 27 October 2024."""
    start = datetime(2024, 3, 30)
    hours = [start + timedelta(hours=h) for h in range(24 * 215)]
    rows = [f"a,100,{hour:%Y-%m-%dT%H:%M}Z,{10 + (i * 7) % 50}" for i, hour in enumerate(hours)]
    rows.append(rows[5].rsplit(",", 1)[0] + ",77")
    counts = read(tmp_path, rows, "car_park,capacity,hour_utc,free", timezone="Europe/Berlin")
    forward, back = (counts.day_index(date(2024, *day)) for day in ((3, 31), (10, 27)))
    assert np.isnan(counts.occupied[0, forward]).tolist() == [h == 2 for h in range(24)]
    free = {hour: 10 + (i * 7) % 50 for i, hour in enumerate(hours)}
    twice = [free[datetime(2024, 10, 27, 0)], free[datetime(2024, 10, 27, 1)]]
    assert counts.occupied[0, back, 2] == pytest.approx(1 - np.mean(twice) / 100)
    assert counts.occupied[0, 0, 6] == pytest.approx(0.23)  # 05:00 UTC, the last of two
    assert (counts.faults[0]["summer_time"], counts.faults[0]["duplicate"]) == (2, 1)
    utc = read(tmp_path, rows, "car_park,capacity,hour_utc,free", timezone="UTC")
    assert utc.faults[0]["summer_time"] == 0


@pytest.mark.parametrize(
    ("zone", "back", "twice"),
    [
        ("Europe/Berlin", date(2023, 10, 29), 2),
        ("America/Asuncion", date(2023, 3, 25), 23),  # from midnight back to 23:00
        ("Africa/Cairo", date(2023, 10, 26), 23),
        ("America/Havana", date(2023, 11, 5), 0),
    ],
)
def test_an_hour_that_comes_twice_is_found_at_midnight_too(tmp_path, zone, back, twice):
    start = datetime(back.year, back.month, back.day) - timedelta(days=1)
    hours = [start + timedelta(hours=h) for h in range(80)]
    rows = [f"a,100,{hour:%Y-%m-%dT%H:%M}Z,{i}" for i, hour in enumerate(hours)]
    counts = read(tmp_path, rows, "car_park,capacity,hour_utc,free", timezone=zone)
    local = [hour.replace(tzinfo=UTC).astimezone(ZoneInfo(zone)) for hour in hours]
    both = [i for i, hour in enumerate(local) if (hour.date(), hour.hour) == (back, twice)]
    assert len(both) == 2
    assert counts.occupied[0, counts.day_index(back), twice] == pytest.approx(1 - np.mean(both) / 100)
    assert (counts.faults[0]["summer_time"], counts.faults[0]["duplicate"]) == (1, 0)


@pytest.mark.parametrize("order", ["newest first", "shuffled"])
def test_the_last_reading_of_an_hour_counts_in_any_order(tmp_path, order):
    """With offsets, which order texts otherwise than times, and a reading repeated at the same time."""
    zones = [timezone(timedelta(hours=h)) for h in (-5, 0, 9)]
    start = datetime(2024, 3, 30, tzinfo=UTC)
    moments = [start + timedelta(minutes=60 * i + 10 * (i % 5)) for i in range(72)]
    rows = [f"a,100,{m.astimezone(zones[i % 3]).isoformat()},{5 + i % 90}" for i, m in enumerate(moments)]
    rows.append(rows[-1].rsplit(",", 1)[0] + ",7")
    wanted, changed = read(tmp_path, rows, timezone="Europe/Berlin"), rows[::-1]
    if order == "shuffled":
        changed = [*np.random.default_rng(0).permutation(rows[:-2]), *rows[-2:]]
    counts = read(tmp_path, changed, timezone="Europe/Berlin")
    np.testing.assert_array_equal(counts.occupied, wanted.occupied)
    assert counts.faults == wanted.faults
    assert wanted.occupied[np.isfinite(wanted.occupied)][-1] == pytest.approx(0.93)


def test_moments_on_the_hour_hold_for_the_end_of_the_hour_before(tmp_path):
    hours, moments = rows_of(free_places()[:30].astype(int)), []
    for name, capacity, hour, places in (row.split(",") for row in hours):
        moment = datetime.fromisoformat(hour) + timedelta(hours=1)
        moments.append(f"{name},{capacity},{moment.isoformat()},{places}")
    by_hour, by_moment = read(tmp_path, hours), read(tmp_path, moments, "car_park,capacity,time,free")
    assert np.array_equal(by_hour.occupied, by_moment.occupied, equal_nan=True)
    at_once = read(tmp_path, moments, "car_park,capacity,hour,free")
    np.testing.assert_array_equal(at_once.occupied[0].ravel()[1:720], by_hour.occupied[0].ravel()[:719])


def test_later_readings_change_nothing_that_was_known_before(tmp_path):
    free = free_places()
    changed = free.copy()
    changed[45:] = 20
    before, after = (read(tmp_path, rows_of(values)) for values in (free, changed))
    for name in ("seen", "capacity"):
        np.testing.assert_array_equal(getattr(before, name)[:, :45], getattr(after, name)[:, :45])


def test_car_parks_without_use_are_named(tmp_path):
    free = free_places()
    rows = rows_of(free) + rows_of(np.where(free > 100, 181.0, 180.0), "dead")
    rows += rows_of(180 + free // 12, "never") + rows_of(np.full_like(free, 9999), "broken")
    idle = read(tmp_path, rows).idle()
    assert {name: text.split(":")[0] for name, text in idle.items()} == {
        "broken": "no usable readings", "dead": "dead", "never": "never filling",
    }  # fmt: skip


def test_names_zones_and_capacities_that_do_not_fit_are_refused(tmp_path):
    counts = read(tmp_path, rows_of(free_places(2)))
    assert is_counts(tmp_path / "counts.csv")
    assert "has no car park 'center'; did you mean 'centre'" in refusal(counts.chosen, ["center"])
    assert "timezone is 'Berlin'" in refusal(Counts.read, tmp_path / "counts.csv", "Berlin")
    rows = ["a,2024-03-01T08,30", "b,2024-03-01T08,30"]
    with pytest.raises(InputError, match="has 2 car parks, want a column of their capacities"):
        read(tmp_path, rows, "car_park,hour,free", capacity=90)
    with pytest.raises(InputError, match="has a column 'capacity', want no --capacity"):
        read(tmp_path, [f"a,90,{rows[0][2:]}"], capacity=90)


DIALECTS = {
    "semicolons and German names": ("Zeit;frei", "{:%d.%m.%Y %H:%M};{free:.0f}"),
    "tabs and taken places": ("timestamp\toccupied", "{:%Y-%m-%dT%H:%M:%S}\t{taken:.0f}"),
    "a date and a time of day": ("Datum;Uhrzeit;belegte Plätze", "{:%d.%m.%Y;%H:%M};{taken:.0f}"),
    "a decimal comma": ("Zeitpunkt;frei", "{:%Y-%m-%d %H:%M};{free:.0f},0"),
}


@pytest.mark.parametrize(("header", "row"), DIALECTS.values(), ids=DIALECTS)
def test_tables_of_times_and_places_are_read_with_a_capacity(tmp_path, header, row):
    """A reading at a time holds for the end of the hour before it."""
    free = free_places(3)
    ends = [datetime(2024, 3, 1) + timedelta(hours=hour + 1) for hour in range(free.size)]
    places = zip(ends, free.ravel(), strict=True)
    rows = [row.format(end, free=place, taken=CAPACITY - place) for end, place in places]
    counts = read(tmp_path, rows, header, capacity=CAPACITY)
    assert counts.car_parks == ("counts",)
    np.testing.assert_allclose(counts.occupied[0], 1 - free / CAPACITY)


def test_free_and_taken_places_are_the_capacity_and_readings_without_a_value_gaps(tmp_path):
    counts = read(tmp_path, ["2024-03-01T08:00;30;70", "2024-03-01T09:00;20;80"], "hour;free;taken")
    np.testing.assert_allclose(counts.occupied[0, 0, 8:10], [0.7, 0.8])
    np.testing.assert_array_equal(counts.capacity, 100)
    rows = ["2024-03-01T08:00;k.A.", "2024-03-01T09:00;30", "2024-03-01T10:00;", "2024-03-01T11:00;n/a"]
    counts = read(tmp_path, rows, "hour;frei", capacity=100)
    assert np.flatnonzero(np.isfinite(counts.occupied[0, 0])).tolist() == [9]


def test_usual_days_are_those_of_their_class_and_need_another_day(tmp_path):
    counts = read(tmp_path, rows_of(free_places(30)))
    y = counts.occupied[0]
    mean, sd = usual_days(y, counts.weekday, "counts")
    saturdays = np.flatnonzero(counts.weekday == 5)
    others = logit(y[saturdays[1:]])
    np.testing.assert_allclose(mean[saturdays[0]], others.mean(axis=0))
    n = len(others)
    variance = (2 * 0.8**2 + others.var(axis=0) * n) / (n + 1) * (1 + 1 / n)
    np.testing.assert_allclose(sd[saturdays[0]], np.sqrt(variance))
    changed = np.where(np.arange(30)[:, None] == saturdays[0], 0.01, y)
    again, _ = usual_days(changed, counts.weekday, "counts")
    np.testing.assert_array_equal(again[saturdays[0]], mean[saturdays[0]])
    assert (again[saturdays[1]] < mean[saturdays[1]]).any()
    y = np.full((2, 24), np.nan)
    y[:, 8:20] = 0.5
    mean, sd = usual_days(y, np.array([0, 5]), "counts")
    np.testing.assert_allclose(mean, 0.0, atol=1e-12)
    assert np.isfinite(sd).all()
    assert "counted on 1 days, want at least two" in refusal(usual_days, y[:1], np.array([0]), "counts")


def write(path, days, fault=False):
    def change(park, day, taken):
        return 1.03 if fault and (park, day) == (1, 2) else taken

    return write_counts(path, days=days, change=change)


@pytest.mark.slow
def test_an_evaluation_has_a_row_and_a_picture_for_each_model(tmp_path):
    counts = write(tmp_path / "counts.csv", 60, fault=True)
    ended = ran("occupancy", "evaluate", counts, "--from", "2024-02-10", "--out", tmp_path / "out")
    summary = summary_of(tmp_path / "out")
    models = [row["model"] for row in summary["rows"]]
    assert models == ["day-curves", "last-four-weekdays", "last-week", "hour-mean", "gradient-boosting"]
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names == {"summary.json", *(f"{m}.png" for m in models)}
    for row in summary["rows"]:
        assert set(KEYS) <= set(row)
        assert (row["days"], row["car_parks"]) == (20, 2)
        assert sum(band["days"] for band in row["coverage_90_by_band"]) == 40
    assert summary["faults"]["negative"] == summary["faults_by_car_park"]["P1"]["negative"] == 24
    assert "negative 24" in ended.stdout
    chosen = ("--from", "2024-02-10", "--car-parks", "P1")
    again = ran("occupancy", "evaluate", counts, *chosen, "--out", tmp_path / "b")
    assert again.stdout.startswith(("Fit", "1 car park"))
    assert summary_of(tmp_path / "b")["rows"][0]["car_parks"] == 1


@pytest.mark.parametrize(
    ("days", "options"),
    [(1, []), pytest.param(3, ["--from", "2024-01-01"], marks=pytest.mark.slow)],
)
def test_a_short_record_is_no_trouble(tmp_path, days, options):
    counts = write(tmp_path / "counts.csv", days)
    assert not ran("occupancy", "evaluate", counts, *options, "--out", tmp_path / "out").stderr


def test_a_fit_states_day_errors_drift_and_faults(tmp_path):
    counts = write(tmp_path / "counts.csv", 40, fault=True)
    assert not ran("occupancy", "fit", counts, "--out", tmp_path / "out").stderr
    summary = summary_of(tmp_path / "out")
    rows = {row["car_park"]: row for row in summary["rows"]}
    assert {name: row["negative"] for name, row in rows.items()} == {"P0": 0, "P1": 24, "empty": 0}
    assert all(rows[name]["day_error"] == pytest.approx(0.5, abs=0.15) for name in ("P0", "P1"))
    assert 0 < summary["level_drift_per_week"] < 1
    assert summary["typical_week"] is None, "40 days are too few"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--from", "May"], "--from is 'May'"),
        (["--from", "2025-01-01"], "no usable readings"),
        (["--car-parks", "c"], "'c'"),
        (["--timezone", "Mars"], "timezone is 'Mars'"),
    ],
)
def test_what_does_not_fit_is_refused_in_a_line(tmp_path, options, message):
    counts = write(tmp_path / "counts.csv", 2)
    assert message in refused("occupancy", "evaluate", counts, *options, "--out", tmp_path / "out")


REAL_LOG = Path(__file__).parents[2] / "shared" / "data" / "cnr_ext" / "occupancy_15_days.csv.gz"


@pytest.mark.slow  # fits five models to ten days of a real log
def test_the_real_logs_slots_are_forecast_better_than_by_simple_models(tmp_path):
    if not REAL_LOG.exists():
        pytest.skip("the CNRPark-EXT log is not in shared/data")
    ran("occupancy", "evaluate", REAL_LOG, "--from", "2015-11-25", "--out", tmp_path)
    rows = summary_of(tmp_path)["rows"]
    assert rows[0]["model"] == OURS
    assert rows[0]["days"] == 10
    assert rows[0]["log_loss"] < 0.96 * min(row["log_loss"] for row in rows[1:])
    assert rows[0]["brier"] < min(row["brier"] for row in rows[1:])
    assert min(row["difference_ci95"][0] for row in rows[1:]) > 0
    assert all((tmp_path / f"{row['model']}.png").exists() for row in rows)
    said = refused("occupancy", "evaluate", REAL_LOG, "--from", "2017-01-01", "--out", tmp_path)
    assert "has no day from then on with one of its class before it" in said
