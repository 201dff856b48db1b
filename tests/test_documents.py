"""Commands, code and numbers in README, documentation and contributing guide are correct; examples run."""

import ast
import importlib.util
import re
import shlex
import subprocess
import sys
import tomllib
import types
from datetime import date
from pathlib import Path

import gymnasium as gym
import pytest
import yaml
from car_park_counts import write_counts
from command_line import ran
from test_command_line import COMMANDS

import parkenv
from parkenv.studies.benchmark.suite import RESULT_VERSION, Suite
from planners.names import AGENTS

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
PAGES = {
    str(path.relative_to(ROOT)): path.read_text(encoding="utf-8")
    for path in (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md")))
}


def blocks(page, languages):
    """Code blocks in one of these languages (a|b), as (language, text)."""
    return re.findall(rf"^```({languages})\n(.*?)^```", page, flags=re.DOTALL | re.MULTILINE)


def commands():
    """Every `parkenv` command of every page, as the page's name and words."""
    for name, page in PAGES.items():
        for _, block in blocks(page, "bash|sh"):
            for line in block.replace("\\\n", " ").splitlines():
                for part in line.split("&&"):
                    words = shlex.split(part, comments=True)
                    if words and words[0].endswith("parkenv"):
                        yield name, words[1:]


def test_the_ten_lines_run_as_printed_and_are_the_same_everywhere():
    ((_, program),) = blocks(README, "python")
    assert len([line for line in program.splitlines() if line.strip()]) == 10
    for name in ("docs/index.md", "docs/api/index.md"):
        assert program in PAGES[name], name
    command = [sys.executable, "-c", program]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=True)
    assert re.fullmatch(r"\d+ s, of which \d+ s on foot\n", done.stdout)


def script(name):
    """Import a script of the documentation."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "docs" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_pages_and_pictures_that_are_made_are_as_their_commands_make_them():
    environments = script("environments")
    for name in environments.PAGES:
        made, there = environments.page(name), PAGES[f"docs/environments/{name}.md"]
        assert made == there, "run: python docs/environments.py"
        film = re.search(r"\.\./pictures/(\S+\.gif)", there)[1]
        assert (ROOT / "docs" / "pictures" / film).stat().st_size < 1e6, film
    found = list(script("figures").figures())
    assert len(found) > 30
    assert not [figure for figure in found if not figure.command]
    shown = {figure.what for figure in found}
    pictures = {f"pictures/{path.name}" for path in (ROOT / "docs" / "pictures").glob("[!.]*")}
    assert pictures <= shown, "a picture on no page"


def program_of(page):
    """Blocks of `python` and `bash` as one program; those of `sh` need data, an installation or hours."""
    program = []
    for language, block in blocks(page, "python|bash"):
        if language == "python":
            program.append(block)
        elif "pip install" not in block:
            for line in block.replace("\\\n", " ").splitlines():
                name, *arguments = shlex.split(line, comments=True)
                assert name == "parkenv", f"{line}: what is no command of ours stands in a block of sh"
                program.append(f"run_parkenv(*{arguments!r})")
    return "\n".join(program)


PROGRAMS = {
    **{name: program for name, page in PAGES.items() if (program := program_of(page))},
    **{f"examples/{path.name}": path.read_text() for path in sorted((ROOT / "examples").glob("*.py"))},
}
FEWER = {
    r"'(--episodes|--drivers|-n)', '\d+'": r"'\1', '2'",
    r"'commute', '--scenario'": "'commute', '--days', '3', '--scenario'",
    r"(SCENARIO, WORLDS, ENVS = .*), 250, 50": r"\1, 10, 5",
    r"range\(6\):\n    model.learn\(50_000": r"range(2):\n    model.learn(4_096",
    r"(UPDATES, EPOCHS, MINIBATCHES = 256, 32), 40": r"\1, 4",
    r"every=2\.5, windows": "every=8.0, windows",
    r"range\(100, 200\)": "range(100, 110)",
    r"(STREETS, PICTURES =) 60, 12": r"\1 2, 3",
    r"(STEPS, BATCH, RATE =) 3_000, 8": r"\1 4, 2",
    r"range\(1, 31\)": "range(1, 11)",
    r"(ROUNDS, DAYS, HOURS) = .*": r"\1 = 2, 1, '10:00-10:30'",
    r"DECISIONS, ROUNDS, TASKS = 20_000, 10, 50": "DECISIONS, ROUNDS, TASKS = 1_100, 1, 2",
    r"(DECISIONS, EPOCHS, BATCH) = 2_000, 8": r"\1 = 50, 2",
    r"WORLDS = 40": "WORLDS = 2",
    r"(SEARCHES, UPDATES, DECISIONS, WORLDS) = .*": r"\1 = 2, 2, 4_096, 2",
    r"SCENES, DEADLINE_S = 10, 3.0": "SCENES, DEADLINE_S = 1, 1.0",
    r"model.learn\(4_096\)\n    observations": "model.learn(1_024)\n    observations",
}
"""What is done often on a page or in an example, and how it is done less often here: the same code runs."""

NEEDS = {"examples/shorten_drives.py": "casadi"}
"""Libraries of others, in no extra that the tests need, without which an example cannot run."""


def fewer(program):
    """Return the program with less of the same."""
    for often, less in FEWER.items():
        program = re.sub(often, less, program)
    return program


def test_all_that_is_done_less_often_stands_somewhere():
    for often in FEWER:
        assert any(re.search(often, program) for program in PROGRAMS.values()), often


@pytest.mark.slow
@pytest.mark.filterwarnings("default")
@pytest.mark.parametrize("name", PROGRAMS)
def test_the_code_of_a_page_and_an_example_run_from_top_to_bottom(name, tmp_path, monkeypatch):
    """As the main module, in a folder of its own; no module of it stays."""
    if name in NEEDS:
        pytest.importorskip(NEEDS[name])
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    write_counts(tmp_path / "car_parks.csv.gz", first=date(2023, 12, 1))
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.syspath_prepend((tmp_path / name).parent)
    # Each core has a test process already: commands work in this one.
    monkeypatch.setenv("LOKY_MAX_CPU_COUNT", "1")
    monkeypatch.setattr(sys, "argv", [name])
    main = types.ModuleType("__main__")
    main.run_parkenv, main.__file__ = ran, str(ROOT / name)
    monkeypatch.setitem(sys.modules, "__main__", main)
    before = set(sys.modules)
    exec(compile(fewer(PROGRAMS[name]), name, "exec"), vars(main))
    for added in set(sys.modules) - before:
        if str(tmp_path) in str(getattr(sys.modules[added], "__file__", "")):
            del sys.modules[added]


def test_links_pictures_options_and_agents_of_pages_exist():
    """Every option in backticks is one of some command."""
    for name, page in PAGES.items():
        for target in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", page):
            if not target.startswith("http"):
                assert (ROOT / name).parent.joinpath(target).exists(), f"{name}: {target}"
    known = set().union(*map(options_of, COMMANDS.values()))
    for name, page in PAGES.items():
        assert set(re.findall(r"`(--[a-z-]+)[^`]*`", page)) - known <= OTHERS, name
    listed = re.findall(r"^\| `([a-z-]+)` \|", PAGES["docs/agents.md"], flags=re.MULTILINE)
    assert sorted(listed) == sorted(AGENTS)


def options_of(command):
    return {"--help", *(option for its in command.params for option in (*its.opts, *its.secondary_opts))}


def test_commands_have_options_that_exist():
    """Every command is there, and has the options that it is given."""
    found = list(commands())
    assert len(found) > 100
    for name, words in found:
        its = [" ".join(words[:count]) for count in (1, 2) if " ".join(words[:count]) in COMMANDS]
        assert its or words[0].startswith("--"), f"{name}: {words}"
        known = options_of(COMMANDS[its[0]]) if its else OTHERS
        assert {word for word in words if word.startswith("--")} <= known, f"{name}: {words}"


OTHERS = {"--version", "--install-completion", "--show-completion", "--num-envs"}
"""Options of `parkenv` itself, and of other programs, such as CleanRL's."""


