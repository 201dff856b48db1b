"""Supply in a native lot file: facilities, the rules of zones, and the weights of goals and entries.

The member `zones` of the file has an object for each zone with rules; all of its members may be absent:

| member | value |
|---|---|
| `price` | a number (of an hour), or an object with `per_hour`, `steps` (pairs of a stay, s, and the price up to it), \
`free_s`, `daily_cap`, `charged` (hours) and `per_kwh` |
| `hours` | when cars may be parked there, such as `"Mo-Sa 08:00-20:00"` |
| `max_stay_s` | s, longest stay |
| `users` | list of classes of users, `["public"]` if absent |
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import fields
from typing import Any

from parkenv.compiled.arrays import FloatArray
from parkenv.errors import InputError, naming, nearest, require_number
from parkenv.files.file_names import is_plain
from parkenv.lots.formats.contents import LotContents, RawFeature
from parkenv.world.facility import Facility
from parkenv.world.tariff import NO_ZONE, Hours, Price, Zone

_COUNTED = ("gate_s", "inside_s", "known", "delay_s")  # properties of counted facilities alone


def read_zones(document: Any) -> dict[str, Zone]:
    """Return the rules of the member `zones`."""
    if not isinstance(document, dict):
        raise InputError(f"zones is {document!r:.40}, want an object with the rules of each zone")
    rules = {}
    for name, given in document.items():
        with naming(f"zone {name!a:.40}"):
            if not name or not is_plain(name):
                raise InputError("its name is empty or has control characters")
            members = _members(given, ("price", "hours", "max_stay_s", "users"), "rules")
            if "price" in members:
                members["price"] = price_of(members["price"])
            if "hours" in members:
                members["hours"] = Hours.parse(members["hours"])
            if not isinstance(members.get("users", []), list):
                raise InputError(f"users is {members['users']!r:.40}, want a list of names")
            rules[name] = Zone(name, **members)
    return rules


def price_of(given: Any) -> Price:
    """Return the price of a number, that of an hour, of a text, by hours, or of the members of a price."""
    if type(given) in (int, float):
        return Price(given)
    if isinstance(given, str):
        return Price.parse(given)
    members = _members(given, [f.name for f in fields(Price)], "price")
    steps = members.get("steps", [])
    if not isinstance(steps, list) or not all(isinstance(step, list) for step in steps):
        raise InputError(f"steps is {steps!r:.40}, want a list of pairs: stay in seconds and price")
    if "charged" in members:
        members["charged"] = Hours.parse(members["charged"], "charged")
    if "hourly" in members:
        members["hourly"] = Price.parse(str(members["hourly"]), "hourly").hourly
    return Price(**members)


def _members(given: Any, known: Collection[str], what: str) -> dict[str, Any]:
    if not isinstance(given, dict):
        raise InputError(f"{what} is {given!r:.40}, want an object with some of {', '.join(known)}")
    for name in given:
        if name not in known:
            raise InputError(f"no member {name!r:.40} of {what}; {nearest(name, known)}")
    return dict(given)


def zone_document(zone: Zone) -> dict[str, Any]:
    """Return the rules of a zone, as the member `zones` has them."""
    price = {f.name: value for f in fields(Price) if (value := getattr(zone.price, f.name)) != f.default}
    if zone.price.charged is not None:
        price["charged"] = str(zone.price.charged)
    if zone.price.hourly:
        price["hourly"] = "; ".join(f"{amount:.12g} @ {hours}" for amount, hours in zone.price.rules)
    document: dict[str, Any] = {"price": price} if price else {}
    if zone.hours is not None:
        document["hours"] = str(zone.hours)
    if zone.max_stay_s is not None:
        document["max_stay_s"] = zone.max_stay_s
    return document | {"users": list(zone.users)}


def read_zone(properties: dict[str, Any], what: str, rules: Collection[str]) -> str:
    """Return the zone of a feature, empty text if not given; where the file has rules, one of those zones."""
    zone = properties.get("zone", "")
    if not isinstance(zone, str) or not is_plain(zone) or ("zone" in properties and not zone):
        raise InputError(f"{what}: zone is {zone!r:.40}, want a name")
    if zone and rules and zone != NO_ZONE and zone not in rules:
        raise InputError(
            f"{what}: zone is {zone!r:.40}, want one of the file's zones; {nearest(zone, rules)}"
        )
    return zone


def read_facilities(contents: LotContents, raw: list[RawFeature], xy: FloatArray) -> None:
    """Validate the facilities of a file and add the valid ones."""
    seen: set[str] = set()
    for feature in raw:
        given = dict(feature.properties)
        name = given.get("name", feature.given_id)
        known = ("kind", "name", "type", "zone", "capacity", *_COUNTED)
        try:
            with naming(f"facility {name!r:.40}"):
                for member in given:
                    if member not in known:
                        raise InputError(
                            f"no property {member!r:.40} of facilities; {nearest(member, known)}"
                        )
                absent = [member for member in _COUNTED if member in given and not given.get("capacity")]
                if absent:
                    raise InputError(f"{absent[0]} is of counted facilities, want a capacity, too")
                if str(name) in seen:
                    raise InputError("its name appears already")
                contents.facilities.append(
                    Facility(
                        name=name,
                        kind=given.get("type", "lot"),
                        zone=given.get("zone", ""),
                        capacity=given.get("capacity", 0),
                        xy=tuple(xy[feature.parts[0]][0].tolist()) if given.get("capacity") else None,
                        **{member: given[member] for member in _COUNTED if member in given},
                    )
                )
                contents.numbers["facility"].append(feature.number)
                seen.add(str(name))
            read_zone(given, f"facility {name!r:.40}", contents.zone_rules)
        except InputError as error:
            contents.error(feature.number, str(error))


def facility_properties(facility: Facility) -> dict[str, Any]:
    """Return the properties of a facility's feature."""
    given: dict[str, Any] = {"name": facility.name, "type": facility.kind}
    if facility.zone:
        given["zone"] = facility.zone
    if facility.is_counted:
        given["capacity"] = facility.capacity
        given |= {name: getattr(facility, name) for name in _COUNTED}
    return given


def read_weights(feature: RawFeature) -> dict[str, float]:
    """Return the weights of a goal or an entry by purpose; empty if not given."""
    weights = feature.properties.get("weights", {})
    if not isinstance(weights, dict):
        raise InputError(f"{feature.kind}: weights is {weights!r:.40}, want numbers by purpose")
    for purpose, weight in weights.items():
        require_number(f"{feature.kind}: weights[{purpose!r:.40}]", weight, least=0.0)
    return {purpose: float(weight) for purpose, weight in weights.items()}
