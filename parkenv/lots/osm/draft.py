"""Import lots from OpenStreetMap.

Slots come from:

- `amenity=parking_space` areas, by their outlines; one with a `capacity` is split into that many along its road;
- `amenity=parking` areas without such spaces, filled by the rule of `fill_outline`;
- kerbside parking tagged on streets, see `rows`.

The import leaves out, and lists, spaces for disabled drivers (subtracted from a tagged capacity), private and closed
parking, parking underground or on a deck, and spaces for other vehicles.

Lanes come from `highway=service` ways. If slots open to a public street, or the service roads are not connected, the
public streets within 60 m of the slots are lanes too. Roads that serve no slot and lead nowhere are dropped. A slot
prefers a parking aisle to another service road, and a service road to a street.

Entries are the points where service roads meet a public street or, if streets are lanes, where the streets leave the
map: at its edge, or otherwise at ends not tagged as dead ends. Goals are the building entrances (`entrance`) near the
slots, main entrances first, or the centre of the nearest building. Buildings block the view. Traffic keeps to the
right, unless `in_left_hand_traffic` converts the draft.

`MapImport` is what lots and towns (`parkenv.lots.town.draft`) read alike: areas, spaces, points, and what is left out.
A lot is slots beside whole roads, those that fit; a town is facilities with rules and capacities at pieces of streets.
"""

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import shapely

from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.errors import InputError, naming, require
from parkenv.lots.draft import ImportOptions, LeftOut, LotDraft, points_in_frame
from parkenv.lots.generators import NO_SLOTS, Slots
from parkenv.lots.infer.layout import (
    findings,
    guesses_and_issues,
    infer_lot,
    missing_parts,
    spaces_without_aisle,
)
from parkenv.lots.infer.network import STREET, Line, limit_junctions
from parkenv.lots.infer.spaces import rectangle_corners, spaces_from_outlines, to_rectangle, validate_areas
from parkenv.lots.local_frame import LocalFrame
from parkenv.lots.osm.conditions import RESERVED_PLACES, note_other_keys
from parkenv.lots.osm.elements import OsmElement, OsmMap, place_name, read_map
from parkenv.lots.osm.parking import (
    BUILDING_REACH,
    ENTRANCE_REACH,
    Area,
    CrossedOutlineError,
    Junctions,
    areas_of,
    corridors_of,
    exterior_rings,
    fill_outline,
    find_goals,
    is_building,
    is_clear,
    is_parking_area,
    is_space,
    kerb_of,
    kerb_slots,
    orientation_of,
    slots_by_rank,
    split_space,
    split_walls,
    why_no_slot,
    within,
    without_overlaps,
)
from parkenv.lots.osm.roads import (
    SIDES,
    Rank,
    Road,
    clipped_roads,
    closed_to_cars,
    components_with_slots,
    count_in,
    lanes_of,
    off_the_ground,
    open_ends,
    read_roads,
    road_ends,
    road_of,
    stops_cars,
    street_junctions,
    turns_of,
    used_roads,
    whole_number,
)
from parkenv.lots.unread import noting_unread, unread_rows
from parkenv.world.drive_graph import SLOT_REACH, component_labels
from parkenv.world.lot import Lane

# Values of `parking` for slots that are not in the open at ground level.
OTHER_FLOORS = ("underground", "multi-storey", "rooftop", "garage", "garages", "garage_boxes", "sheds")
PARKING = ("parking", "parking_space")  # values of `amenity`
FARTHEST = 100_000.0  # largest distance of parking and roads from the centre of a map, m
BLIND = {("noexit", "yes"), ("highway", "turning_circle"), ("highway", "turning_loop")}  # tags of dead ends
STREETS_AROUND = 60.0  # distance beyond the slots, m, within which streets are lanes if no bounds are given
NO_AISLE = f"slots that no aisle reaches within {SLOT_REACH:g} m"  # reason for leaving out
# Sources of slots.
MAPPED, FILLED, KERBSIDE = "amenity=parking_space", "amenity=parking, rows by rule", "kerbside parking"
# Largest allowed overlap, m, of slots drawn by hand, and of slots created by rule.
MAPPED_OVERLAP, RULE_OVERLAP = 0.4, 0.1


