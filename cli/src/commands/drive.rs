//! `tread drive`: teleoperates a robot from the terminal.
//!
//! A terminal reports when a key is pressed and repeats it while it is held, but not when it is
//! released. Each key event therefore drives the robot for a time somewhat longer than the delay
//! before the first repetition. Without a key the robot stops. The terminal is restored on every
//! way out.

use std::io::{self, IsTerminal as _, Write as _};
use std::process::ExitCode;
use std::time::Duration;

use anyhow::{Context, bail};
use crossterm::event::{KeyCode, KeyEvent, KeyEventKind, KeyModifiers};
use crossterm::{cursor, execute, terminal};
use futures_util::{SinkExt as _, StreamExt as _};
use tokio::sync::mpsc;
use tokio::time::{Instant, MissedTickBehavior};
use tokio_tungstenite::tungstenite::{Error, Message};
use tread_api::drive::{
    Drive, DriveRequest, DriveUpdate, DriveView, DriverName, EmptyBody, StopReason,
};
use tread_api::safety::GateCause;
use tread_api::text::escaped;

use super::keys::Keyboard;
use super::robots::{link_name, mode_name};
use crate::args::DriveArguments;
use crate::client::Client;
use crate::output::{age, line, signed};
use crate::signals::ShutdownSignals;
use crate::socket::{self, Socket};

/// Period of drive commands.
const SEND_PERIOD: Duration = Duration::from_millis(50);
/// Duration of each drive command, milliseconds.
const FOR_MS: u64 = 200;
/// Time for which a key is in effect after its last event; longer than the usual delay before a key
/// repeats.
const KEY_HOLDS: Duration = Duration::from_millis(550);
/// Maximum time for connecting to the server, and for closing the socket.
const CONNECT_MAX: Duration = Duration::from_secs(5);
/// Help line with the keys.
const HELP: &str = "arrows or WASD drive, let go to halt · space or x stops and latches · q quits";

/// Terminal in raw mode, in which keys are read one by one. Dropping it restores the terminal, also
/// on a panic.
struct RawTerminal;

impl RawTerminal {
    fn enter() -> anyhow::Result<Self> {
        terminal::enable_raw_mode().context("cannot read single keys from this terminal")?;
        let raw = Self;
        execute!(io::stdout(), cursor::Hide).context("cannot print")?;
        Ok(raw)
    }

    /// Overwrites the current line.
    #[expect(clippy::unused_self, reason = "the terminal must be raw for it")]
    fn show(&self, text: &str) -> anyhow::Result<()> {
        let (width, _) = terminal::size().unwrap_or((80, 24));
        let text: String = text.chars().take(usize::from(width.max(2)) - 1).collect();
        let mut out = io::stdout();
        execute!(out, terminal::Clear(terminal::ClearType::CurrentLine)).context("cannot print")?;
        write!(out, "\r{text}").context("cannot print")?;
        out.flush().context("cannot print")
    }

    /// Writes a line and moves to the next.
    fn print_line(&self, text: &str) -> anyhow::Result<()> {
        self.show(text)?;
        write!(io::stdout(), "\r\n").context("cannot print")
    }
}

impl Drop for RawTerminal {
    fn drop(&mut self) {
        // An error here cannot be handled.
        let _ = terminal::disable_raw_mode();
        let _ = execute!(io::stdout(), cursor::Show);
        let _ = writeln!(io::stdout());
    }
}

/// Effect of a key.
#[derive(Debug, Clone, Copy, PartialEq)]
enum KeyEffect {
    /// Fraction of the full speed, -1 to 1.
    Linear(f64),
    /// Fraction of the full yaw rate, -1 to 1.
    Angular(f64),
    Stop,
    Quit,
    Nothing,
}

#[expect(
    clippy::wildcard_enum_match_arm,
    reason = "all other keys mean nothing"
)]
fn key_effect(key: KeyEvent) -> KeyEffect {
    if key.kind == KeyEventKind::Release {
        return KeyEffect::Nothing;
    }
    if key.modifiers.contains(KeyModifiers::CONTROL) {
        return match key.code {
            KeyCode::Char('c' | 'd') => KeyEffect::Quit,
            _ => KeyEffect::Nothing,
        };
    }
    match key.code {
        KeyCode::Up | KeyCode::Char('w' | 'W') => KeyEffect::Linear(1.0),
        KeyCode::Down | KeyCode::Char('s' | 'S') => KeyEffect::Linear(-1.0),
        KeyCode::Left | KeyCode::Char('a' | 'A') => KeyEffect::Angular(1.0),
        KeyCode::Right | KeyCode::Char('d' | 'D') => KeyEffect::Angular(-1.0),
        KeyCode::Char(' ' | 'x' | 'X') => KeyEffect::Stop,
        KeyCode::Char('q' | 'Q') | KeyCode::Esc => KeyEffect::Quit,
        _ => KeyEffect::Nothing,
    }
}

