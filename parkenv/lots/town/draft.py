"""Import a whole town from OpenStreetMap: streets, kerbs, car parks and garages with their rules, goals and entries.

- Streets: `parkenv.lots.town.streets`; kerbs: `supply`.
- Car parks whose spaces are drawn (`amenity=parking_space`) are slots. Others are counted: as many cars as `capacity`
  says, else by `capacity`'s rules of area and levels. Where more are tagged than drawn, the others are counted, too.
- A garage (`parking=multi-storey`, `underground`, `rooftop`) has a barrier that takes 10 s a car, 30 s to a space when
  it is empty and 120 s when it is full, and a full sign. It is entered at its `amenity=parking_entrance`, else at the
  nearest street, as car parks are. Entrances alone, without an outline, are a garage of the usual size: a multi-storey
  one if there are several within 60 m, else a small underground one.
- Rules (`fee`, `charge`, `maxstay`, `access`, `capacity:disabled`, `capacity:charging`) become zones, named after the
  kind of facility and the rule (`zones`).
- Buildings are no walls: a town is searched without sensors.
- Goals: a building attracts by its floor area: outline times levels (tagged, or usual for its kind), and a shop,
  restaurant, office or the like that is mapped as a point by a nominal area, whom `BUILDINGS` and `POINTS` say; one of
  unknown kind is a dwelling, unless a point within it says otherwise. What is near each other becomes one goal.
"""

from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.errors import InputError, naming, require, with_extra
from parkenv.files.file_names import is_plain
from parkenv.lots.bays.kerbs import kerb_slots_of
from parkenv.lots.bays.register import Box, Register, Rule, read_bays
from parkenv.lots.bays.rules import rules_text, tags_of
from parkenv.lots.draft import UNREACHED, LeftOut, LotDraft
from parkenv.lots.generators import NO_SLOTS, Slots, nearest_on_lanes
from parkenv.lots.local_frame import LocalFrame
from parkenv.lots.osm.conditions import closed_parking, note_other_keys
from parkenv.lots.osm.draft import (
    MAPPED_OVERLAP,
    NO_AISLE,
    RULE_OVERLAP,
    SAME_CAR_PARK,
    MapImport,
    frame_around,
)
from parkenv.lots.osm.elements import OsmElement, OsmMap, place_name, read_map
from parkenv.lots.osm.parking import (
    CAR_SPACES,
    Area,
    corridors_of,
    exterior_rings,
    is_building,
    is_clear,
    is_parking_area,
    is_space,
    without_overlaps,
)
from parkenv.lots.osm.roads import Rank, Road, Turns, count_in, lanes_of, off_the_ground, turns_of
from parkenv.lots.town import supply
from parkenv.lots.town.streets import BEYOND, read_streets
from parkenv.lots.unread import Unread, noting_unread, unread_rows
from parkenv.world.drive_graph import SLOT_REACH, component_labels, linestrings
from parkenv.world.facility import FACILITY_KINDS, FACILITY_REACH
from parkenv.world.tariff import PUBLIC

ENTRANCE_WITHIN = 20.0  # m, of a garage's outline from its `amenity=parking_entrance`
AROUND_BAYS = 0.003  # degrees of latitude, some 300 m, around the bays of a register: what is read of a map
OFF_STREET = ("driveway", "parking_aisle")  # values of `service` of roads without bays at the kerb
SAME_GARAGE = 60.0  # m, between entrances that are of one garage, and from its outline
SAME_TAGS = ("name", "ref", "parking")  # tags in which a car park and a node in it do not differ
# Rules of car parks of a list whose tags name no price: all at the same one, so that none draws drivers by it.
PAID: dict[str, Any] = {"per_hour": supply.PRICE, "assumed": True}
NO_ENTRY = "no entry: no street crosses the edge of the map"
TOO_FAR = f"parking farther than {FACILITY_REACH:g} m from every street"
NOT_ON_MAP = "car parks of the list that the map lacks, without a street or a capacity"
NO_GOAL = "no goal: no building and no point of interest in it; export buildings and shops, too"
ALONG_STREETS = "goals along the streets, as there is no building and no point of interest; export these, too"
UNUSED = ("construction", "disused", "abandoned")  # values of `parking` that no car may use


