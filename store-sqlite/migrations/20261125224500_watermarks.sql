-- Sums of cells are stored behind the receipts. A row says up to which raw measurement, in the order
-- of `segments.pk`, a robot's measurements are in `cell_sums`; those that follow are added when the
-- server starts. A robot without a row has none in the sums.
CREATE TABLE watermarks (
    robot_pk   INTEGER PRIMARY KEY REFERENCES robots (pk),
    segment_pk INTEGER NOT NULL CHECK (segment_pk >= 0)
) STRICT;

-- Until now each measurement was added in the transaction that stored it.
INSERT INTO watermarks (robot_pk, segment_pk)
SELECT pk, (SELECT COALESCE(MAX(pk), 0) FROM segments) FROM robots;
