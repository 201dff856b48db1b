"""`parkenv lot`: show, check, import and convert lots."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer

from parkenv.cli.tables import make_console
from parkenv.errors import InputError
from parkenv.files.file_names import file_name

if TYPE_CHECKING:
    from parkenv.world.lot import ParkingLot

app = typer.Typer(
    help="Show, check, import and convert lots (lot files, OpenStreetMap, lists of slots).",
    no_args_is_help=True,
)


@app.command()
def show(
    lot: Annotated[str, typer.Argument(help="A lot file, or a packaged lot: campus, jam, street, mini.")],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Picture file: .png, .pdf or .svg.  [default: NAME.png]"),
    ] = None,
    graph: Annotated[bool, typer.Option("--graph", help="Also draw the drive graph.")] = False,
) -> None:
    """Draw a lot and summarise it; slots with a parking cost are coloured by it.

    Examples:
    * `parkenv lot show campus --graph --out campus.png`

    * `parkenv lot show mine.geojson`
    """
    from parkenv.evaluation.figures.lot_picture import save_lot_picture
    from parkenv.lots import load_lot

    its_lot = load_lot(lot)
    picture = out or Path(file_name(its_lot.name, ".png"))
    save_lot_picture(its_lot, picture, show_graph=graph)
    make_console().print(f"{_summary(its_lot)}. Picture: {picture}")


def _summary(lot: ParkingLot) -> str:
    low_x, low_y, high_x, high_y = lot.bounds()
    oneway = sum(lane.oneway for lane in lot.lanes)
    parts = [
        f"{lot.name}: {lot.n_slots} slots",
        f"{len(lot.lanes)} lanes ({oneway} one-way)",
        f"{len(lot.entries)} entries",
        f"{len(lot.goals)} goals",
        f"{lot.n_vertices} vertices",
        f"{high_x - low_x:.0f} × {high_y - low_y:.0f} m",
    ]
    cost = lot.slot_parking_cost_s
    if cost.any():
        parts.append(
            f"parking costs {cost.min():g} to {cost.max():g} s ({np.count_nonzero(cost)} slots above 0)"
        )
    return ", ".join(parts)


@app.command()
def check(
    file: Annotated[Path, typer.Argument(help="A lot file, or a file to import.")],
) -> None:
    """List all errors and warnings of a lot file, by feature number (from 0), and summarise a valid lot.

    The exit code is 2 if there are errors, else 0.

    Examples:
    * `parkenv lot check mine.geojson`

    * `parkenv lot check map.osm` (what an import would lack)
    """
    from parkenv.lots import check_lot, read_lot
    from parkenv.lots.file_formats import lot_format

    console = make_console(soft_wrap=True)
    problems = check_lot(file)
    for problem in problems:
        place = "" if problem.feature is None else f"feature {problem.feature}: "
        console.print(
            f"{problem.severity}: {place}{problem.message}",
            style="red" if problem.severity == "error" else "yellow",
        )
    errors = sum(p.severity == "error" for p in problems)
    if not problems:
        console.print(f"{file}: no errors, no warnings")
    else:
        console.print(f"{file}: {errors} errors, {len(problems) - errors} warnings")
    if errors:
        raise typer.Exit(2)
    file_format = lot_format(file)
    if file_format is not None and file_format.is_complete:
        console.print(_summary(read_lot(file)))


@app.command("import")
def import_place(
    file: Annotated[
        Path,
        typer.Argument(
            help="OpenStreetMap (.osm, Overpass .json, overpass-turbo .geojson), slot centres (.csv), "
            "a Dragon Lake map (.yml) or a lot."
        ),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Lot file to write (.geojson).")],
    goal: Annotated[
        list[str] | None,
        typer.Option(
            help="Place that people walk to: LAT,LON, or X,Y in metres. Repeatable.  [default: building entrances, "
            "else the nearest building]"
        ),
    ] = None,
    entry: Annotated[
        list[str] | None,
        typer.Option(
            help="Place where cars enter: LAT,LON, or X,Y in metres. Repeatable.  [default: where service roads meet "
            "a public street, or where streets leave the map]"
        ),
    ] = None,
    bounds: Annotated[
        str | None,
        typer.Option(help="Import only what is within SOUTH,WEST,NORTH,EAST, or X0,Y0,X1,Y1 in metres."),
    ] = None,
    disabled: Annotated[
        bool, typer.Option("--disabled", help="Also import spaces for disabled drivers.")
    ] = False,
    picture: Annotated[Path | None, typer.Option(help="PNG to check the import by.")] = None,
) -> None:
    """Import a lot of a real place; report what was found, left out and is missing.

    If something is missing, the picture is still drawn, but no lot is written and the exit code is 2.

    Examples:
    * `parkenv lot import map.osm --out lot.geojson --picture lot.png`

    * `parkenv lot import slots.csv --out lot.geojson --entry 0,0 --goal 40,25`
    """
    from parkenv.lots import import_lot, write_lot
    from parkenv.lots.importers.import_options import ImportOptions

    corners = None if bounds is None else _numbers("--bounds", bounds, 4)
    wishes = ImportOptions(
        goals=tuple((p[0], p[1]) for p in (_numbers("--goal", text, 2) for text in goal or ())),
        entries=tuple((p[0], p[1]) for p in (_numbers("--entry", text, 2) for text in entry or ())),
        bounds=None if corners is None else ((corners[0], corners[1]), (corners[2], corners[3])),
        with_disabled=disabled,
    )
    draft = import_lot(file, wishes)
    console = make_console(soft_wrap=True)
    for line in draft.found:
        console.print(line)
    for left in draft.left_out:
        console.print(f"left out: {left}", style="yellow")
    if picture is not None:
        from parkenv.evaluation.figures.import_picture import save_import_picture

        save_import_picture(draft, picture)
        console.print(f"Picture: {picture}")
    try:
        lot = draft.lot()
    except InputError as error:
        raise InputError(f"{file}: {error}") from error
    write_lot(lot, out)
    console.print(f"Wrote {out}. {_summary(lot)}")


def _numbers(option: str, text: str, count: int) -> list[float]:
    try:
        values = [float(word) for word in text.split(",")]
    except ValueError:
        values = []
    if len(values) != count or not all(map(math.isfinite, values)):
        raise InputError(f"{option} is {text!r}, want {count} numbers separated by commas")
    return values


@app.command()
def convert(
    lot: Annotated[str, typer.Argument(help="A lot file, or a packaged lot.")],
    out: Annotated[Path, typer.Argument(help="GeoJSON file to write.")],
) -> None:
    """Write a lot as native GeoJSON, e.g. to edit it in a GIS.

    Example:
    * `parkenv lot convert campus mine.geojson`
    """
    from parkenv.lots import load_lot, write_lot

    write_lot(load_lot(lot), out)
    make_console().print(f"Wrote {out}")
