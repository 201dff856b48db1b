"""The rules of a register's bays, in words or in columns, as tags of OpenStreetMap.

Hours are read as in `TANS 7A-9A, 4P-6P Mon-Fri | PKG 9A-4P Mon-Fri, 8A-8P Sat` or `1P MTR M-SAT 7.30 TO 18.30`: times
are of the days after them, in a clause that begins with days of those before; without days, of those of the clause
before, or of all. Where nobody may stop (tow-away, clearway, taxis), the bay is closed at these hours; at hours that no
rule names it is free and open to everybody.
"""

import re
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache

import numpy as np

from parkenv.compiled.arrays import BoolArray
from parkenv.lots.bays.register import Rule
from parkenv.lots.osm.conditions import always, duration, hours_text
from parkenv.world.week import DAY_S, HOUR_S

# Words of the values of `access`; the first that fits counts.
USERS = {
    "no": r"TANS|TOW|CLEARWAY|NO (?:STOPPING|PARKING|STANDING)|NP|NS|S/|TAXI|BUS|MOTOR ?(?:CYCLES?|BIKES?)|BICYCLES?",
    "disabled": r"DIS|DISABLED|HANDICAP\w*|ACCESSIBLE",
    "delivery": r"LOADING|LZ|PLO|COMMERCIAL|TRUCKS?",
    "charging": r"EV|ELECTRIC|CHARGING",
    "permit": r"PERMIT|PP|RESIDENTS?",
    "yes": r"GENERAL|PUBLIC|P?METER\w*|MP?T?R?|PKG|PARKING|STANDARD|REGULAR|TIMED|TICKET|TKT|PAY|PAID|\d*/?\d+P|P",
}
_PAID = r"MP(?=\d)|MTR|P?METER(?:ED)?|TKT|TICKET|PAY|PAID"
_STAY = re.compile(r"(?<![\d.:/])(?:(?P<half>1/\d) ?P|(?P<hours>\d+(?:\.\d)?) ?P|\d+ ?(?:M|H)[A-Z]*)\b", re.I)
_DAYS = ("mon", "tue", "wed", "thu", "fri", "sat", "sun")
_DAY = rf"(?:{'|'.join(_DAYS)})[a-z]*|tu|th|su|sa|[mfs]"
_TIME = r"(?P<h{0}>\d{{1,2}})(?:[:.](?P<m{0}>\d\d))?(?::\d\d)?\s*(?P<half{0}>[ap]?)\.?(?:m\b)?\.?"
_TOKEN = re.compile(
    rf"\b(?P<first>{_DAY})\s*(?:-|–|to|thru)\s*(?P<last>{_DAY})\b|\b(?P<day>(?:{'|'.join(_DAYS)})[a-z]*)\b"
    r"|(?P<all>\b(?:daily|nightly|everyday|all days|weekdays|weekends)\b)"
    rf"|(?P<time>(?<![\w.:]){_TIME.format(0)}\s*(?:-|–|to)\s*{_TIME.format(1)}(?![\w:]))"
    r"|(?P<break>[|;])|(?P<word>[a-z/]{2,})",
    re.I,
)


def clauses_of(text: str) -> Iterator[tuple[str, BoolArray, bool]]:
    """Yield the clauses of a text: the words before its hours, their minutes, (10080,), and whether it has any."""
    clauses: list[tuple[list[str], list[list[int] | tuple[int, int]]]] = [([], [])]
    end = 0
    for match in _TOKEN.finditer(text):
        is_hours = match["word"] is None and match["break"] is None
        if match["break"] or (match["word"] and clauses[-1][1]):
            clauses.append(([], []))
        words, hours = clauses[-1]
        if not hours and not match["break"]:
            words.append(text[end : match.start() if is_hours else match.end()])
        if is_hours:
            hours.append(_span(match) if match["time"] else _days(match))
        end = match.end()
    if not clauses[-1][1]:
        clauses[-1][0].append(text[end:])
    before = list(range(7))
    for words, hours in clauses:
        minutes, days, spans = ~always() if hours else always(), list[int](), list[tuple[int, int]]()
        for part in (*hours, None):
            # A list of days and a list of times, in any order, belong together.
            if part is None or (type(part) is type(hours[0]) and days and spans):
                before = days or before
                _open(minutes, before, spans or [(0, 1440)] * bool(hours))
                days, spans = [], []
            if isinstance(part, list):
                days = days + part
            elif part is not None:
                spans.append(part)
        if "".join(words).strip() or hours:
            yield "".join(words), minutes, bool(hours)


