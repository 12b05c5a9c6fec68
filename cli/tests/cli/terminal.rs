//! A program in a terminal of its own, with its screen as plain text.

use std::fs::File;
use std::io::{Read as _, Write as _};
use std::os::fd::{AsFd as _, OwnedFd};
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use nix::pty::{Winsize, openpty};
use nix::sys::termios::{LocalFlags, tcgetattr};

/// Longest wait for anything.
pub(crate) const PATIENCE: Duration = Duration::from_secs(20);
/// What holds of a lock that nobody breaks.
const WHOLE: &str = "nobody panics with it";
const LOOK_AGAIN: Duration = Duration::from_millis(20);

/// Waits until something is so.
pub(crate) async fn eventually(what: &str, mut is: impl FnMut() -> bool) {
    let waiting = async {
        while !is() {
            tokio::time::sleep(LOOK_AGAIN).await;
        }
    };
    let waited = tokio::time::timeout(PATIENCE, waiting).await;
    assert!(waited.is_ok(), "not within {PATIENCE:?}: {what}");
}

/// A program in a terminal; it is killed when this is dropped.
pub(crate) struct Terminal {
    child: Child,
    keys: File,
    /// The program's side of the terminal, to look at its settings.
    settings: OwnedFd,
    screen: Arc<Mutex<String>>,
}

impl Terminal {
    pub(crate) fn run(program: &str, words: &[&str]) -> Self {
        let size = Winsize {
            ws_row: 24,
            ws_col: 160,
            ws_xpixel: 0,
            ws_ypixel: 0,
        };
        let pty = openpty(&size, None).expect("a terminal");
        let end = || Stdio::from(pty.slave.try_clone().expect("a descriptor"));
        let child = Command::new(program)
            .args(words)
            .env_remove("TREAD_TOKEN")
            .env("TERM", "xterm")
            .stdin(end())
            .stdout(end())
            .stderr(end())
            .spawn()
            .expect("the program can be started");
        let keys = File::from(pty.master);
        let mut output = keys.try_clone().expect("a descriptor");
        let screen = Arc::new(Mutex::new(String::new()));
        let shown = Arc::clone(&screen);
        std::thread::spawn(move || {
            let mut bytes = [0; 4_096];
            while let Ok(count @ 1..) = output.read(&mut bytes) {
                let text = String::from_utf8_lossy(&bytes[..count]);
                shown.lock().expect(WHOLE).push_str(&text);
            }
        });
        Self {
            child,
            keys,
            settings: pty.slave,
            screen,
        }
    }

    /// Types something.
    pub(crate) fn press(&mut self, keys: &str) {
        let typed = self.keys.write_all(keys.as_bytes());
        typed.expect("the terminal takes keys");
    }

    /// All that was shown so far.
    pub(crate) fn screen(&self) -> String {
        self.screen.lock().expect(WHOLE).clone()
    }

    /// Waits until a text was shown.
    pub(crate) async fn shows(&mut self, text: &str) {
        let shown = self.shows_or_ends(text).await;
        assert!(shown, "`{text}` is not shown: {}", self.screen());
    }

    /// Waits until a text was shown, or the program has ended without.
    pub(crate) async fn shows_or_ends(&mut self, text: &str) -> bool {
        let mut has_ended = false;
        let (screen, child) = (Arc::clone(&self.screen), &mut self.child);
        eventually(text, || {
            let is_shown = screen.lock().expect(WHOLE).contains(text);
            // One more look after the end: what was said last may come late.
            let ended_before = std::mem::replace(
                &mut has_ended,
                child.try_wait().expect("it is a child").is_some(),
            );
            is_shown || ended_before
        })
        .await;
        self.screen().contains(text)
    }

    /// Waits until the program has ended; its exit code.
    pub(crate) async fn ended(&mut self) -> Option<i32> {
        let child = &mut self.child;
        let mut status = None;
        eventually("the program ends", || {
            status = child.try_wait().expect("it is a child");
            status.is_some()
        })
        .await;
        status.and_then(|status| status.code())
    }

    /// Whether keys come singly and unseen, rather than in lines.
    pub(crate) fn is_raw(&self) -> bool {
        let flags = tcgetattr(self.settings.as_fd())
            .expect("it is a terminal")
            .local_flags;
        !flags.intersects(LocalFlags::ICANON | LocalFlags::ECHO)
    }
}

impl Drop for Terminal {
    fn drop(&mut self) {
        let _ended = self.child.kill();
        let _reaped = self.child.wait();
    }
}
