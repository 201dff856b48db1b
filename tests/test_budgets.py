"""Budgets: no folder grows above its lines and statements; `python tests/test_budgets.py` prints where each stands."""

import ast
import functools
import tomllib
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
BUDGETS = tomllib.loads((ROOT / "tests" / "budgets.toml").read_text())
FOLDERS = BUDGETS["folders"]


def lines_of(paths):
    return sum(len(path.read_text().splitlines()) for path in paths)


def folder_of(module):
    """The longest folder of the budgets that holds a module; single modules stand with `parkenv`."""
    return max((name for name in FOLDERS if module.is_relative_to(name)), key=len)


@functools.cache
def sizes():
    """Lines and statements (`ast.stmt`) of each folder of the packages."""
    lines, statements = Counter(), Counter()
    for module in (
        path for top in ("parkenv", "planners", "sim_sensors") for path in (ROOT / top).rglob("*.py")
    ):
        name, text = folder_of(module.relative_to(ROOT)), module.read_text()
        lines[name] += len(text.splitlines())
        statements[name] += sum(isinstance(node, ast.stmt) for node in ast.walk(ast.parse(text)))
    return {name: {"lines": lines[name], "statements": statements[name]} for name in FOLDERS}


def rest():
    """Lines of the tests and words of the documentation."""
    words = sum(len(page.read_text().split()) for page in (ROOT / "docs").rglob("*.md"))
    return {"tests_lines": lines_of((ROOT / "tests").rglob("*.py")), "docs_words": words}


@pytest.mark.parametrize("folder", FOLDERS)
def test_a_folder_keeps_its_budget(folder):
    now = sizes()[folder]
    over = {unit: (size, FOLDERS[folder][unit]) for unit, size in now.items() if size > FOLDERS[folder][unit]}
    assert not over, f"{folder} is above its budget (now, budget): {over}; drop something before you add"


def test_tests_and_documentation_keep_their_budgets():
    over = {name: (size, BUDGETS[name]) for name, size in rest().items() if size > BUDGETS[name]}
    assert not over, f"above the budget (now, budget): {over}"


if __name__ == "__main__":
    for name, size in sizes().items():
        print(
            f"{name:22} {size['lines']:7,} of {FOLDERS[name]['lines']:7,} lines "
            f"{size['statements']:7,} of {FOLDERS[name]['statements']:7,} statements"
        )
    total = [sum(size[unit] for size in sizes().values()) for unit in ("lines", "statements")]
    print(f"{'in all':22} {total[0]:7,} lines {total[1]:7,} statements; {rest()}")
