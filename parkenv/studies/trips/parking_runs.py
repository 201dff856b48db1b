"""Run parking episodes and summarise them in a table."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import numpy as np
from scipy.stats import binomtest

from parkenv.driving.drive_state import DriveState
from parkenv.driving.vehicle import STEERING, YAW, VehicleParameters
from parkenv.envs.drive import DriveEnv
from parkenv.files.csv_tables import write_csv
from parkenv.studies.simulate import FrameRecorder, Observer, Step, simulate
from parkenv.studies.workers import SERIAL, Workers
from parkenv.world.lot import ParkingLot
from planners.agent import Agent
from planners.driving.parking import ParkingAgent, ParkingMemory

CHUNK = 25  # episodes per task of a worker


@dataclass(frozen=True)
class ParkingCase:
    """A parking task distribution on one lot."""

    lot: ParkingLot
    kinds: tuple[str, ...] | None = None  # kinds of slots; None for all kinds on the lot
    ways: tuple[str, ...] = ("nose-in", "back-in")  # orientations in perpendicular and oblique slots
    occupancy: float = 0.85  # fraction of the other slots that are occupied
    slack: float = 0.0  # distance around the slot kept clear of parked cars, m
    vehicle: VehicleParameters = field(default_factory=VehicleParameters)

    def environment(self, render_mode: str | None = None) -> gym.Env[Any, Any]:
        """Make `parkenv/Drive-v1` with the obstacle map."""
        return gym.make(
            "parkenv/Drive-v1",
            lot=self.lot,
            kinds=self.kinds,
            ways=self.ways,
            occupancy=self.occupancy,
            slack=self.slack,
            vehicle=self.vehicle,
            obstacle_map=True,
            render_mode=render_mode,
            disable_env_checker=True,
        )


@dataclass
class Parking:
    """Result of one parking episode."""

    row: dict[str, Any]  # metrics of the episode
    state: DriveState  # final state of the episode, with the driven trail
    frames: list[Any] = field(default_factory=list)  # rendered frames, if requested


class _MotionRecorder(Observer):
    """Record steering angle and heading at the start and after every step."""

    def __init__(self) -> None:
        self.steering: list[float] = []
        self.yaws: list[float] = []

    def on_reset(self, env: gym.Env[Any, Any], observation: Any) -> None:
        """Record the start."""
        del observation
        self.drive = cast(DriveEnv, env.unwrapped)
        self._record()

    def on_step(self, step: Step) -> None:
        """Record the step."""
        del step
        self._record()

    def _record(self) -> None:
        vehicle = self.drive.state.vehicle
        self.steering.append(float(vehicle[STEERING]))
        self.yaws.append(float(vehicle[YAW]))


def park_once(env: gym.Env[Any, Any], agent: Agent, seed: int, *, every: int = 0) -> Parking:
    """Run one parking episode.

    Args:
        env: `parkenv/Drive-v1`; with `render_mode="rgb_array"` for pictures.
        agent: the parking agent.
        seed: seed of the task.
        every: steps between frames; 0 for none.

    Returns:
        A row with lot, seed, kind, way, slot, parked, reason (of a failure), contact (what was touched), time_s,
        driven_m, direction_changes, wheel_rad and turned_rad (total change of steering angle and heading),
        position_error_m,
        angle_error_deg; for a planner also plans, planning_s (all plans), path_m, expansions, margin_m.
    """
    recorder = _MotionRecorder()
    film = [FrameRecorder(every)] if every else []
    result = simulate(env, agent, seed, (recorder, *film))
    info, memory, drive = result.info, result.memory, recorder.drive
    state: DriveState = drive.get_state()[1]
    task = state.task
    reason = info["contact"] or ("" if info["is_success"] else "out of time")
    row = {
        "lot": task.lot,
        "seed": seed,
        "kind": task.kind,
        "way": task.way if task.kind != "parallel" else "",
        "slot": task.slot_id,
        "parked": bool(info["is_success"]),
        "reason": reason,
        "contact": info["contact"],
        **{k: info[k] for k in ("time_s", "driven_m", "direction_changes", "position_error_m")},
        "angle_error_deg": float(np.degrees(info["angle_error_rad"])),
        "wheel_rad": float(np.abs(np.diff(recorder.steering)).sum()),
        "turned_rad": float(np.abs(np.diff(recorder.yaws)).sum()),
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
        if not row["parked"] and not info["contact"] and memory.reason:
            row["reason"] = memory.reason
    return Parking(row, state, film[0].frames if film else [])


def park_all(
    cases: Sequence[ParkingCase],
    seeds: Sequence[int],
    workers: Workers = SERIAL,
) -> Iterator[list[Parking]]:
    """Park with every seed of every case by the planner; yield the parkings in order.

    Results do not depend on the number of workers; only wall times differ from run to run.

    Args:
        cases: the tasks.
        seeds: seeds of the tasks.
        workers: where the episodes run.
    """
    parts = [seeds[i : i + CHUNK] for i in range(0, len(seeds), CHUNK)]
    yield from workers.in_order([partial(_park_some, case, part) for case in cases for part in parts])


def _park_some(case: ParkingCase, seeds: Sequence[int]) -> list[Parking]:
    env, agent = case.environment(), ParkingAgent(case.vehicle)
    return [park_once(env, agent, seed) for seed in seeds]


def parking_table(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Summarise parkings: one row per kind of slot and way of parking, and one for all (`kind` "all").

    Returns:
        kind, way, episodes, parked, success and its 95 % interval (Wilson), contacts; median and p95 of planning_ms
        (the first plan), time_s and direction_changes; means of driven_m, wheel_rad, turned_rad.
    """
    groups: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for row in rows:
        groups.setdefault((row["kind"], row["way"]), []).append(row)
    table = [_summary(kind, way, groups[kind, way]) for kind, way in sorted(groups)]
    return [*table, _summary("all", "", rows)] if rows else []


def write_parkings(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Write rows of parkings as CSV, atomically."""
    columns = list(dict.fromkeys(name for row in rows for name in row))
    write_csv(path, columns, rows)


def _summary(kind: str, way: str, rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    parked = [row for row in rows if row["parked"]]
    interval = binomtest(len(parked), len(rows)).proportion_ci(0.95, "wilson")
    summary: dict[str, Any] = {
        "kind": kind,
        "way": way,
        "episodes": len(rows),
        "parked": len(parked),
        "success": len(parked) / len(rows),
        "success_ci95": [float(interval.low), float(interval.high)],
        "contacts": sum(bool(row["contact"]) for row in rows),
    }
    columns = {
        "planning_ms": [1e3 * row["first_planning_s"] for row in rows if "first_planning_s" in row],
        "time_s": [row["time_s"] for row in parked],
        "direction_changes": [row["direction_changes"] for row in parked],
    }
    for name, values in columns.items():
        summary[name] = float(np.median(values)) if values else np.nan
        summary[f"{name}_p95"] = float(np.quantile(values, 0.95)) if values else np.nan
    for name in ("driven_m", "wheel_rad", "turned_rad", "position_error_m", "angle_error_deg"):
        summary[name] = float(np.mean([row[name] for row in parked])) if parked else np.nan
    return summary
