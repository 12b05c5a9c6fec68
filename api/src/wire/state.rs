//! State that a robot publishes periodically, the request for a higher rate of it, and the server's
//! pulse. Only the newest message counts, so a lost one does no harm.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};

use crate::enrolment::TrustId;
use crate::friction::LiveFriction;
use crate::geometry::{Pose, Twist};
use crate::ids::{BootId, RobotId};
use crate::keys::Verb;
use crate::robot::{
    Aged, AlertReport, Battery, LoopStatus, MissionProgress, OutboxStatus, RobotMode,
};
use crate::safety::SafetyStatus;
use crate::site::Cell;
use crate::terrain::TerrainRef;
use crate::wire::reply::{Acknowledgement, Command};

/// State of a robot, published on its `state` key.
///
/// Ages are by the robot's monotonic clock at the time of sending.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RobotState {
    /// Identifier of the robot; must equal the one in the key.
    pub robot: RobotId,
    /// Present run of the agent.
    pub boot: BootId,
    /// Sequence number of the state within the run.
    pub seq: u64,
    /// Wall clock of the robot; it may be wrong.
    pub robot_time: Timestamp,
    /// Monotonic clock of the agent at sending, microseconds, to which end times for this run
    /// refer. Absent from an older agent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub monotonic_us: Option<u64>,
    /// Operating mode of the agent.
    pub mode: RobotMode,
    /// Reason of a fault, for people; absent without one.
    #[serde(
        default,
        skip_serializing_if = "Option::is_none",
        deserialize_with = "crate::text::bounded_option::<_, {crate::robot::FAULT_TEXT_MAX}>"
    )]
    pub fault: Option<String>,
    /// Pose in the site frame; `null` if unknown.
    pub pose: Option<Aged<Pose>>,
    /// Velocity in the robot frame; `null` if unknown.
    pub twist: Option<Aged<Twist>>,
    /// Progress of the active mission; `null` without one.
    pub mission: Option<MissionProgress>,
    /// Revision of the site's terrains on the robot; `null` before it has a definition of the site.
    pub terrain_revision: Option<u64>,
    /// State of the queue of records for the server.
    pub outbox: OutboxStatus,
    /// State of the control loop. If its number of ticks does not increase, the state does not
    /// count as a heartbeat.
    pub control_loop: LoopStatus,
    /// State of the battery; absent if the base does not measure it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub battery: Option<Battery>,
    /// Conditions that need a person's attention now, at most
    /// [`ALERTS_MAX`](crate::robot::ALERTS_MAX), each code once.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub alerts: Vec<AlertReport>,
    /// Whether the agent shuts down and this is its last state; no alert is raised for its absence
    /// then.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub leaving: bool,
    /// Stops, leases, limits and everything else that reduces the robot's motion. Absent from an
    /// older agent.
    #[serde(default)]
    pub safety: SafetyStatus,
}

/// Maximum magnitude of a speed that a state can show, metres per second; far above that of any
/// skid-steered robot.
const SPEED_MAX_M_S: f64 = 100.0;
/// Maximum magnitude of a turn rate that a state can show, radians per second.
const TURN_RATE_MAX_RAD_S: f64 = 1_000.0;
/// Maximum voltage of a battery, volts.
pub const VOLTAGE_MAX_V: f64 = 1_000.0;
/// Maximum magnitude of a heading that is wrapped to ±π, radians; a larger one has no direction left.
const HEADING_MAX_RAD: f64 = 1.0e6;

impl RobotState {
    /// Removes pose, velocity and battery values that no robot can have, as a broken sensor or
    /// driver gives them, and wraps the heading to ±π. The rest still counts as a heartbeat.
    pub fn remove_impossible_values(&mut self) {
        self.pose = self.pose.take().and_then(|pose| {
            let value = possible_pose(pose.value)?;
            Some(Aged { value, ..pose })
        });
        self.twist.take_if(|twist| !is_possible_twist(&twist.value));
        self.battery = self.battery.take().and_then(possible_battery);
    }
}

fn possible_pose(pose: Pose) -> Option<Pose> {
    use std::f64::consts::{PI, TAU};
    if !pose.position().is_on_the_map() || pose.heading_rad.abs() > HEADING_MAX_RAD {
        return None;
    }
    let heading_rad = match pose.heading_rad {
        heading_rad if heading_rad.abs() <= PI => heading_rad,
        heading_rad => (heading_rad + PI).rem_euclid(TAU) - PI,
    };
    Some(Pose {
        heading_rad,
        ..pose
    })
}

fn is_possible_twist(twist: &Twist) -> bool {
    twist.linear_m_s.abs() <= SPEED_MAX_M_S && twist.angular_rad_s.abs() <= TURN_RATE_MAX_RAD_S
}

fn possible_battery(battery: Battery) -> Option<Battery> {
    let is_voltage = |voltage_v: &f64| (0.0..=VOLTAGE_MAX_V).contains(voltage_v);
    (0.0..=1.0)
        .contains(&battery.charge_ratio)
        .then(|| Battery {
            voltage_v: battery.voltage_v.filter(is_voltage),
            ..battery
        })
}

/// State rate that the server requests while somebody watches or drives a robot, Hz.
pub const WATCHED_STATE_RATE_HZ: f64 = 10.0;
/// Maximum state rate that an agent takes from a request, Hz.
pub const STATE_RATE_MAX_HZ: f64 = 20.0;
/// Maximum duration of a request for a state rate, milliseconds; an agent shortens a longer one.
pub const STATE_RATE_FOR_MAX_MS: u64 = 10_000;

