"""Types of validated fields, and the base of dataclasses whose fields are checked by their types."""

from dataclasses import fields
from functools import cache
from typing import Annotated, Any, TypeVar, get_type_hints

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import AfterValidator, AllowInfNan, BeforeValidator, Field, Strict, TypeAdapter, ValidationError

from parkenv.errors import InputError, require_number
from parkenv.files.file_names import is_plain
from parkenv.files.spec_file import wanted

_OF_NUMPY = BeforeValidator(lambda value: value.item() if isinstance(value, np.generic) else value)


def _plain_name(value: str) -> str:
    if not is_plain(value):
        raise ValueError("a text without control characters")
    return value


OF_ARRAY = BeforeValidator(lambda value: value.tolist() if isinstance(value, np.ndarray) else value)
_T = TypeVar("_T")

NumberOrInf = Annotated[float, Strict(), _OF_NUMPY]
Number = Annotated[float, Strict(), AllowInfNan(False), _OF_NUMPY]
Positive = Annotated[Number, Field(gt=0.0)]
NotNegative = Annotated[Number, Field(ge=0.0)]
Probability = Annotated[Number, Field(ge=0.0, le=1.0)]
Whole = Annotated[int, Strict(), Field(ge=0), _OF_NUMPY]
Numbers = Annotated[tuple[_T, ...], Field(min_length=1), OF_ARRAY]
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


def as_array(
    name: str,
    values: ArrayLike,
    *shape: int,
    dtype: Any = np.float64,
    least: float | None = None,
    most: float | None = None,
) -> NDArray[Any]:
    """Return values as a read-only array of a shape, finite and within bounds; a length of -n is n or more."""
    try:
        array = np.array(values, dtype)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name} is {values!r:.60}, want numbers") from error
    sizes = zip(array.shape, shape, strict=False)
    if array.ndim != len(shape) or any(n != size if size >= 0 else n < -size for n, size in sizes):
        wanted = ", ".join(f"{size}" if size >= 0 else f"{-size} or more" for size in shape)
        raise InputError(f"{name} has shape {array.shape}, want ({wanted}{',' * (len(shape) == 1)})")
    if array.dtype.kind == "f":
        low, high = -np.inf if least is None else least, np.inf if most is None else most
        for place in np.argwhere(~(np.isfinite(array) & (array >= low) & (array <= high))):
            require_number(f"{name}{place.tolist()}", float(array[tuple(place)]), least=least, most=most)
    array.flags.writeable = False
    return array