@dataclass(frozen=True, eq=False)
class TownDraft:
    """The draft of a town, and a table of its facilities, a row each with the columns of `TABLE`."""

    draft: LotDraft
    facilities: list[dict[str, Any]]
    bays_left_out: tuple[LeftOut, ...] = ()  # of a register

    @property
    def caution(self) -> str:
        """What to know of the town where more than half of its spaces are at untagged kerbs; else empty."""
        total = sum(row["capacity"] for row in self.facilities)
        guessed = sum(row["capacity"] for row in self.facilities if row["rule"] == supply.CLASS_RULE)
        if 2 * guessed <= total:
            return ""
        share = f"{100 * guessed / total:.0f} %"
        return (
            f"{guessed:,} of {total:,} spaces ({share}) are a guess that decides how easy parking is: kerbs without "
            "tags in the map, by the class of their street, free of charge unless the map has a price. To measure "
            "the effect, import with --untagged-kerbs 0.5, or drive with --price 'kerb free=1/h'."
        )


def import_town(
    path: str | Path,
    car_parks: str | Path | None = None,
    *,
    bays: str | Path | None = None,
    columns: str | None = None,
    bays_only: bool = False,
    listed_only: bool = False,
    bounds: tuple[tuple[float, float], tuple[float, float]] | None = None,
    untagged_kerbs: float = 1.0,
    left_hand: bool = False,
) -> TownDraft:
    """Draft a town from an OpenStreetMap file; see the module for the rules.

    Names and capacities of a list of car parks win; `listed_only` leaves out other parking and streets on no shortest
    way to them. A register of `bays` is in place of the map's kerbs, and with `bays_only` of its car parks, too; its
    map is that around the bays. The map is cut at `bounds`, two pairs of latitude and longitude; `untagged_kerbs`
    multiplies places.
    """
    path = Path(path)
    listed = [] if car_parks is None else supply.read_listed(Path(car_parks))
    register = None if bays is None else read_bays(bays, columns)
    with noting_unread() as unread, naming(path):
        place, name = read_map(path), place_name(path)
        if register is not None:
            town = _around_bays(name, place, register, bounds, left_hand, whole=not bays_only)
        else:
            town = _TownImport(name, place if bounds is None else place.within(bounds), left_hand)
        town.read_drawn()
        if register is not None:
            town.use_bays(register if bounds is None else register.within(bounds))
        else:
            town.read_kerbs(untagged_kerbs)
        town.read_counted()
        if listed:
            town.use_list(listed)
        if listed_only:
            town.rows = [row for row in town.rows if row.capacity_from == "list"]
            town.beside = np.array([row.xy for row in town.rows]).reshape(-1, 2)
        draft = town.draft()
    notes = (Unread(part, text, n, assumed) for (part, text, assumed), n in town.unread.items())
    return replace(draft, draft=replace(draft.draft, unread=(*unread_rows(unread), *notes)))