def osm_draft(path: str | Path, options: ImportOptions | None = None) -> LotDraft:
    path = Path(path)
    with noting_unread() as unread:
        place = read_map(path)
        with naming(path):
            draft = draft_of_map(place_name(path), place, options or ImportOptions(), place.positions.frame)
    found = (*filter(None, [place.positions.found]), *draft.found, *place.cut_elements())
    return replace(
        draft, found=found, left_out=(*place.left_out, *draft.left_out), unread=unread_rows(unread)
    )


def draft_of_map(
    name: str, place: OsmMap, options: ImportOptions, frame: LocalFrame | None = None
) -> LotDraft:
    """Draft a lot from a map.

    Lanes are inferred from outlines of spaces where there are no roads, or, if guesses are allowed, too few of them.
    """
    elements = place.elements
    parking = [e for e in elements if _is_parking(e)]
    require(
        parking,
        "no parking in it: no amenity=parking_space, no amenity=parking, no street with "
        "parking:left, parking:right or parking:both",
    )
    has_spaces = any(e.tags.get("amenity") == "parking_space" for e in parking)
    ways = (e for e in elements if not e.is_node)
    if has_spaces and not any(isinstance(road_of(e.id, e.tags, e.lines[0] * 1e5), Road) for e in ways):
        return outline_draft(MapImport(name, place, frame or frame_around(parking)), [], options)
    refuse_far_away([e for e in elements if _is_parking(e) or "highway" in e.tags])
    importer = _LotImport(name, place, frame or frame_around(parking), options)
    importer.read_drawn()
    importer.fill_areas()
    importer.read_kerbs()
    draft = importer.draft()
    incomplete = bool(draft.missing) or any(left.reason == NO_AISLE for left in draft.left_out)
    if has_spaces and incomplete and (options.guess_entry or options.guess_goal):
        roads = clipped_roads(importer.roads, importer.edge(draft.slots))
        return outline_draft(MapImport(name, place, importer.frame), roads, options)
    return draft


def frame_around(elements: Sequence[OsmElement]) -> LocalFrame:
    refuse_far_away(elements)
    return LocalFrame.around(np.concatenate([line for e in elements for line in e.lines]))


class _Part(NamedTuple):
    area: Area
    name: str
    polygon: shapely.Geometry


class MapImport:
    """What lots and towns read of a map alike: its areas, its points, slots of drawn spaces, and what is left out."""

    def __init__(self, name: str, place: OsmMap, frame: LocalFrame) -> None:
        self.name, self.place, self.frame = name, place, frame
        self.left_out: dict[str, list[str]] = defaultdict(list)
        self.nodes = [e for e in place.elements if e.is_node]

    def areas(self, wanted: Callable[[OsmElement], bool], *, mended: bool = False) -> list[Area]:
        areas = areas_of(self.place.elements, self.frame, wanted, mended=mended)
        if not mended:
            self.left_out["outlines without an area"] += [
                a.element.id for a in areas if not shapely.area(a.polygon)
            ]
        return [a for a in areas if shapely.area(a.polygon) > 0.0]

    def usable(
        self, areas: Iterable[Area], why_not: Callable[[Area], str | None]
    ) -> tuple[list[Area], list[Area]]:
        """Divide areas into those that are used and the others, which are listed with why they are not."""
        judged = [(area, why_not(area)) for area in areas]
        others = [(area, reason) for area, reason in judged if reason is not None]
        for area, reason in others:
            self.left_out[reason].append(area.element.id)
        return [area for area, reason in judged if reason is None], [area for area, _ in others]

    def usable_spaces(self, spaces: Sequence[Area], parking: Sequence[Area]) -> tuple[list[Area], list[Area]]:
        private = [a.polygon for a in parking if closed_to_cars(a.element.tags)]
        return self.usable(spaces, lambda space: why_no_slot(space, private))

    def crossings(self) -> FloatArray:
        return self.points(lambda e: e.tags.get("highway") == "crossing")

    def points(self, wanted: Callable[[OsmElement], bool]) -> FloatArray:
        positions = (e.lines[0] for e in self.nodes if wanted(e))
        return self.frame.to_xy(np.concatenate([np.empty((0, 2)), *positions]))

    def goals(
        self, slots: Slots, buildings: Sequence[Area], options: ImportOptions
    ) -> tuple[FloatArray, str]:
        """Return the goals of a lot, (n, 2) m, and where they come from, unless they are given."""
        given = points_in_frame(self.frame, options.goals)
        return (given, "") if len(given) else find_goals(slots, self.nodes, buildings, self.frame)

    def drawn_slots(
        self, spaces: Sequence[Area], lanes: Sequence[Lane], roads: Sequence[Road]
    ) -> tuple[list[_Part], IntArray, list[Rank], Slots]:
        """Return the places of spaces, and the slots of those that a road reaches: index, rank of the road."""
        parts = [
            _Part(area, name, polygon)
            for area in spaces
            for name, polygon in split_space(area.element, to_rectangle(area.polygon), lanes)
        ]
        index, ranks, slots = slots_by_rank(
            np.array([part.polygon for part in parts], dtype=np.object_), roads
        )
        left = np.setdiff1d(np.arange(len(parts)), index)
        self.left_out[NO_AISLE] += [parts[i].name for i in left.tolist()]
        return parts, index, ranks, slots


