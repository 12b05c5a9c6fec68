//! Examines the messages of a stopped robot: topics, types, rates, gaps, delays, frames, effort.

use std::time::Duration;

use tread_ros2::cdr::decode;
use tread_ros2::messages::JointState;
use tread_ros2::rmw::{KeyMismatch, check_key};

use super::finding::{Finding, Key};
use super::joint_names::JointNames;
use super::message_buffer::Message;
use crate::drive::ros2::frames;
use crate::drive::ros2::reading::Content;
use crate::drive::ros2::refusal::{Refusal, Source};
use crate::drive::ros2::settings::{Effort, Ros2Settings, Scheme, StampClock};
use crate::drive::ros2::topic_receiver::{decoded, topic_of, type_of};

/// Smallest rate of the messages of wheels and inertial unit, Hz.
const RATE_MIN_HZ: f64 = 20.0;
/// Largest age of a message of the base at its arrival, milliseconds.
const AGE_MAX_MS: f64 = 50.0;
/// Age from which a stamp is assumed to be of another clock, milliseconds.
const CLOCK_MIN_MS: f64 = 2_000.0;
/// Largest fraction of invalid messages.
const BAD_SHARE_MAX: f64 = 0.02;
/// Largest fraction of repeated messages.
const REPEATED_SHARE_MAX: f64 = 0.02;
/// Number of previous messages among which a repetition is searched.
const REPEATED_AMONG: usize = 32;
/// Number of messages after which a stamp that never changed counts as constant.
const STANDING_STAMPS_MIN: usize = 5;
/// Largest mean yaw rate of the gyro of a stopped robot, rad/s.
const GYRO_BIAS_MAX_RAD_S: f64 = 0.01;
/// Speed up to which a wheel counts as stopped, rad/s.
const WHEEL_STANDING_RAD_S: f64 = 0.1;

/// Returns the finding's name and the key of a source's section.
fn names(source: Source) -> (&'static str, Key) {
    match source {
        Source::Odometry => ("odometry", Key("drive.ros2.odometry.topic")),
        Source::Imu => ("imu", Key("drive.ros2.imu.topic")),
        Source::Joints => ("joints", Key("drive.ros2.joints.topic")),
        Source::Pose => ("pose", Key("drive.ros2.pose.topic")),
        Source::Battery => ("battery", Key("drive.ros2.battery.topic")),
    }
}

/// Whether driving needs a high rate of this source.
fn is_fast(settings: &Ros2Settings, source: Source) -> bool {
    match source {
        Source::Joints | Source::Imu => true,
        Source::Odometry => settings.joints.is_none(),
        Source::Pose | Source::Battery => false,
    }
}

/// Returns the findings for each topic.
pub(super) fn findings(
    settings: &Ros2Settings,
    messages: &[Message],
    span: Duration,
) -> Vec<Finding> {
    let mut findings = Vec::new();
    for source in Source::ALL {
        let Some(topic) = topic_of(settings, source) else {
            continue;
        };
        let of_source: Vec<&Message> = messages
            .iter()
            .filter(|message| message.source == source)
            .collect();
        if of_source.is_empty() {
            // A battery may publish too seldom to be received.
            if source != Source::Battery {
                let (name, topic_key) = names(source);
                let text = format!("nothing was heard on `{topic}`");
                findings.push(Finding::on(name).wrong(topic_key, text));
            }
            continue;
        }
        if source == Source::Joints {
            findings.extend(of_joints(settings, &of_source, span));
        } else {
            findings.push(of_topic(settings, source, &of_source, span));
        }
    }
    findings.extend(of_gyro_at_rest(settings, messages));
    findings
}

