//! Recordings on the disk: MCAP files and rosbag2 databases, one after the other.

mod mcap_file;
mod rosbag2;

use std::fs::File;
use std::io::Read;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

use serde::Serialize;

/// Most files of one recording.
pub const FILES_MAX: usize = 10_000;
/// Bytes at the begin of a file that tell its kind.
const MAGIC_BYTES: usize = 16;
/// Encoding of the messages of ROS 2.
pub const CDR: &str = "cdr";

/// Why a recording cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum RecordingError {
    /// A file or folder cannot be read.
    #[error("`{}` cannot be read", file.display())]
    Unreadable {
        /// The file.
        file: PathBuf,
        /// The system's reason.
        #[source]
        source: std::io::Error,
    },
    /// A folder without recordings.
    #[error("`{}` holds no file that ends in `.mcap` or `.db3`: name a file, or the folder that `ros2 bag record` made", .0.display())]
    NoFiles(PathBuf),
    /// More than [`FILES_MAX`] files.
    #[error("these are more than {FILES_MAX} files: read them in several runs")]
    TooManyFiles,
    /// A file that rosbag2 compressed as a whole or message by message.
    #[error("`{}` is compressed by rosbag2: decompress it first, by `zstd -d` or `ros2 bag convert`", .0.display())]
    Compressed(PathBuf),
    /// A recording of ROS 1.
    #[error("`{}` is a recording of ROS 1, and only messages of ROS 2 are read: convert it with `rosbags-convert`", .0.display())]
    Ros1(PathBuf),
    /// Neither MCAP nor SQLite.
    #[error("`{}` is neither an MCAP file nor a database of rosbag2", .0.display())]
    UnknownKind(PathBuf),
    /// An MCAP file that gives no message.
    #[error("`{}` is torn before its first message: {problem}", file.display())]
    Torn {
        /// The file.
        file: PathBuf,
        /// What its reader met.
        problem: String,
    },
    /// A file without messages.
    #[error("`{}` holds no messages", .0.display())]
    Empty(PathBuf),
    /// A database that is none of rosbag2, or is damaged.
    #[error("`{}` cannot be read as a database of rosbag2: {problem}", file.display())]
    Database {
        /// The file.
        file: PathBuf,
        /// What SQLite said.
        problem: String,
    },
    /// One topic with two types.
    #[error(
        "`{topic}` is of the type {one} in one file and {other} in another: read them in several runs"
    )]
    TwoTypes {
        /// The topic.
        topic: String,
        /// A type.
        one: String,
        /// Another type.
        other: String,
    },
}

/// A topic of a recording.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Topic {
    /// Name, with the slash before it.
    pub name: String,
    /// Type of its messages, for instance `sensor_msgs/msg/Imu`.
    pub message_type: String,
    /// Encoding of its messages.
    pub encoding: String,
    /// Number of messages.
    pub count: u64,
    /// When the first was recorded, nanoseconds of the recorder's clock.
    pub first_ns: i64,
    /// When the last was recorded.
    pub last_ns: i64,
}

impl Topic {
    /// Returns the mean rate of the messages, hertz; `None` for fewer than two.
    #[expect(clippy::cast_precision_loss, reason = "counts and times of recordings")]
    pub fn rate_hz(&self) -> Option<f64> {
        let span_s = self.last_ns.saturating_sub(self.first_ns) as f64 * 1.0e-9;
        (self.count > 1 && span_s > 0.0).then(|| (self.count - 1) as f64 / span_s)
    }

    /// Adds the messages of the same topic in another file.
    fn join(&mut self, other: &Self) -> Result<(), RecordingError> {
        if self.message_type != other.message_type {
            return Err(RecordingError::TwoTypes {
                topic: self.name.clone(),
                one: self.message_type.clone(),
                other: other.message_type.clone(),
            });
        }
        self.count += other.count;
        self.first_ns = self.first_ns.min(other.first_ns);
        self.last_ns = self.last_ns.max(other.last_ns);
        Ok(())
    }
}

/// A message as it was recorded.
#[derive(Debug, Clone, Copy)]
pub struct RawMessage<'a> {
    /// Its topic.
    pub topic: &'a str,
    /// When it was recorded, nanoseconds of the recorder's clock.
    pub logged_ns: i64,
    /// The message itself.
    pub bytes: &'a [u8],
}

/// What a reader does with a message; it may end the reading.
pub type MessageHandler<'t> = dyn FnMut(RawMessage<'_>) -> ControlFlow<()> + 't;

/// How the reading of a file ended.
#[derive(Debug, Clone, PartialEq, Eq)]
enum Ended {
    /// At its end.
    Whole,
    /// Where it is torn or damaged.
    Torn(String),
    /// By whoever takes the messages.
    Enough,
}

/// Kind of a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    Mcap,
    Rosbag2,
}

/// Topics of a recording.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Contents {
    /// All topics with messages, by name.
    pub topics: Vec<Topic>,
    /// Files that end early, with where; what comes before is read.
    pub torn: Vec<String>,
}

