"""Experiment files: what they run, how a run folder is resumed, and errors of invalid files."""

import json
import sys
from pathlib import Path

import jsonschema
import pytest
from command_line import ran, refused, rows_in, summary_of
from stored_rows import change_rows

from parkenv import InputError
from parkenv.files.option import parse_call
from parkenv.files.spec_file import read_tables
from parkenv.studies.compare.comparison import Comparison
from parkenv.studies.fields import AgentSpec, split_agents
from parkenv.studies.results import SPEC_FILE
from parkenv.studies.study import schemas

ROOT = Path(__file__).parents[1]
COURTYARD = ROOT / "examples" / "courtyard"

SWEEP = """
agents = ["first-free", { name = "mdp", failure_s = 90 }, "mdp"]
scenarios = ["mini", "own.toml", { name = "inline", lot = { grid = { rows = 2, columns = 6 } } }]
episodes = 4
seed = 7
jobs = 1
figures = false

[grid]
failure_s = [5, 60]
v_walk_kmh = 4
v_drive_kmh = [10, 15]
"""


@pytest.fixture
def sweep(tmp_path):
    own, file = tmp_path / "own.toml", tmp_path / "sweep.toml"
    own.write_text('lot = "mini"\ncosts = { give_up_s = 60 }\nspeeds = { v_walk_kmh = 3 }\n')
    file.write_text(SWEEP)
    return file


def refusal(folder, text):
    (folder / "bad.toml").write_text(text)
    said = refused("run", folder / "bad.toml", "--out", folder / "out")
    assert not (folder / "out").exists()
    return said


def test_a_file_is_run_and_its_folder_says_what_was_run(tmp_path, sweep):
    out = tmp_path / "out"
    ran("run", sweep, "--out", out)
    rows = summary_of(out)["rows"]
    assert len(rows) == 3 * 3 * 2 * 2
    assert {row["agent"] for row in rows} == {"first-free", "mdp(failure_s=90)", "mdp"}
    assert {row["scenario"] for row in rows} == {"mini", "own", "inline"}
    assert {row["v_walk_kmh"] for row in rows} == {4.0}, "the grid goes before the scenario's own speed"
    kept = Comparison.read(out / SPEC_FILE)
    assert kept == Comparison.read(sweep)

    # The folder alone is enough to resume the run and to extend it.
    (out / "summary.json").rename(out / "summary.partial.json")
    episodes = (out / "episodes.csv").read_text()
    change_rows(out, lambda row: row["seed"] > 8)
    ran("run", out, "--resume")
    assert (out / "episodes.csv").read_text() == episodes
    ran("compare", "--resume", "-n", 5, "--out", out)
    assert {row["episodes"] for row in summary_of(out)["rows"]} == {5}
    assert Comparison.read(out / SPEC_FILE) == kept.changed(episodes=5)

    # A changed file of the experiment is detected.
    (tmp_path / "own.toml").write_text('lot = "mini"\ncosts = { give_up_s = 70 }\n')
    assert "own.costs.give_up_s was 60.0" in refused("run", sweep, "--out", out, "--resume")


def test_what_the_world_charges_and_what_a_planner_assumes_are_two_things(sweep):
    cases = [case for case, _ in Comparison.read(sweep).cases if case.agent == "mdp"]
    assert {case.scenario.failure_s for case in cases} == {5.0, 60.0}
    assert {case.label: case.options for case in cases} == {"mdp(failure_s=90)": {"failure_s": 90}, "mdp": {}}


def test_options_build_the_same_specification_as_a_file(tmp_path, sweep):
    out = tmp_path / "out"
    ran(
        "compare", "--scenario", f"mini,{tmp_path / 'own.toml'}", "--agents", "first-free,mdp(failure_s=90)", "-n", 2,
        "--failure-cost", "5,60", "--v-walk-kmh", "4", "--occupancy-levels", "none", "--jobs", 1, "--no-figures",
        "--out", out,
    )  # fmt: skip
    text = SWEEP.replace(', { name = "inline", lot = { grid = { rows = 2, columns = 6 } } }', "")
    text = text.replace(', "mdp"]', "]").replace("v_drive_kmh = [10, 15]", "").replace("seed = 7", "")
    sweep.write_text(text.replace("episodes = 4", "episodes = 2"))
    assert Comparison.read(out / SPEC_FILE) == Comparison.read(sweep)


