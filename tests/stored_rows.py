"""Rows of a run's store, changed behind its back."""

import json
import sqlite3
from zlib import crc32


def change_rows(folder, change, file="results.sqlite"):
    """Give each row to a function that changes it, or returns True to forget it, as a crash would have."""
    database = sqlite3.connect(folder / file)
    for number, text in database.execute("SELECT rowid, value FROM row").fetchall():
        row = json.loads(text)
        if "what" not in row and change(row):
            database.execute("DELETE FROM row WHERE rowid = ?", (number,))
        else:
            new = json.dumps(row)
            changed = new, crc32(new.encode()), number
            database.execute("UPDATE row SET value = ?, crc32 = ? WHERE rowid = ?", changed)
    database.commit()
    database.close()
