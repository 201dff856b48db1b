"""`parkenv play`: search for a slot yourself, in the worlds of the agents."""

from __future__ import annotations

import webbrowser
from pathlib import Path
from typing import Annotated

from pydantic import Field

from parkenv.cli.options import Command
from parkenv.cli.tables import make_console, stages
from parkenv.files.option import Inside, option
from parkenv.scenarios.spec import scenario_spec
from parkenv.studies.agent_spec import AgentSpec
from parkenv.studies.fields import TRAFFIC, Agents, OneScenario, Seed


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
        from parkenv.files.atomic_write import make_folder
        from parkenv.scenarios.build import build
        from parkenv.show.report.page import write_game
        from parkenv.studies.play import game_data

        console = make_console()
        with stages(console) as progress:
            seeds = range(self.seed, self.seed + self.worlds)
            data = game_data(build(self.scenario), self.agents, seeds, progress)
        make_folder(self.out.parent)
        write_game(data, self.out)
        console.print(f"Written: {self.out}, {self.out.stat().st_size / 1e6:.1f} MB")
        if not (self.html or webbrowser.open(self.out.absolute().as_uri())):
            console.print("No browser can be opened here: open the page in one.")
