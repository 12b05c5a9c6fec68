-- Sites, terrains, robots, missions, and what robots measured.
--
-- Times are microseconds since 1970, UTC (`_us`). UUIDs are text. What is only handed through
-- (models, trajectories, polygons, measurements) is JSON text of the types in `api`.

CREATE TABLE sites (
    pk               INTEGER PRIMARY KEY,
    id               TEXT    NOT NULL UNIQUE,
    name             TEXT    NOT NULL,
    grid_revision    INTEGER NOT NULL CHECK (grid_revision >= 1),
    cell_m           REAL    NOT NULL CHECK (cell_m > 0),
    terrain_revision INTEGER NOT NULL DEFAULT 0,
    created_at_us    INTEGER NOT NULL
) STRICT;

-- The terrains that are drawn now.
CREATE TABLE terrains (
    site_pk       INTEGER NOT NULL REFERENCES sites (pk),
    id            TEXT    NOT NULL,
    revision      INTEGER NOT NULL CHECK (revision >= 1),
    name          TEXT    NOT NULL,
    class         TEXT    NOT NULL,
    polygon       TEXT    NOT NULL,
    layer         INTEGER NOT NULL,
    updated_at_us INTEGER NOT NULL,
    PRIMARY KEY (site_pk, id)
) STRICT;

-- Every revision that ever was: a measurement names the one it was made on, and a terrain that
-- is drawn again under an old name counts on from here.
CREATE TABLE terrain_revisions (
    site_pk       INTEGER NOT NULL REFERENCES sites (pk),
    id            TEXT    NOT NULL,
    revision      INTEGER NOT NULL CHECK (revision >= 1),
    class         TEXT    NOT NULL,
    polygon       TEXT    NOT NULL,
    layer         INTEGER NOT NULL,
    written_at_us INTEGER NOT NULL,
    PRIMARY KEY (site_pk, id, revision)
) STRICT;

-- Robot models with their tyres. The model is unknown while only measurements name it.
CREATE TABLE configurations (
    pk    INTEGER PRIMARY KEY,
    id    TEXT NOT NULL UNIQUE,
    model TEXT
) STRICT;

CREATE TABLE robots (
    pk               INTEGER PRIMARY KEY,
    site_pk          INTEGER NOT NULL REFERENCES sites (pk),
    id               TEXT    NOT NULL,
    configuration_pk INTEGER NOT NULL REFERENCES configurations (pk),
    agent_version    TEXT    NOT NULL,
    boot             TEXT    NOT NULL,
    first_seen_at_us INTEGER NOT NULL,
    last_hello_at_us INTEGER NOT NULL,
    UNIQUE (site_pk, id)
) STRICT;

-- The runs of agents: short names for what identifies a record.
CREATE TABLE boots (
    pk       INTEGER PRIMARY KEY,
    robot_pk INTEGER NOT NULL REFERENCES robots (pk),
    id       TEXT    NOT NULL,
    UNIQUE (robot_pk, id)
) STRICT;

CREATE TABLE missions (
    id              TEXT    PRIMARY KEY,
    robot_pk        INTEGER NOT NULL REFERENCES robots (pk),
    state           TEXT    NOT NULL CHECK (state IN (
        'queued', 'offered', 'active', 'paused', 'cancelling',
        'succeeded', 'failed', 'cancelled', 'rejected', 'expired')),
    reason          TEXT,
    revision        INTEGER NOT NULL CHECK (revision >= 1),
    plan_hash       TEXT    NOT NULL,
    trajectory      TEXT    NOT NULL,
    latest_start_us INTEGER,
    boot            TEXT,
    plan            TEXT,
    progress        TEXT,
    created_at_us   INTEGER NOT NULL,
    started_at_us   INTEGER,
    ended_at_us     INTEGER
) STRICT, WITHOUT ROWID;

-- A robot has at most one mission in hand, whatever any code believes.
CREATE UNIQUE INDEX missions_in_hand ON missions (robot_pk)
    WHERE state IN ('offered', 'active', 'paused', 'cancelling');
CREATE INDEX missions_queued ON missions (robot_pk, id) WHERE state = 'queued';
CREATE INDEX missions_of_robot ON missions (robot_pk, id);

CREATE TABLE mission_events (
    pk         INTEGER PRIMARY KEY,
    mission    TEXT    NOT NULL REFERENCES missions (id),
    at_us      INTEGER NOT NULL,
    actor      TEXT    NOT NULL CHECK (actor IN ('client', 'server', 'robot')),
    from_state TEXT,
    to_state   TEXT    NOT NULL,
    reason     TEXT
) STRICT;

CREATE INDEX mission_events_of_mission ON mission_events (mission, pk);

-- Mission reports that have been taken, so that one sent again is not taken twice.
CREATE TABLE reports_seen (
    boot_pk INTEGER NOT NULL REFERENCES boots (pk),
    seq     INTEGER NOT NULL,
    PRIMARY KEY (boot_pk, seq)
) STRICT, WITHOUT ROWID;

-- Raw measurements. `(boot, seq)` names one for ever. The terrain is `''` where none was drawn.
CREATE TABLE segments (
    pk             INTEGER PRIMARY KEY,
    boot_pk        INTEGER NOT NULL REFERENCES boots (pk),
    seq            INTEGER NOT NULL,
    robot_pk       INTEGER NOT NULL,
    site_pk        INTEGER NOT NULL,
    terrain        TEXT    NOT NULL,
    received_at_us INTEGER NOT NULL,
    measurement    TEXT    NOT NULL
) STRICT;

CREATE UNIQUE INDEX segments_identity ON segments (boot_pk, seq);
CREATE INDEX segments_of_robot ON segments (robot_pk);
CREATE INDEX segments_of_terrain ON segments (site_pk, terrain);

-- Sums of measurements per cell, ground, robot, configuration and hour of measuring.
--
-- Sums are fixed point, value = hi + lo / 2^32 with 0 <= lo < 2^32, so that they are the same to
-- the bit in whatever order segments arrive. A segment adds at most 5e11 to `hi`, so 1.8e7 of the
-- largest ones fit into one sum.
CREATE TABLE cell_sums (
    site_pk          INTEGER NOT NULL REFERENCES sites (pk),
    iy               INTEGER NOT NULL,
    ix               INTEGER NOT NULL,
    grid_revision    INTEGER NOT NULL,
    terrain          TEXT    NOT NULL,
    terrain_revision INTEGER NOT NULL,
    robot_pk         INTEGER NOT NULL REFERENCES robots (pk),
    configuration_pk INTEGER NOT NULL REFERENCES configurations (pk),
    epoch_h          INTEGER NOT NULL,
    information_hi   INTEGER NOT NULL,
    information_lo   INTEGER NOT NULL CHECK (information_lo BETWEEN 0 AND 4294967295),
    weighted_hi      INTEGER NOT NULL,
    weighted_lo      INTEGER NOT NULL CHECK (weighted_lo BETWEEN 0 AND 4294967295),
    segments         INTEGER NOT NULL,
    samples          INTEGER NOT NULL,
    mu_peak          REAL,
    newest_at_us     INTEGER NOT NULL,
    -- A robot's cells of one hour lie together, so what it uploads in one go changes few pages.
    PRIMARY KEY (robot_pk, epoch_h, iy, ix, terrain, terrain_revision, grid_revision, site_pk,
                 configuration_pk)
) STRICT, WITHOUT ROWID;

CREATE INDEX cell_sums_of_cell ON cell_sums (site_pk, iy, ix);
CREATE INDEX cell_sums_of_terrain ON cell_sums (site_pk, terrain, terrain_revision);
