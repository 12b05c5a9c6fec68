//! `tread-agent recover`: copies the readable part of a damaged or torn record to a new record.
//!
//! A record consists of chunks, each with a header and a checksum, so damage costs only the chunks
//! it hits, about a second each. Channels are defined in the first chunk and again at the file's
//! end; where both are lost, this agent's own definitions are used.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::collections::btree_map::Entry;
use std::fs::{self, File};
use std::io::{self, BufWriter, Write as _};
use std::ops::Range;
use std::path::{Path, PathBuf};

use clap::Args;
use mcap::read::{ChannelAccumulator, Summary, parse_record};
use mcap::records::{Channel, MessageHeader, Record, SchemaHeader, op};
use mcap::sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions};
use mcap::{McapError, Writer};
use serde_json::{Value, json};
use tread_ros2::cdr::decode;
use tread_ros2::messages::tread::LoopTick;

use super::writer::{channel_numbered, options, ros_channel};
use super::{codec, topics};

/// Length of the magic at the begin and end of a file, bytes.
const MAGIC_BYTES: usize = 8;
/// Length of the head of an MCAP record, bytes: opcode and content length.
const RECORD_HEAD_BYTES: usize = 9;
/// Largest uncompressed size of a chunk that is read, bytes.
const CHUNK_BYTES_MAX: u64 = 256 * 1024 * 1024;

/// Arguments of `tread-agent recover`.
#[derive(Debug, Clone, Args)]
pub(crate) struct RecoverArgs {
    /// The damaged or truncated record
    file: PathBuf,
    /// The record to write; the file must not exist
    #[arg(long)]
    into: PathBuf,
    /// Print one JSON object
    #[arg(long)]
    json: bool,
}

/// Why nothing could be recovered.
#[derive(Debug, thiserror::Error)]
pub(crate) enum SalvageError {
    #[error("`{}` cannot be read", path.display())]
    Unreadable {
        path: PathBuf,
        #[source]
        source: io::Error,
    },
    #[error("`{}` has no chunk that is whole: nothing can be recovered", .0.display())]
    Nothing(PathBuf),
    #[error("`{}` cannot be written", path.display())]
    Unwritable {
        path: PathBuf,
        #[source]
        source: McapError,
    },
}

/// Result of a recovery.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub(crate) struct Salvaged {
    pub(crate) chunks: u64,
    pub(crate) messages: u64,
    pub(crate) ticks: u64,
    /// First and last number of each run of ticks that is missing between recovered ones.
    pub(crate) missing: Vec<(u64, u64)>,
}

impl Salvaged {
    fn record_tick(&mut self, number: u64, last: &mut Option<u64>) {
        self.ticks += 1;
        if let Some(last) = *last
            && number > last + 1
        {
            self.missing.push((last + 1, number - 1));
        }
        *last = Some(number);
    }
}

/// A message as it was written.
struct Message {
    header: MessageHeader,
    data: Vec<u8>,
}

/// Content of a chunk.
#[derive(Default)]
struct Chunk {
    schemas: Vec<(SchemaHeader, Vec<u8>)>,
    channels: Vec<Channel>,
    messages: Vec<Message>,
}

/// Copies the readable part and prints its size. Returns whether anything was recovered.
///
/// # Errors
/// [`SalvageError`], unless JSON is printed, which then contains the error; or the output cannot be
/// written.
pub(crate) fn run(args: &RecoverArgs) -> anyhow::Result<bool> {
    let salvaged = salvage(args);
    let mut out = io::stdout().lock();
    if args.json {
        let is_recovered = salvaged.is_ok();
        let object = match salvaged {
            Ok(found) => object(&found),
            Err(refused) => json!({ "refused": format!("{:#}", anyhow::Error::from(refused)) }),
        };
        serde_json::to_writer(&mut out, &object)?;
        writeln!(out)?;
        return Ok(is_recovered);
    }
    let found = salvaged?;
    writeln!(
        out,
        "recovered {} messages, {} ticks of them, from {} chunks",
        found.messages, found.ticks, found.chunks
    )?;
    for (first, last) in &found.missing {
        writeln!(out, "ticks {first} to {last} are missing")?;
    }
    Ok(true)
}

fn object(found: &Salvaged) -> Value {
    json!({
        "chunks": found.chunks,
        "messages": found.messages,
        "ticks": found.ticks,
        "missing_ticks": found.missing,
    })
}

