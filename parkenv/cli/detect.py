"""`parkenv detect`, `train-detector`, `evaluate-detector`: car detection in image files."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.progress import Progress, track
from rich.table import Table

from parkenv import __version__
from parkenv.cli import arguments as args
from parkenv.cli.tables import make_console, make_table
from parkenv.errors import InputError

if TYPE_CHECKING:
    from parkenv.perception.cross_validation import CropScore

_MODEL_HELP = "side, front, or an .npz that train-detector wrote"


def detect(
    files: Annotated[list[Path], typer.Argument(help="Image files, or folders of them.")],
    model: Annotated[
        list[str] | None, typer.Option("--model", help=f"{_MODEL_HELP}; can be repeated.")
    ] = None,
    threshold: Annotated[
        float, typer.Option("--threshold", help="Least probability of a reported car.")
    ] = 0.5,
    least_height: Annotated[
        float | None,
        typer.Option("--least-height", min=8.0, help="Height of the smallest regions searched, px."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder for pictures and summary.json.")
    ] = None,
) -> None:
    """Find cars in image files.

    Examples:
    * `parkenv detect photo.png --out results/cars`

    * `parkenv detect photos --model side --threshold 0.8`
    """
    import cv2

    from parkenv.evaluation.experiments.results import make_folder, write_summary
    from parkenv.evaluation.figures.survey_pictures import draw_detections
    from parkenv.files.atomic_write import atomic_write
    from parkenv.files.images import images_in, read_image
    from parkenv.perception.hog_detector import HogDetector

    detector = HogDetector.load(*(model or ()), threshold=threshold, least_height=least_height)
    chosen = [f for path in files for f in (images_in(path) if path.is_dir() else [path])]
    if out is not None:
        make_folder(out)
    console = make_console()
    rows = []
    table = make_table(None, ["file", "left", "top", "right", "bottom", "probability", "view"])
    for file in track(chosen, "Detecting", console=console, disable=not console.is_terminal):
        image = read_image(file)
        found = detector.detect(image)
        for box, p, end in zip(
            found.boxes.tolist(), found.probability.tolist(), found.end_on.tolist(), strict=True
        ):
            view = "end" if end else "side"
            rows.append({"file": str(file), "box": box, "probability": p, "view": view})
            table.add_row(str(file), *(f"{v:.0f}" for v in box), f"{p:.2f}", view)
        if out is not None:
            drawn = draw_detections(
                image if image.ndim == 3 else cv2.cvtColor(image, cv2.COLOR_GRAY2RGB), found
            )
            with atomic_write(out / f"{file.stem}_cars.png") as beside:
                beside.write_bytes(cv2.imencode(".png", drawn[..., ::-1])[1].tobytes())
    console.print(table)
    console.print(f"{len(rows)} cars in {len(chosen)} images")
    if out is not None:
        write_summary(
            out, {"command": ["parkenv", *sys.argv[1:]], "version": __version__, "seed": None, "rows": rows}
        )
        console.print(f"Images are in {out}")


def train_detector(
    out: Annotated[Path, typer.Option("--out", "-o", help="The model file to write, .npz.")],
    uiuc: Annotated[
        Path | None,
        typer.Option("--uiuc", help="UIUC's folder: trains on TrainImages (or TrainImages.tar.gz)."),
    ] = None,
    crops: Annotated[
        Path | None,
        typer.Option(
            "--crops", help="A folder with positives/ and negatives/ (or vehicles/ and non-vehicles/)."
        ),
    ] = None,
    front: Annotated[
        bool, typer.Option("--front", help="Train a model of fronts and rears, with a square window.")
    ] = False,
    normalization: Annotated[
        str, typer.Option("--normalization", help="neighbors, cell (the thesis's), or blocks.")
    ] = "neighbors",
    penalty: Annotated[
        float, typer.Option("--penalty", help="Penalty C of the support vector machine.")
    ] = 0.01,
    rounds: Annotated[int, typer.Option("--rounds", min=0, help="Rounds of hard-negative mining.")] = 3,
    jitter: Annotated[
        int,
        typer.Option("--jitter", min=0, help="Shifted copies of each car; 0 if the crops are not aligned."),
    ] = 2,
    misaligned: Annotated[
        int,
        typer.Option(
            "--misaligned",
            min=0,
            help="Misaligned crops of each car as negatives; 0 if the crops are not aligned.",
        ),
    ] = 2,
    folds: Annotated[
        int,
        typer.Option("--folds", min=0, help="Folds of a cross-validation on the crops; 0: none."),
    ] = 0,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of jitter, solver and folds.")] = 0,
) -> None:
    """Train a car model on photographs: aligned crops of cars, and images without cars.

    With `--folds`, 30 blocks of consecutive files are held out in turn: consecutive images often show the same car.

    Examples:
    * `parkenv train-detector --uiuc CarData --out side.npz`

    * `parkenv train-detector --crops kitti --front --normalization blocks --penalty 0.02 --jitter 0 --misaligned 0
    --rounds 0 --folds 3 --out front.npz`
    """
    from parkenv.perception.car_datasets import read_crop_folder, read_uiuc_training
    from parkenv.perception.cross_validation import cross_validated
    from parkenv.perception.hog import Descriptor
    from parkenv.perception.training import TrainingSettings, train

    if (uiuc is None) == (crops is None):
        raise InputError("give either --uiuc FOLDER or --crops FOLDER")
    if out.suffix != ".npz":
        raise InputError(f"--out {out}: want a name that ends in .npz")
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

    rates = [f"recall at {rate:.1%} false positives" for rate in FALSE_POSITIVES]
    table = make_table("Held-out crops", ["part", "cars", "others", "AUC", *rates])
    for i, score in enumerate(scores):
        table.add_row(
            str(i + 1),
            str(score.n_cars),
            str(score.n_others),
            f"{score.auc:.4f}",
            *(f"{r:.3f}" for r in score.recall),
        )
    count = len(scores)
    table.add_row(
        "mean", "", "", f"{sum(s.auc for s in scores) / count:.4f}",
        *(f"{sum(s.recall[k] for s in scores) / count:.3f}" for k in range(len(rates))),
    )  # fmt: skip
    return table


def evaluate_detector(
    uiuc: Annotated[Path, typer.Option("--uiuc", help="UIUC's folder as published (CarData).")],
    model: Annotated[str, typer.Option("--model", help=_MODEL_HELP)] = "side",
    seed: args.SeedOption = 0,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for summary.json and the curves.")] = Path(
        "results/detector"
    ),
) -> None:
    """Measure recall and precision of a side model on UIUC's test sets, by their matching rule.

    Example:
    * `parkenv evaluate-detector --uiuc CarData --model side`
    """
    from parkenv.evaluation.experiments.detector_scores import save_curves, score_on_uiuc
    from parkenv.evaluation.experiments.results import make_folder, write_summary
    from parkenv.perception.car_model import CarModel

    loaded = CarModel.load(model)
    make_folder(out)
    console = make_console()
    with Progress(console=console, disable=not console.is_terminal, transient=True) as progress:
        task = progress.add_task("Detecting", total=None)
        scores = score_on_uiuc(loaded, uiuc, on_image=lambda: progress.advance(task))
    table = make_table(None, list(scores[0].row))
    for score in scores:
        table.add_row(*(f"{v:.4f}" if isinstance(v, float) else str(v) for v in score.row.values()))
    console.print(table)
    save_curves(scores, f"model {model}", out / "recall_precision.png")
    rows = [s.row for s in scores]
    write_summary(
        out, {"command": ["parkenv", *sys.argv[1:]], "version": __version__, "seed": seed, "rows": rows}
    )
    console.print(f"Written: {out / 'recall_precision.png'}, summary.json")
