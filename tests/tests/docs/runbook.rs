//! The runbook has a section for every alert: for each code that server and agent raise, and for each
//! rule for Prometheus, which `deploy/prometheus-tests.yml` tries.

use std::collections::BTreeSet;
use std::path::Path;

use regex::Regex;
use tread_tests::repository::{files, root};

/// What each section says.
const PARTS: [&str; 4] = ["Meaning", "Causes", "Diagnosis", "Mitigation"];
const RULES: &str = "deploy/prometheus-alerts.yml";
const RULE_TESTS: &str = "deploy/prometheus-tests.yml";

fn read(name: &str) -> String {
    std::fs::read_to_string(root().join(name)).unwrap_or_else(|error| panic!("{name}: {error}"))
}

fn found(pattern: &str, text: &str) -> BTreeSet<String> {
    let pattern = Regex::new(pattern).unwrap();
    let named = pattern.captures_iter(text).map(|found| found[1].to_owned());
    named.collect()
}

/// The part of a source that is compiled into the program.
fn shipped(name: &str) -> String {
    let text = read(name);
    text.split("#[cfg(test)]")
        .next()
        .unwrap_or_default()
        .to_owned()
}

/// Every code that server or agent raise, from their sources.
fn codes() -> BTreeSet<String> {
    let mut codes = BTreeSet::new();
    for name in files() {
        let is_source = Path::new(&name).extension().is_some_and(|end| end == "rs");
        if is_source && name.starts_with("server/src/") {
            codes.extend(found(r#"_ALERT: &str = "([a-z-]+)""#, &shipped(&name)));
        }
    }
    let of_agent = shipped("robot-agent/src/alerts.rs");
    for pattern in [
        r#"alert\(\s*"([a-z-]+)""#,
        r#"=> "([a-z]+-[a-z-]+)""#,
        r#"\("([a-z-]+)", text\)"#,
    ] {
        codes.extend(found(pattern, &of_agent));
    }
    let notices = shipped("robot-agent/src/drive/ros2/notices.rs");
    codes.extend(found(r#"=> "([a-z]+-[a-z-]+)""#, &notices));
    let refusals = shipped("robot-agent/src/drive/ros2/refusal.rs");
    let begin = refusals
        .find("/// Part of an alert's code")
        .expect("refusals have codes");
    let end = begin + refusals[begin..].find("\n    }\n").expect("it ends");
    let of_bases = found(r#"=> "([a-z-]+)""#, &refusals[begin..end]);
    codes.extend(of_bases.iter().map(|code| format!("base-{code}")));
    codes.extend(found(r#"=> "(base-[a-z-]+)""#, &refusals));
    codes
}

/// Sections of the runbook: what the heading names, and its text.
fn sections() -> Vec<(BTreeSet<String>, String)> {
    let text = read("docs/runbook.md");
    let parts = text.split("\n### ").skip(1);
    let section = |part: &str| {
        let (heading, rest) = part.split_once('\n').expect("a heading has a text");
        let names = heading
            .split(", ")
            .map(|name| name.trim_matches('`').to_owned());
        let rest = rest.split("\n## ").next().unwrap_or_default();
        (names.collect(), rest.to_owned())
    };
    parts.map(section).collect()
}

fn rules() -> BTreeSet<String> {
    found(r"(?m)^      - alert: (\w+)$", &read(RULES))
}

#[test]
fn the_runbook_has_a_section_for_every_alert_and_for_nothing_else() {
    let codes = codes();
    assert!(codes.len() > 40, "only {codes:?}");
    for known in [
        "robot-lost",
        "certificate-expiring",
        "stopped",
        "sensor-frozen",
        "base-late",
    ] {
        assert!(
            codes.contains(known),
            "{known} was not found in the sources"
        );
    }
    let expected: BTreeSet<String> = codes.union(&rules()).cloned().collect();
    let mut named = BTreeSet::new();
    for (names, text) in sections() {
        for part in PARTS {
            assert!(
                text.contains(&format!("* **{part}**: ")),
                "{names:?} has no `{part}`"
            );
        }
        for name in names {
            assert!(named.insert(name.clone()), "{name} has two sections");
        }
    }
    let missing: Vec<_> = expected.difference(&named).collect();
    let unknown: Vec<_> = named.difference(&expected).collect();
    assert!(
        missing.is_empty() && unknown.is_empty(),
        "missing: {missing:?}; of nothing: {unknown:?}"
    );
}

#[test]
fn every_rule_leads_to_its_section_and_is_tried_both_ways() {
    let (text, tests) = (read(RULES), read(RULE_TESTS));
    let rules = rules();
    assert!(rules.len() > 20, "only {rules:?}");
    for rule in &rules {
        let begin = text
            .find(&format!("- alert: {rule}\n"))
            .expect("it was found");
        let of_rule = text[begin + 1..]
            .split("- alert: ")
            .next()
            .unwrap_or_default();
        let link = format!("runbook: docs/runbook.md#{}\n", rule.to_lowercase());
        assert!(of_rule.contains(&link), "{rule} has no `{link}`");
        for (how, expected) in [
            ("is raised", "exp_labels"),
            ("is not raised", "exp_alerts: []"),
        ] {
            let name = format!("- name: {rule} {how}\n");
            let begin = tests
                .find(&name)
                .unwrap_or_else(|| panic!("no test that {rule} {how}"));
            let of_test = tests[begin + 1..]
                .split("- name: ")
                .next()
                .unwrap_or_default();
            assert!(
                of_test.contains(&format!("alertname: {rule}\n")),
                "{rule} {how}"
            );
            assert!(of_test.contains(expected), "{rule} {how}: no `{expected}`");
        }
    }
    let tried = found(r"alertname: (\w+)", &tests);
    assert_eq!(tried, rules, "left: tried; right: the rules");
}
