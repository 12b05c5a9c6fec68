use std::time::Duration;

use tread_api::friction::ROBOT_BIAS_RATIO;
use tread_api::site::Cell;
use tread_control::consistency::Unit;
use tread_control::estimation::ValueWithStdDev;
use tread_control::tracking::ThetaKnowledge;

use super::*;
use crate::drive::ros2::topic_receiver::topic_of;

fn codes(alerts: &[AlertReport]) -> Vec<&str> {
    alerts.iter().map(|alert| alert.code.as_str()).collect()
}

#[test]
fn a_battery_that_wavers_does_not_make_its_alert_flicker() {
    let mut alerts = Alerts::default();
    let mut at = |charge_ratio| {
        let battery = Some(Battery {
            charge_ratio,
            voltage_v: 22.0,
        });
        alerts.judge(&AlertInputs {
            battery,
            ..AlertInputs::default()
        })
    };
    assert!(at(0.21).is_empty());
    assert_eq!(codes(&at(0.19)), ["battery-low"]);
    assert_eq!(codes(&at(0.22)), ["battery-low"]);
    assert!(at(0.26).is_empty());
    assert_eq!(codes(&at(0.04)), ["battery-critical"]);
    assert_eq!(codes(&at(0.07)), ["battery-critical"]);
    assert_eq!(codes(&at(0.09)), ["battery-low"]);
}

#[test]
fn faults_and_losses_are_alerts_each_code_once() {
    let mut alerts = Alerts::default();
    let mut causes = AlertInputs {
        fault: Some(Fault::BaseSilent),
        outbox: OutboxStatus {
            pending: 60_000,
            dropped: 1,
            refused: 0,
        },
        ..AlertInputs::default()
    };
    let first = alerts.judge(&causes);
    assert_eq!(
        codes(&first),
        ["base-silent", "outbox-long", "outbox-dropped"]
    );
    causes.outbox.pending = 30_000;
    assert!(codes(&alerts.judge(&causes)).contains(&"outbox-long"));
    causes.outbox.pending = 20_000;
    assert!(!codes(&alerts.judge(&causes)).contains(&"outbox-long"));
}

#[test]
fn a_loop_that_is_late_is_an_alert_with_its_figures() {
    let causes = AlertInputs {
        overrun: Some(Overrun {
            late: Duration::from_millis(310),
            late_ticks: 5,
        }),
        ..AlertInputs::default()
    };
    let said = Alerts::default().judge(&causes);
    assert_eq!(codes(&said), ["loop-overrun"]);
    let text = "the control loop is late and the robot is held: a tick by 310 ms, 5 of 64 ticks";
    assert_eq!(said[0].text, text);
}

#[test]
fn records_lost_by_damage_are_an_alert_of_their_own_with_their_number() {
    let damage = OutboxDamage {
        lost_records: 34,
        kept_in: Some("/data/outbox/damaged.bin".into()),
    };
    let mut causes = AlertInputs {
        outbox: OutboxStatus {
            pending: 34,
            dropped: 34,
            refused: 0,
        },
        outbox_damage: Some(&damage),
        ..AlertInputs::default()
    };
    let mut alerts = Alerts::default();
    let said = alerts.judge(&causes);
    assert_eq!(codes(&said), ["outbox-damaged"]);
    let text = &said[0].text;
    assert!(
        text.contains("34 records") && text.contains("damaged.bin"),
        "{text}"
    );
    causes.outbox.dropped = 35;
    let both = ["outbox-dropped", "outbox-damaged"];
    assert_eq!(codes(&alerts.judge(&causes)), both, "a full store too");
    causes.outbox.dropped = 34;
    let seen = OutboxDamage {
        kept_in: None,
        ..damage.clone()
    };
    causes.outbox_damage = Some(&seen);
    assert!(
        alerts.judge(&causes).is_empty(),
        "somebody has looked at it"
    );
}

#[test]
fn a_base_that_started_again_and_a_second_commander_are_alerts() {
    let counts = Counts::default();
    let (mut alerts, causes) = (
        Alerts::default(),
        AlertInputs {
            base: Some(&counts),
            ..AlertInputs::default()
        },
    );
    assert!(alerts.judge(&causes).is_empty());
    counts.record(Source::Joints, Notice::Restarted);
    counts.count_foreign_command();
    let said = alerts.judge(&causes);
    assert_eq!(codes(&said), ["command-second-writer", "base-restarted"]);
    assert!(said[0].text.contains("another node"), "{said:?}");
    assert!(said[1].text.contains("joints"), "{said:?}");
}

#[test]
fn a_base_that_is_not_heard_is_an_alert_with_the_topics_that_never_came() {
    let settings = crate::drive::ros2::tests::settings();
    let counts = Counts::of(|source| Some(topic_of(&settings, source)?.to_string()));
    counts.receive(Source::Imu);
    let said = Alerts::default().judge(&AlertInputs {
        base: Some(&counts),
        fault: Some(Fault::BaseSilent),
        ..AlertInputs::default()
    });
    assert_eq!(codes(&said), ["base-silent"]);
    let text = &said[0].text;
    assert!(
        text.contains("`/joint_states` (joints)") && !text.contains("imu"),
        "{text}"
    );
}

