-- Keys of the measurements that were archived without a gap, so that a missing file is noticed.
CREATE TABLE archive_mark (
    id       BIGINT PRIMARY KEY CHECK (id = 1),
    first_pk BIGINT NOT NULL CHECK (first_pk >= 1),
    last_pk  BIGINT NOT NULL CHECK (last_pk >= first_pk)
);

-- Values of measurements are in partitions by key, since retention drops whole partitions.
DROP VIEW segments;
ALTER TABLE segment_values RENAME TO segment_values_0;
ALTER INDEX segment_values_pkey RENAME TO segment_values_0_pkey;
CREATE TABLE segment_values (
    LIKE segment_values_0 INCLUDING CONSTRAINTS,
    PRIMARY KEY (pk)
) PARTITION BY RANGE (pk);

-- Partitions of segment_values: `segment_values_N`, where N is the first key.
CREATE TABLE segment_partitions (
    first_pk BIGINT PRIMARY KEY,
    last_pk  BIGINT NOT NULL CHECK (last_pk >= first_pk)
);

DO $$
DECLARE
    newest BIGINT;
BEGIN
    SELECT MAX(pk) INTO newest FROM segment_values_0;
    IF newest IS NULL THEN
        DROP TABLE segment_values_0;
    ELSE
        EXECUTE format(
            'ALTER TABLE segment_values ATTACH PARTITION segment_values_0 FOR VALUES FROM (0) TO (%s)',
            newest + 1);
        INSERT INTO segment_partitions (first_pk, last_pk) VALUES (0, newest);
    END IF;
END
$$;

-- The offset makes PostgreSQL read the values of each range by their index, whatever sizes it assumes.
CREATE VIEW segments AS
SELECT measured.pk, segment_ranges.boot_pk,
    segment_ranges.first_seq + measured.pk - segment_ranges.first_pk AS seq,
    segment_ranges.robot_pk, segment_ranges.site_pk, segment_ranges.configuration_pk,
    segment_ranges.mission, segment_ranges.grid_revision, segment_ranges.terrain,
    segment_ranges.terrain_revision, segment_ranges.received_at_us, started_at_ns, ended_at_ns, ix,
    iy, theta_information, theta_weighted, independent_information, robot_error_ratio,
    tyre_error_ratio, track_information, track_weighted, rolling_information, rolling_weighted,
    mu_peak_lower_bound, samples, distance_m, saturation_ratio
FROM segment_ranges CROSS JOIN LATERAL (
    SELECT * FROM segment_values
    WHERE segment_values.pk BETWEEN segment_ranges.first_pk AND segment_ranges.last_pk
    OFFSET 0
) AS measured;
