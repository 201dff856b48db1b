"""Lots made from OpenStreetMap.

What becomes a slot:

- `amenity=parking_space` areas, by their outlines; one with a `capacity` is cut into as many along its road;
- `amenity=parking` areas that hold no such space, filled by the rule of `fill_outline`;
- kerbside parking tagged on streets, see `osm_kerbs`.

Spaces for disabled drivers are left out unless asked for, and taken off a tagged capacity; so is what
is private, closed, below the ground or on a deck, and spaces for other than cars. Everything left out is
listed.

What becomes a lane: `highway=service` ways. Where slots open to a public street, or the service roads do
not hang together, the public streets are lanes too, within 60 m of the slots. Roads to which no slot opens
and that lead nowhere are dropped. A slot opens to a parking aisle before another service road, and to that
before a street.

Cars come in where service roads meet a public street, or, where streets are lanes, where these leave the
map: at its edge, or else at their ends that are not tagged as blind. People walk to the building entrances
(`entrance`) near the slots, main ones first, or to the middle of the nearest building. Buildings stop the
eye. Traffic keeps to the right, as everywhere in parkenv: in a country that drives on the left, slots and
lanes are true, the sides are not.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from parkenv.errors import InputError
from parkenv.lots.generators import Slots
from parkenv.lots.local_frame import LocalFrame
from parkenv.lots.places.lot_draft import LeftOut, LotDraft, Wishes, points_in
from parkenv.lots.places.osm_elements import OsmElement, read_elements
from parkenv.lots.places.osm_junctions import uncrowded
from parkenv.lots.places.osm_kerbs import Junctions, kerb_of, kerb_slots
from parkenv.lots.places.osm_outlines import CORRIDOR, fill_outline
from parkenv.lots.places.osm_roads import Rank, Road, closed_to_cars, off_the_ground, road_of, whole_number
from parkenv.lots.places.osm_rows import ARRANGEMENTS, NO_SLOTS, boxes_of, without_overlaps
from parkenv.lots.slot_polygons import nearest_on_lanes, slots_from_polygons
from parkenv.world.drive_graph import SLOT_REACH, places
from parkenv.world.lot import Lane, mouth_points

FloatArray = NDArray[np.float64]

CAR_SPACES = ("normal", "yes", "car", "parent", "parents", "women", "woman", "customers", "residents")
"""Values of `parking_space` that any car may use."""
OTHER_FLOORS = ("underground", "multi-storey", "rooftop", "garage", "garages", "garage_boxes", "sheds")
"""Values of `parking` whose slots do not lie open on the ground."""
LARGEST_SPACE = 30.0
"""m²; a larger space without a capacity stands for several."""
FARTHEST = 100_000.0
"""How far from the middle of a map its parking and roads may lie, m."""
STREETS_AROUND = 60.0
"""How far beyond the slots streets are lanes, m, where no bounds are given."""
ENTRANCE_REACH = 100.0
"""How far from the nearest slot a building's entrance may lie to be a goal, m."""
BUILDING_REACH = 200.0
"""The same of the nearest building where there is no entrance."""
NO_DOORS = ("no", "garage", "emergency", "exit", "service")
NOT_WALKED_TO = ("garage", "garages", "carport", "roof", "shed", "parking", "hut", "no", "transformer_tower")
MAPPED_OVERLAP, RULE_OVERLAP = 0.4, 0.1
"""Overlap, m, up to which slots stay that are drawn by hand, and that are made by rule."""


def osm_draft(path: str | Path, wishes: Wishes | None = None) -> LotDraft:
    """What a file of OpenStreetMap holds of a lot; see the module for the rules.

    Args:
        path: `.osm`, `.xml`, or the JSON and GeoJSON of Overpass.
        wishes: what the user says of the place.

    Raises:
        InputError: the file is torn or of another kind, holds no parking, an outline crosses itself, or what it holds
            lies too far apart.
    """
    path = Path(path)
    wishes = wishes or Wishes()
    place = _Place(path, read_elements(path), wishes)
    place.read_spaces()
    place.fill_outlines()
    place.line_kerbs()
    return place.draft()


