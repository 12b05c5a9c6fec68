-- What a restored backup leaves open, and which versions of the server have written this database.

-- Each restoration of a backup; the newest is the last.
CREATE TABLE restorations (
    pk              INTEGER PRIMARY KEY,
    restored_at_us  INTEGER NOT NULL,
    -- Time of the backup. What happened between the two is not in this database.
    taken_at_us     INTEGER NOT NULL,
    -- Version of the server that made the backup.
    version         TEXT    NOT NULL,
    -- Revisions of terrains and numbers of enrolments up to these may have been given meanwhile.
    revision_floor  INTEGER NOT NULL,
    enrolment_floor INTEGER NOT NULL
) STRICT;

-- Since when nothing is dispatched to a robot, until an operator releases it; NULL for the others.
ALTER TABLE robots ADD COLUMN awaits_release_since_us INTEGER;
-- Whether a robot is to say how its open missions ended before anything is decided about them.
ALTER TABLE robots ADD COLUMN outcomes_wanted INTEGER NOT NULL DEFAULT 0
    CHECK (outcomes_wanted IN (0, 1));
CREATE INDEX robots_restrained ON robots (pk)
    WHERE awaits_release_since_us IS NOT NULL OR outcomes_wanted = 1;

-- Versions of the server that have opened this database: an older one can say which to install.
CREATE TABLE server_versions (
    pk           INTEGER PRIMARY KEY,
    version      TEXT    NOT NULL,
    opened_at_us INTEGER NOT NULL
) STRICT;
