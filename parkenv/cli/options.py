"""Options of a command from the fields of its class, and the command that given options make."""

from __future__ import annotations

import inspect
import types
from abc import abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from keyword import iskeyword
from pathlib import Path
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    ClassVar,
    Literal,
    Self,
    TypeVar,
    Union,
    get_args,
    get_origin,
)

from pydantic.fields import FieldInfo

from parkenv.cli.tables import make_console
from parkenv.errors import InputError, require
from parkenv.files.option import Inside, Option
from parkenv.files.spec_file import Spec, models_in

if TYPE_CHECKING:
    from rich.console import Console

SpecT = TypeVar("SpecT", bound=Spec)
_LETTERS = {int: "N", float: "X", Path: "FILE"}


# What was given for each option, such as `--episodes`: text, a tuple of texts, or for switches a bool.
Given = Mapping[str, Any]


class Command(Spec):
    """A command: its fields are its arguments and options; its docstring and examples are on its help page."""

    examples: ClassVar[str]
    soft_wrap: ClassVar[bool] = False  # whether lines are printed whole, however wide the terminal is

    @classmethod
    def of(cls, given: Given) -> Self:
        return spec_of(cls, given)

    @cached_property
    def console(self) -> Console:
        return make_console(soft_wrap=self.soft_wrap)

    def say(self, *texts: str, **how: Any) -> None:
        for text in texts:
            self.console.print(text, **how)

    @abstractmethod
    def run(self) -> None: ...


@dataclass(frozen=True)
class FieldOption:
    path: tuple[str, ...]  # names of the tables, and of the field
    field: FieldInfo
    option: Option  # how it is given on the command line
    model: type[Spec]  # class of the table that the field belongs to

    @property
    def name(self) -> str:
        name = self.path[-1]
        return self.option.name or (name.upper() if self.option.argument else f"--{name.replace('_', '-')}")

    @property
    def parameter(self) -> str:
        name = self.name.lstrip("-").replace("-", "_").lower()
        # An argument and an option of the same name set the same field.
        return f"{name}_" if iskeyword(name) or self.option.argument else name

    @property
    def is_required(self) -> bool:
        return len(self.path) == 1 and self.field.is_required()

    @property
    def is_switch(self) -> bool:
        return self.field.annotation is bool

    @property
    def has_opposite(self) -> bool:
        """Whether the switch also has the form `--no-...`: it is on by default, or in the file of a study."""
        return self.is_switch and (bool(self.field.default) or len(self.path) > 1)

    @property
    def is_repeated(self) -> bool:
        is_list = get_origin(_bare(self.field.annotation)) is tuple
        return self.option.repeat or (self.option.argument and is_list)

    @property
    def kind(self) -> Any:
        kind = _bare(self.field.annotation)
        return get_args(kind)[0] if self.is_repeated else kind

    @property
    def takes(self) -> str:
        default = "DIR" if self.name == "--out" else self.name if self.option.argument else ""
        takes = self.option.takes or default
        return takes if len(takes) > 2 else _taken(self.kind, takes)

    @property
    def choices(self) -> tuple[str, ...]:
        return get_args(self.kind) if get_origin(self.kind) is Literal else ()

    @property
    def help(self) -> str:
        default = self.option.default or self._default()
        text = self.option.description or self.field.description or ""
        return f"{text}  [default: {default}]" if default else text

    def _default(self) -> str:
        value = self.field.get_default(call_default_factory=True)
        if self.is_switch:
            return "" if not self.has_opposite else self.name[2:] if value else f"no-{self.name[2:]}"
        if self.option.description or value is None or self.is_required:
            return ""
        return ",".join(_shown(part) for part in (value if isinstance(value, tuple) else (value,)))

    def value(self, given: Any) -> object:
        if self.is_switch:
            return given
        convert = self.option.parse or partial(_converted, self.kind)
        try:
            return tuple(map(convert, given)) if self.is_repeated else convert(given)
        except InputError as error:
            begun = f"{self.name} " if str(error).startswith(("is ", "names ")) else ""
            raise InputError(f"{begun}{error}") from None


_Values = dict[tuple[str, ...], tuple[FieldOption, object]]  # of options and what they are set to, by path