@dataclass(frozen=True, eq=False)
class _Area:
    """A closed element, projected."""

    element: OsmElement
    polygon: shapely.Geometry


@dataclass(eq=False)
class _Group:
    """Slots that were made in one way, and the least rank of road that each opens to."""

    source: str
    ids: list[str] = field(default_factory=list)
    owners: list[str] = field(default_factory=list)
    slots: list[Slots] = field(default_factory=list)
    ranks: list[int] = field(default_factory=list)

    def add(self, owners: Sequence[str], ids: Sequence[str], slots: Slots, ranks: Sequence[int]) -> None:
        self.owners += owners
        self.ids += ids
        self.slots.append(slots)
        self.ranks += ranks

    def add_row(self, owner: str, start: str, slots: Slots, rank: Rank) -> None:
        """Slots of one element, numbered from 1."""
        n = len(slots)
        self.add([owner] * n, [f"{start}-{k + 1}" for k in range(n)], slots, [int(rank)] * n)


class _Place:
    """What is known of the place while a file is read."""

    def __init__(self, path: Path, elements: Sequence[OsmElement], wishes: Wishes) -> None:
        self.path = path
        self.wishes = wishes
        self.left_out: dict[str, list[str]] = {}
        self.notes: list[str] = []
        parking = [e for e in elements if _is_parking(e)]
        if not parking:
            raise InputError(
                f"{path}: no parking in it: no amenity=parking_space, no amenity=parking, no street with "
                "parking:left, parking:right or parking:both"
            )
        _refuse_far_away(path, [e for e in elements if _is_parking(e) or "highway" in e.tags])
        self.frame = LocalFrame.around(np.concatenate([line for e in parking for line in e.lines]))
        self.box = wishes.box(self.frame)
        box = None if self.box is None else shapely.box(*self.box)
        self.nodes = [e for e in elements if e.is_node]
        self.roads = self._roads(elements, box)

        def areas(wanted: Callable[[OsmElement], bool]) -> list[_Area]:
            found = [
                _Area(e, self._polygon(e))
                for e in elements
                if wanted(e) and e.lines and e.is_closed and not e.is_node
            ]
            return [
                a for a in found if box is None or shapely.contains(box, shapely.point_on_surface(a.polygon))
            ]

        self.outlines = areas(lambda e: e.tags.get("amenity") == "parking")
        self.spaces = areas(lambda e: e.tags.get("amenity") == "parking_space")
        self.buildings = areas(lambda e: e.tags.get("building", "no") != "no")
        for e in parking:
            kind = e.tags.get("amenity", "")
            if kind.startswith("parking") and not (e.lines and e.is_closed):
                self._leave_out(f"amenity={kind} without an outline", e.id)
        self.mapped = _Group("amenity=parking_space")
        self.filled = _Group("amenity=parking, rows by rule")
        self.kerbside = _Group("kerbside parking")
        self.blocked: list[shapely.Geometry] = [a.polygon for a in self.buildings]

    def _leave_out(self, reason: str, name: str) -> None:
        self.left_out.setdefault(reason, []).append(name)

    def _roads(self, elements: Sequence[OsmElement], box: shapely.Geometry | None) -> list[Road]:
        roads: list[Road] = []
        for element in elements:
            if element.is_node or "highway" not in element.tags:
                continue
            road = road_of(element.id, element.tags, self.frame.to_xy(element.lines[0]))
            if isinstance(road, str):
                self._leave_out(road, element.id)
            elif road is not None:
                roads += [road] if box is None else _clipped(road, box)
        return roads

    def _polygon(self, element: OsmElement) -> shapely.Geometry:
        outer, inner = (
            [shapely.Polygon(self.frame.to_xy(line)) for line in lines]
            for lines in (element.lines, element.holes)
        )
        is_building = "building" in element.tags and "amenity" not in element.tags
        for polygon in outer + inner:
            if not polygon.is_valid and not is_building:
                reason = shapely.is_valid_reason(polygon).split("[")[0]
                raise InputError(f"{self.path}: {element.id}: its outline is not a simple one: {reason}")
        whole = [shapely.union_all([shapely.make_valid(p) for p in part]) for part in (outer, inner)]
        return whole[0].difference(whole[1])

    # ---- slots ----

    def read_spaces(self) -> None:
        """Slots from mapped spaces."""
        private = [a for a in self.outlines if closed_to_cars(a.element.tags)]
        kept: list[_Area] = []
        for area in self.spaces:
            reason = self._why_no_slot(area, private)
            if reason is None:
                kept.append(area)
            else:
                self._leave_out(reason, area.element.id)
                self.blocked.append(area.polygon)
        if not kept:
            return
        owners: list[str] = []
        names: list[str] = []
        polygons: list[shapely.Geometry] = []
        lanes = _lanes(self.roads)
        for area in kept:
            capacity = whole_number(area.element.tags.get("capacity")) or 1
            parts = _cut_along_road(_squared(area.polygon), capacity, lanes)
            names += (
                [area.element.id]
                if capacity == 1
                else [f"{area.element.id}-{k + 1}" for k in range(capacity)]
            )
            polygons += parts
            owners += [area.element.id] * len(parts)
        self.blocked += [area.polygon for area in kept]

        # An aisle is preferred to another service road, and that to a street, even where these are nearer.
        left = np.arange(len(polygons))
        array = np.array(polygons, dtype=np.object_)
        for rank in Rank:
            near = _lanes([road for road in self.roads if road.rank <= rank])
            if not len(left) or not near:
                continue
            slots = slots_from_polygons(array[left], near)
            mouth = mouth_points(slots.xy, slots.yaw, slots.length, slots.width, slots.mouth)
            to_lane = nearest_on_lanes(near, mouth)[0] - mouth
            reached = np.hypot(to_lane[:, 0], to_lane[:, 1]) <= SLOT_REACH
            found = np.flatnonzero(reached)
            reached_ids = left[found]
            self.mapped.add(
                [owners[i] for i in reached_ids],
                [names[i] for i in reached_ids],
                slots[found],
                [int(rank)] * len(found),
            )
            left = left[~reached]
        for i in left:
            self._leave_out(f"slots that no aisle reaches within {SLOT_REACH:g} m", names[i])

    def _why_no_slot(self, area: _Area, private: Sequence[_Area]) -> str | None:
        tags = area.element.tags
        kind = tags.get("parking_space", "normal")
        is_disabled = (
            kind == "disabled"
            or tags.get("access") == "disabled"
            or tags.get("capacity:disabled", "no") not in ("no", "0")
        )
        if is_disabled and not self.wishes.with_disabled:
            return "spaces for disabled drivers"
        if not is_disabled and kind not in CAR_SPACES:
            return f"spaces with parking_space={kind}"
        reason = closed_to_cars(tags) or off_the_ground(tags)
        if reason is not None:
            return f"spaces with {reason}"
        inside = shapely.point_on_surface(area.polygon)
        if any(shapely.contains(other.polygon, inside) for other in private):
            return "spaces in private parking"
        if (
            whole_number(tags.get("capacity")) in (None, 0)
            and float(shapely.area(area.polygon)) > LARGEST_SPACE
        ):
            return f"spaces larger than {LARGEST_SPACE:g} m² without a capacity"
        return None

    def fill_outlines(self) -> None:
        """Slots by rule in the parking areas that hold none."""
        centers = shapely.points(
            np.concatenate([s.xy for s in self.mapped.slots]) if self.mapped.slots else np.empty((0, 2))
        )
        tree = shapely.STRtree([shapely.LineString(road.points) for road in self.roads])
        for area in self.outlines:
            tags, name = area.element.tags, area.element.id
            kind = tags.get("parking", "surface")
            reason = closed_to_cars(tags) or off_the_ground(tags)
            if kind in OTHER_FLOORS:
                reason = f"parking={kind}"
            if reason is not None:
                self._leave_out(f"parking areas with {reason}", name)
                continue
            if shapely.contains(area.polygon, centers).any():
                continue
            orientation = tags.get("orientation", tags.get("parking:orientation"))
            capacity = whole_number(tags.get("capacity"))
            if capacity is not None and not self.wishes.with_disabled:
                capacity = max(capacity - (whole_number(tags.get("capacity:disabled")) or 0), 0)
            near = np.sort(tree.query(area.polygon, predicate="dwithin", distance=SLOT_REACH)).tolist()
            on_it = np.flatnonzero(shapely.dwithin(np.array(self.blocked, dtype=object), area.polygon, 1.0))
            slots, rank = NO_SLOTS, Rank.SERVICE
            for rank in (Rank.SERVICE, Rank.STREET):
                slots = fill_outline(
                    area.polygon,
                    [self.roads[k] for k in near if self.roads[k].rank <= rank],
                    [self.blocked[k] for k in on_it],
                    orientation if orientation in ARRANGEMENTS else None,
                    capacity,
                )
                if len(slots):
                    break
            if not len(slots):
                self._leave_out("parking areas without a road along which a slot fits", name)
                continue
            self.filled.add_row(name, name, slots, rank)
            self.blocked += list(boxes_of(slots, shrink=0.02))
            if capacity is not None and len(slots) < capacity:
                self.notes.append(f"{name}: {len(slots)} of the tagged {capacity} slots fit by the rule")

    def line_kerbs(self) -> None:
        """Slots along streets."""
        crossings = [e.lines[0] for e in self.nodes if e.tags.get("highway") == "crossing"]
        if not any(road.has_kerb_parking for road in self.roads):
            return
        junctions = Junctions(self.roads, self.frame.to_xy(np.concatenate([np.empty((0, 2)), *crossings])))
        corridors = shapely.union_all(
            [
                shapely.LineString(road.points).buffer(CORRIDOR * road.half_width, cap_style="flat")
                for road in self.roads
            ]
        )
        shapely.prepare(corridors)
        for k, road in enumerate(self.roads):
            for side in ("left", "right"):
                tagged = side
                if road.turned:
                    tagged = "left" if side == "right" else "right"
                kerb = kerb_of(road.tags, tagged)  # type: ignore[arg-type]
                if isinstance(kerb, str):
                    self._leave_out(kerb, f"{road.id}-{tagged}")
                if kerb is None or isinstance(kerb, str):
                    continue
                slots = kerb_slots(road, side, kerb, junctions.closed_stretches(k, side))
                clear = np.flatnonzero(~shapely.intersects(corridors, boxes_of(slots, shrink=0.05)))
                slots = slots[clear]
                self.kerbside.add_row(road.id, f"{road.id}-{tagged}", slots, road.rank)
                if kerb.capacity is not None and len(slots) < kerb.capacity:
                    self.notes.append(
                        f"{road.id}: {len(slots)} of the tagged {kerb.capacity} slots fit on the {tagged}"
                    )

    # ---- what belongs together ----

    def draft(self) -> LotDraft:
        """The lot as far as it is known."""
        names, sources, slots, ranks = self._all_slots()
        lanes_of_streets = bool((ranks == Rank.STREET).any())
        roads = self.roads
        if len(slots) and not lanes_of_streets:
            service = [road for road in roads if road.rank < Rank.STREET]
            lanes_of_streets = len(_parts_with_slots(service, slots)) > 1
        streets = [road for road in roads if road.rank is Rank.STREET]
        edge = None
        if lanes_of_streets:
            edge = self._edge(slots)
            roads = [part for road in roads for part in _clipped(road, edge)]
            lanes_around: list[Road] = []
        else:
            roads = [road for road in roads if road.rank < Rank.STREET]
            lanes_around = streets
        roads = self._used(roads, lanes_around, slots)
        entries = points_in(self.frame, self.wishes.entries)
        if not len(entries) and roads:
            entries = _gates(roads, streets) if edge is None else self._open_ends(roads, edge)
        goals, goal_note = self._goals(slots)

        lanes = uncrowded(_lanes(roads))
        draft = LotDraft(
            name=self.path.stem,
            slot_ids=tuple(names),
            slots=slots,
            slot_source=tuple(sources),
            lanes=tuple(lanes),
            entries=entries,
            goals=goals,
            walls=tuple(self._walls(slots, roads)),
            outlines=tuple(
                shapely.get_coordinates(shapely.get_exterior_ring(part))
                for a in self.outlines
                for part in shapely.get_parts(a.polygon)
            ),
            missing=tuple(self._missing(slots, roads, entries, goals)),
            frame=self.frame,
        ).searchable()
        left_out = [LeftOut(reason, tuple(ids)) for reason, ids in self.left_out.items()]
        return replace(
            draft,
            found=tuple(self._found(draft, roads, goal_note)),
            left_out=(*left_out, *draft.left_out),
        )

    def _all_slots(self) -> tuple[list[str], list[str], Slots, NDArray[np.int64]]:
        groups = [g for g in (self.mapped, self.filled, self.kerbside) if g.ids]
        if not groups:
            return [], [], NO_SLOTS, np.empty(0, dtype=np.int64)
        names = [name for g in groups for name in g.ids]
        sources = [g.source for g in groups for _ in g.ids]
        slots = Slots.joined([part for g in groups for part in g.slots])
        ranks = np.array([rank for g in groups for rank in g.ranks], dtype=np.int64)
        is_mapped = np.array([source == self.mapped.source for source in sources])
        shrink = np.where(is_mapped, MAPPED_OVERLAP, RULE_OVERLAP)
        boxes = boxes_of(replace(slots, length=slots.length - shrink, width=slots.width - shrink))
        kept = without_overlaps(boxes)
        for i in np.flatnonzero(~kept):
            self._leave_out("slots that lie on others", names[i])
        index = np.flatnonzero(kept)
        return [names[i] for i in index], [sources[i] for i in index], slots[index], ranks[index]

    def _edge(self, slots: Slots) -> shapely.Geometry:
        """The box beyond which streets are no lanes."""
        if self.box is not None:
            return shapely.Polygon(shapely.box(*self.box))
        low, high = slots.xy.min(axis=0) - STREETS_AROUND, slots.xy.max(axis=0) + STREETS_AROUND
        return shapely.Polygon(shapely.box(*low, *high))

    def _open_ends(self, roads: Sequence[Road], edge: shapely.Geometry) -> FloatArray:
        """Where streets leave the map, (n, 2) m, and cars may drive in.

        These are the ends at its edge, or, where none is cut there, all ends that are not tagged as blind.
        """
        ends = [
            xy
            for road, xy, is_first in _ends(roads)
            if road.rank is Rank.STREET and (is_first or not road.oneway)
        ]
        if not ends:
            return np.empty((0, 2))
        xy = np.array(ends)
        at_edge = shapely.dwithin(shapely.get_exterior_ring(edge), np.asarray(shapely.points(xy)), 0.1)
        if at_edge.any():
            return xy[np.flatnonzero(at_edge)]
        blind = [e.lines[0] for e in self.nodes if _is_blind_end(e)]
        if blind:
            away = self.frame.to_xy(np.concatenate(blind))[None] - xy[:, None]
            xy = xy[np.flatnonzero(np.hypot(away[..., 0], away[..., 1]).min(axis=1) > 0.1)]
        return xy

    def _used(self, roads: Sequence[Road], around: Sequence[Road], slots: Slots) -> list[Road]:
        """The roads that hang together with slots, less service roads that lead to none."""
        parts = _parts_with_slots(roads, slots)
        kept = [road for part in parts for road in part]
        serving = _serving(kept, slots)
        while True:
            shared = _shared_places(kept, around)
            loose = [
                road.rank < Rank.STREET and k not in serving and shared[k] < 2 for k, road in enumerate(kept)
            ]
            if not any(loose):
                return kept
            new_number = np.cumsum(~np.array(loose)) - 1
            serving = {int(new_number[k]) for k in serving}
            kept = [road for road, dead in zip(kept, loose, strict=True) if not dead]

    def _goals(self, slots: Slots) -> tuple[FloatArray, str | None]:
        if self.wishes.goals:
            return points_in(self.frame, self.wishes.goals), None
        none = np.empty((0, 2))
        if not len(slots):
            return none, None
        doors = [e for e in self.nodes if e.tags.get("entrance", "no") not in NO_DOORS]
        if doors:
            xy = self.frame.to_xy(np.concatenate([e.lines[0] for e in doors]))
            near = _distance_to(slots, np.asarray(shapely.points(xy))) <= ENTRANCE_REACH
            away = np.hypot(*(xy - slots.xy.mean(axis=0)).T)
            is_side = np.array([e.tags["entrance"] != "main" for e in doors])
            order = [int(i) for i in np.lexsort((away, is_side)) if near[i]]
            if order:
                return xy[order], "entrance " + ", ".join(doors[i].id for i in order[:5])
        buildings = [a for a in self.buildings if a.element.tags["building"] not in NOT_WALKED_TO]
        if buildings:
            distance = _distance_to(slots, np.array([a.polygon for a in buildings]))
            k = int(np.argmin(distance))
            if distance[k] <= BUILDING_REACH:
                middle = shapely.get_coordinates(shapely.centroid(buildings[k].polygon))
                return middle, f"the middle of the nearest building, {buildings[k].element.id}"
        return none, None

    def _walls(self, slots: Slots, roads: Sequence[Road]) -> list[FloatArray]:
        """Outlines of the buildings near the slots that stand on no slot and no lane."""
        if not len(slots) or not self.buildings:
            return []
        polygons = np.array([a.polygon for a in self.buildings])
        used = shapely.union_all(
            [*boxes_of(slots, shrink=0.1), *(shapely.LineString(road.points).buffer(1.0) for road in roads)]
        )
        near = (_distance_to(slots, polygons) <= ENTRANCE_REACH) & ~shapely.intersects(polygons, used)
        for k in np.flatnonzero(shapely.intersects(polygons, used)):
            self._leave_out("buildings over slots or lanes, which are no walls", self.buildings[k].element.id)
        rings = [
            shapely.get_exterior_ring(part)
            for k in np.flatnonzero(near)
            for part in shapely.get_parts(polygons[k])
        ]
        return [shapely.get_coordinates(ring) for ring in rings if ring is not None]

    def _missing(
        self, slots: Slots, roads: Sequence[Road], entries: FloatArray, goals: FloatArray
    ) -> Iterable[str]:
        if not self.roads:
            yield "no lane: the file holds no road that cars may drive; export highway=service and streets too"
        elif not len(slots):
            yield "no slot: nothing that the file calls parking could be used"
        if len(slots) and roads and not len(entries):
            ends = self.frame.to_lonlat(_dead_ends(roads))[:3, ::-1].tolist()
            where = (
                "; lanes end at " + " and ".join(f"{lat:.6f},{lon:.6f}" for lat, lon in ends) if ends else ""
            )
            yield (
                "no entry: the lanes meet no public street in this file, nor do they leave it; give one by "
                f"--entry LAT,LON{where}"
            )
        if len(slots) and not len(goals):
            yield (
                f"no goal: no building entrance within {ENTRANCE_REACH:g} m of a slot and no building within "
                f"{BUILDING_REACH:g} m; give the place that people walk to by --goal LAT,LON"
            )

    def _found(self, draft: LotDraft, roads: Sequence[Road], goal_note: str | None) -> Iterable[str]:
        for group in (self.mapped, self.filled, self.kerbside):
            owner_of = dict(zip(group.ids, group.owners, strict=True))
            owners = [owner_of[name] for name in draft.slot_ids if name in owner_of]
            if owners:
                yield f"{len(owners)} slots from {group.source} ({len(set(owners))} elements)"
        aisles, service = (sum(road.rank is rank for road in roads) for rank in (Rank.AISLE, Rank.SERVICE))
        yield (
            f"{len(roads)} lanes: {aisles} parking aisles, {service} other service roads, "
            f"{len(roads) - aisles - service} streets; {sum(road.oneway for road in roads)} one-way"
        )
        how = "as given" if self.wishes.entries else "where the lanes are left or meet a public street"
        if len(draft.entries):
            yield f"{len(draft.entries)} entries {how}"
        if len(draft.goals):
            yield f"{len(draft.goals)} goals: {goal_note or 'as given'}"
        yield from self.notes
        yield f"frame: metres east and north of {self.frame.lat:.7f}, {self.frame.lon:.7f}"


