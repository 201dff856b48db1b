"""The benchmark suite: results can be checked, and altered ones are rejected."""

import itertools
import json
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from command_line import ran, refused, rows_in, summary_of
from test_report import data_of

from parkenv import InputError
from parkenv.lots import read_lot
from parkenv.lots.draft import combined_error_probability, read_provenance
from parkenv.lots.lot_files import PLACES
from parkenv.studies.benchmark.page import Entry, benchmark_data, precision
from parkenv.studies.benchmark.suite import (
    CONTROLS,
    Stratum,
    Suite,
    check_result,
    fingerprint,
    result_of,
    worlds_of,
    write_result,
)
from parkenv.studies.fields import AgentSpec
from parkenv.studies.lots import check_drivability, lot_columns
from parkenv.studies.results import EPISODES
from parkenv.studies.statistics import mean_over_days
from parkenv.world.occupancy.day_error import DayError
from parkenv.world.occupancy.process import Arrival

AGENTS = ("first-free", "greedy-goal")
TIMES = "episodes.first-free.mini.total_s"


@pytest.fixture(scope="module")
def small():
    """The suite with fewer searches and tasks, so that a test may run it."""
    suite = Suite.packaged()
    parts = [[replace(part, seeds=part.seeds[:2]) for part in task.strata] for task in suite.tasks]
    tasks = [replace(task, strata=tuple(strata)) for task, strata in zip(suite.tasks, parts, strict=True)]
    return replace(suite, tasks=tuple(tasks[3:5]))


def episodes_of(cells):
    return {EPISODES.key(row): row for case, seeds in cells for row in case.run(seeds)}


@pytest.fixture(scope="module")
def result(small):
    cases = small.cases([AgentSpec(name=name) for name in AGENTS])
    return result_of(small, cases, episodes_of(cases), ["parkenv", "benchmark", "run"])


def checked(content, small, path, monkeypatch):
    monkeypatch.setattr(Suite, "packaged", classmethod(lambda cls, name: small))
    write_result(path, content, "result.json")
    return check_result(path / "result.json")


def test_a_result_passes_its_own_check_and_scores_are_shares(result, small, tmp_path, monkeypatch):
    assert checked(result, small, tmp_path, monkeypatch) == json.loads(json.dumps(result))
    cases = {(agent, task.name) for agent in AGENTS for task in small.tasks}
    assert {(row["agent"], row["task"]) for row in result["rows"]} == cases
    for row in result["rows"]:
        strata = next(task.strata for task in small.tasks if task.name == row["task"])
        bound = sum(part.share * part.means[0] for part in strata)
        assert row["score"] == pytest.approx(bound / row["total_s"], abs=1e-4)
        # The bound is a control variate: its estimate is its mean over the population.
        assert row["total_s"] - row["regret_s"] == pytest.approx(bound, abs=1e-5)


def times_of(content):
    return content["episodes"]["first-free"]["mini"]["total_s"]


@pytest.mark.parametrize(
    ("change", "wanted"),
    [
        (lambda c: times_of(c).__setitem__(0, 1.0), rf"{TIMES}\[0\] is 1, want at least the clairvoyant"),
        (lambda c: times_of(c).pop(), f"{TIMES} is 11, want 12"),
        (lambda c: c["rows"].pop(), "rows has none of greedy-goal in campus-full, want one"),
        (lambda c: c["rows"].append(c["rows"][0] | {"agent": "x"}), "rows or scores are of others than"),
        (lambda c: c["episodes"]["first-free"].pop("mini"), f"{TIMES} is 0, want 12"),
        (lambda c: c["rows"][0].update(total_s=20.0), r"rows\[0\].total_s is 20.0, want \d+\.\d+"),
        (lambda c: c["rows"][0].update(episodes=60), r"rows\[0\].episodes is 60, want 12"),
        (lambda c: times_of(c).__setitem__(2, times_of(c)[2] + 1.0), r"rows\[0\].total_s is"),
        (lambda c: c["rows"][0].update(decision_ms=0.0), "sha256 is [0-9a-f]{64}, want [0-9a-f]{64}"),
        (lambda c: c["scores"].update({"greedy-goal": 0.99}), "scores.greedy-goal is 0.99, want"),
        (lambda c: c.update(suite_sha256="0" * 64), "suite_sha256 is 0{64}, want "),
        (lambda c: c.update(suite="v7"), "suite is 'v7', want 'v3' or 'streets-v1'"),
        (lambda c: c.pop("scores"), "scores is missing"),
    ],
)
def test_what_was_altered_or_left_out_is_found(result, small, tmp_path, monkeypatch, change, wanted):
    altered = json.loads(json.dumps(result))
    change(altered)
    with pytest.raises(InputError, match=rf"^{tmp_path / 'result.json'}[^\n]*{wanted}[^\n]*$"):
        checked(altered, small, tmp_path, monkeypatch)


