-- What a standby reads of the server that has this database: the address at which other servers reach its REST
-- API, and the number of writes that changed a site, terrain or robot.
ALTER TABLE server_epoch ADD COLUMN advertise_url TEXT;
ALTER TABLE server_epoch ADD COLUMN generation BIGINT NOT NULL DEFAULT 0;
