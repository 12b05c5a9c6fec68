//! Layout and drawing of the screen: heading, robots, missions, alerts, message and key help.

use ratatui::Frame;
use ratatui::layout::{Constraint, Layout, Rect};
use ratatui::style::{Color, Modifier, Style};
use ratatui::text::{Line, Span};
use ratatui::widgets::{Block, Borders, Paragraph, Row, Table, TableState, Wrap};
use tread_api::ids::SiteId;
use tread_api::mission::{Mission, MissionState};
use tread_api::robot::{LinkState, MissionProgress, Robot, RobotLive, RobotMode, Severity};
use tread_api::safety::StandstillState;

use super::site_state::SiteState;
use super::view::{Order, Section, View};
use crate::commands::mission_text::{state, trajectory};
use crate::commands::robots::{details, link_name, mode_name, steps_driven, theta};
use crate::output::{age, fixed, or_dash};

/// Maximum width of a robot's name, columns.
const NAME_WIDTH_MAX: usize = 24;
/// Width of a progress bar, columns.
const BAR: usize = 10;
/// Minimum width of the screen, columns, for whole identifiers and additional columns of robots.
const WIDE: u16 = 130;
/// Maximum number of rows for missions.
const MISSION_ROWS: u16 = 40;
/// Minimum number of rows for missions including their heading, if the screen has enough.
const MISSION_ROWS_LEAST: u16 = 7;
/// Number of rows for the details of one robot.
const DETAIL_ROWS: u16 = 24;
/// Maximum number of rows for alerts.
const ALERT_ROWS: u16 = 5;

const KEYS: &str =
    " q quit · ↑↓ select · Tab table · Enter details · o order · X STOP robot · a alert seen";

/// Data to draw.
pub(super) struct Picture<'screen> {
    pub(super) site: &'screen SiteId,
    pub(super) address: &'screen str,
    pub(super) known: &'screen SiteState,
    pub(super) shown: &'screen View,
}

/// Returns the number of rows for a list of `count` entries, with heading and border.
fn rows(count: usize, most: u16) -> u16 {
    let rows = u16::try_from(count).unwrap_or(most).min(most);
    // One row for the border with the title, one for the heading.
    rows + 2
}

pub(super) fn draw(frame: &mut Frame<'_>, picture: &Picture<'_>) {
    let (known, shown) = (picture.known, picture.shown);
    let (missions, alerts) = (known.missions(), known.alerts());
    let alert_rows = if alerts.is_empty() {
        0
    } else {
        rows(alerts.len(), ALERT_ROWS)
    };
    let opened = shown.robot(known).filter(|_| shown.details);
    let above = if opened.is_some() {
        // Details of one robot; missions get the remaining rows.
        Constraint::Length(DETAIL_ROWS)
    } else {
        let most = frame
            .area()
            .height
            .saturating_sub(MISSION_ROWS_LEAST + alert_rows + 4);
        Constraint::Length(rows(known.robots().count(), most.max(3) - 2))
    };
    let below = if opened.is_some() {
        0
    } else {
        rows(missions.len(), MISSION_ROWS).min(MISSION_ROWS_LEAST)
    };
    let [
        heading,
        robots_area,
        missions_area,
        alerts_area,
        result,
        keys,
    ] = Layout::vertical([
        Constraint::Length(2),
        above,
        Constraint::Min(below),
        Constraint::Length(alert_rows),
        Constraint::Length(1),
        Constraint::Length(1),
    ])
    .areas(frame.area());
    frame.render_widget(Paragraph::new(head(picture)), heading);
    match opened {
        Some(robot) => {
            let details = details(robot);
            let width = usize::from(robots_area.width).max(1);
            let rows = details
                .lines()
                .map(|line| Line::raw(line).width().div_ceil(width).max(1));
            // The title takes a row.
            let is_cut = rows.sum::<usize>() + 1 > usize::from(robots_area.height);
            let id = &robot.id;
            let title = if is_cut {
                format!(" {id}: more with `tread robots {id}` ")
            } else {
                format!(" {id} ")
            };
            let block = framed(title, true);
            let text = Paragraph::new(details).wrap(Wrap { trim: false });
            frame.render_widget(text.block(block), robots_area);
        }
        None => draw_robots(frame, robots_area, picture),
    }
    draw_missions(frame, missions_area, picture, &missions);
    if alert_rows > 0 {
        draw_alerts(frame, alerts_area, picture);
    }
    let text = shown.result.as_deref().unwrap_or_default();
    frame.render_widget(Paragraph::new(text).style(bold(Color::Yellow)), result);
    let dim = Style::new().add_modifier(Modifier::DIM);
    frame.render_widget(Paragraph::new(KEYS).style(dim), keys);
}

