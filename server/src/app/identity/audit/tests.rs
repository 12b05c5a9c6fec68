use serde_json::json;

use super::*;

fn entry(token: Option<u128>, method: &str, path: &str, status: u16) -> AuditEntry {
    let token = token.map(uuid::Uuid::from_u128);
    serde_json::from_value(json!({
        "id": 0, "at": "2026-11-22T09:00:00Z", "since": null, "count": 1, "who": null,
        "token": token, "role": null, "address": "192.0.2.1", "method": method, "route": path,
        "path": path, "status": status, "request_id": "", "what": null,
        "previous_hash": null, "hash": null,
    }))
    .unwrap()
}

fn written(waiting: &mut AuditQueue, now: Duration, all: bool) -> Vec<AuditEntry> {
    let mut written = Vec::new();
    loop {
        let next = waiting.next(now, all);
        if next.is_empty() {
            return written;
        }
        written.extend(next);
    }
}

#[test]
fn a_flood_of_one_author_is_counted_and_costs_others_nothing() {
    let mut waiting = AuditQueue::default();
    let mut log = Vec::new();
    let mut changes = 0_u32;
    let sign_out = entry(Some(7), "DELETE", "/v1/session", 204);
    // A thousand a second for ten minutes, and an admin's change each second.
    for ms in 0..600_000_u64 {
        let now = Duration::from_millis(ms);
        waiting.add(sign_out.clone(), now);
        if ms % 1_000 == 0 {
            let mut change = entry(Some(1), "POST", "/v1/tokens", 201);
            change.what = Some(json!({"name": format!("desk-{changes}")}));
            assert_ne!(waiting.add(change, now), EntryOutcome::Dropped);
            changes += 1;
        }
        if ms % 100 == 0 {
            log.extend(waiting.next(now, false));
        }
    }
    log.extend(written(&mut waiting, Duration::from_mins(10), true));
    let of_flood = log.iter().filter(|entry| entry.method == "DELETE");
    let (rows, asked) = of_flood.fold((0, 0), |(rows, asked), entry| {
        (rows + 1, asked + entry.count)
    });
    assert_eq!(asked, 600_000, "nothing is lost");
    assert!(rows < 630, "{rows} entries of one author");
    for number in 0..changes {
        let name = json!({"name": format!("desk-{number}")});
        let is_it = |entry: &&AuditEntry| entry.what.as_ref() == Some(&name);
        assert_eq!(log.iter().filter(is_it).count(), 1, "{name}");
    }
}

#[test]
fn strangers_share_little_and_repeats_are_written_ever_more_rarely() {
    let mut waiting = AuditQueue::default();
    let mut rows = 0;
    let guess = entry(None, "GET", "/v1/sites", 401);
    for second in 0..24 * 3_600 {
        let now = Duration::from_secs(second);
        for _ in 0..5 {
            waiting.add(guess.clone(), now);
        }
        rows += waiting.next(now, false).len();
    }
    // The burst, the share of a day, and the counts.
    assert!(rows <= 60 + 2_880 + 40, "{rows} entries in a day");
}

#[test]
fn while_nothing_is_written_different_changes_are_kept_apart() {
    let mut waiting = AuditQueue::default();
    let robots = KINDS_PER_AUTHOR_MAX + 50 + WAITING_PER_AUTHOR_MAX;
    for number in 0..robots {
        let path = format!("/v1/sites/yard/robots/rover-{number}/stop");
        let mut stop = entry(Some(7), "POST", &path, 200);
        "/v1/sites/{site}/robots/{robot}/stop".clone_into(&mut stop.route);
        assert_ne!(waiting.add(stop, Duration::ZERO), EntryOutcome::Dropped);
    }
    let log = written(&mut waiting, Duration::ZERO, true);
    let asked: u64 = log.iter().map(|entry| entry.count).sum();
    assert_eq!(asked, u64::try_from(robots).unwrap());
    assert_eq!(log.len(), WAITING_PER_AUTHOR_MAX + KINDS_PER_AUTHOR_MAX + 1);
}

#[test]
fn what_is_not_asked_again_is_forgotten() {
    let mut waiting = AuditQueue::default();
    for _ in 0..100 {
        waiting.add(entry(None, "GET", "/v1/sites", 401), Duration::ZERO);
    }
    assert_eq!(waiting.repeats.len(), 1);
    for minute in 0..10 {
        waiting.next(Duration::from_mins(minute), false);
    }
    assert!(waiting.repeats.is_empty());
    assert!(
        waiting
            .shares
            .values()
            .all(|share| share.kinds == 0 && share.waiting == 0)
    );
}

#[test]
fn a_line_of_the_log_is_printable_ascii() {
    let mut odd = entry(None, "GET", "/v1/\u{1b}[2J\u{202e}\n😀", 404);
    odd.who = Some("\u{9b}".to_owned());
    let line = ascii_json(&odd);
    assert!(
        line.chars().all(|letter| (' '..='~').contains(&letter)),
        "{line}"
    );
    assert_eq!(serde_json::from_str::<AuditEntry>(&line).unwrap(), odd);
}
