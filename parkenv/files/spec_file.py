"""Specification files of scenarios and experiments: TOML or JSON, validated by pydantic, with one-line errors."""

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Self, TypeVar, get_args

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PrivateAttr,
    Strict,
    ValidationError,
    ValidationInfo,
)
from pydantic.annotated_handlers import GetJsonSchemaHandler
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema, ErrorDetails, PydanticCustomError

from parkenv.errors import InputError, nearest
from parkenv.files.atomic_write import write_text
from parkenv.files.known_names import DETECTOR_SUFFIXES, DETECTORS
from parkenv.files.limited_reading import MAX_SPEC_BYTES, is_there, read_json, read_toml

_SHOWN = 60
_FOLDER = "folder"

# What is wanted, by pydantic's error type; other types keep pydantic's message.
_WANTED = {
    "greater_than": "a number above {gt}",
    "greater_than_equal": "a number of at least {ge}",
    "less_than": "a number below {lt}",
    "less_than_equal": "a number of at most {le}",
    "model_type": "a table",
    "dataclass_type": "a table",
    "missing": "one more value",
    "unexpected_keyword_argument": "no such key",
    "float_type": "a number",
    "float_parsing": "a number",
    "int_parsing": "a whole number",
    "finite_number": "a finite number",
    "is_instance_of": "an instance of {class}",
    "int_type": "a whole number",
    "string_type": "text",
    "bool_type": "true or false",
    "tuple_type": "a list",
    "too_short": "at least {min_length} values",
    "too_long": "at most {max_length} values",
}

T = TypeVar("T")


def resolved_path(value: object, info: ValidationInfo) -> object:
    if not isinstance(value, str | Path):
        return value
    folder = (info.context or {}).get(_FOLDER, Path())
    path = (Path(folder) / Path(value).expanduser()).absolute()
    if not (is_there(path) and path.is_file()):
        raise ValueError(f"a file; there is none at {path}")
    return path


# An existing file; paths are relative to the folder of the file that names them.
FilePath = Annotated[Path, BeforeValidator(resolved_path)]


def _detector(value: object, info: ValidationInfo) -> object:
    """Resolve the file of a detector relative to the folder of the file that names it; leave names as they are."""
    if not isinstance(value, str | Path):
        return value
    is_file = str(value).lower().endswith(DETECTOR_SUFFIXES)
    return str(resolved_path(value, info)) if is_file else str(value)


def _packaged(value: str) -> str:
    if value not in DETECTORS and not value.lower().endswith(DETECTOR_SUFFIXES):
        wanted = f"{', '.join(DETECTORS)} or a file ({', '.join(DETECTOR_SUFFIXES)})"
        # Scenario files hold no code.
        note = "; a class of your own is named by --detector or in an experiment" if ":" in value else ""
        raise ValueError(f"{wanted}{note}")
    return value


# A packaged detector, a file (.npz, .onnx) or `MODULE:CLASS`; paths are relative to the folder of the file.
DetectorName = Annotated[str, BeforeValidator(_detector)]
# A packaged detector or a file.
PackagedDetector = Annotated[str, BeforeValidator(_detector), AfterValidator(_packaged)]


