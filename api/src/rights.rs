//! What somebody may do, and where: rights, sets of them, and the sites and robots they hold for.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use crate::ids::{RobotId, SiteId};

/// A named bundle of rights; each role has those of the ones before it.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, ToSchema,
)]
#[serde(rename_all = "snake_case")]
pub enum Role {
    /// Sees everything but tokens and the audit log, and may stop robots.
    Viewer,
    /// Gives missions, draws terrains, drives robots: every right but `administer`.
    Operator,
    /// Makes sites, gives and revokes tokens, reads the audit log: every right.
    Admin,
}

impl Role {
    /// Every role, the weakest first.
    pub const ALL: [Self; 3] = [Self::Viewer, Self::Operator, Self::Admin];

    /// The name on the wire.
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Viewer => "viewer",
            Self::Operator => "operator",
            Self::Admin => "admin",
        }
    }

    /// The role of that name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|role| role.as_str() == name)
    }
}

impl fmt::Display for Role {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(self.as_str())
    }
}

/// Why a text is no role.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("a role is `viewer`, `operator` or `admin`")]
pub struct InvalidRole;

impl FromStr for Role {
    type Err = InvalidRole;

    fn from_str(text: &str) -> Result<Self, InvalidRole> {
        Self::from_name(text).ok_or(InvalidRole)
    }
}

/// Most sites that a token may be limited to.
pub const SCOPE_SITES_MAX: usize = 100;
/// Most robots that it may be limited to, of all its sites.
pub const SCOPE_ROBOTS_MAX: usize = 1_000;

/// A right. Each route of the API needs one.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, ToSchema,
)]
#[serde(rename_all = "snake_case")]
pub enum Right {
    /// Stops robots; comes with every other right.
    Stop,
    /// Sees everything but tokens and the audit log; comes with every right but `stop`.
    Read,
    /// Teleoperates robots.
    Drive,
    /// Clears stops.
    ClearStop,
    /// Holds and slows robots as the limit's owner that is named like the token.
    Hold,
    /// Sets and ends the limits of every owner; brings `hold` along.
    ReleaseHold,
    /// Gives missions, changes, pauses, resumes and cancels them.
    Dispatch,
    /// Acknowledges alerts.
    Acknowledge,
    /// Draws terrains and geofences, ties sites to the earth, names and retires robots, withdraws
    /// measurements.
    Configure,
    /// Makes sites, lets robots join and puts them out, gives and revokes tokens, reads the audit
    /// log.
    Administer,
}

impl Right {
    /// Every right.
    pub const ALL: [Self; 10] = [
        Self::Stop,
        Self::Read,
        Self::Drive,
        Self::ClearStop,
        Self::Hold,
        Self::ReleaseHold,
        Self::Dispatch,
        Self::Acknowledge,
        Self::Configure,
        Self::Administer,
    ];

    /// The name on the wire.
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Stop => "stop",
            Self::Read => "read",
            Self::Drive => "drive",
            Self::ClearStop => "clear_stop",
            Self::Hold => "hold",
            Self::ReleaseHold => "release_hold",
            Self::Dispatch => "dispatch",
            Self::Acknowledge => "acknowledge",
            Self::Configure => "configure",
            Self::Administer => "administer",
        }
    }

    /// The right of that name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|right| right.as_str() == name)
    }

    const fn bit(self) -> u16 {
        1 << self as u16
    }
}

impl fmt::Display for Right {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(self.as_str())
    }
}

/// Why a text is no right.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "a right is `stop`, `read`, `drive`, `clear_stop`, `hold`, `release_hold`, `dispatch`, \
     `acknowledge`, `configure` or `administer`"
)]
pub struct InvalidRight;

impl FromStr for Right {
    type Err = InvalidRight;

    fn from_str(text: &str) -> Result<Self, InvalidRight> {
        Self::from_name(text).ok_or(InvalidRight)
    }
}

/// A set of rights, closed under those that others bring along: `stop` comes with every right,
/// `read` with every right but `stop`, `hold` with `release_hold`. A list of names on the wire.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(from = "Vec<Right>", into = "Vec<Right>")]
pub struct Rights(u16);

impl Rights {
    /// Whether a right is in it.
    pub const fn includes(self, right: Right) -> bool {
        self.0 & right.bit() != 0
    }

    /// Whether all of another set are in it.
    pub const fn includes_all(self, other: Self) -> bool {
        self.0 & other.0 == other.0
    }

    /// The rights that are in it or in another.
    #[must_use]
    pub const fn union(self, other: Self) -> Self {
        Self(self.0 | other.0)
    }

    /// The rights that are in it and in another.
    #[must_use]
    pub const fn intersection(self, other: Self) -> Self {
        Self(self.0 & other.0)
    }

    /// Whether it is for looking and stopping alone.
    pub const fn only_watches(self) -> bool {
        self.0 & !(Right::Stop.bit() | Right::Read.bit()) == 0
    }

