-- A session belongs to a token, or to a person who signed in at an OpenID provider. What a person may do
-- comes from the groups, by the configuration in force. Sessions that there are stay.
CREATE TABLE sessions_of_all (
    id              TEXT    PRIMARY KEY,
    token_id        TEXT    REFERENCES tokens (id),
    -- Of issuer and subject.
    person_id       TEXT,
    issuer          TEXT,
    subject         TEXT,
    name            TEXT,
    -- JSON list of the groups that gave rights at the sign-in.
    groups          TEXT    CHECK (groups IS NULL OR json_array_length(groups) > 0),
    lookup          BLOB    NOT NULL UNIQUE CHECK (length(lookup) = 8),
    hash            BLOB    NOT NULL CHECK (length(hash) = 32),
    created_at_us   INTEGER NOT NULL,
    expires_at_us   INTEGER NOT NULL,
    -- Of people alone: a token has its own.
    last_used_at_us INTEGER,
    CHECK ((token_id IS NULL) <> (person_id IS NULL)),
    CHECK ((person_id IS NULL) = (issuer IS NULL)),
    CHECK ((person_id IS NULL) = (subject IS NULL)),
    CHECK ((person_id IS NULL) = (name IS NULL)),
    CHECK ((person_id IS NULL) = (groups IS NULL))
) STRICT, WITHOUT ROWID;

INSERT INTO sessions_of_all (id, token_id, lookup, hash, created_at_us, expires_at_us)
SELECT id, token_id, lookup, hash, created_at_us, expires_at_us FROM sessions;

DROP TABLE sessions;
ALTER TABLE sessions_of_all RENAME TO sessions;

CREATE INDEX sessions_of_token ON sessions (token_id, id);
CREATE INDEX sessions_of_person ON sessions (person_id, id);
CREATE INDEX sessions_by_expiry ON sessions (expires_at_us);

-- JSON of the person behind an entry, who had signed in at a provider.
ALTER TABLE audit ADD COLUMN person TEXT;
