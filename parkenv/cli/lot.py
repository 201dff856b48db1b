"""`parkenv lot`: show, check, import and convert lots."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from typer import Exit

from parkenv.cli import arguments as args
from parkenv.cli.command import add, group
from parkenv.cli.single_writer import writing_into
from parkenv.cli.tables import make_console, make_table, progress_bar, save_summary
from parkenv.errors import InputError
from parkenv.files.file_names import file_name
from parkenv.show.plurals import plural

AUTO = "auto"
"""Value of `--entry` and `--goal` that allows a guess."""

if TYPE_CHECKING:
    from parkenv.lots.draft import ImportOptions
    from parkenv.lots.quality import Provenance
    from parkenv.world.lot import ParkingLot


def show(lot: str, /, graph: bool = False, out: Path | None = None) -> None:
    """Draw a lot and summarise it; slots with a parking cost are coloured by it. Guesses of an import are listed.

    Examples:
        parkenv lot show campus --graph --out campus.png
        parkenv lot show mine.geojson

    Options:
        lot (NAME|FILE): {scenarios}, or a lot file.
        graph: Also draw the drive graph.
        out, -o (FILE): Picture: .png, .pdf or .svg.  [default: NAME.png]
    """
    from parkenv.lots import load_lot
    from parkenv.show.figures.lot import save_lot_picture

    its_lot = load_lot(lot)
    picture = out or Path(file_name(its_lot.name, ".png"))
    origin = _provenance(Path(lot))
    guesses = origin.guesses if origin is not None else ()
    save_lot_picture(its_lot, picture, show_graph=graph, guesses=guesses)
    console = make_console(soft_wrap=True)
    for guess in guesses:
        console.print(f"guessed: {guess}", style="cyan", markup=False)
    console.print(f"{_summary(its_lot)}. Picture: {picture}")


def check(place: Path, /, drive: bool | None = None) -> None:
    """List all errors and warnings of a lot file, by feature number (from 0), and summarise a valid lot.

    The drivability of a lot is checked: can a car reach every slot, drive into it and get back, and are the lanes
    clear? The error probability, 0 to 1, sums up the reasons why an imported lot may differ from the place.

    The exit code is 2 if there are errors, else 0. Of a file to import it lists what an import would lack.

    Examples:
        parkenv lot check mine.geojson
        parkenv lot check map.osm

    Options:
        place (FILE): OpenStreetMap (.osm, .osm.pbf, Overpass .json, overpass-turbo .geojson), slot centres (.csv), a
            Dragon Lake map (.yml) or a lot.
        drive: Plan how the car drives into each kind of slot.  [default: drive]
    """
    from parkenv.lots import check_lot, read_lot
    from parkenv.lots.formats.recognition import lot_format
    from parkenv.studies.drivability import check_drivability

    console = make_console(soft_wrap=True)
    problems = check_lot(place)
    form = lot_format(place)
    drivability = None
    if form is not None and form.is_complete and not any(p.severity == "error" for p in problems):
        origin = _provenance(place)
        drivability = check_drivability(
            read_lot(place), origin.issues if origin is not None else (), drive=drive is not False
        )
        problems += drivability.problems
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
    if drivability is not None:
        console.print(_summary(read_lot(place)))
        if drive is not False:
            console.print(f"{drivability.planned} of {drivability.kinds} kinds of manoeuvres planned")
        reasons = "; ".join(map(str, drivability.issues))
        console.print(
            f"error probability {drivability.error_probability:.2f}" + (f": {reasons}" if reasons else ""),
            markup=False,
        )


def import_place(
    place: Path,
    /,
    out: Path,
    picture: Path | None = None,
    goal: list[str] | None = None,
    entry: list[str] | None = None,
    bounds: str | None = None,
    disabled: bool = False,
    split: bool = False,
    least: int = 10,
) -> None:
    """Import a lot of a real place; report what was found, guessed, left out and is missing.

    Outlines of parking spaces are enough: without roads in the file, the rows, the aisles before them and the ways
    between these are inferred. With --split, every car park of a town becomes a lot in a folder, with a table
    (`summary.json`) and a contact sheet.

    If something is missing, the picture is still drawn, but no lot is written and the exit code is 2.

    Examples:
        parkenv lot import map.osm --out lot.geojson --picture lot.png
        parkenv lot import slots.csv --out lot.geojson --entry 0,0 --goal 40,25
        parkenv lot import spaces.geojson --entry auto --goal auto --out lot.geojson
        parkenv lot import town.geojson --split --out lots

    Options:
        place (FILE): OpenStreetMap (.osm, .osm.pbf, Overpass .json, overpass-turbo .geojson), slot centres (.csv), a
            Dragon Lake map (.yml) or a lot.
        out, -o (FILE.geojson|DIR): Lot file to write, or folder with --split.
        picture (FILE.png): Picture to check the import by.
        goal (POINT): Place that people walk to: LAT,LON, or X,Y in metres, or auto: guess it. Repeatable.  [default:
            building entrances, else the nearest building]
        entry (POINT): Place where cars enter: LAT,LON, or X,Y in metres, or auto: guess it. Repeatable.  [default:
            where service roads meet a public street, or where streets leave the map]
        bounds (BOX): Import only this: SOUTH,WEST,NORTH,EAST, or X0,Y0,X1,Y1 in metres.
        disabled: Also import spaces for disabled drivers.
        split: Find the car parks of a town and write a lot of each; entries and goals are guessed.
        least (N >= 2): Number of spaces of the smallest car park, with --split.
    """
    from parkenv.files.atomic_write import check_writable
    from parkenv.lots import import_lot, write_lot
    from parkenv.lots.draft import ImportOptions
    from parkenv.lots.formats.geojson import check_lot_output
    from parkenv.lots.quality import Provenance

    corners = None if bounds is None else args.numbers("--bounds", bounds, 4)
    options = ImportOptions(
        goals=_points("--goal", goal),
        entries=_points("--entry", entry),
        guess_entry=split or AUTO in (entry or ()),
        guess_goal=split or AUTO in (goal or ()),
        bounds=None if corners is None else ((corners[0], corners[1]), (corners[2], corners[3])),
        with_disabled=disabled,
    )
    console = make_console(soft_wrap=True)
    if split:
        if options.goals or options.entries or options.bounds or picture:
            raise InputError(
                "--split finds entries, goals and places itself, want no --entry, --goal, --bounds, --picture"
            )
        with writing_into(out):
            _import_town(place, out, options, least)
        return
    check_lot_output(out)
    if picture is not None:
        if picture.suffix.lower() != ".png":
            raise InputError(f"--picture {picture}: want a name that ends in .png")
        check_writable(picture)
    draft = import_lot(place, options)
    for line in draft.found:
        console.print(line)
    for guess in draft.guesses:
        console.print(f"guessed: {guess}", style="cyan", markup=False)
    for left in draft.left_out:
        console.print(f"left out: {left}", style="yellow")
    if picture is not None:
        from parkenv.show.figures.lot_import import save_import_picture

        save_import_picture(draft, picture)
        console.print(f"Picture: {picture}")
    try:
        lot = draft.lot()
    except InputError as error:
        raise InputError(f"{place}: {error}") from error
    provenance = Provenance(place.name, draft.guesses, draft.issues) if draft.guesses else None
    write_lot(lot, out, provenance)
    console.print(f"Wrote {out}. {_summary(lot)}")


def _import_town(place: Path, out: Path, options: ImportOptions, least: int) -> None:
    """Write every car park of a town, a table of what became of each, and contact sheets."""
    from parkenv.lots import write_lot
    from parkenv.lots.osm.town import import_town
    from parkenv.lots.quality import Provenance
    from parkenv.show.figures.contact_sheet import save_contact_sheets
    from parkenv.studies.drivability import check_drivability

    rows: list[dict[str, object]] = []
    lots = []
    console = make_console(soft_wrap=True)
    parks = import_town(place, options, least)
    with progress_bar(console) as bar:
        task = bar.add_task("car parks", total=None)
        for park in parks:
            bar.advance(task)
            row: dict[str, object] = {"lot": park.name, "spaces": park.spaces, "slots": 0, "lanes": 0}
            if park.draft is None:
                row |= {"result": "refused", "error_probability": None, "reason": park.reason}
            else:
                lot = park.draft.lot()
                drivability = check_drivability(lot, park.draft.issues)
                left = "; ".join(map(str, park.draft.left_out))
                problems = "; ".join(problem.message for problem in drivability.problems)
                row |= {
                    "slots": lot.n_slots,
                    "lanes": len(lot.lanes),
                    "result": "warnings" if drivability.problems else "clean",
                    "error_probability": round(drivability.error_probability, 3),
                    "reason": problems or (f"left out: {left}" if left else ""),
                }
                lots.append(
                    (
                        lot,
                        Provenance(place.name, park.draft.guesses, drivability.issues),
                        drivability.error_probability,
                    )
                )
            rows.append(row)
    for lot, provenance, _ in lots:
        write_lot(lot, out / f"{lot.name}.geojson", provenance)
    drawn = [(f"{lot.name}\n{lot.n_slots} slots, error probability {p:.2f}", lot) for lot, _, p in lots]
    sheets = save_contact_sheets(drawn, out)
    save_summary(out, None, rows)
    headings = ("car park", "spaces", "slots", "lanes", "p(error)", "result", "reason")
    table = make_table(None, headings)
    for column in table.columns[-2:]:
        column.justify, column.no_wrap = "left", False
    for row in rows:
        p = "" if row["error_probability"] is None else f"{row['error_probability']:.2f}"
        cells = (row["lot"], row["spaces"], row["slots"], row["lanes"], p, row["result"], row["reason"])
        table.add_row(*map(str, cells))
    make_console().print(table)
    became = {name: sum(row["result"] == name for row in rows) for name in ("clean", "warnings", "refused")}
    listed = ", ".join(f"{count} {name}" for name, count in became.items())
    pictures = f" Pictures: {', '.join(map(str, sheets))}" if sheets else ""
    console.print(
        f"{plural(len(rows), 'car park')} in {place}: {listed}. Wrote {plural(len(lots), 'lot')} to {out}.{pictures}"
    )


def _points(option: str, texts: list[str] | None) -> tuple[tuple[float, float], ...]:
    """Return the points of an option; `auto` stands for none."""
    numbers = (args.numbers(option, text, 2) for text in texts or () if text != AUTO)
    return tuple((p[0], p[1]) for p in numbers)


def census(places: list[Path], /, drive: bool | None = None, out: Path = Path("results/census")) -> None:
    """Count lots: how large each is, of what kinds its slots are, how far it is to drive, and how sure it is.

    A slot is perpendicular, oblique or kerbside by the angle between its lane and the parked car; a lot is of the kind
    of nine in ten of its slots, else mixed. It is small below 80 slots, large from 200 on. The drive time is that from
    an entry to the slot farthest from it, at 10 km/h. The error probability is that of `parkenv lot check`.

    The exit code is 2 if a file holds no lot; the others are counted all the same.

    Examples:
        parkenv lot import town.geojson --split --out lots
        parkenv lot census lots
        parkenv lot census campus.geojson lots --no-drive --out results/all

    Options:
        places (FILE|DIR): Lots (.geojson, .yml), and folders of lots (.geojson).
        drive: Plan how the car drives into each kind of slot, as `parkenv lot check` does.  [default: drive]
        out, -o (DIR): Folder for census.csv, summary.json, census.png and contact sheets.
    """
    from parkenv.files.atomic_write import make_folder
    from parkenv.files.csv_tables import write_csv
    from parkenv.show.figures.census import save_census
    from parkenv.show.figures.contact_sheet import save_contact_sheets
    from parkenv.studies.lot_census import COLUMNS, count_lot, lot_files

    files = lot_files(places)
    make_folder(out)
    console = make_console(soft_wrap=True)
    counted = []
    with progress_bar(console, "lots") as bar:
        task = bar.add_task("Checking", total=len(files))
        for file in files:
            counted.append(count_lot(file, drive=drive is not False))
            bar.advance(task)
    counted.sort(key=lambda one: -one[0].get("slots", 0))
    rows = [row for row, _ in counted]
    lots = [(row, lot) for row, lot in counted if lot is not None]
    write_csv(out / "census.csv", COLUMNS, rows)
    save_summary(out, None, rows)
    pictures = []
    if lots:
        pictures = [out / "census.png"]
        save_census([row for row, _ in lots], pictures[0])
        drawn = [
            (f"{row['lot']}\n{row['slots']} slots, error probability {row['error_probability']:.2f}", lot)
            for row, lot in lots
        ]
        pictures += save_contact_sheets(drawn, out)
    headings = (
        "lot",
        "slots",
        "kind",
        "perp.",
        "obl.",
        "kerb",
        "m",
        "drive s",
        "p(error)",
        "result",
        "reason",
    )
    table = make_table(None, headings)
    for column in table.columns[-2:]:
        column.justify, column.no_wrap = "left", False
    for row in rows:
        extent = f"{row['extent_x_m']:.0f} × {row['extent_y_m']:.0f}" if "slots" in row else ""
        values = [
            row.get(name, "") for name in ("lot", "slots", "kind", "perpendicular", "oblique", "kerbside")
        ]
        shown = (
            *values,
            extent,
            row.get("drive_s", ""),
            row.get("error_probability", ""),
            row["result"],
            row["reason"],
        )
        table.add_row(*map(str, shown))
    make_console().print(table)
    became = {name: sum(row["result"] == name for row in rows) for name in ("clean", "warnings", "invalid")}
    listed = ", ".join(f"{count} {name}" for name, count in became.items() if count)
    slots = sum(row["slots"] for row, _ in lots)
    console.print(f"{len(rows)} lots, {slots:,} slots: {listed}. Table and pictures are in {out}")
    if became["invalid"]:
        raise Exit(2)


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


def _provenance(path: Path) -> Provenance | None:
    """Return what a lot file says of its import; None for a packaged lot or another format."""
    from parkenv.lots.quality import read_provenance

    is_json = path.suffix.lower() in (".json", ".geojson") and path.exists()
    return read_provenance(path) if is_json else None


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


app = group("lot", "Show, check, import, count and convert lots (lot files, OpenStreetMap, lists of slots).")
add(app, "show", show)
add(app, "check", check)
add(app, "import", import_place)
add(app, "census", census)
add(app, "convert", convert)
