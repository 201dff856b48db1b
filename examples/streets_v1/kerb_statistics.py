"""Statistics of real kerbs: `python examples/streets_v1/kerb_statistics.py DATA LAW.json`.

In seconds, reads the folders of DATA that hold public counts and states of kerbs, and writes the few numbers that the
made district `kerbs` follows. No count, position or bay is carried over. Which number comes from where:

- share taken by hour: the mean, in logits, of San Francisco (SFpark's sensors, 2011-2013) and Melbourne (25 groups of
  bays, five days of 2017), the only two with all hours and a Saturday and a Sunday. Beside it, as a check, Seattle's
  hand counts of 2021 and 2022, where a capacity is known, and four moments of Los Angeles.
- spread between block faces: the mean of two standard deviations, logits. Seattle's (about 300 faces of 13 districts,
  around each district's mean) is of a day each, so the spread between days is taken out; Melbourne's is of three
  weekdays. They are far apart: Seattle counts whole districts, Melbourne published its busy centre.
- correlation of block faces: Seattle's, by their names: opposite faces, the next block of the street, farther ones.
- spread between the bays of a street: Melbourne, three weekdays of April 2018, without bays that are always or never
  taken (dead sensors). Covariances between different days leave out the chance of a day.
- spread between days of a block face: Melbourne's three weekdays and Seattle's four, around the face's own mean. The
  days of a whole city hardly differ within a week; a season would add to it, and no set here has one.
- stays: the time since a car came is the age of its stay; of exponential stays the median age is ln 2 of the mean. By
  day: Los Angeles (12:31 and 18:25) and Melbourne (2025, 2026); at night Los Angeles alone (01:13). Real stays have a
  heavier tail. Seattle's changes bound them: a car came to each space every `arrival_every_h` at least as often.
- spread of stays between block faces: Los Angeles, the variance of the logarithm of a face's mean age beyond chance.
"""

import csv
import gzip
import itertools
import json
import re
import sys
from collections import defaultdict
from datetime import datetime
from pathlib import Path

import numpy as np
from scipy.special import expit, logit, polygamma

MOMENTS = {1: "2019-05-09 01:25:09", 2: "2019-05-09 08:13:28", 3: "2019-05-09 19:31:08"}  # UTC, Los Angeles
LIVE_H = 48.0  # h; a sensor without a change for longer counts as dead
BY_DAY = range(9, 18)


def rows(file):
    """Read a CSV table."""
    with (gzip.open if file.suffix == ".gz" else open)(file, "rt", encoding="utf-8") as text:
        yield from csv.DictReader(text)


def day_kind(weekday):
    """Return 0 for a weekday, 1 for Saturday, 2 for Sunday; Monday is 0."""
    return max(0, weekday - 4)


def logits(shares):
    """Return the logits of shares, kept from 0 and 1."""
    return logit(np.clip(shares, 0.03, 0.97))


def sfpark_hours(data):
    """Return the share taken by kind of day and hour in San Francisco, (3, 24)."""
    taken, known = np.zeros((2, 3, 24))
    for row in rows(data / "sfpark_profiles/profiles.csv.gz"):
        at, spaces = (day_kind(int(row["weekday"])), int(row["hour"])), float(row["spaces"])
        taken[at] += spaces * float(row["occupied"])
        known[at] += spaces * (float(row["occupied"]) + float(row["vacant"]))
    return taken / known


def melbourne_groups(data):
    """Return the share taken by kind of day and hour, (3, 24), and that of each group on each weekday, by day."""
    taken, spaces = np.zeros((2, 3, 24))
    days = defaultdict(list)
    for row in rows(data / "melbourne_2017_groups/counts.csv.gz"):
        time, capacity = datetime.fromisoformat(row["time"]), int(row["capacity"])
        at = day_kind(time.weekday()), time.hour
        taken[at] += int(row["cars"])
        spaces[at] += capacity
        if at[0] == 0 and time.hour in BY_DAY:
            days[row["group"], time.day].append(int(row["cars"]) / capacity)
    return taken / spaces, table(days)


