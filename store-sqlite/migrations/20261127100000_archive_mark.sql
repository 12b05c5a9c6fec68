-- Keys of the measurements that were archived without a gap, so that a missing file is noticed.
CREATE TABLE archive_mark (
    id       INTEGER PRIMARY KEY CHECK (id = 1),
    first_pk INTEGER NOT NULL CHECK (first_pk >= 1),
    last_pk  INTEGER NOT NULL CHECK (last_pk >= first_pk)
) STRICT;
