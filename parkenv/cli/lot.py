"""`parkenv lot`: show, check, import and convert lots."""

from __future__ import annotations

import math
import warnings
from collections import Counter
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from textwrap import shorten
from typing import TYPE_CHECKING, Annotated, ClassVar, Self

import numpy as np
from pydantic import Field, model_validator
from typer import Exit

from parkenv.cli.options import Command
from parkenv.cli.tables import make_console, print_rows, save_summary, stages
from parkenv.errors import InputError, require
from parkenv.files.atomic_write import check_writable, write_together
from parkenv.files.csv_tables import write_csv
from parkenv.files.file_names import file_name
from parkenv.files.folder_lock import only_writer
from parkenv.files.known_names import PACKAGED_LOTS
from parkenv.files.option import Option, numbers_in, option
from parkenv.files.spec_file import Several, require_together
from parkenv.show.tables import Column, plural
from parkenv.world.tariff import NO_ZONE

if TYPE_CHECKING:
    from parkenv.lots.draft import ImportOptions, Provenance
    from parkenv.world.lot import ParkingLot

_LOT_COLUMNS = (
    Column("lot", "lot"),
    Column("slots", "slots", digits=0),
    Column("kind", "kind"),
    Column("perpendicular", "perpendicular"),
    Column("oblique", "oblique"),
    Column("kerbside", "kerbside"),
    Column("extent_x_m", "east", "m", 0),
    Column("extent_y_m", "north", "m", 0),
    Column("error_probability", "p(error)", digits=2),
    Column("result", "result"),
    Column("reason", "reason"),
)
_LEFT_OUT = (Column("reason", "reason"), Column("bays", "bays", digits=0), Column("ids", "ids"))
_MOST_ZONES = 12  # most zones of a lot that are printed
_MOST_UNREAD = 20  # most rows of what could not be read that are printed
AUTO = "auto"  # value of `--entry` and `--goal` that allows a guess
LotName = Annotated[
    str,
    Field(description=f"{', '.join(PACKAGED_LOTS)}, or a lot file."),
    Option("LOT", takes="NAME|FILE", argument=True),
]
Place = Annotated[
    Path,
    Field(
        description="OpenStreetMap (.osm, .osm.pbf, overpass-turbo .geojson), a Dragon Lake map (.yml) or a lot."
    ),
    Option(takes="FILE", argument=True),
]


class Show(Command):
    """Slots are coloured by their zone or parking cost. The output lists the guesses of an import."""

    soft_wrap: ClassVar = True
    examples = """
        parkenv lot show campus --graph --out campus.png
        parkenv lot show mine.geojson
        """

    lot: LotName
    graph: bool = option(False, "Also draw the drive graph.")
    out: Path | None = option(
        None, "Picture: .png, .pdf or .svg.", short="-o", takes="FILE", default="NAME.png"
    )

    def run(self) -> None:
        from parkenv.lots import load_lot
        from parkenv.show.figures.lot import save_lot_picture

        lot, origin = load_lot(self.lot), _provenance(Path(self.lot))
        picture = self.out or Path(file_name(lot.name, ".png"))
        guesses = origin.guesses if origin is not None else ()
        save_lot_picture(lot, picture, show_graph=self.graph, guesses=guesses)
        self.say(*(f"guessed: {guess}" for guess in guesses), style="cyan")
        self.say(f"{_summary(lot)}. Picture: {picture}")


class Check(Command):
    """The check of drivability: can a car reach every slot and get back, and are lanes clear?

    The error probability, 0 to 1, summarises the reasons why an imported lot may differ from the place. The output
    describes a valid lot.

    The exit code is 2 if there are errors, else 0. For a file to import, the command lists what an import would lack.
    """

    soft_wrap: ClassVar = True
    examples = """
        parkenv lot check mine.geojson
        parkenv lot check map.osm
        """

    place: Place

    def run(self) -> None:
        from parkenv.lots import check_lot, read_lot
        from parkenv.lots.lot_files import lot_format
        from parkenv.studies.lots import check_drivability

        problems, form, drivability = check_lot(self.place), lot_format(self.place), None
        if form != "osm" and not any(p.severity == "error" for p in problems):
            origin = _provenance(self.place)
            with warnings.catch_warnings(action="ignore"):  # listed already
                lot = read_lot(self.place)
            issues = origin.issues if origin is not None else ()
            drivability = check_drivability(lot, issues)
            problems += [problem for problem in drivability.problems if problem not in problems]
        for problem in problems:
            feature = "" if problem.feature is None else f"feature {problem.feature}: "
            style = "red" if problem.severity == "error" else "yellow"
            self.say(f"{problem.severity}: {feature}{problem.message}", style=style)
        errors = sum(p.severity == "error" for p in problems)
        counts = f"{plural(errors, 'error')}, {plural(len(problems) - errors, 'warning')}"
        self.say(f"{self.place}: {counts if problems else 'no errors, no warnings'}")
        if errors:
            raise Exit(2)
        if drivability is not None:
            self.say(_summary(lot))
            reasons = f": {'; '.join(map(str, drivability.issues))}" if drivability.issues else ""
            self.say(f"error probability {drivability.error_probability:.2f}{reasons}")


