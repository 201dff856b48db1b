"""`parkenv detect`, `train-detector`, `evaluate-detector`: car detection in images."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Self, get_args

from pydantic import Field, model_validator
from pydantic_core import PydanticCustomError

from parkenv.cli.options import Command
from parkenv.cli.study_command import StudyCommand
from parkenv.cli.tables import make_console, make_table, print_rows, save_summary, stages
from parkenv.errors import InputError
from parkenv.files.known_names import RigName
from parkenv.files.option import Inside, Option, option
from parkenv.files.spec_file import Axis, DetectorName, Several
from parkenv.show.plurals import plural
from parkenv.show.report.tables import Column
from parkenv.studies.fields import CaptureDistance, ScenarioItem, Seed
from parkenv.studies.results import Row
from parkenv.studies.sensing.detector_study import DetectorStudy
from parkenv.studies.sensing.detector_training import DetectorTraining
from parkenv.studies.study import ExecutionSpec, counted

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from parkenv.perception.car_model import CarModel
    from parkenv.perception.detector import Detector
    from parkenv.perception.lab.cross_validation import CropScore
    from parkenv.studies.runner import Result


class Detect(Command):
    """With --out, the command writes pictures and films with boxes, and a table of all boxes with frame and time.

    View and visible fraction depend on the detector: HOG distinguishes only sides and ends, `net` all three views.
    """

    examples = """
        parkenv detect photo.png --out results/cars
        parkenv detect photos --model side --threshold 0.8
        parkenv detect drive.mp4 --detector yolo.onnx --step 5 --out results/cars
        parkenv detect drive.mcap --detector net --out results/cars
        """

    images: Several[Path] = option(
        ...,
        "Images, videos, recorded drives (MCAP, rosbags; extra bags), or folders of them.",
        takes="FILE|DIR",
        argument=True,
    )
    model: Several[str] | None = option(
        None,
        "side, front, or an .npz of `parkenv train-detector`; repeatable.",
        takes="NAME|FILE",
        repeat=True,
        default="side and front",
    )
    detector: DetectorName | None = option(
        None,
        "Instead of models: net, the packaged network, another (.onnx), or your own MODULE:CLASS.",
        takes="NAME|FILE|MODULE:CLASS",
        default="none",
    )
    threshold: float = option(0.5, "Smallest probability of a reported car.", takes="P", gt=0, lt=1)
    least_height: float | None = option(
        None, "Height of the smallest regions searched, px.", takes="PX", default="the model's", ge=8
    )
    step: int = option(1, "Process every N-th frame of a video.", ge=1)
    out: Path | None = option(
        None,
        "Folder for NAME_cars.png, NAME_cars.mp4, boxes.csv and summary.json.",
        short="-o",
        default="none",
    )

    def run(self) -> None:
        """See `Command`."""
        from parkenv.studies.sensing.detection_run import find_cars

        console = make_console()
        with stages(console, "frames") as progress:
            found = find_cars(self.images, self._finder(), self.threshold, self.step, self.out, progress)
        headings = ["file", "left", "top", "right", "bottom", "probability", "view", "visible_fraction"]
        boxes = [b for b in found.boxes if b["frame"] is None]
        cells = [
            (b["file"], *(f"{b[side]:.0f}" for side in headings[1:5]), f"{b['probability']:.2f}", b["view"],
             "" if b["visible_fraction"] is None else f"{b['visible_fraction']:.2f}")
            for b in boxes
        ]  # fmt: skip
        if found.images:
            console.print(make_table(None, [h.removesuffix("_fraction") for h in headings], cells))
            console.print(f"{plural(len(cells), 'car')} in {plural(found.images, 'image')}")
        for video in found.videos:
            console.print(
                f"{video['file']}: {plural(video['frames'], 'frame')} of {video['seconds']:.1f} s, "
                f"{plural(video['boxes'], 'box', 'boxes')}, at most {plural(video['most_cars'], 'car')} in a frame"
            )
        if self.out is not None:
            rows = [
                {"file": b["file"], "box": [b[side] for side in headings[1:5]]}
                | {k: b[k] for k in headings[5:]}
                for b in boxes
            ]
            save_summary(self.out, None, rows, videos=found.videos)
            console.print(f"Pictures, films, boxes.csv and summary.json are in {self.out}")

    def _finder(self) -> Detector:
        """Return the detector that the options describe."""
        from parkenv.perception.detector_registry import make_detector
        from parkenv.perception.hog_detector import HogDetector

        if self.detector is None:
            return HogDetector.load(
                *(self.model or ()), threshold=self.threshold, least_height=self.least_height
            )
        if self.model or self.least_height is not None:
            raise InputError(
                f"--detector {self.detector} excludes --model and --least-height, which choose HOG models"
            )
        return make_detector(self.detector, self.threshold)


class TrainDetector(Command, DetectorTraining):
    """A HOG model (.npz) learns from photographs with labelled boxes, or from aligned crops and images without cars.

    A network like the packaged `net` (.onnx) learns from simulated pictures only.

    With --folds, 30 blocks of consecutive files are held out in rotation: consecutive images often show the same car.
    The held-out cars are also searched in composed photographs: pasted at 0.8 to 2.2 times their size into mosaics of
    the held-out images without cars.
    """

    examples = """
        parkenv train-detector --uiuc CarData --out side.npz
        parkenv train-detector --labels coco.json --images pictures -o side.npz
        parkenv train-detector --labels yolo --front -o front.npz
        parkenv train-detector --crops kitti --front --out front.npz \\
            --normalization blocks --penalty 0.02 \\
            --jitter 0 --misaligned 0 --enlarged 0
        parkenv train-detector --simulated 94 --out my-net.onnx
        """

    out: Path = option(
        ...,
        "The file to write: a HOG model, or with --simulated a network.",
        short="-o",
        takes="FILE.npz|FILE.onnx",
    )

    def run(self) -> None:
        """See `Command`."""
        console = make_console()
        with console.status("Training") as status:
            trained = self.train(self.out, status.update)
        if trained.scores:
            console.print(_cross_validation_table(trained.scores))
        written = ", ".join([str(self.out), *(file.name for file in trained.files[1:])])
        console.print(f"Trained on {trained.trained_on}. Written: {written}")


def _cross_validation_table(scores: Sequence[CropScore]) -> Table:
    from parkenv.perception.lab.cross_validation import FALSE_POSITIVES

    def cells(part: str, cars: str, others: str, values: Sequence[float]) -> tuple[str, ...]:
        return part, cars, others, *(f"{v:.4f}" for v in values)

    values = [(s.auc, *s.recall, s.equal_error) for s in scores]
    rows = [
        cells(str(i + 1), str(s.n_cars), str(s.n_others), v)
        for i, (s, v) in enumerate(zip(scores, values, strict=True))
    ]
    rows.append(cells("mean", "", "", [sum(column) / len(scores) for column in zip(*values, strict=True)]))
    rates = [f"recall at {rate:.1%} false positives" for rate in FALSE_POSITIVES]
    columns = ["part", "cars", "others", "AUC", *rates, "equal error, made photographs"]
    return make_table("Held out", columns, rows)


_PICTURES, _DRIVES = "On drives", "On whole drives"


class EvaluateDetector(Command, ExecutionSpec):
    """On UIUC's sets, by their matching rule, a HOG model (--model) is searched at the sizes of the set's cars.

    Any other detector works as in a survey; its boxes of other sizes, and of fronts and rears, are left out, as the
    sets label neither, and a box more than twice as wide as high is a side. On crops, the output gives the fraction of
    cars found at 1 % and 10 % false positives, with intervals over 30 blocks of consecutive files. On pictures of
    drives, the threshold of every detector is set to the same number of false positives; a car counts if it is within
    20 m, 16 px high, and 30 % visible.

    With --sessions, the command compares whole survey drives like those of `parkenv survey`: cars found, slots right,
    error of the map, by weather, distance, and cause of a miss. All detectors process the same pictures. Each rig and
    detector has a folder with its map. The same command continues after an interruption.
    """

    examples = """
        parkenv evaluate-detector --uiuc CarData --model side
        parkenv evaluate-detector --uiuc CarData --detector net
        parkenv evaluate-detector --crops kitti --detector net
        parkenv evaluate-detector --drives campus --detector hog,net
        parkenv evaluate-detector --drives campus --detector hog,net \\
            --sessions 21 --rig laser,stereo --misses 8
        """

    uiuc: Path | None = option(None, "UIUC's folder as published (CarData).", takes="DIR")
    model: str = option(
        "side",
        "side, front, or an .npz of `parkenv train-detector`; for other detectors use --detector.",
        takes="NAME|FILE",
    )
    detectors: Axis[DetectorName] | None = option(
        None,
        "Instead of a model: hog, net, a network (.onnx), or your own MODULE:CLASS; with --drives "
        "several, separated by commas.",
        name="--detector",
        takes="NAME|FILE|MODULE:CLASS",
        default="none",
    )
    crops: Path | None = option(
        None,
        "Instead of --uiuc: a folder with positives/, negatives/ (or vehicles/, non-vehicles/).",
        takes="DIR",
    )
    drives: Annotated[ScenarioItem | None, Inside(only=())] = option(
        None,
        "Instead of --uiuc: pictures along the survey's route of a scenario, or whole drives.",
        takes="SCENARIO",
        panel=_PICTURES,
    )
    pictures: int = option(40, "Pictures in each of the five weathers.", panel=_PICTURES, ge=1)
    false_positives: float = option(
        0.1, "Boxes without a car in a picture, on average.", panel=_PICTURES, ge=0, le=100
    )
    seed: Annotated[Seed, Option(panel=_PICTURES)] = Field(0, description="Seed of cars, lighting and noise.")
    sessions: int = option(0, "Survey drives for each rig; 0: only pictures.", panel=_DRIVES, ge=0)
    rigs: Axis[RigName] | None = option(
        None,
        f"{', '.join(get_args(RigName))}.",
        name="--rig",
        takes="NAME[,...]",
        panel=_DRIVES,
        default="laser",
    )
    every: CaptureDistance = option(2.5, "Metres between captures.", takes="M", panel=_DRIVES)
    misses: int = option(
        0,
        "Missed cars of each kind on a contact sheet for each rig and detector; 0: none.",
        panel=_DRIVES,
        ge=0,
    )
    out: Path = option(Path("results/detector"), "Folder for summary.json, tables and figures.", short="-o")

    @model_validator(mode="after")
    def _fit_together(self) -> Self:
        if sum(source is not None for source in (self.uiuc, self.crops, self.drives)) != 1:
            raise PydanticCustomError(
                "whole", "give one of --uiuc FOLDER, --crops FOLDER and --drives SCENARIO"
            )
        if not self.sessions and (self.rigs is not None or self.misses):
            raise PydanticCustomError("whole", "--rig and --misses go with --sessions")
        if self.sessions and self.drives is None:
            raise PydanticCustomError("whole", "--sessions requires --drives")
        if self.drives is None and len(self.detectors or ()) > 1:
            raise PydanticCustomError("whole", "--detector names several, which requires --drives")
        return self

    def run(self) -> None:
        """See `Command`."""
        if self.sessions:
            names = [name for name in DetectorStudy.model_fields if name in type(self).model_fields]
            fields = {name: getattr(self, name) for name in names}
            fields |= {"scenario": self.drives, "detectors": self._names, "rigs": self.rigs or ("laser",)}
            CompareDetectors(study=DetectorStudy.parse(fields, ""), out=self.out).run()
        elif self.drives is not None:
            self._on_drives()
        elif self.crops is not None:
            self._on_crops(self.crops)
        elif self.uiuc is not None:
            self._on_uiuc(self.uiuc)

    @property
    def _names(self) -> Sequence[str]:
        return self.detectors or (self.model,)

    def _detector(self) -> CarModel | Detector:
        from parkenv.perception.car_model import PACKAGED_MODELS, CarModel
        from parkenv.perception.detector_registry import make_detector
        from parkenv.perception.hog_detector import LEAST_SCORED

        (name,) = self._names
        if self.detectors is None and (name in PACKAGED_MODELS or name.lower().endswith(".npz")):
            return CarModel.load(name)
        return make_detector(name, LEAST_SCORED)

    def _on_drives(self) -> None:
        from parkenv.files.atomic_write import make_folder
        from parkenv.perception.detector_registry import make_detector
        from parkenv.scenarios.build import build
        from parkenv.studies.sensing.detector_drives import drive_pictures, score_on_drives

        assert self.drives is not None
        detectors = {name: make_detector(name, 0.01) for name in self._names}
        its = build(self.drives)
        make_folder(self.out)
        console = make_console()
        with stages(console, "pictures") as progress:
            taken, drawn = [], counted(progress, "Drawing")
            for picture in drive_pictures(its, self.pictures, self.seed):
                taken.append(picture)
                drawn()
            advance = counted(progress, "Detecting", len(taken) * len(detectors))
            rows = score_on_drives(detectors, taken, self.false_positives, advance)
        columns = {name: Column(name, name, share=True) for name in detectors}
        print_rows(console, "Cars found", rows, rows[0], columns)
        save_summary(self.out, None, rows)
        console.print(
            f"Recall on {plural(len(taken), 'picture')} at {self.false_positives:g} false positives in a picture. "
            f"Written: {self.out / 'summary.json'}"
        )

    def _on_crops(self, folder: Path) -> None:
        from parkenv.files.atomic_write import make_folder
        from parkenv.perception.lab.car_datasets import read_crop_folder
        from parkenv.studies.sensing.detector_scores import recall_on_crops

        loaded, crops = self._detector(), read_crop_folder(folder)
        make_folder(self.out)
        console = make_console()
        with stages(console, "crops") as progress:
            advance = counted(progress, "Detecting", len(crops.positives) + len(crops.negatives))
            rows = recall_on_crops(loaded, crops, on_image=advance)
        columns = {
            key: Column(key, key.replace("_", " "), share=True) for key in ("false_positives", "recall")
        }
        shown = [
            r | {"recall_ci95": [r["recall"] - r["interval"], r["recall"] + r["interval"]]} for r in rows
        ]
        print_rows(console, "Cars found in crops", shown, (*columns, "cars", "others"), columns)
        save_summary(self.out, None, rows)
        console.print(f"Written: {self.out / 'summary.json'}")

    def _on_uiuc(self, uiuc: Path) -> None:
        from parkenv.files.atomic_write import make_folder
        from parkenv.perception.car_model import CarModel
        from parkenv.studies.sensing.detector_scores import save_curves, score_on_uiuc

        loaded = self._detector()
        make_folder(self.out)
        console = make_console()
        with stages(console, "images") as progress:
            scores = score_on_uiuc(loaded, uiuc, on_image=counted(progress, "Detecting"))
        rows = [score.row for score in scores]
        print_rows(console, "UIUC", rows, rows[0])
        kind = "model" if isinstance(loaded, CarModel) else "detector"
        save_curves(scores, f"{kind} {self._names[0]}", self.out / "recall_precision.png")
        save_summary(self.out, None, rows)
        console.print(f"Written: {self.out / 'recall_precision.png'}, summary.json")


class CompareDetectors(StudyCommand):
    """The comparison of detectors on whole drives, as `evaluate-detector --sessions` and experiment files run it."""

    examples = "parkenv evaluate-detector --drives campus --detector hog,net --sessions 21"

    study: DetectorStudy = DetectorStudy()
    out: Path

    def show(self, console: Console, result: Result) -> None:
        """Print the comparison of detectors, once all have driven."""
        if result.complete:
            for printed in _tables(result.rows, self.study.rigs, self.study.detectors):
                console.print(printed)


def _tables(table: Sequence[Row], rigs: Sequence[str], detectors: Sequence[str]) -> list[Table]:
    """Return three tables: whole drives, drives by weather, and cars in pictures."""
    names = [(rig, detector) for rig in rigs for detector in detectors]
    headings = [f"{detector}, {rig}" for rig, detector in names]
    rows = {(r["rig"], r["detector"], r["group"], r["part"]): r for r in table}
    parts = list(dict.fromkeys((r["group"], r["part"]) for r in table))

    def line(heading: str, part: tuple[str, str], measure: str) -> tuple[str, ...]:
        return heading, *(_rate(rows[*name, *part], measure) for name in names)

    def numbers(heading: str, column: str) -> tuple[str, ...]:
        values = [rows[*name, "all", "all"][column] for name in names]
        return heading, *("" if value is None else f"{value:.3f}" for value in values)

    whole = ("all", "all")
    drives = [
        line("parked cars found", whole, "cars"),
        line("cars in a picture found in it", whole, "in_pictures"),
        line("boxes that are cars", whole, "boxes"),
        line("slots right", whole, "slots"),
        line("slots unknown: never in view", whole, "unknown"),
        line("slots wrong", whole, "wrong"),
        numbers("error of the place, m", "place_error_m"),
        numbers("mean error of the map", "map_error"),
    ]
    weathers = [
        line(f"{part}: {heading}".replace("_", " "), (group, part), measure)
        for heading, measure in (
            ("cars found", "cars"),
            ("boxes that are cars", "boxes"),
            ("slots right", "slots"),
        )
        for group, part in parts
        if group == "weather"
    ]
    pictures = [
        line(
            f"{part} ({rows[*names[0], group, part]['in_pictures']:,})".replace("_", " "),
            (group, part),
            "in_pictures",
        )
        for group, part in parts
    ]
    precision = [
        line(f"{part}: boxes that are cars", (group, part), "boxes")
        for group, part in parts
        if group == "distance"
    ]
    never = [
        (f"{part}: cars never found", *(str(rows[*name, "cause", part]["cars"]) for name in names))
        for group, part in parts
        if group == "cause"
    ]
    return [
        make_table("Whole drives", ["", *headings], drives),
        make_table("By weather", ["", *headings], weathers),
        make_table(
            "Cars in a picture that are found in it", ["", *headings], [*pictures, *precision, *never]
        ),
    ]


def _rate(row: Row, measure: str) -> str:
    rate, low, high = (row[f"{measure}_{c}"] for c in ("rate", "low", "high"))
    return "" if rate is None else f"{rate:.1%} [{100 * low:.1f}, {100 * high:.1f}]"
