-- Raw measurements in typed columns, and a ledger of what is stored.
--
-- A range is a run of measurements with consecutive sequence numbers and consecutive keys that agree
-- in everything but their values. The ledger replaces the unique index on (boot_pk, seq): a
-- measurement that is sent again lies in a range. The terrain is `''` where none was drawn.
CREATE TABLE segment_ranges (
    first_pk         INTEGER PRIMARY KEY,
    last_pk          INTEGER NOT NULL,
    first_seq        INTEGER NOT NULL,
    last_seq         INTEGER NOT NULL,
    boot_pk          INTEGER NOT NULL REFERENCES boots (pk),
    robot_pk         INTEGER NOT NULL,
    site_pk          INTEGER NOT NULL,
    configuration_pk INTEGER NOT NULL,
    mission          TEXT,
    grid_revision    INTEGER NOT NULL,
    terrain          TEXT    NOT NULL,
    terrain_revision INTEGER NOT NULL,
    received_at_us   INTEGER NOT NULL,
    CHECK (last_pk >= first_pk AND last_seq - first_seq = last_pk - first_pk)
) STRICT;

CREATE UNIQUE INDEX segment_ranges_identity ON segment_ranges (boot_pk, first_seq);
CREATE INDEX segment_ranges_of_robot ON segment_ranges (robot_pk);
CREATE INDEX segment_ranges_of_terrain ON segment_ranges (site_pk, terrain);

-- Values of the measurements; each key lies in one range. Times are nanoseconds since 1970.
CREATE TABLE segment_values (
    pk                      INTEGER PRIMARY KEY,
    started_at_ns           INTEGER NOT NULL,
    ended_at_ns             INTEGER NOT NULL,
    ix                      INTEGER NOT NULL,
    iy                      INTEGER NOT NULL,
    theta_information       REAL    NOT NULL,
    theta_weighted          REAL    NOT NULL,
    independent_information REAL,
    robot_error_ratio       REAL,
    tyre_error_ratio        REAL,
    track_information       REAL,
    track_weighted          REAL,
    rolling_information     REAL,
    rolling_weighted        REAL,
    mu_peak_lower_bound     REAL,
    samples                 INTEGER NOT NULL,
    distance_m              REAL    NOT NULL,
    saturation_ratio        REAL    NOT NULL
) STRICT;

ALTER TABLE segments RENAME TO segments_as_json;

-- Measurements name the configuration by its key.
INSERT INTO configurations (id)
SELECT DISTINCT measurement ->> '$.configuration' FROM segments_as_json WHERE true
ON CONFLICT DO NOTHING;

WITH named AS (
    SELECT pk, seq, boot_pk, robot_pk, site_pk, terrain, received_at_us,
        measurement ->> '$.configuration' AS configuration,
        measurement ->> '$.mission' AS mission,
        measurement ->> '$.grid_revision' AS grid_revision,
        COALESCE(measurement ->> '$.terrain.revision', 0) AS terrain_revision
    FROM segments_as_json
),
marked AS (
    SELECT *, (pk, seq, boot_pk, robot_pk, site_pk, terrain, received_at_us, configuration, mission,
            grid_revision, terrain_revision) IS NOT (LAG(pk) OVER keys + 1, LAG(seq) OVER keys + 1,
            LAG(boot_pk) OVER keys, LAG(robot_pk) OVER keys, LAG(site_pk) OVER keys,
            LAG(terrain) OVER keys, LAG(received_at_us) OVER keys, LAG(configuration) OVER keys,
            LAG(mission) OVER keys, LAG(grid_revision) OVER keys, LAG(terrain_revision) OVER keys)
        AS is_first
    FROM named WINDOW keys AS (ORDER BY pk)
),
numbered AS (
    SELECT *, SUM(is_first) OVER (ORDER BY pk ROWS UNBOUNDED PRECEDING) AS number FROM marked
)
INSERT INTO segment_ranges (first_pk, last_pk, first_seq, last_seq, boot_pk, robot_pk, site_pk,
    configuration_pk, mission, grid_revision, terrain, terrain_revision, received_at_us)
SELECT MIN(pk), MAX(pk), MIN(seq), MAX(seq), boot_pk, robot_pk, site_pk,
    (SELECT configurations.pk FROM configurations WHERE configurations.id = configuration),
    mission, grid_revision, terrain, terrain_revision, received_at_us
FROM numbered GROUP BY number;

-- `unixepoch` rounds a fraction of a second, so it is added from the text. Times before 1677 or after
-- 2262, which wrong clocks gave, become the first and the last second that fit.
INSERT INTO segment_values
SELECT pk,
    MIN(MAX(COALESCE(unixepoch(substr(started_at, 1, 19)), -9223372036), -9223372036), 9223372035)
            * 1000000000
        + iif(substr(started_at, 20, 1) = '.',
            CAST(substr(rtrim(substr(started_at, 21), 'Z') || '000000000', 1, 9) AS INTEGER), 0),
    MIN(MAX(COALESCE(unixepoch(substr(ended_at, 1, 19)), -9223372036), -9223372036), 9223372035)
            * 1000000000
        + iif(substr(ended_at, 20, 1) = '.',
            CAST(substr(rtrim(substr(ended_at, 21), 'Z') || '000000000', 1, 9) AS INTEGER), 0),
    measurement ->> '$.cell.ix', measurement ->> '$.cell.iy',
    measurement ->> '$.theta.information', measurement ->> '$.theta.weighted',
    measurement ->> '$.theta_errors.independent_information',
    measurement ->> '$.theta_errors.robot_ratio', measurement ->> '$.theta_errors.tyre_ratio',
    measurement ->> '$.effective_track_ratio.information',
    measurement ->> '$.effective_track_ratio.weighted',
    measurement ->> '$.rolling_resistance.information',
    measurement ->> '$.rolling_resistance.weighted',
    measurement ->> '$.mu_peak_lower_bound', measurement ->> '$.samples',
    measurement ->> '$.distance_m', measurement ->> '$.saturation_ratio'
FROM (SELECT pk, measurement, measurement ->> '$.started_at' AS started_at,
        measurement ->> '$.ended_at' AS ended_at
    FROM segments_as_json);

DROP TABLE segments_as_json;

-- All measurements with their identities, for readers.
CREATE VIEW segments AS
SELECT segment_values.pk, segment_ranges.boot_pk,
    segment_ranges.first_seq + segment_values.pk - segment_ranges.first_pk AS seq,
    segment_ranges.robot_pk, segment_ranges.site_pk, segment_ranges.configuration_pk,
    segment_ranges.mission, segment_ranges.grid_revision, segment_ranges.terrain,
    segment_ranges.terrain_revision, segment_ranges.received_at_us, started_at_ns, ended_at_ns, ix,
    iy, theta_information, theta_weighted, independent_information, robot_error_ratio,
    tyre_error_ratio, track_information, track_weighted, rolling_information, rolling_weighted,
    mu_peak_lower_bound, samples, distance_m, saturation_ratio
FROM segment_ranges CROSS JOIN segment_values
    ON segment_values.pk BETWEEN segment_ranges.first_pk AND segment_ranges.last_pk;
