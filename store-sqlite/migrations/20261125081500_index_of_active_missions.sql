-- The index says what it holds: a robot has at most one mission that is active or about to be.
DROP INDEX missions_in_hand;
CREATE UNIQUE INDEX missions_active ON missions (robot_pk)
    WHERE state IN ('offered', 'active', 'paused', 'cancelling');
