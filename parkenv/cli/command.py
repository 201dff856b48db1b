"""Commands from plain functions: their signatures and docstrings become options, help pages and hints.

A positional-only parameter is an argument, any other an option of its name; a dataclass is a group of options. A
docstring has text, `Examples:` as they are printed, and headings with a line for each option:

    Options:
        episodes, -n (N >= 1): What it does.

In brackets stands what the option takes. Numbers out of such a range are refused.
"""

from __future__ import annotations

import inspect
import re
import sys
import textwrap
from collections.abc import Callable, Collection, Mapping
from dataclasses import fields, is_dataclass
from functools import wraps
from inspect import Parameter
from pathlib import Path
from typing import Annotated, Any, NamedTuple, TypeVar, get_type_hints

import typer
from typer.core import TyperArgument, TyperCommand, TyperGroup, TyperOption

from parkenv.cli import arguments as args
from parkenv.cli.completion import COMPLETERS, NAMES, completer
from parkenv.errors import InputError, nearest

if sys.flags.optimize > 1:
    sys.stderr.write(
        "parkenv: error: its help is made from docstrings; run it without PYTHONOPTIMIZE=2 and -OO\n"
    )
    sys.exit(2)
F = TypeVar("F", bound=Callable[..., None])
CONTEXT = {"help_option_names": ["-h", "--help"], "max_content_width": 110}
_HEADING = re.compile(r"^([A-Z][\w ,]*):$", re.MULTILINE)
_ENTRY = re.compile(r"(\w+)((?:, -\w)?)(?: \(([^)]*)\))?: (.*)")
_RANGE = re.compile(r"(?:([\d.]+) <= )?[A-Z]+(?: (>=|<=) ([\d.]+))?")


class Entry(NamedTuple):
    """What a docstring says of an option: heading, short form, what it takes, and help."""

    heading: str
    short: str
    takes: str | None
    help: str


def read_docstring(doc: str | None) -> tuple[str, str, dict[str, Entry]]:
    """Split a docstring into its text, its examples and its options."""
    text, *rest = _HEADING.split(inspect.cleandoc(doc or ""))
    sections = dict(zip(rest[::2], rest[1::2], strict=True))
    examples = textwrap.dedent(sections.pop("Examples", "").strip("\n"))
    entries = {}
    for heading, lines in sections.items():
        for line in re.sub(r"\n {5,}", " ", lines).strip().splitlines():
            if (found := _ENTRY.match(line.strip())) is None:
                raise ValueError(f"not an option: {line}")
            name, short, takes, said = found.groups()
            entries[name] = Entry(heading, short[2:], takes, said)
    return text.strip(), examples, entries


_, _, SHARED = read_docstring(args.__doc__)
"""Options that stand in several commands."""


class _Page:
    """The parts of a help page: text, examples, and parameters under their headings."""

    help: str | None
    params: list[Any]

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse arguments; for a completion leave them text, since converting them loads pydantic."""
        if ctx.resilient_parsing:
            for param in self.get_params(ctx):  # type: ignore[attr-defined]
                param.process_value = lambda _, value: value
        return super().parse_args(ctx, args)  # type: ignore[misc, no-any-return]

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """Return the words after the command, without the braces of required arguments."""
        return [re.sub("[{}]", "", piece) for piece in super().collect_usage_pieces(ctx)]  # type: ignore[misc]

    def format_help_text(self, ctx: Any, formatter: Any) -> None:
        """Write the text, and the examples as they are."""
        del ctx
        text, examples, _ = read_docstring(self.help)
        formatter.write_paragraph()
        with formatter.indentation():
            formatter.write_text(text)
        if examples:
            with _section(formatter, "Examples"):
                formatter.write(textwrap.indent(examples, "  ") + "\n")

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write arguments, options and commands, each under its heading."""
        sections: dict[str, list[tuple[str, str]]] = {"Arguments": [], "Options": []}
        commands = getattr(self, "commands", {})
        for name, command in commands.items():
            summary = " ".join((command.help or "").partition("\n\n")[0].split())
            sections.setdefault(command.rich_help_panel or "Commands", []).append((name, summary))
        for param in self.get_params(ctx):  # type: ignore[attr-defined]
            if isinstance(param, TyperArgument):
                sections["Arguments"].append((param.display_name_raw, param.help or ""))
            elif isinstance(param, TyperOption):
                param.min = param.max = None  # what it takes says so
                record = param.get_help_record(ctx)
                sections.setdefault(param.rich_help_panel or "Options", []).append(record or ("", ""))
        if commands:
            sections["Options"] = sections.pop("Options")
        for heading, rows in sections.items():
            if rows:
                with _section(formatter, heading):
                    formatter.write_dl(rows)


