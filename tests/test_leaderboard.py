"""The leaderboard's pages are made from its result files, each of which passes the check."""

import importlib.util
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[1] / "docs"


@pytest.mark.slow  # recomputes the bounds of all searches of the suites
def test_the_pages_of_the_leaderboard_are_those_of_its_result_files():
    spec = importlib.util.spec_from_file_location("leaderboard", DOCS / "leaderboard.py")
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    for name, folder in script.PAGES.items():
        there = (script.FOLDER / name).read_text(encoding="utf-8")
        assert script.page(there, folder) == there, "run: python docs/leaderboard.py"
        assert all(file.stat().st_size < 250_000 for file in script.result_files(script.FOLDER / folder))
