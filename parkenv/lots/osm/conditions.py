"""OpenStreetMap's hours, conditions, durations and charges, and who may park: for kerbs, car parks and spaces alike.

Hours are a week of minutes, (10080,) bool from Monday 00:00 on, without public and school holidays.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from functools import lru_cache

import numpy as np

from parkenv.compiled.arrays import BoolArray
from parkenv.errors import with_extra
from parkenv.lots.osm.roads import NOT_CARS, Side, closed_to_cars, decisive_access
from parkenv.lots.unread import note_unread
from parkenv.world.tariff import DAYS, PUBLIC, Hours
from parkenv.world.week import DAY_S, HOUR_S

Tags = Mapping[str, str]
# A value, and those that replace it at some hours; later ones take precedence.
Conditional = tuple[str, Sequence[tuple[str, BoolArray]]]
FORBIDDEN = ""  # the class of users of places where nobody may park
# Class of users for each value of `access`, `parking:condition` and `restriction` that not everyone may park by.
RESERVED = {
    **dict.fromkeys(("loading", "loading_only", "unloading", "delivery"), "delivery"),
    **dict.fromkeys(("charging", "charging_only", "electric", "electric_vehicle"), "charging"),
    **dict.fromkeys(("disabled", "disabled_only", "wheelchair"), "disabled"),
    **dict.fromkeys(("private", "employees", "staff", "members", "official", "diplomat", "diplomatic"), "private"),
    **dict.fromkeys(("police", "doctor", "government", "carsharing", "car_sharing", "car_pool"), "private"),
    **dict.fromkeys(("residents", "resident", "permit", "permit_holders"), "permit"),
    "customers": "customers",
}  # fmt: skip
# Classes of users whose places a car park may count apart: `capacity:disabled` and so on.
RESERVED_PLACES = ("disabled", "charging", "women")
NO_PARKING = (
    *("no_parking", "no_stopping", "no_standing", "no_waiting", "fire_lane", "taxi_only", "bus_only", "bus_stop"),
    *("hgv_only", "motorcycle", "motorcycle_only", "bicycle", "taxi", "goods", "coach", *NOT_CARS),
)  # fmt: skip
FOR_ALL = (
    *("yes", "none", "free", "ticket", "disc", "public", "permissive", "designated", "destination", "motorcar"),
    *("fee", "unknown", "limited", "customary", "car", "use_sidepath", "motor_vehicle", ""),
)  # fmt: skip
FREE = ("no", "free", "none", "0")  # values of `fee` and `charge` where nothing is charged
# Properties of an ordinary car that conditions may ask for: t, m.
ORDINARY_CAR = {"weight": 1.5, "maxweight": 1.5, "length": 4.5, "width": 1.8, "height": 1.6, "axles": 2.0}
_OTHERS = (
    *("wet", "snow", "winter", "emergency", "agricultural", "forestry", "bicycle", "moped", "trailer", "caravan"),
    *("visitors", "guests", "students", "women", "parents", "doctors", "holders"),
)  # fmt: skip
# Mondays of the week that counts and of those that must be like it, in summer and in winter.
_WEEKS = tuple(datetime(2026, month, day) for month, day in ((6, 8), (6, 1), (11, 2), (11, 9)))
_DAY_NAMES = {
    **dict(zip(("mon", "tue", "wed", "thu", "fri", "sat", "sun"), DAYS, strict=True)),
    **dict(
        zip(("monday", "tuesday", "wednesday", "thursday", "friday", "saturday", "sunday"), DAYS, strict=True)
    ),
    **{"tues": "Tu", "thur": "Th", "thurs": "Th", "di": "Tu", "mi": "We", "do": "Th", "so": "Su"},
    **{"daily": "Mo-Su", "täglich": "Mo-Su"},
}
_MONTHS = re.compile(r"Jan|Feb|Mar|Apr|May|Jun|Jul|Aug|Sep|Oct|Nov|Dec|week|easter|\d{4}", re.I)


@dataclass(frozen=True, eq=False)
class Week:
    """The hours that a text says, and what is doubtful about them."""

    minutes: BoolArray  # (10080,)
    doubt: str = ""


def always() -> BoolArray:
    return np.ones(7 * 1440, bool)


@lru_cache(maxsize=4096)
def week_of(text: str) -> Week | None:
    """Return the hours of an ordinary week; None if the text cannot be read."""
    with with_extra("hours of OpenStreetMap", "osm"):
        from opening_hours import OpeningHours, ParserError  # type: ignore[attr-defined]

    doubt = ""

    def minutes_of(rules: str, monday: datetime) -> BoolArray:
        nonlocal doubt
        minutes = np.zeros(7 * 1440, bool)
        for begin, end, state, comments in OpeningHours(rules).intervals(monday, monday + timedelta(7)):
            first, last = ((t - monday) / timedelta(minutes=1) for t in (begin, end or monday + timedelta(7)))
            minutes[round(first) : round(last)] = str(state) == "open"
            if str(state) == "unknown":
                doubt = "closed when unknown"
            elif comments and str(state) == "open":
                doubt = "as without the comment"
        return minutes

    usual, *fallback = _plain(text).split("||")
    try:
        weeks = [minutes_of(usual, monday) for monday in _WEEKS]
        for rule in filter(str.strip, usual.split(";") if ";" in usual else ()):
            # The library forgets what is open past midnight if another rule has the next day.
            alone = minutes_of(rule, _WEEKS[0])
            for minutes in weeks:
                _open_past_midnight(minutes, alone, rule)
    except ParserError:
        return None
    if fallback:
        doubt = "without what follows ||"
    if _MONTHS.search(text) or any((weeks[0] != other).any() for other in weeks[1:]):
        doubt = "all year as in the second week of June"
    if re.search("sun|dawn|dusk", text):
        doubt = "sunrise at 07:00, sunset at 19:00, dawn at 06:00, dusk at 20:00"
    weeks[0].setflags(write=False)
    return Week(weeks[0], doubt)


def hours_in(tags: Tags, key: str, text: str, assumed: str, otherwise: BoolArray) -> BoolArray:
    """Return the hours that a text says, or others; what is not read, or doubtful, is listed with what is assumed."""
    week = week_of(text)
    if week is None or week.doubt:
        note_unread(tags, key, assumed if week is None else week.doubt)
    return otherwise if week is None else week.minutes


def _open_past_midnight(minutes: BoolArray, alone: BoolArray, rule: str) -> None:
    """Open a week after midnight for as long as a rule, `alone`, lasts that was in force before."""
    for h0, m0, h1, m1 in re.findall(r"(\d?\d):(\d\d)\s*-\s*(\d?\d):(\d\d)", rule):
        begin, end = 60 * int(h0) + int(m0), 60 * int(h1) + int(m1)
        for last in range(1439, 7 * 1440, 1440) if end > 1440 or end < begin else ():
            after = (last + 1 + np.arange(end % 1440)) % (7 * 1440)
            if minutes[last] and alone[last] and alone[after].all():
                minutes[after] = True


def _plain(text: str) -> str:
    """Return hours with usual deviations from OpenStreetMap's notation mended."""
    text = re.sub(r"[–—−]", "-", text).strip(" ;,")
    while re.fullmatch(r"\([^()]*\)", text):
        text = text[1:-1].strip(" ;,")
    text = re.sub(r"[^\W\d_]+", lambda m: _DAY_NAMES.get(m[0].lower(), m[0]), text)
    text = re.sub(r"(?<=[a-z])\s+-\s+(?=[A-Z])", "-", text)
    text = re.sub(r"(?<=\d),(?=[A-Z][a-z])", ", ", text)
    text = re.sub(r"\b24\s*h\b", "00:00-24:00", text)
    text = re.sub(r"(?<!\d)(\d{1,2})(?::(\d\d))?\s*([ap])\.?m\b\.?", _on_24_hours, text, flags=re.I)
    text = re.sub(r"(?<!\d)(\d{1,2})[.h](\d\d)(?!\d)", r"\1:\2", text)
    text = re.sub(r"(\d\d:\d\d)\s*(?:h|Uhr)\b", r"\1", text)
    if not _MONTHS.search(text):
        whole = r"(?<![\d:\[])(\d{1,2})\s*(?:h|Uhr)?\s*-\s*(\d{1,2})\s*(?:h\b|Uhr\b)?(?![\d:])"
        text = re.sub(whole, r"\1:00-\2:00", text)
        text = re.sub(r"(?<![\d:\[])(\d{1,2})\s*h?\s*-\s*(?=\d?\d:\d\d)", r"\1:00-", text)
        text = re.sub(r"(\d:\d\d\s*-\s*\d{1,2})h?(?![\d:])", r"\1:00", text)
    # Rules of holidays alone, such as `SH Mo-Fr 08:00-12:00`.
    rules = [rule for rule in text.split(";") if not re.match(r"\s*[PS]H\s+[A-Z][a-z]\b", rule)]
    text = ";".join(rule for rule in rules if rule.strip())
    closing = [re.fullmatch(r"\s*[A-Z][A-Za-z,\s-]*\s(?:off|closed)\s*", rule) for rule in rules]
    return f"24/7; {text}" if rules and all(closing) else text