/// Copies the readable part of a record into a new file.
///
/// # Errors
/// [`SalvageError`]: the file is unreadable or without an undamaged chunk, or the new one cannot be
/// written.
fn salvage(RecoverArgs { file, into, .. }: &RecoverArgs) -> Result<Salvaged, SalvageError> {
    let bytes = fs::read(file).map_err(|source| SalvageError::Unreadable {
        path: file.to_owned(),
        source,
    })?;
    let mut known = ChannelAccumulator::default();
    let mut places = Vec::new();
    let mut at = MAGIC_BYTES.min(bytes.len());
    while at < bytes.len() {
        // Bytes between two chunks contain no messages.
        match chunk_at(&bytes, at) {
            Some((place, chunk)) => {
                chunk.add_channels(&mut known);
                at = place.end;
                places.push(place.start);
            }
            None => at += 1,
        }
    }
    if places.is_empty() {
        return Err(SalvageError::Nothing(file.to_owned()));
    }
    if let Ok(Some(summary)) = Summary::read(&bytes) {
        let mut whole = ChannelAccumulator::from_summary(&summary);
        std::mem::swap(&mut known, &mut whole);
    }
    let messages = places
        .into_iter()
        .filter_map(|at| chunk_at(&bytes, at))
        .map(|(_, chunk)| chunk.messages);
    write(messages, &known, into).map_err(|source| SalvageError::Unwritable {
        path: into.to_owned(),
        source,
    })
}

/// Returns position and content of the chunk that begins at `at`; `None` if none does or it is
/// damaged.
fn chunk_at(bytes: &[u8], at: usize) -> Option<(Range<usize>, Chunk)> {
    let rest = bytes.get(at..)?;
    let (head, rest) = rest.split_at_checked(RECORD_HEAD_BYTES)?;
    if head[0] != op::CHUNK {
        return None;
    }
    let length = u64::from_le_bytes(head[1..].try_into().ok()?);
    let content = rest.get(..usize::try_from(length).ok()?)?;
    let Ok(Record::Chunk { header, .. }) = parse_record(op::CHUNK, content) else {
        return None;
    };
    if header.uncompressed_size > CHUNK_BYTES_MAX || header.uncompressed_crc == 0 {
        return None;
    }
    let place = at..at + RECORD_HEAD_BYTES + content.len();
    let largest = content
        .len()
        .max(usize::try_from(header.uncompressed_size).ok()?);
    let options = LinearReaderOptions::default()
        .with_skip_start_magic(true)
        .with_skip_end_magic(true)
        // Checked before the content is parsed: lengths in a damaged chunk are not trustworthy.
        .with_prevalidate_chunk_crcs(true)
        .with_record_length_limit(largest);
    let mut reader = LinearReader::new_with_options(options);
    let mut rest = bytes.get(place.clone())?;
    let mut chunk = Chunk::default();
    while let Some(event) = reader.next_event() {
        match event.ok()? {
            LinearReadEvent::ReadRequest(length) => {
                let (next, after) = rest.split_at(length.min(rest.len()));
                reader.insert(next.len()).copy_from_slice(next);
                reader.notify_read(next.len());
                rest = after;
            }
            LinearReadEvent::Record { data, opcode } => {
                chunk.take(parse_record(opcode, data).ok()?);
            }
        }
    }
    Some((place, chunk))
}

impl Chunk {
    fn take(&mut self, record: Record<'_>) {
        if let Record::Schema { header, data } = record {
            self.schemas.push((header, data.into_owned()));
        } else if let Record::Channel(channel) = record {
            self.channels.push(channel);
        } else if let Record::Message { header, data } = record {
            let data = data.into_owned();
            self.messages.push(Message { header, data });
        }
    }

    /// Adds the chunk's channel definitions; one that contradicts an earlier one is ignored.
    fn add_channels(self, known: &mut ChannelAccumulator<'static>) {
        for (header, data) in self.schemas {
            let _ = known.add_schema(header, Cow::Owned(data));
        }
        for channel in self.channels {
            let _ = known.add_channel(channel);
        }
    }
}

/// Writes the new record.
fn write(
    chunks: impl Iterator<Item = Vec<Message>>,
    known: &ChannelAccumulator<'static>,
    into: &Path,
) -> Result<Salvaged, McapError> {
    let mut writer = options().create(BufWriter::new(File::create_new(into)?))?;
    let mut channels = BTreeMap::new();
    let (mut found, mut last_tick) = (Salvaged::default(), None);
    for chunk in chunks {
        found.chunks += 1;
        for Message { mut header, data } in chunk {
            let number = header.channel_id;
            let channel = match channels.entry(number) {
                Entry::Vacant(place) => place.insert(channel(&mut writer, known, number)?),
                Entry::Occupied(place) => place.into_mut(),
            };
            let Some((id, topic)) = channel else {
                continue;
            };
            header.channel_id = *id;
            writer.write_to_known_channel(&header, &data)?;
            found.messages += 1;
            if topic == topics::TICK
                && let Some(number) = tick_number(&data)
            {
                found.record_tick(number, &mut last_tick);
            }
        }
    }
    writer.finish()?;
    Ok(found)
}

/// Returns the number of a tick, its first field in every format.
fn tick_number(data: &[u8]) -> Option<u64> {
    let tick: Result<LoopTick<'_>, _> = decode(data);
    tick.map(|tick| tick.number).ok().or_else(|| {
        let earlier = codec::from_format_1(data).ok()?;
        let tick: LoopTick<'_> = decode(&earlier).ok()?;
        Some(tick.number)
    })
}

