"""Commute: a map that learns over days, resumed and reported."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
from command_line import ran, rows_in, summary_of
from pictures import shows_color
from stored_rows import change_rows

from parkenv import ArrivalWindow, InputError, OccupancyLog, RecordedOccupancy, make_scenario
from parkenv.files.spec_file import read_tables
from parkenv.mapping.learned_map import LearnedMap
from parkenv.mapping.store import MapStore
from parkenv.show.figures.times import AGENT_COLORS
from parkenv.studies.commute.runs import TRIP, CommuteRun, calendar
from parkenv.studies.commute.study import Commute
from parkenv.studies.fields import AgentSpec
from parkenv.studies.results import DECISIONS
from parkenv.studies.runner import run


def spec(**changes):
    its = {"scenarios": ["mini"], "agents": ["belief", "first-free"], "maps": ["empty"], "days": 4}
    return Commute.parse(its | {"drivers": 1, "jobs": 1} | changes, "test")


def write_log(path, days):
    lines = ["slot_id,datetime,occupied"]
    for day, taken in days.items():
        for slot, one in enumerate(taken):
            lines += [f"s{slot},{day}T{hour:02}:00,{int(one)}" for hour in range(7, 20)]
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    out = tmp_path_factory.mktemp("commute")
    done = ran(
        "commute", "--scenario", "mini", "--map", "empty,wrong", "--agents", "belief,first-free", "--days", 4,
        "--drivers", 2, "--out", out, "--jobs", 1, "--report",
    )  # fmt: skip
    assert "days 1-4" in done.stdout
    return out


def test_the_command_writes_rows_maps_picture_and_report(out):
    rows = summary_of(out)["rows"]
    cases = {("empty", "belief"), ("wrong", "belief"), ("fixed", "belief"), ("none", "first-free")}
    days = {(*case, day) for case in cases for day in range(1, 5)}
    assert {(r["map"], r["agent"], r["day"]) for r in rows} == days
    episodes = rows_in(out / "episodes.csv")
    for row in rows:
        key = row["map"], row["agent"], str(row["day"])
        searches = [e for e in episodes if (e["map"], e["agent"], e["day_number"]) == key]
        for name in ("total_s",) if row["map"] == "none" else ("total_s", "forecast_error"):
            assert row[name] == pytest.approx(np.mean([float(e[name]) for e in searches]))
    # All agents meet the same worlds, every day a new one; a driver comes at the same time of day.
    worlds = {(e["course"], e["day_number"], e["seed"], e["arrival_s"], e["occupancy"]) for e in episodes}
    assert len(worlds) == 2 * 4
    times = {(e["course"], round(float(e["arrival_s"]) % 86400, 2)) for e in episodes}
    assert len(times) == 2
    assert len(list((out / "maps").glob("*.sqlite"))) == 4
    assert shows_color(out / "commute.png", AGENT_COLORS["belief"])
    assert "Maps that learn from every trip on mini" in (out / "report.html").read_text()
    assert read_tables(out / "experiment.json")["kind"] == "commute"


def test_a_resumed_commute_equals_an_unbroken_one(tmp_path):
    """Also after a crash between trips and episodes, and with more days than at first."""
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    run(spec(), whole)
    run(spec(days=3), broken)
    # The last day's episodes are lost, its trips are not.
    change_rows(broken, lambda row: (row["day_number"], row["agent"]) == (3, "belief"))
    run(spec(), broken, resume=True)
    assert (whole / "episodes.csv").read_text() == (broken / "episodes.csv").read_text()
    assert summary_of(whole) == summary_of(broken)
    lot = make_scenario("mini").lot
    for file in (whole / "maps").iterdir():
        with MapStore(file, lot) as one, MapStore(broken / "maps" / file.name, lot) as other:
            assert [t.key for t in one.trips()] == [f"{day:05}-0000" for day in range(1, 5)]
            for trip, again in zip(one.trips(), other.trips(), strict=True):
                np.testing.assert_array_equal(trip.taken, again.taken)
    with pytest.raises(InputError, match="fleet was 1"):
        run(spec(fleet=2), broken, resume=True)


def test_days_do_not_depend_on_later_ones_and_a_fleets_drivers_meet_the_same_day():
    course = CommuteRun(make_scenario("mini"), AgentSpec(name="belief"), "wrong", 0, 2, 5)
    days = calendar(course.scenario, 4)
    rows, first = course.run(days), course.run(days[:2])
    trips = sorted((row[TRIP] for row in first), key=lambda trip: (trip.time, trip.key))
    parts = first + replace(course, before=trips).run(days[2:])
    unlike = dict.fromkeys((TRIP, DECISIONS))
    assert [row | unlike for row in rows] == [row | unlike for row in parts]
    assert len({row["seed"] for row in rows if row["day_number"] == 1}) == 1
    assert len({row["arrival_s"] for row in rows if row["day_number"] == 1}) == 2


def test_drivers_come_on_the_next_weekdays_or_recorded_days(tmp_path):
    mini = make_scenario("mini")
    assert [day.count for day in calendar(mini, 7)] == [0, 1, 2, 3, 4, 7, 8]
    dates = ("2024-03-05", "2024-03-06", "2024-03-09", "2024-03-12", "2024-03-13")
    log = OccupancyLog.read(write_log(tmp_path / "log.csv", {day: np.arange(10) % 2 for day in dates}))
    log = RecordedOccupancy(log, mini.lot.walk_m(0), np.arange(10))
    recorded = mini.replace(occupancy=log, arrival=ArrivalWindow())
    days = calendar(recorded, 30)
    wanted = [(n, dates[i]) for n, i in ((1, 0), (2, 1), (8, 3), (9, 4))]
    assert [(day.count, day.date) for day in days] == wanted
    rows = CommuteRun(recorded, AgentSpec(name="first-free"), "none", 0, 1, 0).run(days)
    assert [row["day"] for row in rows] == [day.date for day in days]


def test_a_map_of_a_commute_is_a_forecast(out, tmp_path):
    """A scenario file takes the map file of a course; a copy of it goes on learning elsewhere."""
    shutil.copy(out / "maps" / "mini_wrong_belief_0.sqlite", tmp_path / "map.sqlite")
    (tmp_path / "known.toml").write_text('lot = "mini"\nforecast = "map.sqlite"\n')
    known = make_scenario(tmp_path / "known.toml")
    arrival = known.occupancy.draw_arrival(known.arrival, np.uint64(1))
    learned = known.forecast(arrival)
    assert np.ptp(learned.p_occupied) > 0.05
    assert learned.day_error.level > 0.0


@pytest.mark.slow
def test_a_week_of_trips_closes_the_gap_of_a_wrong_map(monkeypatch):
    """On jam, where the map is wrong, against drivers without a map (greedy-drive) and with the right one."""
    scenario = make_scenario("jam")
    days = calendar(scenario, 8)

    def total_s(agent, start):
        courses = [CommuteRun(scenario, AgentSpec(name=agent), start, number, 1, 0) for number in range(12)]
        return np.array([[row["total_s"] for row in course.run(days)] for course in courses])

    learning, right = (total_s("belief", start) for start in ("wrong", "fixed"))
    without = total_s("greedy-drive", "none")
    first, later = slice(0, 1), slice(5, None)
    assert (learning - without)[:, first].mean() > 5.0
    assert (learning - without)[:, later].mean() < -2.0
    assert (learning - right)[:, later].mean() < 4.0  # 3.2 ± 1.7 s with 30 drivers
    monkeypatch.setattr(LearnedMap, "learn", lambda self, trips: None)
    assert (total_s("belief", "wrong") - without)[:, later].mean() > 5.0


def test_a_log_keeps_its_slots_on_all_days_of_a_commute(tmp_path):
    """Without a mapping, a log's slots are ranked anew for every day; a map could not learn them."""
    rng = np.random.default_rng(0)
    write_log(tmp_path / "log.csv", {f"2024-03-0{day}": rng.random(10) < 0.5 for day in (5, 6, 7, 8)})
    (tmp_path / "recorded.toml").write_text('lot = "mini"\noccupancy = "log.csv"\n')
    commute = spec(scenarios=[str(tmp_path / "recorded.toml")], drivers=1)
    occupancy = commute.runs[0].scenario.occupancy
    anew = make_scenario(tmp_path / "recorded.toml").occupancy
    slots, ranked = ([its.mapped_log(d).log_slot for d in its.log.days] for its in (occupancy, anew))
    assert (np.array(slots) == slots[0]).all()
    assert not (np.array(ranked) == ranked[0]).all()
    # The fullest are nearest to the goal.
    mean = occupancy.log.mean_occupancy("weekday")[slots[0]]
    assert (np.diff(mean[np.argsort(occupancy.walk_m, kind="stable")]) <= 0.0).all()
    assert occupancy.with_fixed_slots(ArrivalWindow()) is occupancy
