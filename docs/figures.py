"""Every picture and table of results in the documentation: the command that made it, when, and what has changed since.

`python docs/figures.py` lists them; `--stale` only those whose sources are newer, with the number of commits since.
"""

import re
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
SEARCHES = "parkenv/engine parkenv/world parkenv/belief parkenv/scenarios planners parkenv/studies/compare"
SENSORS = "sim_sensors parkenv/perception parkenv/mapping parkenv/studies/sensing"
SOURCES = {
    "compare": SEARCHES, "plan": SEARCHES, "benchmark": f"{SEARCHES} parkenv/studies/benchmark",
    "commute": f"{SEARCHES} parkenv/studies/commute", "fleet": f"{SEARCHES} parkenv/studies/fleet",
    "train": f"{SEARCHES} parkenv/studies/training",
    "calibrate": f"{SEARCHES} parkenv/driving parkenv/studies/trips",
    "trip": "parkenv/driving parkenv/studies/trips planners/driving",
    "park": "parkenv/driving parkenv/envs/drive.py planners/driving", "lot": "parkenv/lots parkenv/show/figures",
    "occupancy": "parkenv/forecast parkenv/world/occupancy parkenv/studies/occupancy.py",
}  # fmt: skip
NUMBER = re.compile(r"\|\s*\**[+-]?\d[\d,.]*( ?%| ?s| ?m| ?ms| ?\[[^]|]*\])?\**\s*(?=\|)")
STATED = re.compile(r"[Cc]ommits? ([0-9a-f]{8})")
COMMAND = re.compile(r"(?:parkenv|python3?|examples/\S+\.py)(?: [^`\n]+|(?=$))")


class Figure(NamedTuple):
    """A picture or a table of results on a page."""

    page: str
    line: int
    what: str  # the file in docs, or "table"
    command: str  # that made it, "" if the page does not say
    commit: str = ""  # that the section states


def figures():
    """Find the pictures and the tables of results, those with at least six numbers, of all pages."""
    for page in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]:
        text = page.read_text(encoding="utf-8")
        for found in re.finditer(r"!\[[^]]*\]\(([^)]+)|(?:^\|.*\n)+", text, re.M):
            specified = "| Meaning |" in found[0].partition("\n")[0]  # what numbers mean, no results
            if found[1] or (len(NUMBER.findall(found[0])) >= 6 and not specified):
                start = text.rfind("\n#", 0, found.start()) + 1
                end = text.find("\n#", found.end())
                after = commands(text[found.end() : end if end > 0 else None])
                command = [*after, *commands(text[start : found.start()])[::-1], ""][0]
                what = found[1].removeprefix("../").removeprefix("docs/") if found[1] else "table"
                section = text[found.end() : end if end > 0 else None], text[start : found.start()]
                stated = [commit for part in section for commit in STATED.findall(part)]
                line = text.count("\n", 0, found.start()) + 1
                yield Figure(str(page.relative_to(ROOT)), line, what, command, *stated[:1])


def commands(text):
    """Return the commands in a part of a page, in blocks of code or in lines."""
    text = re.sub(r"^```(?!bash|sh).*?^```", "", text, flags=re.DOTALL | re.MULTILINE)
    text = re.sub(r"\\?\n(?! *\n)", " ", re.sub(r"```(?:bash|sh)\n", "`", text).replace("```", "`"))
    return [
        found[0].strip()
        for code in re.findall(r"`([^`]+)`", text)
        for found in [COMMAND.match(code.strip())]
        if found
    ]


def git(*arguments):
    """Return what git prints."""
    return subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=True).stdout


def made(figure):
    """Return commit and date: as stated, or of a picture's file, or of the newest line of a table's first row."""
    if figure.commit:
        return git("show", "-s", "--format=%h %cs", figure.commit).split()
    if figure.what != "table":
        return git("log", "-1", "--format=%h %cs", "--", f"docs/{figure.what}").split()
    line = git("blame", "-s", f"-L{figure.line + 2},+1", figure.page).split()[0].lstrip("^")
    return git("show", "-s", "--format=%h %cs", line).split()


def changes_since(commit, command):
    """Return the number of commits since to the sources that a command runs."""
    words = re.findall(r"[a-z-]+", command.removeprefix("parkenv"))
    sources = SOURCES.get(words[0] if words else "", SENSORS).split()
    return len(git("log", "--format=%h", f"{commit}..HEAD", "--", *sources).split())


if __name__ == "__main__":
    for figure in figures():
        commit, day = made(figure)
        changes = changes_since(commit, figure.command)
        if changes or "--stale" not in sys.argv:
            since = f"{day} {commit}  {changes} changes since"
            sys.stdout.write(f"{figure.page}:{figure.line}  {figure.what}  {since}  {figure.command}\n")
