//! What a moving robot's messages say: wheel directions, sides, signs, radius, effective track.
//!
//! Pure: from what was told and what was said while the robot turned to the left on the spot, and
//! while it drove ahead.

use tread_control::measured::{WheelSpeeds, WheelTorques};
use tread_control::robot::RobotModel;
use tread_ros2::messages::Time;

use super::heard::Message;
use super::{Finding, pulling};
use crate::drive::ros2::inlet::decoded;
use crate::drive::ros2::reading::{Content, Position, Wheels, wheels_of};
use crate::drive::ros2::settings::{MotionOf, Ros2Settings};

/// Speed below which a wheel counts as standing, as a share of what it was told.
const STANDING_SHARE: f64 = 0.2;
/// Turn rate below which a robot does not turn, radians per second.
const TURNING_RAD_S: f64 = 0.05;
/// Least spread of the places' times for a speed, seconds squared: ten over a second.
const PLACES_SPREAD_MIN_S2: f64 = 0.8;
/// Messages of the wheels whose mean is the speed that they gained.
const LAST_SPEEDS: usize = 10;
/// Error of a radius that is borne, as a share.
const RADIUS_SHARE: f64 = 0.06;

/// What was told and said over the second half of a motion.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Drove {
    /// What the wheels were told.
    pub(super) told: WheelSpeeds,
    /// What they said; none if they said nothing.
    pub(super) wheels: Option<WheelSpeeds>,
    /// How the robot turned, radians per second.
    pub(super) turn_rad_s: Option<f64>,
    /// How fast it went over ground, metres per second.
    pub(super) ground_m_s: Option<f64>,
    /// How they pulled; none if that is not known.
    pub(super) torques: Option<WheelTorques>,
    /// How both sides together pulled while the robot set off.
    pub(super) set_off: Option<SetOff>,
    /// Whether the base was heard all the while.
    pub(super) is_heard: bool,
}

/// How the wheels of both sides pulled from rest to the whole speed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct SetOff {
    /// Their mean torque together, newton metres.
    pub(super) torque_n_m: f64,
    /// How long that took, by the messages' stamps.
    pub(super) span_s: f64,
    /// How fast they turned at its end.
    pub(super) gained_rad_s: f64,
}

/// A mean that grows.
#[derive(Debug, Clone, Copy, Default)]
struct Mean {
    sum: f64,
    count: f64,
}

impl Mean {
    fn add(&mut self, value: f64) {
        self.sum += value;
        self.count += 1.0;
    }

    fn value(self) -> Option<f64> {
        (self.count > 0.0).then(|| self.sum / self.count)
    }
}

/// Sums up what was said while the robot set off, and when its speed was steady.
pub(super) fn drove(
    told: WheelSpeeds,
    settings: &Ros2Settings,
    starting: &[Message],
    messages: &[Message],
) -> Drove {
    let (mut left, mut right) = (Mean::default(), Mean::default());
    let (mut left_torque, mut right_torque) = (Mean::default(), Mean::default());
    let (mut gyro, mut odometry_turn, mut speed) =
        (Mean::default(), Mean::default(), Mean::default());
    let mut places: Vec<(f64, Position)> = Vec::new();
    let motion_of = settings
        .odometry
        .as_ref()
        .map(|odometry| odometry.motion_of);
    for message in messages {
        let Ok(Some((stamp, content))) = decoded(settings, message.source, &message.payload) else {
            continue;
        };
        let mut add_wheels = |speeds: WheelSpeeds| {
            left.add(speeds.left_rad_s);
            right.add(speeds.right_rad_s);
        };
        let at_s = seconds(stamp);
        match content {
            Content::Wheels(wheels) => {
                add_wheels(wheels.speeds);
                if let Some(torques) = wheels.torques {
                    left_torque.add(torques.left_n_m);
                    right_torque.add(torques.right_n_m);
                }
            }
            Content::Inertial(inertial) => gyro.add(inertial.yaw_rate_rad_s),
            Content::Motion(motion) => {
                odometry_turn.add(motion.yaw_rate_rad_s);
                if settings.joints.is_none() {
                    add_wheels(wheels_of(&motion, &settings.command));
                }
                if motion_of == Some(MotionOf::Ground) {
                    speed.add(motion.ahead_m_s);
                }
                places.extend(motion.position.map(|position| (at_s, position)));
            }
            Content::Position(position) => places.push((at_s, position)),
            Content::Battery(_) => {}
        }
    }
    Drove {
        told,
        wheels: left
            .value()
            .zip(right.value())
            .map(|(left_rad_s, right_rad_s)| WheelSpeeds {
                left_rad_s,
                right_rad_s,
            }),
        turn_rad_s: gyro.value().or(odometry_turn.value()),
        ground_m_s: speed_of(&places).or(speed.value()),
        torques: left_torque
            .value()
            .zip(right_torque.value())
            .map(|(left_n_m, right_n_m)| WheelTorques {
                left_n_m,
                right_n_m,
            }),
        set_off: set_off(settings, starting),
        is_heard: true,
    }
}