def _points(texts: Sequence[str]) -> tuple[tuple[float, float], ...]:
    numbers = (numbers_in(text, 2) for text in texts if text != AUTO)
    return tuple((p[0], p[1]) for p in numbers)


def _point(text: str) -> str:
    if text != AUTO:
        numbers_in(text, 2)
    return text


def _square(text: str) -> tuple[float, ...]:
    from parkenv.lots.local_frame import LocalFrame

    lat, lon, metres = numbers_in(text, 3)
    # Near a pole the corners are not the farthest points.
    side = np.linspace(-metres, metres, 41)
    edge = [(x, y) for x in side for y in side if metres in (abs(x), abs(y))]
    at = LocalFrame(lon, lat).to_lonlat(edge)
    (west, south), (east, north) = at.min(axis=0).tolist(), at.max(axis=0).tolist()
    pole = math.copysign(90.0, lat)
    if LocalFrame(lon, lat).to_xy([[lon, pole]])[0, 1] * math.copysign(1.0, lat) <= metres:
        return min(south, pole), -180.0, max(north, pole), 180.0
    if east - west > 180.0:
        west, east = at[at[:, 0] > 0.0, 0].min().item(), at[at[:, 0] < 0.0, 0].max().item()
    return south, west, north, east


class Import(Command):
    """Outlines of parking spaces are enough: without roads in the file, the import infers rows, aisles and connections.

    With --split, every car park of a town becomes a lot in a folder, with a table (`summary.json`) and a contact sheet.
    With --town, a whole town becomes one lot: streets, kerbs, car parks and garages with prices and rules, entries at
    its edge, and goals with weights of demand. A table of its facilities (.csv) gives name, kind, capacity, and the
    source of the capacity: the map (tag, drawn) or a rule.
    With --bays, the bays of a city's register become slots at the kerbs of the map's streets, with their ids and rules:
    points (meters), outlines, or kerb lines with counts. With --town, car parks of the map are imported, too.

    If something is missing, the picture is still drawn, but no lot is written and the exit code is 2.
    """

    soft_wrap: ClassVar = True
    examples = """
        parkenv lot import map.osm --out lot.geojson --picture lot.png
        parkenv lot import spaces.geojson --entry auto --goal auto --out lot.geojson
        parkenv lot import town.geojson --split --out lots
        parkenv lot import town.osm.pbf --town --out town.geojson --picture town.png
        parkenv lot import map.osm --town --around 49.5,11.3,800 --out part.geojson
        parkenv lot import streets.osm --bays meters.csv --out kerbs.geojson
        """

    place: Place
    picture: Path | None = option(None, "Picture for checking the import.", takes="FILE.png")
    goal: Several[str] = option(
        (),
        "Goal of the walk: LAT,LON, or X,Y in metres, or auto: guess it. Repeatable.",
        takes="POINT",
        repeat=True,
        parse=_point,
        default="building entrances, else the nearest building",
    )
    entry: Several[str] = option(
        (),
        "Entry of cars: LAT,LON, or X,Y in metres, or auto: guess it. Repeatable.",
        takes="POINT",
        repeat=True,
        parse=_point,
        default="where service roads meet a public street, or where streets leave the map",
    )
    bounds: Annotated[
        Several[float] | None,
        Field(
            description="Import only this area: SOUTH,WEST,NORTH,EAST, or X0,Y0,X1,Y1 in metres; with --town, "
            "latitudes and longitudes."
        ),
        Option(takes="BOX", default="all of the map", parse=lambda text: tuple(numbers_in(text, 4))),
        Option(
            "--around",
            takes="LAT,LON,METRES",
            parse=_square,
            description="Import only a square around this point, METRES to each side.",
        ),
    ] = None
    left_hand: bool = option(False, "Left-hand traffic, which map files do not state.")
    split: bool = option(
        False, "Find the car parks of a town and write a lot of each; entries and goals are guessed."
    )
    town: bool = option(False, "Import a whole town as one lot; entries and goals are those of the map.")
    bays: Path | None = option(
        None,
        "Register of bays at the kerb (.csv, .geojson, .gz): the only kerbs of the lot. Bays that fit no street are "
        "left out, and listed in a table beside the lot.",
        takes="REGISTER",
        default="none",
    )
    columns: str | None = option(
        None,
        "Columns of the register, by part: bay (its id), lat, lon, line, street, capacity, cars, limit, rate, hours, "
        "class, ... Several that are added up are joined by +.",
        takes="PART=COLUMN,...",
        parse=str,
        default="by usual names",
    )
    car_parks: Path | None = option(
        None,
        "List of counted car parks: name,capacity,lat,lon. With --town, they override names and "
        "capacities of the map; missing ones are added.",
        takes="FILE.csv",
        default="none",
    )
    listed_only: bool = option(
        False,
        "Leave out kerbs, car parks that are not in --car-parks, and streets that are on no "
        "shortest path to these.",
    )
    untagged_kerbs: float = option(
        1.0,
        "Number of places at kerbs without tags, as a multiple of the rule's number, with --town.",
        ge=0.0,
        le=10.0,
    )
    least: int = option(10, "Smallest number of spaces of a car park, with --split.", ge=2)
    out: Path = option(
        ..., "Lot file to write, or folder with --split.", short="-o", takes="FILE.geojson|DIR"
    )

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        points = [point for point in (*self.goal, *self.entry) if point != AUTO]
        on_earth = all(abs(lat) <= 90.0 and abs(lon) <= 180.0 for lat, lon in self.box or ())
        require_together(not (self.split and self.town), "--split and --town: want one of them")
        require_together(
            not (self.split and (points or self.box or self.picture or self.left_hand)),
            "--split finds entries, goals and places itself, want no --entry, --goal, --bounds, --around, --picture, "
            "--left-hand",
        )
        require_together(self.town or self.car_parks is None, "--car-parks wants --town")
        require_together(self.bays or not self.columns, "--columns wants --bays")
        require_together(not (self.split and self.bays), "--split and --bays: want one of them")
        require_together(self.car_parks or not self.listed_only, "--listed-only wants --car-parks")
        require_together(
            not (self._is_town and (self.entry or self.goal)),
            "--town and --bays have those of the map, want no --entry, --goal",
        )
        require_together(on_earth or not self._is_town, "--bounds: want SOUTH,WEST,NORTH,EAST with --town")
        return self

    @property
    def _is_town(self) -> bool:
        return self.town or self.bays is not None

    @property
    def box(self) -> tuple[tuple[float, float], tuple[float, float]] | None:
        if self.bounds is None:
            return None
        south, west, north, east = self.bounds
        return (south, west), (north, east)

    @property
    def _options(self) -> ImportOptions:
        from parkenv.lots.draft import ImportOptions

        return ImportOptions(
            goals=_points(self.goal),
            entries=_points(self.entry),
            guess_entry=self.split or AUTO in self.entry,
            guess_goal=self.split or AUTO in self.goal,
            bounds=self.box,
            left_hand=self.left_hand,
        )

    def run(self) -> None:
        if self.split:
            with only_writer(self.out):
                self._import_car_parks()
            return
        from parkenv.lots import import_lot, write_lot
        from parkenv.lots.draft import Provenance
        from parkenv.lots.formats.geojson import check_lot_output
        from parkenv.lots.town.draft import import_town
        from parkenv.lots.town.supply import TABLE
        from parkenv.lots.unread import Unread

        check_lot_output(self.out)
        table, unread_csv, town = self.out.with_suffix(".csv"), self.out.with_suffix(".unread.csv"), None
        left_out_csv = self.out.with_suffix(".left_out.csv")
        require(
            self.picture is None or self.picture.suffix.lower() == ".png",
            f"--picture {self.picture}: want a name that ends in .png",
        )
        inputs = [path.resolve() for path in (self.place, self.bays, self.car_parks) if path is not None]
        outputs = [self.out, unread_csv, self.picture, table if self._is_town else None]
        for file in (*outputs, left_out_csv if self.bays else None):
            if file is not None:
                require(
                    file.resolve() not in inputs, f"--out {self.out}: would replace {file}, which is read"
                )
                check_writable(file)
        if self._is_town:
            town = import_town(
                self.place, self.car_parks, bays=self.bays, columns=self.columns, bays_only=not self.town,
                listed_only=self.listed_only, bounds=self.box, untagged_kerbs=self.untagged_kerbs,
                left_hand=self.left_hand,
            )  # fmt: skip
        draft = town.draft if town is not None else import_lot(self.place, self._options)
        draft = draft.in_left_hand_traffic() if self.left_hand else draft
        self.say(*draft.found)
        self.say(*(f"guessed: {guess}" for guess in draft.guesses), style="cyan")
        bays_out = () if town is None else town.bays_left_out
        left_out = (f"left out: {left}" for left in draft.left_out if left not in bays_out)
        self.say(*left_out, style="yellow")
        if self.picture is not None:
            from parkenv.show.figures.lots import save_import_picture, save_town_picture

            if town is not None:
                save_town_picture(town, self.picture)
            else:
                save_import_picture(draft, self.picture)
            self.say(f"Picture: {self.picture}")
        try:
            lot = draft.lot()
        except InputError as error:
            raise InputError(f"{self.place}: {error}") from error
        caution = "" if town is None else town.caution
        provenance = Provenance(self.place.name, draft.guesses, draft.issues, caution)
        write_lot(lot, self.out, provenance if draft.guesses else None)
        if town is not None:
            write_csv(table, TABLE, town.facilities)
            self.say(f"Facilities: {table}")
        if self.bays is not None:
            write_csv(
                left_out_csv,
                ("reason", "id"),
                [{"reason": left.reason, "id": name} for left in bays_out for name in left.ids],
            )
            rows = [{"reason": left.reason, "bays": len(left.ids), "ids": left.shown} for left in bays_out]
            print_rows(self.console, f"Bays left out, all in {left_out_csv}", rows, columns=_LEFT_OUT)
        if draft.unread or unread_csv.exists():
            write_csv(unread_csv, [field.name for field in fields(Unread)], map(vars, draft.unread))
            self.say(
                f"Tags that could not be read, and what was assumed: {len(draft.unread)}, all in {unread_csv}"
            )
            for row in sorted(draft.unread, key=lambda row: -row.count)[:_MOST_UNREAD]:
                text = shorten(f"{row.tag}={row.value}", 60, placeholder="...")
                self.say(f"{row.count:5} {text}: {row.assumed}", highlight=False, markup=False)
        self.say(f"Wrote {self.out}. {_summary(lot)}")
        if caution:
            self.say(caution, style="yellow")

    def _import_car_parks(self) -> None:
        from parkenv.studies.lots import import_town_lots

        with stages(self.console) as progress, write_together(self.out) as folder:
            rows = import_town_lots(self.place, folder, self._options, self.least, progress)
            save_summary(folder, None, rows)
        print_rows(make_console(), "Car parks", rows, columns=_LOT_COLUMNS)
        results = Counter(row["result"] for row in rows)
        listed = ", ".join(f"{results[name]} {name}" for name in ("clean", "warnings", "refused"))
        lots = plural(len(rows) - results["refused"], "lot")
        self.say(f"{plural(len(rows), 'car park')} in {self.place}: {listed}. Wrote {lots} to {self.out}")


