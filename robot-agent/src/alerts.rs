//! Derives the alerts that need a person's attention from the agent's state. Pure.
//!
//! An alert is raised as long as its cause lasts; the server records its begin and end. Continuous
//! values have two bounds (hysteresis), so that an alert does not flicker.

use std::ops::Range;

use tread_api::ids::AlertCode;
use tread_api::robot::{ALERT_TEXT_MAX, AlertReport, OutboxStatus, Severity};
use tread_control::consistency::{Consequence, Finding, Findings, Kind, Subject};
use tread_control::estimation::PayloadChange;
use tread_control::geometry::Point;
use tread_control::measured::WheelTorques;

use crate::control_loop::channels::Fault;
use crate::control_loop::overrun::{Overrun, WINDOW_TICKS};
use crate::control_loop::standstill::{MotionEvidence, StandstillReport};
use crate::control_loop::surface::Comparison;
use crate::drive::Battery;
use crate::drive::ros2::notices::{ForeignCommands, RecentNotices};
use crate::drive::ros2::refusal::Notice;
use crate::drive::ros2::refusal::{Counts, DropMonitor, Source};
use crate::outbox::OutboxDamage;

/// Charge below which the battery is low, and charge above which it no longer is.
const BATTERY_LOW: Range<f64> = 0.20..0.25;
/// Charge below which the battery is critical, and charge above which it no longer is.
const BATTERY_CRITICAL: Range<f64> = 0.05..0.08;
/// Number of waiting records above which an alert is raised, and below which it ends.
const OUTBOX_LONG: (u64, u64) = (50_000, 25_000);

/// Inputs of the alerts.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct AlertInputs<'a> {
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
    /// The last change of the payload, while it is reported.
    pub(crate) payload_change: Option<PayloadChange>,
    /// Wheel torques that are frozen.
    pub(crate) frozen_torque: Option<WheelTorques>,
    /// Position at which the wheels turn without moving the robot.
    pub(crate) dug_in_at: Option<Point>,
    /// Lateness of the loop while the robot is held for it.
    pub(crate) overrun: Option<Overrun>,
    /// Contradictions between sensors.
    pub(crate) findings: Findings,
    /// Result of the standstill watch.
    pub(crate) standstill: StandstillReport,
}

/// State of the alerts with hysteresis.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Alerts {
    battery_low: bool,
    battery_critical: bool,
    outbox_long: bool,
    drop_monitor: DropMonitor,
    recent_notices: [RecentNotices; Notice::ALL.len()],
    foreign_commands: ForeignCommands,
}

/// Whether a value counts as low: below both bounds it does, and between them if it did before.
fn is_below(value: f64, is_so: bool, Range { start, end }: Range<f64>) -> bool {
    value < if is_so { end } else { start }
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

fn payload_change(PayloadChange { before, after }: &PayloadChange) -> Option<AlertReport> {
    let how = if after.value > before.value {
        "was loaded"
    } else {
        "was unloaded"
    };
    let text = format!(
        "the robot {how} while it stood: its apparent mass is {:.2} ± {:.2} of the configured mass, \
         and was {:.2} ± {:.2}; speed and stopping distance depend on it",
        after.value, after.std_dev, before.value, before.std_dev,
    );
    alert("payload-changed", Severity::Warning, text)
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

/// Returns code, severity and text of frozen wheel torques.
fn frozen_torque_alert(torques: WheelTorques) -> (&'static str, Severity, String) {
    let text = format!(
        "wheel torques frozen: {:.2} N m left and {:.2} N m right to the last bit while the robot drives; θ is estimated without them",
        torques.left_n_m, torques.right_n_m
    );
    ("sensor-frozen", Severity::Warning, text)
}

/// Returns one alert for each code; those of the same code are joined.
fn sensor_alerts(
    found: impl IntoIterator<Item = (&'static str, Severity, String)>,
) -> Vec<AlertReport> {
    let mut alerts: Vec<AlertReport> = Vec::new();
    for (code, severity, text) in found {
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
fn standstill_alert(report: &StandstillReport) -> Option<AlertReport> {
    let measured = |shown: MotionEvidence| match shown {
        MotionEvidence::Speed(speed_m_s) => format!("{speed_m_s:.2} m/s"),
        MotionEvidence::Turn(turn_rad_s) => format!("{turn_rad_s:.2} rad/s"),
        MotionEvidence::Distance(distance_m) => format!("{distance_m:.1} m from where it stood"),
    };
    let (code, text) = if let Some(shown) = report.standstill_not_reached {
        let text = format!(
            "the robot is commanded to rest and has not come to rest: {}; its base does not obey",
            measured(shown)
        );
        ("standstill-not-reached", text)
    } else {
        let text = format!(
            "the robot stood and moves again: {}; it is pushed, rolls, or is driven by another program",
            measured(report.unexpected_motion?)
        );
        ("moves-while-stopped", text)
    };
    alert(code, Severity::Critical, text)
}

/// Returns the alert of a fault; that of a silent base names the topics that never came.
fn fault_alert(fault: Fault, base: Option<&Counts>) -> Option<AlertReport> {
    let code = match fault {
        Fault::BaseSilent => "base-silent",
        Fault::PositionLost => "position-lost",
    };
    let base = base.filter(|_| fault == Fault::BaseSilent);
    let missing = base.and_then(|base| base.topics_without_messages(&Source::OF_BASE));
    let text = match missing {
        Some(missing) => format!("{}: {missing}", fault.text()),
        None => fault.text().to_owned(),
    };
    alert(code, Severity::Critical, text)
}

impl Alerts {
    /// Returns the alerts that are raised now.
    pub(crate) fn judge(&mut self, causes: &AlertInputs<'_>) -> Vec<AlertReport> {
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
        let fault = causes
            .fault
            .and_then(|fault| fault_alert(fault, causes.base));
        let dropped = causes.base.and_then(|base| {
            let (refusal, text) = self.drop_monitor.check(base)?;
            let code = format!("base-{}", refusal.code());
            alert(&code, Severity::Warning, format!("the base: {text}"))
        });
        let noticed = Notice::ALL.map(|notice| {
            let text = self.recent_notices[notice as usize].check(causes.base?, notice)?;
            alert(notice.code(), Severity::Warning, text)
        });
        let foreign = causes.base.and_then(|base| {
            let text = self.foreign_commands.check(base)?;
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
            standstill_alert(&causes.standstill),
            battery,
            overrun,
            fault,
            dropped,
            stopped.flatten(),
            dug_in,
            causes.surface_change.as_ref().and_then(surface_change),
            causes.payload_change.as_ref().and_then(payload_change),
            long.flatten(),
            lost.flatten(),
            damaged,
            foreign,
        ]
        .into_iter()
        .chain(noticed)
        .flatten()
        .collect();
        let findings = causes.findings.iter().map(sensor_alert);
        let torques = causes.frozen_torque.map(frozen_torque_alert);
        alerts.extend(sensor_alerts(findings.chain(torques)));
        alerts
    }
}

#[cfg(test)]
mod tests;
