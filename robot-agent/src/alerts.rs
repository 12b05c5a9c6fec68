//! Derives the alerts that need a person's attention from the agent's state. Pure.
//!
//! An alert is raised as long as its cause lasts; the server records its begin and end. Continuous
//! values have two bounds (hysteresis), so that an alert does not flicker.

use tread_api::ids::AlertCode;
use tread_api::robot::{ALERT_TEXT_MAX, AlertReport, OutboxStatus, Severity};
use tread_control::consistency::{Consequence, Finding, Findings, Kind, Subject};
use tread_control::geometry::Point;

use crate::control_loop::channels::Fault;
use crate::control_loop::overrun::{Overrun, WINDOW_TICKS};
use crate::control_loop::standing::{Shown, StandingReport};
use crate::control_loop::surface::Comparison;
use crate::drive::Battery;
use crate::drive::ros2::notices::{ForeignCommands, Notice, Noticing};
use crate::drive::ros2::refusal::{Counts, Dropping};
use crate::outbox::OutboxDamage;

/// Charge below which the battery is low, and charge above which it no longer is.
const BATTERY_LOW: (f64, f64) = (0.20, 0.25);
/// Charge below which the battery is critical, and charge above which it no longer is.
const BATTERY_CRITICAL: (f64, f64) = (0.05, 0.08);
/// Number of waiting records above which an alert is raised, and below which it ends.
const OUTBOX_LONG: (u64, u64) = (50_000, 25_000);

/// Inputs of the alerts.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Causes<'a> {
    pub(crate) battery: Option<Battery>,
    pub(crate) fault: Option<Fault>,
    pub(crate) is_stopped: bool,
    pub(crate) outbox: OutboxStatus,
    /// Records lost by damage of the outbox's files.
    pub(crate) outbox_damage: Option<&'a OutboxDamage>,
    /// Counts of the base's dropped messages.
    pub(crate) base: Option<&'a Counts>,
    /// The comparison that shows that the ground differs from the map.
    pub(crate) surface_change: Option<Comparison>,
    /// Position at which the wheels turn without moving the robot.
    pub(crate) dug_in_at: Option<Point>,
    /// Lateness of the loop while the robot is held for it.
    pub(crate) overrun: Option<Overrun>,
    /// Contradictions between sensors.
    pub(crate) findings: Findings,
    /// Result of the standstill watch.
    pub(crate) standing: StandingReport,
}

/// State of the alerts with hysteresis.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Alerts {
    battery_low: bool,
    battery_critical: bool,
    outbox_long: bool,
    dropping: Dropping,
    noticing: [Noticing; Notice::ALL.len()],
    foreign_commands: ForeignCommands,
}

/// Whether a value counts as below the bound of the present state.
fn is_below<T: PartialOrd + Copy>(value: T, is_so: bool, (enter, leave): (T, T)) -> bool {
    if is_so { value < leave } else { value < enter }
}

fn alert(code: &str, severity: Severity, text: String) -> Option<AlertReport> {
    let code: AlertCode = code.parse().ok()?;
    Some(AlertReport {
        code,
        severity,
        text,
    })
}

fn surface_change(found: &Comparison) -> Option<AlertReport> {
    let (measured, expected) = (found.measured, found.expected);
    let how = if measured.theta > expected.theta {
        "slips more"
    } else {
        "has more friction"
    };
    let text = format!(
        "the ground in cell ({}, {}) {how} than the map says: θ {:.2} ± {:.2}, not {:.2} ± {:.2}",
        found.cell.ix,
        found.cell.iy,
        measured.theta,
        measured.std_dev,
        expected.theta,
        expected.std_dev,
    );
    alert("surface-change", Severity::Warning, text)
}

/// Returns code, severity and text of a finding.
fn sensor_alert(finding: &Finding) -> (&'static str, Severity, String) {
    let Finding {
        subject,
        kind,
        observed,
        predicted,
        unit,
    } = *finding;
    let code = match (subject, kind) {
        (Subject::WheelsAndMotion, _) => "wheels-and-motion-disagree",
        (_, Kind::Locked) => "wheel-locked",
        (_, Kind::Frozen) => "sensor-frozen",
        (_, Kind::Inverted | Kind::Jumped | Kind::Inconsistent) => "sensor-inconsistent",
    };
    let how = match kind {
        Kind::Frozen => "frozen",
        Kind::Inverted => "inverted",
        Kind::Jumped => "jumped",
        Kind::Inconsistent => "inconsistent",
        Kind::Locked => "locked",
    };
    let (name, unit) = (subject.text(), unit.symbol());
    let text = if subject == Subject::WheelsAndMotion {
        format!(
            "wheels and motion disagree: wheels {observed:.2} {unit}, motion {predicted:.2} {unit}; \
             they slip, or a sensor is wrong"
        )
    } else if subject == Subject::Motion {
        format!("{name} disagree: {observed:.2} against {predicted:.2} {unit}")
    } else if kind == Kind::Jumped {
        format!("{name} jumped by {observed:.2} {unit}")
    } else {
        format!("{name} {how}: observed {observed:.2} {unit}, predicted {predicted:.2} {unit}")
    };
    let severity = match subject.consequence() {
        Consequence::Hold => Severity::Critical,
        Consequence::Slow | Consequence::NoLearning => Severity::Warning,
    };
    (code, severity, text)
}