def _on_24_hours(match: re.Match[str]) -> str:
    hour = int(match[1]) % 12 + (12 if match[3].lower() == "p" else 0)
    return f"{hour:02}:{match[2] or '00'}"


def hours_text(minutes: BoolArray) -> str:
    """Return hours as `Hours` writes them; empty for always."""
    if minutes.all():
        return ""
    days = []
    for day in minutes.reshape(7, 1440):
        edges = np.flatnonzero(np.diff(np.r_[False, day, False])).tolist()
        days.append(tuple(zip(edges[::2], edges[1::2], strict=True)))
    return str(Hours(tuple(days)))


def conditional(tags: Tags, key: str) -> tuple[Conditional, list[tuple[str, float]]]:
    """Return the values of a key and of its `:conditional`, and those for stays shorter than some s.

    Conditions that an ordinary car or driver never meets are left away, and those that cannot be read are listed.
    """
    clauses: list[tuple[str, BoolArray]] = []
    short: list[tuple[str, float]] = []
    value = tags.get(key, "").strip()
    texts = [(f"{key}:conditional", tags.get(f"{key}:conditional", ""))]
    if "@" in value:
        texts, value = [(key, value), *texts], ""
    for name, text in texts:
        for part in _clauses(text):
            to, _, condition = part.partition("@")
            minutes, below = always(), 0.0
            for factor in re.split(
                r"\s+AND\s+", condition.strip().removeprefix("(").removesuffix(")"), flags=re.I
            ):
                if stay := re.fullmatch(r"(?:max)?stay\s*(<=?|>=?)\s*(.+)", factor.strip(), re.I):
                    below = duration(stay[2]) or 0.0
                    if not below:
                        note_unread(tags, name, "the condition is never met")
                        minutes = ~always()
                    elif stay[1].startswith(">"):
                        below = -below
                    continue
                holds = _holds(factor.strip())
                if holds is None:
                    holds = hours_in(tags, name, factor, "the condition is never met", ~always())
                minutes = minutes & holds
            if below < 0.0 and minutes.any() and to.strip().lower() not in FREE:
                # What longer stays alone pay is free before.
                clauses.append((to.strip(), minutes))
                short.append(("no", -below))
            elif below and minutes.any():
                short.append((to.strip(), below))
            elif minutes.any():
                clauses.append((to.strip(), minutes))
    return (value, clauses), short


