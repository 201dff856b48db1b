"""The demo: from a survey to a film, in one command."""

import pytest
from command_line import ran, summary_of
from PIL import Image

from parkenv.scenarios.spec import scenario_spec
from parkenv.studies.compare.cases import Case
from parkenv.studies.demo.study import AGENTS, QUICK, Demo


@pytest.mark.slow
def test_a_quick_demo_leaves_a_report_and_a_film_and_says_where(tmp_path):
    out = tmp_path / "demo"
    shorter = ("--more", 10, "--every", 8)
    done = ran("demo", "--scenario", "mini", "--quick", *shorter, "--jobs", 1, "--out", out)
    summary = summary_of(out)
    assert [row["agent"] for row in summary["rows"]] == 2 * list(AGENTS)
    through_sensors, without_images = summary["rows"][: len(AGENTS)], summary["rows"][len(AGENTS) :]
    assert {row["episodes"] for row in through_sensors} == {QUICK["episodes"]}
    assert {row["episodes"] for row in without_images} == {10}
    assert all(row["leads"] for row in through_sensors if row["agent"] != "oracle"), "two show nothing"
    assert done.stdout.index(str(out / "lot.png")) < done.stdout.index("Compiling")
    assert all(row["regret_s"] >= -1e-6 for row in summary["rows"])
    for name in ("lot.png", "report.html", "search.gif"):
        assert str(out / name) in done.stdout
    assert done.stdout.count("\n  parkenv ") == 2, "commands to try next"
    page = (out / "report.html").read_text()
    assert page.count("<figure") == len(list(out.glob("*.png"))) == 6
    assert '"drives":[{' in page
    with Image.open(out / "search.gif") as film:
        assert film.n_frames > 10
        assert film.width == 840
    assert (out / "search.gif").stat().st_size < 3e6

    # The oracle needs no sensors.
    cases = Demo(scenario=scenario_spec("mini"), sessions=2, episodes=2, every=8.0).cases_in(out)
    (oracle,) = [case for case, _ in cases if case.agent == "oracle"]
    seed = cases[0][1][0]
    looking = Case(oracle.scenario, "oracle", rig="laser").runner().run(seed).row
    assert looking["total_s"] == oracle.runner().run(seed).row["total_s"]