def test_a_task_weights_its_searches_and_uses_their_known_means(small, tmp_path, monkeypatch):
    """Both strata of `mini` have the same worlds and known means of their own: the estimate is other, by hand."""
    mini = next(task for task in small.tasks if task.name == "mini")
    means = tuple(worlds_of(mini, small).mean(axis=0))
    task = replace(mini, strata=tuple(Stratum(share, mini.seeds, means) for share in (0.25, 0.75)))
    suite = replace(small, tasks=(task,))
    cases = suite.cases([AgentSpec(name="first-free")])
    content = result_of(suite, cases, episodes_of(cases), ["parkenv"])
    (row,) = content["rows"]
    times = times_of(content)
    assert (row["episodes"], len(times)) == (24, 24)
    assert row["total_s"] == pytest.approx(sum(times) / 24, abs=1e-3)
    assert row["score"] == pytest.approx(means[0] / row["total_s"], abs=1e-5)
    assert row["total_s_ci95"][0] < row["total_s"] < row["total_s_ci95"][1]
    assert checked(content, suite, tmp_path, monkeypatch)["sha256"] == content["sha256"]
    content["rows"][0]["total_s_ci95"][1] += 1.0
    with pytest.raises(InputError, match=r"rows\[0\].total_s_ci95 is"):
        checked(content, suite, tmp_path, monkeypatch)


def test_precision_is_the_error_of_the_mean_difference_by_strata(small):
    mini = next(task for task in small.tasks if task.name == "mini")
    parts = (Stratum(0.25, (0, 1, 2), (30.0, 0.5)), Stratum(0.75, (3, 4), (30.0, 0.5)))
    suite = replace(small, tasks=(replace(mini, strata=parts),))
    others = np.array([20.0, 20.0, 20.0, 40.0, 40.0])
    times = others + np.array([1, 2, 3, 4, 8]), others
    row = precision(suite, *(Entry(name, {}, {"mini": of}) for name, of in zip("ab", times, strict=True)))
    assert row["behind_s"] == pytest.approx(0.25 * 2.0 + 0.75 * 6.0)
    assert row["error"] == pytest.approx(np.sqrt(0.25**2 * 1.0 / 3 + 0.75**2 * 8.0 / 2))
    assert row["searches_for_1_s"] == pytest.approx(5 * (1.96 * row["error"]) ** 2, rel=1e-3)


