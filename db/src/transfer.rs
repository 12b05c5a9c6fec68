//! Copies all tables of a database into an empty one, of the same engine or the other, and compares both.
//!
//! ```text
//! check the source ─► compare schemas ─► is it empty? ─► copy table by table ─► read it back, compare checksums ─► commit
//! ```
//!
//! A PostgreSQL database is written in one transaction, so that it remains empty if the copy fails. A
//! file is written in several, because its log would grow to the size of the database; the caller
//! removes the file if the copy fails.

pub use tread_store::transfer::Contents;
use tread_store::transfer::{Row, SEEDED_TABLES, Summary, Table, Value};

use super::{Db, DbError, Tx, forward};

/// Number of rows that are read and written at a time: from few, since a row of JSON may have megabytes,
/// to many, as long as they are small.
const CHUNK_ROWS: (u32, u32) = (64, 2_048);
/// Size of a chunk, bytes: a smaller one is followed by one of twice as many rows, one of four times this
/// size by a small one.
const CHUNK_BYTES: usize = 4 * 1024 * 1024;
/// Size of what was written after which a file commits, bytes.
const COMMIT_BYTES: usize = 128 * 1024 * 1024;

forward! {
    transfer;
    fn tables() -> Vec<Table>;
    fn count(table: &Table) -> u64;
    fn rows(table: &Table, after: Option<&[Value]>, limit: u32) -> Vec<Row>;
    fn disable_timeouts() -> ();
    fn clear(table: &Table) -> ();
    fn insert(table: &Table, rows: &[Row]) -> ();
    fn finish(tables: &[Table]) -> ();
}

/// Reason why a database was not copied.
#[derive(Debug, thiserror::Error)]
pub enum CopyError {
    /// The database that is copied cannot be read.
    #[error("cannot read the database that is copied, at table {table}")]
    Read {
        /// The table.
        table: String,
        /// The cause.
        #[source]
        cause: DbError,
    },
    /// The copy cannot be written, or read back.
    #[error("cannot write the copy, at table {table}")]
    Write {
        /// The table.
        table: String,
        /// The cause.
        #[source]
        cause: DbError,
    },
    /// The tables of both engines are not the same, which is a defect of this version.
    #[error("table {0} has other columns in the copy")]
    Schema(String),
    /// The target contains data.
    #[error("the target is not empty: table {0} has rows. Name a new database")]
    NotEmpty(String),
    /// The table was not read whole, since its index is damaged.
    #[error(
        "table {table} has {of} rows, of which {read} can be read in the order of its key: the database that \
         is copied is damaged"
    )]
    Incomplete {
        /// The table.
        table: String,
        /// Number of its rows.
        of: u64,
        /// Number of rows that were read.
        read: u64,
    },
    /// The database that is copied is damaged.
    #[error("the database that is copied is damaged: {0}")]
    Damaged(String),
    /// The copy does not contain what was read.
    #[error(
        "table {table} differs in the copy: {read} rows were read and {written} are in the copy{hint}"
    )]
    Differs {
        /// The table.
        table: String,
        /// Number of rows that were read.
        read: u64,
        /// Number of rows in the copy.
        written: u64,
        /// What else there is to say.
        hint: &'static str,
    },
}

/// Progress of a copy.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Progress {
    /// The table.
    pub table: String,
    /// Number of its rows that were handled.
    pub rows: u64,
    /// Number of its rows.
    pub of: u64,
    /// Whether the copy is being compared, after it was written.
    pub is_comparing: bool,
}

/// A table that was copied, and is the same in both databases.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Copied {
    /// Its name.
    pub table: String,
    /// Number and checksum of its rows.
    pub contents: Contents,
}

/// The target, which commits now and then if it is a file.
struct Target<'to> {
    database: &'to Db,
    tx: Tx,
    uncommitted: usize,
}

impl Target<'_> {
    async fn insert(mut self, table: &Table, rows: &[Row]) -> Result<Self, DbError> {
        insert(&mut self.tx, table, rows).await?;
        self.uncommitted += size_bytes(rows);
        if matches!(self.database, Db::Postgres(_)) || self.uncommitted < COMMIT_BYTES {
            return Ok(self);
        }
        let Self { database, tx, .. } = self;
        tx.commit().await?;
        database.checkpoint().await?;
        Ok(Self {
            database,
            tx: database.write("copy").await?,
            uncommitted: 0,
        })
    }
}

/// Databases of a copy.
#[derive(Debug, Clone, Copy)]
pub struct Databases<'db> {
    /// Database that is read.
    pub from: &'db Db,
    /// Database that is written.
    pub to: &'db Db,
}

