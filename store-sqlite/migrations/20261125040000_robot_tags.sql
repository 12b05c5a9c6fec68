-- Tags by which people sort out a fleet: a JSON list, sorted.
ALTER TABLE robots ADD COLUMN tags TEXT NOT NULL DEFAULT '[]';