def _is_parking(element: OsmElement) -> bool:
    tags = element.tags
    return tags.get("amenity") in ("parking", "parking_space") or (
        "highway" in tags and any(key.startswith(("parking:", "parking:lane:")) for key in tags)
    )


def _refuse_far_away(path: Path, elements: Sequence[OsmElement]) -> None:
    """A map of one place is wanted: no plane holds the distances of a continent."""
    positions = np.concatenate([line for e in elements for line in e.lines])
    order = len(positions) // 2
    lon, lat = (float(np.partition(degrees, order)[order]) for degrees in positions.T)
    frame = LocalFrame(lon, lat)
    for element in elements:
        for line in element.lines:
            away = np.hypot(*frame.to_xy(line).T)
            if away.max() > FARTHEST:
                there_lon, there_lat = line[away.argmax()]
                raise InputError(
                    f"{path}: {element.id} is at {there_lat:.4f}, {there_lon:.4f} and most of the map "
                    f"{away.max() / 1e3:,.0f} km away at {lat:.4f}, {lon:.4f}, want a map no larger than "
                    f"{FARTHEST / 1e3:.0f} km around its middle (are latitude and longitude swapped?)"
                )


def _is_blind_end(element: OsmElement) -> bool:
    tags = element.tags
    return tags.get("noexit") == "yes" or tags.get("highway") in ("turning_circle", "turning_loop")


