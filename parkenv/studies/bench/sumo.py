"""The same lot, cars and rule in Eclipse SUMO, as a peer of the fleet: network, parking areas, trips, results.

SUMO is not needed by anything else; `pip install eclipse-sumo` provides it.
"""

from __future__ import annotations

import os
import resource
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from parkenv.engine.fleet import DriverKind, Fleet, drive_times
from parkenv.errors import InputError
from parkenv.studies.bench.rows import BenchRow, absent, duration
from parkenv.world.demand import Demand, ExponentialTime, PoissonArrivals
from parkenv.world.lot import ParkingLot
from parkenv.world.week import HOUR_S
from planners.heuristics import POLICIES

PARKING_WEIGHTS = {
    "parking.distanceto.weight": 1,  # the nearest of the areas not known to be full
    "parking.probability.weight": 0,
    "parking.memory": 1_000_000,  # an area found full is not tried again for this time, s
    "parking.frustration": 1_000_000,
}
"""Parameters with which SUMO's drivers do as `greedy-drive`: drive on to the nearest slot not known to be taken."""
STEPS_S = (1.0, 0.1)
"""Time steps of SUMO, s."""
_WINDOW = 8 * HOUR_S, 13 * HOUR_S
_SHORT_M = 2.0  # length of a parking area on its lane, m
# A step is 0.1 to 1 s, so these reach any speed, or stop, within one.
_AT_ONCE = 100.0  # m/s²


class Street(NamedTuple):
    """A chain of drive graph edges between two junctions: one edge of SUMO.

    Attributes:
        start, end: vertices of the lot.
        length: m.
        slots: slots along it, and their positions, m from the start.
    """

    start: int
    end: int
    length: float
    slots: tuple[tuple[int, float], ...]
    number: int = 0  # of the streets between the same junctions

    @property
    def name(self) -> str:
        """Name of the edge."""
        return f"{self.start}-{self.end}" + (f"-{self.number}" if self.number else "")


@dataclass(frozen=True)
class SumoDay:
    """What SUMO made of a day.

    Attributes:
        search_s: (n_cars,) s from the arrival until the car stood in its parking area; NaN if it never did.
        slot: (n_cars,) int64, the slot of that area; -1 if it never did.
        began_s, left_s: (n_cars,) s since the beginning, when the car came to stand there and left.
        cpu_s: CPU time of the simulation, s.
    """

    search_s: NDArray[np.float64]
    slot: NDArray[np.int64]
    began_s: NDArray[np.float64]
    left_s: NDArray[np.float64]
    cpu_s: float


def sumo_folder() -> Path | None:
    """Return the folder of SUMO's programs, None if it is not installed."""
    spec = find_spec("sumo")
    if spec is not None and spec.origin is not None:
        return Path(spec.origin).parent / "bin"
    found = shutil.which("sumo")
    return None if found is None else Path(found).parent


def sumo_version(folder: Path) -> str:
    """Return the version, such as `SUMO 1.28.0`."""
    said = _run([folder / "sumo", "--version"]).split()
    return f"SUMO {said[said.index('sumo') + 1] if 'sumo' in said else said[3]}"


def sumo_rows(seed: int = 0, days: int = 3, per_hour: float = 60.0) -> list[BenchRow]:
    """Return rows with CPU times and mean search times of the same days in a fleet and in SUMO, if it is installed.

    Args:
        seed: seed of the days.
        days: number of days.
        per_hour: cars an hour, from 8 to 13 o'clock.
    """
    folder = sumo_folder()
    if folder is None:
        return absent("day", "SUMO: not installed", "s")
    demand = Demand(PoissonArrivals(per_hour, *_WINDOW), ExponentialTime(HOUR_S))
    kind = DriverKind(policy=POLICIES["greedy-drive"])
    fleet = Fleet("street", demand, background="none", drivers=[kind], leave_full_lot=False)
    end_s = _WINDOW[1] - _WINDOW[0] + HOUR_S
    peers = {f"{sumo_version(folder)}, steps of {step:g} s": step for step in STEPS_S}
    cpu_s: dict[str, list[float]] = {name: [] for name in ("ours", *peers)}
    search_s: dict[str, list[float]] = {name: [] for name in ("ours", *peers)}
    fleet.reset(seed)
    fleet.run()  # compiles
    for day in range(days):
        start = time.process_time()
        fleet.reset(seed, day)
        fleet.run()
        cpu_s["ours"].append(time.process_time() - start)
        search_s["ours"].append(float((fleet.cars["ended_at"] - fleet.cars["arrival"]).mean()))
        for name, step in peers.items():
            theirs = run_sumo(fleet, folder, step, end_s)
            cpu_s[name].append(theirs.cpu_s)
            search_s[name].append(float(np.nanmean(theirs.search_s)))
    case = f"street, {per_hour:g} cars an hour for 5 hours, greedy-drive"
    ours, *others = (float(np.mean(cpu_s[name])) for name in cpu_s)
    rows = duration("day", case, 1e3 * ours, "ms", **{n: 1e3 * t for n, t in zip(peers, others, strict=True)})
    ours, *others = (float(np.mean(search_s[name])) for name in search_s)
    for name, other in zip(peers, others, strict=True):
        (row,) = duration("day", f"{case}: mean search time", ours, "s of search", **{name: other})
        row["ratio"] = None  # to be equal, not to be small
        rows.append(row)
    return rows