/// Returns one alert for each code; findings of the same code are joined.
fn sensor_alerts<'a>(findings: impl IntoIterator<Item = &'a Finding>) -> Vec<AlertReport> {
    let mut alerts: Vec<AlertReport> = Vec::new();
    for (code, severity, text) in findings.into_iter().map(sensor_alert) {
        match alerts.iter_mut().find(|known| known.code.as_str() == code) {
            Some(known) => {
                known.severity = known.severity.max(severity);
                known.text = format!("{}; {text}", known.text)
                    .chars()
                    .take(ALERT_TEXT_MAX)
                    .collect();
            }
            None => alerts.extend(alert(code, severity, text)),
        }
    }
    alerts
}

/// Returns the alert for a robot that moves although commanded to zero.
fn standing_alert(report: &StandingReport) -> Option<AlertReport> {
    let measured = |shown: Shown| match shown {
        Shown::Speed(speed_m_s) => format!("{speed_m_s:.2} m/s"),
        Shown::Turn(turn_rad_s) => format!("{turn_rad_s:.2} rad/s"),
        Shown::Distance(distance_m) => format!("{distance_m:.1} m from where it stood"),
    };
    let (code, text) = if let Some(shown) = report.does_not_stand {
        let text = format!(
            "the robot is commanded to rest and does not stand: {}; its base does not obey",
            measured(shown)
        );
        ("does-not-stand", text)
    } else {
        let text = format!(
            "the robot stood and moves again: {}; it is pushed, rolls, or is driven by another program",
            measured(report.moves?)
        );
        ("moves-while-stopped", text)
    };
    alert(code, Severity::Critical, text)
}

