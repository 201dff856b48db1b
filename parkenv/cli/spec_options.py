"""Options of a command from the fields of its specification, and the specification that given options make."""

from __future__ import annotations

import types
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

import annotated_types
from pydantic.fields import FieldInfo

from parkenv.cli.arguments import saved
from parkenv.cli.trust import readable_models, require_trust
from parkenv.errors import InputError
from parkenv.files.file_names import file_name
from parkenv.files.option import Option, words_in
from parkenv.files.spec_file import Spec, models_in
from parkenv.scenarios.spec import ScenarioSpec
from parkenv.studies.agent_spec import split_agents

SpecT = TypeVar("SpecT", bound=Spec)
_SHOWN_BOUND = 1e6  # larger bounds only guard against mistakes
_LETTERS = {int: "N", float: "X", Path: "FILE"}


@dataclass(frozen=True)
class FieldOption:
    """An option of a command: a field of its specification, or of a table in it.

    Args:
        path: names of the tables, and of the field.
        field: the field.
        option: how it is given on the command line.
        model: class of the table that the field belongs to.
    """

    path: tuple[str, ...]
    field: FieldInfo
    option: Option
    model: type[Spec]

    @property
    def name(self) -> str:
        """The option, such as `--episodes`."""
        return self.option.name or f"--{self.path[-1].replace('_', '-')}"

    @property
    def is_switch(self) -> bool:
        """Whether the option takes no value, and its opposite is `--no-...`."""
        return self.field.annotation is bool

    @property
    def takes(self) -> str:
        """What the option takes: choices, or a letter with the field's bounds."""
        return self.option.takes or _taken(self.field.annotation, self.field.metadata)

    @property
    def choices(self) -> tuple[str, ...]:
        """The words that the option takes, if these are all."""
        kind = _bare(self.field.annotation)
        return get_args(kind) if get_origin(kind) is Literal else ()

    @property
    def help(self) -> str:
        """The description with the default."""
        default = self.option.default or self._default()
        text = self.option.description or self.field.description or ""
        return f"{text}  [default: {default}]" if default else text

    def _default(self) -> str:
        value = self.field.get_default(call_default_factory=True)
        if self.is_switch:
            return self.name[2:] if value else f"no-{self.name[2:]}"
        if self.option.description or value is None or self.field.is_required():
            return ""
        return ",".join(_shown(part) for part in (value if isinstance(value, tuple) else (value,)))

    def value(self, text: str) -> object:
        """Convert what was given.

        Raises:
            InputError: the text has another form; the message names the option.
        """
        if self.is_switch:
            return text
        try:
            return self.option.parse(text) if self.option.parse else _converted(self.field.annotation, text)
        except InputError as error:
            message = str(error)
            raise InputError(
                f"{self.name} {message}" if message.startswith(("is ", "names ")) else message
            ) from None


_Values = dict[tuple[str, ...], tuple[FieldOption, object]]  # of options and what they are set to, by path


def spec_class(source: str) -> type[Spec]:
    """Import the class of a specification, `MODULE:CLASS`."""
    module, _, name = source.partition(":")
    found: type[Spec] = getattr(import_module(module), name)
    return found


def field_options(model: type[Spec], path: tuple[str, ...] = ()) -> Iterator[FieldOption]:
    """Yield the options of a specification and of its tables; its own go before those of the same name in a table."""
    own = [
        FieldOption((*path, name), field, mark, model)
        for name, field in model.model_fields.items()
        for mark in {mark.name: mark for mark in field.metadata if isinstance(mark, Option)}.values()
    ]
    names = {option.name for option in own}
    for name, field in model.model_fields.items():
        yield from (option for option in own if option.path[-1] == name)
        for inner in models_in(field.annotation):
            if issubclass(inner, Spec):
                inside = field_options(inner, (*path, name))
                yield from (option for option in inside if option.name not in names)


def changed_by(spec: SpecT, given: Mapping[str, Any]) -> SpecT:
    """Return a specification changed by options.

    An option of a table, such as a scenario's, changes each table of that name; options of a whole table come first.

    Args:
        spec: the specification.
        given: what was given, by option such as `--episodes`.

    Raises:
        InputError: a value cannot be used, or options exclude each other; the message names the options.
    """
    chosen: dict[tuple[str, ...], FieldOption] = {}
    for option in field_options(type(spec)):
        if option.name in given:
            if (other := chosen.get(option.path)) is not None:
                raise InputError(f"{other.name} and {option.name} exclude each other")
            chosen[option.path] = option
    values: _Values = {path: (o, o.value(given[o.name])) for path, o in chosen.items()}
    if "--car-park" in given:
        spec = _changed(spec, {path: value for path, value in values.items() if len(path) == 1})
        counts = ("--car-park", "--occupancy", "--replay-from")
        values = {path: v for path, v in values.items() if len(path) > 1 and v[0].name not in counts}
        if "scenarios" in type(spec).model_fields:
            scenarios = [one for scenario in spec.scenarios for one in _by_car_park(scenario, given)]  # type: ignore[attr-defined]
            spec = spec.changed("--car-park", scenarios=tuple(scenarios))
        else:
            found = _by_car_park(spec.scenario, given)  # type: ignore[attr-defined]
            if len(found) > 1:
                raise InputError(f"--car-park names {len(found)} scenarios, want one")
            spec = spec.changed("--car-park", scenario=found[0])
    return _changed(spec, values)


