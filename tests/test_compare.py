"""`parkenv compare` and related commands: results, resuming, errors."""

import numpy as np
import pytest
from command_line import ran, refused, rows_in, summary_of
from pictures import shows_color

from parkenv import SensorModel, make_scenario
from parkenv.lots import packaged_lot, write_lot
from parkenv.show.tables import table_of
from parkenv.studies.compare.cases import Case, table
from parkenv.studies.compare.comparison import Comparison
from parkenv.studies.results import DECISIONS
from parkenv.studies.statistics import MEANS, mean_interval, summarize
from parkenv.studies.study import Cell

LOG = "datetime,camera,slot_id,weather,occupied\n"
ONE_DAY = LOG + "".join(
    f"2015-11-12 {hour:02d}:09,1,s{slot},sunny,{slot % 2}\n" for hour in range(7, 14) for slot in range(10)
)


def small(out, *more, agents="mdp,greedy-goal,oracle", episodes=12):
    return (
        "compare", "--scenario", "mini", "--agents", agents, "-n", episodes, "--occupancy-levels", "none",
        "--no-figures", "--jobs", 1, "--out", out, *more,
    )  # fmt: skip


def rows_without_times(out):
    rows = summary_of(out)["rows"]
    return [{k: v for k, v in row.items() if not k.startswith("decision_ms")} for row in rows]


def test_the_summary_is_what_the_episodes_say(tmp_path):
    ran(*small(tmp_path, "--failure-cost", "10,90", "--v-walk-kmh", "4,10"))
    episodes, rows = rows_in(tmp_path / "episodes.csv"), rows_without_times(tmp_path)
    assert len(episodes) == 12 * 3 * 2 * 2
    assert len(rows) == 3 * 2 * 2
    for row in rows:
        keys = ("agent", "failure_cost_s", "v_walk_kmh")
        its = [float(e["total_s"]) for e in episodes if all(e[key] == str(row[key]) for key in keys)]
        assert row["total_s"] == pytest.approx(np.mean(its))
        low, high = row["total_s_ci95"]
        assert low < row["total_s"] < high
        terms = ("drive_s", "failed_s", "walk_s", "parking_cost_s", "gave_up_s")
        assert row["total_s"] == pytest.approx(sum(row[term] for term in terms))
        assert row["regret_s"] >= -1e-9
        assert row["episodes"] == 12
    assert rows[1]["difference_s"] == pytest.approx(rows[1]["total_s"] - rows[0]["total_s"])
    assert summary_of(tmp_path)["command"][1] == "compare"
    assert {"version", "seed", "rows"} <= summary_of(tmp_path).keys()


def test_figures_and_occupancy_levels(tmp_path):
    ran(
        "compare", "--scenario", "mini", "--agents", "greedy-goal,oracle", "-n", 12,
        "--occupancy-levels", "0.5,0.9", "--out", tmp_path,
    )  # fmt: skip
    pictures = sorted(p.name for p in tmp_path.glob("*.png"))
    assert pictures == [
        "searches_mini_failure10_walk4_drive10.png",
        "time_against_occupancy_mini.png",
        "time_distribution_failure10_walk4_drive10.png",
        "time_split_mini.png",
    ]
    swept = summary_of(tmp_path)["occupancy_rows"]
    assert [r["occupancy_level"] for r in swept] == [0.5, 0.5, 0.9, 0.9]
    assert swept[1]["total_s"] < swept[3]["total_s"], "a fuller lot takes longer"


def test_the_sweep_over_failure_costs_tells_seen_slots_from_unseen_ones(tmp_path):
    ran(
        "compare", "--scenario", "mini", "--agents", "greedy-drive,mdp-tuned", "-n", 6, "--failure-cost", "sweep",
        "--jobs", 1, "--out", tmp_path,
    )  # fmt: skip
    assert [p.name for p in tmp_path.glob("*.png")] == ["time_against_failure_cost_mini.png"]
    rows = summary_of(tmp_path)["rows"]
    tries = {(r["scenario"], r["failure_cost_s"]): r for r in rows if r["agent"] == "greedy-drive"}
    assert len(tries) == 26
    assert all(row["blind"] == (name == "mini-blind") for (name, _), row in tries.items())
    assert {r["scenario"] for r in rows if r["agent"] == "mdp-tuned"} == {"mini"}
    assert all(r["failed_s"] == 0.0 for (name, _), r in tries.items() if name == "mini")
    blind = [tries["mini-blind", cost]["total_s"] for cost in (0.0, 8.0, 30.0, 120.0)]
    assert blind == sorted(blind)
    assert tries["mini-blind", 120.0]["failed_parks"] > 0.0
    # Other costs replace the whole sweep, with its searches without observations.
    ran("compare", "--resume", "--failure-cost", 5, "--no-figures", "--out", tmp_path)
    rows = summary_of(tmp_path)["rows"]
    assert [(r["scenario"], r["failure_cost_s"]) for r in rows] == [("mini", 5.0), ("mini", 5.0)]


def test_agents_may_be_given_maps_that_are_wrong(tmp_path):
    ran(
        "compare", "--scenario", "mini", "--agents", "mdp,first-free,oracle", "-n", 12,
        "--constant-forecast", "0,0.5,1", "--occupancy-levels", "none", "--jobs", 1, "--out", tmp_path,
    )  # fmt: skip
    rows = summary_of(tmp_path)["rows"]
    total = {(row["scenario"], row["agent"]): row["total_s"] for row in rows}
    worlds = ("mini", *(f"mini-constant-forecast-{p}" for p in ("0", "0.5", "1")))
    assert {name for name, _ in total} == set(worlds)
    assert len({total[name, "oracle"] for name in worlds}) == 1, "the worlds are the same"
    assert len({total[name, "mdp"] for name in worlds}) > 1, "the maps are not"
    assert (tmp_path / "time_against_map_mini.png").exists()
    assert not (tmp_path / "time_split_mini-constant-forecast-1.png").exists()


