"""A study of a user's own: one class, which the runner of all studies runs."""

import time
import warnings
from typing import ClassVar, Literal, NamedTuple

from pydantic import Field

from parkenv.files.spec_file import Several
from parkenv.studies.results import Table
from parkenv.studies.study import Cell, Study


class Power(NamedTuple):
    power: int

    @property
    def columns(self):
        return {"power": self.power}


class Toy(Study):
    """Powers of whole numbers."""

    table: ClassVar = Table("powers.csv", ("power", "number"), ("value",))
    block: ClassVar = 2
    unit: ClassVar = "numbers"

    kind: Literal["toy"] = "toy"
    powers: Several[int] = Field((2, 3), description="Exponents.")
    numbers: int = Field(6, ge=1, description="How many numbers.")
    pause_s: float = Field(0.0, ge=0.0, description="Time that a number takes, s.")
    offset: int = 0
    warns: bool = False

    def settings(self):
        return {"offset": self.offset}

    def cells(self):
        return [Cell(Power(power), range(self.numbers)) for power in self.powers]

    def run(self, work, items):
        time.sleep(self.pause_s * len(items))
        if self.warns and 4 in items:
            warnings.warn(f"{items[0]} comes before 4", stacklevel=2)
        return [{"power": work.power, "number": n, "value": self.offset + n**work.power} for n in items]

    def summarise(self, results):
        sums = {
            cell.work.power: [row["value"] for row in self.rows_of(cell, results)] for cell in self.cells()
        }
        return {"rows": [{"power": power, "sum": sum(values)} for power, values in sums.items()]}

    def outputs(self, results, summary):
        return [(results.path / "done.txt").touch]
