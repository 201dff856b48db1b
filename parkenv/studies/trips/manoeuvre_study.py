"""Scenes of manoeuvres, planned and driven, and judged by their footprints."""

from __future__ import annotations

import dataclasses
import functools
from collections import Counter
from collections.abc import Callable, Sequence
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import numpy as np
from pydantic import BeforeValidator, Field, ValidationInfo

from parkenv.errors import require
from parkenv.files.known_names import SCENE_LEVELS
from parkenv.files.option import option, words_in
from parkenv.files.spec_file import Axis
from parkenv.show.tables import Column
from parkenv.studies.fields import Figures, Seed, Vehicle
from parkenv.studies.results import Results, Row, Table, fingerprints
from parkenv.studies.study import Cell, Labelled, Study
from parkenv.version import __version__

if TYPE_CHECKING:
    from parkenv.driving.scene import Scene
    from parkenv.studies.workers import Task
    from planners.driving.manoeuvre import Manoeuvre

_SCENE = ("agent", "case")
MANOEUVRES = Table(
    "manoeuvres.csv",
    _SCENE,
    (
        "planned", "driven", "contact", "clearance_m", "error_m", "error_rad", "time_s", "length_m",
        "direction_changes", "planning_s",
    ),
)  # fmt: skip
_STATE = ("x_m", "y_m", "yaw_rad", "speed_mps", "steering_rad")
TRAJECTORIES = Table("trajectories.csv", _SCENE, ("time_s", *_STATE), long=True)
ROAD_USERS = Table("road_users.csv", _SCENE, ("time_s", "user", *_STATE[:3]), long=True)
SHEET = 12  # greatest number of scenes on a picture


def _there(value: object, info: ValidationInfo) -> object:
    folder = (info.context or {}).get("folder", Path())
    return (Path(folder) / Path(value).expanduser()).absolute() if isinstance(value, str | Path) else value


