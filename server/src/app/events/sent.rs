//! Encoded events, and the filter of a client.

use std::collections::HashSet;

use tread_api::event::{Event, Topic};
use tread_api::ids::{RobotId, SiteId};
use tread_api::rights::Scope;

/// A place in the order of events.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Position {
    /// Number of the event in this run of the server.
    pub(super) seq: u64,
    /// Key of the newest transition of a mission up to it, the same for every server of a database.
    pub(super) step: i64,
}

/// One encoded event.
#[derive(Debug)]
pub struct Sent {
    /// Identifier that a client returns as `Last-Event-ID`; `None` within a snapshot.
    pub id: Option<String>,
    /// Its name.
    pub name: &'static str,
    /// Its body, JSON on one line. A boxed string has no spare capacity, so that its length is the
    /// memory that it takes: of a large event the encoder's buffer has up to twice as much.
    pub text: Box<str>,
    pub(super) seq: u64,
    pub(super) topic: Option<Topic>,
    pub(super) about: Option<EventSubject>,
}

/// Subject of an event: a robot of a site, or, with `None`, the site as a whole.
pub(super) type EventSubject = (SiteId, Option<RobotId>);

/// Filter of a client; an empty field lets everything through.
#[derive(Debug, Clone, Default)]
pub struct EventFilter {
    /// Only these topics.
    pub topics: HashSet<Topic>,
    /// Only this site.
    pub site: Option<SiteId>,
    /// Only these robots.
    pub robots: HashSet<RobotId>,
    /// Only events within this scope, and those about the server.
    pub within: Scope,
}

impl EventFilter {
    pub(super) fn matches(&self, topic: Option<Topic>, about: Option<&EventSubject>) -> bool {
        let of_topic = topic.is_none_or(|topic| self.includes_topic(topic));
        let is_about = |about: &EventSubject| match about {
            (site, Some(robot)) => self.includes_robot(site, robot),
            // A filter on robots does not exclude events about a whole site.
            (site, None) => {
                self.site.as_ref().is_none_or(|wanted| wanted == site)
                    && self.within.includes_site(site)
            }
        };
        of_topic && about.is_none_or(is_about)
    }

    pub(super) fn includes_topic(&self, topic: Topic) -> bool {
        self.topics.is_empty() || self.topics.contains(&topic)
    }

    pub(super) fn includes_robot(&self, site: &SiteId, robot: &RobotId) -> bool {
        self.site.as_ref().is_none_or(|wanted| wanted == site)
            && (self.robots.is_empty() || self.robots.contains(robot))
            && self.within.includes_robot(site, robot)
    }
}

pub(super) fn unnumbered(event: &Event, topic: Option<Topic>, about: Option<EventSubject>) -> Sent {
    Sent {
        id: None,
        name: event.name(),
        text: serde_json::to_string(event)
            .unwrap_or_default()
            .into_boxed_str(),
        seq: 0,
        topic,
        about,
    }
}
