//! Authorisation: rights, sets of rights, and the sites and robots for which they hold.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use crate::ids::{RobotId, SiteId};

/// Named set of rights; each role has the rights of the roles before it.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, ToSchema,
)]
#[serde(rename_all = "snake_case")]
pub enum Role {
    /// Read everything except tokens and the audit log, and stop robots.
    Viewer,
    /// Every right except `administer`.
    Operator,
    /// Every right.
    Admin,
}

impl Role {
    /// Every role, in ascending order of rights.
    pub const ALL: [Self; 3] = [Self::Viewer, Self::Operator, Self::Admin];

    /// Returns the role's name on the wire.
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Viewer => "viewer",
            Self::Operator => "operator",
            Self::Admin => "admin",
        }
    }

    /// Returns the role with this name; `None` if there is none.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|role| role.as_str() == name)
    }
}

impl fmt::Display for Role {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(self.as_str())
    }
}

/// Error for a text that is not the name of a role.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("a role is `viewer`, `operator` or `admin`")]
pub struct InvalidRole;

impl FromStr for Role {
    type Err = InvalidRole;

    fn from_str(text: &str) -> Result<Self, InvalidRole> {
        Self::from_name(text).ok_or(InvalidRole)
    }
}

/// Maximum number of sites to which a token is limited.
pub const SCOPE_SITES_MAX: usize = 100;
/// Maximum number of robots to which a token is limited, over all its sites.
pub const SCOPE_ROBOTS_MAX: usize = 1_000;

/// Permission for some operations. Each route of the API requires one right.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, ToSchema,
)]
#[serde(rename_all = "snake_case")]
pub enum Right {
    /// Stop robots; part of every other right.
    Stop,
    /// Read everything except tokens and the audit log; part of every right except `stop`.
    Read,
    /// Teleoperate robots.
    Drive,
    /// Clear stops.
    ClearStop,
    /// Hold and slow robots by the limit of the owner that has the same name as the token.
    Hold,
    /// Set and end the limits of every owner; includes `hold`.
    ReleaseHold,
    /// Create, change, pause, resume and cancel missions.
    Dispatch,
    /// Acknowledge alerts.
    Acknowledge,
    /// Change terrains and geofences, georeference sites, rename and retire robots, withdraw
    /// measurements.
    Configure,
    /// Create sites, enrol and revoke robots, create and revoke tokens, read the audit log.
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

    /// Returns the right's name on the wire.
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

    /// Returns the right with this name; `None` if there is none.
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

/// Error for a text that is not the name of a right.
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

/// Set of rights, closed under inclusion: every right includes `stop`, every right except `stop`
/// includes `read`, and `release_hold` includes `hold`. A list of names on the wire.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(from = "Vec<Right>", into = "Vec<Right>")]
pub struct Rights(u16);

impl Rights {
    /// Whether a right is in the set.
    pub const fn includes(self, right: Right) -> bool {
        self.0 & right.bit() != 0
    }

    /// Whether all rights of another set are in this set.
    pub const fn includes_all(self, other: Self) -> bool {
        self.0 & other.0 == other.0
    }

    /// Returns the rights that are in this set or in another.
    #[must_use]
    pub const fn union(self, other: Self) -> Self {
        Self(self.0 | other.0)
    }

    /// Returns the rights that are in this set and in another.
    #[must_use]
    pub const fn intersection(self, other: Self) -> Self {
        Self(self.0 & other.0)
    }

    /// Whether the set has no right except `stop` and `read`.
    pub const fn only_watches(self) -> bool {
        self.0 & !(Right::Stop.bit() | Right::Read.bit()) == 0
    }

