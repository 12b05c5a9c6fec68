//! The stop latch on the disk. An agent that cannot read it, or finds it damaged, starts stopped.

use std::io;
use std::path::{Path, PathBuf};

use tracing::error;
use tread_api::safety::StopLatch;

use super::stop::StopState;
use crate::clock::SharedClock;
use crate::durable;

const FILE_NAME: &str = "stop.json";

/// The file in which the latch outlives the process.
#[derive(Debug, Clone)]
pub(crate) struct LatchFile {
    folder: PathBuf,
}

impl LatchFile {
    /// The latch in a folder, which must exist.
    pub(crate) fn new(folder: &Path) -> Self {
        Self {
            folder: folder.to_owned(),
        }
    }

    /// Reads it; a robot's first start finds nothing and is free. What cannot be read stops.
    pub(crate) fn load(&self, clock: &SharedClock) -> StopState {
        let path = self.folder.join(FILE_NAME);
        let problem = match std::fs::read(&path) {
            Ok(file) => match durable::unsealed(&file).map(serde_json::from_slice) {
                Ok(Ok(state)) => return state,
                Ok(Err(cause)) => cause.to_string(),
                Err(cause) => cause.to_string(),
            },
            Err(cause) if cause.kind() == io::ErrorKind::NotFound => return StopState::default(),
            Err(cause) => cause.to_string(),
        };
        error!(
            problem,
            "the stop latch `{}` cannot be read: starting stopped",
            path.display()
        );
        StopState::latched(StopLatch {
            id: tread_api::ids::StopId::from_uuid(uuid::Uuid::new_v4()),
            by: "the agent".to_owned(),
            reason: "the stop latch on the robot's disk cannot be read".to_owned(),
            since: clock.wall(),
        })
    }

    /// Writes it and waits until the disk has it. Blocks.
    ///
    /// # Errors
    /// What the operating system said; the former content stays then.
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
        assert_eq!(file.load(&clock), StopState::default());
        std::fs::write(folder.path().join(FILE_NAME), b"{\"latch\":").unwrap();
        let state = file.load(&clock);
        let id = state.latch().expect("stopped").id;
        let cleared = state.cleared(id).unwrap().unwrap();
        file.save(&cleared).unwrap();
        assert_eq!(file.load(&clock), cleared);
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
