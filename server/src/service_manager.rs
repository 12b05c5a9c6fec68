//! Messages to the service manager (systemd) by its notification protocol: ready, stopping, what
//! the server does, and the watchdog.
//!
//! ```text
//! READY=1      once the REST API and the robots' port answer
//! WATCHDOG=1   each quarter of WATCHDOG_USEC, while no task blocks its thread ([`crate::liveness`])
//! STATUS=…     whenever it has changed
//! STOPPING=1   when the stop begins
//! ```
//!
//! The watchdog ignores storage and readiness: a restart mends no full disk, and would take Stop
//! and teleoperation away, which work without the disk. Without `NOTIFY_SOCKET` nothing is sent.

use std::fmt::Write as _;
use std::io;
use std::os::unix::net::UnixDatagram;
use std::path::Path;
use std::time::Duration;

use sd_notify::NotifyState;
use tokio_util::sync::CancellationToken;
use tracing::{error, warn};
use tread_api::rights::Scope;

use crate::app::App;
use crate::liveness::Liveness;

/// Messages to the watchdog in the time that it waits for one: some may be late.
const MESSAGES_PER_TIMEOUT: u32 = 4;
/// Interval of checks of the status if there is no watchdog.
const STATUS_EVERY: Duration = Duration::from_secs(10);

/// Sends messages; one that cannot be sent is logged.
pub(crate) fn notify(states: &[NotifyState<'_>]) {
    if let Err(error) = send(states) {
        warn!("cannot notify the service manager: {error}");
    }
}

/// Sends messages without waiting: a service manager that does not read must not block a thread.
fn send(messages: &[NotifyState<'_>]) -> io::Result<()> {
    let Some(path) = std::env::var_os("NOTIFY_SOCKET") else {
        return Ok(());
    };
    let mut text = String::new();
    for message in messages {
        // Writing to a string cannot fail.
        let _ = writeln!(text, "{message}");
    }
    let socket = UnixDatagram::unbound()?;
    socket.set_nonblocking(true)?;
    socket.send_to(text.as_bytes(), Path::new(&path))?;
    Ok(())
}

/// Returns whether a service manager waits for messages.
pub(crate) fn is_present() -> bool {
    std::env::var_os("NOTIFY_SOCKET").is_some()
}

/// Returns what the server does, in one line.
fn status(app: &App, address: &str) -> String {
    let robots = app.presences().present_count(&Scope::EVERYWHERE);
    let robots = match robots {
        1 => "1 robot".to_owned(),
        count => format!("{count} robots"),
    };
    match app.storage_condition().problem() {
        None => format!("{robots} connected, REST API on {address}"),
        Some(problem) => format!("the storage fails ({problem}); {robots} connected"),
    }
}

/// Says that the server is ready, and feeds the watchdog until the stop.
pub(crate) async fn run(app: App, address: String, liveness: Liveness, stop: CancellationToken) {
    let watchdog = sd_notify::watchdog_enabled();
    let every = watchdog.map_or(STATUS_EVERY, |timeout| timeout / MESSAGES_PER_TIMEOUT);
    let mut sent_status = status(&app, &address);
    notify(&[NotifyState::Ready, NotifyState::Status(&sent_status)]);
    let mut blocked = None;
    loop {
        let now_blocked = liveness.begin_round();
        if now_blocked.is_none() && watchdog.is_some() {
            notify(&[NotifyState::Watchdog]);
        }
        if let (Some(task), None) = (now_blocked, blocked) {
            error!("task `{task}` blocks its thread: the watchdog is no longer fed");
        }
        blocked = now_blocked;
        tokio::select! {
            () = stop.cancelled() => break,
            () = tokio::time::sleep(every) => {}
        }
        let present = status(&app, &address);
        if present != sent_status {
            sent_status = present;
            notify(&[NotifyState::Status(&sent_status)]);
        }
    }
    notify(&[NotifyState::Stopping, NotifyState::Status("stopping")]);
}
