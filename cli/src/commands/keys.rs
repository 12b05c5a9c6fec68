//! Keys of the terminal, one by one.

use std::thread::JoinHandle;
use std::time::Duration;

use crossterm::event::{self, Event, KeyEvent};
use tokio::sync::mpsc;

/// Keys that may wait.
const KEYS_MAX: usize = 64;
/// How often the keyboard is looked at, so that its thread ends soon after the rest.
const KEY_POLL: Duration = Duration::from_millis(50);

/// A thread that reads keys until nobody takes them.
pub(super) struct Keyboard {
    reading: JoinHandle<()>,
}

impl Keyboard {
    /// Starts to read. The terminal must give single keys.
    pub(super) fn read() -> (Self, mpsc::Receiver<KeyEvent>) {
        let (keys, pressed) = mpsc::channel(KEYS_MAX);
        let reading = std::thread::spawn(move || read_keys(&keys));
        (Self { reading }, pressed)
    }

    /// Ends the thread; whoever comes next has the keyboard for itself.
    pub(super) async fn end(self, pressed: mpsc::Receiver<KeyEvent>) {
        drop(pressed);
        let reading = self.reading;
        // A thread that panicked has ended as well.
        let _ = tokio::task::spawn_blocking(move || reading.join()).await;
    }
}

fn read_keys(keys: &mpsc::Sender<KeyEvent>) {
    while !keys.is_closed() {
        match event::poll(KEY_POLL) {
            Ok(false) => {}
            Ok(true) => match event::read() {
                // What does not fit is one key more of those that are held.
                Ok(Event::Key(key)) => _ = keys.try_send(key),
                Ok(_) => {}
                Err(_) => return,
            },
            Err(_) => return,
        }
    }
}
