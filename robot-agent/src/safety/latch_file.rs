//! Stores the stop latch on disk. An agent whose latch is unreadable or damaged starts stopped.
//!
//! The first start writes a latch without a stop before anything else in the folder. So a missing
//! latch beside other files of an agent was lost and may have held a stop: the agent then starts
//! stopped too.

use std::io;
use std::path::{Path, PathBuf};

use tracing::error;
use tread_api::safety::StopLatch;

use super::stop::StopState;
use crate::clock::SharedClock;
use crate::durable;

const FILE_NAME: &str = "stop.json";
/// Files of an agent that has run, in the folder of the latch.
const TRACES: [&str; 2] = ["outbox", "missions.json"];

const UNREADABLE: &str = "the stop latch on the robot's disk cannot be read";
const MISSING: &str = "the stop latch on the robot's disk is missing though an agent ran there before, \
     so nobody knows whether a stop was in force";

/// The file that keeps the latch across restarts.
#[derive(Debug, Clone)]
pub(crate) struct LatchFile {
    folder: PathBuf,
}

impl LatchFile {
    /// Creates the file's handle; the folder must exist.
    pub(crate) fn new(folder: &Path) -> Self {
        Self {
            folder: folder.to_owned(),
        }
    }

    /// Reads the latch. Returns no stop at a robot's first start, and a stop of the agent's own if
    /// the file is unreadable, or missing though an agent has run in this folder.
    pub(crate) fn load(&self, clock: &SharedClock) -> StopState {
        let path = self.folder.join(FILE_NAME);
        let (problem, reason) = match std::fs::read(&path) {
            Ok(file) => match durable::unsealed(&file).map(serde_json::from_slice) {
                Ok(Ok(state)) => return state,
                Ok(Err(cause)) => (cause.to_string(), UNREADABLE),
                Err(cause) => (cause.to_string(), UNREADABLE),
            },
            Err(cause) if cause.kind() == io::ErrorKind::NotFound => {
                if !self.has_traces() {
                    return self.begin();
                }
                (cause.to_string(), MISSING)
            }
            Err(cause) => (cause.to_string(), UNREADABLE),
        };
        let stop = StopLatch {
            id: tread_api::ids::StopId::from_uuid(uuid::Uuid::new_v4()),
            by: "the agent".to_owned(),
            reason: reason.to_owned(),
            since: clock.wall(),
        };
        error!(
            problem,
            "`{}`: {}: starting stopped",
            path.display(),
            stop.reason
        );
        StopState::latched(stop)
    }

    /// Whether an agent has run in this folder; true if that cannot be checked.
    fn has_traces(&self) -> bool {
        let is_there = |name: &&str| self.folder.join(name).try_exists().unwrap_or(true);
        TRACES.iter().any(is_there)
    }

    /// Writes a latch without a stop at the first start.
    fn begin(&self) -> StopState {
        let state = StopState::default();
        let made = std::fs::create_dir_all(&self.folder);
        if let Err(cause) = made.and_then(|()| self.save(&state)) {
            error!("the stop latch cannot be written, so the next start will be stopped: {cause}");
        }
        state
    }

    /// Writes the latch and waits until it is on disk. Blocks.
    ///
    /// # Errors
    /// The error of the operating system; the former content is kept.
    pub(crate) fn save(&self, state: &StopState) -> io::Result<()> {
        let text = serde_json::to_vec(state)?;
        durable::replace(&self.folder, FILE_NAME, &durable::sealed(&text))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::clock::SystemClock;

    #[test]
    fn a_latch_that_cannot_be_read_stops_the_robot_and_a_clear_repairs_it() {
        let folder = tempfile::tempdir().unwrap();
        let (file, clock) = (LatchFile::new(folder.path()), SystemClock::shared());
        std::fs::write(folder.path().join(FILE_NAME), b"{\"latch\":").unwrap();
        let state = file.load(&clock);
        let id = state.latch().expect("stopped").id;
        let cleared = state.cleared(id).unwrap().unwrap();
        file.save(&cleared).unwrap();
        assert_eq!(file.load(&clock), cleared);
    }

    #[test]
    fn a_latch_that_is_missing_stops_the_robot_unless_no_agent_ran_there_before() {
        let folder = tempfile::tempdir().unwrap();
        let (file, clock) = (
            LatchFile::new(&folder.path().join("data")),
            SystemClock::shared(),
        );
        let path = file.folder.join(FILE_NAME);
        for start in 0..3 {
            assert_eq!(file.load(&clock), StopState::default(), "start {start}");
            assert!(path.exists(), "start {start}");
            std::fs::create_dir_all(file.folder.join("outbox")).unwrap();
        }
        for trace in TRACES {
            let folder = tempfile::tempdir().unwrap();
            let file = LatchFile::new(folder.path());
            std::fs::create_dir(folder.path().join(trace)).unwrap();
            let state = file.load(&clock);
            let stop = state.latch().expect("stopped").clone();
            assert!(stop.reason.contains("missing"), "{stop:?}");
            // It stays so over restarts until somebody clears it.
            assert!(file.load(&clock).latch().is_some());
            file.save(&state.cleared(stop.id).unwrap().unwrap())
                .unwrap();
            assert_eq!(file.load(&clock).latch(), None);
        }
    }

    #[test]
    fn no_damage_of_a_latch_that_stops_the_robot_ever_frees_it() {
        let folder = tempfile::tempdir().unwrap();
        let (file, clock) = (LatchFile::new(folder.path()), SystemClock::shared());
        let stopped = StopState::latched(StopLatch {
            id: tread_api::ids::StopId::from_uuid(uuid::Uuid::from_u128(7)),
            by: "ada".to_owned(),
            reason: "a person is in the way".to_owned(),
            since: clock.wall(),
        });
        file.save(&stopped).unwrap();
        let path = folder.path().join(FILE_NAME);
        let intact = std::fs::read(&path).unwrap();
        let is_stopped = |bytes: &[u8]| {
            std::fs::write(&path, bytes).unwrap();
            file.load(&clock).latch().is_some()
        };
        for bit in 0..intact.len() * 8 {
            let mut damaged = intact.clone();
            damaged[bit / 8] ^= 1 << (bit % 8);
            assert!(is_stopped(&damaged), "bit {bit}");
        }
        for length in 0..intact.len() {
            assert!(is_stopped(&intact[..length]), "cut to {length} bytes");
            let mut zeroed = intact.clone();
            zeroed[length..].fill(0);
            assert!(is_stopped(&zeroed), "zeros from {length}");
        }
        // Of an earlier agent there is no checksum; a name that is damaged is no absent latch.
        let earlier = serde_json::to_string(&stopped).unwrap();
        assert!(is_stopped(earlier.as_bytes()));
        assert!(is_stopped(earlier.replace("latch", "lat#h").as_bytes()));
        assert!(!is_stopped(br#"{"latch":null,"seen":[]}"#));
    }
}
