"""Code that files name runs only when the user trusts it, and a user's agents keep their names."""

import json
import sys
from pathlib import Path

import pytest
from command_line import ran, refused, rows_in, summary_of

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
