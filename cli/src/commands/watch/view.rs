//! What the screen shows of the site: section, order, selection, details.

use tread_api::robot::{Alert, LinkState, Robot};

use super::site_state::SiteState;

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

    pub(super) fn next(self) -> Self {
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
pub(super) struct View {
    pub(super) section: Section,
    pub(super) order: Order,
    /// Selected object of each section, by its identifier, so that an action applies to the
    /// selected object even if its row has moved.
    selected: [Option<String>; 3],
    /// Whether the details of the selected robot replace its table.
    pub(super) details: bool,
    /// Result of the last action.
    pub(super) result: Option<String>,
    /// Reason why no events arrive; `None` while they do.
    pub(super) lost: Option<String>,
}

impl View {
    /// Returns the identifiers in a section, in their order.
    fn listed(&self, known: &SiteState, section: Section) -> Vec<String> {
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
    pub(super) fn row(&self, known: &SiteState, section: Section) -> usize {
        let selected = self.selected[section as usize].as_ref();
        let listed = self.listed(known, section);
        let at = listed.iter().position(|id| Some(id) == selected);
        at.unwrap_or_default()
    }

    pub(super) fn move_by(&mut self, known: &SiteState, rows: isize) {
        let listed = self.listed(known, self.section);
        let row = self.row(known, self.section).saturating_add_signed(rows);
        let row = row.min(listed.len().saturating_sub(1));
        self.selected[self.section as usize] = listed.get(row).cloned();
    }

    /// Fixes the selection to the objects that are drawn as selected, so that it follows them when
    /// rows move.
    pub(super) fn mark(&mut self, known: &SiteState) {
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
    pub(super) fn robots<'known>(&self, known: &'known SiteState) -> Vec<&'known Robot> {
        let mut robots: Vec<&Robot> = known.robots().collect();
        if self.order == Order::Trouble {
            robots.sort_by_key(|robot| std::cmp::Reverse(severity_rank(robot)));
        }
        robots
    }

    /// Returns the selected robot.
    pub(super) fn robot<'known>(&self, known: &'known SiteState) -> Option<&'known Robot> {
        let selected = self.selected[Section::Robots as usize].as_deref();
        known
            .robots()
            .find(|robot| Some(robot.id.as_str()) == selected)
    }

    /// Selects a robot.
    pub(super) fn select_robot(&mut self, id: String) {
        self.selected[Section::Robots as usize] = Some(id);
    }

    /// Returns the selected alert.
    pub(super) fn alert<'known>(&self, known: &'known SiteState) -> Option<&'known Alert> {
        let selected = self.selected[Section::Alerts as usize].as_deref();
        let mut alerts = known.alerts().into_iter();
        alerts.find(|alert| Some(alert.id.to_string().as_str()) == selected)
    }
}

/// Returns a score of how much a robot needs attention; higher comes first.
fn severity_rank(robot: &Robot) -> u8 {
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
