"""The header of a model file: the card, and where the tensors are.

A model file has the layout of safetensors: the length of the header, 8 bytes, little-endian; the header, JSON; the
tensors. Its metadata holds the card. It is read here without the library of that name: nothing of it runs code.
"""

from __future__ import annotations

import os
from typing import Any, NamedTuple

from parkenv.errors import InputError
from parkenv.files.limited_reading import parse_json

CARD_KEY = "parkenv"
"""Key of the card in the metadata."""
_MAX_HEADER = 1_000_000


class ModelHeader(NamedTuple):
    """Header of a model file."""

    card: dict[str, Any]  # content of the card, not yet validated
    tensors: dict[str, Any]  # entries with dtype, shape and data_offsets by name, not yet validated
    body: memoryview  # the tensors


def read_header(data: bytes, path: str | os.PathLike[str]) -> ModelHeader:
    """Read the header of a model file.

    Args:
        data: content of the file.
        path: its name, for messages.
    """
    size = int.from_bytes(data[:8], "little")
    if data[8:9] != b"{" or size > min(_MAX_HEADER, len(data) - 8):
        raise InputError(f"{path}: no model file, or a damaged one")
    header = parse_json(data[8 : 8 + size], f"{path}: header")
    metadata = header.pop("__metadata__", None)
    text = metadata.get(CARD_KEY) if isinstance(metadata, dict) else None
    if not isinstance(text, str):
        raise InputError(f"{path}: no model of `parkenv train`: it has no card")
    card = parse_json(text, f"{path}: card")
    if not isinstance(card, dict):
        raise InputError(f"{path}: card is a {type(card).__name__}, want a JSON object")
    return ModelHeader(card, header, memoryview(data)[8 + size :])