def _lanes(roads: Sequence[Road]) -> list[Lane]:
    return [Lane(road.points, road.oneway) for road in roads]


def _clipped(road: Road, box: shapely.Geometry) -> list[Road]:
    """The parts of a road within a box, in its own direction."""
    line = shapely.LineString(road.points)
    if shapely.covers(box, line):
        return [road]
    parts = []
    for part in shapely.get_parts(shapely.intersection(line, box)):
        if part.geom_type != "LineString" or part.length < 1.0:
            continue
        points = shapely.get_coordinates(part)
        ends = [line.project(shapely.Point(point)) for point in points[:2]]
        parts.append(replace(road, points=points[::-1] if ends[0] > ends[1] else points))
    return parts


def _squared(polygon: shapely.Geometry) -> shapely.Geometry:
    """A slanted slot of four corners as the rectangle along its longer sides, of the same middle and area."""
    corners = shapely.get_coordinates(polygon)
    if len(corners) != 5:
        return polygon
    sides = np.diff(corners, axis=0)
    length = np.hypot(sides[:, 0], sides[:, 1])
    first = int(length[1] + length[3] > length[0] + length[2])
    along = sides[first] - sides[first + 2]
    size = (length[first] + length[first + 2]) / 2
    along = along / np.hypot(*along) * size / 2
    across = np.array([-along[1], along[0]]) * float(shapely.area(polygon)) / (4 * (along @ along))
    middle = shapely.get_coordinates(shapely.centroid(polygon))[0]
    return shapely.Polygon([middle + a * along + b * across for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))])


