-- How robots join the fleet. Of a join token's secret its hash alone is kept; it counts once.
CREATE TABLE join_tokens (
    id            TEXT    PRIMARY KEY,
    site          TEXT    NOT NULL,
    -- The robot that it is for; NULL for any that is new to the site.
    robot         TEXT,
    lookup        BLOB    NOT NULL UNIQUE CHECK (length(lookup) = 8),
    hash          BLOB    NOT NULL CHECK (length(hash) = 32),
    created_at_us INTEGER NOT NULL,
    created_by    TEXT    NOT NULL,
    expires_at_us INTEGER NOT NULL,
    used_at_us    INTEGER,
    used_by       TEXT,
    revoked_at_us INTEGER,
    CHECK ((used_at_us IS NULL) = (used_by IS NULL))
) STRICT, WITHOUT ROWID;

-- Each time that a robot joined. Only the newest one counts, unless it was revoked.
CREATE TABLE enrolments (
    site           TEXT    NOT NULL,
    robot          TEXT    NOT NULL,
    number         INTEGER NOT NULL CHECK (number >= 1),
    enrolled_at_us INTEGER NOT NULL,
    join_token     TEXT    NOT NULL,
    renewed_at_us  INTEGER NOT NULL,
    expires_at_us  INTEGER NOT NULL,
    revoked_at_us  INTEGER,
    revoked_by     TEXT,
    PRIMARY KEY (site, robot, number),
    CHECK ((revoked_at_us IS NULL) = (revoked_by IS NULL))
) STRICT, WITHOUT ROWID;

CREATE UNIQUE INDEX enrolments_in_force ON enrolments (site, robot) WHERE revoked_at_us IS NULL;
