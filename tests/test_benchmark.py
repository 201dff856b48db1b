"""Benchmark suites: results can be checked, and altered ones are rejected."""

import json
import re
import shutil
from dataclasses import replace

import jsonschema
import pytest
from command_line import parkenv

from parkenv.errors import InputError
from parkenv.lots import grid_lot, read_lot, write_lot
from parkenv.lots.lot_files import PLACES
from parkenv.lots.quality import combined_error_probability, read_provenance
from parkenv.scenarios.selection import lot_share
from parkenv.scenarios.spec import scenario_specs
from parkenv.show.report.page import SCHEMA
from parkenv.studies.agent_spec import AgentSpec
from parkenv.studies.benchmark import suite as benchmark
from parkenv.studies.benchmark.suite import Suite, by_group, check_result, result_of, suite_lots
from parkenv.studies.lots.census import slots_by_kind
from parkenv.studies.results import DECISIONS, EPISODES, write_summary
from parkenv.studies.training.search import SearchTraining
from parkenv.studies.training.spec import SearchTrainingSpec
from parkenv.world.occupancy.day_error import DayError
from parkenv.world.occupancy.process import Arrival

AGENTS = ("first-free", "greedy-goal")


@pytest.fixture(scope="module")
def small():
    """The suite with fewer searches and tasks, so that a test may run it."""
    suite = Suite.named("v1")
    return replace(suite, seeds=suite.seeds[:6], tasks=suite.tasks[3:5])


def episodes_of(cells):
    return {EPISODES.key(row): row for case, seeds in cells for row in case.run(seeds)}


@pytest.fixture(scope="module")
def result(small):
    cases = small.cases([AgentSpec(name=name) for name in AGENTS])
    return result_of(small, cases, episodes_of(cases), ["parkenv", "benchmark", "run"])


def test_a_suite_without_its_timings_is_refused(small):
    cases = small.cases([AgentSpec(name="first-free")])
    episodes = {key: row | {DECISIONS: ""} for key, row in episodes_of(cases).items()}
    with pytest.raises(InputError, match=r"no decision_ms of first-free in .*timings\.csv is not whole"):
        result_of(small, cases, episodes, ["parkenv", "benchmark", "run"])


def checked(content, small, path, monkeypatch):
    monkeypatch.setattr(benchmark.Suite, "named", classmethod(lambda cls, name: small))
    write_summary(path, content, "result.json")
    return check_result(path / "result.json")


def test_a_result_passes_its_own_check_and_scores_are_shares_of_the_bound(
    result, small, tmp_path, monkeypatch
):
    assert checked(result, small, tmp_path, monkeypatch) == json.loads(json.dumps(result))
    assert {(r["agent"], r["task"]) for r in result["rows"]} == {
        (agent, task.name) for agent in AGENTS for task in small.tasks
    }
    for row in result["rows"]:
        searches = result["episodes"][row["agent"]][row["task"]]
        assert row["score"] == pytest.approx(sum(searches["bound_s"]) / sum(searches["total_s"]))
        assert row["total_s"] - row["regret_s"] == pytest.approx(sum(searches["bound_s"]) / 6, abs=1e-5)


def faster(content):
    for tasks in content["episodes"].values():
        for searches in tasks.values():
            searches["total_s"][0] = searches["bound_s"][0] - 1.0


def other_worlds(content):
    content["episodes"]["first-free"]["mini"]["bound_s"][-1] += 1.0
    content["episodes"]["first-free"]["mini"]["total_s"][-1] += 1.0


