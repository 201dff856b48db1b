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
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from benchmarks.rows import Row, absent, duration, equal
from parkenv.compiled.arrays import FloatArray
from parkenv.engine.fleet import Fleet
from parkenv.errors import InputError
from parkenv.world.lot import ParkingLot
from parkenv.world.scenario import drive_times
from parkenv.world.week import HOUR_S

PARKING_WEIGHTS = {
    "parking.distanceto.weight": 1,  # the nearest of the areas not known to be full
    "parking.probability.weight": 0,
    "parking.memory": 1_000_000,  # an area found full is not tried again for this time, s
    "parking.frustration": 1_000_000,
}
"""Parameters with which SUMO's drivers do as `greedy-drive`: drive on to the nearest slot not known to be taken."""
ALTERNATIVES = 100
"""Parking areas that a car may go on to from a full one, the nearest: SUMO computes a route to each."""
_SHORT_M = 2.0  # length of a parking area on its lane, m
# A step is 0.1 to 1 s, so these reach any speed, or stop, within one.
_AT_ONCE = 100.0  # m/s²


class Street(NamedTuple):
    """A chain of drive graph edges between two junctions: one edge of SUMO.

    Attributes:
        start, end: vertices of the lot, the first of those at their junctions.
        length: m.
        slots: slots along it, and their positions, m from the start.
        reached: vertex where cars come out of it: which turns they may make there.
        number: of the streets between the same junctions.
    """

    start: int
    end: int
    length: float
    slots: tuple[tuple[int, float], ...]
    reached: int
    number: int = 0

    @property
    def first(self) -> int:
        """The first vertex on it."""
        return self.slots[0][0] if self.slots else self.reached

    @property
    def name(self) -> str:
        """Name of the edge."""
        return f"{self.start}-{self.end}" + (f"-{self.number}" if self.number else "")


@dataclass(frozen=True)
class ParkedDay:
    """What a model made of a day.

    Attributes:
        search_s: (n_cars,) s from the arrival until the car stood in its slot; NaN if it never did.
        slot: (n_cars,) int64; -1 if it never did.
        began_s, left_s: (n_cars,) s since the beginning, when the car came to stand there and left.
        cpu_s: CPU time of the simulation, s.
    """

    search_s: FloatArray
    slot: NDArray[np.int64]
    began_s: FloatArray
    left_s: FloatArray
    cpu_s: float

    def parked_share(self, capacity: NDArray[np.int64], end_s: float) -> FloatArray:
        """Return the mean share of the spaces of each slot in which cars stood until a time, (n_slots,)."""
        stood = np.clip(self.left_s, 0.0, end_s) - np.clip(self.began_s, 0.0, end_s)
        parked = (self.slot >= 0) & np.isfinite(self.began_s)
        return np.bincount(self.slot[parked], stood[parked], len(capacity)) / (end_s * capacity)


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


def sumo_rows(
    fleet: Fleet, case: str, seed: int, end_s: float, steps_s: Sequence[float], days: int = 1
) -> tuple[list[Row], dict[str, list[ParkedDay]]]:
    """Return rows with CPU times and mean search times of days in a fleet and in SUMO, and these days.

    Args:
        fleet: a fleet in an empty lot, whose drivers are `greedy-drive`.
        case: what the days are.
        seed: seed of the days.
        end_s: s from the beginning of the day until no more cars come.
        steps_s: time steps of SUMO, s, each a peer.
        days: number of days.

    Returns:
        The rows; the days of the fleet under the name `ours`, and of each peer. Without SUMO, a row that says so.
    """
    folder = sumo_folder()
    if folder is None:
        return absent("day", "SUMO: not installed", "s"), {}
    peers = {f"{sumo_version(folder)}, steps of {step:g} s": step for step in steps_s}
    driven: dict[str, list[ParkedDay]] = {name: [] for name in ("ours", *peers)}
    fleet.reset(seed)
    fleet.run()  # compiles
    for day in range(days):
        driven["ours"].append(run_fleet(fleet, seed, day))
        for name, step in peers.items():
            driven[name].append(run_sumo(fleet, folder, step, end_s + HOUR_S))

    def means(value: Callable[[ParkedDay], float]) -> dict[str, float]:
        return {name: float(np.mean([value(day) for day in those])) for name, those in driven.items()}

    case = f"{case}, greedy-drive"
    took_ms, search_s = means(lambda day: 1e3 * day.cpu_s), means(lambda day: float(np.nanmean(day.search_s)))
    rows = duration("day", case, took_ms.pop("ours"), "ms", **took_ms)
    rows += equal("day", f"{case}: mean search time", search_s.pop("ours"), "s of search", **search_s)
    return rows, driven


