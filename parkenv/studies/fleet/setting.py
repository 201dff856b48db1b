"""Settings of a study of many cars, and the columns of their days and tables."""

from dataclasses import dataclass
from typing import Annotated

from pydantic import BeforeValidator, WithJsonSchema

from parkenv.show.tables import Column, shared
from parkenv.studies.fields import AgentSpec
from parkenv.studies.results import Row
from parkenv.world.cost_terms import COST_FIELDS

OWN = "own"
NOWHERE = "no slot"  # stands for the block, and the zone, of cars that find no slot
# Arrivals with which the lot becomes as full as counted, or as its world says; `1.2x` are so many times these.
COUNTED = "counted"
GIVEN = "given"  # arrivals of the scenario's own demand; there, `1.2x` are so many times these
MAX_PER_HOUR = 1e6
SETTING_COLUMNS = ("scenario", "agents", "knows", "share", "arrivals_per_hour")
# Measures of a day, of which a summary has the mean over days.
MEASURES = (
    "total_s", "median_s", "p95_s", "gini", "search_s", "queued_s", "failed_attempts", "driven_m", "cruised_m",
    "cruising_share", "balked_fraction", "occupancy", "counted_occupancy", "members_s", "others_s",
    "bound_s", "clairvoyant_s", *COST_FIELDS, "paid", "paying_share",
)  # fmt: skip
# Lists over the cars of a day, in the order of their arrivals: total time in centiseconds; 1 for members; and in lots
# with zones or prices, number of the zone that a car parks in, from 1, or 0, and what it pays for its stay; of several
# purposes, number of the car's, from 0.
CAR_LISTS = ("total_cs", "member", "zone", "paid_cents", "purpose")
# Columns with the mean share of taken slots in each hour of the day's arrivals, simulated and as counted.
BY_HOUR = ("occupancy_by_hour", "counted_by_hour")
_WANTED = (
    f"a number above 0 and at most {MAX_PER_HOUR:g}, {GIVEN}, {COUNTED}, or so many times that, such as 1.2x"
)


def rate_of(value: float | str) -> float | str:
    text = str(value).strip()
    try:
        rate = 1.0 if text in (GIVEN, COUNTED) else float(text.removesuffix("x"))
    except ValueError:
        rate = -1.0
    if not 0.0 < rate <= MAX_PER_HOUR:
        raise ValueError(_WANTED)
    if text in (GIVEN, COUNTED):
        return text
    return f"{rate:g}x" if text.endswith("x") else rate


def times_demanded(rate: str) -> float:
    return 1.0 if rate in (GIVEN, COUNTED) else float(rate.removesuffix("x"))


_NUMBER_OR_TIMES = {
    "type": ["number", "string"], "exclusiveMinimum": 0, "maximum": MAX_PER_HOUR,
    "pattern": rf"^({GIVEN}|{COUNTED}|[0-9.]+x)$",
}  # fmt: skip
# Cars an hour, or multiples of the demand that is given or counted.
Demanded = Annotated[float | str, BeforeValidator(rate_of), WithJsonSchema(_NUMBER_OR_TIMES)]


@dataclass(frozen=True)
class Setting:
    scenario: str
    agent: AgentSpec  # of every car
    knows: str  # what members know, one of `KNOWLEDGE`; the others know their own observations
    share: float  # of the cars, members
    arrivals_per_hour: float | str  # see `rate_of`

    @property
    def columns(self) -> Row:
        values = self.scenario, self.agent.label, self.knows, self.share, self.arrivals_per_hour
        return dict(zip(SETTING_COLUMNS, values, strict=True))

    def holds(self, row: Row) -> bool:
        return all(row[name] == value for name, value in self.columns.items())

    def __str__(self) -> str:
        _, agent, knows, share, rate = self.columns.values()
        return f"{agent}, {knows}, share {share:g}, {rate_text(rate)}"


def rate_text(rate: float | str) -> str:
    if not isinstance(rate, str):
        return f"{rate:g} cars an hour"
    return f"demand as {rate}" if rate in (GIVEN, COUNTED) else f"{times_demanded(rate):g} times the demand"