fn bold(color: Color) -> Style {
    Style::new().fg(color).add_modifier(Modifier::BOLD)
}

fn framed(title: String, is_chosen: bool) -> Block<'static> {
    let style = if is_chosen {
        Style::new().add_modifier(Modifier::BOLD)
    } else {
        Style::new().add_modifier(Modifier::DIM)
    };
    Block::new()
        .borders(Borders::TOP)
        .border_style(style)
        .title(title)
}

fn head(picture: &Picture<'_>) -> Vec<Line<'static>> {
    let mut first = vec![
        Span::styled(
            format!("tread · {}", picture.site),
            Style::new().add_modifier(Modifier::BOLD),
        ),
        Span::raw(format!(" · {} · ", picture.address)),
    ];
    first.push(match (&picture.shown.lost, picture.known.is_whole()) {
        (Some(why), _) => Span::styled(
            format!("NOT LIVE, old values are shown: {why}"),
            bold(Color::Red),
        ),
        (None, true) => Span::styled("live", bold(Color::Green)),
        (None, false) => Span::styled("reading …", bold(Color::Yellow)),
    });
    let counts = picture.known.counts();
    let counted = |count: usize, name: &str, color: Color| {
        let style = if count > 0 { bold(color) } else { Style::new() };
        Span::styled(format!("{count} {name}   "), style)
    };
    let second = vec![
        counted(counts.online, "online", Color::Green),
        counted(counts.stale, "stale", Color::Yellow),
        counted(counts.offline, "offline", Color::Red),
        counted(counts.stopped, "stopped", Color::Red),
        counted(counts.in_progress, "active missions", Color::Cyan),
        counted(counts.queued, "queued", Color::Reset),
        counted(counts.alerts, "alerts", Color::Yellow),
    ];
    vec![Line::from(first), Line::from(second)]
}

/// Returns a progress bar of a mission.
fn bar(progress: Option<MissionProgress>) -> String {
    let Some((progress, full)) = progress.and_then(|it| Some((it, steps_driven(it, BAR)?))) else {
        return "-".to_owned();
    };
    let share = (progress.driven_m / progress.length_m).clamp(0.0, 1.0);
    let (full, rest) = ("█".repeat(full), "░".repeat(BAR - full));
    format!("{full}{rest} {:>3} %", fixed(1e2 * share, 0))
}

fn robot_style(robot: &Robot) -> Style {
    let live = robot.live.as_ref();
    let is_down = live.is_some_and(|live| {
        let standstill = live.safety.standstill.map(|standstill| standstill.state);
        let runs = matches!(
            standstill,
            Some(StandstillState::StandstillNotReached | StandstillState::UnexpectedMotion)
        );
        runs || live.safety.stop.is_some()
            || matches!(live.mode, RobotMode::Fault | RobotMode::Stopped)
    });
    match (is_down, robot.link) {
        (true, _) => bold(Color::Red),
        (false, LinkState::Offline) => Style::new().fg(Color::Red),
        (false, LinkState::Stale) => Style::new().fg(Color::Yellow),
        (false, LinkState::Online) => Style::new(),
    }
}

/// Returns the mode: `stopping` until a stopped robot is at standstill, and a warning if it moves
/// although it should be at rest.
fn mode_and_standstill(live: &RobotLive) -> String {
    let mode = mode_name(live.mode);
    let standstill = live.safety.standstill.map(|standstill| standstill.state);
    match standstill {
        Some(StandstillState::StandstillNotReached) => "STILL MOVING".to_owned(),
        Some(StandstillState::UnexpectedMotion) => "MOVES".to_owned(),
        Some(StandstillState::Stopping) if live.mode == RobotMode::Stopped => "stopping".to_owned(),
        Some(StandstillState::Stopping | StandstillState::Standstill | StandstillState::Other)
        | None => mode.to_owned(),
    }
}

fn robot_row(robot: &Robot, is_wide: bool) -> Row<'static> {
    let live = robot.live.as_ref();
    let twist = live.and_then(|live| live.twist);
    let mission = live.and_then(|live| live.mission);
    // Adding zero turns a negative zero into a positive one.
    let off = mission.map(|mission| format!("{:.0}", (1e3 * mission.cross_track_m).round() + 0.0));
    let mut cells = vec![
        robot.id.to_string(),
        link_name(robot.link).to_owned(),
        or_dash(live.map(mode_and_standstill)),
        bar(mission),
        or_dash(twist.map(|twist| fixed(twist.value.linear_m_s, 2))),
        or_dash(off),
        or_dash(live.and_then(theta)),
        or_dash(live.map(|live| age(live.state_age_ms))),
    ];
    if is_wide {
        let pose = live.and_then(|live| live.pose).map(|pose| pose.value);
        let battery = live.and_then(|live| live.battery);
        let gate = live.and_then(|live| live.safety.gate.cause);
        let gate = gate.and_then(|cause| serde_json::to_value(cause).ok());
        let gate = gate.as_ref().and_then(serde_json::Value::as_str);
        cells.extend([
            or_dash(pose.map(|pose| format!("{}, {}", fixed(pose.x_m, 2), fixed(pose.y_m, 2)))),
            or_dash(battery.map(|battery| format!("{:.0} %", 1e2 * battery.charge_ratio))),
            or_dash(gate.map(|cause| cause.replace('_', " "))),
        ]);
    }
    Row::new(cells).style(robot_style(robot))
}

