"""The rules of a register's bays, in words or in columns, as tags of OpenStreetMap, which the importer reads.

A rule has a class of users, hours, a longest stay and a price. Hours are written as in `TANS 7A-9A, 4P-6P Mon-Fri | PKG
9A-4P Mon-Fri, 8A-8P Sat` or `1P MTR M-SAT 7.30 TO 18.30`: each time is of the days after it, or of those before it in
a text that begins with days; without days it is of those of the rule before, else of all. Where nobody may stop (tow-away,
clearway, taxis) is closed at these hours; at all others the bay is free and open to everybody.
"""

import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from parkenv.compiled.arrays import BoolArray
from parkenv.lots.bays.register import Rule
from parkenv.lots.osm.conditions import always, duration, hours_text
from parkenv.lots.unread import Unread

USERS = {
    "no": r"TANS|TOW|CLEARWAY|NO (?:STOPPING|PARKING|STANDING)|NP|NS|S/|TAXI|BUS|MOTOR ?(?:CYCLES?|BIKES?)|BICYCLES?",
    "disabled": r"DIS|DISABLED|HANDICAP\w*|ACCESSIBLE|BLUE",
    "delivery": r"LOADING|LZ|PLO|COMMERCIAL|TRUCKS?",
    "charging": r"EV|ELECTRIC|CHARGING",
    "permit": r"PERMIT|PP|RESIDENTS?|PERMIT ZONE",
}
"""Words of the classes of users other than the public, by OpenStreetMap's access; the first that fits counts."""
_OPEN = r"GENERAL|PUBLIC|METER\w*|MTR|PKG|PARKING|STANDARD|REGULAR|SHORT|TIMED|TICKET|TKT|\d*/?\d*P|P"
_PAID = r"MP(?=\d)|MTR|P?METER(?:ED)?|TKT|TICKET|PAY|PAID"
_LIMIT = re.compile(r"(?<![\d.:])(?:(\d+)/(\d+)|(\d+(?:\.\d+)?))\s?P\b", re.I)
_STAY = re.compile(r"(?<![\w.:-])\d+(?:\.\d+)?\s?(?:MINS?|MINUTES?|M|HRS?|HOURS?|H)\b", re.I)
_SPELLED = "mon tue wed thu fri sat sun"
_DAY = r"(?:mon|tue|wed|thu|fri|sat|sun)[a-z]*|tu|th|su|sa|[mfs]"
_TIME = r"(?P<h{0}>\d{{1,2}})(?:[:.](?P<m{0}>\d\d))?(?::\d\d)?\s*(?P<half{0}>[ap]?)\.?(?:m\b)?\.?"
_TOKEN = re.compile(
    rf"\b(?P<days>(?P<first>{_DAY})\s*(?:-|–|to|thru)\s*(?P<last>{_DAY})|daily|nightly|everyday|weekdays|weekends"
    rf"|(?:mon|tue|wed|thu|fri|sat|sun)[a-z]*)\b|(?P<time>(?<![\w.:]){_TIME.format(0)}\s*(?:-|–|to)\s*{_TIME.format(1)}(?![\w:]))"
    r"|24/7|24 hours|at all times|(?P<word>[a-z/]{2,}|[|;])",
    re.I,
)
_NAMED = {"weekdays": range(5), "weekends": range(5, 7)}


class Clause(NamedTuple):
    label: str  # words before its hours
    minutes: BoolArray  # (10080,)
    is_timed: bool  # whether the text says hours or days


def clauses_of(text: str) -> list[Clause]:
    """Return the clauses of a text with hours, each with its words; see the module."""
    clauses, label, tokens, before = list[Clause](), "", list[tuple[bool, list[int]]](), list(range(7))
    end = 0

    def close() -> None:
        nonlocal before
        if label.strip(" |;,") or tokens:
            minutes, before = _week(tokens, before)
            clauses.append(Clause(label.strip(" |;,"), minutes, bool(tokens)))

    for match in _TOKEN.finditer(text):
        is_hours = match["word"] is None
        if not is_hours and (tokens or match["word"] in "|;"):
            close()
            label, tokens, end = "", [], match.start()
        if is_hours:
            label += text[end : match.start()] if not tokens else ""
            end = match.end()
            if match["days"]:
                tokens.append((True, _days(match)))
            elif match["time"]:
                tokens.append((False, _span(match)))
            else:
                tokens += [(True, list(range(7)))]
    if not tokens:
        label += text[end:]
    close()
    return clauses


