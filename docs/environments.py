"""The environments' pages, from their docstrings: `python docs/environments.py` writes them; a test compares.

What stands below `BY_HAND` on a page is written by hand and kept.
"""

import importlib
import inspect
import re
from pathlib import Path

FOLDER = Path(__file__).parent / "environments"
BY_HAND = "<!-- what follows is written by hand; the rest by docs/environments.py -->"
BASE = "`parkenv/Search-v2`"
FILM = "python docs/films.py "
PAGES = {
    "search": (BASE, "envs.search:SearchEnv", "env_search.gif", f"{FILM}search"),
    "search-vector": (
        f"{BASE}, batch", "envs.search_vector:ParkSearchVectorEnv", "env_search-vector.gif", f"{FILM}search-vector",
    ),
    "search-sensors": (
        "`parkenv/SearchSensors-v2`", "envs.sensors:SearchSensorsEnv", "env_search-sensors.gif",
        f"{FILM}search-sensors",
    ),
    "search-perception": (
        "`parkenv/SearchPerception-v2`", "envs.perception:SearchPerceptionEnv", "search_campus.gif", "parkenv demo",
    ),
    "drive": ("`parkenv/Drive-v1`", "envs.drive:DriveEnv", "env_drive.gif", f"{FILM}drive"),
    "lot": ("`parkenv.lot_v0`", "lot_v0:LotEnv", "fleet_campus.gif", "python examples/09_many_cars.py fleet.gif"),
}  # fmt: skip
"""Of each page: title, class, film, and the command that made the film."""
MORE = {"lot": ("The parallel form", "lot_v0:LotParallelEnv")}
LINKED = (
    "action-space",
    "observation-space",
    "rewards",
    "starting-state",
    "episode-end",
    "several-scenarios",
    "arguments",
)
"""Anchors of the page of `parkenv/Search-v2` to which the other pages link."""
FLAGS = re.DOTALL | re.MULTILINE


def page(name):
    """Return the Markdown of a page."""
    title, path, film, command = PAGES[name]
    summary, rest = markdown(path).split("\n\n", 1)
    if title != BASE:
        rest = with_links(rest)
    parts = [
        f"# {title}",
        summary,
        f"![{summary}](../pictures/{film})".replace("`", ""),
        f"*Made by `{command}`.*",
        rest,
    ]
    if name in MORE:
        parts += [f"## {MORE[name][0]}", markdown(MORE[name][1])]
    file = FOLDER / f"{name}.md"
    kept = file.read_text(encoding="utf-8").partition(BY_HAND)[2] if file.exists() else ""
    return "\n\n".join(parts) + f"\n\n{BY_HAND}{kept.rstrip()}\n"


def with_links(text):
    """Link what the text takes from `parkenv/Search-v2` to the section of the same heading there."""

    def link(section):
        anchor = section[1].lower().replace(" ", "-")
        target = f"search.md#{anchor}" if anchor in LINKED else "search.md"
        return re.sub(f"([aA]s in|of|with) {BASE}", rf"\1 [{BASE}]({target})", section[0], count=1)

    return re.sub(r"^## (.*?)\n.*?(?=^## |\Z)", link, text, flags=FLAGS)


def markdown(path):
    """Return the docstring of a class or a module as Markdown: doctests as programs, arguments and errors as lists."""
    module, _, name = path.partition(":")
    described = importlib.import_module(f"parkenv.{module}")
    doc = inspect.getdoc(getattr(described, name) if name else described)
    doc = re.sub(
        r"^```python\n(?!>>>)", "```py\n", doc, flags=FLAGS
    )  # a long program: shown, not run by tests
    doc = re.sub(r"^```python\n(>>>.*?)\n+```", lambda found: program(found[1]), doc, flags=FLAGS)
    doc = re.sub(
        r"^Examples:\n((?:    .*\n?|\n)+)",
        lambda found: program(inspect.cleandoc("\n" + found[1])),
        doc,
        flags=re.M,
    )
    return re.sub(r"^(Args|Raises):\n((?:    .*\n?)+)", items, doc, flags=re.M).strip()


def items(found):
    """Return a section of a docstring as a list."""
    lines = re.sub(r"^    (\w+): ", r"- `\1`: ", found[2], flags=re.M)
    return {"Args": "Arguments:\n\n", "Raises": "Errors:\n\n"}[found[1]] + re.sub(
        "^      ", " ", lines, flags=re.M
    )


def program(doctest):
    """Return a doctest as a program, with what it shows as comments."""
    lines = [line[4:] if line.startswith((">>> ", "... ")) else f"# {line}" for line in doctest.splitlines()]
    code = "\n".join(line for line in lines if line != "# ")
    return "```python\n" + re.sub(r"^((?:(?:import|from) .*\n)+)", r"\1\n", code) + "\n```"


if __name__ == "__main__":
    for name in PAGES:
        (FOLDER / f"{name}.md").write_text(page(name), encoding="utf-8")