    /// Those in it.
    pub fn iter(self) -> impl Iterator<Item = Right> {
        Right::ALL
            .into_iter()
            .filter(move |right| self.includes(*right))
    }
}

impl FromIterator<Right> for Rights {
    fn from_iter<T: IntoIterator<Item = Right>>(rights: T) -> Self {
        let named = rights.into_iter().fold(0, |set, right| set | right.bit());
        let stop = Right::Stop.bit();
        if named & !stop == 0 {
            return Self(named);
        }
        let is_releasing = named & Right::ReleaseHold.bit() != 0;
        let hold = if is_releasing { Right::Hold.bit() } else { 0 };
        Self(named | hold | stop | Right::Read.bit())
    }
}

impl From<Vec<Right>> for Rights {
    fn from(rights: Vec<Right>) -> Self {
        rights.into_iter().collect()
    }
}

impl From<Rights> for Vec<Right> {
    fn from(rights: Rights) -> Self {
        rights.iter().collect()
    }
}

impl From<Role> for Rights {
    fn from(role: Role) -> Self {
        let held = |right: &Right| match right {
            Right::Stop | Right::Read => true,
            Right::Drive
            | Right::ClearStop
            | Right::Hold
            | Right::ReleaseHold
            | Right::Dispatch
            | Right::Acknowledge
            | Right::Configure => role >= Role::Operator,
            Right::Administer => role == Role::Admin,
        };
        Right::ALL.into_iter().filter(held).collect()
    }
}

impl fmt::Display for Rights {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let names: Vec<&str> = self.iter().map(Right::as_str).collect();
        formatter.write_str(&names.join(", "))
    }
}

/// A site that rights hold for.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct SiteScope {
    /// The site.
    pub site: SiteId,
    /// Only these of its robots; all of them, and the site itself, when absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub robots: Option<Vec<RobotId>>,
}

/// Where rights hold: everywhere, or for sites, of which some may be limited to named robots.
/// A list of [`SiteScope`] or `null` on the wire.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(try_from = "Option<Vec<SiteScope>>", into = "Option<Vec<SiteScope>>")]
pub struct Scope(Option<BTreeMap<SiteId, Option<BTreeSet<RobotId>>>>);

/// Rights for some places. Of several, any one that has the right and the place suffices.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Serialize, Deserialize, ToSchema)]
pub struct Grant {
    /// What may be done.
    #[schema(value_type = Vec<Right>)]
    pub rights: Rights,
    /// Where; `null` for everywhere.
    #[schema(value_type = Option<Vec<SiteScope>>)]
    pub sites: Scope,
}

/// Why a list of sites is no scope.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum InvalidScope {
    /// Nothing would be let through.
    #[error("name at least one site, or leave `sites` out; a site's `robots` likewise")]
    Empty,
    /// A site is named twice.
    #[error("site `{0}` is named twice")]
    Twice(SiteId),
    /// Too many are named.
    #[error("at most {SCOPE_SITES_MAX} sites and {SCOPE_ROBOTS_MAX} robots can be named")]
    TooMany,
    /// It names neither a site nor a robot of one.
    #[error("write `SITE` or `SITE/ROBOT`")]
    Name,
}

impl Scope {
    /// Everywhere.
    pub const EVERYWHERE: Self = Self(None);

    /// Whether nothing is left out.
    pub fn is_everywhere(&self) -> bool {
        self.0.is_none()
    }

    /// Whether a site, or some of its robots, is in it.
    pub fn includes_site(&self, site: &SiteId) -> bool {
        self.0.as_ref().is_none_or(|sites| sites.contains_key(site))
    }

    /// Whether a site is in it with all its robots.
    pub fn includes_whole_site(&self, site: &SiteId) -> bool {
        self.robots_of(site).is_some_and(|robots| robots.is_none())
    }

    /// Whether a robot is in it.
    pub fn includes_robot(&self, site: &SiteId, robot: &RobotId) -> bool {
        let robots = self.robots_of(site);
        robots.is_some_and(|robots| robots.is_none_or(|robots| robots.contains(robot)))
    }

    /// Whether a robot of that name is in it, of whatever site.
    pub fn includes_robot_name(&self, robot: &RobotId) -> bool {
        let Some(sites) = &self.0 else {
            return true;
        };
        let mut robots = sites.values();
        robots.any(|robots| robots.as_ref().is_none_or(|robots| robots.contains(robot)))
    }

    /// Whether all of another scope is in it.
    pub fn includes(&self, other: &Self) -> bool {
        let Some(others) = &other.0 else {
            return self.is_everywhere();
        };
        others.iter().all(|(site, robots)| match robots {
            None => self.includes_whole_site(site),
            Some(robots) => robots.iter().all(|robot| self.includes_robot(site, robot)),
        })
    }

