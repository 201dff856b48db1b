"""`parkenv report` and `play`: pages on a run and of a game; and the trust that running a file's code needs."""

import sys
import webbrowser
from collections.abc import Collection
from pathlib import Path
from typing import Annotated

import typer
from pydantic import Field

from parkenv.cli.options import Command
from parkenv.cli.tables import make_console, stages
from parkenv.errors import InputError
from parkenv.files.atomic_write import make_folder
from parkenv.files.option import Inside, Option, option
from parkenv.files.spec_file import Spec
from parkenv.files.user_class import find_module
from parkenv.scenarios.spec import scenario_spec
from parkenv.studies.fields import TRAFFIC, Agents, AgentSpec, OneScenario, Seed, classes_in
from parkenv.studies.study import ExecutionSpec, ReportOptions

Trust = Annotated[
    bool,
    Option(panel="Trust"),
    Field(
        description="Run the classes (MODULE:CLASS) and use the cluster named by the file or the folder of "
        "the run."
    ),
]


def require_trust(spec: Spec, source: Path, trust: bool, given: Collection[str] = ()) -> None:
    """Refuse a specification that names classes or a cluster in fields that are not given; ask in a terminal."""
    classes = classes_in(spec, given)
    named = [f"{name} ({find_module(name) or 'not found'})" for name in classes]
    if "address" not in given and (address := getattr(spec, "address", None)):
        # A cluster's answers are pickled objects.
        named.append(f"tasks on the cluster at {address}")
    if trust or not named:
        return
    shown = ", ".join(named)
    if sys.stdin.isatty() and typer.confirm(f"{source} runs {shown}. Run this code?"):
        return
    raise InputError(f"{source}: would run {shown}; read that code, then add --trust")


class Report(Command, ExecutionSpec, ReportOptions):
    """The page needs no network and no other file. Searches and drives are repeated with their seeds.

    If the total time of a search differs from that in the results, the page says so.
    """

    examples = """
        parkenv report results/compare
        parkenv report results/compare --replay 3,17 --agents mdp --out two.html
        parkenv report results/survey --sessions 2
        """

    folder: Path = option(
        ...,
        "Folder of compare, survey, demo, train, fleet or another command.",
        name="RUN",
        takes="DIR",
        argument=True,
    )
    out: Path | None = option(None, "The page.", short="-o", takes="FILE.html", default="DIR/report.html")
    trust: Trust = False

    def run(self) -> None:
        make_report(self.folder, self, self, out=self.out, trust=self.trust)


def make_report(
    folder: Path,
    machines: ExecutionSpec,
    options: ReportOptions | None = None,
    *,
    out: Path | None = None,
    stage: str = "Running again",
    trust: bool = True,
) -> Path:
    """Write the page on a run with a progress bar, searching again on the machines of `machines`; return its path."""
    from parkenv.studies.report import RunFolder, write_report

    run = RunFolder.read(folder)
    notes: list[str] = []
    spec = None
    try:
        spec = run.spec()
    except (InputError, OSError) as error:
        notes.append(f"There is no replay: {error}")
    if spec is not None:
        # The page is made on the machines of this command, not of the run.
        require_trust(spec.changed(address=None), folder, trust)
    console = make_console()
    with machines.workers() as workers, stages(console) as progress:
        path, notes = write_report(
            run, spec, options, out=out, notes=notes, workers=workers, progress=progress, doing=stage
        )
    for note in notes:
        console.print(f"Note: {note}")
    console.print(f"Written: {path}, {path.stat().st_size / 1e6:.1f} MB")
    return path


class Play(Command):
    """The page is one file for phones and desktops, and needs no network.

    The page shows only what the car has observed. After each search it shows the drives of the agents in the same
    world, and your regret: your total time minus the clairvoyant bound. It saves your scores for `parkenv compare
    --agents human:scores.json`. The file contains the future of the worlds, so a player can cheat by reading its
    source.
    """

    examples = """
        parkenv play
        parkenv play --html --scenario jam --worlds 5 --out jam.html
        parkenv play --lot lot.geojson --agents belief,mdp,oracle
        parkenv compare -n 10 --agents belief,human:scores.json,oracle
        """

    scenario: Annotated[OneScenario, Inside(without=TRAFFIC)] = scenario_spec("campus")
    agents: Agents = Field(
        (AgentSpec(name="belief"), AgentSpec(name="oracle")),
        description="Agents to compare your searches with.",
    )
    worlds: int = option(10, "Number of worlds; world i has the seed seed + i.", ge=1, le=100)
    seed: Seed = Field(0, description="Seed of the first world.")
    html: bool = option(False, "Only write the page, without opening it in the browser.")
    out: Path = option(Path("results/play.html"), "The page.", short="-o", takes="FILE.html")

    def run(self) -> None:
        from parkenv.scenarios.build import build
        from parkenv.show.report.page import write_game
        from parkenv.studies.play import game_data

        with stages(self.console) as progress:
            seeds = range(self.seed, self.seed + self.worlds)
            data = game_data(build(self.scenario), self.agents, seeds, progress)
        make_folder(self.out.parent)
        write_game(data, self.out)
        self.say(f"Written: {self.out}, {self.out.stat().st_size / 1e6:.1f} MB")
        if not (self.html or webbrowser.open(self.out.absolute().as_uri())):
            self.say("No browser can be opened here: open the page in one.")