def _cut_along_road(polygon: shapely.Geometry, count: int, lanes: Sequence[Lane]) -> list[shapely.Geometry]:
    """A space cut into as many equal ones, side by side along its road (along its longer side without one)."""
    if count == 1:
        return [polygon]
    corners = shapely.get_coordinates(shapely.minimum_rotated_rectangle(polygon))[:4]
    one, other = corners[1] - corners[0], corners[3] - corners[0]
    along = nearest_on_lanes(lanes, corners.mean(axis=0)[None])[1][0]
    share = (
        [abs(side @ along) / np.hypot(*side) for side in (one, other)] if lanes else np.hypot(*[one, other])
    )
    if share[1] > share[0]:
        one, other = other, one
    starts = corners[0] + np.arange(count)[:, None] / count * one
    return [shapely.Polygon([p, p + one / count, p + one / count + other, p + other]) for p in starts]


def _distance_to(slots: Slots, things: NDArray[np.object_]) -> FloatArray:
    """From each thing to the nearest slot's centre, m."""
    tree = shapely.STRtree(np.asarray(shapely.points(slots.xy)))
    (index, _), distance = tree.query_nearest(things, all_matches=False, return_distance=True)
    result = np.full(len(things), np.inf)
    result[index] = distance
    return result


# ---- how roads hang together ----