def run_fleet(fleet: Fleet, seed: int, day: int = 0) -> ParkedDay:
    """Run a day of a fleet to its end."""
    start = time.process_time()
    fleet.reset(seed, day)
    fleet.run()
    took, cars = time.process_time() - start, fleet.cars
    parked = cars["slot"] >= 0
    began_s = np.where(parked, cars["ended_at"], np.nan)
    slot = cars["slot"].astype(np.int64)
    return ParkedDay(
        began_s - cars["arrival"], slot, began_s - fleet.begin, cars["left_at"] - fleet.begin, took
    )


def streets_of(lot: ParkingLot) -> list[Street]:
    """Return the streets of a lot whose slots all lie on one-way lanes.

    A parking area of SUMO belongs to one lane, so a slot between two lanes would have to be two areas.

    Raises:
        InputError: a slot can be reached, or left, in two ways.
    """
    n, neighbors = lot.n_slots, [[int(v) for v in row if v >= 0] for row in lot.neighbors]
    # All vertices of a junction begin the same streets.
    junction = lot.junction_of_vertex
    ways_in = np.unique([(junction[u], v) for u, row in enumerate(neighbors) for v in row], axis=0)
    reached = np.bincount(ways_in[:, 1], minlength=n)
    for slot in range(n):
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
    streets: dict[tuple[Any, ...], Street] = {}
    count: dict[tuple[int, int], int] = {}
    for start in range(n, lot.n_vertices):
        for begin in neighbors[start]:
            before, at, along, slots = start, begin, length[start, begin], []
            while at < n:
                slots.append((at, along))
                before, at = at, neighbors[at][0]
                along += length[before, at]
            ends = int(junction[start]), int(junction[at])
            key = (*ends, along, tuple(slots), at)
            if key not in streets:
                number = count[ends] = count.get(ends, -1) + 1
                streets[key] = Street(*key, number)
    return list(streets.values())


def run_sumo(fleet: Fleet, folder: Path, step_s: float, end_s: float) -> ParkedDay:
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
    ahead_m = {street.name: _metres_ahead(fleet, street) for street in streets}
    with tempfile.TemporaryDirectory() as name:
        at = Path(name)
        _write_network(fleet, streets, at, folder)
        _write_parking(fleet, streets, ahead_m, at / "parking.add.xml")
        _write_trips(fleet, streets, ahead_m, at / "trips.rou.xml", step_s)
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
    arrival_s = fleet.cars["arrival"] - fleet.begin
    slot, began_s, left_s = np.full(len(arrival_s), -1), *np.full((2, len(arrival_s)), np.nan)
    for stop in stops:
        car, ended = int(stop.attrib["id"]), float(stop.get("ended", "-1"))
        slot[car] = int(stop.get("parkingArea", "slot-1").removeprefix("slot"))
        began_s[car] = float(stop.get("started", "nan"))
        left_s[car] = ended if ended >= 0.0 else np.inf
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return ParkedDay(began_s - arrival_s, slot, began_s, left_s, cpu_s)


def _metres_ahead(fleet: Fleet, street: Street) -> FloatArray:
    """Return the drive from the beginning of a street, through it, to each slot, (n_slots,) m."""
    scenario = fleet.scenario
    beyond: FloatArray = drive_times(scenario, street.reached)[: scenario.lot.n_slots] * scenario.v_drive
    metres = street.length + beyond
    for slot, along in street.slots:
        metres[slot] = along
    return metres