/// `cmd/state_rate`: requests states at a rate for a limited time.
///
/// The newest request counts. An agent reduces a rate above [`STATE_RATE_MAX_HZ`] to it, and never
/// publishes at less than its own configured rate. When the time has passed or the connection is
/// lost, the agent returns to its own rate. A rate that [`StateRate::validate`] refuses is answered
/// as `impossible`. An agent of an older release does not answer.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct StateRate {
    /// Rate of states, Hz, above 0.
    pub rate_hz: f64,
    /// Duration of the request from its arrival, milliseconds; 0 ends the one before.
    pub for_ms: u64,
}

impl StateRate {
    /// Checks the rate.
    ///
    /// # Errors
    /// A message for people, if the rate is not finite or not above 0.
    pub fn validate(&self) -> Result<(), String> {
        let rate_hz = self.rate_hz;
        if rate_hz.is_finite() && rate_hz > 0.0 {
            return Ok(());
        }
        Err(format!("rate_hz must be finite and above 0, not {rate_hz}"))
    }
}

impl Command for StateRate {
    const VERB: Verb = Verb::StateRate;
    type Reply = Acknowledgement;
}

/// Pulse of the server, published every [`PULSE_PERIOD_MS`] milliseconds on the site's `pulse` key.
///
/// From it a robot measures for how long the server has been silent.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct ServerPulse {
    /// Wall clock of the server.
    pub server_time: Timestamp,
    /// Identifier of the authorities that robots must trust; a robot that trusts others renews its
    /// certificate. Absent where robots need no certificates, and from an older server.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub trust: Option<TrustId>,
}

/// Period of the server's pulse, milliseconds.
pub const PULSE_PERIOD_MS: u64 = 250;

/// Friction estimates of a robot, published on its `friction` key.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FrictionReport {
    /// Identifier of the robot; must equal the one in the key.
    pub robot: RobotId,
    /// Present run of the agent.
    pub boot: BootId,
    /// Sequence number of the report within the run.
    pub seq: u64,
    /// Wall clock of the robot; it may be wrong.
    pub robot_time: Timestamp,
    /// Cell at the robot's position; `null` if unknown.
    pub cell: Option<Cell>,
    /// Terrain under the robot; `null` if there is none or it is unknown.
    pub terrain: Option<TerrainRef>,
    /// Estimates of the tracking law and of the estimator.
    pub friction: LiveFriction,
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use serde_json::json;

    use super::*;
    use crate::safety::{StandstillState, StandstillStatus};
    use crate::wire;

    #[test]
    fn a_state_with_the_names_of_an_earlier_agent_is_read() {
        let safety: SafetyStatus = serde_json::from_value(json!({
            "gate": {"cause": null, "reduced_ticks": 3, "counts": [{"cause": "stop", "times": 2}]},
            "standing": {"state": "does_not_stand", "took_ms": 700},
        }))
        .unwrap();
        let standstill = StandstillStatus {
            state: StandstillState::StandstillNotReached,
            stopping_time_ms: Some(700),
        };
        assert_eq!(safety.standstill, Some(standstill));
        assert_eq!(safety.gate.counts[0].count, 2);
        let report: AlertReport = serde_json::from_value(json!({
            "code": "does-not-stand", "severity": "critical", "text": "0.59 m/s",
        }))
        .unwrap();
        assert_eq!(report.code.as_str(), "standstill-not-reached");
    }

    proptest! {
        #[test]
        fn a_state_shows_only_values_that_a_robot_can_have(
            x_m: f64, y_m: f64, heading_rad: f64, charge_ratio: f64, voltage_v: f64,
        ) {
            let pose = possible_pose(Pose { x_m, y_m, heading_rad });
            if let Some(pose) = pose {
                prop_assert!(pose.position().is_on_the_map());
                prop_assert!(pose.heading_rad.abs() <= std::f64::consts::PI);
            }
            let battery = Battery { charge_ratio, voltage_v: Some(voltage_v), charging: false };
            if let Some(battery) = possible_battery(battery) {
                prop_assert!((0.0..=1.0).contains(&battery.charge_ratio));
                prop_assert!(battery.voltage_v.is_none_or(|voltage_v| voltage_v >= 0.0));
            }
        }

        #[test]
        fn a_heading_keeps_its_direction(turns in -100..100_i32, heading_rad in -3.1..3.1_f64) {
            let unwrapped = heading_rad + f64::from(turns) * std::f64::consts::TAU;
            let pose = possible_pose(Pose { x_m: 1.0, y_m: 2.0, heading_rad: unwrapped }).unwrap();
            prop_assert!((pose.heading_rad - heading_rad).abs() < 1.0e-9);
        }

        #[test]
        fn a_state_rate_survives_the_wire_and_only_a_positive_finite_rate_is_valid(
            rate_hz in any::<f64>(),
            for_ms in 0..1_u64 << 53,
        ) {
            let asked = StateRate { rate_hz, for_ms };
            prop_assert_eq!(asked.validate().is_ok(), rate_hz.is_finite() && rate_hz > 0.0);
            let read = wire::encode(&asked).ok().map(|text| wire::decode::<StateRate>(&text));
            if rate_hz.is_finite() {
                prop_assert_eq!(read.unwrap().unwrap(), asked);
            } else {
                // No such number exists on the wire.
                prop_assert!(!matches!(read, Some(Ok(_))));
            }
        }
    }
}
