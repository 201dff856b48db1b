"""`parkenv detect`, `train-detector`, `evaluate-detector`: car detection in image files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from parkenv.cli.tables import make_console, make_table, save_summary
from parkenv.errors import InputError
from parkenv.evaluation.plurals import plural
from parkenv.files.file_names import distinct_names, file_name

if TYPE_CHECKING:
    from rich.table import Table

    from parkenv.perception.cross_validation import CropScore
    from parkenv.perception.detector import Detector


def detect(
    images: list[Path],
    /,
    model: list[str] | None = None,
    detector: str | None = None,
    threshold: float = 0.5,
    least_height: float | None = None,
    out: Path | None = None,
) -> None:
    """Find cars in image files.

    Examples:
        parkenv detect photo.png --out results/cars
        parkenv detect photos --model side --threshold 0.8
        parkenv detect photos --detector yolo.onnx --out results/cars

    Options:
        images (FILE|DIR): Image files, or folders of them.
        model (NAME|FILE): side, front, or an .npz of `parkenv train-detector`; repeatable.  [default: side and front]
        detector (NAME|FILE|MODULE:CLASS): Instead of models: a network (.onnx), or a class of your own.  [default:
            none]
        threshold (P): Least probability of a reported car.
        least_height (PX >= 8): Height of the smallest regions searched, px.  [default: the model's]
        out, -o (DIR): Folder for pictures, NAME_cars.png, and summary.json.  [default: none]
    """
    import cv2
    from rich.progress import track

    from parkenv.evaluation.experiments.results import make_folder
    from parkenv.evaluation.figures.survey_pictures import draw_detections
    from parkenv.files.atomic_write import atomic_write
    from parkenv.files.images import images_in, read_image
    from parkenv.perception.detector_registry import make_detector
    from parkenv.perception.hog_detector import HogDetector

    finder: Detector
    if detector is None:
        finder = HogDetector.load(*(model or ()), threshold=threshold, least_height=least_height)
    elif model or least_height is not None:
        raise InputError(
            f"--detector {detector} excludes --model and --least-height, which choose HOG models"
        )
    elif not 0.0 < threshold < 1.0:
        raise InputError(f"--threshold is {threshold}, want between 0 and 1")
    else:
        finder = make_detector(detector, threshold)
    chosen = [f for path in images for f in (images_in(path) if path.is_dir() else [path])]
    for file in chosen:
        read_image(file)  # a damaged one is refused before any work
    drawings = [file_name(f"{name}_cars", ".png") for name in distinct_names(chosen)]
    if out is not None:
        originals = {file.resolve() for file in chosen}
        for drawing in drawings:
            if (out / drawing).resolve() in originals:
                raise InputError(f"--out {out}: {drawing} would replace an image that is searched")
        make_folder(out)
    console = make_console()
    rows, cells = [], []
    progress = track(
        zip(chosen, drawings, strict=True),
        "Detecting",
        total=len(chosen),
        console=console,
        disable=not console.is_terminal,
    )
    for file, drawing in progress:
        image = read_image(file)
        found = finder.detect(image)
        found = found.select(found.probability >= threshold)
        for box, p, end in zip(
            found.boxes.tolist(), found.probability.tolist(), found.end_on.tolist(), strict=True
        ):
            view = "end" if end else "side"
            rows.append({"file": str(file), "box": box, "probability": p, "view": view})
            cells.append((str(file), *(f"{v:.0f}" for v in box), f"{p:.2f}", view))
        if out is not None:
            colored = image if image.ndim == 3 else cv2.cvtColor(image, cv2.COLOR_GRAY2RGB)
            drawn = draw_detections(colored, found)
            with atomic_write(out / drawing) as beside:
                beside.write_bytes(cv2.imencode(".png", drawn[..., ::-1])[1].tobytes())
    headings = ["file", "left", "top", "right", "bottom", "probability", "view"]
    console.print(make_table(None, headings, cells))
    console.print(f"{plural(len(rows), 'car')} in {plural(len(chosen), 'image')}")
    if out is not None:
        save_summary(out, None, rows)
        console.print(f"Images are in {out}")


def train_detector(
    out: Path,
    uiuc: Path | None = None,
    crops: Path | None = None,
    front: bool = False,
    folds: int = 0,
    seed: int = 0,
    *,
    normalization: Literal["neighbors", "cell", "blocks"] = "neighbors",
    penalty: float = 0.01,
    rounds: int = 3,
    jitter: int = 2,
    misaligned: int = 2,
) -> None:
    r"""Train a car model on photographs: aligned crops of cars, and images without cars.

    With `--folds`, 30 blocks of consecutive files are held out in turn: consecutive images often show the same car.

    Examples:
        parkenv train-detector --uiuc CarData --out side.npz
        parkenv train-detector --crops kitti --front --out front.npz \
            --normalization blocks --penalty 0.02 --jitter 0 --misaligned 0

    Options:
        out, -o (FILE.npz): The model file to write.
        uiuc (DIR): UIUC's folder: trains on TrainImages (or TrainImages.tar.gz).
        crops (DIR): Instead: a folder with positives/, negatives/ (or vehicles/, non-vehicles/).
        front: Train a model of fronts and rears, with a square window.
        folds (N >= 0): Folds of a cross-validation on the crops; 0: none.
        seed (N >= 0): Seed of jitter, solver and folds.

    Training:
        normalization (NAME): neighbors, cell (the thesis's), or blocks.
        penalty (C): Penalty of the support vector machine.
        rounds (N >= 0): Rounds of hard-negative mining.
        jitter (N >= 0): Shifted copies of each car; 0 if the crops are not aligned.
        misaligned (N >= 0): Misaligned crops of each car as negatives; 0 if the crops are not aligned.
    """
    from parkenv.files.atomic_write import check_writable
    from parkenv.perception.car_datasets import read_crop_folder, read_uiuc_training
    from parkenv.perception.cross_validation import cross_validated
    from parkenv.perception.hog import Descriptor
    from parkenv.perception.training import TrainingSettings, train

    if (uiuc is None) == (crops is None):
        raise InputError("give either --uiuc FOLDER or --crops FOLDER")
    if out.suffix != ".npz":
        raise InputError(f"--out {out}: want a name that ends in .npz")
    check_writable(out)
    data = read_uiuc_training(uiuc) if uiuc is not None else read_crop_folder(Path(str(crops)))
    descriptor = Descriptor(128, 128 if front else 64, normalization)
    settings = TrainingSettings(
        penalty=penalty, rounds=rounds, jitter=jitter, misaligned=misaligned, seed=seed
    )
    console = make_console()
    with console.status("Training") as status:
        if folds:
            scores = cross_validated(
                data,
                folds=folds,
                seed=seed,
                descriptor=descriptor,
                end_on=front,
                settings=settings,
                progress=status.update,
            )
            console.print(_cross_validation_table(scores))
        model = train(
            data.positives,
            data.negatives,
            descriptor=descriptor,
            end_on=front,
            settings=settings,
            trained_on=f"{len(data.positives)} crops and {len(data.negatives)} others in {uiuc or crops}",
            progress=status.update,
        )
    model.save(out)
    console.print(f"Trained on {model.trained_on}. Written: {out}")


def _cross_validation_table(scores: Sequence[CropScore]) -> Table:
    from parkenv.perception.cross_validation import FALSE_POSITIVES

    def cells(part: str, cars: str, others: str, auc: float, recall: Sequence[float]) -> tuple[str, ...]:
        return part, cars, others, f"{auc:.4f}", *(f"{r:.3f}" for r in recall)

    n = len(scores)
    mean = [sum(s.recall[k] for s in scores) / n for k in range(len(FALSE_POSITIVES))]
    rows = [cells(str(i + 1), str(s.n_cars), str(s.n_others), s.auc, s.recall) for i, s in enumerate(scores)]
    rates = [f"recall at {rate:.1%} false positives" for rate in FALSE_POSITIVES]
    rows.append(cells("mean", "", "", sum(s.auc for s in scores) / n, mean))
    return make_table("Held-out crops", ["part", "cars", "others", "AUC", *rates], rows)


def evaluate_detector(
    uiuc: Path, model: str = "side", out: Path = Path("results/detector"), *, detector: str | None = None
) -> None:
    """Measure recall and precision of a detector on UIUC's test sets, by their matching rule.

    A HOG model (--model) is searched at the sizes of the set's cars, a --detector looks as it does in a survey.

    Examples:
        parkenv evaluate-detector --uiuc CarData --model side
        parkenv evaluate-detector --uiuc CarData --detector yolo.onnx

    Options:
        uiuc (DIR): UIUC's folder as published (CarData).
        model (NAME|FILE): side, front, or an .npz of `parkenv train-detector`; any other detector is taken as with
            --detector.
        detector (NAME|FILE|MODULE:CLASS): Instead of a model: hog, a network (.onnx), or a class of your own.
            [default: none]
        out, -o (DIR): Folder for summary.json and the curves.
    """
    from rich.progress import Progress

    from parkenv.evaluation.experiments.detector_scores import LEAST_SCORED, save_curves, score_on_uiuc
    from parkenv.evaluation.experiments.results import make_folder
    from parkenv.perception.car_model import PACKAGED_MODELS, CarModel
    from parkenv.perception.detector_registry import make_detector

    name = detector or model
    is_model = detector is None and (name in PACKAGED_MODELS or name.lower().endswith(".npz"))
    loaded = CarModel.load(name) if is_model else make_detector(name, LEAST_SCORED)
    make_folder(out)
    console = make_console()
    with Progress(console=console, disable=not console.is_terminal, transient=True) as progress:
        task = progress.add_task("Detecting", total=None)
        scores = score_on_uiuc(loaded, uiuc, on_image=lambda: progress.advance(task))
    rows = [score.row for score in scores]
    cells = ([f"{v:.4f}" if isinstance(v, float) else str(v) for v in row.values()] for row in rows)
    console.print(make_table(None, list(rows[0]), cells))
    save_curves(scores, f"{'model' if is_model else 'detector'} {name}", out / "recall_precision.png")
    save_summary(out, None, rows)
    console.print(f"Written: {out / 'recall_precision.png'}, summary.json")