class _TownImport(MapImport):
    def __init__(self, name: str, place: OsmMap, left_hand: bool) -> None:
        # What an extract's edge cuts may have lost its nodes, too.
        elements = [e.closed() if is_parking_area(e) and not e.is_node else e for e in place.elements]
        elements, merged = _with_nodes_in_areas(elements)
        streets = [e for e in elements if "highway" in e.tags and not e.is_node]
        require(streets, "no street in it, want ways with the tag highway")
        super().__init__(name, replace(place, elements=elements), frame_around(streets))
        self.streets = read_streets(elements, self.frame, self.left_out, left_hand=left_hand)
        self.left_out["car parks mapped as a point, too, within their outlines"] += merged
        self.roads = self.streets.roads_of(self.streets.kept)
        self.lines = linestrings([road.points for road in self.roads])
        self.tree = shapely.STRtree(self.lines)
        self.buildings = self.areas(is_building, mended=True)
        self.parking, _ = self.usable(self.areas(is_parking_area, mended=True), _why_closed)
        for e in elements:
            if is_parking_area(e) and not e.is_node and not e.is_closed:
                self.left_out["parking without an outline"].append(e.id)
        self.rows: list[supply.FacilityRow] = []
        self.names: set[str] = set()
        self.used: set[int] = set()  # parking areas whose places are slots
        self.beside: FloatArray | None = None  # what is near these attracts, if not everything does
        self.unread: Counter[tuple[str, str, str]] = Counter()  # of rules of bays: part, text, assumed
        self.n_bays = 0  # of a register, with those left out
        self.bays_left_out: tuple[LeftOut, ...] = ()
        self.bays_found: tuple[str, ...] = ()
        self.listed: list[str] = []  # which facilities car parks of a list are

    def _named(self, name: str, element_id: str) -> str:
        name = name if name and is_plain(name) else element_id
        name = f"{name} ({element_id})" if name in self.names else name
        self.names.add(name)
        return name

    def _named_kerb(self, street: str, element_id: str) -> str:
        return self._named(f"{street} ({element_id})" if street else "", element_id)

    def read_drawn(self) -> None:
        """Read the spaces that are drawn one by one, grouped by the car park around them, else by their distance."""
        spaces, _ = self.usable(self.areas(is_space, mended=True), _why_no_space)
        lanes = lanes_of([road for road in self.roads if road.rank < Rank.STREET])
        parts, index, _, slots = self.drawn_slots(spaces, lanes, self.roads)
        if not parts:
            return
        polygons = np.array([part.polygon for part in parts], dtype=np.object_)
        owner = _car_parks_of(polygons, self.parking)
        groups = np.unique(owner[index]).tolist()
        self.used = {k for k in groups if k < len(self.parking)}
        for k in groups:
            around = self.parking[k] if k in self.used else parts[int(np.flatnonzero(owner == k)[0])].area
            inside = around.element
            whole = supply.rules_of(inside.tags) if k in self.used else supply.Rules()
            row = supply.FacilityRow(
                self._named(inside.tags.get("name", ""), inside.id), "lot", whole, "drawn", "", inside.id
            )
            row.slots = slots[owner[index] == k]
            # A space without rules of its own has those of its car park.
            rules = (supply.rules_of(parts[i].area.element.tags) for i in index[owner[index] == k].tolist())
            row.slot_rules = [own if own != supply.Rules() else whole for own in rules]
            row.tagged = count_in(inside.tags, "capacity", "the drawn places") if k in self.used else None
            more = (row.tagged or 0) - len(row.slots)
            if more > 0:
                row.xy = self._entrance(self.parking[k].polygon, [])
                row.counted = [(f"{row.name}, not drawn", more, whole)]
                row.capacity_from = "tag"
            self.rows.append(row)

    def read_kerbs(self, untagged: float) -> None:
        strips = {
            k: supply.strip_side(area, self.roads, self.tree)
            for k, area in enumerate(self.parking)
            if k not in self.used
        }
        self.used |= {k for k, side in strips.items() if side is not None}
        sides = list(filter(None, strips.values()))
        sides += supply.kerb_sides(self.roads, self.crossings(), self.buildings, self.left_out, untagged)
        # Several runs of one way are one kerb.
        whole: dict[str, supply.FacilityRow] = {}
        for side in sides:
            row = whole.setdefault(side.element, side)
            if row is side:
                row.name = self._named_kerb(side.name, side.element)
            else:
                row.slots = Slots.joined([row.slots, side.slots])
        rows = list(whole.values())
        slots = Slots.joined([row.slots for row in rows] or [NO_SLOTS])
        others = Slots.joined([*(row.slots for row in self.rows), NO_SLOTS])
        boxes = np.concatenate([others.boxes(MAPPED_OVERLAP), slots.boxes(RULE_OVERLAP)])
        is_free = without_overlaps(boxes)[len(others) :] & is_clear(slots, corridors_of(self.roads), 0.05)
        end = np.cumsum([len(row.slots) for row in rows], dtype=np.int64)
        for row, free in zip(rows, np.split(is_free, end), strict=False):
            if not free.all():
                self.left_out["kerbs with fewer places, because of streets and other places"].append(
                    row.element
                )
            row.slots = row.slots[free]
            row.slot_rules = [row.rules] * len(row.slots)
        self.rows += [row for row in rows if len(row.slots)]

    def use_bays(self, register: Register) -> None:
        """Add the bays of a register as slots at the kerbs of streets, a facility for each side of a way."""
        advice = no_streets(register)
        closed = np.array([tags_of(own)[0].get("access") == "no" for own in register.rules], bool)
        register = register.part(~closed, "bays where no car may park at any hour")
        roads = [road for road in self.roads if _has_kerbs(road)]
        self.bays_left_out = LeftOut.by_reason(register.left_out)
        if roads and len(register.ids):
            kerbs = kerb_slots_of(register, roads, self.frame)
            self.bays_left_out += kerbs.left_out
        if not (roads and len(register.ids) and kerbs.ids):
            why = "; ".join(map(str, self.bays_left_out)) or "no street for cars"
            raise InputError(f"no bay stands at a street of the map ({why}); {advice}")
        self.n_bays = len(kerbs.ids) + sum(len(left.ids) for left in self.bays_left_out)
        self.bays_found = register.found
        rules, self.unread = _rules_of_bays(register.rules[kerbs.bay].tolist())
        rows: dict[tuple[str, str], list[int]] = defaultdict(list)
        for i, (k, is_left) in enumerate(zip(kerbs.road.tolist(), kerbs.is_left.tolist(), strict=True)):
            side = roads[k].side_of_way("left" if is_left else "right")
            rows[f"{roads[k].id} {side}", roads[k].tags.get("name", "")].append(i)
        for (element, street), index in rows.items():
            own_rules = [rules[own] for own in register.rules[kerbs.bay[index]].tolist()]
            name = self._named_kerb(street, element)
            usual = Counter(own_rules).most_common(1)[0][0]
            slots, ids = kerbs.slots[np.array(index)], [kerbs.ids[i] for i in index]
            row = supply.FacilityRow(
                name, "kerb", usual, "register", "", element, None, slots, own_rules, ids
            )
            self.rows.append(row)

    def read_counted(self) -> None:
        ways_in = [
            e
            for e in self.nodes
            if e.tags.get("amenity") == "parking_entrance" and closed_parking(e.tags) is None
        ]
        entrances = [self.frame.to_xy(e.lines[0])[0] for e in ways_in]
        points = (
            Area(e, shapely.Point(self.frame.to_xy(e.lines[0])[0]))
            for e in (*self.nodes, *_unseen_garages(self.parking, ways_in, entrances))
            if is_parking_area(e)
        )
        outlines = (a for k, a in enumerate(self.parking) if k not in self.used)
        for area in (*outlines, *self.usable(points, _why_closed)[0]):
            element, tags = area.element, area.element.tags
            rule = supply.rule_of(tags)
            kind = supply.RULES[rule].kind
            rules = supply.rules_of(tags)
            note_other_keys(tags)
            if rule == "boxes" and rules.users == PUBLIC:
                rules = replace(rules, users="private")
            xy = self._entrance(area.polygon, entrances if FACILITY_KINDS[kind].gate_s else [])
            if xy is None:
                self.left_out[TOO_FAR].append(element.id)
                continue
            tagged = count_in(tags, "capacity", "by area and levels")
            source = ("tag", "") if tagged else ("rule", rule)
            row = supply.FacilityRow(
                self._named(tags.get("name", ""), element.id), kind, rules, *source, element.id, tagged, xy=xy
            )
            size = float(shapely.area(area.polygon)) or None  # a point has none
            places = tagged or supply.expected_capacity(rule, size, supply.levels_of(tags))
            row.counted = supply.counted_parts(row.name, places, rules, tags)
            self.rows.append(row)

    def use_list(self, listed: list[supply.ListedCarPark]) -> None:
        """Give the car parks of a list their names and capacities; those that the map lacks are garages of it."""
        of_map = [row for row in self.rows if row.kind != "kerb" and row.xy is not None]
        at = self.frame.to_xy([(car_park.lon, car_park.lat) for car_park in listed])
        same = supply.matched(listed, at, of_map)
        for car_park, point, k in zip(listed, at, same.tolist(), strict=True):
            if k < 0:
                xy_of = self._entrance(shapely.Point(point), [])
                if xy_of is None or not car_park.capacity:
                    self.left_out[NOT_ON_MAP].append(car_park.name)
                    continue
                row = supply.FacilityRow(car_park.name, "garage", supply.Rules(), "list", "", "", xy=xy_of)
                self.rows.append(row)
            else:
                row = of_map[k]
                self.listed.append(f"{car_park.name}: {row.name}, {row.places} places in the map")
            # It is counted as a whole, open to everybody, and cars stand there when it is closed, too.
            capacity = car_park.capacity or row.places
            self.names.discard(row.name)
            row.name = self._named(car_park.name, row.element)
            row.slots, row.slot_rules = NO_SLOTS, []
            paid = {} if row.rules.per_hour else PAID
            row.rules = replace(row.rules, users=PUBLIC, hours="", **paid)
            row.counted = [(row.name, capacity, row.rules)]
            row.capacity_from, row.rule = "list", ""

    def _entrance(
        self, shape: shapely.Geometry, entrances: Sequence[FloatArray]
    ) -> tuple[float, float] | None:
        if entrances:
            away = shapely.distance(shape, shapely.points(np.array(entrances)))
            if away.min() <= ENTRANCE_WITHIN:
                shape = shapely.Point(entrances[int(away.argmin())])
        index, distance = self.tree.query_nearest(shape, return_distance=True, all_matches=False)
        if not len(index) or distance[0] > FACILITY_REACH - SLOT_REACH:
            return None
        at = shapely.get_coordinates(shapely.shortest_line(shape, self.lines[int(index[0])]))[0]
        return float(at[0]), float(at[1])

    def draft(self) -> TownDraft:
        require(self.rows, "no parking in it: no kerb, no car park and no garage beside its streets")
        slots, ids, zones = supply.zoned_slots(self.rows)
        mouths = np.concatenate([slots.mouths(), *([row.xy] for row in self.rows if row.xy is not None)])
        entries, traffic = self.streets.entries()
        is_guess = bool(self.n_bays) and not len(entries)
        if is_guess:
            entries, traffic = self.streets.outermost()
        whole, lanes = self.streets.lanes(mouths, entries if self.beside is not None else None)
        # Of some car parks alone, the shortest ways are left, and none around what is forbidden.
        turns = turns_of(self.place, self.frame, whole, lanes) if self.beside is None else Turns((), (), ())
        to_lane = nearest_on_lanes(lanes, slots.mouths())[0] - slots.mouths()
        near = np.hypot(*to_lane.T) < SLOT_REACH - 0.01  # a file rounds
        self.left_out[NO_AISLE] += [ids[i] for i in np.flatnonzero(~near).tolist()]
        index = np.flatnonzero(near)
        slots, ids = slots[index], [ids[i] for i in index.tolist()]
        source = {row.name: row.capacity_from for row in self.rows}
        filled = set(slots.facility.tolist())
        facilities = [f for row in self.rows for f in supply.facilities_of(row, filled)]
        goals, weights = weighted_goals(
            self.place.elements, self.buildings, self.frame, self.tree, self.beside
        )
        along = self.beside is None and not len(goals)
        if along:
            everywhere = shapely.get_coordinates(shapely.segmentize(self.lines, APART))
            goals, weights = _clustered(everywhere, np.ones((len(everywhere), len(PURPOSES))))
        draft = LotDraft(
            name=self.name,
            slot_ids=tuple(ids),
            slots=slots,
            slot_source=tuple(source[name] for name in slots.facility.tolist()),
            lanes=tuple(lanes),
            entries=entries,
            goals=goals,
            outlines=tuple(exterior_rings(a.polygon for a in self.parking)),
            missing=tuple(
                text for text, points in ((NO_ENTRY, entries), (NO_GOAL, goals)) if not len(points)
            ),
            frame=self.frame,
            facilities=tuple(facilities),
            zone_rules=zones,
            goal_weights=weights,
            entry_weights=dict.fromkeys(PURPOSES, traffic),
            turns=turns.kept,
        ).searchable()
        rows = supply.table_of(self.rows, draft)
        listed = LeftOut.by_reason(self.left_out)
        left_out = (*self.place.left_out, *listed, *turns.left_out, *draft.left_out)
        found = (*_findings(self, rows, draft, along), *turns.found, *self.place.cut_elements())
        guessed = (ALONG_STREETS,) * along + ("entries where the streets reach farthest",) * is_guess
        guesses = (*_guesses(rows, draft), *guessed)
        lost = (left for left in left_out if self.n_bays and left.reason in (NO_AISLE, UNREACHED))
        draft = replace(draft, found=found, left_out=left_out, guesses=guesses)
        return TownDraft(draft, rows, (*self.bays_left_out, *lost))


