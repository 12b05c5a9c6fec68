-- Stops, each of one robot, and the geofences of sites.

-- What a person, a program or the robot itself stopped. A stop is wanted until its robot has
-- confirmed it, and in force until it is cleared; it is sent again for as long as it is wanted.
CREATE TABLE stops (
    id              TEXT    PRIMARY KEY,
    robot_pk        INTEGER NOT NULL REFERENCES robots (pk),
    stopped_by      TEXT    NOT NULL,
    reason          TEXT    NOT NULL,
    wanted_at_us    INTEGER NOT NULL,
    confirmed_at_us INTEGER,
    -- Somebody asked the robot to clear it. Written before the robot hears of it, so that a robot
    -- that no longer shows a stop which nobody cleared is told again.
    clear_asked_by  TEXT,
    clear_asked_at_us INTEGER,
    cleared_at_us   INTEGER
) STRICT, WITHOUT ROWID;

CREATE INDEX stops_of_robot ON stops (robot_pk, id);
CREATE INDEX stops_in_force ON stops (robot_pk) WHERE cleared_at_us IS NULL;

-- Every geofence that ever was; the highest revision counts.
CREATE TABLE geofences (
    site_pk       INTEGER NOT NULL REFERENCES sites (pk),
    revision      INTEGER NOT NULL CHECK (revision >= 1),
    keep_in       TEXT    NOT NULL,
    keep_out      TEXT    NOT NULL,
    written_at_us INTEGER NOT NULL,
    PRIMARY KEY (site_pk, revision)
) STRICT, WITHOUT ROWID;
