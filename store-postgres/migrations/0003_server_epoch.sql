-- Counts the servers that have taken this database over. One that was taken over itself writes no more.
CREATE TABLE server_epoch (
    id    BIGINT PRIMARY KEY CHECK (id = 1),
    epoch BIGINT NOT NULL CHECK (epoch >= 0)
);
INSERT INTO server_epoch (id, epoch) VALUES (1, 0);

-- Called when a server begins to write.
CREATE FUNCTION check_server_epoch(own BIGINT) RETURNS VOID LANGUAGE plpgsql AS $$
BEGIN
    IF NOT EXISTS (SELECT FROM server_epoch WHERE epoch = own) THEN
        RAISE EXCEPTION 'another server has taken over this database' USING ERRCODE = 'TR001';
    END IF;
END
$$;
