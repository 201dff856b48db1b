"""Small JSON files with a format name and version."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from parkenv.errors import InputError
from parkenv.files.atomic_write import write_text
from parkenv.files.limited_reading import read_json


@dataclass(frozen=True)
class JsonFormat:
    """A file format.

    Args:
        name: value of `"format"` in the file.
        version: value of `"version"`; this version of the package reads and writes no other.
        meaning: description of the format for messages.
    """

    name: str
    version: int
    meaning: str

    def read(self, path: str | os.PathLike[str]) -> dict[str, Any]:
        """Read the fields of a file, without format and version."""
        try:
            content = read_json(Path(path))
        except InputError as error:
            raise InputError(f"{error}; want {self.meaning}") from error
        if not isinstance(content, dict) or content.pop("format", None) != self.name:
            raise InputError(f'{path}: want {self.meaning}, a JSON object with "format": "{self.name}"')
        if (version := content.pop("version", None)) != self.version:
            raise InputError(f"{path}: version is {version!r}, want {self.version}")
        return content

    def write(self, path: str | os.PathLike[str], fields: Mapping[str, Any]) -> None:
        """Write a file atomically."""
        content = {"format": self.name, "version": self.version, **fields}
        write_text(path, json.dumps(content, indent=1) + "\n")
