"""Ids and tags of elements of OpenStreetMap in GeoJSON, as its exporters write them."""

import re
from contextlib import suppress
from typing import Any

from pydantic_core import from_json

from parkenv.lots.unread import note_unread

OSM_ID = re.compile(r"(?:.*/)?((?:node|way|relation)/-?\d+)")
_SHORT_ID = re.compile(
    r"([nwra])(-?\d+)"
)  # of osmium and QuickOSM; an area's is twice the way's or relation's
_HSTORE = re.compile(r'\s*"((?:[^"\\]|\\.)*)"\s*=>\s*(?:"((?:[^"\\]|\\.)*)"|NULL)\s*(?:,|$)')
NESTED = ("tags", "other_tags", "all_tags")  # members with tags, as objects, JSON or hstore (ogr2ogr)
LISTED = ("highway", "amenity", "building", "oneway", "capacity", "barrier")  # keys whose objects are listed


def id_of_feature(feature: dict[str, Any], properties: dict[str, Any]) -> str | None:
    """Return the id of a feature as exporters write it: `way/1`, `w1`, an area `a2`, or a number beside a type."""
    given = [properties.get(key) for key in ("@id", "id", "full_id", "osm_id", "osmid")]
    given.insert(1, feature.get("id"))
    for text in (value for value in given if isinstance(value, str)):
        if match := OSM_ID.fullmatch(text):
            return match[1]
        if match := _SHORT_ID.fullmatch(text):
            return _name_of(match[1], int(match[2]))
    types = (properties.get(key) for key in ("@type", "osm_type", "element_type", "type"))
    kind = next((t[0] for t in types if t in ("node", "way", "relation", "area")), None)
    shape = (feature.get("geometry") or {}).get("type") if "osm_id" in properties else None
    kind = kind or {"Point": "n", "LineString": "w", "Polygon": "r", "MultiPolygon": "r"}.get(str(shape))
    number = next((int(str(v)) for v in given if re.fullmatch(r"-?\d+", str(v))), None)
    if re.fullmatch(r"-?\d+", str(properties.get("osm_way_id"))):
        return f"way/{properties['osm_way_id']}"
    return None if kind is None or number is None else _name_of(kind, number)


def _name_of(kind: str, number: int) -> str:
    if kind == "a":
        kind, number = "wr"[number % 2], abs(number) // 2 * (1 if number > 0 else -1)
    return {"n": "node", "w": "way", "r": "relation"}[kind] + f"/{number}"


def tags_of_feature(properties: dict[str, Any]) -> dict[str, str]:
    """Return tags as texts, from typed values, and from objects, JSON and hstore within one member."""
    given = {key: value for key, value in properties.items() if key not in NESTED and key[:1] != "@"}
    for key in NESTED:
        nested = properties.get(key)
        if isinstance(nested, str) and nested.strip():
            nested = _tags_in(nested)
            if nested is None:
                note_unread(properties, key, "no tags")
        given |= nested if isinstance(nested, dict) else {}
    tags = {}
    for key, value in given.items():
        text = _text_of(key, value)
        if text is not None:
            tags[str(key)] = text
        elif isinstance(value, dict) and key in LISTED:
            note_unread(given, key, "no tag")
    return tags


def _tags_in(text: str) -> dict[str, Any] | None:
    with suppress(ValueError):
        read = from_json(text)
        return read if isinstance(read, dict) else None
    pairs, end = {}, 0
    while match := _HSTORE.match(text, end):
        end = match.end()
        if match[2] is not None:
            pairs[re.sub(r"\\(.)", r"\1", match[1])] = re.sub(r"\\(.)", r"\1", match[2])
    return pairs if end and not text[end:].strip() else None


def _text_of(key: str, value: object) -> str | None:
    if isinstance(value, bool) or value in ("True", "False"):
        return "yes" if value in (True, "True") else "no"
    if isinstance(value, float):
        return None if value != value else str(int(value)) if value.is_integer() else str(value)
    if isinstance(value, list):
        texts = [text for each in value if (text := _text_of(key, each)) is not None]
        return ";".join(texts[:1] if key == "highway" else texts) or None
    return str(value) if isinstance(value, str | int) else None