/// How the wheels pulled in all of these messages.
fn set_off(settings: &Ros2Settings, messages: &[Message]) -> Option<SetOff> {
    let mut torque = Mean::default();
    let mut said = Vec::with_capacity(messages.len());
    for message in messages {
        let Ok(Some((stamp, content))) = decoded(settings, message.source, &message.payload) else {
            continue;
        };
        if let Content::Wheels(Wheels {
            speeds,
            torques: Some(torques),
        }) = content
        {
            torque.add(torques.left_n_m + torques.right_n_m);
            let speed_rad_s = 0.5 * (speeds.left_rad_s + speeds.right_rad_s);
            said.push((seconds(stamp), speed_rad_s));
        }
    }
    let ((first_s, _), (last_s, _)) = (said.first()?, said.last()?);
    let intervals = torque.count - 1.0;
    let mut gained = Mean::default();
    for (_, speed_rad_s) in said.iter().rev().take(LAST_SPEEDS) {
        gained.add(*speed_rad_s);
    }
    let gained_rad_s = gained.value()?;
    (intervals > 0.0).then(|| SetOff {
        torque_n_m: torque.sum / torque.count,
        // Each message stands for the time since the one before it.
        span_s: (last_s - first_s) * torque.count / intervals,
        gained_rad_s,
    })
}

fn seconds(stamp: Time) -> f64 {
    f64::from(stamp.sec) + 1.0e-9 * f64::from(stamp.nanosec)
}

/// How fast the places went ahead: the slope of the line through all of them.
fn speed_of(places: &[(f64, Position)]) -> Option<f64> {
    let (first_s, first) = places.first()?;
    let (sin, cos) = first.pose.heading_rad.sin_cos();
    let (mut span, mut way) = (Mean::default(), Mean::default());
    let points: Vec<(f64, f64)> = places
        .iter()
        .map(|(at_s, place)| {
            let ahead_m = cos * place.pose.x_m + sin * place.pose.y_m;
            (at_s - first_s, ahead_m)
        })
        .inspect(|(at_s, ahead_m)| {
            span.add(*at_s);
            way.add(*ahead_m);
        })
        .collect();
    let (middle_s, middle_m) = (span.value()?, way.value()?);
    let (mut squares, mut products) = (0.0, 0.0);
    for (at_s, ahead_m) in points {
        squares += (at_s - middle_s).powi(2);
        products += (at_s - middle_s) * (ahead_m - middle_m);
    }
    (squares > PLACES_SPREAD_MIN_S2).then(|| products / squares)
}

/// 1, -1, or 0 for a wheel that stands.
fn direction(said: f64, told: f64) -> i8 {
    if said.abs() < STANDING_SHARE * told.abs() {
        0
    } else if said > 0.0 {
        1
    } else {
        -1
    }
}

