"""Prices that follow demand: San Francisco's rule of SFpark, round after round, in a made town with many cars.

It takes some minutes, with a line after each round.

    python examples/sfpark_prices.py

After each round the price of an hour in a zone changes by what its occupancy was: above 80 % it rises by a step, from
30 to 60 % it falls by one, and below 30 % by two (SFMTA, *SFpark pilot project evaluation*, 2014). The same cars come
on the same days in every round, and drivers know all prices. A table of prices and occupancies, and of what a car
cruises and pays, is printed at the end. SFpark had a price for each block and part of the day; here it is one for each
zone, all day, and drivers expect the occupancy of today's prices.
"""

import parkenv

ROUNDS, DAYS, HOURS = 8, 2, "07:00-20:00"
ZONES = ("centre", "ring", "outer", "garage", "market", "station")
STEP, MOST = 0.25, 8.0


def changed(price, occupancy):
    """Return the next price of an hour, by SFpark's rule."""
    steps = 1 if occupancy > 0.8 else -2 if occupancy < 0.3 else -1 if occupancy < 0.6 else 0
    return min(max(price + steps * STEP, 0.0), MOST)


prices, columns, cars = {}, {zone: [] for zone in ZONES}, []
for number in range(ROUNDS):
    # Without a price of its own, as in the first round, a zone has that of the town's file.
    zones = {zone: {"price": price} for zone, price in prices.items()}
    town = {"base": "town", "arrivals": {"hours": HOURS}, "zones": zones}
    result = parkenv.fleet(scenarios=[town], days=DAYS, seed=0, figures=False)
    occupancies = {}
    for row in result.summary["zones"]:
        if row["zone"] in ZONES:
            columns[row["zone"]].append(f"{row['price']:.2f} {row['occupancy']:4.0%}")
            prices[row["zone"]] = changed(row["price"], row["occupancy"])
    cars.append(result.rows[0])
    print(f"round {number + 1} of {ROUNDS}: {cars[-1]['total_s']:.0f} s a car", flush=True)

print("price of an hour and share of the spaces taken, by round")
for zone, cells in columns.items():
    print(f"{zone:8}", *(f"{cell:>10}" for cell in cells))
for name, label, form in (
    ("cruised_m", "m cruised", ".0f"),
    ("total_s", "s a car", ".0f"),
    ("paid", "paid", ".2f"),
):
    print(f"{label:9}", *(f"{row[name]:>10{form}}" for row in cars))