def _road_places(roads: Sequence[Road]) -> list[NDArray[np.int64]]:
    """The numbered places along each road; roads meet where they share one."""
    place = places(np.concatenate([road.points for road in roads]))
    return np.split(place, np.cumsum([len(road.points) for road in roads])[:-1])


def _serving(roads: Sequence[Road], slots: Slots) -> set[int]:
    """The roads that are nearest to some slot's mouth."""
    if not roads or not len(slots):
        return set()
    mouth = mouth_points(slots.xy, slots.yaw, slots.length, slots.width, slots.mouth)
    lines = np.array([shapely.LineString(road.points) for road in roads])
    nearest = shapely.STRtree(lines).nearest(shapely.points(mouth))
    return set(np.asarray(nearest).tolist())


def _parts_with_slots(roads: Sequence[Road], slots: Slots) -> list[list[Road]]:
    """The roads, sorted into those that hang together; only parts to which slots open."""
    if not roads:
        return []
    along = _road_places(roads)
    road = np.repeat(np.arange(len(roads)), [len(p) for p in along])
    place = np.concatenate(along)
    n = len(roads) + int(place.max()) + 1
    links = coo_array((np.ones(len(road), dtype=bool), (road, len(roads) + place)), shape=(n, n))
    part = connected_components(links, directed=False)[1][: len(roads)]
    serving = {int(part[k]) for k in _serving(roads, slots)}
    return [[r for r, p in zip(roads, part, strict=True) if p == k] for k in sorted(serving)]