@pytest.mark.parametrize(
    ("change", "wanted"),
    [
        (faster, "beats the clairvoyant bound"),
        (other_worlds, "first-free in mini: was not run in the suite's worlds"),
        (lambda c: c["episodes"]["first-free"]["mini"]["total_s"].pop(), "wants 6 searches, has 5"),
        (lambda c: c["rows"].pop(), "rows or scores are not those of its agents"),
        (lambda c: c["episodes"]["first-free"].pop("mini"), "first-free in mini: wants 6 searches, has 0"),
        (lambda c: c["rows"][0].update(total_s=20.0), "its row does not match its searches"),
        (lambda c: c["scores"].update({"greedy-goal": 0.99}), "the score of greedy-goal"),
        (lambda c: c.update(suite_sha256="0" * 64), "settings that are not those of suite v1"),
        (lambda c: c.pop("scores"), "scores is missing"),
    ],
)
def test_what_was_altered_or_left_out_is_found(result, small, tmp_path, monkeypatch, change, wanted):
    altered = json.loads(json.dumps(result))
    change(altered)
    with pytest.raises(InputError, match=wanted):
        checked(altered, small, tmp_path, monkeypatch)


def test_results_are_compared_on_a_page_and_a_bad_one_is_refused(result, small, tmp_path, monkeypatch):
    monkeypatch.setattr(benchmark.Suite, "named", classmethod(lambda cls, name: small))
    theirs = json.loads(json.dumps(result)) | {"by": "</script><b>", "command": ["parkenv", "run", "a b"]}
    for name, content in (("ours", result), ("theirs", theirs)):
        (tmp_path / name).mkdir()
        write_summary(tmp_path / name, content, "result.json")
    page = tmp_path / "page.html"
    made = parkenv("benchmark", "page", tmp_path, "--out", page)
    assert (made.returncode, "4 agents in 2 results" in made.stdout) == (0, True), made.stderr
    data = json.loads(re.search(r'id="report-data">(.*?)</script>', page.read_text(), flags=re.DOTALL)[1])
    jsonschema.validate(data, json.loads(SCHEMA.read_text()))
    scores, commands, tasks = data["tables"]
    rows = [dict(zip([c["key"] for c in scores["columns"]], row, strict=True)) for row in scores["rows"]]
    assert {row["agent"]: row["score"][0] for row in rows} == pytest.approx(result["scores"])
    assert [row["score"] for row in rows] == sorted((row["score"] for row in rows), reverse=True)
    assert all(low < score < high for score, low, high in (row["score"] for row in rows))
    assert {row["by"] for row in rows} == {"", "</script><b>"}
    assert {row["date"] for row in rows} == {result["date"]}
    assert "parkenv run 'a b'" in [row[1] for row in commands["rows"]]
    assert len(tasks["rows"]) == 2 * len(result["rows"])
    page.unlink()
    write_summary(tmp_path / "theirs", theirs | {"suite_sha256": "0" * 64}, "result.json")
    bad = parkenv("benchmark", "page", tmp_path, "--out", page)
    assert (bad.returncode, bad.stderr.count("\n"), page.exists()) == (2, 1, False)
    assert "theirs" in bad.stderr


def test_suites_do_not_change():
    suite = Suite.named("v1")
    assert len(suite.tasks) == 8
    assert suite.fingerprint == "eb8b33585e781fa69eb00fe155aefb44a18fee96789c25a0b65ef4199264b03b"
    assert {task.day_error for task in suite.tasks} == {(0.0,)}


def test_the_days_of_the_second_suite_differ_from_their_forecast():
    suite = Suite.named("v2")
    sizes = {}
    for task in suite.tasks:
        made = task.made(suite.arrival)
        sizes[task.name] = made.occupancy.day_error
        assert made.forecast(Arrival(9 * 3600.0)).day_error == made.occupancy.day_error
    assert sizes["campus"] == sizes["jam"] == sizes["campus-full"] == DayError(0.8)
    assert (sizes["campus-slope"], sizes["campus-as-forecast"]) == (DayError(0.6, 0.6), DayError())


