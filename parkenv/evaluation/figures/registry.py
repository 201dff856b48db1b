"""The figures of a comparison: which there are, and drawing them all.

To add one, write a function that takes `ComparisonResults` and yields (suffix, figure) pairs, and add a line to
`FIGURES`. `parkenv compare` draws it into `NAME_SUFFIX.png`, and the report shows it under its caption.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from parkenv.evaluation.experiments.compare import UNSEEN, Case

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Row = Mapping[str, Any]


@dataclass(frozen=True)
class ComparisonResults:
    """What figures of a comparison are drawn from.

    Attributes:
        cases: each with the seeds of its episodes.
        episodes: finished episodes, rows of `episodes.csv` by `Case.key`.
        rows: of the table, one per case with finished episodes.
        occupancy_rows: the same of lots that were made fuller and emptier.
        flat_forecasts: scenarios whose forecast is the same for every slot: the scenario that each varies, and that
            probability.
        seed: of the episode that pictures of single searches show.
    """

    cases: Sequence[tuple[Case, Sequence[int]]]
    episodes: Mapping[tuple[Any, ...], Row]
    rows: Sequence[Row]
    occupancy_rows: Sequence[Row] = ()
    flat_forecasts: Mapping[str, tuple[str, float]] = field(default_factory=dict)
    seed: int = 0

    @property
    def scenarios(self) -> list[str]:
        """Names, in order, without variants with flat forecasts, and without those of a failure-cost sweep."""
        names = dict.fromkeys(row["scenario"] for row in self.rows)
        sweep = {name for name in names if f"{name}{UNSEEN}" in names}
        return [n for n in names if n.removesuffix(UNSEEN) not in sweep and n not in self.flat_forecasts]

    @property
    def failure_cost_sweeps(self) -> list[str]:
        """Names of the scenarios that were also run without observations of slots."""
        names = dict.fromkeys(row["scenario"] for row in self.rows)
        return [name for name in names if f"{name}{UNSEEN}" in names]

    def rows_of(self, scenario: str) -> list[Row]:
        """The table's rows of a scenario."""
        return [row for row in self.rows if row["scenario"] == scenario]

    def episodes_of(self, case: Case, seeds: Sequence[int]) -> list[Row]:
        """The finished episodes of a case."""
        return [self.episodes[key] for seed in seeds if (key := case.key(seed)) in self.episodes]


@dataclass(frozen=True)
class ComparisonFigure:
    """One kind of figure.

    Attributes:
        name: what its files' names begin with.
        caption: of the figure in reports.
        function: `MODULE:FUNCTION`, imported when it is drawn.
    """

    name: str
    caption: str
    function: str

    def draw(self, results: ComparisonResults) -> Iterator[tuple[str, Figure]]:
        """Yield its figures, each with the rest of its file's name; none where it does not apply."""
        module, _, function = self.function.partition(":")
        draw: Callable[[ComparisonResults], Iterator[tuple[str, Figure]]] = getattr(
            import_module(module), function
        )
        yield from draw(results)


_HERE = "parkenv.evaluation.figures"
FIGURES = (
    ComparisonFigure("time_split", "Mean total time by its parts", f"{_HERE}.time_figures:time_splits"),
    ComparisonFigure(
        "time_distribution",
        "Cumulative distribution of the total time",
        f"{_HERE}.time_distribution:time_distributions",
    ),
    ComparisonFigure(
        "time_against_occupancy",
        "Total time against occupancy",
        f"{_HERE}.time_figures:times_against_occupancy",
    ),
    ComparisonFigure(
        "time_against_failure_cost",
        "Total time against the failure cost",
        f"{_HERE}.time_figures:times_against_failure_cost",
    ),
    ComparisonFigure(
        "time_against_map", "Total time against a flat forecast", f"{_HERE}.time_figures:times_against_map"
    ),
    ComparisonFigure("searches", "Searches in one world", f"{_HERE}.search_pictures:searches"),
)
"""In the order in which reports show them."""


def draw_figures(results: ComparisonResults, folder: Path, names: Sequence[str] | None = None) -> list[Path]:
    """Draw the figures of a comparison into PNG files.

    Args:
        results: of the comparison.
        folder: where to.
        names: of the kinds to draw; all where None.

    Returns:
        The files.

    Raises:
        InputError: a file cannot be written.
    """
    from parkenv.evaluation.figures.picture_files import save_picture

    files = []
    for kind in FIGURES:
        if names is None or kind.name in names:
            for suffix, figure in kind.draw(results):
                files.append(folder / f"{kind.name}_{suffix}.png")
                save_picture(figure, files[-1])
    return files


def remove_figures(folder: Path) -> None:
    """Delete the figures of an earlier comparison from a folder."""
    for picture in folder.glob("*.png"):
        if picture.name.startswith(tuple(f"{kind.name}_" for kind in FIGURES)):
            picture.unlink()
