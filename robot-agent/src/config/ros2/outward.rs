//! Checks `[drive.ros2.outward]`: the topics on which the agent publishes its state.

use tread_control::geometry::Pose;

use super::file::OutwardFile;
use super::{Key, TopicSetting, Topics, refused};
use crate::config::ConfigError;
use crate::drive::ros2::published_topics::PublishedTopic;
use crate::drive::ros2::settings::{OutwardSettings, Ros2Settings};

/// Returns the frame of the topic that gives the position, and its pose in the site.
fn frame(read: &Ros2Settings) -> Option<(String, Pose)> {
    if let Some(pose) = &read.pose {
        return Some((pose.frame.clone(), pose.site_from_map));
    }
    let odometry = read.odometry.as_ref()?;
    Some((odometry.frame.clone(), odometry.site_from_odom?))
}

impl OutwardFile {
    /// Checks the topics against all that are read or commanded; `None` if switched off.
    pub(super) fn checked(
        &self,
        topics: &Topics,
        others: &Ros2Settings,
    ) -> Result<Option<OutwardSettings>, ConfigError> {
        if self.enabled == Some(false) {
            return Ok(None);
        }
        // Without a source of positions both paths stay empty.
        let (frame, site_from_frame) = frame(others).unwrap_or_default();
        let name = |topic, given: &Option<String>, default| {
            let setting = TopicSetting {
                key: key(topic),
                default,
            };
            topics.name(&setting, given.as_deref())
        };
        let settings = OutwardSettings {
            plan: name(PublishedTopic::Plan, &self.plan, "tread/plan")?,
            driven: name(PublishedTopic::Driven, &self.driven, "tread/driven")?,
            theta: name(PublishedTopic::Theta, &self.theta, "tread/theta")?,
            diagnostics: name(
                PublishedTopic::Diagnostics,
                &self.diagnostics,
                "/diagnostics",
            )?,
            frame,
            site_from_frame,
        };
        // A base commanded by lists of numbers would execute θ as a command.
        let mut taken = others.topics();
        for topic in PublishedTopic::ALL {
            let name = topic.topic(&settings);
            if taken.contains(&name) {
                return Err(refused(
                    Key(key(topic)),
                    format!("`{name}` is used already"),
                ));
            }
            taken.push(name);
        }
        Ok(Some(settings))
    }
}

fn key(topic: PublishedTopic) -> &'static str {
    match topic {
        PublishedTopic::Plan => "drive.ros2.outward.plan",
        PublishedTopic::Driven => "drive.ros2.outward.driven",
        PublishedTopic::Theta => "drive.ros2.outward.theta",
        PublishedTopic::Diagnostics => "drive.ros2.outward.diagnostics",
    }
}

#[cfg(test)]
mod tests {
    use super::super::Ros2File;
    use super::*;
    use crate::geometry::paper_robot;

    fn checked(text: &str) -> Result<Option<OutwardSettings>, String> {
        let file: Ros2File = toml::from_str(text).map_err(|refused| refused.to_string())?;
        let checked = file.checked(&paper_robot());
        checked
            .map(|settings| settings.outward)
            .map_err(|refused| refused.to_string())
    }

    #[test]
    fn it_speaks_unless_it_is_switched_off() {
        let text = "namespace = \"/robot7\"\n[odometry]\ngives_position = true\nsite_x_m = 2.0\n";
        let settings = checked(text).unwrap().unwrap();
        let names = PublishedTopic::ALL.map(|topic| topic.topic(&settings).to_string());
        let expected = [
            "/robot7/tread/plan",
            "/robot7/tread/driven",
            "/robot7/tread/theta",
            "/diagnostics",
        ];
        assert_eq!(names, expected);
        assert_eq!(settings.frame, "odom");
        assert!((settings.site_from_frame.x_m - 2.0).abs() < f64::EPSILON);
        let off = format!("{text}[outward]\nenabled = false\n");
        assert_eq!(checked(&off).unwrap(), None);
    }

    #[test]
    fn both_ways_are_in_the_frame_of_the_pose_where_there_is_one() {
        let text = "[odometry]\n[pose]\nframe = \"hall\"\nsite_heading_rad = 0.5\n";
        let settings = checked(text).unwrap().unwrap();
        assert_eq!(settings.frame, "hall");
        assert!((settings.site_from_frame.heading_rad - 0.5).abs() < f64::EPSILON);
    }

    #[test]
    fn a_topic_that_is_used_already_is_refused_by_its_key() {
        for (outward, key) in [
            ("theta = \"cmd_vel\"", "outward.theta"),
            ("plan = \"odom\"", "outward.plan"),
            ("driven = \"tread/plan\"", "outward.driven"),
            ("diagnostics = \"a b\"", "outward.diagnostics"),
            ("speed = \"a\"", "speed"),
        ] {
            let refused = checked(&format!("[odometry]\n[outward]\n{outward}\n")).unwrap_err();
            assert!(refused.contains(key), "`{key}` is missing in: {refused}");
        }
    }
}