def test_results_are_compared_on_a_page_and_a_bad_one_is_refused(result, small, tmp_path, monkeypatch):
    monkeypatch.setattr(Suite, "packaged", classmethod(lambda cls, name: small))
    other = json.loads(json.dumps(result)) | {"by": "</script><b>", "command": ["parkenv", "run", "a b"]}
    other["sha256"] = fingerprint(other)
    for name, content in (("ours", result), ("other", other)):
        (tmp_path / name).mkdir()
        write_result(tmp_path / name, content, "result.json")
    page = tmp_path / "page.html"
    command = ("benchmark", "page", tmp_path, "--out", page)
    assert "4 agents in 2 results" in ran(*command).stdout
    tables = {table["name"]: table for table in data_of(page)["tables"]}
    columns = [column["key"] for column in tables["scores"]["columns"]]
    rows = [dict(zip(columns, row, strict=True)) for row in tables["scores"]["rows"]]
    assert {row["agent"]: row["score"][0] for row in rows} == pytest.approx(result["scores"], abs=1e-4)
    assert [row["score"] for row in rows] == sorted((row["score"] for row in rows), reverse=True)
    assert all(low < score < high for score, low, high in (row["score"] for row in rows))
    assert rows[0]["behind_s"] == [0.0, 0.0, 0.0]
    assert all(row["behind_s"][0] >= 0.0 for row in rows)
    assert {row["by"] for row in rows} == {"", "</script><b>"}
    assert {row["date"] for row in rows} == {result["date"]}
    assert "parkenv run 'a b'" in [row[1] for row in tables["commands"]["rows"]]
    assert len(tables["tasks"]["rows"]) == 2 * len(result["rows"])
    assert len(tables["times"]["rows"]) == 4
    page.unlink()
    unknown = json.loads(json.dumps(other).replace("first-free", "my_agents:Own"))
    unknown["sha256"] = fingerprint(unknown)
    write_result(tmp_path / "other", unknown, "result.json")
    assert "code is '', want the address of the code of my_agents:Own" in refused(*command)
    write_result(tmp_path / "other", other | {"suite_sha256": "0" * 64}, "result.json")
    assert "other" in refused(*command)
    assert not page.exists()
    with pytest.raises(InputError, match="of the suites streets-v1, v3, want those of one"):
        benchmark_data([result, result | {"suite": "streets-v1"}], ["parkenv"])


@pytest.mark.parametrize(
    ("name", "fingerprint", "tasks", "searches", "smallest"),
    [
        ("v3", "42cb771e4ee99c3b27b33d9500979532c5b9e92b11d9b77010e508998436bc38", 12, 3000, "mini"),
        ("streets-v1", "33e5bc1b62c8fe199d797c8c9816bd6a380971119ff8259e2f40f242755776cf", 11, 1200, "noon"),
    ],
)
def test_a_suite_does_not_change_and_is_a_stratified_sample(name, fingerprint, tasks, searches, smallest):
    suite = Suite.packaged(name)
    assert suite.fingerprint == fingerprint
    seeds = [seed for task in suite.tasks for seed in task.seeds]
    assert (len(suite.tasks), len(set(seeds)), len(seeds)) == (tasks, searches, searches)
    for task in suite.tasks:
        assert sum(part.share for part in task.strata) == pytest.approx(1.0)
        full = [part.means[CONTROLS.index("occupancy")] for part in task.strata]
        assert full == sorted(full)
    # The strata divide the worlds by their occupancy at arrival.
    task = next(task for task in suite.tasks if task.name == smallest)
    numbers = np.repeat(np.arange(len(task.strata)), [len(part.seeds) for part in task.strata])
    full = worlds_of(task, suite)[:, CONTROLS.index("occupancy")]
    assert all(full[numbers == h].max() <= full[numbers == h + 1].min() for h in range(len(task.strata) - 1))


def test_searches_of_streets_begin_outside_at_their_hours_and_walk_to_their_goals():
    suite = Suite.packaged("streets-v1")
    saturday = next(task for task in suite.tasks if task.name == "saturday").made(suite.arrival)
    full = next(task for task in suite.tasks if task.name == "nearly-full").made(suite.arrival)
    assert (saturday.arrival.weekdays, saturday.arrival.start_s, saturday.goal) == ((5,), 12 * 3600.0, 18)
    assert full.occupancy.marginal(19.5 * 3600.0).mean() == pytest.approx(0.96)
    for scenario in (saturday, full):
        assert np.hypot(*(scenario.lot.entries - scenario.lot.goals[scenario.goal]).T).min() > 100.0


BEGINNER = """
class Beginner:
    def __init__(self, scenario):
        pass

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return int(observation["action_mask"].nonzero()[0][-1]), state
"""


