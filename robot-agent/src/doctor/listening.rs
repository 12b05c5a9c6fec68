//! What a standing robot's messages say: topics, types, rates, gaps, delays, frames, effort.

use std::time::Duration;

use tread_ros2::cdr::decode;
use tread_ros2::messages::{Imu, JointState, Odometry, PoseWithCovarianceStamped};
use tread_ros2::rmw::{KeyMismatch, check_key};

use super::Finding;
use super::heard::Message;
use crate::drive::ros2::inlet::{decoded, topic_of, type_of};
use crate::drive::ros2::reading::Content;
use crate::drive::ros2::refusal::{Refusal, Source};
use crate::drive::ros2::settings::{Effort, Ros2Settings, Scheme};

/// Slowest messages of wheels and inertial unit, Hz.
const RATE_MIN_HZ: f64 = 20.0;
/// Oldest that a message of the base may be when it comes, milliseconds.
const AGE_MAX_MS: f64 = 50.0;
/// Share of messages that may be bad.
const BAD_SHARE_MAX: f64 = 0.02;

/// The finding's name and the key of a source's section.
fn names(source: Source) -> (&'static str, &'static str) {
    match source {
        Source::Odometry => ("odometry", "drive.ros2.odometry.topic"),
        Source::Imu => ("imu", "drive.ros2.imu.topic"),
        Source::Joints => ("joints", "drive.ros2.joints.topic"),
        Source::Pose => ("pose", "drive.ros2.pose.topic"),
        Source::Battery => ("battery", "drive.ros2.battery.topic"),
    }
}

/// Whether the base cannot be driven without it at a good rate.
fn is_fast(settings: &Ros2Settings, source: Source) -> bool {
    match source {
        Source::Joints | Source::Imu => true,
        Source::Odometry => settings.joints.is_none(),
        Source::Pose | Source::Battery => false,
    }
}

/// What was found, topic by topic.
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
            // A battery may speak so seldom that it was not heard.
            if source != Source::Battery {
                let (name, key) = names(source);
                let text = format!("nothing was heard on `{topic}`");
                findings.push(Finding::wrong(name, key, text));
            }
            continue;
        }
        findings.push(of_topic(settings, source, &of_source, span));
        if source == Source::Joints {
            findings.extend(effort(settings, &of_source));
        }
    }
    findings
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
    let count = f64::from(u32::try_from(messages.len()).unwrap_or(u32::MAX));
    let mut bad = 0.0;
    let mut worst = None;
    for message in messages {
        if let Err(refusal) = decoded(settings, source, &message.payload) {
            bad += 1.0;
            worst = Some((refusal, *message));
        }
    }
    if let Some((refusal, message)) = worst.filter(|_| bad > BAD_SHARE_MAX * count) {
        return of_refusal(source, refusal, message, bad / count);
    }
    let rate_hz = count / span.as_secs_f64();
    if is_fast(settings, source) && rate_hz < RATE_MIN_HZ {
        let text = format!("only {rate_hz:.1} messages a second: {RATE_MIN_HZ} are needed");
        return Finding::wrong(name, topic_key, text);
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
        return Finding::wrong(name, "drive.ros2.stamps", text);
    }
    let gaps = messages.windows(2).map(|pair| {
        let gap = pair[1]
            .arrival
            .monotonic
            .saturating_sub(pair[0].arrival.monotonic);
        1.0e3 * gap.as_secs_f64()
    });
    let gap_ms = gaps.fold(0.0, f64::max);
    Finding::well(
        name,
        format!(
            "{rate_hz:.1} Hz, {middle_ms:.1} ms old when they come (the 99th of 100 {late_ms:.1} \
             ms), longest gap {gap_ms:.0} ms"
        ),
    )
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
            Some(Finding::wrong(name, topic_key, text))
        }
        Err(KeyMismatch::Hash) => {
            let text = format!("its type is defined otherwise: `{}`", message.key);
            Some(Finding::wrong(name, "drive.ros2.distribution", text))
        }
        Ok(()) if !message.has_attachment => {
            let text = "its messages have no attachment: they are not written by rmw_zenoh_cpp";
            Some(Finding::wrong(name, "drive.ros2.bus", text))
        }
        Ok(()) => None,
    }
}

fn of_refusal(source: Source, refusal: Refusal, message: &Message, share: f64) -> Finding {
    let (name, topic_key) = names(source);
    let percent = 100.0 * share;
    if refusal == Refusal::WrongFrame {
        let key = match source {
            Source::Odometry => "drive.ros2.odometry.frame",
            Source::Imu => "drive.ros2.imu.frame",
            Source::Joints | Source::Pose | Source::Battery => "drive.ros2.pose.frame",
        };
        let frames = frames_of(source, &message.payload).unwrap_or_default();
        let text = format!("it is of the frame {frames}, which the configuration does not name");
        return Finding::wrong(name, key, text);
    }
    let key = if refusal == Refusal::Joints {
        "drive.ros2.joints.left"
    } else {
        topic_key
    };
    let text = format!("{percent:.0} % of it are {}", refusal.text());
    Finding::wrong(name, key, text)
}

fn frames_of(source: Source, payload: &[u8]) -> Option<String> {
    match source {
        Source::Odometry => {
            let read: Odometry<'_> = decode(payload).ok()?;
            Some(format!(
                "`{}` and `{}`",
                read.header.frame_id, read.child_frame_id
            ))
        }
        Source::Imu => {
            let read: Imu<'_> = decode(payload).ok()?;
            Some(format!("`{}`", read.header.frame_id))
        }
        Source::Pose => {
            let read: PoseWithCovarianceStamped<'_> = decode(payload).ok()?;
            Some(format!("`{}`", read.header.frame_id))
        }
        Source::Joints | Source::Battery => None,
    }
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
        return Some(Finding::wrong(
            "effort",
            "drive.ros2.joints.effort",
            "the joints say no effort: friction shows in acceleration and turns alone (`effort = \
             \"none\"` says so)",
        ));
    }
    if messages.iter().all(is_zero) {
        let text = "the joints' effort is always zero: it is not measured (`effort = \"none\"`)";
        return Some(Finding::wrong("effort", "drive.ros2.joints.effort", text));
    }
    Some(Finding::well("effort", "the joints say how they pull"))
}
