-- The errors of theta that segments of one robot, or of robots on the same tyres, have in common, as
-- shares of theta: sums of information times the share, in fixed point. 0 where nobody told them apart.

ALTER TABLE cell_sums ADD COLUMN robot_error_hi INTEGER NOT NULL DEFAULT 0;
ALTER TABLE cell_sums ADD COLUMN robot_error_lo INTEGER NOT NULL DEFAULT 0;
ALTER TABLE cell_sums ADD COLUMN tyre_error_hi INTEGER NOT NULL DEFAULT 0;
ALTER TABLE cell_sums ADD COLUMN tyre_error_lo INTEGER NOT NULL DEFAULT 0;
