"""SQLite alone: appends rows of the same columns as Tread's measurements, with the loop in C.

Prints one JSON object. Rows are made before the measurement; nothing is decoded, checked or summed.
"""

import argparse
import json
import sqlite3
import time

ROWS_PER_COMMIT = 5_000
COLUMNS = 17


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--database", required=True)
    parser.add_argument("--seconds", type=float, default=5.0)
    arguments = parser.parse_args()

    database = sqlite3.connect(arguments.database, isolation_level=None)
    database.execute("PRAGMA journal_mode = WAL")
    database.execute("PRAGMA synchronous = FULL")
    names = ", ".join(f"c{number}" for number in range(COLUMNS))
    database.execute(f"CREATE TABLE segment_values (pk INTEGER PRIMARY KEY, {names})")
    insert = f"INSERT INTO segment_values VALUES (NULL{', ?' * COLUMNS})"
    # Times, a cell, sums and missing values, as in the measurements of `load`.
    row = (
        1_795_000_000_000_000_000, 1_795_000_000_000_000_000, 17, 23, 25_000.5, 5_000.25, None, None,
        None, None, None, None, None, 0.3, 160, 1.5, 0.0,
    )
    rows = [row] * ROWS_PER_COMMIT
    count = 0
    begin, cpu_begin = time.monotonic(), time.process_time()
    while time.monotonic() - begin < arguments.seconds:
        database.execute("BEGIN IMMEDIATE")
        database.executemany(insert, rows)
        database.execute("COMMIT")
        count += ROWS_PER_COMMIT
    took, cpu_s = time.monotonic() - begin, time.process_time() - cpu_begin
    print(json.dumps({"rows_per_second": count / took, "cpu_us_per_row": 1e6 * cpu_s / count}))


if __name__ == "__main__":
    main()
