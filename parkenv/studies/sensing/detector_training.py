"""Train a car model on photographs, or a network on simulated pictures."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Self

from pydantic import Field, model_validator
from pydantic_core import PydanticCustomError

from parkenv.errors import InputError, needs_extra
from parkenv.files.atomic_write import atomic_write, check_writable
from parkenv.files.option import option
from parkenv.files.spec_file import Several, Spec
from parkenv.studies.fields import Seed

if TYPE_CHECKING:
    from parkenv.perception.lab.car_datasets import LabelledImage
    from parkenv.perception.lab.cross_validation import CropScore

_HOG, _NETWORK = "Training of a HOG model", "Training of a network"


class TrainedDetector(NamedTuple):
    """A detector that is trained and written.

    Attributes:
        trained_on: what it learned from.
        files: the files that were written.
        scores: of the parts of a cross-validation.
    """

    trained_on: str
    files: tuple[Path, ...]
    scores: list[CropScore]


class DetectorTraining(Spec):
    """The training of a HOG model, on photographs, or of a network, on simulated pictures."""

    uiuc: Path | None = option(
        None, "UIUC's folder: trains on TrainImages (or TrainImages.tar.gz).", takes="DIR"
    )
    crops: Path | None = option(
        None, "Instead: a folder with positives/, negatives/ (or vehicles/, non-vehicles/).", takes="DIR"
    )
    labels: Path | None = option(
        None,
        "Instead: labelled photographs, a file of COCO, or a folder of YOLO (images/ and labels/, or .txt "
        "beside the pictures; names in data.yaml or classes.txt).",
        takes="FILE.json|DIR",
    )
    simulated: int | None = option(
        None, "Instead: streets, 20 pictures of each; trains a network (needs the extra detector).", ge=2
    )
    images: Path | None = option(None, "Folder of the pictures of COCO.", takes="DIR", default="the file's")
    classes: Several[str] | None = option(
        None,
        "Classes of the labels that are cars.",
        takes="NAME[,...]",
        default="car, van, truck, bus and the like",
        min_length=1,
    )
    front: bool = option(False, "Train a model of fronts and rears, with a square window.")
    folds: int = option(0, "Folds of a cross-validation on the crops; 0: none.", ge=0)
    seed: Seed = Field(
        0, description="Seed of jitter, solver and folds; of pictures and weights of a network."
    )
    normalization: Literal["neighbors", "cell", "blocks"] = option(
        "neighbors", "neighbors, cell (the thesis's), or blocks.", takes="NAME", panel=_HOG
    )
    penalty: float = option(0.03, "Penalty of the support vector machine.", takes="C", panel=_HOG)
    rounds: int = option(3, "Rounds of hard-negative mining.", panel=_HOG, ge=0)
    jitter: int = option(4, "Shifted copies of each car; 0 if the crops are not aligned.", panel=_HOG, ge=0)
    misaligned: int = option(
        2, "Misaligned crops of each car as negatives; 0 if the crops are not aligned.", panel=_HOG, ge=0
    )
    enlarged: float = option(
        2.0,
        "Factor by which crops are enlarged for further mining, so that parts of large cars "
        "become negatives; 0: none, if the crops are not aligned. With --labels, the photographs "
        "are mined instead.",
        panel=_HOG,
    )
    steps: int = option(9_000, "Steps, each with 16 new examples.", panel=_NETWORK, ge=1)
    pictures: Path | None = option(
        None,
        "Folder for the simulated pictures; pictures of an earlier training are reused.",
        takes="DIR",
        panel=_NETWORK,
        default="none",
    )

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        if sum(source is not None for source in (self.uiuc, self.crops, self.labels, self.simulated)) != 1:
            raise PydanticCustomError(
                "whole", "give one of --uiuc FOLDER, --crops FOLDER, --labels FILE|FOLDER and --simulated N"
            )
        if self.labels is None and (self.images is not None or self.classes is not None):
            raise PydanticCustomError("whole", "--images and --classes go with --labels")
        return self

    def train(self, out: Path, progress: Callable[[str], None] = lambda _: None) -> TrainedDetector:
        """Train the detector, and write it.

        Args:
            out: the file: .npz for a HOG model, .onnx for a network.
            progress: called with what is going on.

        Raises:
            InputError: the file cannot be written, or the photographs cannot be used.
        """
        if self.simulated is not None:
            return self._train_network(self.simulated, out, progress)
        from parkenv.perception.car_regions import END, SIDE
        from parkenv.perception.hog import Descriptor
        from parkenv.perception.lab.car_datasets import read_crop_folder, read_uiuc_training
        from parkenv.perception.lab.cross_validation import cross_validated
        from parkenv.perception.lab.labelled_folders import crops_of, read_labels
        from parkenv.perception.lab.training import TrainingSettings, train

        if out.suffix != ".npz":
            raise InputError(f"--out {out}: want a name that ends in .npz")
        check_writable(out)
        window = END if self.front else SIDE
        photos: list[LabelledImage] = []
        alignment: dict[str, Any] = {}
        if self.labels is not None:
            labelled = read_labels(self.labels, self.images, self.classes or ())
            data, photos = crops_of(labelled, end_on=self.front, seed=self.seed)
            alignment = {"region_aspect": window.aspect, "car": window.car}
        elif self.uiuc is not None:
            data = read_uiuc_training(self.uiuc)
        else:
            data = read_crop_folder(Path(str(self.crops)))
        how: dict[str, Any] = {
            "descriptor": Descriptor(*window.size, self.normalization),
            "end_on": self.front,
            "settings": TrainingSettings(
                penalty=self.penalty, rounds=self.rounds, jitter=self.jitter, misaligned=self.misaligned,
                enlarged=self.enlarged, seed=self.seed,
            ),
            "progress": progress,
        }  # fmt: skip
        scores = cross_validated(data, folds=self.folds, seed=self.seed, **how) if self.folds else []
        source = self.uiuc or self.crops or self.labels
        model = train(
            data.positives,
            data.negatives,
            trained_on=f"{len(data.positives)} crops and {len(data.negatives)} others in {source}",
            photos=photos,
            **alignment,
            **how,
        )
        model.save(out)
        return TrainedDetector(model.trained_on, (out,), scores)

    def _train_network(self, streets: int, out: Path, progress: Callable[[str], None]) -> TrainedDetector:
        if out.suffix != ".onnx":
            raise InputError(f"--out {out}: want a name that ends in .onnx for a network")
        check_writable(out)
        try:
            from parkenv.perception.lab.center_training import CenterTrainingSettings, build_network
        except ImportError as error:
            raise InputError(needs_extra("--simulated", "detector")) from error
        settings = CenterTrainingSettings(steps=self.steps, seed=self.seed)
        built = build_network(streets, settings, self.pictures, progress=progress)
        files = out, out.with_suffix(".toml")
        for file, content in zip(files, (built.data, built.settings.encode()), strict=True):
            with atomic_write(file) as beside:
                beside.write_bytes(content)
        return TrainedDetector(str(built.card["trained_on"]), files, [])
