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
use tread_api::robot::{Alert, LinkState, Robot};
use tread_api::stop::StopRobot;

use super::ended;
use super::feed::News;
use super::known::Known;
use super::picture::{Picture, draw};
use crate::args::WatchArguments;
use crate::client::Client;
use crate::commands::keys::Keyboard;

/// Number of rows by which the page keys move.
const PAGE_ROWS: usize = 10;

/// Table to which the keys apply.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) enum Section {
    #[default]
    Robots,
    Missions,
    Alerts,
}

impl Section {
    const ALL: [Self; 3] = [Self::Robots, Self::Missions, Self::Alerts];

    fn next(self) -> Self {
        let at = Self::ALL.iter().position(|section| *section == self);
        Self::ALL[(at.unwrap_or_default() + 1) % Self::ALL.len()]
    }
}

/// Order of the robots.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) enum Order {
    #[default]
    Name,
    /// Robots that need attention first: stopped, offline, stale.
    Trouble,
}

/// State of the screen besides the data of the site.
#[derive(Debug, Default)]
pub(super) struct Shown {
    pub(super) section: Section,
    pub(super) order: Order,
    /// Selected object of each section, by its identifier, so that an action applies to the
    /// selected object even if its row has moved.
    selected: [Option<String>; 3],
    /// Whether the details of the selected robot replace its table.
    pub(super) details: bool,
    /// Result of the last action.
    pub(super) said: Option<String>,
    /// Reason why no events arrive; `None` while they do.
    pub(super) lost: Option<String>,
}

impl Shown {
    /// Returns the identifiers in a section, in their order.
    fn listed(&self, known: &Known, section: Section) -> Vec<String> {
        match section {
            Section::Robots => {
                let robots = self.robots(known).into_iter();
                robots.map(|robot| robot.id.to_string()).collect()
            }
            Section::Missions => {
                let missions = known.missions().into_iter();
                missions.map(|mission| mission.id.to_string()).collect()
            }
            Section::Alerts => {
                let alerts = known.alerts().into_iter();
                alerts.map(|alert| alert.id.to_string()).collect()
            }
        }
    }

    /// Returns the selected row of a section; the first one if nothing is selected.
    pub(super) fn row(&self, known: &Known, section: Section) -> usize {
        let selected = self.selected[section as usize].as_ref();
        let listed = self.listed(known, section);
        let at = listed.iter().position(|id| Some(id) == selected);
        at.unwrap_or_default()
    }

    fn move_by(&mut self, known: &Known, rows: isize) {
        let listed = self.listed(known, self.section);
        let row = self.row(known, self.section).saturating_add_signed(rows);
        let row = row.min(listed.len().saturating_sub(1));
        self.selected[self.section as usize] = listed.get(row).cloned();
    }

    /// Fixes the selection to the objects that are drawn as selected, so that it follows them when
    /// rows move.
    fn mark(&mut self, known: &Known) {
        if !known.is_whole() {
            // Rows are still missing.
            return;
        }
        for section in Section::ALL {
            let row = self.row(known, section);
            let listed = self.listed(known, section);
            self.selected[section as usize] = listed.get(row).cloned();
        }
    }

    /// Returns the robots in the chosen order.
    pub(super) fn robots<'known>(&self, known: &'known Known) -> Vec<&'known Robot> {
        let mut robots: Vec<&Robot> = known.robots().collect();
        if self.order == Order::Trouble {
            robots.sort_by_key(|robot| std::cmp::Reverse(trouble(robot)));
        }
        robots
    }

    /// Returns the selected robot.
    pub(super) fn robot<'known>(&self, known: &'known Known) -> Option<&'known Robot> {
        let selected = self.selected[Section::Robots as usize].as_deref();
        known
            .robots()
            .find(|robot| Some(robot.id.as_str()) == selected)
    }

    /// Returns the selected alert.
    fn alert<'known>(&self, known: &'known Known) -> Option<&'known Alert> {
        let selected = self.selected[Section::Alerts as usize].as_deref();
        let mut alerts = known.alerts().into_iter();
        alerts.find(|alert| Some(alert.id.to_string().as_str()) == selected)
    }
}