def _why_closed(area: Area) -> str | None:
    kind = area.element.tags.get("parking")
    reason = f"parking={kind}" if kind in UNUSED else closed_parking(area.element.tags)
    return reason and f"parking with {reason}"


def _why_no_space(area: Area) -> str | None:
    tags, kind = area.element.tags, area.element.tags.get("parking_space", "normal")
    reason = off_the_ground(tags) or closed_parking(tags)
    if kind not in CAR_SPACES and supply.rules_of(tags).users == PUBLIC:
        reason = f"parking_space={kind}"
    if area.element.cut:
        reason = "an outline that the edge of the map cuts"
    return reason and f"spaces with {reason}"


def _has_kerbs(road: Road) -> bool:
    """Whether bays may stand at a road: not on motorways, in tunnels, and beyond the map."""
    is_fast = road.tags["highway"] in ("motorway", "motorway_link", "trunk_link")
    return not is_fast and road.tags.get("tunnel", "no") == "no" and not road.id.startswith(BEYOND)


def _around_bays(
    name: str, place: OsmMap, register: Register, bounds: Box | None, left_hand: bool, *, whole: bool
) -> _TownImport:
    """Begin the import of a map within bounds, else around bays; unless `whole`, without driveways and car parks."""
    try:
        place = place.within(register.box(AROUND_BAYS) if bounds is None else bounds)
        used = (
            e.tags.get("service") not in OFF_STREET and "parking" not in e.tags.get("amenity", "")
            for e in place.elements
        )
        elements = [e for e, is_used in zip(place.elements, used, strict=True) if whole or is_used]
        return _TownImport(name, replace(place, elements=elements), left_hand)
    except InputError as error:
        swapped = "; are latitudes and longitudes of the bays swapped?"
        raise InputError(f"{error}; {no_streets(register)}{swapped}") from error


