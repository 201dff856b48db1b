"""Commands as Typer runs them: help pages, hints, completion, and options from the class of the chosen command."""

from __future__ import annotations

import inspect
import re
import textwrap
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from importlib import import_module
from inspect import Parameter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer
from typer.core import TyperArgument, TyperCommand, TyperGroup, TyperOption

from parkenv.errors import InputError, nearest, require
from parkenv.files.known_names import (
    DETECTOR_SUFFIXES,
    DETECTORS,
    LOT_SUFFIXES,
    PACKAGED_LOTS,
    SCENARIO_NAMES,
    SENSOR_MODELS,
    WEATHERS,
)
from planners.names import AGENTS

if TYPE_CHECKING:
    from parkenv.cli.options import Command, FieldOption

Completer = Callable[[str], list[str]]


def completer(names: Sequence[str] = (), suffixes: Sequence[str] = (), several: bool = False) -> Completer:
    """Return a function that completes names, and files with one of the suffixes; of `several`, the last."""

    def complete(incomplete: str) -> list[str]:
        before, comma, last = incomplete.rpartition(",") if several else ("", "", incomplete)
        words = [name for name in names if name.startswith(last)]
        return [f"{before}{comma}{word}" for word in (*words, *_files(last, suffixes))]

    return complete


def _files(begun: str, suffixes: Sequence[str]) -> list[str]:
    if not suffixes:
        return []
    folder, slash, name = begun.rpartition("/")
    try:
        entries = sorted(Path(f"{folder}{slash}" or ".").iterdir())
    except OSError:
        return []
    return [
        f"{folder}{slash}{entry.name}{'/' if entry.is_dir() else ''}"
        for entry in entries
        if entry.name.startswith(name)
        and (name or entry.name[0] != ".")
        and (entry.is_dir() or entry.name.endswith(tuple(suffixes)))
    ]


_TABLES = (".toml", ".json")
COMPLETERS: dict[str, Completer] = {
    "agents": completer(tuple(AGENTS), several=True),
    "calibrated": completer((), (".json",)),
    "detector": completer(DETECTORS, DETECTOR_SUFFIXES),
    "evaluate_on": completer(SCENARIO_NAMES, (*_TABLES, ".geojson"), several=True),
    "experiment": completer((), _TABLES),
    "lot": completer(PACKAGED_LOTS, LOT_SUFFIXES, several=True),
    "log": completer((), (".csv", ".csv.gz")),
    "mapping": completer((), (".csv",)),
    "map_file": completer((), (".sqlite",)),
    "model": completer(DETECTORS, DETECTOR_SUFFIXES),
    "occupancy": completer((), (".csv", ".csv.gz", ".json")),
    "place": completer((), (*LOT_SUFFIXES, ".osm")),
    "scenario": completer(SCENARIO_NAMES, (*_TABLES, ".geojson"), several=True),
    "sensor_model": completer(SENSOR_MODELS, (".json",)),
    "test_on": completer(SCENARIO_NAMES, (*_TABLES, ".geojson"), several=True),
    "weather": completer(WEATHERS, several=True),
}

CONTEXT = {"help_option_names": ["-h", "--help"], "max_content_width": 110}
# Headings of options on help pages, in their order; others stand before World.
PANELS = ("Options", "Costs and speeds", "World", "Sensors", "Results", "Trust", "Machines")


class Entry(NamedTuple):
    summary: str  # what the command does, in a sentence
    # its class, `MODULE:CLASS` below `parkenv.cli`, or its kind of study; empty for a group of commands
    source: str = ""
    heading: str = "Commands"


class _Page:
    help: str | None
    params: list[Any]
    examples: str = ""
    order: Sequence[str] = ()

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        return [re.sub("[{}]", "", piece) for piece in super().collect_usage_pieces(ctx)]  # type: ignore[misc]

    def format_help_text(self, ctx: Any, formatter: Any) -> None:
        formatter.write_paragraph()
        with formatter.indentation():
            formatter.write_text(self.text)
        with _section(formatter, "Examples"):
            formatter.write(textwrap.indent(inspect.cleandoc(self.examples), "  ") + "\n")

    @property
    def text(self) -> str:
        return self.help or ""

    def format_options(self, ctx: Any, formatter: Any) -> None:
        sections: dict[str, list[tuple[str, str]]] = {"Arguments": [], "Options": []}
        commands = getattr(self, "commands", {})
        # Typer lists groups after commands.
        for name in [name for name in self.order if name in commands] or commands:
            command = commands[name]
            sections.setdefault(command.rich_help_panel or "Commands", []).append((name, command.help))
        for param in self.get_params(ctx):  # type: ignore[attr-defined]
            if isinstance(param, TyperArgument):
                sections["Arguments"].append((param.display_name_raw, param.help or ""))
            elif isinstance(param, TyperOption):
                record = param.get_help_record(ctx)
                sections.setdefault(param.rich_help_panel or "Options", []).append(record or ("", ""))
        if commands:
            sections["Options"] = sections.pop("Options")
        for heading, rows in sections.items():
            if rows:
                with _section(formatter, heading):
                    formatter.write_dl(rows)