impl Contents {
    /// Returns the topics as lines for people: name, type, count, rate.
    pub fn lines(&self) -> String {
        let lines = self.topics.iter().map(|topic| {
            let rate = topic.rate_hz();
            let rate = rate.map_or_else(|| "once".to_owned(), |rate| format!("{rate:.1} Hz"));
            let (name, kind, count) = (&topic.name, &topic.message_type, topic.count);
            let other = if topic.encoding == CDR {
                String::new()
            } else {
                format!(", encoded in {}, which is not read", topic.encoding)
            };
            format!("  {name}  {kind}, {count} messages, {rate}{other}\n")
        });
        lines.collect()
    }
}

/// The files of a recording.
#[derive(Debug, Clone)]
pub struct Recording {
    files: Vec<(PathBuf, Kind)>,
}

impl Recording {
    /// Finds the files of a recording: files, or folders as `ros2 bag record` makes them.
    ///
    /// # Errors
    /// [`RecordingError`] names the file that is none.
    pub fn open(paths: &[PathBuf]) -> Result<Self, RecordingError> {
        let mut files = Vec::new();
        for path in paths {
            if path.is_dir() {
                files.extend(files_of(path)?);
            } else {
                files.push(path.clone());
            }
            if files.len() > FILES_MAX {
                return Err(RecordingError::TooManyFiles);
            }
        }
        let kinds = files.into_iter().map(|file| {
            let kind = kind_of(&file)?;
            Ok((file, kind))
        });
        Ok(Self {
            files: kinds.collect::<Result<_, RecordingError>>()?,
        })
    }

    /// Returns the files.
    pub fn files(&self) -> impl Iterator<Item = &Path> {
        self.files.iter().map(|(file, _)| file.as_path())
    }

    /// Reads which topics there are.
    ///
    /// # Errors
    /// [`RecordingError`] for a file that gives no message at all.
    pub fn contents(&self) -> Result<Contents, RecordingError> {
        let mut contents = Contents::default();
        for (file, kind) in &self.files {
            let (topics, torn) = match kind {
                Kind::Mcap => mcap_file::topics(file)?,
                Kind::Rosbag2 => (rosbag2::topics(file)?, None),
            };
            if topics.is_empty() {
                return Err(RecordingError::Empty(file.clone()));
            }
            contents.torn.extend(torn);
            for topic in topics {
                let known = contents
                    .topics
                    .iter_mut()
                    .find(|known| known.name == topic.name);
                match known {
                    Some(known) => known.join(&topic)?,
                    None => contents.topics.push(topic),
                }
            }
        }
        contents
            .topics
            .sort_by(|one, other| one.name.cmp(&other.name));
        Ok(contents)
    }

    /// Reads the messages of some topics, file after file. Returns where files are torn.
    ///
    /// # Errors
    /// [`RecordingError`] for a file that gives no message at all.
    pub fn read(
        &self,
        topics: &[&str],
        take: &mut MessageHandler<'_>,
    ) -> Result<Vec<String>, RecordingError> {
        let mut torn = Vec::new();
        for (file, kind) in &self.files {
            let ended = match kind {
                Kind::Mcap => mcap_file::read(file, topics, take)?,
                Kind::Rosbag2 => rosbag2::read(file, topics, take)?,
            };
            match ended {
                Ended::Whole => {}
                Ended::Torn(place) => torn.push(place),
                Ended::Enough => break,
            }
        }
        Ok(torn)
    }
}

fn unreadable(file: &Path) -> impl FnOnce(std::io::Error) -> RecordingError {
    let file = file.to_owned();
    move |source| RecordingError::Unreadable { file, source }
}

/// Returns the recordings of a folder, by name.
fn files_of(folder: &Path) -> Result<Vec<PathBuf>, RecordingError> {
    let mut files = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(unreadable(folder))? {
        let path = entry.map_err(unreadable(folder))?.path();
        let ending = path.extension().and_then(|ending| ending.to_str());
        match ending {
            Some("mcap" | "db3") => files.push(path),
            Some("zstd") => return Err(RecordingError::Compressed(path)),
            Some(_) | None => {}
        }
        if files.len() > FILES_MAX {
            return Err(RecordingError::TooManyFiles);
        }
    }
    if files.is_empty() {
        return Err(RecordingError::NoFiles(folder.to_owned()));
    }
    files.sort();
    Ok(files)
}

fn kind_of(file: &Path) -> Result<Kind, RecordingError> {
    let opened = File::open(file).map_err(unreadable(file))?;
    let mut first = Vec::with_capacity(MAGIC_BYTES);
    let bytes = MAGIC_BYTES as u64;
    opened
        .take(bytes)
        .read_to_end(&mut first)
        .map_err(unreadable(file))?;
    if first.starts_with(mcap::MAGIC) {
        Ok(Kind::Mcap)
    } else if first.starts_with(b"SQLite format 3\0") {
        Ok(Kind::Rosbag2)
    } else if first.starts_with(b"#ROSBAG V") {
        Err(RecordingError::Ros1(file.to_owned()))
    } else if first.starts_with(&[0x28, 0xb5, 0x2f, 0xfd]) {
        Err(RecordingError::Compressed(file.to_owned()))
    } else {
        Err(RecordingError::UnknownKind(file.to_owned()))
    }
}

#[cfg(test)]
mod tests;
