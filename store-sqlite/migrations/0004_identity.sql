-- Who may do what. Secrets are never kept: a token is found by the hash of its secret.
CREATE TABLE tokens (
    id              TEXT    PRIMARY KEY,
    name            TEXT    NOT NULL,
    role            TEXT    NOT NULL CHECK (role IN ('viewer', 'operator', 'admin')),
    -- SHA-256 of the secret, whose first eight bytes are what it is looked up by.
    lookup          BLOB    NOT NULL UNIQUE CHECK (length(lookup) = 8),
    hash            BLOB    NOT NULL CHECK (length(hash) = 32),
    created_at_us   INTEGER NOT NULL,
    created_by      TEXT    NOT NULL,
    expires_at_us   INTEGER NOT NULL,
    revoked_at_us   INTEGER,
    last_used_at_us INTEGER
) STRICT, WITHOUT ROWID;

CREATE INDEX tokens_by_name ON tokens (name);

-- Browsers that signed in with a token; they end with it.
CREATE TABLE sessions (
    id            TEXT    PRIMARY KEY,
    token_id      TEXT    NOT NULL REFERENCES tokens (id),
    lookup        BLOB    NOT NULL UNIQUE CHECK (length(lookup) = 8),
    hash          BLOB    NOT NULL CHECK (length(hash) = 32),
    created_at_us INTEGER NOT NULL,
    expires_at_us INTEGER NOT NULL
) STRICT, WITHOUT ROWID;

CREATE INDEX sessions_of_token ON sessions (token_id, id);
CREATE INDEX sessions_by_expiry ON sessions (expires_at_us);

-- Who changed what, and who was refused. Numbers are not used again.
CREATE TABLE audit (
    id         INTEGER PRIMARY KEY AUTOINCREMENT,
    at_us      INTEGER NOT NULL,
    who        TEXT,
    token_id   TEXT,
    role       TEXT,
    address    TEXT    NOT NULL,
    method     TEXT    NOT NULL,
    route      TEXT    NOT NULL,
    path       TEXT    NOT NULL,
    status     INTEGER NOT NULL,
    request_id TEXT    NOT NULL,
    what       TEXT
) STRICT;

CREATE INDEX audit_by_time ON audit (at_us);
