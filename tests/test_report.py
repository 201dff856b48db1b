"""`parkenv report`: the page's data are the run's, its replays the run's searches."""

import itertools
import json
import re
import shutil

import numpy as np
import pytest
from command_line import ran, summary_of
from stored_rows import change_rows

from parkenv import InputError, make_scenario
from parkenv.cli.report import make_report
from parkenv.files.known_names import UNBEATEN
from parkenv.lots import packaged_lot, write_lot
from parkenv.show.tables import table_of
from parkenv.studies.compare.cases import Case
from parkenv.studies.compare.search_replay import Encounter, choose, replay
from parkenv.studies.report import RunFolder
from parkenv.studies.results import EPISODES
from parkenv.studies.sensing.sessions import SESSIONS
from parkenv.studies.study import ExecutionSpec, ReportOptions
from parkenv.world.lot import PARK


def data_of(page, name="report-data"):
    text = page.read_text(encoding="utf-8")
    return json.loads(re.search(rf'id="{name}">(.*?)</script>', text, flags=re.DOTALL)[1])


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A small comparison, with its report."""
    out = tmp_path_factory.mktemp("report") / "compare"
    options = "--failure-cost 10,30 -n 4 --occupancy-levels none --seed 7 --jobs 1 --report"
    ran(f"compare --scenario mini --agents mdp,belief,mdp-static,oracle {options} --out", out)
    return out


def test_the_tables_hold_every_number_of_the_summary(run):
    rows = summary_of(run)["rows"]
    (table,) = [t for t in data_of(run / "report.html")["tables"] if t["name"] == "rows"]
    keys = [column["key"] for column in table["columns"]]
    same = {column["key"]: column["value"] for column in table["same"]}
    assert len(table["rows"]) == len(rows)
    assert table["leads"] == [i for i, row in enumerate(rows) if row.pop("leads")]
    assert table["unbeaten"] == [i for i, row in enumerate(rows) if row["agent"] in UNBEATEN]
    for row, cells in zip(rows, table["rows"], strict=True):
        shown = same | dict(zip(keys, cells, strict=True))
        for key, value in row.items():
            if key.endswith("_ci95"):  # four searches have no interval
                assert shown[key.removesuffix("_ci95")] == [row[key.removesuffix("_ci95")], None, None]
            elif f"{key}_ci95" not in row and value and key != "median_s":
                assert shown[key] == value


def test_every_replayed_search_comes_to_the_total_that_was_counted(run):
    counted = {EPISODES.key(row): row["total_s"] for row in EPISODES.read(run)}
    worlds = data_of(run / "report.html")["worlds"]
    searches = [(world, search) for world in worlds for search in world["searches"]]
    assert len(searches) == 20
    for world, search in searches:
        setting = world["setting"] | {"agent": search["agent"], "seed": world["seed"]}
        assert search["total_s"] == counted[EPISODES.key(setting)] == search["counted_s"]
        assert search["agrees"] is True
        costs, times = search["costs"], search["t"]
        assert sum(costs.values()) == pytest.approx(search["total_s"])
        assert times[-1] == pytest.approx(100 * (costs["drive_s"] + costs["failed_s"]), abs=1)
        assert len(times) == len(search["action"]) + 1 == len(search["belief"]) == len(search["plan"]) + 1
        assert times == sorted(times)
        # All agents of a world meet the same cars.
        taken = set(world["taken"])
        for moment, *slots in world["changes"]:
            if moment <= times[-1]:
                taken ^= set(slots)
        assert not search["parked"] or search["slot"] not in taken


def test_a_page_is_one_small_file_that_needs_nothing_else_and_is_made_again_the_same(run, tmp_path):
    page = run / "report.html"
    text = page.read_text(encoding="utf-8")
    assert page.stat().st_size < 10e6
    without_data = re.sub(r"data:[a-z/+-]+;base64,[A-Za-z0-9+/=]+", "", text)
    assert not re.findall(r"""(?:src|href)\s*=\s*["'](?!data:|#)[^"']""", without_data)
    assert re.findall(r"https?://[^\s\"'<>]+", without_data.replace("http://www.w3.org/2000/svg", "")) == []
    assert text.count("<figure") == len(list(run.glob("*.png")))
    again = make_report(run, ExecutionSpec(jobs=2), out=tmp_path / "again.html")
    assert again.read_bytes() == page.read_bytes()


def test_searches_of_the_run_can_be_chosen(run, tmp_path):
    for options, message in (
        (ReportOptions(numbers=(99,)), "99; .* 7 to 10"),
        (ReportOptions(agents=("belief", "usual")), "'usual'; known: mdp, belief"),
    ):
        with pytest.raises(InputError, match=message):
            make_report(run, ExecutionSpec(), options, out=tmp_path / "x.html")
    assert not list(tmp_path.iterdir())
    options = ReportOptions(numbers=(9, 8), agents=("belief", "oracle"))
    worlds = data_of(make_report(run, ExecutionSpec(jobs=1), options, out=tmp_path / "chosen.html"))["worlds"]
    assert [w["seed"] for w in worlds] == [9, 9, 8, 8]
    assert {s["agent"] for w in worlds for s in w["searches"]} == {"belief", "oracle"}


def summary_in(folder, **changes):
    content = {"command": ["parkenv", "bench"], "version": "0.1.0", "seed": 0, "rows": []} | changes
    (folder / "summary.json").write_text(json.dumps(content))
    return folder


def test_folders_that_hold_no_finished_run_are_refused_in_words(tmp_path):
    def refused(folder, match):
        with pytest.raises(InputError, match=match):
            RunFolder.read(folder)

    refused(tmp_path / "nothing", "no such folder")
    refused(tmp_path, "summary.json")
    refused(summary_in(tmp_path, version="0.0.9"), "0.0.9")
    for damaged in (
        {"rows": None},
        {"seed": 10**20},
        {"command": ["parkenv", "commute"], "weeks": [[]]},
        {"command": ["parkenv", "train"]},
        {"rows": [{"total_s_ci95": None}]},
    ):
        refused(summary_in(tmp_path, **damaged), "is not as a command wrote it")
    (tmp_path / "summary.json").write_text('{"command": [')
    refused(tmp_path, "JSON")
    (tmp_path / "summary.json").rename(tmp_path / "summary.partial.json")
    refused(tmp_path, "interrupted")


def test_a_total_that_differs_is_told(run, tmp_path, capsys):
    copy, first = shutil.copytree(run, tmp_path / "copy"), iter([True])
    change_rows(copy, lambda row: next(first, None) and row.update(total_s=1.0))
    make_report(copy, ExecutionSpec(jobs=1))
    assert "episodes.csv says 1.00 s" in " ".join(capsys.readouterr().out.split())
    data = data_of(copy / "report.html")
    assert len(data["run"]["notes"]) == 1
    assert sum(s["agrees"] is False for w in data["worlds"] for s in w["searches"]) == 1


def test_a_world_that_has_changed_since_is_not_replayed_but_told(tmp_path):
    lot, out = tmp_path / "lot.geojson", tmp_path / "compare"
    write_lot(packaged_lot("mini"), lot)
    words = "compare --agents mdp,oracle -n 2 --occupancy-levels none --no-figures --jobs 1 --out"
    ran(words, out, "--lot", lot)
    make_report(out, ExecutionSpec(jobs=1))
    assert len(data_of(out / "report.html")["worlds"]) == 2
    lot.write_text(lot.read_text() + "\n")
    make_report(out, ExecutionSpec(jobs=1))
    data = data_of(out / "report.html")
    assert data["run"]["notes"] == [f"There is no replay: {lot} has changed since the run"]
    assert (data["worlds"], len(data["tables"][0]["rows"])) == ([], 2)


def test_learning_curves_are_those_of_the_training(tmp_path):
    for seed, text in ((3, "steps,total_s\n0,0.25\n500,0.5\n"), (4, "step,total_s\n0,1\n")):
        (tmp_path / f"seed_{seed}").mkdir()
        (tmp_path / f"seed_{seed}" / "curve.csv").write_text(text)
    curve = [
        {"steps": steps, "total_s": value, "low_s": None, "high_s": None}
        for steps, value in ((0.0, 0.25), (500.0, 0.5))
    ]
    summary_in(
        tmp_path,
        command=["parkenv", "train"],
        rows=[{"agent": "ppo", "scenario": "campus,street", "seed": k, "total_s": 0.5} for k in (3, 4)],
        evaluated={"mdp": 80.0, "clairvoyant bound": 60.0},
        curve=curve,
    )
    data = RunFolder.read(tmp_path).data()
    assert data["run"]["title"] == "ppo trained on campus and street"
    (panel,) = data["learning"]
    assert panel["title"] == "total time, s"
    assert panel["mean"] == [[0.0, 0.25, None, None], [500.0, 0.5, None, None]]
    assert panel["seeds"] == [[[0.0, 0.25], [500.0, 0.5]], []], "a curve without steps is not drawn"
    assert panel["lines"] == [["mdp", 80.0], ["clairvoyant bound", 60.0]]


def test_text_in_the_data_ends_no_element_and_episodes_of_other_commands_are_no_searches(tmp_path):
    nasty = "</script><script>alert(1)</script>"
    summary_in(tmp_path, rows=[{"case": nasty}, {"case": "b"}], command=["parkenv", "park", nasty])
    (tmp_path / "episodes.csv").write_text("agent,lot,seed,parked\nplanner,mini,0,True\n")
    make_report(tmp_path, ExecutionSpec(jobs=1))
    assert nasty not in (tmp_path / "report.html").read_text()
    assert data_of(tmp_path / "report.html")["tables"][0]["rows"] == [[nasty], ["b"]]


def test_searches_are_chosen_in_turns_over_settings():
    mini = make_scenario("mini")
    settings = itertools.product((1.0, 2.0), ("mdp", "oracle"))
    cases = [(Case(mini.replace(failure_s=cost), agent), range(5, 9)) for cost, agent in settings]
    chosen = choose(cases, 7)
    assert [(e.cases[0].scenario.failure_s, e.seed) for e in chosen] == [(1.0, 5), (2.0, 5), (1.0, 6)]
    assert len(choose(cases, 1)) == 1


@pytest.mark.parametrize("name", ["mdp-tuned", "belief", "greedy-goal", "first-free", "oracle", "random"])
def test_plans_are_ways_that_can_be_driven_and_begin_with_what_is_done(name):
    scenario = make_scenario("campus")
    recorded = replay(Encounter((Case(scenario, name),), 3), {})
    (search,), neighbors = recorded["world"]["searches"], scenario.lot.neighbors
    assert search["agrees"] is None
    plan, planned = [], 0
    for k, (action, vertex) in enumerate(zip(search["action"], search["vertex"], strict=False)):
        if search["plan"][k] is not None:
            plan = search["plan"][k]
        elif k and vertex != search["vertex"][k - 1]:
            plan = plan[1:]
        way = [vertex, *plan]
        assert all(b in neighbors[a] for a, b in itertools.pairwise(way))
        if plan and action < PARK:
            assert plan[0] == neighbors[vertex, action]
        planned += bool(plan)
    assert planned == 0 if name == "random" else planned > len(search["action"]) / 2


def test_intervals_and_nested_figures_become_cells():
    row = {"a_s": 1.0, "a_s_ci95": [0.5, 2.0], "error_m": {"median": 0.1, "p95": 0.3}, "list": [{}]}
    table = table_of("x", "X", [row])
    assert [c["key"] for c in table["columns"]] == ["a_s", "error_m.median", "error_m.p95"]
    assert table["rows"] == [[[1.0, 0.5, 2.0], 0.1, 0.3]]
    few = table_of("x", "X", [{"episodes": 2, "a_s": a, "a_s_ci95": [0.5, 2.0]} for a in (1.0, 2.0)])
    assert few["rows"] == [[[1.0, None, None]], [[2.0, None, None]]], "two searches have no interval"


@pytest.mark.slow
def test_a_survey_is_driven_again(tmp_path):
    out = tmp_path / "survey"
    ran("survey --scenario mini --sessions 2 --every 6 --weather sunny --jobs 1 --report --out", out)
    data = data_of(out / "report.html")
    (drive,), sessions = data["drives"], SESSIONS.read(out)
    assert drive["key"] == sessions[0]["key"]
    assert drive["slot_accuracy"] == sessions[0]["slot_accuracy"]
    assert (drive["found"], drive["parked"]) == (sessions[0]["found"], sessions[0]["parked"])
    assert drive["captures"] == len(drive["frames"])
    judged = {}
    for frame in drive["frames"]:
        judged |= dict(zip(frame["belief"][::2], frame["belief"][1::2], strict=True))
    assert np.mean([value >= 0 for value in judged.values()]) > 0.5
    assert (out / "report.html").stat().st_size < 10e6

    made = tmp_path / "short.html"
    make_report(out, ExecutionSpec(jobs=1), ReportOptions(frames=6, sessions=2), out=made)
    assert [len(d["frames"]) <= 4 for d in data_of(made)["drives"]] == [True, True]
