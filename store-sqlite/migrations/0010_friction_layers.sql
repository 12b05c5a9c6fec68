-- The map's other layers, the scatter and the newest pass of each sum, merged epochs, withdrawals,
-- and measurements whose time is not known yet.

-- Fixed point like the others: sum of information * theta^2, then track ratio, rolling resistance.
ALTER TABLE cell_sums ADD COLUMN square_hi INTEGER NOT NULL DEFAULT 0;
ALTER TABLE cell_sums ADD COLUMN square_lo INTEGER NOT NULL DEFAULT 0;
ALTER TABLE cell_sums ADD COLUMN track_information_hi INTEGER NOT NULL DEFAULT 0;
ALTER TABLE cell_sums ADD COLUMN track_information_lo INTEGER NOT NULL DEFAULT 0;
ALTER TABLE cell_sums ADD COLUMN track_weighted_hi INTEGER NOT NULL DEFAULT 0;
ALTER TABLE cell_sums ADD COLUMN track_weighted_lo INTEGER NOT NULL DEFAULT 0;
ALTER TABLE cell_sums ADD COLUMN rolling_information_hi INTEGER NOT NULL DEFAULT 0;
ALTER TABLE cell_sums ADD COLUMN rolling_information_lo INTEGER NOT NULL DEFAULT 0;
ALTER TABLE cell_sums ADD COLUMN rolling_weighted_hi INTEGER NOT NULL DEFAULT 0;
ALTER TABLE cell_sums ADD COLUMN rolling_weighted_lo INTEGER NOT NULL DEFAULT 0;
-- The newest pass by itself; NULL in sums from before this was kept.
ALTER TABLE cell_sums ADD COLUMN newest_information REAL;
ALTER TABLE cell_sums ADD COLUMN newest_weighted REAL;
ALTER TABLE cell_sums ADD COLUMN newest_mu REAL;

-- What was summed before shows no scatter: it was not kept.
UPDATE cell_sums SET
    square_hi = CAST(square AS INTEGER),
    square_lo = CAST((square - CAST(square AS INTEGER)) * 4294967296.0 AS INTEGER)
FROM (
    SELECT s.robot_pk AS r, s.epoch_h AS e, s.iy AS y, s.ix AS x, s.terrain AS t,
        s.terrain_revision AS tr, s.grid_revision AS gr, s.site_pk AS sp,
        s.configuration_pk AS c,
        (s.weighted_hi + s.weighted_lo / 4294967296.0)
            * (s.weighted_hi + s.weighted_lo / 4294967296.0)
            / (s.information_hi + s.information_lo / 4294967296.0) AS square
    FROM cell_sums s WHERE s.information_hi > 0 OR s.information_lo > 0)
WHERE robot_pk = r AND epoch_h = e AND iy = y AND ix = x AND terrain = t
    AND terrain_revision = tr AND grid_revision = gr AND site_pk = sp AND configuration_pk = c;

-- The map is read from memory; these served reading.
DROP INDEX cell_sums_of_cell;
DROP INDEX cell_sums_of_terrain;

-- Hours before this one, a multiple of 24, are read as days and merged by and by.
ALTER TABLE sites ADD COLUMN merged_before_h INTEGER NOT NULL DEFAULT 0
    CHECK (merged_before_h % 24 = 0);

-- Whose measurements of which hours do not count, both ends included; what comes late does not
-- count either.
CREATE TABLE withdrawals (
    pk              INTEGER PRIMARY KEY,
    robot_pk        INTEGER NOT NULL REFERENCES robots (pk),
    from_h          INTEGER NOT NULL,
    to_h            INTEGER NOT NULL CHECK (to_h >= from_h),
    reason          TEXT    NOT NULL,
    withdrawn_by    TEXT    NOT NULL,
    withdrawn_at_us INTEGER NOT NULL
) STRICT;

CREATE INDEX withdrawals_of_robot ON withdrawals (robot_pk, pk);

-- Measurements from a time that has not come, of runs whose clock is not known: kept until it is.
CREATE TABLE segments_aside (
    boot_pk        INTEGER NOT NULL REFERENCES boots (pk),
    seq            INTEGER NOT NULL,
    site_pk        INTEGER NOT NULL REFERENCES sites (pk),
    robot_pk       INTEGER NOT NULL REFERENCES robots (pk),
    ended_at_us    INTEGER NOT NULL,
    received_at_us INTEGER NOT NULL,
    measurement    TEXT    NOT NULL,
    PRIMARY KEY (boot_pk, seq)
) STRICT, WITHOUT ROWID;

CREATE INDEX segments_aside_of_robot ON segments_aside (robot_pk);

-- What a robot sent and the server will never take, counted for each robot.
ALTER TABLE robots ADD COLUMN segments_refused INTEGER NOT NULL DEFAULT 0;
ALTER TABLE robots ADD COLUMN segments_refused_why TEXT;
