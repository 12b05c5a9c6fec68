-- A robot has at most one open stop: the newest one that was asked for or that came to it. One that
-- another has taken the place of names it; it is history, and nothing waits for it any more.
ALTER TABLE stops ADD COLUMN replaced_by TEXT;

CREATE INDEX stops_by_time ON stops (robot_pk, wanted_at_us);

UPDATE stops SET replaced_by = (
    SELECT newest.id FROM stops newest
    WHERE newest.robot_pk = stops.robot_pk AND newest.cleared_at_us IS NULL
    ORDER BY newest.wanted_at_us DESC, newest.id DESC LIMIT 1)
WHERE cleared_at_us IS NULL;
UPDATE stops SET replaced_by = NULL WHERE replaced_by = id;

DROP INDEX stops_in_force;
CREATE UNIQUE INDEX stops_in_force ON stops (robot_pk)
    WHERE cleared_at_us IS NULL AND replaced_by IS NULL;
