//! Interactive screen of `tread watch`: selection, keys and actions. The terminal is restored on
//! every way out.

use std::time::Duration;

use anyhow::Context as _;
use crossterm::event::{KeyCode, KeyEvent, KeyEventKind, KeyModifiers};
use futures_util::StreamExt as _;
use futures_util::future::BoxFuture;
use futures_util::stream::FuturesUnordered;
use tokio::sync::mpsc;
use tokio::time::MissedTickBehavior;
use tread_api::event::Event;
use tread_api::ids::{AlertId, RobotId, SiteId};
use tread_api::stop::StopRobot;

use super::ended;
use super::feed::FeedMessage;
use super::picture::{Picture, draw};
use super::site_state::SiteState;
use super::view::{Order, Section, View};
use crate::args::WatchArguments;
use crate::client::Client;
use crate::commands::keys::Keyboard;

/// Number of rows by which the page keys move.
const PAGE_ROWS: usize = 10;

/// Action of a key beyond the screen itself.
#[derive(Debug, Clone, PartialEq, Eq)]
enum KeyAction {
    Quit,
    Stop(RobotId),
    Acknowledge(AlertId),
}

/// Interactive screen of a site.
pub(super) struct Screen<'client> {
    client: &'client Client,
    site: &'client SiteId,
    every: Duration,
    known: SiteState,
    shown: View,
    /// Requests without an answer yet.
    requests: FuturesUnordered<BoxFuture<'client, String>>,
}

/// Guard that restores the terminal when dropped, also on a panic.
struct Restored;

impl Drop for Restored {
    fn drop(&mut self) {
        ratatui::restore();
    }
}

impl<'client> Screen<'client> {
    pub(super) fn new(arguments: &'client WatchArguments, client: &'client Client) -> Self {
        Self {
            client,
            site: &arguments.connection.site,
            every: arguments.every,
            known: SiteState::default(),
            shown: View::default(),
            requests: FuturesUnordered::new(),
        }
    }

