//! Frames that a message names, beside the configured ones.

use tread_api::text::cleaned;
use tread_ros2::cdr::decode;
use tread_ros2::messages::{Imu, Odometry, PoseWithCovarianceStamped};

use super::reading::bare;
use super::refusal::Source;
use super::settings::Ros2Settings;

/// Maximum length of a frame's name in a text for people, characters; the rest is cut off.
const NAME_SHOWN_MAX: usize = 40;

/// A frame that a message names.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NamedFrame {
    /// Which of the message's frames, for people.
    pub kind: &'static str,
    /// Its key in `robot.toml`, with the tables.
    pub key: &'static str,
    /// Its name in the message.
    pub received: String,
    /// Its name in the configuration.
    pub configured: String,
}

impl NamedFrame {
    fn is_other(&self) -> bool {
        bare(&self.received) != self.configured
    }

    fn text(&self) -> String {
        let received = match cleaned(&self.received, NAME_SHOWN_MAX) {
            name if name.is_empty() => "without a name".to_owned(),
            name => format!("`{name}`"),
        };
        let configured = cleaned(&self.configured, NAME_SHOWN_MAX);
        format!("{} {received} instead of `{configured}`", self.kind)
    }
}

/// Returns the frames of a topic's message; `None` if it cannot be read, or if its frames are not
/// compared.
pub fn named(settings: &Ros2Settings, source: Source, payload: &[u8]) -> Option<Vec<NamedFrame>> {
    let frame = |key, received: &str, configured: &str| NamedFrame {
        kind: "frame",
        key,
        received: received.to_owned(),
        configured: configured.to_owned(),
    };
    match source {
        Source::Odometry => {
            let configured = settings.odometry.as_ref()?;
            let read: Odometry<'_> = decode(payload).ok()?;
            let key = "drive.ros2.odometry.frame";
            let child_key = "drive.ros2.odometry.child_frame";
            Some(vec![
                frame(key, read.header.frame_id, &configured.frame),
                NamedFrame {
                    kind: "child frame",
                    ..frame(child_key, read.child_frame_id, &configured.child_frame)
                },
            ])
        }
        Source::Imu => {
            let configured = settings.imu.as_ref()?;
            let read: Imu<'_> = decode(payload).ok()?;
            let key = "drive.ros2.imu.frame";
            Some(vec![frame(key, read.header.frame_id, &configured.frame)])
        }
        Source::Pose => {
            let configured = settings.pose.as_ref()?;
            let read: PoseWithCovarianceStamped<'_> = decode(payload).ok()?;
            let key = "drive.ros2.pose.frame";
            Some(vec![frame(key, read.header.frame_id, &configured.frame)])
        }
        Source::Joints | Source::Battery => None,
    }
}

/// Returns which of these frames are not the configured ones, for people; `None` if all are.
pub fn others(frames: &[NamedFrame]) -> Option<String> {
    let others = frames.iter().filter(|frame| frame.is_other());
    let texts: Vec<String> = others.map(NamedFrame::text).collect();
    (!texts.is_empty()).then(|| texts.join(" and "))
}

#[cfg(test)]
mod tests {
    use tread_ros2::cdr::encode;
    use tread_ros2::messages::Header;

    use super::super::settings::{MotionOf, OdometrySettings};
    use super::super::tests::{settings, topic};
    use super::*;

    #[test]
    fn each_frame_that_is_not_the_configured_one_is_named_with_that() {
        let configured = Ros2Settings {
            odometry: Some(OdometrySettings {
                topic: topic("odom"),
                frame: "odom".to_owned(),
                child_frame: "base_link".to_owned(),
                motion_of: MotionOf::Wheels,
                site_from_odom: None,
            }),
            ..settings()
        };
        let said = |frame_id: &str, child_frame_id: &str| {
            let message = Odometry {
                header: Header {
                    frame_id,
                    ..Header::default()
                },
                child_frame_id,
                ..Odometry::default()
            };
            let mut bytes = Vec::new();
            encode(&message, &mut bytes);
            others(&named(&configured, Source::Odometry, &bytes).unwrap())
        };
        assert_eq!(said("/odom", "base_link"), None, "as tf1 wrote it");
        assert_eq!(
            said("odom", "base_footprint").unwrap(),
            "child frame `base_footprint` instead of `base_link`"
        );
        assert_eq!(
            said("", "base\nlink").unwrap(),
            "frame without a name instead of `odom` and child frame `base link` instead of `base_link`"
        );
        let long = said(&"m".repeat(500), "base_link").unwrap();
        assert!(long.len() < 100, "{long}");
        assert_eq!(named(&configured, Source::Joints, &[]), None);
        assert_eq!(named(&configured, Source::Imu, &[1, 2]), None);
    }
}