def _shared_places(roads: Sequence[Road], around: Sequence[Road]) -> list[int]:
    """At how many places each road meets others, of its own kind or around."""
    along = [set(p.tolist()) for p in _road_places([*roads, *around])]
    users: dict[int, int] = {}
    for places_on in along:
        for place in places_on:
            users[place] = users.get(place, 0) + 1
    return [sum(users[place] > 1 for place in places_on) for places_on in along[: len(roads)]]


def _gates(roads: Sequence[Road], streets: Sequence[Road]) -> FloatArray:
    """Where cars turn in from a street, (n, 2) m."""
    if not streets:
        return np.empty((0, 2))
    along = _road_places([*roads, *streets])
    public = set(np.concatenate(along[len(roads) :]).tolist())
    gates: dict[int, FloatArray] = {}
    for road, on_road in zip(roads, along, strict=False):
        # Nobody comes in by the end of a one-way road.
        last = len(on_road) - 1 if road.oneway else len(on_road)
        for i in range(last):
            if int(on_road[i]) in public:
                gates.setdefault(int(on_road[i]), road.points[i])
    return np.array(list(gates.values())).reshape(-1, 2)


def _dead_ends(roads: Sequence[Road]) -> FloatArray:
    """All ends of lanes where no other begins, (n, 2) m."""
    return np.array([xy for _, xy, _ in _ends(roads)]).reshape(-1, 2)


def _ends(roads: Sequence[Road]) -> list[tuple[Road, FloatArray, bool]]:
    along = _road_places(roads)
    users = np.bincount(np.concatenate(along))
    return [
        (road, road.points[i], i == 0)
        for road, on_road in zip(roads, along, strict=True)
        for i in (0, -1)
        if users[on_road[i]] == 1
    ]
