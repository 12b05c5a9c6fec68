-- Segments that wait for the clock of their run are called deferred.
ALTER TABLE segments_aside RENAME TO deferred_segments;
DROP INDEX segments_aside_of_robot;
CREATE INDEX deferred_segments_of_robot ON deferred_segments (robot_pk);