def test_a_scenario_may_be_called_like_a_blind_one():
    named = {"name": "x-blind", "lot": "mini"}
    spec = Comparison.parse({"agents": ["belief"], "scenarios": [named], "episodes": 2}, "test")
    assert [case.scenario.name for case, _ in spec.cases] == ["x-blind"]


def test_agents_with_options_are_read_from_words_and_tables():
    words = ["mdp(failure_s=90,gamma=0.9)", "ppo:a/b.zip", "oracle"]
    assert split_agents("mdp(failure_s=90,gamma=0.9), ppo:a/b.zip,oracle") == words
    table = parse_call("x:Y(a=1, b=2.5,c=true,d=word)")
    assert table == {"name": "x:Y", "a": 1, "b": 2.5, "c": True, "d": "word"}
    spec = AgentSpec.parse(table, "test")
    assert spec.label == "x:Y(a=1,b=2.5,c=true,d=word)"
    assert parse_call(spec.label) == table
    for text in ("mdp(", "mdp(a)", "mdp(a=1,a=2)", "mdp(a=(1))", "mdp(=1)", "mdp(a=)"):
        with pytest.raises(InputError, match="agent 'mdp"):
            parse_call(text)


def test_a_grid_without_bounds_is_refused_before_any_work(tmp_path):
    axis = list(range(1, 1001))
    speeds = f"v_walk_kmh = {[v / 10 for v in axis]}\nv_drive_kmh = {[v / 5 for v in axis]}"
    said = refusal(tmp_path, f"episodes = 1\n[grid]\nfailure_s = {axis}\n{speeds}")
    assert "agents x scenarios x grid x episodes is 8000000000 searches, want at most" in said


def test_the_example_of_the_documentation_has_a_cell_for_every_combination():
    """Its commands are run in `test_documents`."""
    cells = Comparison.read(COURTYARD / "sweep.toml").cells()
    assert len(cells) == 5 * 3 * 2 * 2
    assert {cell.work.columns["scenario"] for cell in cells} == {"courtyard", "mini", "garage"}


def test_files_are_valid_by_the_schemas_of_their_kinds(tmp_path):
    made = schemas()
    assert str(ROOT) not in json.dumps(made)  # no path of the machine on which they are written
    ran("schema --out", tmp_path)
    written = {file.name: json.loads(file.read_text()) for file in tmp_path.iterdir()}
    assert written == {f"{kind}.schema.json": schema for kind, schema in made.items()}
    for file, kind in ((COURTYARD / "courtyard.toml", "scenario"), (COURTYARD / "sweep.toml", "compare")):
        jsonschema.validate(read_tables(file), made[kind])
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate(read_tables(file) | {"episods": 3}, made[kind])


AGENT = """
from pathlib import Path
from planners.heuristics.agents import FirstFreeAgent

Path("was_run").touch()

class Mine(FirstFreeAgent):
    name = "mine"
"""
EXPERIMENTS = {
    "compare": {"agents": ["mdp", "{module}:Mine"], "grid": {}, "figures": False, "episodes": 2},
    "benchmark": {"agents": ["{module}:Mine"]},
    "train": {"agents": ["{module}:Mine"]},
    "survey": {"detector": "{module}:Mine"},
    "demo": {"detector": "{module}:Mine"},
}


@pytest.fixture
def module(tmp_path, monkeypatch, request):
    """A module of a user's agent in the working directory, which leaves a mark when it is imported."""
    name = f"their_{abs(hash(request.node.name))}"
    (tmp_path / f"{name}.py").write_text(AGENT)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    return name


def experiment(path, kind, module):
    tables = {"kind": kind, "jobs": 1} | EXPERIMENTS[kind]
    if kind in ("compare", "train"):
        tables["scenarios"] = ["mini"]
    path.write_text(json.dumps(tables).replace("{module}", module))
    return path


