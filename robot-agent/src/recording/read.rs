//! Reads the files of one recorded run, in order, up to where a file is torn.

use std::fs::File;
use std::io::BufReader;
use std::path::{Path, PathBuf};

use mcap::McapError;
use mcap::io::MessageReader;
use mcap::sans_io::LinearReaderOptions;
use serde::de::DeserializeOwned;
use tread_api::ids::BootId;

use super::{CommandMessage, FORMAT, FORMATS_READ, RunHead, SafetyMessage, codec, topics};

/// Largest MCAP record that is read, bytes.
const PIECE_BYTES_MAX: usize = 256 * 1024 * 1024;
/// Message encoding of JSON in MCAP.
const JSON: &str = "json";

/// Why a record cannot be read.
#[derive(Debug, thiserror::Error)]
pub(crate) enum ReadError {
    #[error("there is no file to replay")]
    Nothing,
    #[error("`{file}` cannot be opened")]
    Unreadable {
        file: PathBuf,
        #[source]
        source: std::io::Error,
    },
    #[error("`{0}` is no MCAP file, or is torn before its first message")]
    NoRecord(PathBuf),
    #[error("`{file}` has no channel `{topic}`: it is no record of tread-agent")]
    NoChannel { file: PathBuf, topic: &'static str },
    #[error(
        "`{file}` is written in format {found}, and this agent reads formats up to {FORMAT}: replay it with tread-agent {version}"
    )]
    OtherFormat {
        file: PathBuf,
        found: u32,
        version: String,
    },
    #[error("`{file}` holds on `{topic}` what is none of its messages: {problem}")]
    Malformed {
        file: PathBuf,
        topic: String,
        problem: String,
    },
    #[error("`{file}` is of another run than the files before it ({found}, not {expected})")]
    OtherRun {
        file: PathBuf,
        found: BootId,
        expected: BootId,
    },
    #[error(
        "`{file}` is part {found} of its run, and part {expected} is missing: a replay needs all parts from the first on"
    )]
    PartMissing {
        file: PathBuf,
        found: u32,
        expected: u32,
    },
}

/// An entry of a record, in the order of writing.
pub(crate) enum Entry {
    Command(Box<CommandMessage>),
    Safety(Box<SafetyMessage>),
    /// A tick in its recorded encoding.
    Tick(Vec<u8>),
}

/// The files of one run.
pub(crate) struct Run {
    pub(crate) head: RunHead,
    parts: std::vec::IntoIter<(PathBuf, RunHead)>,
    present: Option<Part>,
    /// Description of a torn file; nothing behind that position is read.
    pub(crate) torn: Option<String>,
}

/// A file that is being read.
struct Part {
    file: PathBuf,
    messages: MessageReader<BufReader<File>>,
}

/// A message as stored in the file.
struct Raw {
    topic: String,
    bytes: Vec<u8>,
    /// Whether the message itself is JSON, as in format 1, and not a ROS text that contains JSON.
    is_json: bool,
}

/// Topic of a message that is described.
struct InTopic<'a>(&'a str);

impl Raw {
    /// Parses the message's JSON.
    fn json<T: DeserializeOwned>(&self, part: &Part) -> Result<T, ReadError> {
        let json = if self.is_json {
            &self.bytes[..]
        } else {
            let text = codec::text_of(&self.bytes);
            text.map_err(|refused| part.malformed(InTopic(&self.topic), refused))?
                .as_bytes()
        };
        serde_json::from_slice(json)
            .map_err(|refused| part.malformed(InTopic(&self.topic), refused))
    }
}

impl Part {
    fn open(file: &Path) -> Result<Self, ReadError> {
        let opened = File::open(file).map_err(|source| ReadError::Unreadable {
            file: file.to_owned(),
            source,
        })?;
        let options = LinearReaderOptions::default()
            .with_prevalidate_chunk_crcs(true)
            .with_record_length_limit(PIECE_BYTES_MAX);
        Ok(Self {
            file: file.to_owned(),
            messages: MessageReader::new_with_options(BufReader::new(opened), options),
        })
    }

    fn next(&mut self) -> Option<Result<Raw, McapError>> {
        Some(self.messages.next()?.map(|message| Raw {
            topic: message.channel.topic.clone(),
            is_json: message.channel.message_encoding == JSON,
            bytes: message.data.into_owned(),
        }))
    }

