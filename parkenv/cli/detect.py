"""`parkenv detect`, `train-detector`, `evaluate-detector`: car detection in images."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal, Self

from pydantic import Field, model_validator

from parkenv.cli.options import Command
from parkenv.cli.tables import print_rows, save_summary, stages
from parkenv.errors import require
from parkenv.files.atomic_write import check_writable, make_folder
from parkenv.files.option import option
from parkenv.files.spec_file import DetectorName, Several, require_together
from parkenv.show.tables import Column, plural
from parkenv.studies.fields import Seed
from parkenv.studies.study import counted

if TYPE_CHECKING:
    from parkenv.perception.car_model import CarModel
    from parkenv.perception.detector import Detector


BOX = (
    Column("file", "file"),
    *(Column(side, side, digits=0) for side in ("left", "top", "right", "bottom")),
    Column("probability", "probability", digits=2),
    Column("view", "view"),
    Column("visible_fraction", "visible", digits=2),
)


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
    calibration: Path | None = option(
        None,
        "The camera (.toml, as of map-drive), so that only cars on the ground are reported: no sky, no own bonnet.",
        takes="FILE",
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
        from parkenv.studies.sensing.detection_run import find_cars

        with stages(self.console, "frames") as progress:
            cars = find_cars(
                self.images, self._on_ground(self._finder()), self.threshold, self.step, self.out, progress
            )
        boxes = [box for box in cars.boxes if box["frame"] is None]
        if cars.images:
            print_rows(self.console, "Cars", boxes, [column.key for column in BOX], BOX)
            self.say(f"{plural(len(boxes), 'car')} in {plural(cars.images, 'image')}")
        for video in cars.videos:
            self.say(
                f"{video['file']}: {plural(video['frames'], 'frame')} of {video['seconds']:.1f} s, "
                f"{plural(video['boxes'], 'box', 'boxes')}, at most {plural(video['most_cars'], 'car')} in a frame"
            )
        for topic in cars.not_searched:
            self.say(f"Not searched: {topic['file']}: {topic['reason']}")
        if self.out is not None:
            file, *sides, probability, view, visible = (column.key for column in BOX)
            rows = [
                {file: box[file], "box": [box[side] for side in sides]}
                | {key: box[key] for key in (probability, view, visible)}
                for box in boxes
            ]
            save_summary(self.out, None, rows, videos=cars.videos, not_searched=cars.not_searched)
            self.say(f"Pictures, films, boxes.csv and summary.json are in {self.out}")

    def _on_ground(self, detector: Detector) -> Detector:
        if self.calibration is None:
            return detector
        from parkenv.mapping.recordings.calibration import DriveCalibration
        from parkenv.perception.ground_detector import GroundDetector

        return GroundDetector(detector, *DriveCalibration.read(self.calibration).only_camera())

    def _finder(self) -> Detector:
        from parkenv.perception.detector_registry import make_detector
        from parkenv.perception.hog_detector import HogDetector

        if self.detector is None:
            return HogDetector.load(
                *(self.model or ()), threshold=self.threshold, least_height=self.least_height
            )
        require(
            not self.model and self.least_height is None,
            f"--detector {self.detector} excludes --model and --least-height, which choose HOG models",
        )
        return make_detector(self.detector, self.threshold)


class TrainDetector(Command):
    """The model learns from aligned crops of cars and from images without cars."""

    examples = """
        parkenv train-detector --uiuc CarData --out side.npz
        parkenv train-detector --crops kitti --front --out front.npz \\
            --normalization blocks --penalty 0.02 \\
            --jitter 0 --misaligned 0 --enlarged 0
        """

    uiuc: Path | None = option(None, "UIUC's folder: trains on TrainImages.", takes="DIR")
    crops: Path | None = option(
        None, "Instead: a folder with positives/, negatives/ (or vehicles/, non-vehicles/).", takes="DIR"
    )
    front: bool = option(False, "Train a model of fronts and rears, with a square window.")
    seed: Seed = Field(0, description="Seed of jitter and solver.")
    normalization: Literal["neighbors", "cell", "blocks"] = option(
        "neighbors", "neighbors, cell (the thesis's), or blocks.", takes="NAME"
    )
    penalty: float = option(0.03, "Penalty of the support vector machine.", takes="C")
    rounds: int = option(3, "Rounds of hard-negative mining.", ge=0)
    jitter: int = option(4, "Shifted copies of each car; 0 if the crops are not aligned.", ge=0)
    misaligned: int = option(
        2, "Misaligned crops of each car as negatives; 0 if the crops are not aligned.", ge=0
    )
    enlarged: float = option(
        2.0,
        "Factor by which crops are enlarged for further mining, so that parts of large cars "
        "become negatives; 0: none, if the crops are not aligned.",
    )
    out: Path = option(..., "The file to write.", short="-o", takes="FILE.npz")

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        require_together(
            (self.uiuc is None) != (self.crops is None), "give one of --uiuc FOLDER and --crops FOLDER"
        )
        return self

    def run(self) -> None:
        from parkenv.perception.car_datasets import read_crop_folder, read_uiuc_training
        from parkenv.perception.hog import Descriptor
        from parkenv.perception.hog_detector import END, SIDE
        from parkenv.perception.training import TrainingSettings, train

        require(self.out.suffix == ".npz", f"--out {self.out}: want a name that ends in .npz")
        check_writable(self.out)
        window = END if self.front else SIDE
        with self.console.status("Training") as status:
            data = (
                read_crop_folder(self.crops)
                if self.crops is not None
                else read_uiuc_training(Path(str(self.uiuc)))
            )
            model = train(
                data.positives,
                data.negatives,
                descriptor=Descriptor(*window.size, self.normalization),
                end_on=self.front,
                settings=TrainingSettings(
                    self.penalty, self.rounds, self.jitter, self.misaligned, self.enlarged, self.seed
                ),
                trained_on=f"{len(data.positives)} crops and {len(data.negatives)} others in "
                f"{self.uiuc or self.crops}",
                progress=status.update,
            )
            model.save(self.out)
        self.say(f"Trained on {model.trained_on}. Written: {self.out}")


class EvaluateDetector(Command):
    """On UIUC's sets, by their matching rule, a HOG model (--model) is searched at the sizes of the set's cars.

    Any other detector works as in a survey; its boxes of other sizes, and of fronts and rears, are left out, as the
    sets label neither, and a box more than twice as wide as high is a side. On crops, the output gives the fraction of
    cars found at 1 % and 10 % false positives, with intervals over 30 blocks of consecutive files.

    For whole drives see `parkenv survey --detector NAME`: cars detected, slots right, error of the map.
    """

    examples = """
        parkenv evaluate-detector --uiuc CarData --model side
        parkenv evaluate-detector --uiuc CarData --detector net
        parkenv evaluate-detector --crops kitti --detector net
        """

    uiuc: Path | None = option(None, "UIUC's folder as published (CarData).", takes="DIR")
    crops: Path | None = option(
        None,
        "Instead of --uiuc: a folder with positives/, negatives/ (or vehicles/, non-vehicles/).",
        takes="DIR",
    )
    model: str = option(
        "side",
        "side, front, or an .npz of `parkenv train-detector`; for other detectors use --detector.",
        takes="NAME|FILE",
    )
    detector: DetectorName | None = option(
        None,
        "Instead of a model: hog, net, a network (.onnx), or your own MODULE:CLASS.",
        takes="NAME|FILE|MODULE:CLASS",
        default="none",
    )
    out: Path = option(Path("results/detector"), "Folder for summary.json.", short="-o")

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        require_together(
            (self.uiuc is None) != (self.crops is None), "give one of --uiuc FOLDER and --crops FOLDER"
        )
        return self

    def run(self) -> None:
        from parkenv.perception.car_datasets import read_crop_folder
        from parkenv.perception.detection_scores import recall_on_crops, score_on_uiuc

        detector = self._detector()
        if self.crops is not None:
            crops = read_crop_folder(self.crops)
            make_folder(self.out)
            with stages(self.console, "crops") as progress:
                advance = counted(progress, "Detecting", len(crops.positives) + len(crops.negatives))
                rows = recall_on_crops(detector, crops, on_image=advance)
            columns = [
                Column(key, key.replace("_", " "), share=True) for key in ("false_positives", "recall")
            ]
            shown = [
                r | {"recall_ci95": [r["recall"] - r["interval"], r["recall"] + r["interval"]]} for r in rows
            ]
            print_rows(
                self.console,
                "Cars found in crops",
                shown,
                ("false_positives", "recall", "cars", "others"),
                columns,
            )
        elif self.uiuc is not None:
            make_folder(self.out)
            with stages(self.console, "images") as progress:
                rows = score_on_uiuc(detector, self.uiuc, on_image=counted(progress, "Detecting"))
            print_rows(self.console, "UIUC", rows)
        save_summary(self.out, None, rows)
        self.say(f"Written: {self.out / 'summary.json'}")

    def _detector(self) -> CarModel | Detector:
        from parkenv.perception.car_model import PACKAGED_MODELS, CarModel
        from parkenv.perception.detector_registry import make_detector
        from parkenv.perception.hog_detector import LEAST_SCORED

        if self.detector is not None:
            return make_detector(self.detector, LEAST_SCORED)
        if self.model in PACKAGED_MODELS or self.model.lower().endswith(".npz"):
            return CarModel.load(self.model)
        return make_detector(self.model, LEAST_SCORED)
