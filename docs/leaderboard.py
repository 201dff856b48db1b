"""The tables on the pages of the leaderboard, made from its result files: `python docs/leaderboard.py`."""

import re
from pathlib import Path

from parkenv.show.tables import interval_text
from parkenv.studies.benchmark.page import entries_of, neighbours, ranking, result_files
from parkenv.studies.benchmark.suite import Suite, check_result

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "docs" / "leaderboard"
PAGES = {"index.md": "results", "streets.md": "streets"}
"""Pages of the suites, and the folders of their results."""
START, END = "<!-- {}: made by docs/leaderboard.py -->\n", "<!-- end -->\n"


def tables(folder):
    """Make the tables of a page from the results in a folder, by name."""
    results = [check_result(file) for file in result_files(FOLDER / folder)]
    suite, entries = Suite.packaged(results[0]["suite"]), entries_of(results)
    lines = [
        "| | agent | score, % | mean time, s | behind the best, s | ms a decision | submitted by | code | commit |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    rows = ranking(suite, entries)
    for place, row in enumerate(rows, 1):
        score, low, high = (f"{100 * value:.1f}" for value in (row["score"], *row["score_ci95"]))
        code = f"[code]({row['code']})" if row["code"].startswith("http") else row["code"]
        lines.append(
            f"| {place} | {row['agent']} | {score} [{low}, {high}] | {interval(row, 'mean_s')} | "
            f"{interval(row, 'behind_s', '+')} | {row['decision_ms']:.2f} | {row['by']} | {code} | {row['commit']} |"
        )
    pairs = ["| agents | difference, s | searches |", "|---|---|---|"]
    pairs += [
        f"| {row['agents']} | {interval(row, 'behind_s', '+')} | {row['searches_for_1_s']:,.0f} |"
        for row in neighbours(suite, entries)
    ]
    made = {"ranking": "\n".join(lines), "pairs": "\n".join(pairs)}
    for agent in (row["agent"] for row in rows):
        brief = re.sub(r"([:=])[^()]*[/\\]", r"\1", agent)  # without the folders of its file
        made = {name: table.replace(agent, brief) for name, table in made.items()}
    return made


def interval(row, name, sign=""):
    """Write a value with its interval."""
    ends = row[f"{name}_ci95"]
    return interval_text(row[name], ends, f"{sign}.1f") if ends[1] > ends[0] else ""


def page(text, folder):
    """Return a page with its tables made anew."""
    for name, table in tables(folder).items():
        start = START.format(name)
        before, found, rest = text.partition(start)
        text = f"{before}{start}\n{table}\n\n{END}{rest.partition(END)[2]}" if found else text
    return text


if __name__ == "__main__":
    for name, folder in PAGES.items():
        path = FOLDER / name
        path.write_text(page(path.read_text(encoding="utf-8"), folder), encoding="utf-8")