def _clauses(text: str) -> list[str]:
    parts: list[str] = []
    for part in re.split(r";(?![^()]*\))", text):
        if "@" in part or not parts:
            parts.append(part)
        else:
            parts[-1] += f";{part}"
    return [part for part in parts if "@" in part]


def _holds(factor: str) -> BoolArray | None:
    """Return whether a condition holds for an ordinary car and driver; None if it may be hours."""
    if match := re.fullmatch(r"(\w+)\s*(<=?|>=?|=)\s*(\d+(?:\.\d+)?)\s*\w*", factor):
        if (car := ORDINARY_CAR.get(match[1].lower())) is None:
            return None
        limit = float(match[3])
        holds = {"<": car < limit, ">": car > limit, "=": car == limit}[match[2][0]]
        return always() if holds else ~always()
    word = factor.lower().replace("-", "_")
    if word in RESERVED or word in NO_PARKING or word in _OTHERS:
        return ~always()
    return always() if word in ("motorcar", "motor_vehicle", "vehicle", "car") else None


def at_hours(values: Conditional, meant: Callable[[str], bool]) -> BoolArray:
    """Return when the value is one that is meant."""
    base, clauses = values
    minutes = always() & meant(base)
    for value, when in clauses:
        minutes = np.where(when, meant(value), minutes)
    return minutes