def test_the_protocol_runs_on_recorded_days_and_says_what_it_leaves_out(tmp_path, monkeypatch):
    """Six weekdays from 8 to 19 h of the ten slots of `mini`: one goal, so equal hours count once; no Saturday."""
    lines = ["slot_id,datetime,occupied"]
    for day, hour, slot in itertools.product(range(11, 19), range(8, 20), range(10)):
        name = f"A{slot + 1}" if slot < 6 else f"B{slot - 5}"
        if day not in (16, 17):  # a weekend
            lines.append(f"{name},2016-01-{day}T{hour:02d}:00:00,{int((slot * 7 + hour * day) % 5 > 1)}")
    (tmp_path / "log.csv").write_text("\n".join(lines))
    (tmp_path / "real.toml").write_text('lot = "mini"\noccupancy = { log = "log.csv", mapping = "same" }')
    (tmp_path / "beginner.py").write_text(BEGINNER)
    monkeypatch.setattr("parkenv.studies.benchmark.suite.SEARCHES_ON", 6)
    agents = "first-free,beginner:Beginner"
    said = ran(f"benchmark run streets-v1 --on real.toml --agents {agents} --jobs 1 --out out", cwd=tmp_path)
    assert "task saturday is left out" in said.stderr + said.stdout
    summary = summary_of(tmp_path / "out")
    assert [row["scenario"] for row in summary["tasks"][::2]] == ["morning", "noon", "evening"]
    assert [(row["scenario"], row["episodes"]) for row in summary["rows"]] == [("real", 18)] * 2
    own = [row for row in rows_in(tmp_path / "out" / "episodes.csv") if row["agent"] == "first-free"]
    wanted = mean_over_days([float(row["total_s"]) for row in own], [row["day"] for row in own])
    assert len({row["day"] for row in own}) > 2
    assert all(8 * 3600 <= float(row["arrival_s"]) % 86_400 <= 19 * 3600 for row in own)
    assert summary["rows"][0]["total_s_ci95"] == pytest.approx(wanted[1:], abs=1e-2)


def test_the_days_of_the_suite_differ_from_their_forecast():
    suite, sizes = Suite.packaged(), {}
    for task in suite.tasks:
        scenario = task.made(suite.arrival)
        sizes[task.name] = scenario.occupancy.day_error
        assert scenario.forecast(Arrival(9 * 3600.0)).day_error == scenario.occupancy.day_error
    assert sizes["campus"] == sizes["jam"] == sizes["campus-full"] == DayError(0.8)
    assert (sizes["campus-slope"], sizes["campus-as-forecast"]) == (DayError(0.6, 0.6), DayError())


@pytest.mark.slow  # reads 24 lots
def test_the_places_are_sure_real_lots_of_stated_kinds():
    groups = Counter()
    for path in PLACES.glob("*.geojson"):
        lot, origin = read_lot(path), read_provenance(path)
        assert origin.source.startswith("zuid-holland_")
        assert combined_error_probability(origin.issues) <= 0.3
        assert lot.slot_ids[0].startswith(("way/", "relation/"))
        row = lot_columns(lot, check_drivability(lot, origin.issues))
        kind = row["kind"]
        groups[f"{kind}, {row['size']}" if kind == "perpendicular" else kind] += 1
    assert groups == {
        "perpendicular, small": 4, "perpendicular, medium": 4, "perpendicular, large": 4,
        "oblique": 2, "kerbside": 4, "mixed": 6,
    }  # fmt: skip
    notice = (PLACES / "LICENSE").read_text(encoding="utf-8")
    assert "Open Database License" in notice
    assert "OpenStreetMap contributors" in notice


def test_the_command_tells_of_the_suite_and_refuses_what_is_none(tmp_path):
    assert "campus-full" in ran("benchmark show").stdout
    assert "'v7'" in refused("benchmark run v7 --out", tmp_path / "out")
    for content in ('{"format": "park', "[" * 100_000):
        (tmp_path / "torn.json").write_text(content)
        assert "not JSON" in refused("benchmark check", tmp_path / "torn.json")
