"""The rules of the house: who may import whom, and what importing costs."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

MAY_SEE_PLANNERS = ("parkenv/evaluation/", "parkenv/cli/")
# In this order, a package imports those before it only.
LAYERS = (
    "errors",
    "files",
    "world",
    "lots",
    "perception",
    "mapping",
    "belief",
    "scenarios",
    "driving",
    "envs",
    "evaluation",
    "cli",
)
PLANNERS_MAY_SEE = ("parkenv.world", "parkenv.belief", "parkenv.driving", "parkenv.errors", "parkenv.files")


def imports(path):
    """Every module that a file imports, at any depth of its code."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            yield node.module


def sources(package):
    return sorted((ROOT / package).rglob("*.py"))


@pytest.mark.parametrize("path", sources("sim_sensors"), ids=str)
def test_sensors_know_nothing_of_parking(path):
    assert not [m for m in imports(path) if m.split(".")[0] in ("parkenv", "planners")]


@pytest.mark.parametrize("path", sources("planners"), ids=lambda p: p.name)
def test_planners_see_the_lot_the_belief_and_the_problem_only(path):
    seen = {m for m in imports(path) if m.split(".")[0] == "parkenv"}
    assert not [m for m in seen if not m.startswith(PLANNERS_MAY_SEE)]


@pytest.mark.parametrize("path", sources("parkenv"), ids=lambda p: str(p.relative_to(ROOT)))
def test_the_world_never_imports_a_planner(path):
    if not path.relative_to(ROOT).as_posix().startswith(MAY_SEE_PLANNERS):
        assert not [m for m in imports(path) if m.split(".")[0] == "planners"]


def test_importing_parkenv_is_light():
    program = (
        "import sys, parkenv;"
        "print([m for m in ('torch', 'matplotlib', 'cv2', 'numba', 'stable_baselines3') if m in sys.modules])"
    )
    loaded = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    ).stdout
    assert loaded.strip() == "[]"


def test_the_command_line_answers_without_loading_the_world():
    program = "import sys; import parkenv.cli; print([m for m in ('torch', 'matplotlib', 'cv2') if m in sys.modules])"
    loaded = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    ).stdout
    assert loaded.strip() == "[]"
