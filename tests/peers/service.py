"""A plain server of segments, as one would write it in Python, to compare `load --peers` with.

It takes the payloads of Tread's robots at a zenoh router of its own and stores each segment once:
a unique index on run and sequence number, one commit for many uploads, sums of cells as floats in
memory, stored every few seconds. It checks nothing and knows no sites, clocks or retention.
"""

import argparse
import gc
import queue
import threading
import time

import orjson
import uvicorn
import zenoh
from fastapi import FastAPI
from sqlalchemy import (
    Column, Float, Index, Integer, MetaData, Table, Text, create_engine, event, func, select,
)
from sqlalchemy.dialects.sqlite import insert

RECORDS_PER_COMMIT_MAX = 5_000
# SQLite's module gives up the interpreter's lock for each statement, and waits for it again while
# payloads are decoded: one statement for many rows is several times as fast as one for each.
ROWS_PER_STATEMENT = 400
COMMIT_EVERY_S = 0.04
SUMS_EVERY_S = 10.0

# Columns that Tread's database has too are named as there, so that one statement counts both.
metadata = MetaData()
segments = Table(
    "segments", metadata,
    Column("pk", Integer, primary_key=True),
    Column("boot_pk", Text, nullable=False),
    Column("seq", Integer, nullable=False),
    Column("robot", Text, nullable=False),
    Column("terrain", Text, nullable=False),
    Column("ended_at", Text, nullable=False),
    Column("ix", Integer, nullable=False),
    Column("iy", Integer, nullable=False),
    Column("theta_information", Float, nullable=False),
    Column("theta_weighted", Float, nullable=False),
    Column("samples", Integer, nullable=False),
    Column("distance_m", Float, nullable=False),
    Column("saturation_ratio", Float, nullable=False),
    Index("segments_identity", "boot_pk", "seq", unique=True),
)
sums = Table(
    "cell_sums", metadata,
    Column("robot", Text, primary_key=True),
    Column("ix", Integer, primary_key=True),
    Column("iy", Integer, primary_key=True),
    Column("information", Float, nullable=False),
    Column("weighted", Float, nullable=False),
    Column("segments", Integer, nullable=False),
)


class Store:
    def __init__(self, path):
        self.engine = create_engine(f"sqlite:///{path}")

        @event.listens_for(self.engine, "connect")
        def configure(connection, _record):
            connection.execute("PRAGMA journal_mode = WAL")
            connection.execute("PRAGMA synchronous = FULL")

        metadata.create_all(self.engine)
        names = [column.name for column in segments.columns if column.name != "pk"]
        # The statement of Core, as a text: rows that are tuples take half the time of dictionaries.
        one = str(insert(segments).on_conflict_do_nothing().compile(
            dialect=self.engine.dialect, column_keys=names))
        before, after = one.split(" VALUES ")
        values, conflict = after.split(" ON ")
        self.insert_rows = lambda count: (
            f"{before} VALUES {', '.join([values] * count)} ON {conflict}")
        self.insert_full = self.insert_rows(ROWS_PER_STATEMENT)
        upsert = insert(sums)
        self.upsert = str(upsert.on_conflict_do_update(
            index_elements=["robot", "ix", "iy"],
            set_={name: upsert.excluded[name] for name in ("information", "weighted", "segments")},
        ).compile(dialect=self.engine.dialect))
        self.sums = {}
        self.changed = set()
        self.stored_sums_at = time.monotonic()

    def rows(self, batch):
        """Adds a batch to the sums, and returns the values of its rows one after another."""
        boot, robot = batch["boot"], batch["robot"]
        every, changed = self.sums, self.changed
        rows = []
        for record in batch["records"]:
            segment = record["content"]["segment"]
            cell, theta = segment["cell"], segment["theta"]
            ix, iy = cell["ix"], cell["iy"]
            information, weighted = theta["information"], theta["weighted"]
            rows += (
                boot, record["seq"], robot, segment["terrain"]["id"], segment["ended_at"], ix, iy,
                information, weighted, segment["samples"], segment["distance_m"],
                segment["saturation_ratio"],
            )
            key = (robot, ix, iy)
            known = every.get(key)
            if known is None:
                every[key] = [information, weighted, 1]
            else:
                known[0] += information
                known[1] += weighted
                known[2] += 1
            changed.add(key)
        return rows

    def store(self, batches):
        """Stores batches in one commit and returns how many segments of each were new."""
        counts, every = [], []
        for batch in batches:
            counts.append(len(batch["records"]))
            every += self.rows(batch)
        with self.engine.begin() as connection:
            if self.insert_all(connection, every) != sum(counts):
                raise RuntimeError("this service is measured with new segments alone")
        if time.monotonic() - self.stored_sums_at > SUMS_EVERY_S:
            self.store_sums()
        return counts

    def insert_all(self, connection, values):
        """Inserts rows whose values follow one another; returns how many were new."""
        length = len(segments.columns) - 1
        new = 0
        for begin in range(0, len(values), ROWS_PER_STATEMENT * length):
            some = tuple(values[begin:begin + ROWS_PER_STATEMENT * length])
            count = len(some) // length
            is_full = count == ROWS_PER_STATEMENT
            statement = self.insert_full if is_full else self.insert_rows(count)
            new += connection.exec_driver_sql(statement, some).rowcount
        return new

    def store_sums(self):
        rows = [(*key, *self.sums[key]) for key in self.changed]
        if rows:
            with self.engine.begin() as connection:
                connection.exec_driver_sql(self.upsert, rows)
        self.changed.clear()
        self.stored_sums_at = time.monotonic()