def _rules_of_bays(
    given: Sequence[tuple[Rule, ...]],
) -> tuple[dict[tuple[Rule, ...], supply.Rules], Counter[tuple[str, str, str]]]:
    """Return the rules of bays as tags say them, and how many have what could not be read: part, text, assumed."""
    rules, lost = {}, Counter[tuple[str, str, str]]()
    for own, count in Counter(given).items():
        tags, notes = tags_of(own)
        with noting_unread() as unread:
            rules[own] = supply.rules_of(tags)
        for part, text, assumed in notes:
            lost[part, text, assumed] += count
        for note in unread_rows(unread):
            lost[note.tag.removesuffix(":conditional"), rules_text(own), note.assumed] += count
    return rules, lost


def no_streets(register: Register) -> str:
    """Say how to get the streets of a register."""
    box = ",".join(f"{degrees:g}" for corner in register.box(AROUND_BAYS) for degrees in corner)
    return (
        f"want the streets of {box} (south, west, north, east): by overpass-turbo.eu, way[highway]({box});(._;>;);out;"
        " or from download.geofabrik.de or extract.bbbike.org; examples/streets_of_bays.py makes some of bays alone"
    )


def _with_nodes_in_areas(elements: Sequence[OsmElement]) -> tuple[list[OsmElement], list[str]]:
    """Return elements without nodes of car parks whose areas are mapped, too, and the ids of these nodes.

    The areas have the tags of both. A node is another car park if both have a name, or both a kind, and these differ.
    """
    parking = [(i, e) for i, e in enumerate(elements) if is_parking_area(e) and e.lines]
    nodes = [(i, e) for i, e in parking if e.is_node]
    areas = [(i, e) for i, e in parking if not e.is_node and e.is_closed]
    if not nodes or not areas:
        return list(elements), []
    shapes = [shapely.make_valid(shapely.MultiPolygon([(r, []) for r in e.lines])) for _, e in areas]
    pairs = shapely.STRtree(shapes).query([shapely.Point(e.lines[0][0]) for _, e in nodes], "intersects").T
    kept: list[OsmElement | None] = list(elements)
    for k, area in pairs.tolist():
        (own, node), (i, whole) = nodes[k], areas[area]
        same = all(
            node.tags.get(key, value) == value for key, value in whole.tags.items() if key in SAME_TAGS
        )
        if same and kept[own] is not None:
            kept[own] = None
            kept[i] = replace(whole, tags={**node.tags, **(kept[i] or whole).tags})
    return [e for e in kept if e is not None], [e.id for (i, e) in nodes if kept[i] is None]


