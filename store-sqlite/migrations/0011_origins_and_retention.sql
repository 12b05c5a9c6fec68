-- Where sites lie on the earth, and which raw measurements were removed.

-- JSON of `GeoOrigin`; NULL for a site that is tied to nothing.
ALTER TABLE sites ADD COLUMN origin TEXT;

-- Numbers of raw measurements that were removed after their time, both ends included: one that is
-- sent again is known all the same, and counted once for ever.
CREATE TABLE segments_removed (
    boot_pk  INTEGER NOT NULL REFERENCES boots (pk),
    from_seq INTEGER NOT NULL,
    to_seq   INTEGER NOT NULL CHECK (to_seq >= from_seq),
    PRIMARY KEY (boot_pk, from_seq)
) STRICT, WITHOUT ROWID;