/// Returns a score of how much a robot needs attention; higher comes first.
fn trouble(robot: &Robot) -> u8 {
    let live = robot.live.as_ref();
    let is_stopped = live.is_some_and(|live| live.safety.stop.is_some() || live.fault.is_some());
    let link = match robot.link {
        LinkState::Online => 0,
        LinkState::Stale => 1,
        LinkState::Offline => 2,
    };
    let alerts = u8::from(!robot.alerts.is_empty());
    8 * u8::from(is_stopped) + 2 * link + alerts
}

/// Action of a key beyond the screen itself.
#[derive(Debug, Clone, PartialEq, Eq)]
enum Wish {
    Quit,
    Stop(RobotId),
    Acknowledge(AlertId),
}

/// Interactive screen of a site.
pub(super) struct Screen<'client> {
    client: &'client Client,
    site: &'client SiteId,
    every: Duration,
    known: Known,
    shown: Shown,
    /// Requests without an answer yet.
    asked: FuturesUnordered<BoxFuture<'client, String>>,
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
            known: Known::default(),
            shown: Shown::default(),
            asked: FuturesUnordered::new(),
        }
    }

    /// Shows news and handles keys until the user quits.
    pub(super) async fn run(mut self, mut news: mpsc::Receiver<News>) -> anyhow::Result<()> {
        // The screen begins with the first news, so that a connection error is printed in the
        // normal terminal.
        let Some(first) = news.recv().await else {
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
                next = news.recv() => match next {
                    Some(next) => self.take(next),
                    None => break Ok(()),
                },
                key = pressed.recv() => {
                    let Some(key) = key else {
                        break Err(anyhow::anyhow!("the terminal's input ended"));
                    };
                    match self.press(key) {
                        Some(Wish::Quit) => break Ok(()),
                        Some(wish) => self.ask(wish),
                        None => {}
                    }
                    ticks.reset_immediately();
                }
                Some(said) = self.asked.next() => self.shown.said = Some(said),
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

    fn take(&mut self, news: News) {
        match news {
            News::Opened => self.shown.lost = None,
            News::Lost(why) => self.shown.lost = Some(why),
            News::Event(event) => {
                if let Event::End(end) = &*event {
                    self.shown.lost = Some(ended(*end).to_owned());
                }
                self.known.take(*event);
            }
        }
    }

    fn press(&mut self, key: KeyEvent) -> Option<Wish> {
        if key.kind == KeyEventKind::Release {
            return None;
        }
        if key.modifiers.contains(KeyModifiers::CONTROL) {
            let is_end = matches!(key.code, KeyCode::Char('c' | 'd'));
            return is_end.then_some(Wish::Quit);
        }
        self.shown.said = None;
        let page = isize::try_from(PAGE_ROWS).unwrap_or(isize::MAX);
        #[expect(
            clippy::wildcard_enum_match_arm,
            reason = "all other keys mean nothing"
        )]
        match key.code {
            KeyCode::Esc if self.shown.details => self.shown.details = false,
            KeyCode::Char('q') | KeyCode::Esc => return Some(Wish::Quit),
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
                return Some(Wish::Stop(robot.id.clone()));
            }
            KeyCode::Char('a') => {
                let alert = self.shown.alert(&self.known)?;
                return Some(Wish::Acknowledge(alert.id));
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
        if robot.is_some() {
            self.shown.selected[Section::Robots as usize] = robot;
        }
        self.shown.details = !self.shown.details;
        self.shown.section = Section::Robots;
    }

    fn ask(&mut self, wish: Wish) {
        let (client, site) = (self.client, self.site);
        match wish {
            Wish::Quit => {}
            Wish::Stop(robot) => {
                self.shown.said = Some(format!("stopping {robot} …"));
                self.asked.push(Box::pin(async move {
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
            Wish::Acknowledge(alert) => {
                self.asked.push(Box::pin(async move {
                    match client.acknowledge(alert).await {
                        Ok(alert) => format!("noted as seen: {}", alert.text),
                        Err(error) => format!("not noted: {error}"),
                    }
                }));
            }
        }
    }
}
