"""`parkenv lot`: show, check, import and convert lots."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from typer import Exit

from parkenv.cli import arguments as args
from parkenv.cli.command import add, group
from parkenv.cli.tables import make_console
from parkenv.errors import InputError
from parkenv.files.file_names import file_name

if TYPE_CHECKING:
    from parkenv.world.lot import ParkingLot


def show(lot: str, /, graph: bool = False, out: Path | None = None) -> None:
    """Draw a lot and summarise it; slots with a parking cost are coloured by it.

    Examples:
        parkenv lot show campus --graph --out campus.png
        parkenv lot show mine.geojson

    Options:
        lot (NAME|FILE): {scenarios}, or a lot file.
        graph: Also draw the drive graph.
        out, -o (FILE): Picture: .png, .pdf or .svg.  [default: NAME.png]
    """
    from parkenv.evaluation.figures.lot_picture import save_lot_picture
    from parkenv.lots import load_lot

    its_lot = load_lot(lot)
    picture = out or Path(file_name(its_lot.name, ".png"))
    save_lot_picture(its_lot, picture, show_graph=graph)
    make_console().print(f"{_summary(its_lot)}. Picture: {picture}")


def check(place: Path, /) -> None:
    """List all errors and warnings of a lot file, by feature number (from 0), and summarise a valid lot.

    The exit code is 2 if there are errors, else 0. Of a file to import it lists what an import would lack.

    Examples:
        parkenv lot check mine.geojson
        parkenv lot check map.osm

    Options:
        place (FILE): OpenStreetMap (.osm, Overpass .json, overpass-turbo .geojson), slot centres (.csv), a Dragon Lake
            map (.yml) or a lot.
    """
    from parkenv.lots import check_lot, read_lot
    from parkenv.lots.file_formats import lot_format

    console = make_console(soft_wrap=True)
    problems = check_lot(place)
    for problem in problems:
        feature = "" if problem.feature is None else f"feature {problem.feature}: "
        console.print(
            f"{problem.severity}: {feature}{problem.message}",
            style="red" if problem.severity == "error" else "yellow",
            markup=False,
        )
    errors = sum(p.severity == "error" for p in problems)
    if not problems:
        console.print(f"{place}: no errors, no warnings")
    else:
        counts = (errors, "error"), (len(problems) - errors, "warning")
        console.print(f"{place}: " + ", ".join(f"{n} {word}{'s' * (n != 1)}" for n, word in counts))
    if errors:
        raise Exit(2)
    form = lot_format(place)
    if form is not None and form.is_complete:
        console.print(_summary(read_lot(place)))


def import_place(
    place: Path,
    /,
    out: Path,
    picture: Path | None = None,
    goal: list[str] | None = None,
    entry: list[str] | None = None,
    bounds: str | None = None,
    disabled: bool = False,
) -> None:
    """Import a lot of a real place; report what was found, left out and is missing.

    If something is missing, the picture is still drawn, but no lot is written and the exit code is 2.

    Examples:
        parkenv lot import map.osm --out lot.geojson --picture lot.png
        parkenv lot import slots.csv --out lot.geojson --entry 0,0 --goal 40,25

    Options:
        place (FILE): OpenStreetMap (.osm, Overpass .json, overpass-turbo .geojson), slot centres (.csv), a Dragon Lake
            map (.yml) or a lot.
        out, -o (FILE.geojson): Lot file to write.
        picture (FILE.png): Picture to check the import by.
        goal (POINT): Place that people walk to: LAT,LON, or X,Y in metres. Repeatable.  [default: building entrances,
            else the nearest building]
        entry (POINT): Place where cars enter: LAT,LON, or X,Y in metres. Repeatable.  [default: where service roads
            meet a public street, or where streets leave the map]
        bounds (BOX): Import only this: SOUTH,WEST,NORTH,EAST, or X0,Y0,X1,Y1 in metres.
        disabled: Also import spaces for disabled drivers.
    """
    from parkenv.lots import import_lot, write_lot
    from parkenv.lots.importers.import_options import ImportOptions

    corners = None if bounds is None else args.numbers("--bounds", bounds, 4)
    options = ImportOptions(
        goals=tuple((p[0], p[1]) for p in (args.numbers("--goal", text, 2) for text in goal or ())),
        entries=tuple((p[0], p[1]) for p in (args.numbers("--entry", text, 2) for text in entry or ())),
        bounds=None if corners is None else ((corners[0], corners[1]), (corners[2], corners[3])),
        with_disabled=disabled,
    )
    draft = import_lot(place, options)
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
        raise InputError(f"{place}: {error}") from error
    write_lot(lot, out)
    console.print(f"Wrote {out}. {_summary(lot)}")


def convert(lot: str, /, out: Path) -> None:
    """Write a lot as native GeoJSON, e.g. to edit it in a GIS.

    Examples:
        parkenv lot convert campus --out mine.geojson

    Options:
        lot (NAME|FILE): {scenarios}, or a lot file.
        out, -o (FILE.geojson): Lot file to write.
    """
    from parkenv.lots import load_lot, write_lot

    write_lot(load_lot(lot), out)
    make_console().print(f"Wrote {out}")


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
            f"parking costs {cost.min():g} to {cost.max():g} s ({int((cost != 0).sum())} slots above 0)"
        )
    return ", ".join(parts)


app = group("lot", "Show, check, import and convert lots (lot files, OpenStreetMap, lists of slots).")
add(app, "show", show)
add(app, "check", check)
add(app, "import", import_place)
add(app, "convert", convert)
