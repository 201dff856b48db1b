"""Parking by the planner on lots: its episodes, their table, pictures and a film."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, fields
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, cast

import gymnasium as gym
import numpy as np

from parkenv.driving.parking_task import DriveState
from parkenv.driving.vehicle import STEERING, YAW, VehicleParameters
from parkenv.envs.drive import DriveEnv
from parkenv.files.csv_tables import write_csv
from parkenv.show.figures.manoeuvres import save_sheet
from parkenv.show.figures.picture_files import save_film
from parkenv.show.frames.drive import DriveRenderer
from parkenv.studies.results import Row
from parkenv.studies.simulate import FrameRecorder, Observer, Step, simulate
from parkenv.studies.statistics import success_columns
from parkenv.studies.study import Progress
from parkenv.studies.workers import SERIAL, Workers
from parkenv.world.lot import ParkingLot
from planners.agent import Agent
from planners.driving.parking import ParkingAgent, ParkingMemory

CHUNK = 25  # episodes per task of a worker
SHOWN_FAILURES = 6
PLANNER = ParkingAgent.name


@dataclass(frozen=True)
class ParkingCase:
    lot: ParkingLot
    kinds: tuple[str, ...] | None = None  # kinds of slots; None for all kinds on the lot
    ways: tuple[str, ...] = ("nose-in", "back-in")  # orientations in perpendicular and oblique slots
    occupancy: float = 0.85  # fraction of the other slots that are occupied
    slack: float = 0.0  # distance around the slot kept clear of parked cars, m
    vehicle: VehicleParameters = field(default_factory=VehicleParameters)

    def environment(self, render_mode: str | None = None) -> gym.Env[Any, Any]:
        options: dict[str, Any] = {each.name: getattr(self, each.name) for each in fields(self)}
        options |= {"obstacle_map": True, "render_mode": render_mode, "disable_env_checker": True}
        return gym.make("parkenv/Drive-v1", **options)


class Parking(NamedTuple):
    row: Row  # metrics of the episode
    state: DriveState  # final state of the episode, with the driven trail
    frames: list[Any] = []  # noqa: RUF012 - never changed; rendered frames, if requested


class _MotionRecorder(Observer):
    def on_reset(self, env: gym.Env[Any, Any], observation: Any) -> None:
        self.drive, self.motion = cast("DriveEnv", env.unwrapped), list[tuple[float, float]]()
        self._record()

    def on_step(self, step: Step) -> None:
        self._record()

    def _record(self) -> None:
        vehicle = self.drive.state.vehicle
        self.motion.append((float(vehicle[STEERING]), float(vehicle[YAW])))


def park_once(env: gym.Env[Any, Any], agent: Agent, seed: int, *, every: int = 0) -> Parking:
    """Run one episode of `parkenv/Drive-v1`; with frames, `every` so many steps, of `render_mode="rgb_array"`.

    In its row, `contact` is what was touched, `wheel_rad` and `turned_rad` are total changes of steering angle and
    heading, and `planning_s` is that of all plans.
    """
    recorder = _MotionRecorder()
    film = [FrameRecorder(every)] if every else []
    result = simulate(env, agent, seed, (recorder, *film))
    info, memory, state = result.info, result.memory, recorder.drive.state
    task, (wheel, heading) = state.task, zip(*recorder.motion, strict=True)
    row = {
        "lot": task.lot,
        "seed": seed,
        "kind": task.kind,
        "way": task.way if task.kind != "parallel" else "",
        "slot": task.slot_id,
        "parked": bool(info["is_success"]),
        "reason": state.contact or ("" if info["is_success"] else "out of time"),
        "contact": state.contact,
        **{k: info[k] for k in ("time_s", "driven_m", "direction_changes", "position_error_m")},
        "angle_error_deg": float(np.degrees(info["angle_error_rad"])),
        "wheel_rad": float(np.abs(np.diff(wheel)).sum()),
        "turned_rad": float(np.abs(np.diff(heading)).sum()),
        "decision_ms": 1e3 * sum(result.decision_s) / result.steps,
    }
    if isinstance(memory, ParkingMemory):
        first = memory.paths[0] if memory.paths else None
        row |= {
            "plans": len(memory.planning_s),
            "planning_s": sum(memory.planning_s),
            "first_planning_s": memory.planning_s[0],
            "path_m": first.driven_m if first else np.nan,
            "expansions": sum(p.expansions for p in memory.paths),
            "margin_m": first.margin if first else np.nan,
        }
        if not row["parked"] and not state.contact and memory.reason:
            row["reason"] = memory.reason
    return Parking(row, state, film[0].frames if film else [])


def park_all(
    cases: Sequence[ParkingCase], seeds: Sequence[int], workers: Workers = SERIAL
) -> Iterator[list[Parking]]:
    """Park with every seed of every case by the planner; yield the parkings in order, for any number of workers."""
    parts = [seeds[i : i + CHUNK] for i in range(0, len(seeds), CHUNK)]
    yield from workers.in_order([partial(_park_some, case, part) for case in cases for part in parts])


def _park_some(case: ParkingCase, seeds: Sequence[int]) -> list[Parking]:
    env, agent = case.environment(), ParkingAgent(case.vehicle)
    return [park_once(env, agent, seed) for seed in seeds]


def parking_table(rows: Sequence[Row]) -> list[Row]:
    """Summarise parkings: one row per kind of slot and way of parking, and one for all (`kind` "all")."""
    groups: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((row["kind"], row["way"]), []).append(row)
    table = [_summary(kind, way, groups[kind, way]) for kind, way in sorted(groups)]
    return [*table, _summary("all", "", rows)] if rows else []


def _summary(kind: str, way: str, rows: Sequence[Row]) -> Row:
    parked = [row for row in rows if row["parked"]]
    columns = {
        "planning_ms": [1e3 * row["first_planning_s"] for row in rows if "first_planning_s" in row],
        "time_s": [row["time_s"] for row in parked],
        "direction_changes": [row["direction_changes"] for row in parked],
    }
    quantiles: Row = {}
    for name, values in columns.items():
        quantiles[name] = float(np.median(values)) if values else np.nan
        quantiles[f"{name}_p95"] = float(np.quantile(values, 0.95)) if values else np.nan
    means = ("driven_m", "wheel_rad", "turned_rad", "position_error_m", "angle_error_deg")
    return {
        "kind": kind,
        "way": way,
        "episodes": len(rows),
        "parked": len(parked),
        **success_columns("success", len(parked), len(rows)),
        "contacts": sum(bool(row["contact"]) for row in rows),
        **quantiles,
        **{name: float(np.mean([row[name] for row in parked])) if parked else np.nan for name in means},
    }


def park_on_lots(
    cases: Sequence[ParkingCase],
    seeds: Sequence[int],
    folder: Path,
    *,
    workers: Workers = SERIAL,
    progress: Progress = lambda *_: None,
) -> tuple[list[Row], list[Row]]:
    """Park with all seeds on all lots; write episodes.csv and pictures; return its rows and the `parking_table`."""
    for case in cases:
        case.environment().close()
    total, parkings = len(cases) * len(seeds), list[Parking]()
    progress("Parking", 0, total)
    for block in park_all(cases, seeds, workers):
        parkings += block
        progress("Parking", len(parkings), total)
    rows = [{"agent": PLANNER, **p.row} for p in parkings]
    write_csv(folder / "episodes.csv", list(dict.fromkeys(name for row in rows for name in row)), rows)
    _draw(parkings, {case.lot.name: case for case in cases}, folder)
    return rows, [{"agent": PLANNER, **row} for row in parking_table([p.row for p in parkings])]


def _draw(parkings: Sequence[Parking], cases: dict[str, ParkingCase], folder: Path) -> None:
    """Draw the first success of each kind of slot and way, failures, and a film of the success with most changes."""
    first = {(p.row["kind"], p.row["way"]): p for p in reversed(parkings) if p.row["parked"]}
    successes = [first[key] for key in sorted(first)]
    failures = [p for p in parkings if not p.row["parked"]][:SHOWN_FAILURES]
    for shown, name in ((successes, "parkings.png"), (failures, "failures.png")):
        if shown:
            frames = [DriveRenderer(cases[p.row["lot"]].lot).frame(p.state) for p in shown]
            save_sheet(frames, folder / name)
    if successes:
        row = max((p.row for p in successes), key=lambda row: row["direction_changes"])
        case = cases[row["lot"]]
        env, agent = case.environment("rgb_array"), ParkingAgent(case.vehicle)
        save_film(park_once(env, agent, row["seed"], every=2).frames, folder / "parking.gif", fps=10.0)