def _write_network(fleet: Fleet, streets: Sequence[Street], at: Path, folder: Path) -> None:
    xy, speed = fleet.scenario.lot.vertex_xy.tolist(), fleet.scenario.v_drive
    _write(
        at / "lot.nod.xml",
        "nodes",
        (
            f'<node id="{v}" x="{xy[v][0]:.3f}" y="{xy[v][1]:.3f}"/>'
            for v in sorted({v for street in streets for v in (street.start, street.end)})
        ),
    )
    _write(
        at / "lot.edg.xml",
        "edges",
        (
            f'<edge id="{s.name}" from="{s.start}" to="{s.end}" speed="{speed:.3f}" length="{s.length:.3f}"/>'
            for s in streets
        ),
    )
    # All turns of the drive graph and no other, also back at a corner, which netconvert would leave out.
    neighbors = fleet.scenario.lot.neighbors
    _write(
        at / "lot.con.xml",
        "connections",
        (
            f'<connection from="{a.name}" to="{b.name}" fromLane="0" toLane="0"/>'
            for a in streets
            for b in streets
            if a.end == b.start and b.first in neighbors[a.reached]
        ),
    )
    files = (
        "-n",
        at / "lot.nod.xml",
        "-e",
        at / "lot.edg.xml",
        "-x",
        at / "lot.con.xml",
        "-o",
        at / "lot.net.xml",
    )
    # Without lanes within junctions, routes have the lengths of the lot's drive graph.
    _run([folder / "netconvert", *files, "--no-internal-links", "true"])


def _write_parking(
    fleet: Fleet, streets: Sequence[Street], ahead_m: Mapping[str, FloatArray], path: Path
) -> None:
    lines = [
        f'<parkingArea id="slot{slot}" roadsideCapacity="{fleet.scenario.lot.capacity[slot]}" lane="{street.name}_0" '
        f'startPos="{max(along - _SHORT_M, 0.0):.3f}" endPos="{along:.3f}"/>'
        for street in streets
        for slot, along in street.slots
    ]
    for street in streets:
        nearest = np.argsort(ahead_m[street.name])[:ALTERNATIVES].tolist()
        places = "".join(f'<parkingAreaReroute id="slot{slot}" visible="false"/>' for slot in nearest)
        lines.append(
            f'<rerouter id="at{street.name}" edges="{street.name}"><interval begin="0" end="1000000">{places}'
            "</interval></rerouter>"
        )
    _write(path, "additional", lines)


def _write_trips(
    fleet: Fleet, streets: Sequence[Street], ahead_m: Mapping[str, FloatArray], path: Path, step_s: float
) -> None:
    weights = "".join(f'<param key="{name}" value="{value}"/>' for name, value in PARKING_WEIGHTS.items())
    lines = [
        f'<vType id="car" sigma="0" speedDev="0" speedFactor="1" length="4" minGap="0.5" tau="{step_s}" '
        f'accel="{_AT_ONCE}" decel="{_AT_ONCE}" emergencyDecel="{_AT_ONCE}">{weights}</vType>'
    ]
    of_slot = {slot: (street.name, along) for street in streets for slot, along in street.slots}
    first: dict[int, tuple[str, int]] = {}
    for entry in np.unique(fleet.cars["entry"]).tolist():
        begins = [street.name for street in streets if street.start == entry]
        start = min(begins, key=lambda name: float(ahead_m[name].min()))
        first[entry] = start, int(ahead_m[start].argmin())
    for number, car in enumerate(fleet.cars):
        start, slot = first[int(car["entry"])]
        to, along = of_slot[slot]
        # A route that ends in the parking area ends in each next one, too: nobody drives on from there.
        lines.append(
            f'<trip id="{number}" type="car" depart="{car["arrival"] - fleet.begin:.3f}" departSpeed="max" '
            f'from="{start}" to="{to}" arrivalPos="{along - _SHORT_M / 4:.3f}">'
            f'<stop parkingArea="slot{slot}" duration="{car["stay_s"]:.3f}"/></trip>'
        )
    _write(path, "routes", lines)


def _write(path: Path, tag: str, lines: Iterable[str]) -> None:
    path.write_text("\n".join([f"<{tag}>", *lines, f"</{tag}>", ""]), encoding="utf-8")


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