impl Alerts {
    /// Returns the alerts that are raised now.
    pub(crate) fn judge(&mut self, causes: &Causes<'_>) -> Vec<AlertReport> {
        let charge = causes.battery.map(|battery| battery.charge_ratio);
        self.battery_low =
            charge.is_some_and(|charge| is_below(charge, self.battery_low, BATTERY_LOW));
        self.battery_critical =
            charge.is_some_and(|charge| is_below(charge, self.battery_critical, BATTERY_CRITICAL));
        let (many, few) = OUTBOX_LONG;
        let pending = causes.outbox.pending;
        self.outbox_long = pending > if self.outbox_long { few } else { many };
        let percent = charge.map_or(0.0, |charge| 100.0 * charge);
        let battery = if self.battery_critical {
            let text = format!("the battery is nearly empty: {percent:.0} %");
            alert("battery-critical", Severity::Critical, text)
        } else if self.battery_low {
            let text = format!("the battery is low: {percent:.0} %");
            alert("battery-low", Severity::Warning, text)
        } else {
            None
        };
        let fault = causes.fault.and_then(|fault| {
            let code = match fault {
                Fault::BaseSilent => "base-silent",
                Fault::PositionLost => "position-lost",
            };
            alert(code, Severity::Critical, fault.text().to_owned())
        });
        let dropped = causes.base.and_then(|base| {
            let (refusal, text) = self.dropping.look(base)?;
            let code = format!("base-{}", refusal.code());
            alert(&code, Severity::Warning, format!("the base: {text}"))
        });
        let noticed = Notice::ALL.map(|notice| {
            let text = self.noticing[notice as usize].look(causes.base?, notice)?;
            alert(notice.code(), Severity::Warning, text)
        });
        let foreign = causes.base.and_then(|base| {
            let text = self.foreign_commands.look(base)?;
            alert("command-second-writer", Severity::Critical, text)
        });
        let long = self.outbox_long.then(|| {
            let text = "many measurements wait for the server".to_owned();
            alert("outbox-long", Severity::Warning, text)
        });
        let damage = causes.outbox_damage;
        let damaged = damage.and_then(|damage| {
            let (lost, kept_in) = (damage.lost_records, damage.kept_in.as_ref()?.display());
            let text = format!(
                "files of the outbox were damaged, {lost} records were lost: the disk may be failing; \
                 what was damaged is in `{kept_in}`"
            );
            alert("outbox-damaged", Severity::Warning, text)
        });
        let by_damage = damage.map_or(0, |damage| damage.lost_records);
        let lost = (causes.outbox.dropped > by_damage).then(|| {
            let text = "measurements were lost: the store was full".to_owned();
            alert("outbox-dropped", Severity::Warning, text)
        });
        let stopped = causes.is_stopped.then(|| {
            let text = "the robot is stopped until an operator clears it".to_owned();
            alert("stopped", Severity::Critical, text)
        });
        let dug_in = causes.dug_in_at.and_then(|at| {
            let Point { x_m, y_m } = at;
            let text = format!("the wheels turn and the robot stays at ({x_m:.1} m, {y_m:.1} m)");
            alert("dug-in", Severity::Critical, text)
        });
        let overrun = causes.overrun.and_then(|Overrun { late, late_ticks }| {
            let late_ms = late.as_millis();
            let text = format!(
                "the control loop is late and the robot is held: a tick by {late_ms} ms, \
                 {late_ticks} of {WINDOW_TICKS} ticks"
            );
            alert("loop-overrun", Severity::Critical, text)
        });
        let mut alerts: Vec<AlertReport> = [
            standing_alert(&causes.standing),
            battery,
            overrun,
            fault,
            dropped,
            stopped.flatten(),
            dug_in,
            causes.surface_change.as_ref().and_then(surface_change),
            long.flatten(),
            lost.flatten(),
            damaged,
            foreign,
        ]
        .into_iter()
        .chain(noticed)
        .flatten()
        .collect();
        alerts.extend(sensor_alerts(causes.findings.iter()));
        alerts
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use tread_api::friction::ROBOT_BIAS_RATIO;
    use tread_api::site::Cell;
    use tread_control::consistency::Unit;
    use tread_control::tracking::ThetaKnowledge;

    use super::*;
    use crate::drive::ros2::refusal::Source;

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
            alerts.judge(&Causes {
                battery,
                ..Causes::default()
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
        let mut causes = Causes {
            fault: Some(Fault::BaseSilent),
            outbox: OutboxStatus {
                pending: 60_000,
                dropped: 1,
                refused: 0,
            },
            ..Causes::default()
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
        let causes = Causes {
            overrun: Some(Overrun {
                late: Duration::from_millis(310),
                late_ticks: 5,
            }),
            ..Causes::default()
        };
        let said = Alerts::default().judge(&causes);
        assert_eq!(codes(&said), ["loop-overrun"]);
        let text =
            "the control loop is late and the robot is held: a tick by 310 ms, 5 of 64 ticks";
        assert_eq!(said[0].text, text);
    }

    #[test]
    fn records_lost_by_damage_are_an_alert_of_their_own_with_their_number() {
        let damage = OutboxDamage {
            lost_records: 34,
            kept_in: Some("/data/outbox/damaged.bin".into()),
        };
        let mut causes = Causes {
            outbox: OutboxStatus {
                pending: 34,
                dropped: 34,
                refused: 0,
            },
            outbox_damage: Some(&damage),
            ..Causes::default()
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
            Causes {
                base: Some(&counts),
                ..Causes::default()
            },
        );
        assert!(alerts.judge(&causes).is_empty());
        counts.note(Source::Joints, Notice::Restarted);
        counts.note_foreign_command();
        let said = alerts.judge(&causes);
        assert_eq!(codes(&said), ["command-second-writer", "base-restarted"]);
        assert!(said[0].text.contains("another node"), "{said:?}");
        assert!(said[1].text.contains("joints"), "{said:?}");
    }

    #[test]
    fn other_ground_and_wheels_that_dig_are_alerts_with_their_words() {
        let known = |theta, std_dev| ThetaKnowledge { theta, std_dev };
        let causes = Causes {
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
            ..Causes::default()
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
        let mut alerts = sensor_alerts(&[finding(Subject::Gyro, Kind::Frozen, 0.52, -0.31)]);
        let only = alerts.pop().unwrap();
        assert_eq!(only.code.as_str(), "sensor-frozen");
        assert_eq!(only.severity, Severity::Critical);
        assert_eq!(
            only.text,
            "gyro frozen: observed 0.52 rad/s, predicted -0.31 rad/s"
        );
        let said = sensor_alerts(&[
            finding(Subject::Odometry, Kind::Inconsistent, 0.9, 0.6),
            finding(Subject::Position, Kind::Jumped, 5.0, 0.0),
            finding(Subject::WheelsAndMotion, Kind::Inconsistent, 0.9, 0.1),
            finding(Subject::LeftWheels, Kind::Locked, 0.0, 6.0),
        ]);
        assert_eq!(
            codes(&said),
            [
                "sensor-inconsistent",
                "wheels-and-motion-disagree",
                "wheel-locked"
            ]
        );
        assert_eq!(said[0].severity, Severity::Critical, "the worse of both");
        assert!(
            said[0].text.contains("odometry speed") && said[0].text.contains("position jumped")
        );
        assert_eq!(said[1].severity, Severity::Warning);
    }

    #[test]
    fn a_robot_that_does_not_stand_is_the_first_alert() {
        let mut causes = Causes {
            is_stopped: true,
            standing: StandingReport {
                is_to_stand: true,
                does_not_stand: Some(Shown::Speed(0.59)),
                ..StandingReport::default()
            },
            ..Causes::default()
        };
        let said = Alerts::default().judge(&causes);
        assert_eq!(codes(&said), ["does-not-stand", "stopped"]);
        assert!(said[0].text.contains("0.59 m/s"), "{}", said[0].text);
        assert_eq!(said[0].severity, Severity::Critical);
        causes.standing.does_not_stand = None;
        causes.standing.moves = Some(Shown::Distance(0.6));
        let said = Alerts::default().judge(&causes);
        assert_eq!(codes(&said), ["moves-while-stopped", "stopped"]);
    }
}