def seattle_minutes(data):
    """Return the share of each face on each day, by day, and hours between arrivals at a space, at most."""
    capacity = {
        row["blockface"]: int(row["capacity"]) for row in rows(data / "seattle_minutes/blockfaces.csv")
    }
    days, before, arrivals, space_h = defaultdict(list), {}, 0.0, 0.0
    for row in rows(data / "seattle_minutes/counts.csv.gz"):
        face, day, cars = row["blockface"], row["time"][:10], int(row["cars"])
        if int(row["time"][11:13]) in BY_DAY:
            days[face, day].append(min(cars / capacity[face], 1.0))
        if (face, day) in before:
            arrivals += abs(cars - before[face, day]) / 2
            space_h += capacity[face] / 60
        before[face, day] = cars
    return table(days), space_h / arrivals


def table(days):
    """Return the logits of mean shares, (faces, days), from shares by face and day."""
    faces, dates = (sorted({key[i] for key in days}) for i in (0, 1))
    return np.array([[logits(np.mean(days[face, date])) for date in dates] for face in faces])


def spreads(values):
    """Return the standard deviations between faces, and between days of a face, of (faces, days) logits."""
    noise = values.var(axis=1, ddof=1).mean()
    return float(np.sqrt(values.mean(axis=1).var(ddof=1) - noise / values.shape[1])), float(np.sqrt(noise))


def seattle_faces(data):
    """Return share by hour, standard deviation of faces around their district, and correlations of faces."""
    capacity = {
        row["blockface"]: float(row["capacity"] or 0) for row in rows(data / "seattle_hours/blockfaces.csv")
    }
    counted, names, by_hour = defaultdict(list), {}, defaultdict(list)
    for row in rows(data / "seattle_hours/counts.csv.gz"):
        face, cars, hour = row["blockface"], float(row["cars_paid_spaces"] or -1), int(row["time"][11:13])
        if capacity[face] < 4 or cars < 0 or hour not in BY_DAY:
            continue
        share = min(cars / capacity[face], 1.0)
        counted[row["study"], face].append(share)
        by_hour[hour].append((share, capacity[face]))
        names[face] = re.fullmatch(r"(.+) BETWEEN (.+) AND (.+)", row["name"])
    studies = defaultdict(dict)
    for (study, face), shares in counted.items():
        if len(shares) >= 6:
            studies[study][face] = float(logits(np.mean(shares)))
    studies = {study: faces for study, faces in studies.items() if len(faces) >= 5}
    products, squares, free = defaultdict(list), 0.0, 0
    for faces in studies.values():
        mean = np.mean(list(faces.values()))
        squares += sum((value - mean) ** 2 for value in faces.values())
        free += len(faces) - 1
        for (one, x), (other, y) in itertools.combinations(faces.items(), 2):
            if names[one] and names[other] and names[one][1] == names[other][1]:
                shared = len(set(names[one].groups()[1:]) & set(names[other].groups()[1:]))
                products[("farther", "next", "opposite")[shared]].append((x - mean) * (y - mean))
    correlation = {kind: float(np.mean(values)) / (squares / free) for kind, values in products.items()}
    hours = {
        hour: float(np.average(np.transpose(values)[0], weights=np.transpose(values)[1]))
        for hour, values in sorted(by_hour.items())
    }
    return [round(hours[hour], 3) for hour in BY_DAY], float(np.sqrt(squares / free)), correlation


def melbourne_bays(data):
    """Return the standard deviation between the bays of a street, logits."""
    with gzip.open(data / "melbourne_bays/bays.geojson.gz", "rt", encoding="utf-8") as text:
        street = {f["properties"]["id"]: f["properties"]["street"] for f in json.load(text)["features"]}
    streets = defaultdict(list)
    for row in rows(data / "melbourne_bays/states.csv.gz"):
        days = [row[f"share_{day}"] for day in ("wednesday", "thursday", "friday")]
        shares = np.array([float(share) if share else np.nan for share in days])
        if row["bay_id"] in street and shares.min() < 0.98 and shares.max() > 0.02:
            streets[street[row["bay_id"]]].append(logits(shares))
    mean = np.concatenate(list(streets.values())).mean(axis=0)
    same, others = [], []
    for bays in (np.array(values) - mean for values in streets.values() if len(values) > 1):
        for i, j in itertools.permutations(range(3), 2):
            each = bays[:, i] * bays[:, j]
            same += each.tolist()
            others += len(bays) * [
                (bays[:, i].sum() * bays[:, j].sum() - each.sum()) / (len(bays) * (len(bays) - 1))
            ]
    return float(np.sqrt(np.mean(same) - np.mean(others)))