#[test]
fn a_robot_that_was_unloaded_is_an_alert_with_both_masses() {
    let apparent = |value| ValueWithStdDev {
        value,
        std_dev: 0.012,
    };
    let said = Alerts::default().judge(&AlertInputs {
        payload_change: Some(PayloadChange {
            before: apparent(1.25),
            after: apparent(1.05),
        }),
        ..AlertInputs::default()
    });
    assert_eq!(codes(&said), ["payload-changed"]);
    let text = &said[0].text;
    assert!(
        text.contains("unloaded") && text.contains("is 1.05 ± 0.01") && text.contains("1.25"),
        "{text}"
    );
}

#[test]
fn other_ground_and_wheels_that_dig_are_alerts_with_their_words() {
    let known = |theta, std_dev| ThetaKnowledge { theta, std_dev };
    let causes = AlertInputs {
        surface_change: Some(Comparison {
            cell: Cell { ix: -3, iy: 12 },
            measured: known(1.43, 0.05),
            expected: known(0.2, 0.02),
            robot_bias_ratio: ROBOT_BIAS_RATIO,
        }),
        dug_in_at: Some(Point {
            x_m: 3.04,
            y_m: -1.0,
        }),
        ..AlertInputs::default()
    };
    let said = Alerts::default().judge(&causes);
    assert_eq!(codes(&said), ["dug-in", "surface-change"]);
    assert_eq!(
        said[0].text,
        "the wheels turn and the robot stays at (3.0 m, -1.0 m)"
    );
    assert_eq!(
        said[1].text,
        "the ground in cell (-3, 12) slips more than the map says: θ 1.43 ± 0.05, not 0.20 ± 0.02"
    );
}

#[test]
fn sensors_that_contradict_are_alerts_by_code_with_channel_and_both_values() {
    let finding = |subject, kind, observed, predicted| Finding {
        subject,
        kind,
        observed,
        predicted,
        unit: Unit::RadiansPerSecond,
    };
    let frozen = finding(Subject::Gyro, Kind::Frozen, 0.52, -0.31);
    let mut alerts = sensor_alerts([sensor_alert(&frozen)]);
    let only = alerts.pop().unwrap();
    assert_eq!(only.code.as_str(), "sensor-frozen");
    assert_eq!(only.severity, Severity::Critical);
    assert_eq!(
        only.text,
        "gyro frozen: observed 0.52 rad/s, predicted -0.31 rad/s"
    );
    let contradictions = [
        finding(Subject::Odometry, Kind::Inconsistent, 0.9, 0.6),
        finding(Subject::Position, Kind::Jumped, 5.0, 0.0),
        finding(Subject::WheelsAndMotion, Kind::Inconsistent, 0.9, 0.1),
        finding(Subject::LeftWheels, Kind::Locked, 0.0, 6.0),
    ];
    let said = sensor_alerts(contradictions.iter().map(sensor_alert));
    assert_eq!(
        codes(&said),
        [
            "sensor-inconsistent",
            "wheels-and-motion-disagree",
            "wheel-locked"
        ]
    );
    assert_eq!(said[0].severity, Severity::Critical, "the worse of both");
    assert!(said[0].text.contains("odometry speed") && said[0].text.contains("position jumped"));
    assert_eq!(said[1].severity, Severity::Warning);
}

#[test]
fn frozen_wheel_torques_are_a_warning_with_their_values() {
    let said = Alerts::default().judge(&AlertInputs {
        frozen_torque: Some(WheelTorques {
            left_n_m: 1.25,
            right_n_m: 0.0,
        }),
        ..AlertInputs::default()
    });
    assert_eq!(codes(&said), ["sensor-frozen"]);
    assert_eq!(said[0].severity, Severity::Warning);
    assert!(said[0].text.contains("1.25 N m left"), "{}", said[0].text);
}

#[test]
fn standstill_that_is_not_reached_is_the_first_alert() {
    let mut causes = AlertInputs {
        is_stopped: true,
        standstill: StandstillReport {
            is_rest_commanded: true,
            standstill_not_reached: Some(MotionEvidence::Speed(0.59)),
            ..StandstillReport::default()
        },
        ..AlertInputs::default()
    };
    let said = Alerts::default().judge(&causes);
    assert_eq!(codes(&said), ["standstill-not-reached", "stopped"]);
    assert!(said[0].text.contains("0.59 m/s"), "{}", said[0].text);
    assert_eq!(said[0].severity, Severity::Critical);
    causes.standstill.standstill_not_reached = None;
    causes.standstill.unexpected_motion = Some(MotionEvidence::Distance(0.6));
    let said = Alerts::default().judge(&causes);
    assert_eq!(codes(&said), ["moves-while-stopped", "stopped"]);
}