def write(store, uploads):
    while True:
        try:
            group = [uploads.get(timeout=SUMS_EVERY_S)]
        except queue.Empty:
            store.store_sums()
            continue
        records = len(group[0][1]["records"])
        begin = time.monotonic()
        while records < RECORDS_PER_COMMIT_MAX:
            wait = begin + COMMIT_EVERY_S - time.monotonic()
            try:
                group.append(uploads.get(timeout=max(wait, 0.0)))
            except queue.Empty:
                break
            records += len(group[-1][1]["records"])
        counts = store.store([batch for _, batch in group])
        for (query, _), count in zip(group, counts):
            receipt = {"v": 2, "body": {"committed": count, "duplicates": 0, "refused": []}}
            with query:
                query.reply(query.key_expr, orjson.dumps(receipt))


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--database", required=True)
    parser.add_argument("--endpoint", required=True, help="of zenoh, such as tcp/127.0.0.1:7447")
    parser.add_argument("--http-port", type=int, required=True)
    parser.add_argument("--welcome", required=True, help="file with the answer to every hello")
    arguments = parser.parse_args()

    # Payloads have no cycles, and looking for some takes half of the processor time.
    gc.disable()
    store = Store(arguments.database)
    uploads = queue.Queue(256)
    threading.Thread(target=write, args=(store, uploads), daemon=True).start()
    with open(arguments.welcome, "rb") as file:
        welcome = file.read()

    def answer(query):
        with query:
            query.reply(query.key_expr, welcome)

    def take(query):
        uploads.put((query, orjson.loads(query.payload.to_bytes())["body"]))

    config = zenoh.Config()
    config.insert_json5("mode", '"router"')
    config.insert_json5("listen/endpoints", f'["{arguments.endpoint}"]')
    config.insert_json5("scouting/multicast/enabled", "false")
    session = zenoh.open(config)
    session.declare_queryable("tread/*/server/hello/*", answer, complete=True)
    session.declare_queryable("tread/*/server/ingest/*", take, complete=True)

    app = FastAPI()

    @app.get("/counts")
    def counts():
        with store.engine.connect() as connection:
            stored = connection.scalar(select(func.count()).select_from(segments))
            in_sums = connection.scalar(select(func.sum(sums.c.segments)))
        return {"segments": stored, "in_sums": in_sums or 0}

    uvicorn.run(app, host="127.0.0.1", port=arguments.http_port, log_level="warning")


if __name__ == "__main__":
    main()