def users_of(value: str) -> str | None:
    """Return the class of users of a value, the widest one of several; None if it is unknown."""
    words = [word.strip().lower() for word in re.split(r"[;,|]", value)]
    users = [
        FORBIDDEN if word in NO_PARKING else PUBLIC if word in FOR_ALL else RESERVED.get(word)
        for word in words
    ]
    if PUBLIC in users:
        return PUBLIC
    return next(filter(None, users), None if None in users else FORBIDDEN)


def parking_users(layers: Sequence[Conditional], open_at: BoolArray) -> tuple[str, BoolArray]:
    """Return the class of users of a place that all layers of values let in, and when they may park."""
    public = open_at
    for layer in layers:
        public = public & at_hours(layer, lambda value: users_of(value) in (PUBLIC, None))
    if public.any() or not open_at.any():
        return PUBLIC, public
    allowed, users = open_at, FORBIDDEN
    for layer in layers:
        allowed = allowed & at_hours(layer, lambda value: users_of(value) != FORBIDDEN)
        named = [users_of(value) for value in (layer[0], *(value for value, _ in layer[1]))]
        users = users or next((name for name in named if name and name != PUBLIC), FORBIDDEN)
    return (users if allowed.any() else FORBIDDEN), allowed


def closed_parking(tags: Tags) -> str | None:
    """Return the tag by which no car may park at any time, or None."""
    reason = closed_to_cars(tags, private=False)
    if reason is not None and reason.split("=")[0] == decisive_access(tags):
        users, _ = parking_users([conditional(tags, reason.split("=")[0])[0]], always())
        return reason if users == FORBIDDEN else None
    return reason


def note_users(tags: Tags, key: str, layer: Conditional) -> Conditional:
    """Return a layer of values; those of unknown meaning are listed."""
    if users_of(layer[0]) is None:
        note_unread(tags, key, "open to everybody")
    if any(users_of(value) is None for value, _ in layer[1]):
        note_unread(tags, f"{key}:conditional", "open to everybody")
    return layer


_SIDE = "(?:left|right|both)"
_VEHICLES = "(?:access|motorcar|motor_vehicle|vehicle)"
_RULES = f"(?:fee|charge|maxstay|{_VEHICLES})(?::conditional)?"
_READ = re.compile(
    rf"{_RULES}|opening_hours|capacity(?::(?:{'|'.join(RESERVED_PLACES)}))?"
    rf"|parking:{_SIDE}:(?:{_RULES}|restriction(?::conditional)?|capacity)"
    rf"|parking:lane:{_SIDE}(?::capacity)?|parking:condition:{_SIDE}:(?:default|maxstay|conditional)"
    rf"|parking:condition:(?:[23]:)?{_SIDE}(?::[23])?(?::(?:time_interval|vehicles))?|parking:ticket:zone"
)
_ON_RULES = re.compile(
    r"(?:parking:(?:.*:)?)?(?:fee|charge|maxstay|access|motorcar|motor_vehicle|vehicle|opening_hours|capacity|restriction"
    r"|conditions?|times?|hours|disc)(?::.*)?|parking:.*:conditional"
)
_NO_RULE = re.compile(
    r".*:(?:capacity:free|reason|residents|private|except|note|source|authentication)(?::.*)?"
)


def note_other_keys(tags: Tags) -> None:
    """List keys of rules of parking that nothing here reads."""
    for key in tags:
        if (
            key[:1] in "pfcmavo"
            and _ON_RULES.fullmatch(key)
            and not (_READ.fullmatch(key) or _NO_RULE.fullmatch(key))
        ):
            note_unread(tags, key, "as without it")


def access_layer(tags: Tags, prefix: str = "") -> Conditional:
    """Return the values of the most specific access tag: whom a place is for."""
    key = prefix + (decisive_access(tags, prefix) or "access")
    return note_users(tags, key, conditional(tags, key)[0])