@pytest.mark.parametrize("kind", EXPERIMENTS)
def test_an_experiment_file_that_names_a_class_shows_it_and_asks_for_trust(module, tmp_path, kind):
    message = refused("run", experiment(tmp_path / "theirs.json", kind, module))
    assert f"theirs.json: would run {module}:Mine ({tmp_path / module}.py); read that code" in message
    assert not (tmp_path / "was_run").exists()
    assert not (tmp_path / "results").exists()


def test_a_cluster_in_a_file_asks_for_trust(tmp_path):
    cluster = {"backend": "dask", "address": "tcp://theirs.example:8786"}
    compared = {"kind": "compare", "scenarios": ["mini"], "agents": ["theirs:Mine"]}
    (tmp_path / "experiment.json").write_text(json.dumps(compared | cluster))
    asked = f"would run tasks on the cluster at {cluster['address']}; read"
    resumed = ("compare", "--resume", "--agents", "mdp", "--out", tmp_path)
    assert asked in refused(*resumed)
    assert "holds no compare run to resume" in refused(*resumed, "--backend", "loky")
    (tmp_path / "experiment.json").rename(tmp_path / "theirs.json")
    (tmp_path / "theirs.json").write_text(json.dumps({"agents": ["mdp"]} | cluster))
    assert asked in refused("run", tmp_path / "theirs.json", "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_run_folder_that_names_a_class_asks_for_trust_and_the_class_names_the_agent(module, tmp_path):
    mark, out = tmp_path / "was_run", tmp_path / "out"
    ran("run", experiment(tmp_path / "theirs.json", "compare", module), "--out", out, "--trust")
    assert mark.exists()
    assert [row["agent"] for row in summary_of(out)["rows"]] == ["mdp", "mine"]
    assert [row["agent"] for row in rows_in(out / "episodes.csv")] == ["mdp"] * 2 + ["mine"] * 2
    sys.modules.pop(module)
    mark.unlink()
    for command in (("report", out), ("run", out, "--resume"), ("compare", "--resume", "--out", out)):
        assert "add --trust" in refused(*command)
    assert not mark.exists()
    assert "Note" not in ran("report", out, "--trust", "--jobs", 1, "--episodes", 1).stdout
    assert mark.exists()


def test_agents_on_the_command_line_are_the_users_own_choice(module, tmp_path):
    command = ["compare", "--scenario", "mini", "--episodes", 1, "--occupancy-levels", "none", "--no-figures"]
    command += ["--jobs", 1, "--out", tmp_path / "out", "--agents"]
    ran(*command, f"mdp,{module}:Mine", "--report")
    (tmp_path / f"{module}_too.py").write_text(AGENT)
    assert "'mine'" in refused(*command, f"{module}:Mine,{module}_too:Mine", "--overwrite")


WORLD = (Path(__file__).with_name("timetable_world.py")).read_text() + '\nopen("was_run", "w").close()\n'


def test_a_world_of_ones_own_is_named_on_the_command_line_and_by_no_scenario_file(module, tmp_path):
    mark, out = tmp_path / "was_run", tmp_path / "out"
    (tmp_path / f"{module}.py").write_text(WORLD)
    (tmp_path / "theirs.toml").write_text(f'lot = "mini"\noccupancy = "{module}:Timetable"')
    assert "no class in a scenario file" in refused("compare", "--scenario", "theirs.toml")
    assert not mark.exists()
    own = f"--scenario mini --occupancy {module}:Timetable(taken_s=1100) --jobs 1 --no-figures"
    ran(f"compare {own} --agents first-free,oracle -n 3 --out", out)
    first_free, oracle = summary_of(out)["rows"]
    assert first_free["total_s"] > oracle["total_s"]
    ran(f"fleet {own} --arrivals-per-hour 10 --knows own -n 1 --out", tmp_path / "fleet")
    mark.unlink()
    sys.modules.pop(module)
    for command in (("report", out), ("compare", "--resume", "--out", out, "--hours", "08:00-09:00")):
        assert "add --trust" in refused(*command)
    assert not mark.exists()
