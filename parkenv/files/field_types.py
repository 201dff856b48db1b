"""Types of validated fields, and the base of dataclasses whose fields are checked by their types."""

from __future__ import annotations

from dataclasses import fields
from functools import cache
from typing import Annotated, Any, get_type_hints

import numpy as np
from pydantic import AfterValidator, AllowInfNan, BeforeValidator, Field, Strict, TypeAdapter, ValidationError

from parkenv.errors import InputError
from parkenv.files.file_names import is_plain
from parkenv.files.spec_file import wanted

_OF_NUMPY = BeforeValidator(lambda value: value.item() if isinstance(value, np.generic) else value)


def _plain_name(value: str) -> str:
    if not is_plain(value):
        raise ValueError("a text without control characters")
    return value


Number = Annotated[float, Strict(), AllowInfNan(False), _OF_NUMPY]
Positive = Annotated[Number, Field(gt=0.0)]
NotNegative = Annotated[Number, Field(ge=0.0)]
Probability = Annotated[Number, Field(ge=0.0, le=1.0)]
Whole = Annotated[int, Strict(), Field(ge=0), _OF_NUMPY]
Flag = Annotated[bool, Strict(), _OF_NUMPY]
Name = Annotated[str, Strict(), AfterValidator(_plain_name)]


class Validated:
    """Base of dataclasses: fields with an annotated type, such as `Positive`, are checked when an object is made."""

    def __post_init__(self) -> None:
        kind: Any = type(self)
        for name, adapter in _adapters(kind).items():
            value = getattr(self, name)
            try:
                object.__setattr__(self, name, adapter.validate_python(value))
            except ValidationError as error:
                kinds = " or ".join(wanted(detail) for detail in error.errors(include_url=False))
                raise InputError(f"{name} is {value!r:.60}, want {kinds}") from None


@cache
def _adapters(kind: Any) -> dict[str, TypeAdapter[Any]]:
    hints = get_type_hints(kind, include_extras=True)
    names = [field.name for field in fields(kind) if field.init and "Annotated" in str(hints[field.name])]
    return {name: TypeAdapter(hints[name]) for name in names}
