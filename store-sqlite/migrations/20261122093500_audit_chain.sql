-- Entries of the audit log are chained by hash, and repeats of the same request are one entry.
-- What is there already has no hash: the chain begins after it.
ALTER TABLE audit ADD COLUMN since_us INTEGER;
ALTER TABLE audit ADD COLUMN count INTEGER NOT NULL DEFAULT 1 CHECK (count >= 1);
ALTER TABLE audit ADD COLUMN previous_hash TEXT;
ALTER TABLE audit ADD COLUMN hash TEXT;

-- What frames the chain: the last entry that is gone or has no hash, and the newest one.
CREATE TABLE audit_chain (
    id          INTEGER PRIMARY KEY CHECK (id = 1),
    before_id   INTEGER NOT NULL,
    before_hash TEXT    NOT NULL,
    last_id     INTEGER NOT NULL,
    last_hash   TEXT    NOT NULL
) STRICT;

INSERT INTO audit_chain (id, before_id, before_hash, last_id, last_hash)
SELECT 1, number, hash, number, hash
FROM (SELECT COALESCE((SELECT seq FROM sqlite_sequence WHERE name = 'audit'), 0) AS number,
             '0000000000000000000000000000000000000000000000000000000000000000' AS hash);