class Convert(Command):
    """The file can be edited in a GIS."""

    examples = "parkenv lot convert campus --out mine.geojson"

    lot: LotName
    out: Path = option(..., "Lot file to write.", short="-o", takes="FILE.geojson")

    def run(self) -> None:
        from parkenv.lots import load_lot, write_lot

        write_lot(load_lot(self.lot), self.out)
        self.say(f"Wrote {self.out}")


def _provenance(path: Path) -> Provenance | None:
    from parkenv.lots.draft import read_provenance

    is_json = path.suffix.lower() in (".json", ".geojson") and path.exists()
    return read_provenance(path) if is_json else None


def _summary(lot: ParkingLot) -> str:
    low_x, low_y, high_x, high_y = lot.bounds()
    oneway = sum(lane.oneway for lane in lot.lanes)
    n_counted, spaces = int(lot.is_counted.sum()), lot.capacity[lot.is_counted].sum()
    parts = [
        f"{lot.name}: {plural(lot.n_slots - n_counted, 'slot')}",
        *([f"{plural(n_counted, 'car park')} with {spaces} spaces"] if n_counted else []),
        f"{plural(len(lot.lanes), 'lane')} ({oneway} one-way)",
        plural(len(lot.entries), "entry", "entries"),
        plural(len(lot.goals), "goal"),
        plural(lot.n_vertices, "vertex", "vertices"),
        f"{high_x - low_x:.0f} × {high_y - low_y:.0f} m",
    ]
    if lot.zones != (NO_ZONE,):
        word, counts = "spaces" if n_counted else "slots", Counter[int]()
        for zone, capacity in zip(lot.zone_of_slot.tolist(), lot.capacity.tolist(), strict=True):
            counts[zone] += capacity
        shown = sorted(zone for zone, _ in counts.most_common(_MOST_ZONES))
        parts.append(f"zones {', '.join(f'{lot.zones[zone]} ({counts[zone]} {word})' for zone in shown)}")
        parts += [f"{len(counts) - len(shown)} smaller zones"] if len(counts) > len(shown) else []
    cost = lot.slot_parking_cost_s
    if cost.any():
        parts.append(
            f"parking costs {cost.min():g} to {cost.max():g} s ({plural(int((cost != 0).sum()), 'slot')} above 0)"
        )
    return ", ".join(parts)
