"""The leaderboard's page is made from its result files, each of which passes the check."""

import importlib.util
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[1] / "docs"


@pytest.mark.slow  # recomputes the bounds of all searches of a suite
def test_the_page_of_the_leaderboard_is_that_of_its_result_files():
    spec = importlib.util.spec_from_file_location("leaderboard", DOCS / "leaderboard.py")
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    there = script.PAGE.read_text(encoding="utf-8")
    assert script.page(there) == there, "run: python docs/leaderboard.py"
    assert all(file.stat().st_size < 250_000 for file in script.result_files(script.FOLDER / "results"))