class Command(_Page, TyperCommand):
    """A command."""

    source: str | None = None
    """Class of the specification whose fields are options, `MODULE:CLASS`; imported when they are needed."""
    without: tuple[str, ...] = ()
    """Options of the specification that the command does not have."""
    names: Mapping[str, str] | None = None
    """The options from fields by parameter."""
    _own: list[Any]

    @property
    def params(self) -> list[Any]:
        """The parameters: options of the specification, and the function's own."""
        if self.source is not None and self.names is None:
            self.names, options = _of_fields(self.source, self.without)
            own = [param for param in self._own if param.name not in self.names]
            self._own = sorted((*options, *own), key=_panel)
        return self._own

    @params.setter
    def params(self, params: list[Any]) -> None:
        self._own = params

    def invoke(self, ctx: Any) -> Any:
        """Run the command; options from fields that are given become one mapping."""
        if self.names is not None:
            values = {option: ctx.params.pop(name) for name, option in self.names.items()}
            ctx.meta["given"] = {option: value for option, value in values.items() if value is not None}
        return super().invoke(ctx)

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse arguments; an unknown option is answered by the nearest known one."""
        try:
            return super().parse_args(ctx, args)
        except typer.TyperException as error:
            option = getattr(error, "param", None)
            if isinstance(option, TyperOption) and "Input should be" in str(error):
                raise InputError(
                    f"{option.opts[0]}: want {option.metavar}; see {ctx.command_path} --help"
                ) from None
            if not hasattr(error, "possibilities"):
                raise
            known = [name for p in self.params for name in (*p.opts, *p.secondary_opts) if name[:2] == "--"]
            name = str(getattr(error, "option_name", ""))
            hint = nearest(name, known).partition("known:")[0]
            raise InputError(
                f"{ctx.command_path} has no option {name}; {hint}see {ctx.command_path} --help"
            ) from None


class Group(_Page, TyperGroup):
    """A group of commands."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse arguments; without any, print the help page."""
        if args or ctx.resilient_parsing:
            return super().parse_args(ctx, args)
        typer.echo(ctx.get_help())
        raise typer.Exit(2)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Find the command; an unknown one is answered by the nearest known one."""
        if args[0] not in self.commands and not ctx.resilient_parsing and args[0][:1] != "-":
            raise InputError(
                f"{ctx.command_path} has no command {args[0]!r}; {nearest(args[0], self.commands)}"
            )
        return super().resolve_command(ctx, args)


def group(name: str, text: str) -> typer.Typer:
    """Make a group of commands."""
    return typer.Typer(name=name, help=text, cls=Group, rich_markup_mode=None, context_settings=CONTEXT)


PANELS = ("Options", "Costs and speeds", "World", "Sensors", "Results", "Code of others", "Machines")
"""Headings on help pages, in their order; others stand before World."""


def _panel(param: Any) -> tuple[float, bool]:
    panel = getattr(param, "rich_help_panel", None) or "Options"
    return (PANELS.index(panel) if panel in PANELS else 1.5), param.name in ("out", "help")


def options_of(source: str, *without: str) -> Callable[[F], F]:
    """Give a command the options of a specification; its parameter `given` has what was given, by option.

    Args:
        source: class of the specification, `MODULE:CLASS`.
        without: options that the command does not have.
    """

    def mark(function: F) -> F:
        function.options = {"source": source, "without": without}  # type: ignore[attr-defined]
        return function

    return mark


def _of_fields(source: str, without: Collection[str]) -> tuple[dict[str, str], list[Any]]:
    """Return options of a specification's fields by parameter, and Typer's parameters."""
    from parkenv.cli.spec_options import field_options, spec_class

    names, parameters = {}, []
    for option in field_options(spec_class(source)):
        name = option.name[2:].replace("-", "_")
        if option.name in without or name in names:
            continue
        names[name] = option.name
        switch = f"{option.name}/--no-{option.name[2:]}" if option.is_switch else option.name
        info = typer.Option(
            switch,
            *filter(None, [option.option.short]),
            help=option.help,
            metavar=option.takes,
            autocompletion=completer(option.choices) if option.choices else COMPLETERS.get(name),
            rich_help_panel=None if option.option.panel == "Options" else option.option.panel,
        )
        kind: Any = Annotated[(bool if option.is_switch else str) | None, info]
        parameters.append(Parameter(name, Parameter.KEYWORD_ONLY, default=None, annotation=kind))

    def command(**_: Any) -> None: ...

    command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    app = typer.Typer(add_completion=False)
    app.command()(command)
    return names, [param for param in typer.main.get_command(app).params if param.name in names]


def add(app: typer.Typer, name: str, function: Callable[..., None], heading: str | None = None) -> None:
    """Add a command to a group, under a heading of the group's help page.

    Raises:
        KeyError: a parameter is described nowhere.
    """
    text, examples, own = read_docstring(function.__doc__)
    signature = inspect.signature(function, eval_str=True)
    annotations: dict[str, Any] = {name: p.annotation for name, p in signature.parameters.items()}
    groups: dict[str, Any] = {name: kind for name, kind in annotations.items() if is_dataclass(kind)}
    parameters: list[Parameter] = []
    options: dict[str, Any] = getattr(function, "options", {})
    for parameter in signature.parameters.values():
        if options and parameter.name == "given":
            parameters.append(Parameter("given", Parameter.KEYWORD_ONLY, annotation=typer.Context))
            continue
        kind = groups.get(parameter.name)
        if kind is None:
            entry = own.get(parameter.name) or SHARED[parameter.name]
            parameters.append(_option(parameter, entry))
            continue
        hints = get_type_hints(kind)
        entries = {
            n: e for base in reversed(kind.__mro__) for n, e in read_docstring(base.__doc__)[2].items()
        }
        for f in fields(kind):
            parameter = Parameter(f.name, Parameter.KEYWORD_ONLY, default=f.default, annotation=hints[f.name])
            parameters.append(_option(parameter, own.get(f.name) or entries.get(f.name) or SHARED[f.name]))
    first = [p.name for p in signature.parameters.values() if p.kind is Parameter.POSITIONAL_ONLY]

    @wraps(function)
    def run(**given: Any) -> None:
        for name, kind in groups.items():
            given[name] = kind(**{f.name: given.pop(f.name) for f in fields(kind)})
        if options:
            given["given"] = given["given"].meta["given"]
        arguments = [given.pop(name) for name in first]
        function(*arguments, **given)

    run.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {}
    page = f"{text}\n\nExamples:\n{textwrap.indent(examples, '  ')}"
    cls = type(name, (Command,), options)
    app.command(name, cls=cls, help=page, rich_help_panel=heading, context_settings=CONTEXT)(run)


def _option(parameter: Parameter, entry: Entry) -> Parameter:
    """Return a parameter with the annotation that Typer makes an argument or an option of."""
    given: dict[str, Any] = {
        "help": entry.help.format(**NAMES),
        "autocompletion": COMPLETERS.get(parameter.name),
    }
    kind: Any = parameter.annotation
    given["metavar"] = entry.takes or {int: "N", float: "X", Path: "FILE"}.get(kind, "TEXT")
    if found := _RANGE.fullmatch(given["metavar"]):
        low, sign, high = found.groups()
        bounds = {"min": low or (high if sign == ">=" else None), "max": high if sign == "<=" else None}
        given |= {end: float(bound) if "." in bound else int(bound) for end, bound in bounds.items() if bound}
    if parameter.kind is Parameter.POSITIONAL_ONLY:
        info: Any = typer.Argument(**given)
    else:
        name = f"--{parameter.name.rstrip('_').replace('_', '-')}"  # from_ is --from
        switch = f"{name}/--no-{name[2:]}" if kind == bool | None else name
        heading = None if entry.heading == "Options" else entry.heading
        info = typer.Option(switch, *filter(None, [entry.short]), rich_help_panel=heading, **given)
    return parameter.replace(kind=Parameter.KEYWORD_ONLY, annotation=Annotated[kind, info])


def _section(formatter: Any, heading: str) -> Any:
    return formatter.section(typer.style(heading, bold=True))
