"""The report of a fleet: its data are the run's, its replay the days of the run."""

import itertools
import shutil

import numpy as np
import pytest
from command_line import ran, rows_in, summary_of
from pictures import shows_color
from small_lots import driven
from stored_rows import change_rows
from test_report import data_of

from parkenv import InputError, make_scenario, open_run
from parkenv.cli.report import make_report
from parkenv.show.figures.fleet import KNOWLEDGE_COLORS
from parkenv.studies.fleet.day_replay import DRIVE, FAIL, QUEUE, choose_days, record_day
from parkenv.studies.fleet.study import FleetStudy
from parkenv.studies.study import ExecutionSpec, ReportOptions


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    out = tmp_path_factory.mktemp("report") / "fleet"
    done = ran(
        "fleet", "--scenario", "mini", "--hours", "08:00-08:30", "--arrivals-per-hour", "20,40", "--share", "0.5,1",
        "--knows", "own,reserve", "-n", 2, "--jobs", 1, "--out", out, "--report",
    )  # fmt: skip
    assert (done.stderr, done.stdout.count("reserve ") >= 4) == ("", True)
    return out


def test_the_command_writes_rows_days_and_a_figure(run):
    assert (len(summary_of(run)["rows"]), len(rows_in(run / "days.csv"))) == (2 * 3, 2 * 2 * 3)
    assert shows_color(run / "fleet.png", KNOWLEDGE_COLORS["reserve"])
    assert [path.name for path in open_run(run).figures()] == ["fleet.png"]


def test_the_data_replay_the_days_of_the_run(run):
    data = data_of(run / "report.html")
    assert data["run"]["title"] == "Many cars on mini"
    assert len(data["run"]["findings"]) == 1
    assert len(data["fleets"]) == 8
    assert all(day["agrees"] for day in data["fleets"])
    names = ("arrivals_per_hour", "knows", "share")
    settings = [tuple(day[name] for name in names) for day in data["fleets"] if day["day"] == 0]
    assert settings == [
        (a, *kind) for a in (20, 40) for kind in (("own", 0), ("reserve", 0.5), ("reserve", 1))
    ]


def test_cars_drive_along_the_lanes_and_no_slot_holds_two(run):
    lot = make_scenario("mini").lot
    edges = {(v, int(t)) for v in range(lot.n_vertices) for t in lot.neighbors[v] if t >= 0}
    names = ("tracks", "arrival", "ended", "slot", "leaves")
    for day in data_of(run / "report.html")["fleets"]:
        occupied = [[] for _ in range(lot.n_slots)]
        for slot, leaves in zip(day["residents"][::2], day["residents"][1::2], strict=True):
            occupied[slot].append((0, leaves))
        for track, arrival, ended, slot, leaves in zip(*(day[name] for name in names), strict=True):
            assert arrival + sum(track[1::2]) == ended
            vertices = [track[0], *(code >> 2 for code in track[2::2])]
            for before, after, code in zip(vertices, vertices[1:], track[2::2], strict=False):
                kind = code & 3
                assert (before == after) == (kind != DRIVE)
                assert kind != DRIVE or (before, after) in edges
            if slot >= 0:
                assert vertices[-1] == slot
                occupied[slot].append((ended, leaves))
        for stays in occupied:
            stays.sort()
            assert all(one[1] <= two[0] for one, two in itertools.pairwise(stays))


def test_failed_attempts_and_queues_are_on_the_track():
    spec = FleetStudy().changed(
        scenario={"lot": "mini", "arrivals": {"hours": "08:00-08:30"}}, agents=["first-free"], knows=["own"],
        arrivals_per_hour=[120], days=1, manoeuvre_s=6.0,
    )  # fmt: skip
    ((setting, day),) = choose_days(spec, spec.fleet_settings, 1)
    fleet, agents = spec.fleet(setting)
    fleet.keep_steps()
    cars = driven(fleet, 0, 0, agents=agents).cars
    time_of = {kind: np.zeros(len(cars)) for kind in (FAIL, QUEUE)}
    for car, track in enumerate(record_day(spec, setting, day, {})["fleet"]["tracks"]):
        for elapsed, code in zip(track[1::2], track[2::2], strict=True):
            if code & 3 in time_of:
                time_of[code & 3][car] += elapsed / 100
    assert np.allclose(time_of[FAIL], cars["failed_s"], atol=0.1)
    assert np.allclose(time_of[QUEUE], cars["queued_s"], atol=0.5)
    assert cars["queued_s"].max() > 0.0
    assert len(fleet.steps) == (cars["n_steps"] - (cars["slot"] >= 0)).sum()
    assert (np.diff(fleet.steps["begin"]) >= 0.0).all()


def test_days_and_agents_can_be_chosen(run, tmp_path):
    page = tmp_path / "chosen.html"
    make_report(run, ExecutionSpec(jobs=1), ReportOptions(numbers=(1,), agents=("greedy-drive",)), out=page)
    assert [day["day"] for day in data_of(page)["fleets"]] == [1] * 6
    make_report(run, ExecutionSpec(jobs=1), ReportOptions(episodes=0), out=page)
    assert data_of(page)["fleets"] == []
    for options, message in (
        ({"numbers": (2,)}, "2; .* 0 to 1"),
        ({"agents": ("belief",)}, "'belief'; known: greedy-drive"),
    ):
        with pytest.raises(InputError, match=message):
            make_report(run, ExecutionSpec(jobs=1), ReportOptions(**options), out=page)


def test_a_day_that_differs_is_noted_and_days_with_too_many_cars_are_not_replayed(run, tmp_path, monkeypatch):
    copy = shutil.copytree(run, tmp_path / "copy")
    change_rows(copy, lambda row: "total_s" in row and row.update(total_s=1.0))
    done = ran("report", copy, "--episodes", 1, "--jobs", 1)
    assert "days.csv says 1.00 s" in " ".join(done.stdout.split())
    monkeypatch.setattr("parkenv.studies.fleet.day_replay.MOST_CARS", 15)
    make_report(run, ExecutionSpec(jobs=1), ReportOptions(episodes=1), out=tmp_path / "page.html")
    data = data_of(tmp_path / "page.html")
    assert {day["arrivals_per_hour"] for day in data["fleets"]} == {20.0}
    assert "40 cars an hour" in data["run"]["notes"][0]