def streets_of(lot: ParkingLot) -> list[Street]:
    """Return the streets of a lot whose slots all lie on one-way lanes.

    A parking area of SUMO belongs to one lane, so a slot between two lanes would have to be two areas.

    Raises:
        InputError: a slot can be reached, or left, in two ways.
    """
    neighbors = [[int(v) for v in row if v >= 0] for row in lot.neighbors]
    reached = np.bincount(lot.neighbors[lot.neighbors >= 0], minlength=lot.n_vertices)
    for slot in range(lot.n_slots):
        if len(neighbors[slot]) != 1 or reached[slot] != 1:
            raise InputError(
                f"lot {lot.name!r}: slot {slot} is on no one-way lane, which SUMO's parking areas need"
            )
    length = {
        (u, int(v)): float(lot.edge_length[u, a])
        for u, row in enumerate(lot.neighbors)
        for a, v in enumerate(row)
        if v >= 0
    }
    streets: list[Street] = []
    count: dict[tuple[int, int], int] = {}
    for start in range(lot.n_slots, lot.n_vertices):
        for first in neighbors[start]:
            before, at, along, slots = start, first, length[start, first], []
            while at < lot.n_slots:
                slots.append((at, along))
                before, at = at, neighbors[at][0]
                along += length[before, at]
            number = count[start, at] = count.get((start, at), -1) + 1
            streets.append(Street(start, at, along, tuple(slots), number))
    return streets


def run_sumo(fleet: Fleet, folder: Path, step_s: float, end_s: float) -> SumoDay:
    """Run a fleet's day in SUMO: the cars of `fleet.cars`, arrivals, entries and stays alike, in an empty lot.

    Cars accelerate at once and keep their minimum gap; they know a slot to be taken only when they are there.

    Args:
        fleet: a fleet that has been reset.
        folder: folder of SUMO's programs.
        step_s: time step, s.
        end_s: end of the simulation, s after the fleet's beginning.

    Raises:
        InputError: the lot has two-way lanes, or SUMO reports an error.
    """
    streets = streets_of(fleet.scenario.lot)
    with tempfile.TemporaryDirectory() as name:
        at = Path(name)
        _write_network(fleet, streets, at, folder)
        _write_parking(streets, fleet.scenario.lot.capacity, at / "parking.add.xml")
        _write_trips(fleet, streets, at / "trips.rou.xml", step_s)
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        _run(
            [
                folder / "sumo", "-n", at / "lot.net.xml", "-a", at / "parking.add.xml", "-r", at / "trips.rou.xml",
                "--step-length", str(step_s), "--end", str(end_s), "--stop-output", at / "stops.xml",
                "--stop-output.write-unfinished", "true", "--time-to-teleport", "-1", "--no-step-log", "true",
                "--no-warnings", "true",
            ]
        )  # fmt: skip
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        stops = ElementTree.parse(at / "stops.xml").getroot()
        found = {int(stop.get("id", -1)): stop for stop in stops}
    arrival_s = fleet.cars["arrival"] - fleet.begin
    slot, began_s, left_s = np.full(len(arrival_s), -1), *np.full((2, len(arrival_s)), np.nan)
    for car, stop in found.items():
        slot[car] = int(stop.get("parkingArea", "slot-1").removeprefix("slot"))
        began_s[car] = float(stop.get("started", "nan"))
        ended = float(stop.get("ended", "-1"))
        left_s[car] = ended if ended >= 0.0 else np.inf
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return SumoDay(began_s - arrival_s, slot, began_s, left_s, cpu_s)