WORDS = {
    "docs/results/": 1_500, "docs/environments/": 1_400, "docs/leaderboard/": 1_300, "docs/": 800,
    "CONTRIBUTING.md": 1_200, "README.md": 1_000,
}  # fmt: skip
"""The most words of a page, by the first beginning of its name that fits; `budgets.toml` has those in all."""


def test_pages_are_short():
    for name, page in PAGES.items():
        most = next(WORDS[part] for part in WORDS if name.startswith(part))
        assert len(page.split()) <= most, f"{name}: {len(page.split())} words, at most {most}"
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert len(changes.split()) <= 900
    assert len(changes.splitlines()) <= 60


@pytest.mark.parametrize("path", sorted((ROOT / "examples").glob("*.py")), ids=lambda path: path.stem)
def test_an_example_says_how_long_it_takes(path):
    """Those that are no scripts, or take as long as they are told, say nothing."""
    if path.stem not in ("ground_detector", "shorten_drives"):
        said = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8")))
        assert re.search(r"\b(seconds|minutes?)\b", said), f"{path}: says not how long it takes"


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_the_notebook_runs_and_shows_its_pictures(tmp_path):
    nbformat = pytest.importorskip("nbformat")
    client = pytest.importorskip("nbclient").NotebookClient
    notebook = nbformat.read(ROOT / "examples" / "main_story.ipynb", 4)
    client(notebook, timeout=1800).execute(cwd=str(tmp_path))
    shown = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    assert sum("image/png" in output.get("data", {}) for output in shown) == 4


@pytest.mark.slow  # recomputes the bounds of all searches of the suites
def test_the_pages_of_the_leaderboard_are_those_of_its_result_files():
    leaderboard = script("leaderboard")
    for name, folder in leaderboard.PAGES.items():
        there = (leaderboard.FOLDER / name).read_text(encoding="utf-8")
        assert leaderboard.page(there, folder) == there, "run: python docs/leaderboard.py"
        files = leaderboard.result_files(leaderboard.FOLDER / folder)
        assert all(file.stat().st_size < 250_000 for file in files)


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
    places = {author["affiliation"] for author in about["authors"]}
    assert places == {its["index"] for its in about["affiliations"]}
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
