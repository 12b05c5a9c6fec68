//! Access control of a router, made from the table of what robots may do with which keys.
//!
//! A robot is identified by its certificate; the gate rejects sessions with another user name. With
//! its own keys a robot may do what the table says, it may receive what is for all robots of its
//! site, and nothing else. Zenoh's rules match a message if their expression includes the message's
//! key. The server's own wildcard declarations are therefore sent to all robots; otherwise a robot
//! would not learn that somebody subscribes to its keys, and would not publish.

use serde_json::{Value, json};
use tread_api::access::{Act, Owner, ROBOT_KEYS, RobotKeys};
use tread_api::ids::{RobotId, SiteId};

use super::credentials::{PROBE_USER, user_of};
use super::probe::PROBE_KEY;
use crate::app::presence::RobotKey;

/// Returns the zenoh names of the messages allowed for one act: from the robot, and to it.
const fn messages(act: Act) -> (&'static [&'static str], &'static [&'static str]) {
    match act {
        Act::Publish => (&["put"], &[]),
        Act::Listen => (&["declare_subscriber"], &["put"]),
        Act::Answer => (&["declare_queryable", "reply"], &["query"]),
        Act::Ask => (&["query"], &["reply"]),
        Act::Announce => (&["liveliness_token"], &[]),
    }
}

/// Returns the zenoh names of the declarations sent to every robot, which show that the server
/// subscribes or answers.
const fn announcements(act: Act) -> &'static [&'static str] {
    match act {
        Act::Publish => &["declare_subscriber"],
        Act::Ask => &["declare_queryable"],
        Act::Listen | Act::Answer | Act::Announce => &[],
    }
}

/// Rules being collected.
#[derive(Default)]
struct Rules {
    rules: Vec<Value>,
    ids: Vec<String>,
}

impl Rules {
    fn add(&mut self, flow: &str, messages: &[&str], keys: &[String]) {
        if messages.is_empty() || keys.is_empty() {
            return;
        }
        let id = format!("r{}", self.rules.len());
        self.rules.push(json!({
            "id": id, "permission": "allow", "flows": [flow],
            "messages": messages, "key_exprs": keys,
        }));
        self.ids.push(id);
    }

    /// Adds the rules of one act on several keys.
    fn add_act(&mut self, act: Act, keys: &[String]) {
        let (inward, outward) = messages(act);
        self.add("ingress", inward, keys);
        self.add("egress", outward, keys);
    }

    /// Returns the identifiers of the rules added since the last call.
    fn take_ids(&mut self) -> Vec<String> {
        std::mem::take(&mut self.ids)
    }
}

/// Returns the rules for these robots, in the format of zenoh's configuration.
pub(super) fn control(robots: &[RobotKey]) -> Value {
    let mut rules = Rules::default();
    let (mut subjects, mut policies) = (Vec::new(), Vec::new());
    for act in Act::ALL {
        let keys = |row: &RobotKeys| (row.act == act).then(|| row.of_all());
        let keys: Vec<String> = ROBOT_KEYS.iter().filter_map(keys).collect();
        rules.add("egress", announcements(act), &keys);
    }
    let for_all = rules.take_ids();
    let mut sites: Vec<&SiteId> = robots.iter().map(|(site, _robot)| site).collect();
    sites.sort();
    sites.dedup();
    for site in sites {
        let keys = |act| own_keys(Owner::Site, act, site, None);
        for act in Act::ALL {
            rules.add_act(act, &keys(act));
        }
        let mut of_site = rules.take_ids();
        of_site.extend(for_all.iter().cloned());
        let mut members = Vec::new();
        for key in robots.iter().filter(|(of, _robot)| of == site) {
            let name = user_of(key);
            for act in Act::ALL {
                rules.add_act(act, &own_keys(Owner::Robot, act, site, Some(&key.1)));
            }
            subjects.push(json!({"id": name, "usernames": [name]}));
            policies.push(json!({"rules": rules.take_ids(), "subjects": [name]}));
            members.push(name);
        }
        policies.push(json!({"rules": of_site, "subjects": members}));
    }
    let probe = [PROBE_KEY.to_owned()];
    rules.add("ingress", &["query"], &probe);
    rules.add("egress", &["reply", "declare_queryable"], &probe);
    subjects.push(json!({"id": PROBE_USER, "usernames": [PROBE_USER]}));
    policies.push(json!({"rules": rules.take_ids(), "subjects": [PROBE_USER]}));
    json!({
        "enabled": true,
        "default_permission": "deny",
        "rules": rules.rules,
        "subjects": subjects,
        "policies": policies,
    })
}

fn own_keys(owner: Owner, act: Act, site: &SiteId, robot: Option<&RobotId>) -> Vec<String> {
    let rows = ROBOT_KEYS.iter();
    let rows = rows.filter(|row| row.owner == owner && row.act == act);
    rows.map(|row| match robot {
        Some(robot) => row.expression(site, robot),
        None => format!("{}/{site}/{}", tread_api::keys::ROOT, row.pattern),
    })
    .collect()
}