class ManoeuvreStudy(Study):
    """On lots it writes pictures of one successful episode per kind of slot and orientation, and an animation of one.

    It also draws failures, if any.

    With --cases or --levels, every scene is planned, driven within the car's limits, and checked with footprints 2 cm
    apart against the exact obstacles: no contact, and an end within 0.05 m and 0.01 rad of the target. The command
    writes manoeuvres.csv, trajectories.csv (the middle of the rear axle every 0.05 s) and pictures of all scenes.
    """

    table: ClassVar = MANOEUVRES
    further_tables: ClassVar = (TRAJECTORIES, ROAD_USERS)
    block: ClassVar = 4
    doing: ClassVar = "Parking"
    unit: ClassVar = "scenes"
    heading: ClassVar = "Manoeuvres"
    columns: ClassVar = (
        Column("lot", "lot"),
        Column("agent", "agent"),
        Column("kind", "kind"),
        Column("way", "way"),
        Column("case", "case"),
        Column("episodes", "searches", digits=0, setting=True),
        Column("parked", "parked", digits=0),
        Column("success", "successful parkings", share=True),
        Column("planned", "planned"),
        Column("driven", "driven"),
        Column("contact", "contact"),
        Column("clearance_m", "smallest clearance", "m", 3),
        Column("error_m", "error at the end", "m", 3),
        Column("error_rad", "error at the end", "rad", 4),
        Column("time_s", "time", "s", 3),
        Column("length_m", "distance driven", "m"),
        Column("direction_changes", "changes of direction", digits=0),
        Column("planning_s", "planning", "s", 3),
    )
    table_titles: ClassVar = {"rows": "Results", "levels": "Levels"}
    shown: ClassVar = {"rows": (), "levels": ()}
    writes: ClassVar = "pictures, episodes.csv and summary.json"
    examples: ClassVar = """
        parkenv park --episodes 250 --scenario campus,street,jam
        parkenv park --lot parking_map.yml --way back-in
        parkenv park --cases tpcap --vehicle tpcap --out results/tpcap
        parkenv park --levels parallel-extreme,oblique-complex --episodes 10
        """

    kind: Literal["park"] = "park"
    cases: Annotated[Path | None, BeforeValidator(_there)] = option(
        None,
        "A scene, or a folder of scenes: TPCAP's CSV, ParkBench's JSON, or our own (.toml, .json).",
        takes="DIR|FILE",
        default="none",
        panel="Scenes",
    )
    levels: Axis[str] | None = option(
        None,
        "Levels of scenes to draw: perpendicular, oblique or parallel, and normal, complex or "
        "extreme, for example parallel-extreme.",
        takes="NAME[,...]|all",
        default="none",
        panel="Scenes",
        parse=lambda text: SCENE_LEVELS if text == "all" else words_in(text),
    )
    episodes: int = option(100, "Episodes per lot, or scenes per level.", short="-n", ge=1, le=1_000_000)
    vehicle: Vehicle = None
    seed: Seed = Field(0, description="First seed; episode or scene i uses seed + i.")
    figures: Figures = True

    @cached_property
    def sources(self) -> dict[str, Path | tuple[str, int]]:
        from parkenv.driving.scene_files import scene_files

        if self.cases is not None:
            return {file.stem: file for file in scene_files(self.cases)}
        seeds = range(self.seed, self.seed + self.episodes)
        return {f"{level}-{seed}": (level, seed) for level in self.levels or () for seed in seeds}

    def scene(self, name: str) -> Scene:
        from parkenv.driving.levels import level_scene
        from parkenv.driving.scene_files import read_scene

        source = self.sources[name]
        if isinstance(source, Path):
            return read_scene(source, self.vehicle)
        return level_scene(*source, self.vehicle)

    def check(self) -> None:
        require(
            (self.cases is None) != (self.levels is None),
            "cases and levels exclude each other: want one of them",
        )
        for name in self.sources if self.cases else (f"{level}-{self.seed}" for level in self.levels or ()):
            self.scene(name)

    def settings(self) -> Row:
        return {"version": __version__, **self.tables(), "files": fingerprints(self.files())}

    def files(self) -> list[Path]:
        scenes = [source for source in self.sources.values() if isinstance(source, Path)]
        return [file for file in super().files() if file != self.cases] + scenes

    def cells(self) -> list[Cell]:
        return [Cell(Labelled({"agent": "planner"}), list(self.sources))]

    def run(self, work: Labelled, items: Sequence[str]) -> list[Row]:
        from planners.driving.manoeuvre import park

        _warm()
        return [manoeuvre_row(work.columns | {"case": name}, park(self.scene(name))) for name in items]

    def summarise(self, results: Results) -> Row:
        names = (*MANOEUVRES.keys, *MANOEUVRES.columns)
        rows = [{name: row[name] for name in names} for row in self.all_rows(results)]
        levels = {
            name: "cases" if isinstance(source, Path) else source[0] for name, source in self.sources.items()
        }
        cars = Counter(self.scene(name).vehicle for name in dict.fromkeys(row["case"] for row in rows))
        return {
            "levels": level_table(rows, levels.__getitem__),
            "agents": level_table(rows, lambda _: "all"),
            "vehicles": [{"scenes": n, **dataclasses.asdict(car)} for car, n in cars.items()],
            "rows": rows,
        }

    @classmethod
    def findings(cls, summary: Row) -> list[str]:
        return [
            f"{row['agent']}: {row['driven']} of {row['scenes']} scenes were driven to their target without a contact, "
            f"within 5 cm and 0.01 rad. Planning took {row['planning_ms']:.0f} ms (median), "
            f"{row['planning_ms_p95']:.0f} ms (95 %), at most {row['planning_ms_max']:.0f} ms."
            for row in summary.get("agents", ())
        ]

    def outputs(self, results: Results, summary: Row) -> list[Task[object]]:
        from parkenv.show.figures.manoeuvres import save_manoeuvre_film, save_manoeuvres

        rows = sorted(summary["rows"], key=lambda row: row["driven"])
        driven = results.rows(TRAJECTORIES)
        shown = [
            (self.scene(row["case"]), driven[MANOEUVRES.key(row)], self._says(row))
            for row in rows[: 5 * SHEET]
        ]
        tasks: list[Task[object]] = [
            partial(save_manoeuvres, shown[i : i + SHEET], results.path / f"manoeuvres_{i // SHEET + 1}.png")
            for i in range(0, len(shown), SHEET)
        ]
        if parked := [row for row in rows if row["driven"]]:
            scenes = {row["case"]: self.scene(row["case"]) for row in parked}
            # Where others move, if anywhere.
            row = max(parked, key=lambda row: (len(scenes[row["case"]].crossings), row["direction_changes"]))
            others = results.rows(ROAD_USERS).get(MANOEUVRES.key(row), {})
            what = scenes[row["case"]], driven[MANOEUVRES.key(row)], others
            tasks.append(partial(save_manoeuvre_film, *what, results.path / "manoeuvre.gif"))
        return tasks

    def _says(self, row: Row) -> str:
        if row["driven"]:
            n = row["direction_changes"]
            times = f"{row['time_s']:.1f} s, {n} change{'' if n == 1 else 's'}"
            clear = row["clearance_m"]
            return times if clear is None or np.isnan(clear) else f"{times}, {100 * clear:.0f} cm clear"
        return "no path" if not row["planned"] else "contact" if row["contact"] else "not at the target"