    /// What is in it or in another. It is for asking what is in it, and may be larger than what a
    /// token may be limited to.
    #[must_use]
    pub fn union(&self, other: &Self) -> Self {
        let (Some(own), Some(others)) = (&self.0, &other.0) else {
            return Self::EVERYWHERE;
        };
        let mut sites = own.clone();
        for (site, robots) in others {
            let Some(present) = sites.get_mut(site) else {
                sites.insert(site.clone(), robots.clone());
                continue;
            };
            match (present.as_mut(), robots) {
                (Some(present), Some(robots)) => present.extend(robots.iter().cloned()),
                (Some(_) | None, _) => *present = None,
            }
        }
        Self(Some(sites))
    }

    /// The sites in it; `None` for everywhere.
    pub fn sites(&self) -> Option<impl Iterator<Item = &SiteId>> {
        Some(self.0.as_ref()?.keys())
    }

    /// The only site in it, if it is limited to one.
    pub fn only_site(&self) -> Option<&SiteId> {
        let mut sites = self.sites()?;
        let site = sites.next()?;
        sites.next().is_none().then_some(site)
    }

    /// `None` if the site is not in it; the robots that it is limited to, or `None` for all.
    pub fn robots_of(&self, site: &SiteId) -> Option<Option<&BTreeSet<RobotId>>> {
        match &self.0 {
            None => Some(None),
            Some(sites) => sites.get(site).map(Option::as_ref),
        }
    }

    /// The robots that a list of a site is limited to: `None` for all, none at all where the site
    /// is not in it.
    pub fn limit_of(&self, site: &SiteId) -> Option<BTreeSet<RobotId>> {
        match self.robots_of(site) {
            None => Some(BTreeSet::new()),
            Some(robots) => robots.cloned(),
        }
    }

    /// What is in it, each as `site` or `site/robot`; `None` for everywhere.
    pub fn names(&self) -> Option<Vec<String>> {
        let sites = self.0.as_ref()?;
        let names = sites.iter().flat_map(|(site, robots)| match robots {
            None => vec![site.to_string()],
            Some(robots) => robots
                .iter()
                .map(|robot| format!("{site}/{robot}"))
                .collect(),
        });
        Some(names.collect())
    }

    /// The scope of such names.
    ///
    /// # Errors
    /// A name is neither, a site is named twice or both whole and by robots, or there are none or
    /// too many.
    pub fn from_names<'name>(
        names: impl IntoIterator<Item = &'name str>,
    ) -> Result<Self, InvalidScope> {
        let mut sites: BTreeMap<SiteId, Option<BTreeSet<RobotId>>> = BTreeMap::new();
        for name in names {
            let (site, robot) = match name.split_once('/') {
                None => (name, None),
                Some((site, robot)) => (site, Some(robot)),
            };
            let site: SiteId = site.parse().map_err(|_slug| InvalidScope::Name)?;
            let Some(robot) = robot else {
                if sites.insert(site.clone(), None).is_some() {
                    return Err(InvalidScope::Twice(site));
                }
                continue;
            };
            let robot: RobotId = robot.parse().map_err(|_slug| InvalidScope::Name)?;
            let robots = sites.entry(site.clone());
            match robots.or_insert_with(|| Some(BTreeSet::new())) {
                Some(robots) => robots.insert(robot),
                None => return Err(InvalidScope::Twice(site)),
            };
        }
        Self::of_sites(sites)
    }

    fn of_sites(sites: BTreeMap<SiteId, Option<BTreeSet<RobotId>>>) -> Result<Self, InvalidScope> {
        let robots = sites.values().flatten().map(BTreeSet::len);
        if sites.is_empty() || robots.clone().any(|count| count == 0) {
            return Err(InvalidScope::Empty);
        }
        if sites.len() > SCOPE_SITES_MAX || robots.sum::<usize>() > SCOPE_ROBOTS_MAX {
            return Err(InvalidScope::TooMany);
        }
        Ok(Self(Some(sites)))
    }
}

impl fmt::Display for Scope {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.names() {
            None => formatter.write_str("everywhere"),
            Some(names) => formatter.write_str(&names.join(", ")),
        }
    }
}

impl TryFrom<Option<Vec<SiteScope>>> for Scope {
    type Error = InvalidScope;

    fn try_from(listed: Option<Vec<SiteScope>>) -> Result<Self, InvalidScope> {
        let Some(listed) = listed else {
            return Ok(Self::EVERYWHERE);
        };
        let mut sites = BTreeMap::new();
        for SiteScope { site, robots } in listed {
            let robots = robots.map(BTreeSet::from_iter);
            if sites.insert(site.clone(), robots).is_some() {
                return Err(InvalidScope::Twice(site));
            }
        }
        Self::of_sites(sites)
    }
}

impl From<Scope> for Option<Vec<SiteScope>> {
    fn from(scope: Scope) -> Self {
        let listed = scope.0?.into_iter().map(|(site, robots)| SiteScope {
            site,
            robots: robots.map(Vec::from_iter),
        });
        Some(listed.collect())
    }
}

#[cfg(test)]
mod tests;