def _days(match: re.Match[str]) -> list[int]:
    if match["all"]:
        return list({"weekdays": range(5), "weekends": range(5, 7)}.get(match["all"].lower(), range(7)))
    ends = [(match["first"] or match["day"])[:3].lower(), (match["last"] or match["day"])[:3].lower()]
    # A single S is Saturday; the second one of `S-S` is Sunday.
    ends = ["sat" if name == "s" and not (k and ends[0] == "s") else name for k, name in enumerate(ends)]
    first, last = (next(k for k, day in enumerate(_DAYS[::-1]) if day.startswith(name)) for name in ends)
    return [(6 - first + k) % 7 for k in range((first - last) % 7 + 1)]


def _span(match: re.Match[str]) -> tuple[int, int]:
    """Return begin and end of a time, minutes of a day; one across midnight ends after 1440."""
    begin, end = (60 * int(match[f"h{k}"]) + int(match[f"m{k}"] or 0) for k in (0, 1))
    halves, noon = [match[f"half{k}"].lower() for k in (0, 1)], 12 * 60
    if halves[1] and not halves[0]:
        # Both are in one half of the day if times then rise.
        halves[0] = halves[1] if begin % noon < end % noon else {"a": "p", "p": "a"}[halves[1]]
    if halves[0]:
        begin = begin % noon + noon * (halves[0] == "p")
    if halves[1]:
        end = end % noon + noon * (halves[1] == "p")
    elif end <= begin < noon and not halves[0]:
        end += noon
    end += end % 60 == 59  # 23:59 is the end of the day
    return begin, end if end > begin else end + 1440


def _open(week: BoolArray, days: Sequence[int], spans: Sequence[tuple[int, int]]) -> None:
    for day in days:
        for begin, end in spans:
            week[(1440 * day + np.arange(begin, end)) % len(week)] = True


def _clauses(rule: Mapping[str, str]) -> list[tuple[str, BoolArray, bool]]:
    """Return the clauses of a rule: of its words, or of columns of days (0 or 7: Sunday) and times."""
    if "start" not in rule and "from_day" not in rule:
        return list(clauses_of(rule.get("hours") or rule.get("days") or rule.get("class", "")))
    days, minutes = list(range(7)), ~always()
    if all(re.fullmatch("[0-7]", rule.get(part, "")) for part in ("from_day", "to_day")):
        first, last = (int(rule[part]) - 1 for part in ("from_day", "to_day"))
        days = [(first + k) % 7 for k in range((last - first) % 7 + 1)]
    elif match := _TOKEN.match(rule.get("days", "")):
        days = days if match["word"] else _days(match)
    time = _TOKEN.fullmatch(f"{rule.get('start', '0:00')}-{rule.get('end', '24:00')}")
    _open(minutes, days, [_span(time)] if time and time["time"] else [(0, 1440)])
    return [("", minutes, True)]


def _has(words: str, text: str) -> bool:
    return re.search(rf"(?<![A-Z])(?:{words})(?![A-Z])", text.upper()) is not None


def _stay(text: str) -> float | None:
    """Return a longest stay, s: `2P`, `1/4P`, `15MIN`, `2HR`, a number of minutes; None if there is none in it."""
    match = _STAY.search(text)
    if match is None:
        return duration(text)
    if match["half"]:
        return HOUR_S / int(match["half"][2:] or 1)
    return HOUR_S * float(match["hours"]) if match["hours"] else duration(match[0])