@pytest.mark.slow  # reads 24 lots
def test_the_places_are_sure_real_lots_of_stated_kinds():
    suite = Suite.named("v2-places")
    assert [task.name for task in suite.tasks] == [f"place-{n:02d}" for n in range(1, 25)]
    groups = {}
    for task in suite.tasks:
        path = PLACES / f"{task.scenario}.geojson"
        lot, origin = read_lot(path), read_provenance(path)
        assert origin.source.startswith("zuid-holland_")
        assert combined_error_probability(origin.issues) <= 0.3
        assert lot.slot_ids[0].startswith(("way/", "relation/"))
        assert suite_lots()[lot_share(lot)] == task.name
        counts = slots_by_kind(lot)
        kind, share = max(counts.items(), key=lambda one: one[1])
        kind = kind if share >= 0.9 * lot.n_slots else "mixed"
        size = "small" if lot.n_slots < 80 else "medium" if lot.n_slots < 200 else "large"
        assert task.group == (f"{kind}, {size}" if kind == "perpendicular" else kind)
        groups[task.group] = groups.get(task.group, 0) + 1
    assert list(groups.values()) == [4, 4, 4, 2, 4, 6]
    made = suite.tasks[0].made(suite.arrival)
    assert (made.name, made.occupancy.day_error, made.arrival) == ("place-01", DayError(0.7), suite.arrival)
    notice = (PLACES / "LICENSE").read_text(encoding="utf-8")
    assert "Open Database License" in notice
    assert "OpenStreetMap contributors" in notice
    assert suite_lots().keys() == {lot_share(read_lot(path)) for path in PLACES.glob("*.geojson")}


def test_results_in_places_are_shown_by_kind(tmp_path, monkeypatch):
    suite = Suite.named("v2-places")
    few = replace(suite, seeds=suite.seeds[:2], tasks=(*suite.tasks[:2], suite.tasks[14]))
    monkeypatch.setattr(benchmark.Suite, "named", classmethod(lambda cls, name: few))
    ran = parkenv(
        "benchmark", "run", "v2", "--places", "--agents", "first-free", "--jobs", 1, "--out", tmp_path
    )
    assert (ran.returncode, ran.stderr) == (0, "")
    result = check_result(tmp_path / "result.json")
    assert result["suite"] == "v2-places"
    means = {group: (total, score) for _, group, total, score in by_group(result)}
    assert list(means) == ["perpendicular, small", "kerbside"]
    rows = result["rows"]
    assert means["perpendicular, small"][0] == pytest.approx((rows[0]["total_s"] + rows[1]["total_s"]) / 2)
    assert means["kerbside"] == pytest.approx((rows[2]["total_s"], rows[2]["score"]))
    assert "perpendicular, small" in ran.stdout
    assert "place-01" not in ran.stdout


def test_no_agent_is_trained_on_a_place_of_the_suite(tmp_path):
    for name in ("a", "b", "c"):
        write_lot(grid_lot(2, ord(name) - 80), tmp_path / f"{name}.geojson")
    shutil.copy(PLACES / "place-15.geojson", tmp_path / "mine.geojson")
    specs = tuple(scenario_specs(tmp_path))
    with pytest.raises(InputError, match="scenario 'mine' is place-15 of benchmark suite v2, which no agent"):
        SearchTraining(SearchTrainingSpec(scenarios=specs)).check()
    split = SearchTraining(SearchTrainingSpec(scenarios=specs, held_out=0.001))
    assert [scenario.name for scenario in split.sides[1]] == ["mine"]
    assert (
        SearchTraining(SearchTrainingSpec(scenarios=specs[:3], evaluate_on=specs[3:])).sides[1][0].name
        == "mine"
    )


def test_the_command_tells_of_suites_and_refuses_what_is_none(tmp_path):
    shown = parkenv("benchmark", "show", "v1")
    assert shown.returncode == 0
    assert "campus-full" in shown.stdout
    unknown = parkenv("benchmark", "run", "v7", "--out", tmp_path / "out")
    assert (unknown.returncode, "known: v1, v2, v2-places" in unknown.stderr) == (2, True)
    for content in ('{"format": "park', "[" * 100_000):
        (tmp_path / "torn.json").write_text(content)
        torn = parkenv("benchmark", "check", tmp_path / "torn.json")
        assert (torn.returncode, "not JSON" in torn.stderr) == (2, True)
