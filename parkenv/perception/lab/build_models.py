"""Train the packaged models on simulated images only: `python -m parkenv.perception.lab.build_models`.

This takes some minutes; equal seeds give equal files.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import typer
from rich.progress import track

from parkenv.perception.car_model import CarModel
from parkenv.perception.car_regions import END_ASPECT, END_CAR, SIDE_ASPECT, SIDE_CAR
from parkenv.perception.hog import Descriptor
from parkenv.perception.lab.simulated_photos import SimulatedPhoto, simulated_photos
from parkenv.perception.lab.simulated_streets import FRAMES
from parkenv.perception.lab.training import TrainingSettings, train

FOLDER = Path(__file__).parents[1] / "models"


def build(photos: list[SimulatedPhoto], seed: int, progress: Callable[[str], None]) -> dict[str, CarModel]:
    """Train the side and the front model on simulated images."""
    settings = TrainingSettings(penalty=0.1, shift=0.03, resize=0.05, seed=seed)
    empty = [p.labelled.image for p in photos if not len(p.labelled.boxes)]
    peopled = [p.labelled for p in photos if len(p.labelled.boxes)]
    trained_on = f"{len(photos)} simulated pictures, seed {seed}"
    side = train(
        [crop for p in photos for crop in p.sides],
        empty,
        photos=peopled,
        descriptor=Descriptor(128, 64),
        region_aspect=SIDE_ASPECT,
        car=SIDE_CAR,
        settings=settings,
        trained_on=trained_on,
        progress=progress,
    )
    front = train(
        [crop for p in photos for crop in p.ends],
        empty,
        photos=peopled,
        descriptor=Descriptor(128, 128),
        region_aspect=END_ASPECT,
        car=END_CAR,
        end_on=True,
        settings=settings,
        trained_on=trained_on,
        progress=progress,
    )
    return {"side": side, "front": front}


def main(scenes: int = 60, seed: int = 0, folder: Path = FOLDER) -> None:
    """Render the images, train, and write `side.npz` and `front.npz`."""
    pictures = track(simulated_photos(scenes, seed), "Taking pictures", total=FRAMES * scenes)
    folder.mkdir(parents=True, exist_ok=True)
    for name, model in build(list(pictures), seed, typer.echo).items():
        model.save(folder / f"{name}.npz")
        typer.echo(f"{folder / name}.npz")


if __name__ == "__main__":
    typer.run(main)
