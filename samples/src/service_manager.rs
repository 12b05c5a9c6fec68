//! A service manager that a test plays: it receives what a program says by systemd's notification
//! protocol.

use std::io;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use tokio::net::UnixDatagram;

/// Longest message; systemd reads no longer ones either.
const MESSAGE_BYTES_MAX: usize = 4_096;

/// A socket for the messages of one program.
#[derive(Debug)]
pub struct ServiceManager {
    socket: UnixDatagram,
    path: PathBuf,
}

impl ServiceManager {
    /// Listens on a socket in a folder.
    ///
    /// # Errors
    /// The socket cannot be made.
    pub fn listen(folder: &Path) -> io::Result<Self> {
        let path = folder.join("notify");
        let socket = UnixDatagram::bind(&path)?;
        Ok(Self { socket, path })
    }

    /// Lets a program know that its messages are awaited, and one to the watchdog within each
    /// `timeout`.
    pub fn attend(&self, program: &mut Command, timeout: Duration) {
        program
            .env("NOTIFY_SOCKET", &self.path)
            .env("WATCHDOG_USEC", timeout.as_micros().to_string())
            .env_remove("WATCHDOG_PID");
    }

    /// Waits for a message that has a line which begins so, and returns the rest of that line and the
    /// whole message; `None` if none comes within `patience`.
    pub async fn next(&self, begin: &str, patience: Duration) -> Option<(String, String)> {
        let waiting = async {
            loop {
                let mut bytes = [0; MESSAGE_BYTES_MAX];
                let length = self.socket.recv(&mut bytes).await.ok()?;
                let message = String::from_utf8_lossy(&bytes[..length]).into_owned();
                let found = message.lines().find_map(|line| line.strip_prefix(begin));
                if let Some(rest) = found {
                    return Some((rest.to_owned(), message.clone()));
                }
            }
        };
        tokio::time::timeout(patience, waiting).await.ok().flatten()
    }

    /// Reads what has arrived so far.
    pub fn drain(&self) {
        let mut bytes = [0; MESSAGE_BYTES_MAX];
        while self.socket.try_recv(&mut bytes).is_ok() {}
    }
}
