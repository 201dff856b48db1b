"""Fingerprints of what a run depends on, so that a resumed run notices changes."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from parkenv.errors import InputError
from parkenv.files.spec_file import Spec
from parkenv.studies.results import Row, read_settings
from parkenv.version import __version__


def search_settings(spec: Any, *fields: str) -> Row:
    """Return the settings of a study whose agents search.

    Args:
        spec: the study; has `scenarios` or a `scenario`, `agents` or an `agent`, and may have a `detector`.
        fields: further fields that a resumed run must share.

    Returns:
        The version, the scenarios, hashes of the files of the study and of its agents, the fields, and the detector.
    """
    scenarios = spec.scenarios if hasattr(spec, "scenarios") else (spec.scenario,)
    agents = (spec.agents or ()) if hasattr(spec, "agents") else (spec.agent,)
    detector = getattr(spec, "detector", None)
    versions = {}
    if detector is not None:
        from parkenv.perception.detector_registry import detector_version

        versions = {"detector": detector_version(detector)}
    return {
        "version": __version__,
        "scenarios": {s.title: flat_tables(s.model_dump(mode="json")) for s in scenarios},
        "files": fingerprints(spec.files()),
        "agent files": agent_fingerprints(agent.name for agent in agents),
        **{name: getattr(spec, name) for name in fields},
        **versions,
    }


def flat_tables(tables: Mapping[str, Any], before: str = "") -> Row:
    """Flatten nested tables into one with dotted keys.

    Examples:
        >>> flat_tables({"costs": {"failure_s": 10.0}, "goal": 0})
        {'costs.failure_s': 10.0, 'goal': 0}
    """
    flat: Row = {}
    for key, value in tables.items():
        flat |= (
            flat_tables(value, f"{before}{key}.") if isinstance(value, Mapping) else {f"{before}{key}": value}
        )
    return flat


def fingerprints(files: Iterable[Path]) -> dict[str, str]:
    """Return a short hash of each file's content, by path, so that a resumed run detects changed files."""
    return {str(path): hashlib.sha256(path.read_bytes()).hexdigest()[:16] for path in files}


def agent_fingerprints(names: Iterable[str]) -> dict[str, str]:
    """Return the fingerprints of agents that come from files: trained models and user-defined agents."""
    from planners.agent import agent_file

    files = {name: agent_file(name) for name in dict.fromkeys(names)}
    return {name: fingerprints([file])[str(file)] for name, file in files.items() if file is not None}


def require_unchanged(spec: Spec, folder: Path) -> None:
    """Check that the files of the run in a folder have not changed since."""
    before = (read_settings(folder) or {}).get("files", {})
    for path, now in fingerprints(spec.files()).items():
        if before.get(path) not in (None, now):
            raise InputError(f"{path} has changed since the run")