def manoeuvre_row(keys: Row, manoeuvre: Manoeuvre) -> Row:
    """Return the row of a manoeuvre, with those of its trajectory and of road users, in the frame of its file."""
    from parkenv.driving.vehicle import PHYSICS_S

    judged = manoeuvre.judged._asdict()
    if np.isinf(judged["clearance_m"]):  # there is no obstacle
        judged["clearance_m"] = np.nan
    lines = manoeuvre.states[:, : len(_STATE)].round(7)
    lines[:, :2] += manoeuvre.scene.origin
    time, others = [round(PHYSICS_S * i, 2) for i in range(len(lines))], dict[str, Row]()
    if manoeuvre.others is not None:
        users, n = manoeuvre.others.round(7).reshape(-1, 3), manoeuvre.others.shape[1]
        users[:, :2] += manoeuvre.scene.origin
        named = {"time_s": [at for at in time for _ in range(n)], "user": list(range(n)) * len(time)}
        named |= dict(zip(_STATE[:3], users.T.tolist(), strict=True))
        others[ROAD_USERS.file] = keys | named
    return {
        **keys,
        "planned": manoeuvre.path is not None,
        **judged,
        "time_s": manoeuvre.time_s,
        "length_m": manoeuvre.length_m,
        "direction_changes": manoeuvre.direction_changes,
        "planning_s": manoeuvre.planning_s,
        TRAJECTORIES.file: {**keys, "time_s": time, **dict(zip(_STATE, lines.T.tolist(), strict=True))},
        **others,
    }


def level_table(rows: Sequence[Row], level: Callable[[str], str]) -> list[Row]:
    """Summarise rows of `MANOEUVRES`: a row for each agent and each of its levels, of which `level` names a case's."""
    from parkenv.studies.statistics import success_columns

    groups: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((row["agent"], level(row["case"])), []).append(row)
    table = list[Row]()
    for (agent, name), group in groups.items():
        driven, planning = [row for row in group if row["driven"]], [1e3 * row["planning_s"] for row in group]
        medians = {
            key: float(np.median([row[key] for row in driven])) if driven else np.nan
            for key in ("time_s", "length_m", "direction_changes")
        }
        table.append({
            "agent": agent, "level": name, "scenes": len(group), "planned": sum(row["planned"] for row in group),
            "driven": len(driven), **success_columns("success", len(driven), len(group)),
            "contacts": sum(row["contact"] for row in group), **medians, "planning_ms": float(np.median(planning)),
            "planning_ms_p95": float(np.quantile(planning, 0.95)), "planning_ms_max": max(planning),
        })  # fmt: skip
    return table


@functools.cache
def _warm() -> None:
    """Plan and drive once, so that the times of the others do not include loading compiled code."""
    from parkenv.driving.levels import level_scene
    from planners.driving.manoeuvre import park

    park(level_scene(SCENE_LEVELS[-1], 0))
