"""Recall-precision curves of a detector."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from parkenv.perception.detection_scores import TestSetScore
from parkenv.show.figures.picture_files import picture


def save_curves(scores: Sequence[TestSetScore], title: str, path: Path) -> None:
    """Plot recall against 1 - precision, as in the papers on UIUC's sets."""
    with picture(path, (5.4, 4.4), layout=None) as figure:
        ax = figure.subplots()
        for score in scores:
            label = f"{score.row['test_set']}-scale: equal error at {score.row['eer']:.1%}"
            ax.plot(1.0 - score.curve.precision, score.curve.recall, label=label)
        ax.plot([0.0, 1.0], [1.0, 0.0], color="0.7", linewidth=0.8, linestyle=":")
        ax.set(xlim=(0.0, 0.3), ylim=(0.7, 1.005), xlabel="1 - precision", ylabel="recall", title=title)
        ax.legend(loc="lower right")
        figure.tight_layout()