def _charge(text: str) -> tuple[str, str]:
    """Return a price in OpenStreetMap's notation, and what is assumed of one that has several."""
    text = text.replace("\\", "/")
    amounts = [float(amount) for amount in re.findall(r"\d+(?:\.\d+)?", text)]
    if "/" in text or " per " in text or not amounts:
        first, *more = re.split(r"\s-\s|;", text)
        return first, "the first price" if more else ""
    middle = f"{(min(amounts) + max(amounts)) / 2:g}/h"
    return middle, "the middle, as the hours of each price are not given" if len(set(amounts)) > 1 else ""


@lru_cache(maxsize=65536)
def tags_of(rules: tuple[Rule, ...]) -> tuple[dict[str, str], tuple[tuple[str, str, str], ...]]:
    """Return OpenStreetMap's tags of the rules of a bay; and what is not read: part, text and what is assumed."""
    unread = list[tuple[str, str, str]]()
    closed = list[BoolArray]()
    access, fees, stays = (defaultdict[str, BoolArray](lambda: ~always()) for _ in range(3))
    for rule in map(dict, rules):
        kind, clauses = rule.get("class", ""), _clauses(rule) or [("", always(), False)]
        if (
            rule.get("hours")
            and not any(is_timed for _, _, is_timed in clauses)
            and re.search(r"\d", rule["hours"])
        ):
            unread.append(("hours", rule["hours"], "at all hours"))
        limit, (charge, doubt) = _stay(rule.get("limit", kind)), _charge(rule.get("rate", ""))
        for part, assumed in (("rate", doubt), ("limit", "" if limit else "no limit of stays")):
            unread += [(part, rule[part], assumed)] if assumed and part in rule else []
        if rule.get("disabled_limit", "0") != "0":
            unread.append(("disabled_limit", rule["disabled_limit"], "the limit of other drivers"))
        for words, when, _ in clauses:
            users = next((users for users, known in USERS.items() if _has(known, f"{words} {kind}")), "")
            if kind and not users and not limit:
                unread.append(("class", kind, "open to everybody"))
            if users == "no":
                closed.append(when)
                continue
            access[users] |= when
            stay = limit or (_stay(words) if words.strip() else None)
            if stay and stay < DAY_S:
                stays[f"{stay / 60:g} min"] |= when
            if "rate" in rule or _has(_PAID, f"{words} {kind}"):
                fees[charge] |= when
    paid = np.any([~always(), *fees.values()], axis=0)
    for when in closed:
        if paid.any() and not (paid & ~when).any():
            # What forbids all that is sold is no rule of these hours.
            unread.append(("hours", rules_text(rules), "parking where it is charged"))
        else:
            access["no"] |= when
    reserved = np.any(
        [~always(), *(when for users, when in access.items() if users not in ("", "yes"))], axis=0
    )
    if not reserved.all():
        # Prices and limits of those for whom the bay is reserved are not those of all others.
        for when in (paid, *fees.values(), *stays.values()):
            when &= ~reserved
    by_key = {"access": access, "fee": {"yes": paid}, "charge": fees, "maxstay": stays}
    return dict(pair for key, values in by_key.items() for pair in _tags(key, values)), tuple(unread)


def rules_text(rules: Sequence[Rule]) -> str:
    """Return the words of rules, without columns of days and times."""
    words = (
        " ".join(text for part, text in rule if part in ("limit", "rate", "hours", "class")) for rule in rules
    )
    return " | ".join(dict.fromkeys(words))


def _tags(key: str, values: Mapping[str, BoolArray]) -> Iterator[tuple[str, str]]:
    """Yield the tag of a key with values at some hours, (10080,) each, or at all."""
    used = {value: when for value, when in values.items() if value not in ("", "yes") or key == "fee"}
    texts = [f"{value} @ ({hours_text(when) or '24/7'})" for value, when in used.items() if when.any()]
    if len(used) == 1 and texts and next(iter(used.values())).all():
        yield key, next(iter(used))
    elif texts:
        yield f"{key}:conditional", "; ".join(texts)
