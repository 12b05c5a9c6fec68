-- What a robot makes the server keep is bounded for each robot.

-- The configurations that a robot has measured with; their sums are kept for ever.
CREATE TABLE measured_configurations (
    robot_pk         INTEGER NOT NULL REFERENCES robots (pk),
    configuration_pk INTEGER NOT NULL REFERENCES configurations (pk),
    PRIMARY KEY (robot_pk, configuration_pk)
) STRICT, WITHOUT ROWID;

INSERT INTO measured_configurations (robot_pk, configuration_pk)
SELECT DISTINCT robot_pk, configuration_pk FROM cell_sums;

-- A configuration that nobody has any more, and nobody measured with, is found by these: its place
-- is taken by the next one.
CREATE INDEX measured_by_configuration ON measured_configurations (configuration_pk);
CREATE INDEX robots_by_configuration ON robots (configuration_pk);
