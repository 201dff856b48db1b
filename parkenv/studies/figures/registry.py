"""Registry of the figures of a comparison.

To add one, write a function that takes `ComparisonResults` and yields (scenario, setting, figure), and add a line to
`FIGURES`. `parkenv compare` writes it to `NAME_SCENARIO_SETTING.png`, and the report shows it under its caption.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from parkenv.files.file_names import file_name
from parkenv.studies.compare.cases import BLIND, Case

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Row = Mapping[str, Any]
Setting = tuple[float, float, float]
"""Failure cost, s, walking and driving speed, km/h."""
Drawn = tuple[str, Setting | None, "Figure"]
"""What a figure shows: a scenario, or \"\" for several; a setting, or None for several; and the figure."""


@dataclass(frozen=True)
class ComparisonResults:
    """Results from which the figures of a comparison are drawn.

    Attributes:
        cases: cases, each with the seeds of its episodes.
        episodes: finished episodes, rows of `episodes.csv` by `Case.key`.
        rows: rows of the table, one per case with finished episodes.
        occupancy_rows: the same at the occupancy levels.
        flat_forecasts: scenarios with the same forecast for every slot: the scenario that each is a variant of, and
            the probability.
        seed: seed of the episode shown in pictures of single searches.
    """

    cases: Sequence[tuple[Case, Sequence[int]]]
    episodes: Mapping[tuple[Any, ...], Row]
    rows: Sequence[Row]
    occupancy_rows: Sequence[Row] = ()
    flat_forecasts: Mapping[str, tuple[str, float]] = field(default_factory=dict)
    seed: int = 0

    @property
    def scenarios(self) -> list[str]:
        """Names, in order, without the variants of flat forecasts and of failure-cost sweeps."""
        names = dict.fromkeys(row["scenario"] for row in self.rows)
        sweep = {name for name in names if f"{name}{BLIND}" in names}
        return [n for n in names if n.removesuffix(BLIND) not in sweep and n not in self.flat_forecasts]

    @property
    def failure_cost_sweeps(self) -> list[str]:
        """Names of the scenarios that were also run without observations of slots."""
        names = dict.fromkeys(row["scenario"] for row in self.rows)
        return [name for name in names if f"{name}{BLIND}" in names]

    def rows_of(self, scenario: str) -> list[Row]:
        """Return the table's rows of a scenario."""
        return [row for row in self.rows if row["scenario"] == scenario]

    def episodes_of(self, case: Case, seeds: Sequence[int]) -> list[Row]:
        """Return the finished episodes of a case."""
        return [self.episodes[key] for seed in seeds if (key := case.key(seed)) in self.episodes]


@dataclass(frozen=True)
class ComparisonFigure:
    """One kind of figure.

    Attributes:
        name: prefix of the file names.
        caption: caption in reports.
        function: `MODULE:FUNCTION`, imported when the figure is drawn.
    """

    name: str
    caption: str
    function: str

    def draw(self, results: ComparisonResults) -> Iterator[tuple[str, str, Figure]]:
        """Yield file name (without suffix), caption and figure; none if the figure does not apply."""
        module, _, function = self.function.partition(":")
        draw: Callable[[ComparisonResults], Iterator[Drawn]] = getattr(import_module(module), function)
        for scenario, setting, figure in draw(results):
            names, words = [scenario] * bool(scenario), [scenario] * bool(scenario)
            if setting is not None:
                names.append("failure{:g}_walk{:g}_drive{:g}".format(*setting))
                words.append("failure cost {:g} s, walk {:g} km/h, drive {:g} km/h".format(*setting))
            yield "_".join([self.name, *names]), f"{self.caption}: {', '.join(words)}", figure


_HERE = "parkenv.studies.figures"
FIGURES = (
    ComparisonFigure("time_split", "Where the time goes", f"{_HERE}.time_figures:time_splits"),
    ComparisonFigure(
        "time_distribution",
        "How many searches took at most how long",
        f"{_HERE}.time_distribution:time_distributions",
    ),
    ComparisonFigure(
        "time_against_occupancy",
        "The fuller the lot, the longer it takes",
        f"{_HERE}.time_figures:times_against_occupancy",
    ),
    ComparisonFigure(
        "time_against_failure_cost",
        "What failed attempts cost",
        f"{_HERE}.time_figures:times_against_failure_cost",
    ),
    ComparisonFigure(
        "time_against_map",
        "If the forecast is the same for every slot",
        f"{_HERE}.time_figures:times_against_map",
    ),
    ComparisonFigure("searches", "Searches on the same day", f"{_HERE}.search_pictures:searches"),
)
"""All figures, in the order of reports."""


def draw_figures(results: ComparisonResults, folder: Path, names: Sequence[str] | None = None) -> list[Path]:
    """Draw the figures of a comparison to PNG files.

    Args:
        results: results of the comparison.
        folder: output folder.
        names: names of the figures to draw; all if None.

    Returns:
        The files written.

    Raises:
        InputError: a file cannot be written.
    """
    from parkenv.studies.figures.picture_files import save_picture

    files = []
    for kind in FIGURES:
        if names is None or kind.name in names:
            for name, caption, figure in kind.draw(results):
                files.append(folder / file_name(name, ".png"))
                save_picture(figure, files[-1], caption)
    return files


def remove_figures(folder: Path) -> None:
    """Delete the figures of an earlier comparison from a folder."""
    for picture in folder.glob("*.png"):
        if picture.name.startswith(tuple(f"{kind.name}_" for kind in FIGURES)):
            picture.unlink()
