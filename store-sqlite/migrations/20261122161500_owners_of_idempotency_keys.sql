-- A key belongs to the token or person that sends it: nobody learns or takes what another has used. The
-- answers of before have no owner, and count for whoever sends the same request again.
CREATE TABLE owned_idempotency_keys (
    owner         TEXT    NOT NULL,
    key           TEXT    NOT NULL,
    request_hash  TEXT    NOT NULL,
    answer        TEXT    NOT NULL,
    created_at_us INTEGER NOT NULL,
    PRIMARY KEY (owner, key)
) STRICT, WITHOUT ROWID;

INSERT INTO owned_idempotency_keys (owner, key, request_hash, answer, created_at_us)
    SELECT '', key, request_hash, answer, created_at_us FROM idempotency_keys;

DROP TABLE idempotency_keys;
ALTER TABLE owned_idempotency_keys RENAME TO idempotency_keys;
CREATE INDEX idempotency_keys_by_age ON idempotency_keys (created_at_us);