@dataclass(frozen=True)
class OrText:
    """Annotation of a table that may also be given as text, or as a number: the JSON schema allows both."""

    kind: str = "string"

    def __get_pydantic_json_schema__(
        self, core_schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> JsonSchemaValue:
        return {"anyOf": [{"type": self.kind}, handler(core_schema)]}


Several = Annotated[tuple[T, ...], Strict(False)]  # a list in the file, a tuple in Python


def require_together(condition: object, message: str) -> None:
    """Refuse a specification whose fields do not fit together, in its validator."""
    if not condition:
        raise PydanticCustomError("whole", "{message}", {"message": message})


def _different(values: tuple[T, ...]) -> tuple[T, ...]:
    repeated = [v for i, v in enumerate(values) if v in values[:i]]
    if repeated:
        raise ValueError(f"different values; {repeated[0]!r} is repeated")
    return values


# The values of one axis of a grid: at least one, without duplicates.
Axis = Annotated[
    tuple[T, ...], Strict(False), Field(min_length=1, max_length=10_000), AfterValidator(_different)
]


class Spec(BaseModel):
    """Base class of specifications: typed, bounded, frozen; unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)

    _file: str = PrivateAttr("")
    """File that the specification was read from, for messages; no part of its value."""

    def __eq__(self, other: object) -> bool:
        if type(self) is not type(other):
            return False
        same = all(getattr(self, name) == getattr(other, name) for name in type(self).model_fields)
        return same and self.model_extra == getattr(other, "model_extra", None)

    @classmethod
    def read(cls, path: str | Path) -> Self:
        path = Path(path)
        return cls.parse(read_tables(path), str(path), path.parent).of_file(path)

    def of_file(self, path: str | Path) -> Self:
        self._file = str(path)
        return self

    @classmethod
    def parse(
        cls, tables: Mapping[str, Any], source: str | Mapping[str, str], folder: str | Path = "."
    ) -> Self:
        """Validate tables; for messages, `source` names their file or each field's option; paths are from `folder`."""
        try:
            return cls.model_validate(tables, context={_FOLDER: Path(folder)})
        except ValidationError as error:
            raise InputError(_message(cls, error, source)) from error

    def changed(self, source: str | Mapping[str, str] = "", /, **changes: Any) -> Self:
        """Return a copy with some fields changed, validated again; `source` names the options that set them."""
        fields = {name: getattr(self, name) for name in type(self).model_fields} | changes
        return type(self).parse(fields, source).of_file(self._file)

    def write(self, path: Path) -> None:
        write_text(path, json.dumps(self.tables(), indent=2) + "\n")

    def files(self) -> list[Path]:
        files: dict[Path, None] = {}
        for name in type(self).model_fields:
            value = getattr(self, name)
            for part in value if isinstance(value, tuple) else (value,):
                own = [part] if isinstance(part, Path) else part.files() if isinstance(part, Spec) else ()
                files |= dict.fromkeys(own)
        return list(files)

    def tables(self) -> dict[str, Any]:
        return self.model_dump(mode="json", exclude_none=True)


def read_tables(path: Path) -> dict[str, Any]:
    tables = read_json(path, MAX_SPEC_BYTES) if path.suffix == ".json" else read_toml(path)
    if not isinstance(tables, dict):
        raise InputError(f"{path}: is a {type(tables).__name__}, want a JSON object")
    return tables


def _message(model: type[BaseModel], error: ValidationError, source: str | Mapping[str, str]) -> str:
    details = error.errors(include_url=False)
    # Invalid items also make a list too short; drop that error.
    details = [d for d in details if d["type"] != "too_short"] or details
    # Report a misspelt key first: it explains a missing one.
    first = min(details, key=lambda d: d["type"] != "extra_forbidden")
    more = f" (and {len(details) - 1} more)" if len(details) > 1 else ""
    if not isinstance(source, str):
        name = str(first["loc"][0]) if first["loc"] else ""
        return _fault(model, first, source.get(name) or name or ", ".join(source.values()))
    if source.startswith("--"):
        # The source is an option, which names the field itself.
        return _fault(model, first, source)
    field = ".".join(str(part) for part in first["loc"])
    return f"{source}{': ' if source else ''}{_fault(model, first, field)}{more}"


def _fault(model: type[BaseModel], detail: ErrorDetails, field: str) -> str:
    location, kind = detail["loc"], detail["type"]
    if kind == "extra_forbidden":
        place = f" in [{field.rpartition('.')[0]}]" if len(location) > 1 else ""
        return f"unknown key {location[-1]!r}{place}; {nearest(str(location[-1]), _keys_at(model, location[:-1]))}"
    context, wants = detail.get("ctx", {}), wanted(detail)
    if isinstance(context.get("error"), InputError):
        return f"{field}: {wants}"
    if kind == "whole":
        return wants
    if kind == "missing":
        return f"{field} is missing"
    value = repr(detail["input"])
    shown = value if len(value) <= _SHOWN else f"{value[:_SHOWN]}..."
    return f"{field} is {shown}, want {wants}" if field else f"is {shown}, want {wants}"


def wanted(detail: ErrorDetails) -> str:
    if detail["type"] not in _WANTED:
        return detail["msg"].removeprefix("Value error, ").removeprefix("Input should be ")
    numbers = {k: f"{v:.7g}" if isinstance(v, int | float) else v for k, v in detail.get("ctx", {}).items()}
    return _WANTED[detail["type"]].format(**numbers)


def _keys_at(model: type[BaseModel], location: tuple[int | str, ...]) -> Iterator[str]:
    at: type[BaseModel] = model
    for part in location:
        if isinstance(part, str) and part in at.model_fields:
            at = next(models_in(at.model_fields[part].annotation), at)
    yield from at.model_fields


def models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for part in get_args(annotation):
        yield from models_in(part)
