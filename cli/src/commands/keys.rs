//! Single key events of the terminal, read by a thread.

use std::thread::JoinHandle;
use std::time::Duration;

use crossterm::event::{self, Event, KeyEvent};
use tokio::sync::mpsc;

/// Maximum number of key events in the queue; further ones are dropped.
const KEYS_MAX: usize = 64;
/// Period at which the thread checks whether to end.
const KEY_POLL: Duration = Duration::from_millis(50);

/// Thread that reads key events until its receiver is dropped.
pub(super) struct Keyboard {
    reading: JoinHandle<()>,
}

impl Keyboard {
    /// Starts the thread. The terminal must be in raw mode.
    pub(super) fn read() -> (Self, mpsc::Receiver<KeyEvent>) {
        let (keys, pressed) = mpsc::channel(KEYS_MAX);
        let reading = std::thread::spawn(move || read_keys(&keys));
        (Self { reading }, pressed)
    }

    /// Ends the thread, so that other code can read the keyboard.
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
                // When the queue is full, keys are being held; a lost repetition does no harm.
                Ok(Event::Key(key)) => _ = keys.try_send(key),
                Ok(_) => {}
                Err(_) => return,
            },
            Err(_) => return,
        }
    }
}