def _by_car_park(scenario: ScenarioSpec, given: Mapping[str, Any]) -> list[ScenarioSpec]:
    """Return a scenario for each of the car parks of a file of counts."""
    if not {"--occupancy", "--replay-from"} <= given.keys():
        raise InputError("--car-park goes with --occupancy FILE.csv and --replay-from DATE")
    from parkenv.scenarios.build import car_parks

    file, names = given["--occupancy"], given["--car-park"]
    return [
        scenario.changed(
            "--car-park",
            name=file_name(f"{scenario.title} {name}").replace(",", " ")[:80],
            occupancy={"counts": {"file": file, "car_park": name}, "replay_from": given["--replay-from"]},
            forecast="own",
        )
        for name in (car_parks(Path(file)) if names == "all" else words_in(names))
    ]


def given_spec(
    base: SpecT, given: Mapping[str, Any], out: Path, resume: bool, trust: bool, trust_model: bool = False
) -> tuple[SpecT, SpecT]:
    """Return the specification that a run begins from, and that changed by the options.

    Args:
        base: the specification of a new run without options.
        given: what was given, by option.
        out: folder of the run.
        resume: begin from the specification in the folder.
        trust: run the code that the folder's specification names.
        trust_model: convert archives of stable-baselines3 among the agents.

    Raises:
        InputError: the folder holds no run to resume, it is not trusted, or an option cannot be used.
    """
    if resume:
        base = saved(out, type(base))
    if "--backend" in given and "--address" not in given:
        # The address belongs to the other backend.
        base = base.changed(address=None)
    if resume:
        fields = {option.path[0] for option in field_options(type(base)) if option.name in given}
        require_trust(base, out, trust, given=fields)
    given = dict(given)
    if trust_model and "--agents" in given:
        given["--agents"] = ",".join(readable_models(split_agents(given["--agents"]), trust_model))
    return base, changed_by(base, given)


def _changed(spec: SpecT, values: _Values) -> SpecT:
    own = {path[0]: (option, value) for path, (option, value) in values.items() if len(path) == 1}
    if own:
        sets = {name: value for option, _ in own.values() for name, value in option.option.sets.items()}
        names = {name: option.name for name, (option, _) in own.items()}
        spec = spec.changed(names, **sets | {name: value for name, (_, value) in own.items()})
    for name in dict.fromkeys(path[0] for path in values if len(path) > 1):
        inner = {path[1:]: value for path, value in values.items() if path[0] == name and len(path) > 1}
        table = getattr(spec, name)
        if table is None:
            table = next(models_in(type(spec).model_fields[name].annotation))()
        several = isinstance(table, tuple)
        tables = tuple(_changed(one, inner) for one in (table if several else (table,)))
        spec = spec.changed(
            ", ".join(option.name for option, _ in inner.values()), **{name: tables if several else tables[0]}
        )
    return spec


def _bare(annotation: Any) -> Any:
    """Return a type without annotations and without None."""
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
    if kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            return text
    return text


def _taken(annotation: Any, metadata: Collection[Any]) -> str:
    kind = _bare(annotation)
    if get_origin(kind) is Literal:
        return "|".join(get_args(kind))
    if get_origin(kind) is tuple:
        return f"{_taken(get_args(kind)[0], ())}[,...]"
    letter = _LETTERS.get(kind, "TEXT")
    low = high = ""
    for bound in metadata:
        match bound:
            case annotated_types.Ge(ge=value):
                low = f"{value} <= {letter}"
            case annotated_types.Gt(gt=value):
                low = f"{value} < {letter}"
            case annotated_types.Le(le=float() | int() as value) if value < _SHOWN_BOUND:
                high = f"{letter} <= {value}"
            case annotated_types.Lt(lt=float() | int() as value) if value < _SHOWN_BOUND:
                high = f"{letter} < {value}"
    if low and high:
        return f"{low}{high.removeprefix(letter)}"
    if low:
        value, sign, _ = low.split()
        return f"{letter} {sign.replace('<', '>')} {value}"
    return high or letter


def _shown(value: object) -> str:
    for name in ("label", "title"):
        if isinstance(shown := getattr(value, name, None), str) and isinstance(value, Spec):
            return shown
    return f"{value:g}" if isinstance(value, float) else str(value)