def _days(match: re.Match[str]) -> list[int]:
    if match["first"] is None:
        name = match["days"].lower()
        return list(_NAMED.get(name, range(7))) if name[:3] not in _SPELLED.split() else [_day(name, 5)]
    first, last = _day(match["first"], 5), _day(match["last"], 6 if match["first"].lower() == "s" else 5)
    return [(first + k) % 7 for k in range((last - first) % 7 + 1)]


def _day(name: str, of_s: int) -> int:
    """Return the day of a name; a single S is Saturday, or Sunday at the end of `S-S`."""
    return of_s if name.lower() == "s" else next(k for k, day in enumerate(_SPELLED.split()) if day.startswith(name.lower()[:3]))


def _span(match: re.Match[str]) -> list[int]:
    """Return begin and end of a time, minutes of a day; one across midnight ends after 1440."""
    h0, m0, half0, h1, m1, half1 = (match[key] for key in ("h0", "m0", "half0", "h1", "m1", "half1"))
    begin, end = 60 * int(h0) + int(m0 or 0), 60 * int(h1) + int(m1 or 0)
    if half0 or half1:
        noon, is_pm = 12 * 60, half1.lower() == "p"
        if half1:
            end = end % noon + noon * is_pm
        if not half0:  # the same half of the day, if the time then rises
            half0 = "p" if is_pm == (begin % noon < end % noon) else "a"
        begin = begin % noon + noon * (half0.lower() == "p")
    elif end <= begin and max(begin, end) < 12 * 60:
        end += 12 * 60
    end += end % 60 == 59  # 23:59 is the end of the day
    return [min(begin, 1440), end if end > begin else end + 1440]


def _week(tokens: Sequence[tuple[bool, list[int]]], before: list[int]) -> tuple[BoolArray, list[int]]:
    """Return the minutes of times and days in order, (10080,), and the days of the last time."""
    week, days, spans = ~always(), list[int](), list[list[int]]()
    if not tokens:
        return always(), list(range(7))
    days_first, after_time = tokens[0][0], False
    for is_days, values in tokens:
        if is_days:
            days = (days if days_first and not after_time else []) + values
            if not days_first:
                _open(week, days, spans)
                spans = []
        else:
            spans.append(values)
            if days_first:
                _open(week, days, [values])
        after_time = not is_days
    if spans and not days_first:
        days = days or before
        _open(week, days, spans)
    elif days_first and all(is_days for is_days, _ in tokens):
        _open(week, days, [[0, 1440]])
    return week, days


def _open(week: BoolArray, days: Sequence[int], spans: Sequence[Sequence[int]]) -> None:
    for begin, end in spans:
        for day in days:
            week[(1440 * day + np.arange(begin, end)) % len(week)] = True


def _minutes_of_columns(rule: Mapping[str, str]) -> BoolArray | None:
    """Return the minutes of a rule whose days (0 or 7: Sunday) and times have columns; None without them."""
    if "start" not in rule and "from_day" not in rule:
        return None
    days = list(range(7))
    if re.fullmatch("[0-7]", rule.get("from_day", "")) and re.fullmatch("[0-7]", rule.get("to_day", "")):
        first, last = (int(rule[key]) - 1 for key in ("from_day", "to_day"))
        days = [(first + k) % 7 for k in range((last - first) % 7 + 1)]
    elif spelled := clauses_of(rule.get("days", "")):
        days = np.flatnonzero(spelled[0].minutes.reshape(7, 1440).any(axis=1)).tolist()
    time = _TOKEN.fullmatch(f"{rule.get('start', '0:00')}-{rule.get('end', '24:00')}")
    week = ~always()
    _open(week, days, [_span(time)] if time is not None and time["time"] else [[0, 1440]])
    return week


def _has(words: str, text: str) -> bool:
    return re.search(rf"(?<![A-Z])(?:{words})(?![A-Z])", text.upper()) is not None


def _stay(text: str) -> float | None:
    """Return a longest stay, s: `2P`, `1/4P`, `15MIN`, `2HR`, minutes; None if there is none in it."""
    if match := _LIMIT.search(text):
        return 3600.0 * (float(match[1]) / max(float(match[2]), 1.0) if match[1] else float(match[3]))
    if match := _STAY.search(text):
        return duration(match[0])
    return duration(text)


