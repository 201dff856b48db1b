"""`parkenv map-drive`, `map`, `sensors` and `fit-sensor-model`: recorded drives, maps and simulated sensors."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, get_args

from pydantic import AfterValidator, Field
from pydantic.fields import FieldInfo

from parkenv.cli.options import Command
from parkenv.cli.tables import print_rows, print_table, save_summary, stages
from parkenv.errors import require
from parkenv.files.atomic_write import make_folder
from parkenv.files.csv_tables import write_csv
from parkenv.files.known_names import SCENARIO_NAMES, WEATHERS, LocaliserName, RigName, WeatherName
from parkenv.files.option import Inside, Option, option, words_in
from parkenv.files.spec_file import Axis, Several
from parkenv.mapping.recordings.photo_options import PhotoOptions
from parkenv.scenarios.spec import scenario_spec
from parkenv.show.tables import Column, plural, table_of
from parkenv.studies.fields import PRICES, TRAFFIC, Detector, OneScenario, Scenarios, Seed, with_traffic
from parkenv.studies.sensing.survey_study import COLUMNS
from parkenv.studies.study import ExecutionSpec, counted
from parkenv.world.occupancy.arrival_window import DAY_NAMES
from parkenv.world.week import DAY_S, HOUR_S

if TYPE_CHECKING:
    from parkenv.studies.results import Row
    from parkenv.world.scenario import Scenario

_OPTIONS_OF_SCENARIO = [mark for mark in get_args(OneScenario) if isinstance(mark, Option | FieldInfo)]
MOST_ROWS = 12  # slots in the table of a map; files have all


class MapDrive(Command):
    """A recording names its sensors (`CameraInfo`, TF, KITTI's calibration), or a calibration file does.

    For photographs or a film with poses, distances follow from the boxes: from the ground and a car's size.

    With --discover, no lot is needed: rows of parked cars become the slots of a new one, lot.geojson in the folder.
    Later drives into the same folder refine it.
    """

    examples = """
        parkenv survey --scenario mini --sessions 1 --record drive.mcap
        parkenv map-drive drive.mcap --scenario mini --out results/drive
        parkenv map-drive bag.mcap --lot lot.geojson --calibration car.toml
        parkenv map-drive photos/ --lot lot.geojson --fov 68 --detector net
        parkenv map-drive drive.mp4 --poses track.gpx --lot lot.geojson --fov 90
        parkenv map-drive mon.mcap tue.mcap --discover --calibration car.toml
        """

    recordings: Several[Path] = option(
        ...,
        "A folder of photographs, of a drive or of KITTI, or a film; or (extra bags) an MCAP file, or a rosbag of "
        "ROS 2 (folder, .db3) or ROS 1 (.bag). Several with --discover.",
        name="RECORDING",
        takes="FILE|DIR",
        argument=True,
        min_length=1,
    )
    scenario: Annotated[OneScenario | None, *_OPTIONS_OF_SCENARIO, Inside(only=())] = None
    discover: bool = option(False, "Make a lot from the parked cars that the drives have passed.")
    streets: Path | None = option(
        None,
        "With --discover: a map whose streets are the lanes (OpenStreetMap; extra osm).",
        takes="FILE",
        default="where the drives went",
    )
    calibration: Path | None = option(
        None, "Sensors, mounts and topics (.toml).", default="those of the recording"
    )
    every: float = option(0.0, "Least distance between captures, m.", takes="M", ge=0.0)
    detector: Detector = None
    localise: LocaliserName = option("none", "scan-matching: the poses are drifting odometry; correct them.")
    photos: PhotoOptions = PhotoOptions()
    out: Path = option(
        Path("results/drive"),
        "Folder for map.sqlite, to which the session is added, map.png and map.yaml (the occupancy grid, for Nav2), "
        "slots.geojson, slots.png, cars.csv, sightings.csv and summary.json.",
        short="-o",
    )

    def run(self) -> None:
        from parkenv.mapping.recordings.calibration import DriveCalibration
        from parkenv.perception.detector_registry import make_detector
        from parkenv.scenarios.build import build
        from parkenv.studies.sensing.recorded_session import DriveReader, add_recording, discover_recordings

        require(
            not (self.discover and self.scenario), "--discover makes a lot; want no --lot and no --scenario"
        )
        require(self.discover or self.streets is None, "--streets is of --discover")
        require(self.discover or len(self.recordings) == 1, "several recordings are of --discover, want one")
        scenario = None if self.scenario is None else build(self.scenario)
        with stages(self.console, "captures") as progress:
            reader = DriveReader(
                make_detector(self.detector or (scenario.detector if scenario else "hog")),
                None if self.calibration is None else DriveCalibration.read(self.calibration),
                self.every,
                self.localise,
                self.photos,
                progress,
            )
            if self.discover:
                rows = discover_recordings(self.recordings, self.out, reader, streets=self.streets)
            else:
                lot_file = self.scenario.lot.file if self.scenario else None
                rows = [add_recording(self.recordings[0], scenario, self.out, reader, lot_file=lot_file)]
        save_summary(self.out, None, rows)
        for row in rows:
            print_table(self.console, table_of("", "The drive", [row], COLUMNS, facts=True))
            self._warn(row, scenario)
        lot = "lot.geojson, " if self.discover else ""
        written = "map.png, map.yaml, slots.geojson, slots.png, cars.csv, sightings.csv, summary.json"
        self.say(f"Written: {self.out / 'map.sqlite'}, {lot}{written}")

    def _warn(self, row: Row, scenario: Scenario | None) -> None:
        driven_in = row["key"].partition("/")[0]
        if scenario and driven_in in SCENARIO_NAMES and driven_in != scenario.name:
            text = f"The drive was recorded in {driven_in}, and is mapped in {scenario.name}: see --scenario"
            self.say(text, style="yellow")
        if not row["seen"]:
            why = f": poses ± {row['pose_error_m']:.2g} m; see --pose-error" if "pose_error_m" in row else ""
            self.say(f"No slot could be identified{why}", style="yellow")


class Map(Command):
    """The predictions are for a weekday and hour, or over all sessions."""

    examples = """
        parkenv map results/survey/map.sqlite --weekday tue --hour 9.5
        parkenv map results/survey/map.sqlite --out results/map
        """

    map_file: Path = option(..., "A map file of `parkenv survey`.", name="FILE", argument=True)
    scenario: Annotated[OneScenario, Inside(only=())] = scenario_spec("campus")
    weekday: Literal["mon", "tue", "wed", "thu", "fri", "sat", "sun"] | None = option(
        None, "mon, tue, ..., sun.", takes="DAY", default="the mean over all sessions"
    )
    hour: float = option(9.0, "Hour of the day, with --weekday.", takes="H", ge=0, le=24)
    out: Path | None = option(
        None, "Folder for map.png, slots.csv, summary.json.", short="-o", default="none"
    )

    def run(self) -> None:
        from parkenv.mapping.inference import predict
        from parkenv.mapping.store import MapStore
        from parkenv.scenarios.build import build
        from parkenv.show.figures.survey import save_map

        scenario, hour = build(self.scenario), self.hour
        lot = scenario.lot
        with MapStore(self.map_file, lot, create=False) as store:
            log = store.log()
        time, when = None, "over all sessions"
        if self.weekday is not None:
            time = DAY_NAMES.index(self.weekday) * DAY_S + min(hour * HOUR_S, DAY_S - 1.0)
            when = f"{self.weekday} {int(hour):02d}:{int(hour % 1 * 60):02d}"
        predicted = predict(log, time)
        rows = [
            {
                "slot": name,
                "p_occupied": float(predicted.p_occupied[i]),
                "low": float(predicted.low[i]),
                "high": float(predicted.high[i]),
                "sessions": int(predicted.sessions[i]),
            }
            for i, name in enumerate(lot.slot_ids)
        ]
        free = sorted(rows, key=lambda row: float(str(row["p_occupied"])))[:MOST_ROWS]
        print_rows(self.console, f"{scenario.name}, {when}, {plural(len(log.time), 'session')}", free)
        if len(rows) > MOST_ROWS:
            self.say(f"The {MOST_ROWS} most likely free of {len(rows)}; --out writes all.")
        if self.out is not None:
            make_folder(self.out)
            save_map(lot, predicted, None, f"{scenario.name}, {when}", self.out / "map.png")
            write_csv(self.out / "slots.csv", list(rows[0]), rows)
            save_summary(self.out, None, rows)
            self.say(f"Written: {self.out / 'map.png'}, slots.csv, summary.json")


UP_TO = Column("up_to", "slots up to", "m")
_OBSERVATIONS = ("--sensor-model", "--view-range", *PRICES)


class Preview(Command):
    """Each figure shows the measurements of all sensors in one weather, at the place with the most parked cars.

    It shows the side camera's image with the true boxes, its depth, the stereo camera's disparity, and the laser scan
    from above.
    """

    examples = """
        parkenv sensors preview
        parkenv sensors preview --scenario street --weather dusk
        """

    scenario: Annotated[OneScenario, AfterValidator(with_traffic), Inside(without=_OBSERVATIONS)] = Field(
        scenario_spec("campus"), validate_default=True
    )
    weather: Axis[WeatherName] = option(
        get_args(WeatherName),
        f"Some of {', '.join(WEATHERS)}.",
        takes="NAME[,...]|all",
        default="all",
        parse=lambda t: WEATHERS if t == "all" else words_in(t),
    )
    seed: Seed = 0
    out: Path = option(Path("results/sensors"), "Folder for the pictures.", short="-o")

    def run(self) -> None:
        from parkenv.scenarios.build import build
        from parkenv.studies.sensing.simulated_sensors import preview_sensors

        self.say("The first image after an installation waits about 20 s for the renderer to be compiled.")
        with stages(self.console) as progress:
            preview_sensors(build(self.scenario), self.out, self.weather, seed=self.seed, progress=progress)
        self.say(f"Images are in {self.out}")


class FitSensorModel(Command, ExecutionSpec):
    """The rates define a sensor model for `parkenv compare --sensor-model FILE`.

    The model has the same error rates as the perception pipeline, and is a thousand times as fast.
    """

    examples = """
        parkenv fit-sensor-model --rig stereo --out stereo.json
        parkenv compare --sensor-model stereo.json
        """

    scenarios: Annotated[Scenarios, Inside(without=(*_OBSERVATIONS, *TRAFFIC))] = (
        scenario_spec("campus"),
        scenario_spec("street"),
    )
    episodes: int = option(
        20, "Episodes of each of three agents in each scenario.", short="-n", ge=1, le=1_000_000
    )
    rig: RigName | None = option(
        None, "Detector whose errors are measured.", panel="Sensors", default="the scenario's, laser"
    )
    detector: Detector = None
    weather: WeatherName | None = option(
        None, f"{', '.join(WEATHERS)}.", takes="NAME", panel="Sensors", default="drawn each time"
    )
    seed: Seed = 500_000
    out: Path = option(Path("sensor_model.json"), "The file to write.", short="-o", takes="FILE.json")

    def run(self) -> None:
        from parkenv.scenarios.build import build
        from parkenv.studies.sensing.simulated_sensors import AGENTS, fitted_model, measure_sensors

        specs = [with_traffic(spec) for spec in self.scenarios]
        scenarios, rig = [build(spec) for spec in specs], self.rig or specs[0].rig
        make_folder(self.out.parent)
        with self.workers() as workers, stages(self.console, "episodes") as progress:
            total = self.episodes * len(AGENTS) * len(scenarios)
            counts = measure_sensors(
                scenarios,
                rig,
                self.episodes,
                seed=self.seed,
                weather=self.weather,
                detector=self.detector,
                workers=workers,
                on_progress=counted(progress, "Searching with simulated sensors", total),
            )
        model = fitted_model(counts)
        model.to_file(self.out)
        in_range = counts.reshape(-1, 2, 3).sum(axis=(1, 2)).tolist()
        rows = [{**asdict(band), "slots_in_range": n} for band, n in zip(model.bands, in_range, strict=True)]
        print_rows(self.console, f"Observations of slots, rig {rig}", rows, columns=(UP_TO,))
        self.say(f"Written: {self.out}")