def _car_parks_of(polygons: NDArray[np.object_], parking: Sequence[Area]) -> IntArray:
    """Return the car park around each space, (n,), else a number beyond these for spaces near each other."""
    near = shapely.STRtree(polygons).query(polygons, predicate="dwithin", distance=SAME_CAR_PARK)
    owner = len(parking) + component_labels(near.T, len(polygons))
    if parking:
        tree = shapely.STRtree([a.polygon for a in parking])
        space, park = tree.query(shapely.point_on_surface(polygons), predicate="intersects")
        owner[space[::-1]] = park[::-1]
    return owner


def _unseen_garages(
    parking: Sequence[Area], ways_in: Sequence[OsmElement], at: Sequence[FloatArray]
) -> Iterator[OsmElement]:
    """Yield a garage for each group of entrances without an outline near: a large one if it has several."""
    if not ways_in:
        return
    points = np.asarray(shapely.points(np.array(at)))
    alone = np.ones(len(points), bool)
    garages = [a.polygon for a in parking if supply.RULES[supply.rule_of(a.element.tags)].kind == "garage"]
    for outlines, reach in (([a.polygon for a in parking], ENTRANCE_WITHIN), (garages, SAME_GARAGE)):
        alone[shapely.STRtree(outlines).query(points, predicate="dwithin", distance=reach)[0]] = False
    index = np.flatnonzero(alone)
    label = component_labels(
        shapely.STRtree(points[index]).query(points[index], predicate="dwithin", distance=SAME_GARAGE).T,
        len(index),
    )
    for k in range(int(label.max(initial=-1)) + 1):
        group = [ways_in[i] for i in index[label == k].tolist()]
        tags = {key: value for e in reversed(group) for key, value in e.tags.items()}
        usual = "multi-storey" if len(group) > 1 else "underground"
        yield replace(group[0], tags={"parking": usual, **tags, "amenity": "parking"})