def test_worse_sight_costs_time_and_the_stacks_is_nearly_perfect(tmp_path):
    SensorModel(6.0, 0.8, 0.3).to_file(tmp_path / "poor.json")
    total = {}
    for sight in ("perfect", "laser", tmp_path / "poor.json"):
        out = tmp_path / f"out{len(total)}"
        ran(*small(out, "--sensor-model", sight, agents="greedy-drive", episodes=25))
        total[sight] = rows_without_times(out)[0]
    perfect, laser, poor = total.values()
    assert perfect["failed_s"] == 0.0 < poor["failed_s"]
    assert poor["total_s"] > perfect["total_s"]
    assert laser["total_s"] == pytest.approx(perfect["total_s"], rel=0.1)


def test_plan_writes_a_path_and_a_picture_to_a_goal_anywhere(tmp_path, lot_file):
    ran("plan", "--scenario", "jam", "--failure-cost", "10,90", "--out", tmp_path)
    assert all(shows_color(tmp_path / "plan.png", color) for color in ("#ffd000", "#1852ba")), "path and walk"
    bold, careful = summary_of(tmp_path)["rows"]
    assert len(bold["path"]) > len(careful["path"]) > 2
    assert bold["path"][-1] == bold["slot"]
    ran("plan", "--lot", lot_file, "--goal", "5,5", "--out", tmp_path / "plan")


def episode(seed, total, parked=True):
    return {**dict.fromkeys(MEANS, 0.0), "seed": seed, "total_s": total, "parked": parked, DECISIONS: ""}


def test_differences_are_paired_by_seed_and_one_value_has_no_interval():
    first = [episode(s, 100.0 * s) for s in range(20)]
    other = [episode(s, 100.0 * s + 1.0) for s in range(19, 5, -1)]
    row = summarize({}, other, first)
    assert row["difference_s"] == pytest.approx(1.0)
    assert row["difference_s_ci95"] == pytest.approx([1.0, 1.0])
    np.testing.assert_array_equal(mean_interval([4.0]), (4.0, np.nan, np.nan))


@pytest.mark.parametrize(
    ("n", "slower_s", "leaders"),
    [(30, 8.0, ["mdp"]), (30, 0.5, ["mdp", "belief"]), (2, 8.0, ["mdp", "belief"])],
)
def test_an_agent_is_called_the_fastest_only_where_no_interval_includes_0(n, slower_s, leaders):
    """The oracle, which is faster than all, is no competitor; two searches show nothing, however they end."""
    scenario, noise = make_scenario("mini"), np.random.default_rng(1).normal(0.0, 5.0, n)
    cases = [Case(scenario, name) for name in ("mdp", "belief", "oracle")]
    later = {"mdp": np.zeros(n), "belief": slower_s + noise - noise.mean(), "oracle": np.full(n, -20.0)}
    finished = {case.key(s): episode(s, 100.0 + s + later[case.agent][s]) for case in cases for s in range(n)}
    rows = table([Cell(case, range(n)) for case in cases], finished)
    assert [row["agent"] for row in rows if row["leads"]] == leaders
    (finding,) = Comparison.findings({"rows": rows})
    assert all(name in finding for name in leaders)
    assert ("belief" in finding) == (len(leaders) == 2)


def test_where_a_search_gave_up_the_median_and_their_share_stand_beside_the_mean():
    rows = []
    for name, last in (("mdp", 1800.0), ("belief", 60.0)):
        searches = [episode(s, t, parked=t < 1000.0) for s, t in enumerate((30.0, 40.0, 50.0, last))]
        rows.append(summarize({"scenario": "mini", "agent": name}, searches))
    assert (rows[0]["median_s"], rows[0]["gave_up_fraction"]) == (45.0, 0.25)
    shown = [column["key"] for column in table_of("rows", "Results", rows)["columns"]]
    assert {"median_s", "gave_up_fraction"} < set(shown)
    assert "median_s" not in [column["key"] for column in table_of("rows", "Results", rows[1:])["columns"]]


@pytest.fixture
def lot_file(tmp_path):
    path = tmp_path / "lot.geojson"
    write_lot(packaged_lot("mini"), path)
    return path


@pytest.mark.parametrize(
    ("text", "wanted"),
    [(LOG + "2015-11-12 09:09,1,a,,2\n", "line 2"), (LOG, "log.csv"), (ONE_DAY, "one more to forecast from")],
)
def test_bad_logs_are_one_clear_line(tmp_path, lot_file, text, wanted):
    (tmp_path / "log.csv").write_text(text)
    said = refused("compare", "--lot", lot_file, "--occupancy", "log.csv", "--out", "out", cwd=tmp_path)
    assert "log.csv" in said
    assert wanted in said
    assert not (tmp_path / "out").exists()


def test_going_on_notices_that_an_agent_of_your_own_has_changed(tmp_path):
    module, out = tmp_path / "mine.py", tmp_path / "out"
    module.write_text("from planners.heuristics.agents import GreedyGoalAgent as Mine\n")
    ran(*small(out, agents="mine:Mine"), cwd=tmp_path)
    ran(*small(out, "--resume", agents="mdp", episodes=3), cwd=tmp_path)
    ran(*small(out, "--resume", agents="mine:Mine", episodes=14), cwd=tmp_path)
    module.write_text("from planners.heuristics.agents import RandomAgent as Mine\n")
    said = refused(*small(out, "--resume", agents="mine:Mine", episodes=16), cwd=tmp_path)
    assert "agent files: mine:Mine was" in said