/// Adds the channel with this number to the new record; `None` if it is defined neither in the old
/// record nor by this agent.
fn channel(
    writer: &mut Writer<BufWriter<File>>,
    known: &ChannelAccumulator<'static>,
    id: u16,
) -> Result<Option<(u16, String)>, McapError> {
    if let Some(channel) = known.get(id) {
        let schema = match &channel.schema {
            Some(schema) => writer.add_schema(&schema.name, &schema.encoding, &schema.data)?,
            None => 0,
        };
        let (topic, encoding) = (&channel.topic, &channel.message_encoding);
        let id = writer.add_channel(schema, topic, encoding, &channel.metadata)?;
        return Ok(Some((id, topic.clone())));
    }
    let Some((topic, kind)) = channel_numbered(id) else {
        return Ok(None);
    };
    let id = ros_channel(writer, topic, kind)?;
    Ok(Some((id, topic.to_owned())))
}

#[cfg(test)]
mod tests {
    use tempfile::TempDir;

    use super::super::replay::replay;
    use super::super::tests::{files, short};
    use super::*;

    /// Where the chunks of a whole record are.
    fn chunks(bytes: &[u8]) -> Vec<Range<usize>> {
        let places = (0..bytes.len()).filter_map(|at| chunk_at(bytes, at));
        places.map(|(place, _)| place).collect()
    }

    fn args(folder: &TempDir, file: &str) -> RecoverArgs {
        RecoverArgs {
            file: folder.path().join(file),
            into: folder.path().join("whole"),
            json: false,
        }
    }

    fn recovered(folder: &TempDir, bytes: &[u8]) -> (PathBuf, Salvaged) {
        let args = args(folder, "damaged");
        drop(fs::remove_file(&args.into));
        fs::write(&args.file, bytes).unwrap();
        let found = salvage(&args).unwrap();
        (args.into, found)
    }

    #[test]
    fn what_lies_behind_a_damaged_chunk_is_readable_again() {
        let folder = TempDir::new().unwrap();
        let file = short(folder.path());
        let bytes = fs::read(&file).unwrap();
        let (_, whole) = recovered(&folder, &bytes);
        let places = chunks(&bytes);
        assert!(places.len() >= 3, "{} chunks", places.len());
        assert_eq!(
            (whole.chunks, &whole.missing),
            (places.len() as u64, &vec![])
        );
        for (number, place) in places.iter().enumerate() {
            // In its head and in the middle of its content.
            for at in [place.start, usize::midpoint(place.start, place.end)] {
                let mut damaged = bytes.clone();
                damaged[at] ^= 4;
                let (copy, found) = recovered(&folder, &damaged);
                assert_eq!(found.chunks, whole.chunks - 1, "chunk {number} at {at}");
                assert!(found.ticks < whole.ticks && found.messages < whole.messages);
                let missing: u64 = found.missing.iter().map(|(from, to)| to - from + 1).sum();
                let is_inner = number > 0 && number + 1 < places.len();
                assert_eq!(missing > 0, is_inner, "chunk {number}");
                if is_inner {
                    assert_eq!(missing, whole.ticks - found.ticks);
                }
                // It is a whole file again, with all channels.
                let read = fs::read(copy).unwrap();
                let summary = Summary::read(&read).unwrap().unwrap();
                assert_eq!(summary.stats.unwrap().message_count, found.messages);
                let topics = summary.channels.values();
                assert!(
                    topics
                        .map(|it| it.topic.as_str())
                        .any(|it| it == topics::TICK)
                );
            }
        }
    }

    #[test]
    fn a_torn_record_is_whole_again_and_runs_as_far_as_it_goes() {
        let folder = TempDir::new().unwrap();
        let file = short(folder.path());
        let bytes = fs::read(&file).unwrap();
        let places = chunks(&bytes);
        let (copy, found) = recovered(&folder, &bytes[..places[1].end + 20]);
        assert_eq!(found.chunks, 2);
        let replayed = replay(&[copy]).unwrap();
        assert_eq!((replayed.differing, replayed.torn), (0, None));
        assert_eq!(replayed.ticks, found.ticks);
    }

    #[test]
    fn with_the_definitions_lost_at_both_ends_those_of_this_agent_hold() {
        let folder = TempDir::new().unwrap();
        let file = short(folder.path());
        let bytes = fs::read(&file).unwrap();
        let places = chunks(&bytes);
        let mut damaged = bytes[..places[2].end].to_vec();
        damaged[places[0].clone()].fill(0);
        let (copy, found) = recovered(&folder, &damaged);
        assert_eq!(found.chunks, 2);
        let (again, same) = recovered(&folder, &fs::read(copy).unwrap());
        assert_eq!((same.messages, same.ticks), (found.messages, found.ticks));
        assert!(again.exists() && files(folder.path()).len() == 3);
        let nothing = salvage(&args(&folder, "gone"));
        assert!(nothing.unwrap_err().to_string().contains("cannot be read"));
        let args = args(&folder, "damaged");
        fs::write(&args.file, b"no record").unwrap();
        let nothing = salvage(&args).unwrap_err();
        assert!(nothing.to_string().contains("nothing can be recovered"));
    }
}