def _section(formatter: Any, heading: str) -> Any:
    return formatter.section(typer.style(heading, bold=True))


def command_class(source: str) -> Any:
    module, _, name = source.partition(":")
    if name:
        return getattr(import_module(f"parkenv.cli.{module}"), name)
    return import_module("parkenv.cli.run").study_command(source)


class _CommandPage(_Page, TyperCommand):
    """A command; its class is imported when its options are needed."""

    source = ""
    _parameters: list[Any]
    _options: Mapping[str, str] | None = None

    @cached_property
    def command_class(self) -> type[Command]:
        kind: type[Command] = command_class(self.source)
        return kind

    @property
    def text(self) -> str:
        return f"{self.help}\n\n{inspect.cleandoc(self.command_class.__doc__ or '')}".strip()

    @property
    def examples(self) -> str:  # type: ignore[override]
        return self.command_class.examples

    @property
    def params(self) -> list[Any]:
        if self._options is None:
            self._options, self._parameters = _parameters(self.command_class)
        return self._parameters

    @params.setter
    def params(self, params: list[Any]) -> None:
        self._parameters = params

    def invoke(self, ctx: Any) -> None:
        assert self._options is not None
        given = {self._options[name]: value for name, value in ctx.params.items() if value not in (None, ())}
        self.command_class.of(given).run()

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        try:
            return super().parse_args(ctx, args)
        except typer.TyperException as error:
            if not hasattr(error, "possibilities"):
                raise
            known = [name for p in self.params for name in (*p.opts, *p.secondary_opts) if name[:2] == "--"]
            name = str(getattr(error, "option_name", ""))
            hint = nearest(name, known).partition("known:")[0]
            raise InputError(
                f"{ctx.command_path} has no option {name}; {hint}see {ctx.command_path} --help"
            ) from None


class _GroupPage(_Page, TyperGroup):
    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if args or ctx.resilient_parsing:
            return super().parse_args(ctx, args)
        typer.echo(ctx.get_help())
        raise typer.Exit(2)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        require(
            args[0] in self.commands or ctx.resilient_parsing or args[0][:1] == "-",
            f"{ctx.command_path} has no command {args[0]!r}; {nearest(args[0], self.commands)}",
        )
        return super().resolve_command(ctx, args)


def make_app(text: str, examples: str, entries: Mapping[str, Entry]) -> typer.Typer:
    """Make the command line of commands and groups by their words; a group comes before its commands."""
    app = _group("parkenv", Entry(text), examples, tuple(entries))
    groups = {"": app}
    for words, entry in entries.items():
        before, _, name = words.rpartition(" ")
        if entry.source:
            page = type(name, (_CommandPage,), {"source": entry.source})
            groups[before].command(
                name, cls=page, help=entry.summary, rich_help_panel=entry.heading, context_settings=CONTEXT
            )(lambda: None)
        else:
            examples = f"parkenv {words} COMMAND --help"
            groups[words] = _group(name, entry, examples)
            app.add_typer(groups[words], rich_help_panel=entry.heading)
    return app


def _group(name: str, entry: Entry, examples: str, order: Sequence[str] = ()) -> typer.Typer:
    page = type(name, (_GroupPage,), {"examples": examples, "order": order})
    return typer.Typer(
        name=name, help=entry.summary, cls=page, rich_markup_mode=None, context_settings=CONTEXT
    )


def _parameters(command_class: type[Command]) -> tuple[dict[str, str], list[Any]]:
    from parkenv.cli.options import field_options

    options: dict[str, FieldOption] = {}
    for option in field_options(command_class):
        options.setdefault(option.parameter, option)

    def command(**_: Any) -> None: ...

    command.__signature__ = inspect.Signature([_typed(option) for option in options.values()])  # type: ignore[attr-defined]
    app = typer.Typer(add_completion=False)
    app.command()(command)
    params = [param for param in typer.main.get_command(app).params if param.name in options]
    return {name: option.name for name, option in options.items()}, sorted(params, key=_panel)


def _typed(option: FieldOption) -> Parameter:
    """Return a parameter with the annotation that Typer makes an argument or an option of: all values are text."""
    mark = option.option
    texts: dict[str, Any] = {
        "help": option.help,
        "metavar": option.takes,
        "autocompletion": completer(option.choices)
        if option.choices
        else COMPLETERS.get(option.parameter.rstrip("_")),
    }
    kind: Any = bool if option.is_switch else list[str] if option.is_repeated else str
    default = Parameter.empty if option.is_required else None
    if mark.argument:
        info: Any = typer.Argument(**texts)
    else:
        switch = f"{option.name}/--no-{option.name[2:]}" if option.has_opposite else option.name
        panel = None if mark.panel == "Options" else mark.panel
        info = typer.Option(switch, *filter(None, [mark.short]), rich_help_panel=panel, **texts)
    kind = kind if default is Parameter.empty else kind | None
    return Parameter(
        option.parameter, Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[kind, info]
    )


def _panel(param: Any) -> tuple[float, bool]:
    panel = getattr(param, "rich_help_panel", None) or "Options"
    return (PANELS.index(panel) if panel in PANELS else 1.5), param.name in ("out", "help")