fn draw_robots(frame: &mut Frame<'_>, area: Rect, picture: &Picture<'_>) {
    let shown = picture.shown;
    let is_wide = area.width >= WIDE;
    let robots = shown.robots(picture.known);
    let order = match shown.order {
        Order::Name => "by name",
        Order::Trouble => "trouble first",
    };
    let title = format!(" robots, {order} ");
    if robots.is_empty() && picture.known.is_whole() {
        let text = "no robot has connected to this site yet";
        let block = framed(title, true);
        frame.render_widget(Paragraph::new(text).block(block), area);
        return;
    }
    let mut header = vec![
        "ROBOT", "LINK", "MODE", "DONE", "M/S", "OFF MM", "THETA", "HEARD",
    ];
    let names = robots.iter().map(|robot| robot.id.as_str().len());
    let longest = names.max().unwrap_or_default().clamp(8, NAME_WIDTH_MAX);
    let mut widths = vec![
        Constraint::Length(u16::try_from(longest).unwrap_or_default()),
        Constraint::Length(7),
        Constraint::Length(14),
        Constraint::Length(16),
        Constraint::Length(5),
        Constraint::Length(6),
        Constraint::Length(15),
        Constraint::Length(7),
    ];
    if is_wide {
        header.extend(["X, Y M", "BATTERY", "SLOWED BY"]);
        widths.extend([
            Constraint::Length(16),
            Constraint::Length(7),
            Constraint::Length(16),
        ]);
    }
    let rows = robots.iter().map(|robot| robot_row(robot, is_wide));
    draw_table(
        frame,
        area,
        picture,
        Section::Robots,
        (title, &header),
        rows,
        widths,
    );
}