/// Last keys for speed and yaw rate, each with the time of its event.
#[derive(Debug, Clone, Copy, Default)]
struct Keys {
    linear: Option<(f64, Instant)>,
    angular: Option<(f64, Instant)>,
}

impl Keys {
    fn shares(&self, now: Instant) -> (f64, f64) {
        let share = |key: Option<(f64, Instant)>| {
            let held = key.filter(|(_, at)| now.saturating_duration_since(*at) < KEY_HOLDS);
            held.map_or(0.0, |(share, _)| share)
        };
        (share(self.linear), share(self.angular))
    }
}

pub(super) async fn run(arguments: &DriveArguments, client: &Client) -> anyhow::Result<ExitCode> {
    if !io::stdin().is_terminal() || !io::stdout().is_terminal() {
        bail!("teleoperation needs a terminal; programs use the WebSocket of the API");
    }
    let mut socket = connect(arguments, client).await?;
    let driver = DriverName {
        name: arguments.name.clone(),
    };
    let request = if arguments.take {
        DriveRequest::Take(driver)
    } else {
        DriveRequest::Acquire(driver)
    };
    send(&mut socket, &request).await?;
    line(HELP)?;
    let mut signals = ShutdownSignals::listen()?;
    let terminal = RawTerminal::enter()?;
    let (keyboard, mut pressed) = Keyboard::read();
    let ended = Driving {
        terminal: &terminal,
        client,
        arguments,
        keys: Keys::default(),
        has_lease: false,
        is_refused: false,
    }
    .run(&mut socket, &mut pressed, &mut signals)
    .await;
    drop(terminal);
    // The server stops the robot when the socket closes, whether or not this message arrives.
    let _ = send(&mut socket, &DriveRequest::Release(EmptyBody {})).await;
    let _ = tokio::time::timeout(CONNECT_MAX, socket.close(None)).await;
    keyboard.end(pressed).await;
    ended
}

async fn connect(arguments: &DriveArguments, client: &Client) -> anyhow::Result<Socket> {
    let (site, robot) = (&arguments.connection.site, &arguments.robot);
    // Requested first, for a clear error message if the robot does not exist.
    client.robot(site, robot).await?;
    let opening = tokio::time::timeout(CONNECT_MAX, socket::open(client, site, robot));
    let opened = opening.await;
    Ok(opened.with_context(|| format!("{} does not answer", client.address()))??)
}

async fn send(socket: &mut Socket, request: &DriveRequest) -> anyhow::Result<()> {
    let text = serde_json::to_string(request).context("cannot write a request")?;
    match socket.send(Message::text(text)).await {
        Ok(()) | Err(Error::ConnectionClosed | Error::AlreadyClosed) => Ok(()),
        Err(error) => Err(error).context("the connection to the server is lost"),
    }
}

struct Driving<'terminal> {
    terminal: &'terminal RawTerminal,
    client: &'terminal Client,
    arguments: &'terminal DriveArguments,
    keys: Keys,
    has_lease: bool,
    is_refused: bool,
}

