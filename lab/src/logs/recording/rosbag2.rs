//! Reads the SQLite databases of rosbag2, by time.

use std::path::Path;

use futures_util::TryStreamExt as _;
use sqlx::sqlite::{SqliteConnectOptions, SqliteConnection};
use sqlx::{ConnectOptions as _, Connection as _};

use super::{Ended, MessageHandler, RawMessage, RecordingError, Topic};

/// First bytes of a message that was compressed by itself.
const ZSTD: [u8; 4] = [0x28, 0xb5, 0x2f, 0xfd];

/// Topics with messages; those without are left out.
const TOPICS: &str = "SELECT t.name, t.type, t.serialization_format, COUNT(*), MIN(m.timestamp), MAX(m.timestamp) \
     FROM messages m JOIN topics t ON t.id = m.topic_id GROUP BY t.name, t.type, t.serialization_format";
/// Messages of the topics of a JSON array, by time.
const MESSAGES: &str = "SELECT t.name, m.timestamp, m.data FROM messages m JOIN topics t ON t.id = m.topic_id \
     WHERE t.name IN (SELECT value FROM json_each(?1)) ORDER BY m.timestamp, m.id";

/// One row of [`TOPICS`].
type TopicRow = (String, String, String, i64, i64, i64);

fn refused(file: &Path) -> impl Fn(&dyn std::fmt::Display) -> RecordingError {
    let file = file.to_owned();
    move |problem| RecordingError::Database {
        file: file.clone(),
        problem: problem.to_string(),
    }
}

/// Runs work on a connection to a file that is only read.
fn with_database<T>(
    file: &Path,
    work: impl AsyncFnOnce(&mut SqliteConnection) -> Result<T, RecordingError>,
) -> Result<T, RecordingError> {
    let refused = refused(file);
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build();
    runtime
        .map_err(|problem| refused(&problem))?
        .block_on(async {
            let options = SqliteConnectOptions::new()
                .filename(file)
                .read_only(true)
                .disable_statement_logging();
            let connected = SqliteConnection::connect_with(&options).await;
            let mut connection = connected.map_err(|problem| refused(&problem))?;
            let done = work(&mut connection).await;
            // Nothing was written, so that nothing can be lost by closing.
            let _ = connection.close().await;
            done
        })
}

/// Returns the topics with messages.
pub(super) fn topics(file: &Path) -> Result<Vec<Topic>, RecordingError> {
    let refused = refused(file);
    with_database(file, async |connection| {
        let rows: Vec<TopicRow> = sqlx::query_as(TOPICS)
            .fetch_all(connection)
            .await
            .map_err(|problem| refused(&problem))?;
        let topics =
            rows.into_iter()
                .map(
                    |(name, message_type, encoding, count, first_ns, last_ns)| Topic {
                        name,
                        message_type,
                        encoding,
                        count: count.unsigned_abs(),
                        first_ns,
                        last_ns,
                    },
                );
        Ok(topics.collect())
    })
}

/// Reads the messages of some topics, by time.
pub(super) fn read(
    file: &Path,
    topics: &[&str],
    take: &mut MessageHandler<'_>,
) -> Result<Ended, RecordingError> {
    let names = serde_json::to_string(topics).map_err(|problem| refused(file)(&problem))?;
    with_database(file, async |connection| {
        let mut rows = sqlx::query_as::<_, (String, i64, Vec<u8>)>(MESSAGES)
            .bind(names)
            .fetch(connection);
        loop {
            let (topic, logged_ns, bytes) = match rows.try_next().await {
                Ok(Some(row)) => row,
                Ok(None) => return Ok(Ended::Whole),
                Err(problem) => {
                    return Ok(Ended::Torn(format!("`{}`: {problem}", file.display())));
                }
            };
            if bytes.starts_with(&ZSTD) {
                return Err(RecordingError::Compressed(file.to_owned()));
            }
            let raw = RawMessage {
                topic: &topic,
                logged_ns,
                bytes: &bytes,
            };
            if take(raw).is_break() {
                return Ok(Ended::Enough);
            }
        }
    })
}