def kerb_tag(tags: Tags, key: str, side: Side) -> str:
    """Return the key of one side of a way, `{}` in the text, that the tags have; else that of both."""
    return next((k for k in (key.format(side), key.format("both")) if k in tags), key.format("both"))


def kerb_conditions(tags: Tags, side: Side) -> Conditional:
    """Return the values of `parking:condition`, those of other hours, and a `parking:lane` that forbids parking."""
    key, lane = (kerb_tag(tags, f"parking:{what}:{{}}", side) for what in ("condition", "lane"))
    forbidden = tags.get(lane, "") if users_of(tags.get(lane, "")) == FORBIDDEN else ""
    both_is_own = "parking:condition:both" in tags and key in tags
    parts = []
    for own in ("{}", "{}:2", "2:{}", "{}:3", "3:{}"):
        at = kerb_tag(tags, f"parking:condition:{own}", side)
        interval_key, vehicles_key = (
            f"{at}:{what}" if both_is_own else kerb_tag(tags, f"parking:condition:{own}:{what}", side)
            for what in ("time_interval", "vehicles")
        )
        value, interval = tags.get(at) or "", tags.get(interval_key, "")
        if own == "{}" and interval and not value:
            value, forbidden = forbidden or "free", ""
        # What is for some vehicles alone is for no ordinary car; what binds these alone does not concern it.
        vehicles = tags.get(vehicles_key, "")
        if vehicles and users_of(vehicles) != PUBLIC:
            value = "" if users_of(value) == FORBIDDEN else RESERVED.get(vehicles, "no")
        if value:
            note_users(tags, at, (value, ()))
            when = hours_in(tags, interval_key, interval, "at all times", always()) if interval else always()
            parts.append((value, when))
    default = f"{key}:default" if both_is_own else kerb_tag(tags, "parking:condition:{}:default", side)
    return forbidden or tags.get(default, ""), [*parts, *conditional(tags, key)[0][1]]


def kerb_users(tags: Tags, side: Side) -> tuple[str, BoolArray]:
    """Return the class of users of one side of a way, and when they may park there."""
    restriction = kerb_tag(tags, "parking:{}:restriction", side)
    conditional_restriction = kerb_tag(tags, "parking:{}:restriction:conditional", side)
    if conditional_restriction.rpartition(":")[0] != restriction and restriction not in tags:
        restriction = conditional_restriction.rpartition(":")[0]
    layers = [note_users(tags, restriction, conditional(tags, restriction)[0]), kerb_conditions(tags, side)]
    layers += [access_layer(tags, f"parking:{at}:") for at in (side, "both")]
    return parking_users(layers, always())


def opening(tags: Tags) -> BoolArray:
    text = tags.get("opening_hours", "").strip()
    return hours_in(tags, "opening_hours", text, "always open", always()) if text else always()


_UNITS = (
    (r"s|secs?|seconds?", 1.0),
    (r"m|mins?|minutes?|minuten?|minuti|minutos?", 60.0),
    (r"h|hrs?|hours?|std|stunden?|heures?|horas?|ora|ore|uur|tim|timme|timmar|godz", HOUR_S),
    (r"d|days?|tage?|jours?|dag|dagar|día|día|dia|giorno", DAY_S),
    (r"w|weeks?|wochen?", 7 * DAY_S),
    (r"months?|monate?|mo", 30 * DAY_S),
    (r"y|years?|jahre?", 365 * DAY_S),
)
_UNIT = "|".join(words for words, _ in _UNITS)
_PART = re.compile(rf"(\d{{1,9}}(?:[.,]\d{{1,9}})?)\s*({_UNIT})(?![^\W\d_])\.?", re.I)
_ISO = re.compile(r"P(?:(\d{1,9})D)?(?:T(?:(\d{1,9})H)?(?:(\d{1,9})M)?(?:(\d{1,9})S)?)?", re.I)


def _seconds(unit: str) -> float:
    return next(seconds for words, seconds in _UNITS if re.fullmatch(words, unit, re.I))


