"""Damaged and hostile variants of good files, drawn by hypothesis."""

import copy
import json
import re

from hypothesis import strategies as st

ODD_VALUES = [
    None,
    True,
    False,
    0,
    -1,
    1,
    2**63,
    -(2**63),
    10**18,
    10**200,
    1e-320,
    1e18,
    1e300,
    -1e300,
    float("inf"),
    float("-inf"),
    float("nan"),
    "",
    "x",
    "\0",
    "a\nb",
    "../x",
    "x" * 3000,
    "[bold]",
    "é",
    "1",
    "nan",
    "2015-13-45",
    [],
    [[]],
    [None],
    [1, 2],
    [1e300, -1e300],
    {},
    {"x": 1},
    {"type": "Point"},
    [[0, 0], [0, 0], [0, 0], [0, 0]],
]
ODD_WORDS = [
    "",
    "-1",
    "0",
    "1",
    "1e999",
    "-1e300",
    "1e300",
    "nan",
    "inf",
    "99999999999999999999",
    "1" * 400,
    "null",
    "true",
    "[",
    "]",
    "{",
    "}",
    '"',
    "'",
    ",",
    "\n",
    ":",
    "=",
    "-",
    "#",
    "&a",
    "*a",
    "!!python/object:os.system",
    "2015-11-12",
    "2015-13-45",
    "0x1f",
    "\\ud800",
    "\\u0000",
    "\0",
    "é",
    "\ufeff",
    "<",
    "/>",
    "<!DOCTYPE x [<!ENTITY a 'b'>]>",
    "[" * 300,
    "(1,2)",
    ";",
]


@st.composite
def mutated_bytes(draw, good):
    """Bytes with slices cut, repeated or overwritten; perhaps cut off, or in another encoding."""
    data = bytes(good)
    for _ in range(draw(st.integers(1, 3))):
        start = draw(st.integers(0, len(data)))
        end = min(len(data), start + draw(st.sampled_from([0, 1, 2, 4, 16, 200])))
        new = draw(
            st.sampled_from([b"", data[start:end] * 2, b"\xff", b"\0", b"\xff\xff\xff\x7f"])
            | st.binary(min_size=1, max_size=8)
        )
        data = draw(st.sampled_from([data[:start] + new + data[end:], data[:start], data[start:]]))
    return data


@st.composite
def mutated_text(draw, good):
    """A text with words and numbers replaced by odd ones, or with lines left out or repeated."""
    text = good
    for _ in range(draw(st.integers(1, 3))):
        parts = [m.span() for m in re.finditer(r"[\w.+-]+", text)] or [(0, 0)]
        start, end = draw(st.sampled_from(parts))
        text = text[:start] + draw(st.sampled_from(ODD_WORDS)) + text[end:]
        lines = text.split("\n")
        if draw(st.booleans()):
            i, n = draw(st.integers(0, len(lines) - 1)), draw(st.integers(0, 3))
            text = "\n".join(lines[:i] + lines[i : i + 1] * n + lines[i + 1 :])
    return text.encode(draw(st.sampled_from(["utf-8"] * 6 + ["utf-16", "latin-1"])), "replace")


def _places(value, place=()):
    yield place
    if isinstance(value, dict):
        for key, part in value.items():
            yield from _places(part, (*place, key))
    elif isinstance(value, list):
        for i, part in enumerate(value[:40]):
            yield from _places(part, (*place, i))


@st.composite
def mutated_value(draw, good):
    """JSON values with parts replaced by odd ones, left out, repeated or nested."""
    holder = [copy.deepcopy(good)]
    for _ in range(draw(st.integers(1, 3))):
        *way, last = draw(st.sampled_from([p for p in _places(holder) if p]))
        at = holder
        for step in way:
            at = at[step]
        match draw(st.sampled_from(["replace", "replace", "replace", "leave out", "repeat", "nest"])):
            case "leave out" if at is not holder:
                del at[last]
            case "repeat" if isinstance(at, list):
                at.insert(0, copy.deepcopy(at[last]))
            case "nest":
                at[last] = [at[last]]
            case _:
                at[last] = copy.deepcopy(draw(st.sampled_from(ODD_VALUES)))
    return holder[0]


def mutated_json(good):
    """A JSON text, damaged as a value or as a text."""
    return mutated_value(good).map(lambda value: json.dumps(value).encode()) | mutated_text(json.dumps(good))
