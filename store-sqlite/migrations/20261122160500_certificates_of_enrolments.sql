-- JSON list of the SHA-256 of those certificates that count for a renewal, oldest first: the one that the
-- robot showed last, and those that were signed since. NULL for any of an authority that is trusted.
ALTER TABLE enrolments ADD COLUMN certificates TEXT
    CHECK (certificates IS NULL OR json_array_length(certificates) > 0);