/// What was found.
pub(super) fn findings(
    settings: &Ros2Settings,
    model: &RobotModel,
    turned: &Drove,
    ahead: &Drove,
) -> Vec<Finding> {
    if !(turned.is_heard && ahead.is_heard) {
        return vec![Finding::wrong(
            "wheels",
            "drive.ros2.silent_after_ms",
            "the base fell silent whenever it was moved: its messages come with gaps, or its machine \
             is overloaded",
        )];
    }
    let (Some(turning), Some(going)) = (turned.wheels, ahead.wheels) else {
        return vec![Finding::wrong(
            "wheels",
            "drive.ros2.command.topic",
            "the wheels said nothing while they were told to move",
        )];
    };
    let of_turn = (
        direction(turning.left_rad_s, turned.told.left_rad_s),
        direction(turning.right_rad_s, turned.told.right_rad_s),
    );
    let of_ahead = (
        direction(going.left_rad_s, ahead.told.left_rad_s),
        direction(going.right_rad_s, ahead.told.right_rad_s),
    );
    let turn_rad_s = turned.turn_rad_s.unwrap_or(0.0);
    let sides = of_sides(of_turn, of_ahead, turn_rad_s);
    let is_well = sides.holds;
    let mut findings = vec![sides];
    if is_well {
        findings.push(of_base(settings, &going, ahead));
        findings.extend(of_radius(model, &going, ahead));
        findings.push(of_track(model, &turning, turn_rad_s));
        findings.extend(pulling::findings(settings, model, turned, ahead));
    }
    findings
}

/// Sides and signs, from the wheels' directions in a turn to the left and on the way ahead.
fn of_sides(of_turn: (i8, i8), of_ahead: (i8, i8), turn_rad_s: f64) -> Finding {
    let wrong = |key, text: &str| Finding::wrong("sides", key, text);
    let is_left = turn_rad_s > TURNING_RAD_S;
    let is_right = turn_rad_s < -TURNING_RAD_S;
    match (of_turn, of_ahead) {
        ((0, 0), (0, 0)) => wrong(
            "drive.ros2.command.topic",
            "the wheels stand though they are told to turn: nobody takes the command, or an \
             emergency stop is pressed",
        ),
        ((-1, 1), (1, 1)) if is_left => Finding::well(
            "sides",
            "wheels, gyro and command agree on left, right and ahead",
        ),
        ((-1, 1), (1, 1)) if is_right => wrong(
            "drive.ros2.imu.upside_down",
            "the gyro says that a turn to the left goes to the right",
        ),
        ((-1, 1), (1, 1)) => wrong(
            "drive.ros2.imu.topic",
            "the gyro says that the robot does not turn though its wheels do",
        ),
        ((1, -1), (1, 1)) if is_left => wrong(
            "drive.ros2.joints.left",
            "left and right joints are swapped: the robot turned to the left, and the joints say \
             to the right",
        ),
        ((1, -1), (1, 1)) => wrong(
            "drive.ros2.command.turn_sign",
            "the base takes a turn to the right for positive, or its sides are wired the wrong \
             way round",
        ),
        ((1, 1), (-1, 1)) => wrong(
            "drive.ros2.joints.left_sign",
            "the left joints say the opposite of what they do: that side is inverted",
        ),
        ((-1, -1), (1, -1)) => wrong(
            "drive.ros2.joints.right_sign",
            "the right joints say the opposite of what they do: that side is inverted",
        ),
        ((1, -1), (-1, -1)) => wrong(
            "drive.ros2.joints.left_sign",
            "both sides' joints say the opposite of what they do: give both signs, or look at \
             `command.ahead_sign`",
        ),
        ((-1, 1), (-1, -1)) => wrong(
            "drive.ros2.command.ahead_sign",
            "the base takes backwards for positive",
        ),
        _ => wrong(
            "drive.ros2.joints.left",
            "the wheels do not do what they are told, in no way that one sign would explain",
        ),
    }
}

/// Whether the base turns its wheels as fast as it was told.
fn of_base(settings: &Ros2Settings, said: &WheelSpeeds, ahead: &Drove) -> Finding {
    let told_rad_s = 0.5 * (ahead.told.left_rad_s + ahead.told.right_rad_s);
    let ratio = 0.5 * (said.left_rad_s + said.right_rad_s) / told_rad_s;
    if (ratio - 1.0).abs() <= RADIUS_SHARE {
        return Finding::well("command", "the wheels turn as fast as they are told");
    }
    let radius_m = settings.command.base_radius_m / ratio;
    let text = format!(
        "the wheels turn at {:.0} % of what they are told: the base reckons with a radius of about \
         {radius_m:.3} m (or the gear is another)",
        100.0 * ratio
    );
    Finding::wrong("command", "drive.ros2.command.wheel_radius_m", text)
}