class _Slot(NamedTuple):
    source: str
    owner: str  # id of its element
    id: str
    rank: Rank


class _LotImport(MapImport):
    def __init__(self, name: str, place: OsmMap, frame: LocalFrame, options: ImportOptions) -> None:
        super().__init__(name, place, frame)
        self.options, self.box = options, options.box(self.frame)
        self.notes: list[str] = []
        self.roads = read_roads(place.elements, self.frame, self.left_out, left_hand=options.left_hand)
        if self.box is not None:
            self.roads = clipped_roads(self.roads, shapely.box(*self.box))
        self.parking, self.spaces, self.buildings = (
            within(self.areas(wanted), self.box) for wanted in (is_parking_area, is_space, is_building)
        )
        for e in place.elements:
            kind = e.tags.get("amenity", "")
            if kind in PARKING and not (e.lines and e.is_closed):
                self.left_out[f"amenity={kind} without an outline"].append(e.id)
        self.slots: list[_Slot] = []
        self.parts: list[Slots] = []  # of the same slots
        self.rows: Counter[str] = Counter()  # number of slots so far of each row
        self.blocked: list[shapely.Geometry] = [a.polygon for a in self.buildings]

    def _add_row(
        self, source: str, owner: str, start: str, slots: Slots, rank: Rank, tagged: int | None, where: str
    ) -> None:
        first = self.rows[start] + 1
        self.rows[start] += len(slots)
        self.slots += [_Slot(source, owner, f"{start}-{first + k}", rank) for k in range(len(slots))]
        self.parts.append(slots)
        if tagged is not None and len(slots) < tagged:
            self.notes.append(f"{owner}: {len(slots)} of the tagged {tagged} slots fit {where}")

    # ---- slots ----

    def read_drawn(self) -> None:
        usable, unused = self.usable_spaces(self.spaces, self.parking)
        self.blocked += [area.polygon for area in (*unused, *usable)]
        spaces, index, ranks, slots = self.drawn_slots(usable, lanes_of(self.roads), self.roads)
        drawn = zip([spaces[i] for i in index.tolist()], ranks, strict=True)
        self.slots += [_Slot(MAPPED, space.area.element.id, space.name, rank) for space, rank in drawn]
        self.parts.append(slots)

    def fill_areas(self) -> None:
        centers = shapely.points(np.concatenate([np.empty((0, 2)), *(slots.xy for slots in self.parts)]))
        tree = shapely.STRtree([shapely.LineString(road.points) for road in self.roads])
        for area in self.parking:
            tags, name = area.element.tags, area.element.id
            kind = tags.get("parking", "surface")
            reason = closed_to_cars(tags) or off_the_ground(tags)
            if kind in OTHER_FLOORS:
                reason = f"parking={kind}"
            if reason is not None:
                self.left_out[f"parking areas with {reason}"].append(name)
                continue
            note_other_keys(tags)
            if shapely.contains(area.polygon, centers).any():
                continue
            capacity = count_in(tags, "capacity", "as many as fit")
            if capacity is not None:
                parts = (whole_number(tags.get(f"capacity:{users}")) or 0 for users in RESERVED_PLACES)
                capacity = max(capacity - sum(parts), 0)
            near = np.sort(tree.query(area.polygon, predicate="dwithin", distance=SLOT_REACH)).tolist()
            on_it = np.flatnonzero(shapely.dwithin(np.array(self.blocked, dtype=object), area.polygon, 1.0))
            slots, rank = NO_SLOTS, Rank.SERVICE
            for rank in (Rank.SERVICE, Rank.STREET):
                slots = fill_outline(
                    area.polygon,
                    [self.roads[k] for k in near if self.roads[k].rank <= rank],
                    [self.blocked[k] for k in on_it],
                    orientation_of(tags),
                    capacity,
                )
                if len(slots):
                    break
            if not len(slots):
                self.left_out["parking areas without a road along which a slot fits"].append(name)
                continue
            self._add_row(FILLED, name, name, slots, rank, capacity, "by the rule")
            self.blocked += list(slots.boxes(shrink=0.02))

    def read_kerbs(self) -> None:
        if not any(road.has_kerb_parking for road in self.roads):
            return
        junctions = Junctions(self.roads, self.crossings())
        corridors = corridors_of(self.roads)
        for k, road in enumerate(self.roads):
            for side in SIDES:
                kerb = kerb_of(road, side, self.left_out)
                if kerb is None:
                    continue
                slots = kerb_slots(road, side, kerb, junctions.free_intervals(k, side))
                slots = slots[is_clear(slots, corridors, 0.05)]
                tagged = road.side_of_way(side)
                start, where = f"{road.id}-{tagged}", f"on the {tagged}"
                self._add_row(KERBSIDE, road.id, start, slots, road.rank, kerb.capacity, where)

    # ---- the lot ----

    def draft(self) -> LotDraft:
        sources, slots = self._without_overlaps()
        streets = [road for road in self.roads if road.rank is Rank.STREET]
        service = [road for road in self.roads if road.rank < Rank.STREET]
        # Streets are lanes, too, where slots open to them or they connect the service roads.
        on_street = any(slot.rank == Rank.STREET for slot in sources)
        is_apart = len(slots) > 0 and len(components_with_slots(service, slots)) > 1
        if on_street or is_apart:
            edge = self.edge(slots)
            roads = used_roads(clipped_roads(self.roads, edge), [], slots)
            ways_in = open_ends(roads, edge, self.points(is_blind))
        else:
            roads = used_roads(service, streets, slots)
            ways_in = street_junctions(roads, streets)
        given = points_in_frame(self.frame, self.options.entries)
        entries = given if len(given) else ways_in
        goals, goal_note = self.goals(slots, self.buildings, self.options)
        walls, passages = split_walls(slots, roads, self.buildings)
        self.left_out["buildings over slots or lanes, which are no walls"] += passages

        whole = lanes_of(roads)
        lanes = limit_junctions(whole)
        turns = turns_of(self.place, self.frame, whole, lanes, away=False)
        draft = LotDraft(
            name=self.name,
            slot_ids=tuple(slot.id for slot in sources),
            slots=slots,
            slot_source=tuple(slot.source for slot in sources),
            lanes=tuple(lanes),
            entries=entries,
            goals=goals,
            walls=tuple(walls),
            outlines=tuple(exterior_rings(a.polygon for a in self.parking)),
            missing=tuple(self._missing(slots, roads, entries, goals)),
            frame=self.frame,
            turns=turns.kept,
        ).searchable()
        return replace(
            draft,
            found=(*self._found(draft, roads, goal_note), *turns.found),
            left_out=(*LeftOut.by_reason(self.left_out), *turns.left_out, *draft.left_out),
        )

    def _without_overlaps(self) -> tuple[list[_Slot], Slots]:
        slots = Slots.joined([*self.parts, NO_SLOTS])
        shrink = np.where([slot.source == MAPPED for slot in self.slots], MAPPED_OVERLAP, RULE_OVERLAP)
        is_free = without_overlaps(slots.boxes(shrink))
        self.left_out["slots that overlap others"] += [
            self.slots[i].id for i in np.flatnonzero(~is_free).tolist()
        ]
        index = np.flatnonzero(is_free)
        return [self.slots[i] for i in index.tolist()], slots[index]

    def edge(self, slots: Slots) -> shapely.Geometry:
        if self.box is not None:
            return shapely.Polygon(shapely.box(*self.box))
        low, high = slots.xy.min(axis=0) - STREETS_AROUND, slots.xy.max(axis=0) + STREETS_AROUND
        return shapely.Polygon(shapely.box(*low, *high))

    def _missing(
        self, slots: Slots, roads: Sequence[Road], entries: FloatArray, goals: FloatArray
    ) -> Iterable[str]:
        if not self.roads:
            yield "no lane: the file holds no road that cars may drive; export highway=service and streets too"
        elif not len(slots):
            yield "no slot: nothing that the file calls parking could be used"
        if len(slots) and roads and not len(entries):
            ends = self.frame.to_lonlat([xy for _, xy, _ in road_ends(roads)])[:3, ::-1]
            where = " and ".join(f"{lat:.6f},{lon:.6f}" for lat, lon in ends.tolist())
            yield (
                "no entry: the lanes meet no public street in this file, nor do they leave it; give one by "
                "--entry LAT,LON" + (f"; lanes end at {where}" if where else "")
            )
        if len(slots) and not len(goals):
            yield (
                f"no goal: no building entrance within {ENTRANCE_REACH:g} m of a slot and no building within "
                f"{BUILDING_REACH:g} m; give the place that people walk to by --goal LAT,LON"
            )

    def _found(self, draft: LotDraft, roads: Sequence[Road], goal_note: str) -> Iterable[str]:
        kept = set(draft.slot_ids)
        for source in (MAPPED, FILLED, KERBSIDE):
            owners = [slot.owner for slot in self.slots if slot.source == source and slot.id in kept]
            if owners:
                yield f"slots from {source}: {len(owners)} (elements: {len(set(owners))})"
        aisles, service = (sum(road.rank is rank for road in roads) for rank in (Rank.AISLE, Rank.SERVICE))
        yield (
            f"lanes: {len(roads)} (parking aisles: {aisles}, other service roads: {service}, "
            f"streets: {len(roads) - aisles - service}; one-way: {sum(road.oneway for road in roads)})"
        )
        how = "as given" if self.options.entries else "where the lanes are left or meet a public street"
        if len(draft.entries):
            yield f"entries: {len(draft.entries)}, {how}"
        if len(draft.goals):
            yield f"goals: {len(draft.goals)}, {goal_note or 'as given'}"
        yield from self.notes
        yield f"frame: {self.frame}"