def _findings(
    town: _TownImport, rows: Sequence[dict[str, Any]], draft: LotDraft, along: bool
) -> Iterator[str]:
    length, kept, real = town.streets.length, town.streets.kept, ~town.streets.is_beyond
    connected = length[kept & real].sum() / length[real].sum()
    yield f"streets: {length.sum() / 1e3:.0f} km, {connected:.1%} of them connected; lanes: {len(draft.lanes)}"
    for kind in FACILITY_KINDS:
        of_kind = [row for row in rows if row["kind"] == kind]
        places = dict.fromkeys(("tag", "drawn", "list", "register", "rule"), 0)
        for row in of_kind:
            places[row["capacity_from"]] += row["capacity"]
        listed = ", ".join(f"{source}: {n:,}" for source, n in places.items() if n)
        yield f"{kind}s: {len(of_kind):,}, places: {sum(places.values()):,} ({listed or 'none'})"
    yield f"entries: {len(draft.entries)}, where streets cross the edge of the map"
    yield f"goals: {len(draft.goals)}, of {'streets' if along else 'buildings and points of interest'}"
    yield from (f"of the list: {line}" for line in town.listed)
    yield from town.bays_found
    if town.n_bays:
        standing = sum(row["slots"] for row in rows if row["capacity_from"] == "register")
        yield f"{standing:,} of {town.n_bays:,} bays, {100 * standing / town.n_bays:.0f} %, stand on a street"
    yield f"frame: {town.frame}"


def _guesses(rows: Sequence[dict[str, Any]], draft: LotDraft) -> Iterator[str]:
    rules: dict[str, list[int]] = defaultdict(list)
    for row in rows:
        if row["rule"]:
            rules[f"{row['kind']}s by the rule of {row['rule']}"].append(row["capacity"])
    for rule, places in rules.items():
        yield f"{rule}: {len(places):,}, places: {sum(places):,}"
    assumed = [zone for zone in draft.zone_rules if " paid" in zone]
    if assumed:
        price = draft.zone_rules[assumed[0]].price.per_hour
        yield f"price where the map has a fee without an amount: {price:g} an hour"


PURPOSES = ("residents", "commuters", "shoppers", "visitors", "deliveries")
MOST_GOALS = 100
APART = 40.0  # m, least distance of goals in a small map, on average
STREET_WITHIN = 300.0  # m, from the streets of a town, of what attracts anybody
WALK_WITHIN = 500.0  # m, from car parks whose drivers alone are wanted
LEAST_AREA = 30.0  # m², of buildings that anybody lives in
DWELLING = {"residents": 1.0, "visitors": 0.05, "deliveries": 0.05}
WORK = {"commuters": 1.0, "visitors": 0.1, "deliveries": 0.1}
SHOP = {"shoppers": 1.0, "commuters": 0.2, "deliveries": 0.4}
LEISURE = {"visitors": 1.0, "commuters": 0.1, "deliveries": 0.1}
OPEN_TO_ALL = {"visitors": 0.5, "commuters": 0.5, "deliveries": 0.05}
# Usual levels of a `building`, and whom a square metre of its floor attracts; of others nobody.
BUILDINGS: dict[str, tuple[float, dict[str, float]]] = {
    name: (levels, attracts)
    for names, levels, attracts in (
        ("house detached semidetached_house terrace bungalow farm yes residential block", 2.0, DWELLING),
        ("apartments dormitory", 4.0, DWELLING),
        ("office commercial government", 3.0, WORK),
        ("industrial manufacture warehouse", 1.0, {"commuters": 0.3, "deliveries": 0.05}),
        ("retail supermarket kiosk mall", 1.0, SHOP),
        ("hotel cinema theatre stadium sports_hall sports_centre", 2.0, LEISURE),
        ("school kindergarten university college hospital", 2.0, OPEN_TO_ALL),
        ("public civic church train_station fire_station", 1.0, OPEN_TO_ALL),
    )
    for name in names.split()
}
# Nominal floor, m², of a point with a key (`shop`, `office`, ...) or an `amenity`, and whom it attracts.
POINTS: dict[str, tuple[float, dict[str, float]]] = {
    name: (floor, attracts)
    for names, floor, attracts in (
        ("shop", 150.0, SHOP),
        ("office", 200.0, WORK),
        ("craft", 150.0, WORK),
        ("healthcare", 200.0, OPEN_TO_ALL),
        ("tourism leisure", 300.0, LEISURE),
        ("restaurant pub bar cafe fast_food nightclub", 150.0, LEISURE),
        ("cinema theatre library community_centre place_of_worship", 400.0, LEISURE),
        ("bank post_office pharmacy marketplace", 200.0, SHOP),
        ("doctors dentist clinic hospital townhall courthouse", 300.0, OPEN_TO_ALL),
        ("school kindergarten university college", 500.0, OPEN_TO_ALL),
    )
    for name in names.split()
}
# Values of keys that no car comes for.
QUIET = {
    "tourism": ("information", "artwork", "viewpoint"),
    "leisure": ("garden", "pitch", "playground", "park"),
}


