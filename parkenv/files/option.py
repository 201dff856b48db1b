"""Command-line options of the fields of specifications."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any

from pydantic import Field

from parkenv.errors import InputError


@dataclass(frozen=True)
class Option:
    """Make a field of a specification an option of the commands that run it: an annotation of the field.

    Type, bounds, default and description are the field's own. A field with several such annotations has several
    options, which exclude each other.

    Args:
        name: The option, such as `--episodes`.  [default: the field's name with dashes]
        short: Its short form, such as `-n`.
        takes: What it takes, such as `X,Y`.  [default: made from the field's type and bounds]
        default: Text on the default.  [default: the field's default; none where that is None]
        panel: Heading that it stands under in help pages.
        parse: Convert text to the field's value.  [default: split lists at commas, and convert numbers]
        sets: Other fields of the same table that the option sets.
        description: Instead of the field's.
        argument: Given by its place, without a name.
        repeat: Given once for each value of a list; arguments are anyway.
    """

    name: str = ""
    short: str = ""
    takes: str = ""
    default: str = ""
    panel: str = "Options"
    parse: Callable[[str], Any] | None = None
    sets: Mapping[str, Any] = field(default_factory=dict, hash=False)
    description: str = ""
    argument: bool = False
    repeat: bool = False


_MARKS = {mark.name for mark in fields(Option)} - {"description"}


def option(value: Any, description: str, **more: Any) -> Any:
    """Return a field that is an option; `more` are arguments of `Option`, and of pydantic's `Field`, such as bounds."""
    marks = {name: more.pop(name) for name in _MARKS & more.keys()}
    field = Field(value, description=description, **more)
    field.metadata.append(Option(**marks))
    return field


@dataclass(frozen=True)
class Inside:
    """Choose the fields of a table, at any depth, that are options: an annotation of the field with the table."""

    without: tuple[str, ...] = ()  # options to leave out
    only: tuple[str, ...] | None = None  # the options to have; None: all

    def has(self, name: str) -> bool:
        return name not in self.without and (self.only is None or name in self.only)


def words_in(text: str) -> list[str]:
    words = [word.strip() for word in text.split(",") if word.strip()]
    if not words:
        raise InputError(f"is {text!r}, want values separated by commas")
    return words


def numbers_in(text: str, count: int | None = None) -> list[float]:
    """Convert comma-separated numbers, `count` finite ones if it is given."""
    try:
        numbers = [float(word) for word in text.split(",")]
    except ValueError:
        numbers = []
    if not numbers or (count is not None and (len(numbers) != count or not all(map(math.isfinite, numbers)))):
        wanted = (
            "a number" if count == 1 else f"{count or ''} numbers separated by commas, e.g. 10,90".strip()
        )
        raise InputError(f"is {text!r}, want {wanted}")
    return numbers


def columns_in(text: str | None) -> dict[str, list[str]]:
    """Convert names of columns by what they mean, `bay=Marker,taken=green+red`: those joined by + are added up."""
    pairs = [word.partition("=") for word in (text or "").split(",") if word.strip()]
    if not all(meaning.strip() and names.strip() for meaning, _, names in pairs):
        raise InputError(f"columns is {text!r:.80}, want MEANING=COLUMN,... such as bay=Marker,time=When")
    return {meaning.strip(): [name.strip() for name in names.split("+")] for meaning, _, names in pairs}


def seconds_of_minutes(text: str) -> float:
    return 60.0 * numbers_in(text, 1)[0]


def parse_call(text: str, kind: str = "agent") -> dict[str, Any]:
    """Parse a name with any options in brackets, such as `mdp(failure_s=90)`: the table of its `name` and its options.

    Examples:
        >>> parse_call("mdp(failure_s=90,solver=policy_iteration)")
        {'name': 'mdp', 'failure_s': 90, 'solver': 'policy_iteration'}
    """
    name, bracket, rest = text.strip().partition("(")
    if not bracket:
        return {"name": name}
    if not rest.endswith(")") or "(" in rest or ")" in rest[:-1]:
        raise InputError(f"{kind} {text!r}, want NAME or NAME(OPTION=VALUE,...)")
    table: dict[str, Any] = {"name": name.strip()}
    for part in rest[:-1].split(","):
        option, equals, value = (word.strip() for word in part.partition("="))
        if not (option.isidentifier() and equals and value) or option in table:
            raise InputError(f"{kind} {text!r}: option {part.strip()!r}, want OPTION=VALUE, each option once")
        table[option] = _value(value)
    return table


def _value(text: str) -> bool | int | float | str:
    if text in ("true", "false"):
        return text == "true"
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text