def _is_parking(element: OsmElement) -> bool:
    tags = element.tags
    return tags.get("amenity") in PARKING or (
        "highway" in tags and any(key.startswith(("parking:", "parking:lane:")) for key in tags)
    )


def is_blind(element: OsmElement) -> bool:
    """Whether a node ends a street where the map goes on."""
    return stops_cars(element.tags) or not BLIND.isdisjoint(element.tags.items())


def refuse_far_away(elements: Sequence[OsmElement]) -> None:
    """Raise an error for a map of more than one place: a plane cannot preserve distances across a continent."""
    positions = np.concatenate([line for e in elements for line in e.lines])
    order = len(positions) // 2
    lon, lat = np.partition(positions, order, axis=0)[order].tolist()
    away = np.hypot(*LocalFrame(lon, lat).to_xy(positions).T)
    if away.max() > FARTHEST:
        k = int(away.argmax())
        names = [e.id for e in elements for line in e.lines for _ in line]
        raise InputError(
            f"{names[k]} is at {positions[k, 1]:.4f}, {positions[k, 0]:.4f} and most of the map "
            f"{away[k] / 1e3:,.0f} km away at {lat:.4f}, {lon:.4f}, want a map no larger than "
            f"{FARTHEST / 1e3:.0f} km around its middle (are latitude and longitude swapped?)"
        )