/// Returns the findings on the joints. The topic may also contain joints of other devices.
fn of_joints(settings: &Ros2Settings, messages: &[&Message], span: Duration) -> Vec<Finding> {
    let Some(joints) = &settings.joints else {
        return Vec::new();
    };
    if let Some(finding) = of_keys(settings, Source::Joints, messages) {
        return vec![finding];
    }
    let mut names = JointNames::default();
    for message in messages {
        if let Ok(read) = decode::<JointState<'_>>(&message.payload) {
            names.add(read.name.iter());
        }
    }
    if let Some(finding) = names.finding(joints) {
        return vec![finding];
    }
    let is_of_others = |message: &&&Message| {
        matches!(
            decoded(settings, Source::Joints, &message.payload),
            Ok(None)
        )
    };
    let own: Vec<&Message> = messages
        .iter()
        .filter(|it| !is_of_others(it))
        .copied()
        .collect();
    let mut finding = of_topic(settings, Source::Joints, &own, span);
    finding.text = format!("{}; it names {}", finding.text, names.text());
    let is_well = finding.holds;
    let effort = effort(settings, &own).filter(|_| is_well);
    std::iter::once(finding).chain(effort).collect()
}

/// Returns the mean turn rate of the gyro while the wheels are stopped, rad/s; `None` if they are
/// not stopped or the rate is not measured.
pub(super) fn gyro_at_rest_rad_s(settings: &Ros2Settings, messages: &[Message]) -> Option<f64> {
    let (mut sum, mut count) = (0.0, 0.0);
    for message in messages {
        let Ok(Some((_, content))) = decoded(settings, message.source, &message.payload) else {
            continue;
        };
        match content {
            Content::Inertial(inertial) => {
                sum += inertial.yaw_rate_rad_s;
                count += 1.0;
            }
            Content::Wheels(wheels) => {
                if wheels.speeds.magnitude_max_rad_s() > WHEEL_STANDING_RAD_S {
                    return None;
                }
            }
            Content::Motion(_) | Content::Position(_) | Content::Battery(_) => {}
        }
    }
    (count > 0.0).then(|| sum / count)
}

fn of_gyro_at_rest(settings: &Ros2Settings, messages: &[Message]) -> Option<Finding> {
    let bias_rad_s = gyro_at_rest_rad_s(settings, messages)?;
    let degrees = bias_rad_s.to_degrees();
    if bias_rad_s.abs() <= GYRO_BIAS_MAX_RAD_S {
        let text = format!("the gyro says {bias_rad_s:.4} rad/s ({degrees:.2} °/s) at rest");
        return Some(Finding::on("gyro").ok(text));
    }
    let text = format!(
        "the gyro says {bias_rad_s:.4} rad/s ({degrees:.2} °/s) while the robot stands, at most \
         {GYRO_BIAS_MAX_RAD_S} rad/s is good: it has a bias. Let its driver calibrate it at rest; no key of \
         robot.toml can"
    );
    Some(Finding::on("gyro").wrong(Key("drive.ros2.imu.topic"), text))
}

/// Returns a finding if several nodes publish on a topic or if messages are repeated.
fn of_writers(source: Source, messages: &[&Message]) -> Option<Finding> {
    let (name, topic_key) = names(source);
    let mut writers = Vec::new();
    for attachment in messages.iter().filter_map(|message| message.attachment) {
        if !writers.contains(&attachment.gid) {
            writers.push(attachment.gid);
        }
    }
    if writers.len() > 1 {
        let text = format!(
            "{} nodes write on it, and the agent hears only one: stop the others, or give each its own topic",
            writers.len()
        );
        return Some(Finding::on(name).wrong(topic_key, text));
    }
    let is_repeated = |index: &usize| {
        let message = messages[*index];
        let before = &messages[index.saturating_sub(REPEATED_AMONG)..*index];
        before
            .iter()
            .any(|other| other.attachment == message.attachment && other.payload == message.payload)
    };
    let repeated = (0..messages.len()).filter(is_repeated).count();
    let share = figure(repeated) / figure(messages.len()).max(1.0);
    if share > REPEATED_SHARE_MAX {
        let text = format!(
            "{:.0} % of its messages come again: two paths lead here, such as two bridges, or a bridge and a \
             router",
            100.0 * share
        );
        return Some(Finding::on(name).wrong(topic_key, text));
    }
    None
}