_MINUS_OWN = "total time, minus that of all cars with own observations only, on the same days"
_PAIRED = "After minus before, of the same cars on the same days"
COLUMNS = (
    *shared("scenario"),
    Column("after", "after"),
    Column("before", "instead of"),
    Column("prices", "prices"),
    Column("purpose", "purpose"),
    Column("block", "block", help="A facility, or the slots of a zone that belong to none"),
    Column("type", "type"),
    Column("zone", "zone", help="Of changes: where the cars parked before; – for all cars"),
    Column("agents", "agents", setting=True),
    Column("arrivals_per_hour", "cars an hour", digits=0, given=True),
    Column("knows", "members know", needs="share"),
    Column("share", "members", share=True, digits=0, needs="share"),
    Column("hour", "hour", digits=0, help="Of the day: 8 is from 8:00 to 9:00"),
    Column("change_s", "change, all cars", "s", signed=True, help=_PAIRED),
    Column("members_change_s", "change, members", "s", signed=True, help=f"{_PAIRED}: members after the change",
           needs="share"),
    Column("others_change_s", "change, the others", "s", signed=True, help=_PAIRED, needs="share"),
    Column("paid_change", "change, paid a car", digits=2, signed=True, help=f"{_PAIRED}; in the prices' currency"),
    Column("better_off", "better off", share=True, digits=0, help="Cars that gain at least a second"),
    Column("worse_off", "worse off", share=True, digits=0, help="Cars that lose at least a second"),
    *shared("total_s"),
    Column("median_s", "median time", "s", help="Median of the total times of a day's cars"),
    Column("difference_s", "change by guidance, all cars", "s", signed=True, help=f"Mean {_MINUS_OWN}", needs="share"),
    Column("price_of_anarchy", "price of anarchy", digits=3, help="Total time over that with reservations for all"),
    Column("price_over_bound", "price over the bound", digits=3, help="Total time over the clairvoyant bound"),
    Column("search_s", "search time", "s", help="From the entry to the end of the search"),
    *shared(*COST_FIELDS),
    Column("change", "change", setting=True),
    Column("days", "days", digits=0, setting=True),
    Column("cars", "cars", digits=0),
    Column("cars_a_day", "cars a day", digits=0),
    Column("search_change_s", "change, search time", "s", signed=True, help=_PAIRED),
    Column("parking_cost_change_s", "change, parking cost", "s", signed=True, help=f"{_PAIRED}; prices as time",
           needs="parking_cost_change_s"),
    Column("gave_up_change_s", "change, give-up penalty", "s", signed=True, help=_PAIRED, needs="gave_up_change_s"),
    Column("balked_change", "change, found no slot", share=True, signed=True, help=_PAIRED),
    Column("slots", "slots", digits=0, setting=True),
    Column("price", "price an hour", digits=2, help="In the currency of the prices, as all that is paid"),
    Column("parked_a_day", "cars a day", digits=0, help="Cars that park in the zone"),
    Column("share_parked", "of all cars", share=True, digits=0, help="Of the cars that park"),
    Column("refused_a_day", "refused a day", digits=0, help="Failed attempts: taken, or full"),
    Column("p95_s", "95 % of cars below", "s", 0, help="95 % quantile of the total times of a day's cars"),
    Column("gini", "inequality (Gini)", digits=3, help="Inequality of total times: 0 if all are equal"),
    Column("queued_s", "time in queues", "s", help="Behind cars that park, leave or stand; in the search time"),
    Column("failed_attempts", "failed attempts a car", digits=3),
    *shared("driven_m"),
    Column("cruised_m", "detour driven", "m", 0, help="Drive beyond the shortest drive to the slot"),
    Column("cruising_share", "traffic that cruises", share=True, digits=0, help="Detours in all metres driven"),
    Column("balked_fraction", "found no slot", share=True),
    Column("occupancy", "slots taken", share=True, digits=0, help="Mean share of slots taken while cars arrive"),
    Column("counted_occupancy", "as counted", share=True, digits=0, help="By the world's counts, log or process"),
    Column("excess", "minus counted", share=True, signed=True, help="Simulated minus counted occupancy"),
    Column("members_s", "time of members", "s", help="Total time of members", needs="share"),
    Column("others_s", "time of the others", "s", help="Total time of non-members", needs="share"),
    Column("bound_s", "time if alone", "s", help="Mean total time of a car alone in an empty lot that it knows"),
    Column("clairvoyant_s", "clairvoyant bound", "s", help="Lower bound that knows all arrivals and stays"),
    Column("paid", "paid a car", digits=2, help="In the currency of the prices; mean over all cars", needs="paid"),
    Column("paying_share", "cars that pay", share=True, digits=0, needs="paid"),
    Column("members_difference_s", "change by guidance, members", "s", signed=True, help=f"Members' {_MINUS_OWN}",
           needs="share"),
    Column("others_difference_s", "change by guidance, others", "s", signed=True, help=f"The others' {_MINUS_OWN}",
           needs="share"),
    Column("paid_a_day", "paid a day", digits=2, help="Revenue: the stays of a day's cars, each paid in full"),
    Column("paid_a_car", "paid a car", digits=2, help="Of those that park in the zone"),
)  # fmt: skip
_SETTING = ("scenario", "agents", "knows", "share", "arrivals_per_hour", "days")
_OF_PLACES = (
    *_SETTING, "purpose", "zone", "block", "slots", "price", "occupancy", "parked_a_day", "share_parked", "search_s",
    "walk_s", "paid_a_day", "paid_a_car", "refused_a_day", "balked_fraction",
)  # fmt: skip
# Columns that the terminal shows of each table.
SHOWN = {
    "rows": (
        *_SETTING, "total_s", "members_s", "others_s", "search_s", *COST_FIELDS, "queued_s", "p95_s",
        "failed_attempts", "balked_fraction", "cruising_share", "occupancy", "counted_occupancy", "price_of_anarchy",
        "price_over_bound", "paid", "paying_share",
    ),
    "purposes": _OF_PLACES,
    "zones": _OF_PLACES,
    "blocks": _OF_PLACES,
    "changes": (
        *_SETTING, "after", "before", "zone", "purpose", "change_s", "members_change_s", "others_change_s",
        "paid_change", "better_off", "worse_off",
    ),
}  # fmt: skip