MOST_SPACES = 20_000  # maximum number of spaces of one lot


def outline_draft(of: MapImport, roads: Sequence[Road], options: ImportOptions) -> LotDraft:
    """Draft a lot from the outlines of its spaces; `parkenv.lots.infer.layout` has the rules."""
    drawn = [e for e in of.place.elements if is_space(e)]
    require(
        len(drawn) <= MOST_SPACES,
        f"{len(drawn):,} parking spaces, want at most {MOST_SPACES:,} in one lot; divide it by --split or --bounds",
    )
    readable, crossing = list[Area](), of.left_out["outlines that cross themselves"]
    for element in drawn:
        try:
            readable.append(Area.of(element, of.frame, simple=True))
        except CrossedOutlineError:
            crossing.append(element.id)
            if len(crossing) == len(drawn):
                raise
    areas = within(readable, options.box(of.frame))
    _refuse_swapped(areas)
    validate_areas(
        [a.element.id for a in areas], shapely.area(np.array([a.polygon for a in areas], dtype=object))
    )
    buildings, parking = (of.areas(wanted, mended=True) for wanted in (is_building, is_parking_area))
    kept, unused = of.usable_spaces(areas, parking)
    if not kept:
        raise InputError(f"no parking space for cars: {'; '.join(map(str, LeftOut.by_reason(of.left_out)))}")
    ids, polygons = zip(*(part for a in kept for part in split_space(a.element, a.polygon, [])), strict=True)
    spaces = spaces_from_outlines(ids, np.array(polygons, dtype=object))
    obstacles = [a.polygon for a in (*buildings, *unused)]
    lines = [Line(road.points, road.oneway, STREET if road.rank is Rank.STREET else -1) for road in roads]
    lot = infer_lot(spaces, obstacles, lines, points_in_frame(of.frame, options.entries))
    n_unused = sum(map(len, of.left_out.values()))
    of.left_out.update(spaces_without_aisle(lot, spaces))
    goals, goal_note = of.goals(lot.slots, buildings, options)
    if not len(goals) and options.guess_goal:
        goals, goal_note = lot.goal, "on the side of the entry"
    is_known = bool(options.entries) or options.guess_entry or lot.entry is None
    entries = lot.entries if is_known else lot.entries[:0]
    guesses, issues = guesses_and_issues(lot, len(spaces), n_unused, options, goal_note)
    return LotDraft(
        name=of.name,
        slot_ids=tuple(spaces.ids[i] for i in lot.index),
        slots=lot.slots,
        slot_source=(MAPPED,) * len(lot.index),
        lanes=lot.lanes,
        entries=entries,
        goals=goals,
        walls=tuple(exterior_rings(a.polygon for a in buildings)),
        outlines=tuple(exterior_rings(a.polygon for a in parking)),
        found=tuple(findings(lot, len(spaces), of.frame)),
        guesses=tuple(guesses),
        issues=tuple(issues),
        left_out=LeftOut.by_reason(of.left_out),
        missing=tuple(missing_parts(lot, entries, goals)),
        frame=of.frame,
    ).searchable()


