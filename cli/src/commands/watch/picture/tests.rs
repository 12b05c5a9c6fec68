use ratatui::Terminal;
use ratatui::backend::TestBackend;
use serde_json::json;
use tread_api::event::Event;

use super::*;

/// A robot as an older or newer server sends it.
fn robot(id: &str, link: &str) -> Event {
    let at = "2026-11-21T08:00:00Z";
    let limits = json!({
        "linear_max_m_s": 1.0, "angular_max_rad_s": 1.0, "linear_acceleration_max_m_s2": 1.0,
        "lateral_acceleration_max_m_s2": 1.0, "linear_jerk_max_m_s3": 1.0,
        "wheel_speed_max_rad_s": 1.0, "wheel_acceleration_max_rad_s2": 1.0,
    });
    let robot = json!({"robot": {
        "id": id, "name": id, "retired_at": null, "site": "yard",
        "model": {
            "name": "model", "tyres": "tyres", "mass_kg": 1.0, "track_width_m": 1.0,
            "wheelbase_m": 1.0, "wheel_radius_m": 1.0, "yaw_inertia_kg_m2": 1.0,
            "limits": limits,
        },
        "configuration": "0192f0c1-2b3c-7d4e-8f50-617283940a1b",
        "capabilities": {"wheel_torque": false, "yaw_rate": false, "teleop": false},
        "agent_version": "1", "first_seen_at": at, "last_hello_at": at,
        "measurements": {"refused": 0, "refusal_reason": null, "deferred": 0},
        "link": link, "link_cause": null, "alerts": [], "live": null,
    }});
    serde_json::from_value(robot).expect("a robot")
}

fn picture(known: &SiteState, width: u16, height: u16) -> String {
    picture_of(known, &View::default(), (width, height))
}

fn picture_of(known: &SiteState, shown: &View, (width, height): (u16, u16)) -> String {
    let mut terminal = Terminal::new(TestBackend::new(width, height)).expect("a screen");
    let site = "yard".parse().expect("a site");
    let picture = Picture {
        site: &site,
        address: "http://here",
        known,
        shown,
    };
    terminal
        .draw(|frame| draw(frame, &picture))
        .expect("it is drawn");
    terminal.backend().to_string()
}

#[test]
fn every_robot_is_shown_on_any_screen_and_a_tiny_one_breaks_nothing() {
    let mut known = SiteState::default();
    known.take(robot("rover-1", "online"));
    known.take(robot("rover-2", "offline"));
    assert!(picture(&known, 100, 20).contains("reading"));
    known.take(Event::SnapshotEnd);
    for (width, height) in [(80, 24), (160, 50), (90, 16)] {
        let text = picture(&known, width, height);
        for word in ["rover-1", "rover-2", "1 online", "1 offline", "live"] {
            assert!(text.contains(word), "{word} at {width}x{height}:\n{text}");
        }
    }
    for (width, height) in [(1, 1), (5, 3), (30, 6)] {
        picture(&known, width, height);
    }
}

#[test]
fn details_that_do_not_fit_say_where_all_of_them_are() {
    let mut known = SiteState::default();
    known.take(robot("rover-1", "online"));
    known.take(Event::SnapshotEnd);
    let mut shown = View::default();
    shown.details = true;
    shown.select_robot("rover-1".to_owned());
    let large = picture_of(&known, &shown, (120, 50));
    assert!(
        large.contains("last hello") && !large.contains("more with"),
        "{large}"
    );
    let small = picture_of(&known, &shown, (80, 10));
    assert!(
        small.contains("more with `tread robots rover-1`"),
        "{small}"
    );
}

#[test]
fn a_bar_is_as_full_as_the_mission_has_come() {
    let progress = |driven_m: f64| MissionProgress {
        id: "0192f0c1-2b3c-7d4e-8f50-617283940a1b"
            .parse()
            .expect("an id"),
        revision: 1,
        plan_hash: "0192f0c1-2b3c-7d4e-8f50-617283940a1b"
            .parse()
            .expect("an id"),
        driven_m,
        length_m: 10.0,
        cross_track_m: 0.0,
        paused: false,
        paused_by: None,
    };
    assert_eq!(bar(Some(progress(5.0))), "█████░░░░░  50 %");
    assert_eq!(bar(Some(progress(12.0))), "██████████ 100 %");
    assert_eq!(bar(None), "-");
}