impl Driving<'_> {
    async fn run(
        mut self,
        socket: &mut Socket,
        pressed: &mut mpsc::Receiver<KeyEvent>,
        signals: &mut ShutdownSignals,
    ) -> anyhow::Result<ExitCode> {
        let mut ticks = tokio::time::interval(SEND_PERIOD);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Skip);
        loop {
            tokio::select! {
                () = signals.next() => return Ok(ExitCode::SUCCESS),
                key = pressed.recv() => {
                    let Some(key) = key else {
                        bail!("the terminal's input ended");
                    };
                    if !self.press(socket, key).await? {
                        return Ok(ExitCode::SUCCESS);
                    }
                }
                _ = ticks.tick() => self.drive(socket).await?,
                frame = socket.next() => match frame {
                    Some(Ok(Message::Text(text))) => {
                        self.read(&text)?;
                        if self.is_refused {
                            return Ok(ExitCode::FAILURE);
                        }
                    }
                    Some(Ok(Message::Close(frame))) => {
                        let why = frame.map(|frame| escaped(&frame.reason).into_owned());
                        bail!("the server closed the connection: {}", why.unwrap_or_default());
                    }
                    Some(Ok(_)) => {}
                    Some(Err(error)) => {
                        return Err(error).context("the connection to the server is lost");
                    }
                    None => bail!("the server closed the connection"),
                },
            }
        }
    }

    /// Handles a key; returns false to quit.
    async fn press(&mut self, socket: &mut Socket, key: KeyEvent) -> anyhow::Result<bool> {
        match key_effect(key) {
            KeyEffect::Linear(share) => self.keys.linear = Some((share, Instant::now())),
            KeyEffect::Angular(share) => self.keys.angular = Some((share, Instant::now())),
            KeyEffect::Stop => {
                self.keys = Keys::default();
                let words = StopReason {
                    by: Some(self.arguments.name.clone()),
                    reason: Some("from the terminal".to_owned()),
                };
                send(socket, &DriveRequest::Stop(words)).await?;
            }
            KeyEffect::Quit => return Ok(false),
            KeyEffect::Nothing => {}
        }
        Ok(true)
    }

    async fn drive(&self, socket: &mut Socket) -> anyhow::Result<()> {
        if !self.has_lease {
            return Ok(());
        }
        let (linear, angular) = self.keys.shares(Instant::now());
        let drive = Drive {
            linear_m_s: linear * self.arguments.speed,
            angular_rad_s: angular * self.arguments.turn,
            for_ms: Some(FOR_MS),
        };
        send(socket, &DriveRequest::Drive(drive)).await
    }

    fn read(&mut self, text: &str) -> anyhow::Result<()> {
        let update: DriveUpdate = self
            .client
            .read(text.as_bytes())
            .context("the server sent an unknown message")?;
        match update {
            DriveUpdate::Welcome { .. } => Ok(()),
            DriveUpdate::Leased(lease) => {
                self.has_lease = true;
                self.terminal
                    .print_line(&format!("you hold lease {}", lease.epoch))
            }
            DriveUpdate::Released { detail, .. } => {
                self.has_lease = false;
                self.is_refused = true;
                self.terminal
                    .print_line(&format!("the lease has ended: {detail}"))
            }
            DriveUpdate::Refused { detail, .. } => {
                // Without a lease the command cannot continue.
                self.is_refused = !self.has_lease;
                self.terminal.print_line(&format!("refused: {detail}"))
            }
            DriveUpdate::Stopped(stop) => {
                let how = if stop.confirmed_at.is_some() {
                    "confirmed"
                } else {
                    "NOT CONFIRMED, the stop is sent again"
                };
                let text = format!(
                    "stopped, {how}; clear it with: tread clear {} {}",
                    stop.robot, stop.id
                );
                self.terminal.print_line(&text)
            }
            DriveUpdate::View(view) => self.terminal.show(&status(&view)),
            DriveUpdate::Ended { detail } => self.terminal.print_line(&format!("ended: {detail}")),
        }
    }
}

fn status(view: &DriveView) -> String {
    let mode = view.mode.map_or("-", mode_name);
    let speed = view.twist.map_or_else(
        || "-".to_owned(),
        |twist| {
            let twist = twist.value;
            format!(
                "{} m/s {} rad/s",
                signed(twist.linear_m_s, 2),
                signed(twist.angular_rad_s, 2)
            )
        },
    );
    let latency = view.latency_ms.map_or_else(
        || "-".to_owned(),
        |latency_ms| format!("{latency_ms:.0} ms"),
    );
    let heard = view.state_age_ms.map_or_else(|| "-".to_owned(), age);
    let driver = view.safety.lease.as_ref();
    let driver = driver.map_or("nobody", |lease| lease.driver.name.as_str());
    // A narrow terminal cuts the line at its end, so the most important parts come first.
    let stop = view.safety.stop.as_ref();
    let stop = stop.map_or(String::new(), |stop| format!("STOPPED by {} · ", stop.by));
    let slowed = view.safety.gate.cause.and_then(slowed_by);
    let slowed = slowed.map_or(String::new(), |cause| format!(" ({cause})"));
    format!(
        "{stop}{} · {mode} · {speed}{slowed} · latency {latency} · heard {heard} ago · driver {driver}",
        link_name(view.link)
    )
}

