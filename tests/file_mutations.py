"""Damaged and hostile variants of good files; `rng` is a `random.Random`."""

import copy
import json
import re

ODD_VALUES = [
    None, True, False, 0, -1, 1, 2**63, -(2**63), 10**18, 10**200, 1e-320, 1e18, 1e300, -1e300,
    float("inf"), float("-inf"), float("nan"), "", "x", "\0", "a\nb", "../x", "x" * 3000, "[bold]", "é", "1", "nan",
    "2015-13-45", [], [[]], [None], [1, 2], [1e300, -1e300], {}, {"x": 1}, {"type": "Point"}, [[0, 0]] * 4,
]  # fmt: skip
ODD_WORDS = [
    "", "-1", "0", "1", "1e999", "-1e300", "1e300", "nan", "inf", "99999999999999999999", "1" * 400, "null", "true",
    "[", "]", "{", "}", '"', "'", ",", "\n", ":", "=", "-", "#", "&a", "*a", "!!python/object:os.system", "2015-11-12",
    "2015-13-45", "0x1f", "\\ud800", "\\u0000", "\0", "é", "\ufeff", "<", "/>", "<!DOCTYPE x [<!ENTITY a 'b'>]>",
    "[" * 300, "(1,2)", ";",
]  # fmt: skip


def mutated_bytes(good, rng):
    """Bytes with slices cut, repeated or overwritten; perhaps cut off."""
    data = bytes(good)
    for _ in range(rng.randint(1, 3)):
        start = rng.randint(0, len(data))
        end = min(len(data), start + rng.choice([0, 1, 2, 4, 16, 200]))
        odd = [b"", data[start:end] * 2, b"\xff", b"\0", b"\xff\xff\xff\x7f"]
        new = rng.choice(odd) if rng.random() < 0.5 else rng.randbytes(rng.randint(1, 8))
        data = rng.choice([data[:start] + new + data[end:], data[:start], data[start:]])
    return data


def mutated_text(good, rng):
    """A text with words and numbers replaced by odd ones, or with lines left out or repeated; any encoding."""
    text = good
    for _ in range(rng.randint(1, 3)):
        parts = [m.span() for m in re.finditer(r"[\w.+-]+", text)] or [(0, 0)]
        start, end = rng.choice(parts)
        text = text[:start] + rng.choice(ODD_WORDS) + text[end:]
        lines = text.split("\n")
        if rng.random() < 0.5:
            i, n = rng.randrange(len(lines)), rng.randint(0, 3)
            text = "\n".join(lines[:i] + lines[i : i + 1] * n + lines[i + 1 :])
    return text.encode(rng.choice(["utf-8"] * 6 + ["utf-16", "latin-1"]), "replace")


def _places(value, place=()):
    yield place
    if isinstance(value, dict):
        for key, part in value.items():
            yield from _places(part, (*place, key))
    elif isinstance(value, list):
        for i, part in enumerate(value[:40]):
            yield from _places(part, (*place, i))


def mutated_value(good, rng):
    """JSON values with parts replaced by odd ones, left out, repeated or nested."""
    holder = [copy.deepcopy(good)]
    for _ in range(rng.randint(1, 3)):
        *way, last = rng.choice([p for p in _places(holder) if p])
        at = holder
        for step in way:
            at = at[step]
        match rng.choice(["replace", "replace", "replace", "leave out", "repeat", "nest"]):
            case "leave out" if at is not holder:
                del at[last]
            case "repeat" if isinstance(at, list):
                at.insert(0, copy.deepcopy(at[last]))
            case "nest":
                at[last] = [at[last]]
            case _:
                at[last] = copy.deepcopy(rng.choice(ODD_VALUES))
    return holder[0]


def mutated_json(good, rng):
    """A JSON text, damaged as a value or as a text."""
    if rng.random() < 0.5:
        return json.dumps(mutated_value(good, rng)).encode()
    return mutated_text(json.dumps(good), rng)
