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
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from functools import wraps
from inspect import Parameter
from pathlib import Path
from typing import Annotated, Any, NamedTuple, get_type_hints

import typer
from typer.core import TyperArgument, TyperCommand, TyperGroup, TyperOption

from parkenv.cli import arguments as args
from parkenv.cli.completion import COMPLETERS, NAMES
from parkenv.errors import InputError, nearest

if sys.flags.optimize > 1:
    sys.stderr.write(
        "parkenv: error: its help is made from docstrings; run it without PYTHONOPTIMIZE=2 and -OO\n"
    )
    sys.exit(2)
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
    for parameter in signature.parameters.values():
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
        arguments = [given.pop(name) for name in first]
        function(*arguments, **given)

    run.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {}
    page = f"{text}\n\nExamples:\n{textwrap.indent(examples, '  ')}"
    app.command(name, cls=Command, help=page, rich_help_panel=heading, context_settings=CONTEXT)(run)


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