/// Returns the reason why the robot drives slower than commanded; `None` for causes that the driver
/// need not see.
fn slowed_by(cause: GateCause) -> Option<&'static str> {
    match cause {
        GateCause::CommandAge => Some("slow: commands arrive late"),
        GateCause::ExternalLimit => Some("slow: another program limits it"),
        GateCause::Fence => Some("slow: the geofence is near"),
        GateCause::LinkPolicy => Some("held: the server was silent"),
        GateCause::ExternalHold => Some("held by another program"),
        GateCause::LoopOverrun => Some("held: its control loop is overloaded"),
        GateCause::SensorFault => Some("slow or held: its sensors contradict each other"),
        GateCause::StalePosition => Some("slow or held: its position is stale"),
        GateCause::Tilt => Some("held: its tilt is too large"),
        GateCause::StaleFeedback => Some("held: its base sends no measurements"),
        GateCause::Acceleration
        | GateCause::Speed
        | GateCause::NotFinite
        | GateCause::NoCommand
        | GateCause::Lease
        | GateCause::Stop
        | GateCause::Other => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_narrow_terminal_shows_first_that_the_robot_is_stopped_and_why_it_is_slow() {
        let mut view: DriveView = serde_json::from_value(serde_json::json!({
            "link": "online", "state_age_ms": 20, "mode": "stopped", "pose": null, "twist": null,
            "mission": null, "latency_ms": 12.0, "socket_ms": 1.0,
            "safety": {
                "stop": {"id": "00000000-0000-0000-0000-000000000001", "by": "Ann",
                         "reason": "smoke", "since": "2026-11-01T00:00:00Z"},
                "gate": {"cause": "stop", "reduced_ticks": 1, "counts": []},
            },
        }))
        .unwrap();
        assert!(status(&view).starts_with("STOPPED by Ann · online"));
        view.safety.stop = None;
        view.safety.gate.cause = Some(GateCause::Fence);
        let shown = status(&view);
        assert!(
            shown.starts_with("online") && shown.contains("geofence"),
            "{shown}"
        );
    }

    fn key(code: KeyCode) -> KeyEvent {
        KeyEvent::new(code, KeyModifiers::NONE)
    }

    #[test]
    fn keys_drive_for_a_moment_and_both_ways_at_once() {
        let (mut keys, start) = (Keys::default(), Instant::now());
        assert_eq!(keys.shares(start), (0.0, 0.0));
        keys.linear = Some((1.0, start));
        keys.angular = Some((-1.0, start + KEY_HOLDS / 2));
        assert_eq!(keys.shares(start + KEY_HOLDS / 2), (1.0, -1.0));
        assert_eq!(keys.shares(start + KEY_HOLDS), (0.0, -1.0));
        assert_eq!(keys.shares(start + 2 * KEY_HOLDS), (0.0, 0.0));
    }

    #[test]
    fn every_key_means_what_the_help_says() {
        assert_eq!(key_effect(key(KeyCode::Up)), KeyEffect::Linear(1.0));
        assert_eq!(key_effect(key(KeyCode::Char('a'))), KeyEffect::Angular(1.0));
        assert_eq!(key_effect(key(KeyCode::Char(' '))), KeyEffect::Stop);
        assert!(HELP.contains("space or x stops and latches"));
        assert_eq!(key_effect(key(KeyCode::Char('x'))), KeyEffect::Stop);
        assert_eq!(key_effect(key(KeyCode::Esc)), KeyEffect::Quit);
        assert_eq!(
            key_effect(key(KeyCode::Char('d'))),
            KeyEffect::Angular(-1.0)
        );
        let control_c = KeyEvent::new(KeyCode::Char('c'), KeyModifiers::CONTROL);
        assert_eq!(key_effect(control_c), KeyEffect::Quit);
        let mut released = key(KeyCode::Up);
        released.kind = KeyEventKind::Release;
        assert_eq!(key_effect(released), KeyEffect::Nothing);
        assert_eq!(key_effect(key(KeyCode::F(1))), KeyEffect::Nothing);
    }
}
