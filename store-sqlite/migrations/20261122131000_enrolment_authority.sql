-- SHA-256 of the authority that signed the certificate which the robot showed last. NULL for robots
-- that have shown none since this is noted.
ALTER TABLE enrolments ADD COLUMN authority TEXT;
