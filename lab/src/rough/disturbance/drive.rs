//! Drive of a robot of the rough world with a faulty channel or with blocked wheels.

use std::collections::VecDeque;
use std::time::Duration;

use tread_agent::drive::{Drive, Feedback, SensorSample};
use tread_agent::testing::SteppedDrive;
use tread_control::geometry::Pose;
use tread_control::measured::{BodyAcceleration, WheelSpeeds, WheelTorques};

use super::{Channel, ChannelFault, Disturbance};
use crate::rough::drive::RoughDrive;

/// Number of samples that a late channel remembers: two seconds of the fast sensors.
const HISTORY_MAX: usize = 200;

/// Speed and turn rate below which a robot stands, metres and radians per second.
const STANDS_BELOW_M_S: f64 = 0.02;
const STANDS_BELOW_RAD_S: f64 = 0.05;

/// Offset of a position that has jumped, per axis, metres: 1 m in total.
const JUMP_M: [f64; 2] = [0.6, -0.8];

/// A robot with at most one disturbance at a time.
#[derive(Debug, Clone)]
pub(super) struct DisturbedDrive {
    drive: RoughDrive,
    disturbance: Disturbance,
    /// Samples in which the faulty channel had a value, since the last one without the fault.
    history: VecDeque<SensorSample>,
    /// The agent's newest command.
    command: WheelSpeeds,
}

impl DisturbedDrive {
    /// Creates the drive without a disturbance.
    pub(super) fn new(drive: RoughDrive) -> Self {
        Self {
            drive,
            disturbance: Disturbance::None,
            history: VecDeque::new(),
            command: WheelSpeeds::default(),
        }
    }

    /// Begins a disturbance instead of the present one, or ends it with [`Disturbance::None`].
    pub(super) fn disturb(&mut self, disturbance: Disturbance) {
        if let Disturbance::GroundChange { stiffness } = disturbance {
            self.drive.change_ground(stiffness);
        }
        self.disturbance = disturbance;
    }

    /// Returns whether the robot truly stands.
    pub(super) fn stands(&self) -> bool {
        let state = self.drive.plant().truth().state;
        let speed_m_s = state.forward_m_s.hypot(state.left_m_s);
        speed_m_s < STANDS_BELOW_M_S && state.yaw_rate_rad_s.abs() < STANDS_BELOW_RAD_S
    }

    /// Returns the agent's newest command.
    pub(super) fn command(&self) -> WheelSpeeds {
        self.command
    }

    /// Returns the sample as the agent gets it.
    fn disturbed(&mut self, sample: SensorSample) -> SensorSample {
        match self.disturbance {
            Disturbance::Channel { channel, fault } => self.faulty(sample, channel, fault),
            Disturbance::PositionJump { .. } => SensorSample {
                position: sample.position.map(|pose| Pose {
                    x_m: pose.x_m + JUMP_M[0],
                    y_m: pose.y_m + JUMP_M[1],
                    ..pose
                }),
                ..sample
            },
            Disturbance::None
            | Disturbance::StartAside
            | Disturbance::BlockedWheels { .. }
            | Disturbance::GroundChange { .. } => sample,
        }
    }

    fn faulty(
        &mut self,
        sample: SensorSample,
        channel: Channel,
        fault: ChannelFault,
    ) -> SensorSample {
        if !channel.is_in(&sample) {
            return sample;
        }
        self.history.push_back(sample);
        if self.history.len() > HISTORY_MAX {
            self.history.pop_front();
        }
        let first = self.history.front().unwrap_or(&sample);
        match fault {
            ChannelFault::Frozen => channel.replaced(sample, first),
            ChannelFault::Zero => channel.replaced(sample, &zeros()),
            ChannelFault::Dropped => channel.replaced(sample, &SensorSample::default()),
            ChannelFault::Late(late) => {
                let due = sample.at.saturating_sub(late);
                let mut earlier = self.history.iter().rev();
                let value = earlier.find(|known| known.at <= due).unwrap_or(first);
                channel.replaced(sample, value)
            }
        }
    }
}