def field_options(model: type[Spec], path: tuple[str, ...] = ()) -> Iterator[FieldOption]:
    """Yield the options of a specification and of its tables; its own replace those of the same name in a table.

    What a command itself declares is an option anyway; other fields if they have an `Option`.
    """
    of_command = {
        name for kind in model.__mro__ if issubclass(kind, Command) for name in inspect.get_annotations(kind)
    }
    own = []
    for name, field in model.model_fields.items():
        marks = {mark.name: mark for mark in field.metadata if isinstance(mark, Option)}
        if not marks and name in of_command and not any(models_in(field.annotation)):
            marks = {"": Option()}
        own += [FieldOption((*path, name), field, mark, model) for mark in marks.values()]
    names = {option.name for option in own}
    for name, field in model.model_fields.items():
        yield from (option for option in own if option.path[-1] == name)
        inside = [Inside(), *(mark for mark in field.metadata if isinstance(mark, Inside))][-1]
        for inner in models_in(field.annotation):
            if issubclass(inner, Spec):
                for option in field_options(inner, (*path, name)):
                    if option.name not in names and inside.has(option.name):
                        yield option


def spec_of(model: type[SpecT], given: Given, base: SpecT | None = None) -> SpecT:
    """Return a specification as options make it: `base` changed, or a new one.

    An option of a table in a list, such as that of scenarios, changes every table of the list; options that set whole
    tables, such as `--scenario`, are applied first.
    """
    chosen: dict[tuple[str, ...], FieldOption] = {}
    for option in field_options(model if base is None else type(base)):
        if option.name in given:
            other = chosen.setdefault(option.path, option)
            require(other.name == option.name, f"{other.name} and {option.name} exclude each other")
    return _with_values(model, base, {path: (o, o.value(given[o.name])) for path, o in chosen.items()})


def _with_values(model: type[SpecT], base: SpecT | None, values: _Values) -> SpecT:
    own = {path[0]: (option, value) for path, (option, value) in values.items() if len(path) == 1}
    sets = {name: value for option, _ in own.values() for name, value in option.option.sets.items()}
    names = {name: option.name for name, (option, _) in own.items()}
    fields = sets | {name: value for name, (_, value) in own.items()}
    spec = base
    if spec is None:
        spec = model.parse(fields, names)
    elif fields:
        spec = spec.changed(names, **fields)
    for name in dict.fromkeys(path[0] for path in values if len(path) > 1):
        inner = {path[1:]: value for path, value in values.items() if path[0] == name and len(path) > 1}
        table = getattr(spec, name)
        if table is None:
            annotation = type(spec).model_fields[name].annotation
            table = () if get_origin(_bare(annotation)) is tuple else next(models_in(annotation))()
        several = isinstance(table, tuple)
        tables = table if several else (table,)
        tables = tuple(_with_values(type(table), table, inner) for table in tables)
        options = ", ".join(option.name for option, _ in inner.values())
        if tables:
            spec = spec.changed(options, **{name: tables if several else tables[0]})
    return spec


def _bare(annotation: Any) -> Any:
    while True:
        if get_origin(annotation) is Annotated:
            annotation = get_args(annotation)[0]
        elif get_origin(annotation) in (Union, types.UnionType):
            kinds = [kind for kind in get_args(annotation) if kind is not type(None)]
            if len(kinds) > 1:
                return None
            annotation = kinds[0]
        else:
            return annotation


def _converted(annotation: Any, text: str) -> object:
    kind = _bare(annotation)
    if get_origin(kind) is tuple:
        if text == "none":
            return ()
        return [_converted(get_args(kind)[0], word.strip()) for word in text.split(",") if word.strip()]
    if kind is Path:
        return Path(text)
    if kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            return text
    return text


def _taken(kind: Any, letter: str = "") -> str:
    if get_origin(kind) is Literal:
        return "|".join(get_args(kind))
    if get_origin(kind) is tuple:
        return f"{_taken(_bare(get_args(kind)[0]), letter)}[,...]"
    return letter or _LETTERS.get(kind, "TEXT")


def _shown(value: object) -> str:
    for name in ("label", "title"):
        if isinstance(shown := getattr(value, name, None), str) and isinstance(value, Spec):
            return shown
    return f"{value:g}" if isinstance(value, float) else str(value)