def weighted_goals(
    elements: Sequence[OsmElement],
    buildings: Sequence[Area],
    frame: LocalFrame,
    streets: shapely.STRtree,
    beside: FloatArray | None = None,
) -> tuple[FloatArray, dict[str, FloatArray]]:
    """Return up to `MOST_GOALS` goals, (n, 2) m, near streets, and points `beside` if given; weights by purpose."""
    xy, weight = _sources(elements, buildings, frame)
    near = np.unique(streets.query(shapely.points(xy), predicate="dwithin", distance=STREET_WITHIN)[0])
    if beside is not None:
        near = near[shapely.distance(shapely.multipoints(beside), shapely.points(xy[near])) <= WALK_WITHIN]
    xy, weight = xy[near], weight[near]
    if not len(xy):
        return np.empty((0, 2)), {}
    return _clustered(xy, weight)


def _clustered(xy: FloatArray, weight: FloatArray) -> tuple[FloatArray, dict[str, FloatArray]]:
    # Every purpose counts alike where goals lie, however large its numbers are.
    share = (weight / np.maximum(weight.sum(axis=0), 1e-9)).sum(axis=1)
    used = share > 0.0
    xy, weight, share = xy[used], weight[used], share[used]
    extent = float(np.prod(np.ptp(xy, axis=0) + 1.0))
    count = min(MOST_GOALS, len(np.unique(np.round(xy), axis=0)), max(int(extent / APART**2), 1))
    with with_extra("a town", "osm"):
        from sklearn.cluster import KMeans

    clusters = KMeans(count, n_init=1, max_iter=30, random_state=0).fit(xy, sample_weight=share)
    label = np.asarray(clusters.labels_, np.int64)
    total = np.bincount(label, share, minlength=count)
    kept = np.flatnonzero(total > 0.0)
    goals = np.stack(
        [np.bincount(label, share * axis, minlength=count)[kept] / total[kept] for axis in xy.T], axis=1
    )
    weights = {
        purpose: np.round(np.bincount(label, weight[:, k], minlength=count)[kept] / 1e3, 3)
        for k, purpose in enumerate(PURPOSES)
    }
    return goals, {purpose: values for purpose, values in weights.items() if values.any()}


def _sources(
    elements: Sequence[OsmElement], buildings: Sequence[Area], frame: LocalFrame
) -> tuple[FloatArray, FloatArray]:
    """Return where anything attracts people, (n, 2) m, and how much, (n, n_purposes) m² of floor."""
    area = shapely.area([a.polygon for a in buildings])
    middle = shapely.get_coordinates(shapely.point_on_surface([a.polygon for a in buildings]))
    own = {a.element.id for a in buildings}
    points = [(e, found) for e in elements if e.id not in own and (found := _point_of(e.tags)) is not None]
    here = np.array([frame.to_xy(e.lines[0]).mean(axis=0) for e, _ in points]).reshape(-1, 2)
    tree = shapely.STRtree([a.polygon for a in buildings])
    spoken_for = set(tree.query(shapely.points(here), predicate="intersects")[1].tolist())
    sources = [(at, floor, attracts) for (_, (floor, attracts)), at in zip(points, here, strict=True)]
    for k, building in enumerate(buildings):
        tags = building.element.tags
        levels, attracts = BUILDINGS.get(tags["building"], (1.0, {}))
        floor = float(area[k]) * (supply.levels_of(tags) or levels)
        point = _point_of(tags)
        if point is not None:
            attracts = point[1]
        elif tags["building"] == "yes" and k in spoken_for:
            floor *= 0.5  # shops below, dwellings above
        if attracts and area[k] >= LEAST_AREA:
            sources.append((middle[k], floor, attracts))
    weights = [[floor * kind.get(purpose, 0.0) for purpose in PURPOSES] for _, floor, kind in sources]
    return np.array([at for at, _, _ in sources]).reshape(-1, 2), np.array(weights).reshape(-1, len(PURPOSES))


def _point_of(tags: Mapping[str, str]) -> tuple[float, dict[str, float]] | None:
    if found := POINTS.get(tags.get("amenity", "")):
        return found
    for key in ("shop", "office", "craft", "healthcare", "tourism", "leisure"):
        if tags.get(key, "no") not in ("no", "vacant", *QUIET.get(key, ())):
            return POINTS[key]
    return None
