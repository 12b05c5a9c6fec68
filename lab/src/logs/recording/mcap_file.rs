//! Reads MCAP files in the order in which they were written, up to where a file is torn.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::BufReader;
use std::path::Path;

use mcap::io::MessageReader;
use mcap::sans_io::LinearReaderOptions;

use super::{Ended, MessageHandler, RawMessage, RecordingError, Topic, unreadable};

/// Largest MCAP record that is read, bytes.
const RECORD_BYTES_MAX: usize = 1 << 30;
/// Encoding of the messages of ROS 1.
const ROS1: &str = "ros1";

fn open(file: &Path) -> Result<MessageReader<BufReader<File>>, RecordingError> {
    let opened = File::open(file).map_err(unreadable(file))?;
    let options = LinearReaderOptions::default()
        .with_prevalidate_chunk_crcs(true)
        .with_record_length_limit(RECORD_BYTES_MAX);
    Ok(MessageReader::new_with_options(
        BufReader::new(opened),
        options,
    ))
}

fn signed(time_ns: u64) -> i64 {
    i64::try_from(time_ns).unwrap_or(i64::MAX)
}

/// Returns the topics with messages, and where the file is torn.
pub(super) fn topics(file: &Path) -> Result<(Vec<Topic>, Option<String>), RecordingError> {
    let mut topics: BTreeMap<String, Topic> = BTreeMap::new();
    for message in open(file)? {
        let message = match message {
            Ok(message) => message,
            Err(problem) if topics.is_empty() => {
                return Err(RecordingError::Torn {
                    file: file.to_owned(),
                    problem: problem.to_string(),
                });
            }
            Err(problem) => {
                let torn = format!("`{}`: {problem}", file.display());
                return Ok((topics.into_values().collect(), Some(torn)));
            }
        };
        if message.channel.message_encoding == ROS1 {
            return Err(RecordingError::Ros1(file.to_owned()));
        }
        let logged_ns = signed(message.log_time);
        let topic = topics
            .entry(message.channel.topic.clone())
            .or_insert_with(|| Topic {
                name: message.channel.topic.clone(),
                message_type: message
                    .channel
                    .schema
                    .as_ref()
                    .map_or_else(String::new, |schema| schema.name.clone()),
                encoding: message.channel.message_encoding.clone(),
                count: 0,
                first_ns: logged_ns,
                last_ns: logged_ns,
            });
        topic.count += 1;
        topic.first_ns = topic.first_ns.min(logged_ns);
        topic.last_ns = topic.last_ns.max(logged_ns);
    }
    Ok((topics.into_values().collect(), None))
}

/// Reads the messages of some topics.
pub(super) fn read(
    file: &Path,
    topics: &[&str],
    take: &mut MessageHandler<'_>,
) -> Result<Ended, RecordingError> {
    for message in open(file)? {
        let message = match message {
            Ok(message) => message,
            Err(problem) => return Ok(Ended::Torn(format!("`{}`: {problem}", file.display()))),
        };
        if !topics.contains(&message.channel.topic.as_str()) {
            continue;
        }
        let raw = RawMessage {
            topic: &message.channel.topic,
            logged_ns: signed(message.log_time),
            bytes: &message.data,
        };
        if take(raw).is_break() {
            return Ok(Ended::Enough);
        }
    }
    Ok(Ended::Whole)
}