    fn malformed(&self, InTopic(topic): InTopic<'_>, problem: impl std::fmt::Display) -> ReadError {
        ReadError::Malformed {
            file: self.file.clone(),
            topic: topic.to_owned(),
            problem: problem.to_string(),
        }
    }

    /// Reads the head of the file's run.
    fn head(&mut self) -> Result<RunHead, ReadError> {
        let mut has_message = false;
        loop {
            match self.next() {
                Some(Ok(raw)) if raw.topic == topics::RUN => {
                    return self.read_head(&raw);
                }
                Some(Ok(_)) => has_message = true,
                Some(Err(_)) | None if !has_message => {
                    return Err(ReadError::NoRecord(self.file.clone()));
                }
                Some(Err(_)) | None => {
                    let (file, topic) = (self.file.clone(), topics::RUN);
                    return Err(ReadError::NoChannel { file, topic });
                }
            }
        }
    }

    fn read_head(&self, raw: &Raw) -> Result<RunHead, ReadError> {
        // The format first: the fields of another format are unknown.
        let spelled: serde_json::Value = raw.json(self)?;
        let found = spelled.get("format").and_then(serde_json::Value::as_u64);
        let found = found.and_then(|found| u32::try_from(found).ok());
        let found =
            found.ok_or_else(|| self.malformed(InTopic(topics::RUN), "it names no format"))?;
        if !FORMATS_READ.contains(&found) {
            let version = spelled.get("version").and_then(serde_json::Value::as_str);
            return Err(ReadError::OtherFormat {
                file: self.file.clone(),
                found,
                version: version.unwrap_or("of its time").to_owned(),
            });
        }
        raw.json(self)
    }

    /// Whether the file has defined a channel of this topic so far.
    fn knows(&self, topic: &str) -> bool {
        (0..=u16::MAX)
            .filter_map(|number| self.messages.get_channel(number))
            .any(|channel| channel.topic == topic)
    }
}

impl Run {
    /// Opens the files of a run, given in any order.
    ///
    /// # Errors
    /// [`ReadError`] if a file is no readable record, or if the files are not all parts of one run
    /// from its first part on.
    pub(crate) fn open(files: &[PathBuf]) -> Result<Self, ReadError> {
        let mut parts = Vec::with_capacity(files.len());
        for file in files {
            parts.push((file.clone(), Part::open(file)?.head()?));
        }
        parts.sort_by_key(|(_, head)| head.part);
        let first = parts.first().ok_or(ReadError::Nothing)?.1.clone();
        for (expected, (file, head)) in (0_u32..).zip(&parts) {
            if head.boot != first.boot {
                return Err(ReadError::OtherRun {
                    file: file.clone(),
                    found: head.boot,
                    expected: first.boot,
                });
            }
            if head.part != expected {
                return Err(ReadError::PartMissing {
                    file: file.clone(),
                    found: head.part,
                    expected,
                });
            }
        }
        Ok(Self {
            head: first,
            parts: parts.into_iter(),
            present: None,
            torn: None,
        })
    }

    /// Returns the next entry; `None` at the end, or where a file is torn.
    ///
    /// # Errors
    /// [`ReadError`] for a malformed message or a file without ticks.
    pub(crate) fn next(&mut self) -> Result<Option<Entry>, ReadError> {
        while self.torn.is_none() {
            let Some(part) = &mut self.present else {
                let Some((file, _)) = self.parts.next() else {
                    return Ok(None);
                };
                self.present = Some(Part::open(&file)?);
                continue;
            };
            match part.next() {
                None if !part.knows(topics::TICK) => {
                    let (file, topic) = (part.file.clone(), topics::TICK);
                    return Err(ReadError::NoChannel { file, topic });
                }
                None => self.present = None,
                Some(Err(cause)) => {
                    self.torn = Some(format!("`{}`: {cause}", part.file.display()));
                }
                Some(Ok(raw)) => {
                    if let Some(entry) = entry_of(part, raw)? {
                        return Ok(Some(entry));
                    }
                }
            }
        }
        Ok(None)
    }
}

fn entry_of(part: &Part, raw: Raw) -> Result<Option<Entry>, ReadError> {
    Ok(match raw.topic.as_str() {
        topics::COMMAND => Some(Entry::Command(Box::new(raw.json(part)?))),
        topics::SAFETY => Some(Entry::Safety(Box::new(raw.json(part)?))),
        topics::TICK => Some(Entry::Tick(raw.bytes)),
        // The other topics are for display only.
        _ => None,
    })
}