def los_angeles(data):
    """Return for each moment the share taken and the median age of a stay, min; and the spread of faces at noon."""
    shares, ages, spread = [], [], 0.0
    for number, text in MOMENTS.items():
        moment, faces, vacant = datetime.fromisoformat(text), defaultdict(list), 0
        for row in rows(data / "la_meters/meters.csv.gz"):
            if row[f"state_{number}"] in ("occupied", "vacant") and (since := row[f"since_utc_{number}"]):
                age = (moment - datetime.fromisoformat(since)).total_seconds() / 60
                if 0.0 <= age < 60 * LIVE_H:
                    vacant += row[f"state_{number}"] == "vacant"
                    if row[f"state_{number}"] == "occupied":
                        faces[row["block_face"]].append(max(age, 1.0))
        stays = np.concatenate(list(faces.values()))
        shares.append(len(stays) / (len(stays) + vacant))
        ages.append(float(np.median(stays)))
        many = [values for values in faces.values() if len(values) >= 4]
        means = np.log([np.mean(values) for values in many])
        chance = np.mean([polygamma(1, len(values)) for values in many])
        spread = float(np.sqrt(max(means.var(ddof=1) - chance, 0.0)))  # of the last moment, noon
    return shares, ages, spread


def melbourne_ages(data):
    """Return the median age of a stay, min, in the live feeds of 2025 and 2026, both by day."""
    medians = []
    for file in sorted((data / "melbourne_bays").glob("since_*.csv.gz")):
        feed = list(rows(file))
        moment = max(datetime.fromisoformat(row["updated_utc"]) for row in feed)
        ages = [moment - datetime.fromisoformat(row["since_utc"]) for row in feed if row["occupied"] == "1"]
        minutes = [age.total_seconds() / 60 for age in ages]
        medians.append(float(np.median([age for age in minutes if age < 60 * LIVE_H])))
    return medians


def law(data):
    """Return the law with its sources."""
    francisco, (melbourne, groups) = sfpark_hours(data), melbourne_groups(data)
    (few_faces, arrival_h), (hours, between_faces, correlation) = seattle_minutes(data), seattle_faces(data)
    (group_sd, group_day), (_, face_day) = spreads(groups), spreads(few_faces)
    shares, (evening, night, noon), stay_spread = los_angeles(data)
    day_sd = (group_day + face_day) / 2
    seattle_sd = np.sqrt(between_faces**2 - day_sd**2)
    by_day = float(np.median([noon, evening, *melbourne_ages(data)]))
    taken = expit((logit(francisco) + logit(melbourne)) / 2).round(3).tolist()
    numbers = {
        "between_faces": (seattle_sd + group_sd) / 2,
        "opposite_correlation": correlation["opposite"],
        "next_correlation": correlation["next"],
        "farther_correlation": correlation["farther"],
        "between_bays": melbourne_bays(data),
        "between_days": day_sd,
        "stay_min": by_day / np.log(2),
        "night_stay_min": night / np.log(2),
        "between_stays": stay_spread,
    }
    checks = {
        "between_faces_seattle": seattle_sd,
        "between_faces_melbourne": group_sd,
        "between_days_melbourne": group_day,
        "between_days_seattle": face_day,
        "arrival_every_h": arrival_h,
    }
    return {
        "made_by": "examples/streets_v1/kerb_statistics.py, which says what comes from which city",
        "sources": [
            "SFMTA, SFpark sensors 2011-2013, San Francisco (public)",
            "City of Melbourne, on-street parking sensors 2017, 2018, 2025, 2026 (CC BY 4.0)",
            "City of Seattle, hand counts 2021-2022 and blockfaces by the minute, March 2022",
            "City of Los Angeles, parking meter occupancy, May 2019 (public domain)",
        ],
        "share_taken": dict(zip(("weekday", "saturday", "sunday"), taken, strict=True)),
        **{name: round(float(value), 3) + 0.0 for name, value in numbers.items()},
        "checks": {
            **{name: round(float(value), 3) for name, value in checks.items()},
            "share_taken_seattle_9_to_17": hours,
            "share_taken_los_angeles_18_25_01_13_12_31": [round(share, 3) for share in shares],
        },
    }


if __name__ == "__main__":
    text = json.dumps(law(Path(sys.argv[1])), indent=1)
    text = re.sub(r"\[[-+.eE\d,\s]+\]", lambda numbers: " ".join(numbers[0].split()), text)
    Path(sys.argv[2]).write_text(text + "\n", encoding="utf-8")
