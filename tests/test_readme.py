"""What the README prints must be true."""

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
GROUPS = ("benchmark", "lot", "occupancy", "sensors")  # of commands
README = (ROOT / "README.md").read_text(encoding="utf-8")


def blocks(language):
    return re.findall(rf"```{language}\n(.*?)```", README, flags=re.DOTALL)


def test_the_ten_lines_run_as_printed():
    program, more = blocks("python")
    assert len([line for line in program.splitlines() if line.strip()]) <= 11
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=120, check=True
    )
    assert re.fullmatch(r"\d+ s, of which \d+ s on foot\n", done.stdout)
    imports = "import gymnasium as gym\nimport parkenv\n"
    subprocess.run([sys.executable, "-c", imports + more], timeout=300, check=True)


def test_links_and_pictures_exist():
    for target in re.findall(r"\]\(([^)#]+)\)", README):
        if not target.startswith("http"):
            assert (ROOT / target).exists(), target


@pytest.mark.parametrize("line", [line for block in blocks("bash") for line in block.splitlines()])
def test_commands_have_options_that_exist(line):
    """Every `parkenv` command in the README names a command and options that --help knows."""
    for part in line.split("&&"):
        words = shlex.split(part)
        if not words or not words[0].endswith("parkenv"):
            continue
        command = words[1:3] if words[1] in GROUPS else words[1:2]
        help_text = subprocess.run(
            [sys.executable, "-c", "from parkenv.cli import main; main()", *command, "--help"],
            capture_output=True,
            text=True,
            check=True,
            env={"COLUMNS": "200", "PATH": "/usr/bin:/bin", "NO_COLOR": "1"},
        ).stdout
        for word in words[2:]:
            if word.startswith("--"):
                assert word in help_text


def test_agents_in_the_table_are_the_agents_there_are():
    from planners.agent import AGENT_NAMES, SMALL_LOTS_ONLY

    listed = re.findall(r"^\| `([a-z-]+)` \|", README, flags=re.MULTILINE)
    assert sorted(listed) == sorted((*AGENT_NAMES, *SMALL_LOTS_ONLY))