def duration(text: str) -> float | None:
    """Return a duration, s: infinite without a limit; None if the text cannot be read."""
    text = text.strip()
    if text.lower() in ("no", "none", "unlimited", "inf"):
        return np.inf
    if re.fullmatch(r"\d{1,6}", text):
        return 60.0 * int(text)
    if match := re.fullmatch(r"(\d{1,3}):(\d\d)(?:\s*h(?:rs?|ours?)?)?", text, re.I):
        return HOUR_S * int(match[1]) + 60.0 * int(match[2])
    if (match := _ISO.fullmatch(text)) and any(match.groups()):
        sizes = (DAY_S, HOUR_S, 60.0, 1.0)
        return sum(float(n or 0) * size for n, size in zip(match.groups(), sizes, strict=True))
    text = re.sub(r"(\d)\s*h\s*(\d\d)$", r"\1 h \2 min", text, flags=re.I)
    parts, rest = _PART.findall(text), _PART.sub("", text)
    if not parts or not re.fullmatch(r"(?:\s|,|\+|and|und)*", rest, re.I):
        return None
    return sum(float(n.replace(",", ".")) * _seconds(unit) for n, unit in parts)


# Currencies in which an hour costs some units, not thousands.
SMALL = re.compile(r"€|\$|£|EUR|USD|GBP|CHF|CAD|AUD|NZD|SGD", re.I)
MOST_PER_HOUR = 1000.0  # a higher charge in one of these is a mistake
_NUMBER = r"\d{1,9}(?:[.,'’\u00a0\u202f ]\d{3})*(?:[.,]\d{1,4})?"
_CHARGE = re.compile(
    rf"(?P<before>[^\W\d_]{{3}}|[€$£¥₹₩])?\s*(?<![\d.,])(?<!\de)(?P<amount>{_NUMBER})\s*(?P<after>[^\d/;,|]{{0,12}}?)\s*"
    rf"(?:/|\bper\b|\bpro\b|\bje\b|\ban\b|\beach\b)\s*(?:(?P<n>\d{{1,6}}(?:[.,]\d{{1,3}})?)\s*)?(?P<unit>{_UNIT})(?![^\W\d_])",
    re.I,
)


@dataclass(frozen=True)
class Charge:
    per_hour: float  # 24 · per_hour a day, if by_day
    by_day: bool = False  # whether a day costs it, however short the stay
    daily_cap: float | None = None  # most that a day costs
    doubt: str = ""


def charge_in(text: str) -> Charge | None:
    """Return the price of an hour or a day that OpenStreetMap's `charge` has; None if it cannot be read."""
    if text.strip().lower() in FREE:
        return Charge(0.0)
    hourly, daily, doubt = list[float](), list[float](), ""
    for match in _CHARGE.finditer(text):
        seconds = float((match["n"] or "1").replace(",", ".")) * _seconds(match["unit"])
        is_small = SMALL.search(f"{match['before'] or ''} {match['after']}") is not None
        amount = _amount(match["amount"], is_small)
        if is_small and re.fullmatch(r"[1-9]\d{0,2}[.,]\d{3}", match["amount"]):
            doubt = f"{amount:g}, not thousands"
        if not seconds or seconds > DAY_S or (is_small and amount * HOUR_S / seconds > MOST_PER_HOUR):
            doubt = "without the other prices"
            continue
        if seconds < DAY_S:
            hourly.append(amount / seconds * HOUR_S)
        else:
            daily.append(amount)
    if not hourly and not daily:
        return None
    rest = re.sub(r"\b(?:max\w*|up|to|day|and|und)\b|[\s.;,+|()]", "", _CHARGE.sub("", text), flags=re.I)
    if len(hourly) > 1 or len(daily) > 1 or rest:
        doubt = "without the other prices"
    if hourly:
        return Charge(hourly[0], False, daily[0] if daily else None, doubt)
    return Charge(daily[0] / 24.0, True, None, doubt)


def _amount(text: str, is_small: bool) -> float:
    """Return a number with a decimal comma or point, and separators of thousands."""
    text = re.sub(r"['’\u00a0\u202f ]", "", text)
    if "," in text and "." in text:
        thousands = "," if text.rindex(",") < text.rindex(".") else "."
        return float(text.replace(thousands, "").replace(",", "."))
    parts = re.split("[.,]", text)
    is_thousands = len(parts) > 2 or (
        len(parts) == 2 and len(parts[1]) == 3 and parts[0] != "0" and not is_small
    )
    return float("".join(parts) if is_thousands else ".".join(parts))
