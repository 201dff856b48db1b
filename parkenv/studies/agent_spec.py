"""Specification of agents in files and on command lines: a name, with any options that differ from the defaults."""

from __future__ import annotations

from collections.abc import Collection
from typing import Annotated, Any

from pydantic import BeforeValidator, ConfigDict, model_validator

from parkenv.files.known_names import DETECTOR_SUFFIXES
from parkenv.files.option import parse_call
from parkenv.files.spec_file import OrText, Spec
from planners.names import FILE_AGENTS

OptionValue = bool | int | float | str


class AgentSpec(Spec):
    """An agent and its options for `planners.make_agent`: `{ name = "mdp", failure_s = 90 }`."""

    model_config = ConfigDict(extra="allow")

    name: str

    @model_validator(mode="after")
    def _plain_options(self) -> AgentSpec:
        for option, value in self.options.items():
            if not isinstance(value, OptionValue) or value != value:
                raise ValueError(f"{option} to be a number, true, false or text, not {value!r}")
        return self

    @classmethod
    def of(cls, text: str) -> AgentSpec:
        return cls.parse(parse_call(text), "agent")

    @property
    def options(self) -> dict[str, Any]:
        return dict(self.model_extra or {})

    @property
    def label(self) -> str:
        return label_of(self.name, self.options)


def label_of(name: str, options: dict[str, Any]) -> str:
    """Format an agent with its options, such as `mdp(failure_s=90)`."""
    if not options:
        return name
    return f"{name}({','.join(f'{option}={_text(value)}' for option, value in options.items())})"


def _text(value: OptionValue) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:g}" if isinstance(value, float) else str(value)


def split_agents(text: str) -> list[str]:
    """Split a comma-separated list of agents; commas within brackets separate options.

    Examples:
        >>> split_agents("mdp(failure_s=90,gamma=1),oracle")
        ['mdp(failure_s=90,gamma=1)', 'oracle']
    """
    words, depth = [""], 0
    for character in text:
        depth += (character == "(") - (character == ")")
        if character == "," and depth <= 0:
            words.append("")
        else:
            words[-1] += character
    return [word.strip() for word in words if word.strip()]


def classes_in(spec: Spec, without: Collection[str] = ()) -> list[str]:
    """Return the classes `MODULE:CLASS` of a user's own that the fields name: agents, detectors and worlds."""
    classes: list[str] = []
    for field in (name for name in type(spec).model_fields if name not in without):
        value = getattr(spec, field)
        for part in value if isinstance(value, tuple) else (value,):
            named = field in ("clone", "detector", "world")
            name = part.name if isinstance(part, AgentSpec) else part if named else None
            if isinstance(name, str) and not name.lower().endswith(DETECTOR_SUFFIXES):
                before, colon, _ = name.partition(":")
                classes += (
                    [name] if colon and (field in ("detector", "world") or before not in FILE_AGENTS) else []
                )
            elif isinstance(part, Spec):
                classes += classes_in(part)
    return list(dict.fromkeys(classes))


def _tables(value: object) -> object:
    return parse_call(value) if isinstance(value, str) else value


AgentItem = Annotated[AgentSpec, BeforeValidator(_tables), OrText()]
"""An agent in a file: `"mdp"`, `"mdp(failure_s=90)"` or a table."""