    /// Iterates over the rights in the set.
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

/// Site for which rights hold, or some of its robots.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct SiteScope {
    /// The site.
    pub site: SiteId,
    /// Robots of the site for which the rights hold; when absent, all of them and the site itself.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub robots: Option<Vec<RobotId>>,
}

/// Sites and robots for which rights hold: all, or listed sites, of which some may be limited to
/// listed robots. A list of [`SiteScope`] or `null` on the wire.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(try_from = "Option<Vec<SiteScope>>", into = "Option<Vec<SiteScope>>")]
pub struct Scope(Option<BTreeMap<SiteId, Option<BTreeSet<RobotId>>>>);

/// Rights with the sites and robots for which they hold. A request is allowed if one of the
/// caller's grants includes both its right and its site or robot.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Serialize, Deserialize, ToSchema)]
pub struct Grant {
    /// Rights that are granted.
    #[schema(value_type = Vec<Right>)]
    pub rights: Rights,
    /// Sites and robots for which the rights hold; `null` for all.
    #[schema(value_type = Option<Vec<SiteScope>>)]
    pub sites: Scope,
}

/// Reason why a list of sites and robots is not a valid scope.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum InvalidScope {
    /// The list of sites, or the robots of a site, are empty.
    #[error("name at least one site, or leave `sites` out; a site's `robots` likewise")]
    Empty,
    /// A site is listed twice.
    #[error("site `{0}` is named twice")]
    Twice(SiteId),
    /// More sites or robots are listed than [`SCOPE_SITES_MAX`] or [`SCOPE_ROBOTS_MAX`].
    #[error("at most {SCOPE_SITES_MAX} sites and {SCOPE_ROBOTS_MAX} robots can be named")]
    TooMany,
    /// A name is neither `SITE` nor `SITE/ROBOT` with valid identifiers.
    #[error("write `SITE` or `SITE/ROBOT`")]
    Name,
}

impl Scope {
    /// Scope of all sites and robots.
    pub const EVERYWHERE: Self = Self(None);

    /// Whether the scope contains all sites and robots.
    pub fn is_everywhere(&self) -> bool {
        self.0.is_none()
    }

    /// Whether the scope contains a site or some of its robots.
    pub fn includes_site(&self, site: &SiteId) -> bool {
        self.0.as_ref().is_none_or(|sites| sites.contains_key(site))
    }

    /// Whether the scope contains a site with all its robots.
    pub fn includes_whole_site(&self, site: &SiteId) -> bool {
        self.robots_of(site).is_some_and(|robots| robots.is_none())
    }

    /// Whether the scope contains a robot.
    pub fn includes_robot(&self, site: &SiteId, robot: &RobotId) -> bool {
        let robots = self.robots_of(site);
        robots.is_some_and(|robots| robots.is_none_or(|robots| robots.contains(robot)))
    }

    /// Whether the scope contains a robot of this name at any site.
    pub fn includes_robot_name(&self, robot: &RobotId) -> bool {
        let Some(sites) = &self.0 else {
            return true;
        };
        let mut robots = sites.values();
        robots.any(|robots| robots.as_ref().is_none_or(|robots| robots.contains(robot)))
    }

    /// Whether the scope contains all of another scope.
    pub fn includes(&self, other: &Self) -> bool {
        let Some(others) = &other.0 else {
            return self.is_everywhere();
        };
        others.iter().all(|(site, robots)| match robots {
            None => self.includes_whole_site(site),
            Some(robots) => robots.iter().all(|robot| self.includes_robot(site, robot)),
        })
    }

    /// Returns the scope that contains what this scope or another contains. It serves for checks
    /// only: it may exceed the limits on the size of a token's scope.
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

    /// Iterates over the sites in the scope; `None` if it contains all.
    pub fn sites(&self) -> Option<impl Iterator<Item = &SiteId>> {
        Some(self.0.as_ref()?.keys())
    }

    /// Returns the only site in the scope; `None` if it contains several or all.
    pub fn only_site(&self) -> Option<&SiteId> {
        let mut sites = self.sites()?;
        let site = sites.next()?;
        sites.next().is_none().then_some(site)
    }

    /// Returns `None` if the scope does not contain the site, `Some(None)` if it contains all its
    /// robots, and `Some(Some(robots))` if it is limited to these robots.
    pub fn robots_of(&self, site: &SiteId) -> Option<Option<&BTreeSet<RobotId>>> {
        match &self.0 {
            None => Some(None),
            Some(sites) => sites.get(site).map(Option::as_ref),
        }
    }

    /// Returns the robots to which a list of the site is limited: `None` if all are listed, the
    /// empty set if the scope does not contain the site.
    pub fn limit_of(&self, site: &SiteId) -> Option<BTreeSet<RobotId>> {
        match self.robots_of(site) {
            None => Some(BTreeSet::new()),
            Some(robots) => robots.cloned(),
        }
    }

    /// Returns the names of what the scope contains, each `site` or `site/robot`; `None` if it
    /// contains all.
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

    /// Creates a scope from names, each `site` or `site/robot`.
    ///
    /// # Errors
    /// [`InvalidScope`] if a name is invalid, a site is named twice or both whole and by robots, or
    /// there are no or too many names.
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