def _write_network(fleet: Fleet, streets: Iterable[Street], at: Path, folder: Path) -> None:
    xy, speed = fleet.scenario.lot.vertex_xy, fleet.scenario.v_drive
    streets = list(streets)
    junctions = sorted({v for street in streets for v in (street.start, street.end)})
    _write(
        at / "lot.nod.xml", "nodes", [("node", {"id": v, "x": xy[v, 0], "y": xy[v, 1]}) for v in junctions]
    )
    edges = [
        (
            "edge",
            {"id": s.name, "from": s.start, "to": s.end, "numLanes": 1, "speed": speed, "length": s.length},
        )
        for s in streets
    ]
    _write(at / "lot.edg.xml", "edges", edges)
    files: list[str | Path] = ["-n", at / "lot.nod.xml", "-e", at / "lot.edg.xml", "-o", at / "lot.net.xml"]
    # Without lanes within junctions, routes have the lengths of the lot's drive graph.
    _run([folder / "netconvert", *files, "--no-internal-links", "true"])


def _write_parking(streets: Iterable[Street], capacity: NDArray[np.int64], path: Path) -> None:
    root = ElementTree.Element("additional")
    streets = list(streets)
    for street in streets:
        for slot, along in street.slots:
            place = {"lane": f"{street.name}_0", "startPos": max(along - _SHORT_M, 0.0), "endPos": along}
            _add(root, "parkingArea", {"id": f"slot{slot}", "roadsideCapacity": int(capacity[slot]), **place})
    rerouter = _add(root, "rerouter", {"id": "search", "edges": " ".join(street.name for street in streets)})
    interval = _add(rerouter, "interval", {"begin": 0, "end": 1_000_000})
    for street in streets:
        for slot, _ in street.slots:
            _add(interval, "parkingAreaReroute", {"id": f"slot{slot}", "visible": "false"})
    ElementTree.ElementTree(root).write(path)


def _write_trips(fleet: Fleet, streets: Iterable[Street], path: Path, step_s: float) -> None:
    streets = list(streets)
    of_slot = {slot: street.name for street in streets for slot, _ in street.slots}
    root = ElementTree.Element("routes")
    driver = {
        "id": "car", "sigma": 0, "speedDev": 0, "speedFactor": 1, "length": 4, "minGap": 0.5, "tau": step_s,
        "accel": _AT_ONCE, "decel": _AT_ONCE, "emergencyDecel": _AT_ONCE,
    }  # fmt: skip
    kind = _add(root, "vType", driver)
    for name, value in PARKING_WEIGHTS.items():
        _add(kind, "param", {"key": name, "value": value})
    cars = fleet.cars
    entries = [int(entry) for entry in np.unique(cars["entry"])]
    first = {entry: int(np.argmin(drive_times(fleet.scenario, entry))) for entry in entries}
    start = {entry: _first_street(fleet, streets, entry, first[entry]).name for entry in entries}
    for number, car in enumerate(cars):
        entry = int(car["entry"])
        route = {"from": start[entry], "to": of_slot[first[entry]], "departSpeed": "max", "type": "car"}
        trip = _add(root, "trip", {"id": number, "depart": car["arrival"] - fleet.begin, **route})
        _add(trip, "stop", {"parkingArea": f"slot{first[entry]}", "duration": car["stay_s"]})
    ElementTree.ElementTree(root).write(path)


def _first_street(fleet: Fleet, streets: Iterable[Street], entry: int, slot: int) -> Street:
    """Return the street by which a car leaves an entry on its way to a slot."""

    def metres(street: Street) -> float:
        along = dict(street.slots).get(slot)
        onward = drive_times(fleet.scenario, street.end)[slot] * fleet.scenario.v_drive
        return street.length + float(onward) if along is None else along

    return min((street for street in streets if street.start == entry), key=metres)


def _write(path: Path, tag: str, children: Iterable[tuple[str, Mapping[str, object]]]) -> None:
    root = ElementTree.Element(tag)
    for name, attributes in children:
        _add(root, name, attributes)
    ElementTree.ElementTree(root).write(path)


def _add(parent: ElementTree.Element, tag: str, attributes: Mapping[str, object]) -> ElementTree.Element:
    text = {name: f"{v:.3f}" if isinstance(v, float) else str(v) for name, v in attributes.items()}
    return ElementTree.SubElement(parent, tag, text)


def _run(command: Sequence[str | Path]) -> str:
    """Run one of SUMO's programs and return its output.

    Raises:
        InputError: it failed.
    """
    environment = {**os.environ, "SUMO_HOME": str(Path(command[0]).parents[1])}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    if done.returncode != 0:
        raise InputError(f"{Path(command[0]).name}: {(done.stderr or done.stdout).strip()[:300]}")
    return done.stdout