    /// Shows news and handles keys until the user quits.
    pub(super) async fn run(
        mut self,
        mut messages: mpsc::Receiver<FeedMessage>,
    ) -> anyhow::Result<()> {
        // The screen begins with the first news, so that a connection error is printed in the
        // normal terminal.
        let Some(first) = messages.recv().await else {
            return Ok(());
        };
        self.take(first);
        let restored = Restored;
        let mut terminal = ratatui::try_init().context("cannot draw in this terminal")?;
        let (keyboard, mut pressed) = Keyboard::read();
        let mut ticks = tokio::time::interval(self.every);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Skip);
        let ended = loop {
            tokio::select! {
                next = messages.recv() => match next {
                    Some(next) => self.take(next),
                    None => break Ok(()),
                },
                key = pressed.recv() => {
                    let Some(key) = key else {
                        break Err(anyhow::anyhow!("the terminal's input ended"));
                    };
                    match self.press(key) {
                        Some(KeyAction::Quit) => break Ok(()),
                        Some(action) => self.ask(action),
                        None => {}
                    }
                    ticks.reset_immediately();
                }
                Some(result) = self.requests.next() => self.shown.result = Some(result),
                _ = ticks.tick() => {
                    self.shown.mark(&self.known);
                    let picture = Picture {
                        site: self.site,
                        address: self.client.address(),
                        known: &self.known,
                        shown: &self.shown,
                    };
                    let drawn = terminal.draw(|frame| draw(frame, &picture));
                    if let Err(error) = drawn {
                        break Err(error).context("cannot draw in this terminal");
                    }
                }
            }
        };
        drop(restored);
        keyboard.end(pressed).await;
        ended
    }

    fn take(&mut self, message: FeedMessage) {
        match message {
            FeedMessage::Opened => self.shown.lost = None,
            FeedMessage::Lost(why) => self.shown.lost = Some(why),
            FeedMessage::Event(event) => {
                if let Event::End(end) = &*event {
                    self.shown.lost = Some(ended(*end).to_owned());
                }
                self.known.take(*event);
            }
        }
    }

    fn press(&mut self, key: KeyEvent) -> Option<KeyAction> {
        if key.kind == KeyEventKind::Release {
            return None;
        }
        if key.modifiers.contains(KeyModifiers::CONTROL) {
            let is_end = matches!(key.code, KeyCode::Char('c' | 'd'));
            return is_end.then_some(KeyAction::Quit);
        }
        self.shown.result = None;
        let page = isize::try_from(PAGE_ROWS).unwrap_or(isize::MAX);
        #[expect(
            clippy::wildcard_enum_match_arm,
            reason = "all other keys mean nothing"
        )]
        match key.code {
            KeyCode::Esc if self.shown.details => self.shown.details = false,
            KeyCode::Char('q') | KeyCode::Esc => return Some(KeyAction::Quit),
            KeyCode::Up | KeyCode::Char('k') => self.shown.move_by(&self.known, -1),
            KeyCode::Down | KeyCode::Char('j') => self.shown.move_by(&self.known, 1),
            KeyCode::PageUp => self.shown.move_by(&self.known, -page),
            KeyCode::PageDown => self.shown.move_by(&self.known, page),
            KeyCode::Home | KeyCode::Char('g') => self.shown.move_by(&self.known, isize::MIN),
            KeyCode::End | KeyCode::Char('G') => self.shown.move_by(&self.known, isize::MAX),
            KeyCode::Tab => self.shown.section = self.shown.section.next(),
            KeyCode::Enter => self.open(),
            KeyCode::Char('o') => {
                self.shown.order = match self.shown.order {
                    Order::Name => Order::Trouble,
                    Order::Trouble => Order::Name,
                };
            }
            KeyCode::Char('X') => {
                let robot = self.shown.robot(&self.known)?;
                return Some(KeyAction::Stop(robot.id.clone()));
            }
            KeyCode::Char('a') => {
                let alert = self.shown.alert(&self.known)?;
                return Some(KeyAction::Acknowledge(alert.id));
            }
            _ => {}
        }
        None
    }

    /// Shows the details of the selected robot, or of the robot of the selected mission or alert.
    fn open(&mut self) {
        let row = self.shown.row(&self.known, self.shown.section);
        let robot = match self.shown.section {
            Section::Robots => None,
            Section::Missions => {
                let missions = self.known.missions();
                missions.get(row).map(|mission| mission.robot.to_string())
            }
            Section::Alerts => {
                let alert = self.shown.alert(&self.known);
                alert.and_then(|alert| Some(alert.robot.as_ref()?.to_string()))
            }
        };
        if let Some(robot) = robot {
            self.shown.select_robot(robot);
        }
        self.shown.details = !self.shown.details;
        self.shown.section = Section::Robots;
    }

    fn ask(&mut self, action: KeyAction) {
        let (client, site) = (self.client, self.site);
        match action {
            KeyAction::Quit => {}
            KeyAction::Stop(robot) => {
                self.shown.result = Some(format!("stopping {robot} …"));
                self.requests.push(Box::pin(async move {
                    let words = StopRobot {
                        by: None,
                        reason: Some("from the watch".to_owned()),
                    };
                    match client.stop_robot(site, &robot, &words).await {
                        Ok(stop) if stop.confirmed_at.is_some() => {
                            format!(
                                "{robot} is stopped; clear it with: tread clear {robot} {}",
                                stop.id
                            )
                        }
                        Ok(_) => {
                            format!("{robot} has NOT CONFIRMED its stop; the stop is sent again")
                        }
                        Err(error) => format!("{robot} may not be stopped: {error}"),
                    }
                }));
            }
            KeyAction::Acknowledge(alert) => {
                self.requests.push(Box::pin(async move {
                    match client.acknowledge(alert).await {
                        Ok(alert) => format!("noted as seen: {}", alert.text),
                        Err(error) => format!("not noted: {error}"),
                    }
                }));
            }
        }
    }
}
