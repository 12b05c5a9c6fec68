-- Where an alert is and of which mission it is; webhooks, and the outbox of what they are to be sent.

ALTER TABLE alerts ADD COLUMN mission_id TEXT;
ALTER TABLE alerts ADD COLUMN x_m REAL;
ALTER TABLE alerts ADD COLUMN y_m REAL;

CREATE TABLE webhooks (
    id            TEXT    PRIMARY KEY,
    name          TEXT    NOT NULL UNIQUE,
    url           TEXT    NOT NULL,
    -- In clear text, since deliveries are signed with it.
    secret        TEXT    NOT NULL,
    -- JSON list of codes of alerts; NULL for all.
    kinds         TEXT    CHECK (kinds IS NULL OR json_array_length(kinds) > 0),
    -- JSON list of sites; NULL for all.
    sites         TEXT    CHECK (sites IS NULL OR json_array_length(sites) > 0),
    enabled       INTEGER NOT NULL CHECK (enabled IN (0, 1)),
    created_at_us INTEGER NOT NULL,
    created_by    TEXT    NOT NULL
) STRICT, WITHOUT ROWID;

-- Outbox and log in one: a row is written in the transaction of its alert and stays until newer ones
-- take its place in the log.
CREATE TABLE webhook_deliveries (
    id                 TEXT    PRIMARY KEY,
    webhook_id         TEXT    NOT NULL REFERENCES webhooks (id) ON DELETE CASCADE,
    -- NULL for a test. Alerts about the server itself are not in the database.
    alert_id           TEXT,
    event              TEXT    NOT NULL CHECK (event IN ('opened', 'ended', 'test')),
    kind               TEXT    NOT NULL,
    body               TEXT    NOT NULL,
    state              TEXT    NOT NULL CHECK (state IN ('pending', 'delivered', 'failed', 'dropped')),
    created_at_us      INTEGER NOT NULL,
    -- When it is sent next, while it is pending.
    due_at_us          INTEGER NOT NULL,
    attempts           INTEGER NOT NULL DEFAULT 0 CHECK (attempts >= 0),
    last_attempt_at_us INTEGER,
    -- HTTP status of the last attempt, if there was an answer.
    status             INTEGER,
    detail             TEXT,
    ended_at_us        INTEGER,
    CHECK ((state = 'pending') = (ended_at_us IS NULL))
) STRICT, WITHOUT ROWID;

CREATE INDEX webhook_deliveries_of_webhook ON webhook_deliveries (webhook_id, id);
CREATE INDEX webhook_deliveries_pending ON webhook_deliveries (webhook_id, id)
    WHERE state = 'pending';
