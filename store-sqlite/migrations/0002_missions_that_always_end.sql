-- Pause, replace, priority and lost robots; quality reports; robots' names, abilities and alerts;
-- idempotency keys.

ALTER TABLE missions ADD COLUMN cause TEXT NOT NULL DEFAULT 'noted';
ALTER TABLE missions ADD COLUMN pause_wanted INTEGER NOT NULL DEFAULT 0
    CHECK (pause_wanted IN (0, 1));
ALTER TABLE missions ADD COLUMN priority INTEGER NOT NULL DEFAULT 0;
ALTER TABLE missions ADD COLUMN link_policy TEXT NOT NULL DEFAULT '"continue"';
ALTER TABLE missions ADD COLUMN lost_after_s REAL CHECK (lost_after_s > 0);
-- A new revision that the robot does not hold whole yet.
ALTER TABLE missions ADD COLUMN replacement TEXT;
-- Since when the robot has not been heard, while the mission is in hand. Kept here so that the
-- bound of a lost robot runs on over a restart of the server.
ALTER TABLE missions ADD COLUMN silent_since_us INTEGER;
ALTER TABLE missions ADD COLUMN quality TEXT;
ALTER TABLE missions ADD COLUMN driven TEXT;

DROP INDEX missions_queued;
CREATE INDEX missions_queued ON missions (robot_pk, priority DESC, id) WHERE state = 'queued';

ALTER TABLE mission_events ADD COLUMN cause TEXT NOT NULL DEFAULT 'noted';

ALTER TABLE robots ADD COLUMN name TEXT;
ALTER TABLE robots ADD COLUMN retired_at_us INTEGER;
ALTER TABLE robots ADD COLUMN capabilities TEXT NOT NULL DEFAULT '{}';

CREATE TABLE alerts (
    id                 TEXT    PRIMARY KEY,
    robot_pk           INTEGER NOT NULL REFERENCES robots (pk),
    code               TEXT    NOT NULL,
    severity           TEXT    NOT NULL CHECK (severity IN ('warning', 'critical')),
    text               TEXT    NOT NULL,
    raised_at_us       INTEGER NOT NULL,
    acknowledged_at_us INTEGER,
    cleared_at_us      INTEGER
) STRICT, WITHOUT ROWID;

-- What a robot says is raised once, however often it says so.
CREATE UNIQUE INDEX alerts_raised ON alerts (robot_pk, code) WHERE cleared_at_us IS NULL;
CREATE INDEX alerts_of_robot ON alerts (robot_pk, id);

-- Answers that were given under an idempotency key, so that the same request gets the same again.
CREATE TABLE idempotency_keys (
    key           TEXT    PRIMARY KEY,
    request_hash  TEXT    NOT NULL,
    answer        TEXT    NOT NULL,
    created_at_us INTEGER NOT NULL
) STRICT, WITHOUT ROWID;

CREATE INDEX idempotency_keys_by_age ON idempotency_keys (created_at_us);
