"""Train the packaged models on simulated images only: `python -m parkenv.perception.lab.build_models`.

This takes some minutes; equal seeds give equal files.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import typer
from rich.progress import track

from parkenv.perception.car_model import CarModel
from parkenv.perception.car_regions import END, SIDE
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
    return {
        name: train(
            [crop for photo in photos for crop in photo.crops[window]],
            empty,
            photos=peopled,
            descriptor=Descriptor(*window.size),
            region_aspect=window.aspect,
            car=window.car,
            end_on=window is END,
            settings=settings,
            trained_on=trained_on,
            progress=progress,
        )
        for name, window in (("side", SIDE), ("front", END))
    }


def main(scenes: int = 60, seed: int = 0, folder: Path = FOLDER) -> None:
    """Render the images, train, and write `side.npz` and `front.npz`."""
    pictures = track(simulated_photos(scenes, seed), "Taking pictures", total=FRAMES * scenes)
    folder.mkdir(parents=True, exist_ok=True)
    for name, model in build(list(pictures), seed, typer.echo).items():
        model.save(folder / f"{name}.npz")
        typer.echo(f"{folder / name}.npz")


if __name__ == "__main__":
    typer.run(main)
