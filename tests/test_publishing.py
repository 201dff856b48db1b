"""What journals, lists and readers of versions look for is there, and is one with the code."""

import re
import tomllib
from pathlib import Path

import gymnasium as gym
import yaml

import parkenv
from parkenv.studies.benchmark.suite import RESULT_VERSION, Suite

ROOT = Path(__file__).parents[1]
PAPER = (ROOT / "paper.md").read_text(encoding="utf-8")
SECTIONS = (
    "Summary", "Statement of need", "State of the field", "Software design", "Research impact statement",
    "AI usage disclosure", "Acknowledgements", "References",
)  # fmt: skip
"""Sections that the journal asks for, in order."""


def test_the_paper_has_the_journals_form_and_cites_what_it_lists():
    _, head, body = PAPER.split("---\n", 2)
    about = yaml.safe_load(head)
    assert {"title", "tags", "authors", "affiliations", "date", "bibliography"} <= about.keys()
    assert {author["affiliation"] for author in about["authors"]} == {
        its["index"] for its in about["affiliations"]
    }
    assert re.findall(r"^# (.*)$", body, re.M) == list(SECTIONS)
    assert 750 <= len(body.split()) <= 1750
    listed = re.findall(r"^@\w+\{(\w+),", (ROOT / about["bibliography"]).read_text(encoding="utf-8"), re.M)
    assert sorted(listed) == sorted(set(re.findall(r"@(\w+)", body)))


def test_addresses_stand_in_one_place():
    urls = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["urls"]
    assert {"Repository", "Documentation", "Issues", "Changelog"} <= urls.keys()
    files = [*ROOT.glob("*.*"), *(ROOT / "docs").rglob("*.md"), *(ROOT / "parkenv").rglob("*.py")]
    assert not [file for file in files if file.name != "pyproject.toml" and urls["Repository"] in _text(file)]


def _text(file):
    return file.read_text(encoding="utf-8", errors="replace") if file.is_file() else ""


def test_the_page_of_versions_is_about_those_there_are():
    page = (ROOT / "docs" / "versions.md").read_text(encoding="utf-8")
    newest = dict(re.findall(r"^\| `parkenv/(\w+)`.*?\| `-v(\d+)` \|", page, re.M))
    ids = dict(re.findall(r"parkenv/(\w+)-v(\d+)", " ".join(gym.registry)))
    assert newest == {"Search": ids["Search"], "Drive": ids["Drive"]}
    assert f"`{Suite.packaged().name}`" in page
    assert f"| the package | {parkenv.__version__} |" in page
    assert f"| result files of the benchmark | {RESULT_VERSION} |" in page
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert re.search(r"^## (\S+)", changes, re.M)[1] == parkenv.__version__