fn figure(count: usize) -> f64 {
    f64::from(u32::try_from(count).unwrap_or(u32::MAX))
}

/// Returns a finding if the stamps of the messages never change.
fn of_stamps(settings: &Ros2Settings, source: Source, messages: &[&Message]) -> Option<Finding> {
    let stamp = |message: &&Message| {
        let read = decoded(settings, source, &message.payload).ok()??;
        read.0.nanoseconds()
    };
    let stamps: Vec<i64> = messages.iter().filter_map(stamp).collect();
    let first = stamps.first()?;
    let stands = stamps.len() >= STANDING_STAMPS_MIN && stamps.iter().all(|it| it == first);
    let (name, topic_key) = names(source);
    stands.then(|| {
        let text =
            "its time stamp stands still: what writes it says the same message again and again";
        Finding::on(name).wrong(topic_key, text)
    })
}

fn of_topic(
    settings: &Ros2Settings,
    source: Source,
    messages: &[&Message],
    span: Duration,
) -> Finding {
    let (name, topic_key) = names(source);
    if let Some(finding) = of_keys(settings, source, messages) {
        return finding;
    }
    let count = figure(messages.len());
    let mut bad = 0.0;
    let mut worst = None;
    for message in messages {
        if let Err(refusal) = decoded(settings, source, &message.payload) {
            bad += 1.0;
            worst = Some((refusal, *message));
        }
    }
    if let Some((refusal, message)) = worst.filter(|_| bad > BAD_SHARE_MAX * count) {
        return of_refusal(settings, source, (refusal, message), bad / count);
    }
    let finding = of_writers(source, messages);
    if let Some(finding) = finding.or_else(|| of_stamps(settings, source, messages)) {
        return finding;
    }
    let rate_hz = count / span.as_secs_f64();
    if is_fast(settings, source) && rate_hz < RATE_MIN_HZ {
        let text = format!("only {rate_hz:.1} messages a second: {RATE_MIN_HZ} are needed");
        return Finding::on(name).wrong(topic_key, text);
    }
    let mut ages_ms: Vec<f64> = messages
        .iter()
        .filter_map(|message| age_ms(settings, source, message))
        .collect();
    ages_ms.sort_by(f64::total_cmp);
    let at = |share: usize| ages_ms.get(ages_ms.len() * share / 100).copied();
    let (middle_ms, late_ms) = (at(50).unwrap_or(0.0), at(99).unwrap_or(0.0));
    let bound_ms = if source == Source::Pose {
        1.0e3 * settings.timing.pose_late_after.as_secs_f64()
    } else {
        AGE_MAX_MS
    };
    if source != Source::Battery && !(-5.0..=bound_ms).contains(&middle_ms) {
        let text = format!(
            "its messages are {middle_ms:.0} ms old when they come, at most {bound_ms:.0} ms is \
             good: what writes them is slow, or stamps them by another clock (then `stamps = \
             \"base\"`)"
        );
        let finding = Finding::on(name).wrong(Key("drive.ros2.stamps"), text);
        let other = match settings.timing.stamps {
            StampClock::Host => "\"base\"",
            StampClock::Base => "\"host\"",
        };
        // A moderate difference is a delay, a large one means another clock.
        return if middle_ms.abs() > CLOCK_MIN_MS {
            finding.with_line(Key("drive.ros2.stamps"), other)
        } else {
            finding
        };
    }
    let gaps = messages.windows(2).map(|pair| {
        let gap = pair[1]
            .arrival
            .monotonic
            .saturating_sub(pair[0].arrival.monotonic);
        1.0e3 * gap.as_secs_f64()
    });
    let gap_ms = gaps.fold(0.0, f64::max);
    Finding::on(name).ok(format!(
        "{rate_hz:.1} Hz, {middle_ms:.1} ms old when they come (the 99th of 100 {late_ms:.1} \
             ms), longest gap {gap_ms:.0} ms"
    ))
}

