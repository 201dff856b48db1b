"""Columns of the tables of studies of many cars, in their order."""

from __future__ import annotations

from parkenv.show.columns import Column, shared
from parkenv.world.cost_terms import COST_FIELDS

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
"""Columns that the terminal shows of each table."""
