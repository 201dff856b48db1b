"""Answers of Overpass, and XML with positions in place of nodes (`out geom`), as plain elements."""

import re
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from parkenv.errors import InputError, naming
from parkenv.files.limited_reading import open_limited

_FAILED = re.compile(r"error|timed out|out of memory|limit|abort", re.IGNORECASE)
MOST_BYTES = 4_000_000_000  # maximum size of unpacked XML


def elements_of_xml(path: Path) -> list[Any]:
    elements: list[Any] = []
    with open_limited(path) as file, naming(path):
        try:
            for _, node in ElementTree.iterparse(file):
                if node.tag in ("node", "way", "relation"):
                    elements.append(_answer_of_xml(node))
                    node.clear()
        except (ElementTree.ParseError, ValueError) as error:
            raise InputError(f"not an OpenStreetMap file: {error}") from error
    return elements


def _answer_of_xml(node: ElementTree.Element) -> dict[str, Any]:
    answer: dict[str, Any] = {"type": node.tag, "tags": {t.get("k"): t.get("v") for t in node.iter("tag")}}
    for name, value in node.attrib.items():
        answer[name] = int(value) if name in ("id", "ref", "version") else value
    points = node.findall("nd")
    answer["geometry"] = [dict(nd.attrib) if nd.get("lat") else None for nd in points]
    if points and all(nd.get("ref") for nd in points):
        answer["nodes"] = [int(nd.get("ref", 0)) for nd in points]
    answer["members"] = [{**_answer_of_xml(m), "type": m.get("type")} for m in node.findall("member")]
    return answer


def has_geometry(path: Path) -> bool:
    """Whether an XML file has positions of ways in place; one whose remark says that it is partial is refused."""
    found = False
    with open_limited(path, MOST_BYTES) as file:
        for line in file:
            found |= b"<nd" in line and b"lat=" in line
            if b"<remark" in line:
                refuse_partial(line.decode(errors="replace").partition("<remark")[2].strip("<>/ \n"))
    return found


def refuse_partial(remark: object) -> None:
    if isinstance(remark, str) and _FAILED.search(remark):
        raise InputError(
            f"its remark says {remark.strip()!a:.160}: the answer is partial, want a whole one; ask for a "
            "smaller area, or with a longer [timeout:] and a larger [maxsize:]"
        )