/// Copies everything into a database that has the present schema and no rows. Calls `progress` now and
/// then.
///
/// # Errors
/// [`CopyError`]: a PostgreSQL database is unchanged then, a file contains a part.
pub async fn copy(
    Databases { from, to }: Databases<'_>,
    mut progress: impl FnMut(Progress),
) -> Result<Vec<Copied>, CopyError> {
    let (reading, writing) = (read_error("schema"), write_error("schema"));
    if let Some(found) = from.quick_check().await.map_err(&reading)? {
        return Err(CopyError::Damaged(found));
    }
    let mut source = from.read("copy").await.map_err(&reading)?;
    disable_timeouts(&mut source).await.map_err(&reading)?;
    let read_tables = tables(&mut source).await.map_err(&reading)?;
    let tx = to.write("copy").await.map_err(&writing)?;
    let mut target = Target {
        database: to,
        tx,
        uncommitted: 0,
    };
    disable_timeouts(&mut target.tx).await.map_err(&writing)?;
    let written_tables = tables(&mut target.tx).await.map_err(&writing)?;
    for (read, written) in read_tables.iter().zip(&written_tables) {
        if !written.takes_rows_of(read) {
            return Err(CopyError::Schema(read.name.clone()));
        }
        let failed = write_error(&read.name);
        let found = rows(&mut target.tx, written, None, 1).await;
        if found.map_err(&failed)?.is_empty() {
            continue;
        }
        if !SEEDED_TABLES.contains(&read.name.as_str()) {
            return Err(CopyError::NotEmpty(read.name.clone()));
        }
        clear(&mut target.tx, written).await.map_err(&failed)?;
    }
    let mut copied = Vec::with_capacity(read_tables.len());
    for (read, written) in read_tables.iter().zip(&written_tables) {
        let copying = copy_table((&mut source, read), (target, written), &mut progress).await?;
        target = copying.0;
        copied.push(Copied {
            table: read.name.clone(),
            contents: copying.1,
        });
    }
    finish(&mut target.tx, &written_tables)
        .await
        .map_err(&writing)?;
    for (one, written) in copied.iter().zip(&written_tables) {
        compare(&mut target.tx, (one, written), &mut progress).await?;
    }
    target.tx.commit().await.map_err(&writing)?;
    to.checkpoint().await.map_err(&writing)?;
    Ok(copied)
}

fn size_bytes(rows: &[Row]) -> usize {
    rows.iter().flatten().map(Value::size_bytes).sum()
}

/// Reads a table in chunks, in the order of its key.
struct Chunks<'table> {
    table: &'table Table,
    after: Option<Vec<Value>>,
    rows: u32,
}

impl<'table> Chunks<'table> {
    fn of(table: &'table Table) -> Self {
        Self {
            table,
            after: None,
            rows: CHUNK_ROWS.0,
        }
    }

    /// Returns the next rows; none after the last one.
    async fn next(&mut self, tx: &mut Tx) -> Result<Vec<Row>, DbError> {
        let chunk = rows(tx, self.table, self.after.as_deref(), self.rows).await?;
        if let Some(last) = chunk.last() {
            self.after = Some(self.table.key_of(last));
        }
        let bytes = size_bytes(&chunk);
        if bytes < CHUNK_BYTES {
            self.rows = self.rows.saturating_mul(2).min(CHUNK_ROWS.1);
        } else if bytes > 4 * CHUNK_BYTES {
            self.rows = CHUNK_ROWS.0;
        }
        Ok(chunk)
    }
}

fn read_error(table: &str) -> impl Fn(DbError) -> CopyError {
    let table = table.to_owned();
    move |cause| CopyError::Read {
        table: table.clone(),
        cause,
    }
}

fn write_error(table: &str) -> impl Fn(DbError) -> CopyError {
    let table = table.to_owned();
    move |cause| CopyError::Write {
        table: table.clone(),
        cause,
    }
}

async fn copy_table<'to>(
    (source, read): (&mut Tx, &Table),
    (mut target, written): (Target<'to>, &Table),
    progress: &mut impl FnMut(Progress),
) -> Result<(Target<'to>, Contents), CopyError> {
    let (reading, writing) = (read_error(&read.name), write_error(&read.name));
    let of = count(source, read).await.map_err(&reading)?;
    let (mut summary, mut chunks) = (Summary::default(), Chunks::of(read));
    loop {
        let chunk = chunks.next(source).await.map_err(&reading)?;
        if chunk.is_empty() {
            break;
        }
        target = target.insert(written, &chunk).await.map_err(&writing)?;
        for row in &chunk {
            summary.add(row);
        }
        progress(Progress {
            table: read.name.clone(),
            rows: summary.rows(),
            of,
            is_comparing: false,
        });
    }
    let contents = summary.finish();
    if contents.rows != of {
        return Err(CopyError::Incomplete {
            table: read.name.clone(),
            of,
            read: contents.rows,
        });
    }
    Ok((target, contents))
}

/// Reads a table back and compares it with what was read from the source.
async fn compare(
    target: &mut Tx,
    (copied, table): (&Copied, &Table),
    progress: &mut impl FnMut(Progress),
) -> Result<(), CopyError> {
    let writing = write_error(&table.name);
    let of = copied.contents.rows;
    let (mut summary, mut chunks) = (Summary::default(), Chunks::of(table));
    loop {
        let chunk = chunks.next(target).await.map_err(&writing)?;
        if chunk.is_empty() {
            break;
        }
        for row in &chunk {
            summary.add(row);
        }
        progress(Progress {
            table: table.name.clone(),
            rows: summary.rows(),
            of,
            is_comparing: true,
        });
    }
    let found = summary.finish();
    if found == copied.contents {
        return Ok(());
    }
    Err(CopyError::Differs {
        table: table.name.clone(),
        read: of,
        written: found.rows,
        hint: if found.rows == of {
            ", with other values"
        } else {
            ""
        },
    })
}
