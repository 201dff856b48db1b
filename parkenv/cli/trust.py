"""Ask before running code that a file names, or that a model file may hold."""

from __future__ import annotations

import sys
from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING, Annotated

import typer
from pydantic import Field

from parkenv.errors import InputError
from parkenv.files.option import Option
from parkenv.files.user_class import find_module
from parkenv.studies.agent_spec import classes_in
from planners.names import ALGORITHMS

if TYPE_CHECKING:
    from pathlib import Path

    from parkenv.files.spec_file import Spec


Trust = Annotated[
    bool,
    Option(panel="Trust"),
    Field(
        description="Run the classes (MODULE:CLASS) and use the cluster named by the file or the folder of "
        "the run."
    ),
]
TrustModel = Annotated[
    bool,
    Option(panel="Trust"),
    Field(
        description="Convert archives of stable-baselines3 (ALGORITHM:FILE.zip) to model files; this runs the code in "
        "them."
    ),
]


def require_trust(spec: Spec, source: Path, trust: bool, given: Collection[str] = ()) -> None:
    """Refuse a specification that names classes or a cluster in fields that are not given; ask in a terminal."""
    classes = classes_in(spec, given)
    named = [f"{name} ({find_module(name) or 'not found'})" for name in classes]
    if "address" not in given and (address := getattr(spec, "address", None)):
        # A cluster's answers are pickled objects.
        named.append(f"tasks on the cluster at {address}")
    if trust or not named:
        return
    shown = ", ".join(named)
    if sys.stdin.isatty() and typer.confirm(f"{source} runs {shown}. Run this code?"):
        return
    raise InputError(f"{source}: would run {shown}; read that code, then add --trust")


def readable_models(agents: Sequence[str]) -> list[str]:
    """Return the agents, with archives of stable-baselines3 converted to model files; this runs the code in them."""
    readable = list(agents)
    for i, agent in enumerate(agents):
        algorithm, _, file = agent.partition(":")
        if algorithm in ALGORITHMS and file.endswith(".zip"):
            from planners.model_file import convert_archive

            converted = convert_archive(algorithm, file)
            typer.echo(f"Converted: {converted}; from now on, name that file")
            readable[i] = f"{algorithm}:{converted}"
    return readable
