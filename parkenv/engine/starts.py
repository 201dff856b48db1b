"""Where and when an episode begins, if the caller of `reset` says so."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from parkenv.compiled.keyed_random import episode_key
from parkenv.engine.records import Searches
from parkenv.errors import InputError, require_number, require_one_of, require_whole
from parkenv.world.occupancy.arrival_window import DAY_NAMES, ArrivalWindow
from parkenv.world.week import DAY_S, WEEK_S

START_OPTIONS = ("place", "entry", "arrival")
"""Names of the options of `reset` that say how an episode begins."""


def choose_start(searches: Searches, index: int, episode: int, options: Mapping[str, Any]) -> None:
    """Let the next episode of a search, with this number, begin as `options` of `reset` say; the rest is drawn.

    Args:
        searches: the searches.
        index: number of the search; its record holds the seed.
        episode: number of the episode.
        options: some of `START_OPTIONS`: `place`, name or index of the scenario; `entry`, index among the scenario's;
            `arrival`, s since Monday 00:00 or a text such as "Tue 08:30", on a weekday of the scenario's; one of
            several such days is drawn.
    """
    scenarios, record = searches.scenarios.scenarios, searches.records[index]
    place, names = options.get("place", 0 if len(scenarios) == 1 else None), [one.name for one in scenarios]
    if place is None or isinstance(place, str):
        require_one_of("option place", place, names)
        place = names.index(place)
    require_whole("option place", place, most=len(scenarios) - 1)
    record["chosen_place"] = place + 1
    if "entry" in options:
        last = int(searches.scenarios.records["n_entries"][place]) - 1
        require_whole("option entry", options["entry"], most=last)
        record["chosen_entry"] = options["entry"] + 1
    if "arrival" in options:
        arrival = options["arrival"]
        if isinstance(arrival, str):
            day, _, hour = arrival.strip().partition(" ")
            try:
                require_one_of("day", day.lower(), DAY_NAMES)
                arrival = DAY_S * DAY_NAMES.index(day.lower()) + ArrivalWindow.parse(f"{hour}-{hour}").start_s
            except InputError:
                wanted = "seconds since Monday 00:00 or a text such as 'Tue 08:30'"
                raise InputError(f"option arrival is {arrival!r:.60}, want {wanted}") from None
        require_number("option arrival", arrival, least=0.0, below=WEEK_S)
        weekday, record["chosen_second"] = divmod(float(arrival), DAY_S)
        days = [day.weekday for day in scenarios[place].occupancy.arrival_days(scenarios[place].arrival)]
        require_one_of(
            "day of option arrival", DAY_NAMES[int(weekday)], [DAY_NAMES[i] for i in sorted(set(days))]
        )
        same = [i for i, other in enumerate(days) if other == weekday]
        record["chosen_day"] = 1 + same[int(episode_key(record["seed_state"], episode)) % len(same)]