fn of_keys(settings: &Ros2Settings, source: Source, messages: &[&Message]) -> Option<Finding> {
    let (name, topic_key) = names(source);
    let Scheme::RmwZenoh(generation) = settings.bus.scheme else {
        return None;
    };
    let message = messages.first()?;
    match check_key(&message.key, &type_of(source), generation) {
        Err(KeyMismatch::Type) => {
            let text = format!("another type is written on it: `{}`", message.key);
            Some(Finding::on(name).wrong(topic_key, text))
        }
        Err(KeyMismatch::Hash) => {
            let text = format!("its type is defined otherwise: `{}`", message.key);
            Some(Finding::on(name).wrong(Key("drive.ros2.distribution"), text))
        }
        Ok(()) if message.attachment.is_none() => {
            let text = "its messages have no attachment: they are not written by rmw_zenoh_cpp";
            Some(Finding::on(name).wrong(Key("drive.ros2.bus"), text))
        }
        Ok(()) => None,
    }
}

fn of_refusal(
    settings: &Ros2Settings,
    source: Source,
    (refusal, message): (Refusal, &Message),
    share: f64,
) -> Finding {
    let (name, topic_key) = names(source);
    let percent = 100.0 * share;
    if refusal == Refusal::WrongFrame {
        let frames = frames::named(settings, source, &message.payload).unwrap_or_default();
        let key = frames.first().map_or(topic_key, |frame| Key(frame.key));
        let text = match frames::others(&frames) {
            Some(others) => format!("its messages have the {others}"),
            None => "its messages are of another frame".to_owned(),
        };
        let finding = Finding::on(name).wrong(key, text);
        return frames.into_iter().fold(finding, |finding, frame| {
            finding.with_line(Key(frame.key), format!("{:?}", frame.received))
        });
    }
    let key = if refusal == Refusal::Joints {
        Key("drive.ros2.joints.left")
    } else {
        topic_key
    };
    let text = format!("{percent:.0} % of it are {}", refusal.text());
    Finding::on(name).wrong(key, text)
}

fn age_ms(settings: &Ros2Settings, source: Source, message: &Message) -> Option<f64> {
    let (stamp, _) = decoded(settings, source, &message.payload).ok()??;
    let behind = message.arrival.wall_ns.saturating_sub(stamp.nanoseconds()?);
    #[expect(clippy::cast_precision_loss, reason = "an age for people")]
    let milliseconds = behind as f64 * 1.0e-6;
    Some(milliseconds)
}

fn effort(settings: &Ros2Settings, messages: &[&Message]) -> Option<Finding> {
    let joints = settings.joints.as_ref()?;
    if joints.effort == Effort::None {
        return None;
    }
    let says_torque = |message: &&&Message| {
        let read = decoded(settings, Source::Joints, &message.payload);
        matches!(read, Ok(Some((_, Content::Wheels(wheels)))) if wheels.torques.is_some())
    };
    let is_zero = |message: &&Message| {
        let read: Result<JointState<'_>, _> = decode(&message.payload);
        read.is_ok_and(|read| read.effort.iter().all(|effort| effort == 0.0))
    };
    if messages.iter().filter(says_torque).count() * 2 < messages.len() {
        return Some(Finding::on("effort").wrong(Key("drive.ros2.joints.effort"),
            "the joints say no effort: friction shows in acceleration and turns alone (`effort = \
             \"none\"` says so)",
        )
        .with_line(Key("drive.ros2.joints.effort"), "\"none\""));
    }
    if messages.iter().all(is_zero) {
        let text =
            "the joints' effort is zero at rest: whether it is measured shows in motion (`--move`)";
        return Some(Finding::on("effort").skipped(text));
    }
    Some(Finding::on("effort").ok("the joints say how they pull"))
}
