"""The site links the repository whose address is in `pyproject.toml`, unless that is still a placeholder."""

import tomllib
from pathlib import Path
from typing import Any

PLACEHOLDER = "OWNER"
ROOT = Path(__file__).parents[2]


def on_config(config: Any, **_: Any) -> Any:
    """MkDocs calls this with its settings."""
    urls = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["urls"]
    if PLACEHOLDER not in urls["Repository"]:
        config.repo_url, config.site_url = urls["Repository"], urls["Documentation"]
    return config
