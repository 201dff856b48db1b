"""`parkenv detect`, `train-detector`, `evaluate-detector`: car detection in image files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from parkenv.cli import arguments as args
from parkenv.cli.arguments import words
from parkenv.cli.detector_drives import show
from parkenv.cli.study_run import run_study
from parkenv.cli.tables import make_console, make_table, progress_bar, save_summary
from parkenv.errors import InputError
from parkenv.files.file_names import distinct_names, file_name
from parkenv.show.plurals import plural

if TYPE_CHECKING:
    from rich.table import Table

    from parkenv.perception.car_model import CarModel
    from parkenv.perception.detector import Detector
    from parkenv.perception.lab.car_datasets import LabelledImage
    from parkenv.perception.lab.cross_validation import CropScore


def detect(
    images: list[Path],
    /,
    model: list[str] | None = None,
    detector: str | None = None,
    threshold: float = 0.5,
    least_height: float | None = None,
    step: int = 1,
    out: Path | None = None,
) -> None:
    """Find cars in photographs, videos and recorded drives.

    With --out, pictures and films with the boxes drawn in are written, and all boxes with frame and time as a table.
    View and visible fraction are those of the detector: HOG knows sides and ends alone, `net` all three views.

    Examples:
        parkenv detect photo.png --out results/cars
        parkenv detect photos --model side --threshold 0.8
        parkenv detect drive.mp4 --detector yolo.onnx --step 5 --out results/cars
        parkenv detect drive.mcap --detector net --out results/cars

    Options:
        images (FILE|DIR): Images, videos, recorded drives (MCAP, rosbags; extra bags), or folders of them.
        model (NAME|FILE): side, front, or an .npz of `parkenv train-detector`; repeatable.  [default: side and front]
        detector (NAME|FILE|MODULE:CLASS): Instead of models: net, the packaged network, another (.onnx), or a class
            of your own.  [default: none]
        threshold (P): Least probability of a reported car.
        least_height (PX >= 8): Height of the smallest regions searched, px.  [default: the model's]
        step (N >= 1): Of a video, look at every N-th frame.
        out, -o (DIR): Folder for NAME_cars.png, NAME_cars.mp4, boxes.csv and summary.json.  [default: none]
    """
    from parkenv.files.atomic_write import make_folder
    from parkenv.files.csv_tables import write_csv
    from parkenv.studies.sensing.detection_run import (
        BOX_COLUMNS,
        detect_in_image,
        detect_in_video,
        require_readable,
    )

    finder = _finder(model, detector, threshold, least_height)
    chosen = require_readable(images)  # a damaged one is refused before any work
    names = distinct_names([one if isinstance(one, Path) else one.file for one in chosen])
    drawings = [
        file_name(f"{name}_cars", ".png" if isinstance(one, Path) else ".mp4")
        for one, name in zip(chosen, names, strict=True)
    ]
    if out is not None:
        originals = {(one if isinstance(one, Path) else one.path).resolve() for one in chosen}
        for drawing in drawings:
            if (out / drawing).resolve() in originals:
                kind = "a video" if drawing.endswith(".mp4") else "an image"
                raise InputError(f"--out {out}: {drawing} would replace {kind} that is searched")
        make_folder(out)
    console = make_console()
    boxes: list[dict[str, Any]] = []
    videos: list[dict[str, Any]] = []
    total: int | None = 0
    for one in chosen:
        frames = 1 if isinstance(one, Path) else one.frames and -(-one.frames // step)
        total = None if total is None or frames is None else total + frames
    with progress_bar(console, "frames") as progress:
        task = progress.add_task("Detecting", total=total)
        for one, drawing in zip(chosen, drawings, strict=True):
            drawn = None if out is None else out / drawing
            if not isinstance(one, Path):
                found = detect_in_video(one, finder, threshold, step, drawn, lambda: progress.advance(task))
                videos.append(found.row)
                boxes += found.boxes
            else:
                boxes += detect_in_image(one, finder, threshold, drawn)
                progress.advance(task)
    headings = ["file", "left", "top", "right", "bottom", "probability", "view", "visible_fraction"]
    cells = [
        (b["file"], *(f"{b[side]:.0f}" for side in headings[1:5]), f"{b['probability']:.2f}", b["view"],
         "" if b["visible_fraction"] is None else f"{b['visible_fraction']:.2f}")
        for b in boxes
        if b["frame"] is None
    ]  # fmt: skip
    n_images = len(chosen) - len(videos)
    if n_images:
        console.print(make_table(None, [h.removesuffix("_fraction") for h in headings], cells))
        console.print(f"{plural(len(cells), 'car')} in {plural(n_images, 'image')}")
    for video in videos:
        console.print(
            f"{video['file']}: {plural(video['frames'], 'frame')} of {video['seconds']:.1f} s, "
            f"{plural(video['boxes'], 'box', 'boxes')}, at most {plural(video['most_cars'], 'car')} in a frame"
        )
    if out is not None:
        write_csv(out / "boxes.csv", BOX_COLUMNS, boxes)
        rows = [
            {"file": b["file"], "box": [b[side] for side in headings[1:5]]} | {k: b[k] for k in headings[5:]}
            for b in boxes
            if b["frame"] is None
        ]
        save_summary(out, None, rows, videos=videos)
        console.print(f"Pictures, films, boxes.csv and summary.json are in {out}")


def _finder(
    model: list[str] | None, detector: str | None, threshold: float, least_height: float | None
) -> Detector:
    """Return the detector that the options describe."""
    from parkenv.perception.detector_registry import make_detector
    from parkenv.perception.hog_detector import HogDetector

    if detector is None:
        return HogDetector.load(*(model or ()), threshold=threshold, least_height=least_height)
    if model or least_height is not None:
        raise InputError(
            f"--detector {detector} excludes --model and --least-height, which choose HOG models"
        )
    if not 0.0 < threshold < 1.0:
        raise InputError(f"--threshold is {threshold}, want between 0 and 1")
    return make_detector(detector, threshold)


def train_detector(
    out: Path,
    uiuc: Path | None = None,
    crops: Path | None = None,
    labels: Path | None = None,
    simulated: int | None = None,
    images: Path | None = None,
    classes: str | None = None,
    front: bool = False,
    folds: int = 0,
    seed: int = 0,
    *,
    normalization: Literal["neighbors", "cell", "blocks"] = "neighbors",
    penalty: float = 0.03,
    rounds: int = 3,
    jitter: int = 4,
    misaligned: int = 2,
    enlarged: float = 2.0,
    steps: int = 9_000,
    pictures: Path | None = None,
) -> None:
    r"""Train a car model on photographs, or a network on simulated pictures.

    A HOG model (.npz) learns from photographs with labelled boxes, or from aligned crops of cars and images without
    cars; a network like the packaged `net` (.onnx) from simulated pictures alone.

    With `--folds`, 30 blocks of consecutive files are held out in turn: consecutive images often show the same car. The
    cars that are held out are also searched in made photographs: pasted at 0.8 to 2.2 times their size into mosaics of
    the images without cars that are held out.

    Examples:
        parkenv train-detector --uiuc CarData --out side.npz
        parkenv train-detector --labels coco.json --images pictures -o side.npz
        parkenv train-detector --labels yolo --front -o front.npz
        parkenv train-detector --crops kitti --front --out front.npz \
            --normalization blocks --penalty 0.02 \
            --jitter 0 --misaligned 0 --enlarged 0
        parkenv train-detector --simulated 94 --out my-net.onnx

    Options:
        out, -o (FILE.npz|FILE.onnx): The file to write: a HOG model, or with --simulated a network.
        uiuc (DIR): UIUC's folder: trains on TrainImages (or TrainImages.tar.gz).
        crops (DIR): Instead: a folder with positives/, negatives/ (or vehicles/, non-vehicles/).
        labels (FILE.json|DIR): Instead: labelled photographs, a file of COCO, or a folder of YOLO (images/ and labels/,
            or .txt beside the pictures; names in data.yaml or classes.txt).
        simulated (N >= 2): Instead: streets, 20 pictures of each; trains a network (needs the extra detector).
        images (DIR): Folder of the pictures of COCO.  [default: the file's]
        classes (NAME[,...]): Classes of the labels that are cars.  [default: car, van, truck, bus and the like]
        front: Train a model of fronts and rears, with a square window.
        folds (N >= 0): Folds of a cross-validation on the crops; 0: none.
        seed (N >= 0): Seed of jitter, solver and folds; of pictures and weights of a network.

    Training of a HOG model:
        normalization (NAME): neighbors, cell (the thesis's), or blocks.
        penalty (C): Penalty of the support vector machine.
        rounds (N >= 0): Rounds of hard-negative mining.
        jitter (N >= 0): Shifted copies of each car; 0 if the crops are not aligned.
        misaligned (N >= 0): Misaligned crops of each car as negatives; 0 if the crops are not aligned.
        enlarged (X): Crops are also mined enlarged so many times, so that parts of large cars become negatives; 0:
            none, if the crops are not aligned. With --labels, the photographs are mined instead.

    Training of a network:
        steps (N >= 1): Steps, each with 16 new examples.
        pictures (DIR): Folder in which the simulated pictures are kept; those of an earlier training are read.
            [default: none]
    """
    from parkenv.files.atomic_write import check_writable
    from parkenv.perception.car_regions import END_ASPECT, END_CAR, SIDE_ASPECT, SIDE_CAR
    from parkenv.perception.hog import Descriptor
    from parkenv.perception.lab.car_datasets import read_crop_folder, read_uiuc_training
    from parkenv.perception.lab.cross_validation import cross_validated
    from parkenv.perception.lab.labelled_folders import crops_of, read_labels
    from parkenv.perception.lab.training import TrainingSettings, train

    if sum(source is not None for source in (uiuc, crops, labels, simulated)) != 1:
        raise InputError("give one of --uiuc FOLDER, --crops FOLDER, --labels FILE|FOLDER and --simulated N")
    if simulated is not None:
        _train_network(out, simulated, steps, seed, pictures)
        return
    if labels is None and (images is not None or classes is not None):
        raise InputError("--images and --classes go with --labels")
    if out.suffix != ".npz":
        raise InputError(f"--out {out}: want a name that ends in .npz")
    check_writable(out)
    photos: list[LabelledImage] = []
    alignment: dict[str, Any] = {}
    if labels is not None:
        named = words("--classes", classes) if classes is not None else ()
        data, photos = crops_of(read_labels(labels, images, named), end_on=front, seed=seed)
        alignment = {"region_aspect": END_ASPECT, "car": END_CAR} if front else {}
        alignment = alignment or {"region_aspect": SIDE_ASPECT, "car": SIDE_CAR}
    else:
        data = read_uiuc_training(uiuc) if uiuc is not None else read_crop_folder(Path(str(crops)))
    descriptor = Descriptor(128, 128 if front else 64, normalization)
    settings = TrainingSettings(
        penalty=penalty, rounds=rounds, jitter=jitter, misaligned=misaligned, enlarged=enlarged, seed=seed
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
            trained_on=f"{len(data.positives)} crops and {len(data.negatives)} others in {uiuc or crops or labels}",
            photos=photos,
            **alignment,
            progress=status.update,
        )
    model.save(out)
    console.print(f"Trained on {model.trained_on}. Written: {out}")


def _train_network(out: Path, streets: int, steps: int, seed: int, pictures: Path | None) -> None:
    from parkenv.files.atomic_write import atomic_write, check_writable

    if out.suffix != ".onnx":
        raise InputError(f"--out {out}: want a name that ends in .onnx for a network")
    check_writable(out)
    try:
        from parkenv.perception.lab.center_training import CenterTrainingSettings, build_network
    except ImportError as error:
        raise InputError(
            f"--simulated needs {error.name}, which is not installed: pip install 'parkenv[detector]'"
        ) from error
    console = make_console()
    with console.status("Training") as status:
        built = build_network(
            streets, CenterTrainingSettings(steps=steps, seed=seed), pictures, progress=status.update
        )
    with atomic_write(out) as beside:
        beside.write_bytes(built.data)
    with atomic_write(out.with_suffix(".toml")) as beside:
        beside.write_text(built.settings)
    console.print(f"Trained on {built.card['trained_on']}. Written: {out}, {out.with_suffix('.toml').name}")


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


def evaluate_detector(
    uiuc: Path | None = None,
    model: str = "side",
    out: Path = Path("results/detector"),
    *,
    detector: str | None = None,
    crops: Path | None = None,
    drives: str | None = None,
    pictures: int = 40,
    false_positives: float = 0.1,
    seed: int = 0,
    sessions: int = 0,
    rig: str | None = None,
    every: float = 2.5,
    misses: int = 0,
    machines: args.Machines,
) -> None:
    r"""Measure a detector on UIUC's test sets or on crops of cars, or compare detectors on simulated drives.

    On UIUC's sets, by their matching rule, a HOG model (--model) is searched at the sizes of the set's cars. Any other
    detector looks as it does in a survey; its boxes of other sizes, and of fronts and rears, are left out, as the sets
    label neither, and a box more than twice as wide as high is a side. On crops, the fraction of cars found is given at
    1 % and 10 % false positives, with intervals over 30 blocks of consecutive files. On pictures of drives, every
    detector reports so many boxes that it has equally many false positives; a car counts if it is within 20 m, 16 px
    high, and 30 % of it are visible.

    With --sessions, whole survey drives are compared, as `parkenv survey` makes them: cars found, slots right, error of
    the map, by weather, distance, and what makes a car hard to find. All detectors look at the same pictures. Each rig
    and detector has a folder with its map. The same command goes on after an interruption.

    Examples:
        parkenv evaluate-detector --uiuc CarData --model side
        parkenv evaluate-detector --uiuc CarData --detector net
        parkenv evaluate-detector --crops kitti --detector net
        parkenv evaluate-detector --drives campus --detector hog,net
        parkenv evaluate-detector --drives campus --detector hog,net \
            --sessions 21 --rig laser,stereo --misses 8

    Options:
        uiuc (DIR): UIUC's folder as published (CarData).
        model (NAME|FILE): side, front, or an .npz of `parkenv train-detector`; any other detector is taken as with
            --detector.
        detector (NAME|FILE|MODULE:CLASS): Instead of a model: hog, net, a network (.onnx), or a class of your own; with
            --drives several, separated by commas.  [default: none]
        crops (DIR): Instead of --uiuc: a folder with positives/, negatives/ (or vehicles/, non-vehicles/).
        out, -o (DIR): Folder for summary.json, tables and figures.

    On drives:
        drives (SCENARIO): Instead of --uiuc: pictures along the survey's route of a scenario, or whole drives.
        pictures (N >= 1): Pictures in each of the five weathers.
        false_positives (X >= 0): Boxes without a car in a picture, on average.
        seed (N >= 0): Seed of cars, light and noise.

    On whole drives:
        sessions (N >= 0): Survey drives for each rig; 0: only pictures.
        rig (NAME[,...]): laser, stereo, both_sides.  [default: laser]
        every (M >= 0.1): Metres between captures.
        misses (N >= 0): Missed cars of each kind on a contact sheet for each rig and detector; 0: none.
    """
    if sum(source is not None for source in (uiuc, crops, drives)) != 1:
        raise InputError("give one of --uiuc FOLDER, --crops FOLDER and --drives SCENARIO")
    if not sessions and (rig is not None or misses):
        raise InputError("--rig and --misses go with --sessions")
    if sessions and drives is None:
        raise InputError("--sessions goes with --drives")
    if drives is not None:
        names = words("--detector", detector or model)
        if sessions:
            from parkenv.studies.sensing.detector_study import DetectorStudy

            study = DetectorStudy().changed("--rig", rigs=words("--rig", rig or "laser"))
            study = study.changed(
                scenario=drives, detectors=names, sessions=sessions, every=every, seed=seed, misses=misses,
                **machines.given,
            )  # fmt: skip
            run_study(study, out, args.ReportedRun(), show)
            return
        _evaluate_on_drives(drives, names, pictures, false_positives, seed, out)
    elif crops is not None:
        _evaluate_on_crops(crops, model, detector, out)
    elif uiuc is not None:
        _evaluate_on_uiuc(uiuc, model, detector, out)


def _evaluate_on_drives(
    scenario: str, names: Sequence[str], pictures: int, false_positives: float, seed: int, out: Path
) -> None:
    from parkenv.files.atomic_write import make_folder
    from parkenv.perception.detector_registry import make_detector
    from parkenv.scenarios.build import make_scenario
    from parkenv.studies.sensing.detector_drives import drive_pictures, score_on_drives

    if pictures < 1:
        raise InputError(f"--pictures is {pictures}, want at least 1")
    if not 0.0 <= false_positives <= 100.0:
        raise InputError(f"--false-positives is {false_positives}, want 0 to 100")
    if seed < 0:
        raise InputError(f"--seed is {seed}, want at least 0")
    detectors = {name: make_detector(name, 0.01) for name in names}
    its = make_scenario(scenario)
    make_folder(out)
    console = make_console()
    with progress_bar(console, "pictures") as progress:
        task = progress.add_task("Drawing", total=None)
        taken = []
        for picture in drive_pictures(its, pictures, seed):
            taken.append(picture)
            progress.advance(task)
        task = progress.add_task("Detecting", total=len(taken) * len(names))
        rows = score_on_drives(detectors, taken, false_positives, lambda: progress.advance(task))
    cells = [
        (row["part"], str(row["cars"]), *("" if row[n] is None else f"{row[n]:.1%}" for n in names))
        for row in rows
    ]
    console.print(make_table(None, ["part", "cars", *names], cells))
    save_summary(out, None, rows)
    console.print(
        f"Recall on {plural(len(taken), 'picture')} at {false_positives:g} false positives in a picture. "
        f"Written: {out / 'summary.json'}"
    )


def _model_or_detector(model: str, detector: str | None) -> CarModel | Detector:
    from parkenv.perception.car_model import PACKAGED_MODELS, CarModel
    from parkenv.perception.detector_registry import make_detector
    from parkenv.perception.hog_detector import LEAST_SCORED

    if detector is None and (model in PACKAGED_MODELS or model.lower().endswith(".npz")):
        return CarModel.load(model)
    return make_detector(detector or model, LEAST_SCORED)


def _evaluate_on_crops(folder: Path, model: str, detector: str | None, out: Path) -> None:
    from parkenv.files.atomic_write import make_folder
    from parkenv.perception.lab.car_datasets import read_crop_folder
    from parkenv.studies.sensing.detector_scores import recall_on_crops

    loaded, crops = _model_or_detector(model, detector), read_crop_folder(folder)
    make_folder(out)
    console = make_console()
    with progress_bar(console, "crops") as progress:
        task = progress.add_task("Detecting", total=len(crops.positives) + len(crops.negatives))
        rows = recall_on_crops(loaded, crops, on_image=lambda: progress.advance(task))
    cells = [
        (
            f"{r['false_positives']:.0%}",
            f"{r['recall']:.1%} ± {100 * r['interval']:.1f}",
            str(r["cars"]),
            str(r["others"]),
        )
        for r in rows
    ]
    console.print(make_table(None, ["false positives", "cars found", "cars", "others"], cells))
    save_summary(out, None, rows)
    console.print(f"Written: {out / 'summary.json'}")


def _evaluate_on_uiuc(uiuc: Path, model: str, detector: str | None, out: Path) -> None:
    from rich.progress import Progress

    from parkenv.files.atomic_write import make_folder
    from parkenv.perception.car_model import CarModel
    from parkenv.studies.sensing.detector_scores import save_curves, score_on_uiuc

    loaded = _model_or_detector(model, detector)
    make_folder(out)
    console = make_console()
    with Progress(console=console, disable=not console.is_terminal, transient=True) as progress:
        task = progress.add_task("Detecting", total=None)
        scores = score_on_uiuc(loaded, uiuc, on_image=lambda: progress.advance(task))
    rows = [score.row for score in scores]
    cells = ([f"{v:.4f}" if isinstance(v, float) else str(v) for v in row.values()] for row in rows)
    console.print(make_table(None, list(rows[0]), cells))
    kind = "model" if isinstance(loaded, CarModel) else "detector"
    save_curves(scores, f"{kind} {detector or model}", out / "recall_precision.png")
    save_summary(out, None, rows)
    console.print(f"Written: {out / 'recall_precision.png'}, summary.json")