/// The wheels' radius against the way over ground.
fn of_radius(model: &RobotModel, said: &WheelSpeeds, ahead: &Drove) -> Option<Finding> {
    let ground_m_s = ahead.ground_m_s?;
    let radius_m = 2.0 * ground_m_s / (said.left_rad_s + said.right_rad_s);
    let ratio = radius_m / model.wheel_radius_m();
    if (ratio - 1.0).abs() <= RADIUS_SHARE {
        let text = format!("the wheels roll as with a radius of {radius_m:.3} m");
        return Some(Finding::well("radius", text));
    }
    let text = format!(
        "the wheels roll as with a radius of {radius_m:.3} m, the model says {:.3} m",
        model.wheel_radius_m()
    );
    Some(Finding::wrong("radius", "model.wheel_radius_m", text))
}

/// The effective track, which is wider than the wheels' on every skid-steered robot.
fn of_track(model: &RobotModel, said: &WheelSpeeds, turn_rad_s: f64) -> Finding {
    let rim_m_s = model.wheel_radius_m() * (said.right_rad_s - said.left_rad_s);
    let track_m = rim_m_s / turn_rad_s;
    let ratio = track_m / model.track_width_m();
    if (0.9..=4.0).contains(&ratio) {
        let text =
            format!("the robot turns as with a track of {track_m:.2} m, {ratio:.2} of its own");
        return Finding::well("track", text);
    }
    let text = format!(
        "the robot turns as with a track of {track_m:.2} m, {ratio:.2} of the model's {:.2} m: no \
         skid-steered robot does",
        model.track_width_m()
    );
    Finding::wrong("track", "model.track_width_m", text)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_way_to_get_sides_and_signs_wrong_has_its_key() {
        let key = |of_turn, of_ahead, turn_rad_s| of_sides(of_turn, of_ahead, turn_rad_s).key;
        assert_eq!(key((-1, 1), (1, 1), 0.5), None);
        assert_eq!(key((1, -1), (1, 1), 0.5), Some("drive.ros2.joints.left"));
        assert_eq!(
            key((1, -1), (1, 1), -0.5),
            Some("drive.ros2.command.turn_sign")
        );
        assert_eq!(
            key((1, 1), (-1, 1), 0.5),
            Some("drive.ros2.joints.left_sign")
        );
        assert_eq!(
            key((-1, -1), (1, -1), 0.5),
            Some("drive.ros2.joints.right_sign")
        );
        assert_eq!(
            key((-1, 1), (1, 1), -0.5),
            Some("drive.ros2.imu.upside_down")
        );
        assert_eq!(
            key((-1, 1), (-1, -1), 0.5),
            Some("drive.ros2.command.ahead_sign")
        );
        assert_eq!(key((0, 0), (0, 0), 0.0), Some("drive.ros2.command.topic"));
    }

    #[test]
    fn a_speed_is_the_slope_of_all_places() {
        let at = |index: u32| {
            let at_s = 100.0 + 0.05 * f64::from(index);
            // Every other place is a centimetre off.
            let off_m = if index.is_multiple_of(2) { 0.01 } else { -0.01 };
            let pose = tread_control::geometry::Pose {
                x_m: 0.2 * at_s + off_m,
                ..Default::default()
            };
            (at_s, Position { pose, noise: None })
        };
        let places: Vec<_> = (0..40).map(at).collect();
        assert!((speed_of(&places).unwrap() - 0.2).abs() < 0.002);
        assert_eq!(speed_of(&places[..3]), None);
    }

    #[test]
    fn a_radius_is_told_from_the_way_over_ground() {
        let said = WheelSpeeds {
            left_rad_s: 2.5,
            right_rad_s: 2.5,
        };
        let model = RobotModel::yi2007();
        let drove = |ground_m_s| Drove {
            told: said,
            ground_m_s: Some(ground_m_s),
            ..Drove::default()
        };
        assert!(of_radius(&model, &said, &drove(0.2)).unwrap().holds);
        let wrong = of_radius(&model, &said, &drove(0.25)).unwrap();
        assert_eq!(wrong.key, Some("model.wheel_radius_m"));
        assert!(wrong.text.contains("0.100"), "{}", wrong.text);
    }
}