fn mission_style(mission: &Mission) -> Style {
    match mission.state {
        MissionState::Failed | MissionState::Rejected => Style::new().fg(Color::Red),
        MissionState::Active => Style::new().fg(Color::Cyan),
        MissionState::Paused | MissionState::Cancelling => Style::new().fg(Color::Yellow),
        MissionState::Queued | MissionState::Offered => Style::new(),
        MissionState::Succeeded | MissionState::Cancelled | MissionState::Expired => {
            Style::new().add_modifier(Modifier::DIM)
        }
    }
}

fn draw_missions(frame: &mut Frame<'_>, area: Rect, picture: &Picture<'_>, missions: &[Mission]) {
    let is_wide = area.width >= WIDE;
    let row = |mission: &Mission| {
        let id = mission.id.to_string();
        let id = if is_wide {
            id
        } else {
            format!("…{}", &id[id.len() - 12..])
        };
        // The reason of a normal state is omitted.
        let is_plain = matches!(
            mission.state,
            MissionState::Active | MissionState::Succeeded
        );
        let reason = mission.reason.clone().filter(|_| !is_plain);
        Row::new([
            id,
            mission.robot.to_string(),
            state(mission),
            bar(mission.progress),
            trajectory(&mission.trajectory),
            reason.unwrap_or_default(),
        ])
        .style(mission_style(mission))
    };
    let widths = vec![
        Constraint::Length(if is_wide { 36 } else { 13 }),
        Constraint::Length(12),
        Constraint::Length(10),
        Constraint::Length(16),
        Constraint::Fill(1),
        Constraint::Fill(1),
    ];
    let header = ["MISSION", "ROBOT", "STATE", "DONE", "TRAJECTORY", "REASON"];
    let rows = missions.iter().map(row);
    let title = (" missions ".to_owned(), &header[..]);
    draw_table(frame, area, picture, Section::Missions, title, rows, widths);
}

fn draw_alerts(frame: &mut Frame<'_>, area: Rect, picture: &Picture<'_>) {
    let alerts = picture.known.alerts();
    let rows = alerts.iter().map(|alert| {
        let style = match (alert.acknowledged_at, alert.severity) {
            (Some(_), _) => Style::new().add_modifier(Modifier::DIM),
            (None, Severity::Critical) => bold(Color::Red),
            (None, Severity::Warning) => Style::new().fg(Color::Yellow),
        };
        Row::new([
            alert.about().to_owned(),
            alert.severity.as_str().to_owned(),
            format!("{:.0}", alert.raised_at),
            alert.text.clone(),
        ])
        .style(style)
    });
    let widths = vec![
        Constraint::Length(12),
        Constraint::Length(8),
        Constraint::Length(20),
        Constraint::Fill(1),
    ];
    let header = ["ABOUT", "ALERT", "SINCE", "WHAT"];
    let title = (" alerts ".to_owned(), &header[..]);
    draw_table(frame, area, picture, Section::Alerts, title, rows, widths);
}

fn draw_table<'row>(
    frame: &mut Frame<'_>,
    area: Rect,
    picture: &Picture<'_>,
    section: Section,
    (title, header): (String, &[&'row str]),
    rows: impl Iterator<Item = Row<'row>>,
    widths: Vec<Constraint>,
) {
    let is_chosen = picture.shown.section == section;
    let header = Row::new(header.to_vec()).style(Style::new().add_modifier(Modifier::DIM));
    let marked = if is_chosen {
        Style::new().add_modifier(Modifier::REVERSED)
    } else {
        Style::new()
    };
    let table = Table::new(rows, widths)
        .header(header)
        .block(framed(title, is_chosen))
        .row_highlight_style(marked);
    let row = picture.shown.row(picture.known, section);
    let mut state = TableState::new().with_selected(Some(row));
    frame.render_stateful_widget(table, area, &mut state);
}

#[cfg(test)]
mod tests;