/// A sample with zero in each channel.
fn zeros() -> SensorSample {
    SensorSample {
        yaw_rate_rad_s: Some(0.0),
        acceleration: Some(BodyAcceleration::default()),
        wheel_speeds: Some(WheelSpeeds::default()),
        wheel_torques: Some(WheelTorques {
            left_n_m: 0.0,
            right_n_m: 0.0,
        }),
        body_speed_m_s: Some(0.0),
        position: Some(Pose::default()),
        ..SensorSample::default()
    }
}

impl Channel {
    fn is_in(self, sample: &SensorSample) -> bool {
        match self {
            Self::Gyro => sample.yaw_rate_rad_s.is_some(),
            Self::Accelerometer => sample.acceleration.is_some(),
            Self::WheelSpeeds => sample.wheel_speeds.is_some(),
            Self::WheelTorques => sample.wheel_torques.is_some(),
            Self::BodySpeed => sample.body_speed_m_s.is_some(),
            Self::Position => sample.position.is_some(),
        }
    }

    /// Returns `sample` with this channel's value of `other`.
    fn replaced(self, mut sample: SensorSample, other: &SensorSample) -> SensorSample {
        match self {
            Self::Gyro => sample.yaw_rate_rad_s = other.yaw_rate_rad_s,
            Self::Accelerometer => sample.acceleration = other.acceleration,
            Self::WheelSpeeds => sample.wheel_speeds = other.wheel_speeds,
            Self::WheelTorques => sample.wheel_torques = other.wheel_torques,
            Self::BodySpeed => sample.body_speed_m_s = other.body_speed_m_s,
            Self::Position => sample.position = other.position,
        }
        sample
    }
}

impl SteppedDrive for DisturbedDrive {
    fn advance(&mut self, now: Duration) {
        self.drive.advance(now);
    }
}

impl Drive for DisturbedDrive {
    fn read(&mut self, now: Duration) -> Feedback {
        let read = self.drive.read(now);
        let mut feedback = Feedback::default();
        for sample in read.samples() {
            feedback.push(self.disturbed(*sample));
        }
        feedback.with_lost(read.lost())
    }

    fn write(&mut self, command: WheelSpeeds) {
        self.command = command;
        let is_blocked = matches!(self.disturbance, Disturbance::BlockedWheels { .. });
        self.drive.write(WheelSpeeds {
            left_rad_s: if is_blocked { 0.0 } else { command.left_rad_s },
            ..command
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Random;
    use crate::rough::sensors::{SAMPLE_PERIOD, SensorSpec};
    use crate::rough::spec::{Deviations, MAKES};

    /// The yaw rates that an agent reads in a second with a fault of the gyro.
    fn yaw_rates(fault: ChannelFault) -> Vec<Option<f64>> {
        let model = MAKES[0].model().expect("a model");
        let robot = RoughDrive::new(
            &model,
            Deviations::none(3.0),
            SensorSpec::usual(false),
            Pose::default(),
            Random::new(1),
        );
        let mut drive = DisturbedDrive::new(robot.expect("a robot"));
        drive.disturb(Disturbance::Channel {
            channel: Channel::Gyro,
            fault,
        });
        drive.write(WheelSpeeds {
            left_rad_s: -5.0,
            right_rad_s: 5.0,
        });
        let mut read = Vec::new();
        for tick in 1..=100 {
            let now = SAMPLE_PERIOD * tick;
            drive.advance(now);
            let feedback = drive.read(now);
            let fast = feedback
                .samples()
                .iter()
                .find(|sample| sample.wheel_speeds.is_some());
            read.extend(fast.map(|sample| sample.yaw_rate_rad_s));
        }
        read
    }

    #[test]
    fn a_channel_fails_as_its_fault_says() {
        let frozen = yaw_rates(ChannelFault::Frozen);
        assert!(
            frozen.len() > 90
                && frozen
                    .iter()
                    .all(|rate| *rate == frozen[0] && rate.is_some())
        );
        assert!(yaw_rates(ChannelFault::Dropped).iter().all(Option::is_none));
        assert!(
            yaw_rates(ChannelFault::Zero)
                .iter()
                .all(|rate| *rate == Some(0.0))
        );
        let (late, sound) = (
            yaw_rates(ChannelFault::Late(5 * SAMPLE_PERIOD)),
            yaw_rates(ChannelFault::Late(Duration::ZERO)),
        );
        assert_eq!(late[60], sound[55]);
        assert!(sound[60].is_some_and(|rate| rate > 0.3), "{:?}", sound[60]);
    }
}
