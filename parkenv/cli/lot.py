"""`parkenv lot`: look at lots and check lot files."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from parkenv.cli.tables import make_console
from parkenv.errors import InputError
from parkenv.lot import ParkingLot

app = typer.Typer(help="Show, check and convert lots.", no_args_is_help=True)


def _load(lot: str) -> ParkingLot:
    from parkenv.lot_files import PACKAGED_LOTS

    if lot in PACKAGED_LOTS:
        return ParkingLot.packaged(lot)
    if not Path(lot).exists():
        raise InputError(f"{lot}: no such file, nor a packaged lot ({', '.join(PACKAGED_LOTS)})")
    return ParkingLot.from_file(lot)


@app.command()
def show(
    lot: Annotated[str, typer.Argument(help="A lot file, or a packaged lot: campus, jam, street, mini.")],
    out: Annotated[Path | None, typer.Option("--out", "-o", help="The picture.  [default: NAME.png]")] = None,
    graph: Annotated[bool, typer.Option("--graph", help="Draw the drive graph, too.")] = False,
) -> None:
    """Draw a lot, and say what is in it."""
    from parkenv.evaluation.lot_picture import save_lot_picture

    its_lot = _load(lot)
    picture = out or Path(f"{its_lot.name}.png")
    save_lot_picture(its_lot, picture, show_graph=graph)
    low_x, low_y, high_x, high_y = its_lot.bounds()
    oneway = sum(lane.oneway for lane in its_lot.lanes)
    make_console().print(
        f"{its_lot.name}: {its_lot.n_slots} slots, {len(its_lot.lanes)} lanes ({oneway} one-way), "
        f"{len(its_lot.entries)} entries, {len(its_lot.goals)} goals, {its_lot.n_vertices} vertices, "
        f"{high_x - low_x:.0f} × {high_y - low_y:.0f} m. Drawn in {picture}",
    )


@app.command()
def check(
    file: Annotated[Path, typer.Argument(help="A lot file.")],
) -> None:
    """List all that is wrong with a lot file, with feature numbers counted from 0.

    Exit code 2 where there are errors; warnings alone leave it at 0.
    """
    from parkenv.lot_check import check_lot

    console = Console(highlight=False, soft_wrap=True)
    problems = check_lot(file)
    for problem in problems:
        place = "" if problem.feature is None else f"feature {problem.feature}: "
        console.print(
            f"{problem.severity}: {place}{problem.message}",
            style="red" if problem.severity == "error" else "yellow",
            markup=False,
        )
    errors = sum(p.severity == "error" for p in problems)
    if not problems:
        console.print(f"{file}: nothing wrong", markup=False)
    else:
        console.print(f"{file}: {errors} errors, {len(problems) - errors} warnings", markup=False)
    if errors:
        raise typer.Exit(2)


@app.command()
def convert(
    lot: Annotated[str, typer.Argument(help="A lot file, or a packaged lot.")],
    out: Annotated[Path, typer.Argument(help="The GeoJSON file to write.")],
) -> None:
    """Write a lot as native GeoJSON, e.g. to edit it."""
    _load(lot).to_file(out)
    make_console().print(f"Wrote {out}")