def _refuse_swapped(areas: Sequence[Area]) -> None:
    """Raise an error if many more spaces have the size of parked cars with latitude and longitude exchanged."""
    lonlat = [area.element.lines[0] for area in areas]
    if not areas or np.abs(np.concatenate(lonlat)).max() > 89.0:
        return
    if _like_cars([line[:, ::-1] for line in lonlat]) - _like_cars(lonlat) > 0.3:
        lon, lat = lonlat[0][0].tolist()
        raise InputError(
            f"{areas[0].element.id} is at {lat:.4f}, {lon:.4f}, where few spaces have the size of a car, want "
            "positions at which they have (are latitude and longitude swapped?)"
        )


def _like_cars(outlines: Sequence[FloatArray]) -> float:
    """Return the fraction of outlines, (k, 2) degrees, that have the size of a parked car."""
    frame = LocalFrame.around(np.concatenate(outlines))
    polygons = [p for o in outlines if (p := shapely.Polygon(frame.to_xy(o))).area >= 0.1]
    sizes = [np.hypot(*np.diff(rectangle_corners(p)[:3], axis=0).T) for p in polygons]
    fits = [1.8 < s.min() < 3.0 and 4.0 < s.max() < 6.0 and s.prod() < 16.0 for s in sizes]
    return float(np.mean(fits)) if fits else 0.0


