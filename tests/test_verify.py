"""Theory against the package: the closed forms themselves, the rows that compare them, and the command."""

import json
import math

import numpy as np
import pytest
from command_line import parkenv
from pictures import shows_color

from parkenv.errors import InputError
from parkenv.show.figures.verification import AGREES
from parkenv.studies.runner import run
from parkenv.studies.verify import line
from parkenv.studies.verify.line import CHANCES, EQUAL_COSTS, THESIS_SPEEDS, Line
from parkenv.studies.verify.rows import certain_row, disagreeing, mean_row
from parkenv.studies.verify.study import Verification
from planners.agent import make_agent


def test_a_row_agrees_where_theory_is_in_its_interval():
    exact = certain_row("a", 3.0, 3.0, "source")
    assert exact.agrees
    assert exact.exact
    assert not certain_row("a", 3.0, 3.001, "source").agrees
    assert certain_row("a", 3.0, 3.001, "source", tolerance=0.002).agrees
    drawn = np.random.default_rng(0).normal(5.0, 2.0, 400)
    right, wrong = mean_row("b", 5.0, drawn, "source"), mean_row("b", 6.0, drawn, "source")
    assert (right.agrees, wrong.agrees) == (True, False)
    assert disagreeing([exact, right, wrong]) == [wrong]
    (low, high), (low95, high95) = right.interval, right.found_ci95
    assert low < low95 < right.found < high95 < high
    assert high - low == pytest.approx(2 * 3.93 * drawn.std(ddof=1) / 20.0, rel=0.01), "Student's t, 399"


def test_the_interval_misses_as_rarely_as_it_says():
    rng = np.random.default_rng(1)
    rows = [mean_row("b", 0.0, rng.normal(size=30), "source") for _ in range(4000)]
    assert len(disagreeing(rows)) <= 3, "0.4 are expected"
    missed = sum(not row.found_ci95[0] <= 0.0 <= row.found_ci95[1] for row in rows)
    assert missed == pytest.approx(200, abs=60)


def best_threshold_and_cost(its):
    """Threshold and mean cost, s, on a line, by dynamic programming from its far end."""
    distances = its.before - np.arange(its.before + 1 + its.beyond)
    onward, takes = 0.0, []
    for r in reversed(distances):
        cost = r * its.before_s if r >= 0 else -r * its.beyond_s
        takes.append(cost <= onward or r == -its.beyond)
        onward = (1.0 - its.q) * (cost if takes[-1] else onward) + its.q * (
            onward if r > -its.beyond else cost
        )
    return line.threshold_of(np.array(takes[::-1]), its.before), onward


@pytest.mark.parametrize("ratio", [EQUAL_COSTS, THESIS_SPEEDS, 0.8])
@pytest.mark.parametrize("q", CHANCES)
def test_the_closed_form_of_the_line_is_that_of_its_dynamic_program(q, ratio):
    its = Line.long(q, ratio)
    threshold, cost_s = best_threshold_and_cost(its)
    assert its.threshold == threshold
    drive_s = (its.before + 1) * line.PITCH / line.V_WALK * ratio
    assert its.mean_s - drive_s == pytest.approx(cost_s, rel=1e-4)
    best = np.arange(its.before + 1 + its.beyond) >= its.before - its.threshold
    assert its.mean_cost(best) == pytest.approx(cost_s, rel=1e-4)


def test_the_thresholds_are_those_of_the_literature():
    assert [Line.long(q, EQUAL_COSTS).threshold for q in CHANCES] == [1, 2, 3, 4, 6, 13, 68]


@pytest.mark.parametrize("q", [0.5, 0.85])
@pytest.mark.parametrize("row", [line.exact_row, line.belief_row, line.mdp_row])
def test_planners_have_the_threshold_of_the_line(row, q):
    (made,) = row(q, THESIS_SPEEDS)
    assert made.agrees, made
    assert made.exact


def test_a_rule_that_is_no_threshold_has_none():
    assert line.threshold_of(np.array([False, True, True, True]), 2) == 1.0
    assert math.isnan(line.threshold_of(np.array([True, False, True, True]), 2))
    (made,) = line.mdp_row(0.85, THESIS_SPEEDS, 10.0)
    assert made.agrees
    assert made.found > Line.long(0.85, THESIS_SPEEDS).threshold, "too cautious"


def test_an_agent_that_takes_the_first_free_slot_is_found_out():
    its = Line(0.5, THESIS_SPEEDS, 4, 20)
    (made,) = line.searches_row("greedy-drive", its, 300, 0)
    assert not made.agrees
    scenario = its.scenario()
    n = scenario.lot.n_slots
    takes = line.free_slots_taken(make_agent("greedy-drive", scenario), scenario, np.full(n, 0.5), n)
    assert takes.all()


def test_inspections_follow_from_how_many_slots_are_free():
    seen = np.array(line.inspections(0, 1500))
    for free in line.FREE:
        mine = seen[seen[:, 0] == free, 1]
        assert mine.max() <= line.SLOTS - free + 1
        assert mean_row("", (line.SLOTS + 1) / (free + 1), mine, "").agrees
        if free < 4:
            assert not mean_row("", line.SLOTS / free, mine, "").agrees, "with replacement"


def test_unknown_cases_are_named():
    with pytest.raises(InputError, match=r"cases: there is no case 'lne'; did you mean 'line'\?"):
        Verification(cases=("lne",)).check()


def test_the_command_writes_rows_and_a_picture(tmp_path, monkeypatch):
    monkeypatch.setattr(line, "INSPECTED", 300)
    done = parkenv("verify", "--cases", "inspections", "--jobs", 1, "--out", tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert "5 of 5 rows agree with theory" in done.stdout
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["confidence"] == 0.9999
    for row in summary["rows"]:
        assert {"case", "expected", "found", "found_ci95", "source"} <= row.keys()
        assert row["agrees"]
    assert shows_color(tmp_path / "verify.png", AGREES, within=40)
    again = parkenv("verify", "--cases", "inspections", "--jobs", 1, "--out", tmp_path / "again")
    assert again.returncode == 0
    assert json.loads((tmp_path / "again" / "summary.json").read_text())["rows"] == summary["rows"]


def test_a_row_that_disagrees_is_said_and_makes_the_exit_code(monkeypatch):
    monkeypatch.setattr(line, "inspections", lambda *_: [(m, 1) for m in line.FREE for _ in range(9)])
    done = parkenv("verify", "--cases", "inspections", "--jobs", 1)
    assert done.returncode == 1
    assert done.stdout.count("DISAGREES") == len(line.FREE)
    assert parkenv("verify", "--cases", "nothing").returncode == 2


@pytest.mark.slow
def test_every_row_is_inside_its_interval(monkeypatch):
    """The mean of an eighth of the searches has an interval that is nearly three times as wide."""
    monkeypatch.setattr(line, "SEARCHES", 1_000)
    monkeypatch.setattr(line, "INSPECTED", 3_000)
    study = Verification(jobs=1)
    rows = study.statements(run(study).results)
    assert not disagreeing(rows)
    assert len(rows) >= 70
