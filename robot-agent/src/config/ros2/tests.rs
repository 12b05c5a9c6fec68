//! What a file makes of a robot, and what it refuses.

use super::*;
use crate::geometry::paper_robot;

fn checked(text: &str) -> Result<Ros2Settings, String> {
    let file: Ros2File = toml::from_str(text).map_err(|refused| refused.to_string())?;
    file.checked(&paper_robot())
        .map_err(|refused| refused.to_string())
}

#[test]
fn a_short_file_is_a_robot_by_its_odometry_alone() {
    let settings = checked("[odometry]\ngives_position = true\n").unwrap();
    assert_eq!(settings.bus.scheme, Scheme::RmwZenoh(Generation::Hashed));
    assert_eq!(settings.bus.endpoint, ENDPOINT_DEFAULT);
    assert_eq!(settings.command.topic.to_string(), "/cmd_vel");
    assert_eq!(settings.timing.silent_after, Duration::from_millis(100));
    assert!(settings.odometry.unwrap().site_from_odom.is_some());
}

/// The complete example of docs/ros2.md.
fn example() -> &'static str {
    let page = include_str!("../../../../docs/ros2.md");
    let (_, after) = page.split_once("<!-- complete example: begin -->").unwrap();
    let (example, _) = after.split_once("<!-- complete example: end -->").unwrap();
    let (_, text) = example.split_once("```toml\n").unwrap();
    text.trim_end().strip_suffix("```").unwrap()
}

fn of_example(text: &str) -> Result<Ros2Settings, String> {
    let whole: toml::Table = toml::from_str(text).map_err(|refused| refused.to_string())?;
    let file: Ros2File = whole["drive"]["ros2"].clone().try_into().unwrap();
    file.checked(&paper_robot())
        .map_err(|refused| refused.to_string())
}

#[test]
fn the_complete_example_says_every_default_as_it_is() {
    let sections = "[odometry]\n[imu]\n[pose]\n[battery]\n[joints]\n\
                    left = [\"front_left_wheel\", \"rear_left_wheel\"]\n\
                    right = [\"front_right_wheel\", \"rear_right_wheel\"]\n";
    assert_eq!(of_example(example()).unwrap(), checked(sections).unwrap());
    let with_current = example()
        .replace("effort = \"torque\"", "effort = \"current\"")
        .replace("# torque_constant_n_m_a", "torque_constant_n_m_a");
    let joints = of_example(&with_current).unwrap().joints.unwrap();
    assert_eq!(joints.effort, Effort::Current(0.05));
}

#[test]
fn the_complete_example_has_every_key() {
    let example = example().replace("\n# torque", "\ntorque");
    let whole: toml::Table = toml::from_str(&example).unwrap();
    let ros2 = whole["drive"]["ros2"].as_table().unwrap();
    let mut sections = vec![("", ros2)];
    let tables = ros2
        .iter()
        .filter_map(|(key, value)| Some((key.as_str(), value.as_table()?)));
    sections.extend(tables);
    assert_eq!(sections.len(), 8);
    for (section, table) in sections {
        // The parser lists all keys of the section in which it found one that it does not know.
        let head = if section.is_empty() {
            String::new()
        } else {
            format!("[{section}]\n")
        };
        let joints = if section == "joints" {
            "left = []\nright = []\n"
        } else {
            ""
        };
        let refused = checked(&format!("{head}{joints}unknown_key = 1\n")).unwrap_err();
        let (_, known) = refused.split_once("expected ").unwrap();
        let known: Vec<&str> = known.split('`').skip(1).step_by(2).collect();
        assert!(!known.is_empty(), "{refused}");
        for key in &known {
            assert!(
                table.contains_key(*key),
                "[drive.ros2.{section}] lacks `{key}`"
            );
        }
    }
}

#[test]
fn names_are_within_the_namespace_but_for_the_bridge() {
    let text = "namespace = \"/robot7\"\n[odometry]\n[command]\ntopic = \"/cmd\"\n";
    let settings = checked(text).unwrap();
    assert_eq!(settings.odometry.unwrap().topic.to_string(), "/robot7/odom");
    assert_eq!(settings.command.topic.to_string(), "/cmd");
    let settings = checked(&format!("bus = \"ros2dds\"\n{text}")).unwrap();
    assert_eq!(settings.odometry.unwrap().topic.to_string(), "/odom");
}

#[test]
fn what_cannot_be_is_named_by_its_key() {
    let joints = "[joints]\nleft = [\"l\"]\nright = [\"r\"]\n";
    for (text, key) in [
        (String::new(), "wheels' speeds"),
        ("[imu]\n".to_owned(), "wheels' speeds"),
        (joints.to_owned(), "turn rate"),
        (
            "[odometry]\nmotion_of = \"ground\"\n".to_owned(),
            "wheels' speeds",
        ),
        (
            "endpoint = \"tcp/192.0.2.1:7447\"\n[odometry]\n".to_owned(),
            "endpoint",
        ),
        (
            "silent_after_ms = 500\n[odometry]\n".to_owned(),
            "silent_after_ms",
        ),
        ("domain = 233\n[odometry]\n".to_owned(), "domain"),
        ("[odometry]\ntopic = \"a b\"\n".to_owned(), "odometry.topic"),
        (
            "[odometry]\n[command]\nkind = \"joint_speeds\"\n".to_owned(),
            "command.kind",
        ),
        (
            "[odometry]\n[command]\nturn_sign = 2\n".to_owned(),
            "turn_sign",
        ),
        (
            "[odometry]\ngives_position = true\n[pose]\n".to_owned(),
            "gives_position",
        ),
        (
            "[odometry]\n[pose]\nsite_x_m = nan\n".to_owned(),
            "pose.site_x_m",
        ),
        (
            format!("[odometry]\n{joints}effort = \"current\"\n"),
            "torque_constant",
        ),
        (
            format!("[odometry]\n{joints}gear_ratio = 0.0\n"),
            "gear_ratio",
        ),
        (
            "[odometry]\n[joints]\nleft = [\"l\"]\nright = [\"l\"]\n".to_owned(),
            "both sides",
        ),
        ("[odometry]\nspeed = 1\n".to_owned(), "speed"),
    ] {
        let refused = checked(&text).map(|_| ()).unwrap_err();
        assert!(refused.contains(key), "`{key}` is missing in: {refused}");
    }
}