def _price(text: str) -> tuple[str, str]:
    """Return OpenStreetMap's charge of a price in words, and what is assumed if they say more than one."""
    text = re.sub(r"\s+", " ", text.replace("\\", "/"))
    amounts = [float(amount) for amount in re.findall(r"\d+(?:\.\d+)?", text)]
    if "/" in text or " per " in text or not amounts:
        return re.split(r" - |;", text)[0], "the first price" if len(amounts) > 1 and re.search(" - |;", text) else ""
    middle = (min(amounts) + max(amounts)) / 2.0
    return f"{middle:g}/h", "the middle, as the hours of each price are not given" if len(set(amounts)) > 1 else ""


@lru_cache(maxsize=65536)
def tags_of(rules: tuple[Rule, ...]) -> tuple[dict[str, str], tuple[Unread, ...]]:
    """Return OpenStreetMap's tags of the rules of a bay, and what of their words is not read."""
    unread = list[Unread]()
    open_to: dict[str, BoolArray] = defaultdict(lambda: ~always())
    fees: dict[str, BoolArray] = defaultdict(lambda: ~always())
    stays: dict[float, BoolArray] = defaultdict(lambda: ~always())
    closed = list[BoolArray]()
    for rule in map(dict, rules):
        kind = rule.get("class", "")
        minutes = _minutes_of_columns(rule)
        text = " ".join(rule[key] for key in ("days", "hours") if key in rule)
        parts = clauses_of(text or ("" if minutes is not None else kind)) if minutes is None else [Clause("", minutes, True)]
        if text and minutes is None and not any(part.is_timed for part in parts) and re.search(r"\d", text):
            unread.append(Unread("hours", text, 1, "at all hours"))
        for label, when, _ in parts or [Clause("", always(), False)]:
            words = f"{label} {kind}"
            users = next((users for users, own in USERS.items() if _has(own, words)), "yes")
            if users == "yes" and kind and not (_has(_OPEN, words) or _stay(kind) or _has(_PAID, words)):
                unread.append(Unread("class", kind, 1, "open to everybody"))
            if users != "no":
                stay = _stay(rule["limit"]) if "limit" in rule else _stay(words)
                if "limit" in rule and stay is None:
                    unread.append(Unread("limit", rule["limit"], 1, "no limit of stays"))
                if stay and stay < 86_400.0:
                    stays[stay] |= when
                if "rate" in rule or _has(_PAID, words):
                    charge, doubt = _price(rule["rate"]) if "rate" in rule else ("", "")
                    fees[charge] |= when
                    unread += [Unread("rate", rule["rate"], 1, doubt)] if doubt else []
                open_to[users] |= when
            else:
                closed.append(when)
        if rule.get("disabled_limit", "0") not in ("0", ""):
            unread.append(Unread("disabled_limit", rule["disabled_limit"], 1, "the limit of other drivers"))
    paid = np.any([~always(), *fees.values()], axis=0)
    for when in closed:
        if paid.any() and not (paid & ~when).any():
            # What forbids all that is sold is no rule of these hours.
            unread.append(Unread("hours", rules_text(rules), 1, "parking where it is charged"))
        else:
            open_to["no"] |= when
    reserved = np.any([~always(), *(when for users, when in open_to.items() if users != "yes")], axis=0)
    if not reserved.all():
        # Prices and limits of those for whom the bay is reserved are not those of all others.
        for when in (*fees.values(), *stays.values()):
            when &= ~reserved
        paid &= ~reserved
    tags = dict(
        pair for pair in (
            _tag("access", {users: when for users, when in open_to.items() if users != "yes"}),
            _tag("fee", {"yes": paid}),
            _tag("charge", {charge: when for charge, when in fees.items() if charge}),
            _tag("maxstay", {f"{stay / 60:g} min": when for stay, when in stays.items()}),
        ) if pair is not None
    )  # fmt: skip
    return tags, tuple(unread)


def rules_text(rules: Sequence[Rule]) -> str:
    return "; ".join(dict.fromkeys(text for rule in rules for _, text in rule))


def _tag(key: str, values: Mapping[str, BoolArray]) -> tuple[str, str] | None:
    """Return a key and its value at some hours, (10080,) each, or at all; None if it has none."""
    used = {value: when for value, when in values.items() if when.any()}
    if not used:
        return None
    if len(used) == 1 and next(iter(used.values())).all():
        return key, next(iter(used))
    texts = (f"{value} @ ({hours_text(when) or '24/7'})" for value, when in used.items())
    return f"{key}:conditional", "; ".join(texts)
