-- Whether a robot was on the network when the server looked last, and had not left by itself: kept
-- so that one that goes away while the server is down is missed afterwards.
ALTER TABLE robots ADD COLUMN is_present INTEGER NOT NULL DEFAULT 0 CHECK (is_present IN (0, 1));