# Distance, m, between spaces up to which they belong to one car park: a street with verges, or two aisles.
SAME_CAR_PARK = 22.0
AROUND = 60.0  # distance, m, from the spaces of a car park within which roads and buildings belong to it
LEAST_SPACES = 10  # number of spaces of the smallest car park, by default
MOST_IN_TOWN = 300_000  # maximum number of spaces in one file


@dataclass(frozen=True, eq=False)
class CarPark:
    name: str
    spaces: int  # number of outlines
    draft: LotDraft | None  # its lot
    reason: str = ""  # why there is none


def import_car_parks(
    path: str | Path, options: ImportOptions, least: int = LEAST_SPACES
) -> Iterator[CarPark]:
    path = Path(path)
    place = read_map(path)
    with naming(path):
        parts = list(split_town(place_name(path), place.elements, least))
    for name, part in parts:
        count = sum(map(is_space, part))
        try:
            draft = draft_of_map(name, replace(place, elements=part), options, place.positions.frame)
            draft.lot()
        except InputError as error:
            yield CarPark(name, count, None, str(error))
        else:
            yield CarPark(name, count, draft)


def split_town(
    name: str, elements: Sequence[OsmElement], least: int
) -> Iterator[tuple[str, list[OsmElement]]]:
    spaces = [e for e in elements if is_space(e)]
    require(spaces, "no amenity=parking_space in it, want their outlines to find car parks")
    if len(spaces) > MOST_IN_TOWN:
        raise InputError(f"{len(spaces):,} parking spaces, want at most {MOST_IN_TOWN:,} in one file")
    frame = frame_around(spaces)
    shapes = np.array([_hull(e, frame.to_xy(np.concatenate(e.lines))) for e in spaces], dtype=object)
    near = shapely.STRtree(shapes).query(shapes, predicate="dwithin", distance=SAME_CAR_PARK)
    label = component_labels(near.T, len(spaces))
    _, first, size = np.unique(label, return_index=True, return_counts=True)
    chosen = [k for k in np.lexsort((first, -size)).tolist() if size[k] >= least]
    require(
        chosen, f"{len(spaces)} parking spaces in groups of at most {size.max()}, want a group of {least}"
    )
    others = [e for e in elements if not is_space(e)]
    around = np.array([_hull(e, frame.to_xy(np.concatenate(e.lines))) for e in others], dtype=object)
    tree = shapely.STRtree(around)
    digits = len(str(len(chosen)))
    for number, k in enumerate(chosen, start=1):
        members = np.flatnonzero(label == k)
        ground = shapely.union_all(shapes[members])
        around_it: list[int] = np.sort(tree.query(ground, predicate="dwithin", distance=AROUND)).tolist()
        yield (
            f"{name}-{number:0{digits}d}",
            [spaces[i] for i in members.tolist()] + [others[i] for i in around_it],
        )


def _hull(element: OsmElement, xy: FloatArray) -> shapely.Geometry:
    """Return a shape that is valid for every element."""
    if element.tags.get("highway") and not element.is_node:
        return shapely.LineString(xy)
    return shapely.convex_hull(shapely.MultiPoint(xy))
