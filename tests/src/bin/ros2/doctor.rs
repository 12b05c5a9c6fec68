//! `tread-agent doctor` on robots of which it is known what is wrong.

use std::path::Path;
use std::process::Command;

use anyhow::Context;
use futures_util::{StreamExt as _, TryStreamExt as _, stream};
use serde_json::Value;

use crate::python_robot::{Configuration, PythonRobot};
use tread_tests::report::Check;

/// Robots that are examined at once; each stands still or drives slowly most of the time.
const AT_ONCE: usize = 2;

/// A planted fault, and how it must be named.
#[derive(Clone, Copy)]
struct PlantedFault {
    name: &'static str,
    flags: &'static [&'static str],
    /// A fault that is switched on, and its value.
    switched: Option<(&'static str, &'static str)>,
    configuration: Configuration,
    /// Whether the robot is moved; some faults are heard at rest.
    moves: bool,
    /// The key of `robot.toml` by which it must be named, and no other.
    key: Option<&'static str>,
    /// Words that the finding must say.
    says: &'static str,
    /// Lines of `robot.toml` that it must print.
    lines: &'static [&'static str],
}

const HEALTHY: PlantedFault = PlantedFault {
    name: "healthy",
    flags: &[],
    switched: None,
    configuration: Configuration::PLAIN,
    moves: true,
    key: None,
    says: "",
    lines: &[],
};

const fn switched(
    name: &'static str,
    fault: (&'static str, &'static str),
    key: &'static str,
) -> PlantedFault {
    PlantedFault {
        name,
        switched: Some(fault),
        key: Some(key),
        ..HEALTHY
    }
}

/// The distance over ground is of the odometry alone.
const WITHOUT_POSE: Configuration = Configuration {
    pose: "",
    ..Configuration::PLAIN
};

const BRIDGED: Configuration = Configuration {
    bus: "ros2dds",
    ..Configuration::PLAIN
};

/// The robot's model but for its track, which is 0.43 m.
const WIDE_MODEL: &str = "[model]\nname = \"yi2007\"\ntyres = \"standard\"\nmass_kg = 5.0\n\
    track_width_m = 0.63\nwheelbase_m = 0.28\nwheel_radius_m = 0.08\nyaw_inertia_kg_m2 = 0.45\n\
    [model.limits]\nlinear_max_m_s = 1.0\nangular_max_rad_s = 2.0\n\
    linear_acceleration_max_m_s2 = 0.8\nlateral_acceleration_max_m_s2 = 1.0\n\
    linear_jerk_max_m_s3 = 4.0\nwheel_speed_max_rad_s = 20.0\n\
    wheel_acceleration_max_rad_s2 = 60.0\n";

const ROBOTS: [PlantedFault; 25] = [
    HEALTHY,
    PlantedFault {
        name: "healthy behind a bridge",
        flags: &["--scheme=ros2dds"],
        configuration: BRIDGED,
        moves: false,
        ..HEALTHY
    },
    PlantedFault {
        says: "are swapped",
        lines: &["left = [\"front_right_wheel\", \"rear_right_wheel\"]"],
        ..switched("swapped sides", ("swapped", "on"), "drive.ros2.joints.left")
    },
    PlantedFault {
        lines: &["left_sign = -1"],
        ..switched(
            "one side inverted",
            ("inverted", "on"),
            "drive.ros2.joints.left_sign",
        )
    },
    PlantedFault {
        says: "the base takes backwards for positive",
        lines: &["turn_sign = -1", "forward_sign = -1"],
        ..switched(
            "both signs of the command",
            ("flipped", "on"),
            "drive.ros2.command.turn_sign",
        )
    },
    PlantedFault {
        name: "wrong radius",
        flags: &["--radius=0.1"],
        key: Some("model.wheel_radius_m"),
        ..HEALTHY
    },
    // The command takes the model's track, so the base turns too slowly as well.
    PlantedFault {
        name: "wrong track of the model",
        configuration: Configuration {
            model: WIDE_MODEL,
            ..Configuration::PLAIN
        },
        key: Some("model.track_width_m"),
        says: "effective track of 0.6",
        lines: &["track_width_m = 0.43"],
        ..HEALTHY
    },
    PlantedFault {
        name: "wrong track of the model behind a right command",
        configuration: Configuration {
            model: WIDE_MODEL,
            command: "track_width_m = 0.43\n",
            ..Configuration::PLAIN
        },
        key: Some("model.track_width_m"),
        says: "effective track of 0.6",
        lines: &["track_width_m = 0.4"],
        ..HEALTHY
    },
    PlantedFault {
        name: "wrong track of the command",
        configuration: Configuration {
            command: "track_width_m = 0.6\n",
            ..Configuration::PLAIN
        },
        key: Some("drive.ros2.command.track_width_m"),
        says: "the base itself divides by a track of 0.4",
        lines: &["track_width_m = 0.4"],
        ..HEALTHY
    },
    switched("delayed odometry", ("delay", "0.15"), "drive.ros2.stamps"),
    PlantedFault {
        moves: false,
        lines: &["effort = \"none\""],
        ..switched(
            "missing effort",
            ("effortless", "on"),
            "drive.ros2.joints.effort",
        )
    },
    PlantedFault {
        lines: &["frame = \"camera\""],
        ..switched("wrong frame", ("frame", "on"), "drive.ros2.imu.frame")
    },
    PlantedFault {
        says: "`fl_wheel_joint`, `fr_wheel_joint`, `rl_wheel_joint`, `rr_wheel_joint`",
        lines: &[
            "left = [\"fl_wheel_joint\", \"rl_wheel_joint\"]",
            "right = [\"fr_wheel_joint\", \"rr_wheel_joint\"]",
        ],
        ..switched(
            "renamed joints",
            ("renamed", "on"),
            "drive.ros2.joints.left",
        )
    },
    PlantedFault {
        says: "though the robot moved",
        ..switched(
            "frozen joints",
            ("frozen_joints", "on"),
            "drive.ros2.joints.topic",
        )
    },
    PlantedFault {
        configuration: WITHOUT_POSE,
        says: "the odometry says the same motion",
        ..switched(
            "frozen odometry",
            ("frozen_odometry", "on"),
            "drive.ros2.odometry.topic",
        )
    },
    PlantedFault {
        says: "the gyro says the same turn rate",
        ..switched("frozen gyro", ("frozen_imu", "on"), "drive.ros2.imu.topic")
    },
    PlantedFault {
        says: "it has a bias",
        ..switched("biased gyro", ("bias", "0.05"), "drive.ros2.imu.topic")
    },
    PlantedFault {
        configuration: WITHOUT_POSE,
        says: "in the frame of the pose",
        ..switched(
            "twist in the frame of the world",
            ("world", "on"),
            "drive.ros2.odometry.child_frame",
        )
    },
    PlantedFault {
        says: "nodes write on it",
        moves: false,
        ..switched("two writers", ("two_imus", "on"), "drive.ros2.imu.topic")
    },
    PlantedFault {
        says: "another node writes on",
        ..switched(
            "another node that commands",
            ("rival", "0.3"),
            "drive.ros2.command.topic",
        )
    },
    PlantedFault {
        name: "another node that commands behind a bridge",
        flags: &["--scheme=ros2dds"],
        switched: Some(("rival", "0.3")),
        configuration: BRIDGED,
        key: Some("drive.ros2.command.topic"),
        says: "another node writes on",
        ..HEALTHY
    },
    // It says amperes, of which each is 0.05 N·m.
    PlantedFault {
        name: "right torque constant",
        switched: Some(("effort", "20")),
        configuration: Configuration {
            joints: "effort = \"current\"\ntorque_constant_n_m_a = 0.05\n",
            ..Configuration::PLAIN
        },
        ..HEALTHY
    },
    PlantedFault {
        name: "torque constant ten times too great",
        switched: Some(("effort", "20")),
        configuration: Configuration {
            joints: "effort = \"current\"\ntorque_constant_n_m_a = 0.5\n",
            ..Configuration::PLAIN
        },
        key: Some("drive.ros2.joints.torque_constant_n_m_a"),
        ..HEALTHY
    },
    switched(
        "effort in another unit",
        ("effort", "0.1"),
        "drive.ros2.joints.effort",
    ),
    PlantedFault {
        lines: &["left_effort_sign = -1", "right_effort_sign = -1"],
        ..switched(
            "effort against the motion",
            ("effort", "-1"),
            "drive.ros2.joints.left_effort_sign",
        )
    },
];

/// A robot on which every message comes twice: each topic is named, so it is judged apart.
const TWICE: PlantedFault = PlantedFault {
    name: "every message comes twice",
    switched: Some(("twice", "on")),
    moves: false,
    says: "come again",
    ..HEALTHY
};

/// The keys by which all topics of that robot are named.
const TOPICS: [&str; 5] = [
    "drive.ros2.odometry.topic",
    "drive.ros2.imu.topic",
    "drive.ros2.joints.topic",
    "drive.ros2.pose.topic",
    "drive.ros2.battery.topic",
];

/// Examines each robot, two at once.
pub(crate) async fn measure(python: &Path, node: &Path) -> anyhow::Result<Vec<Check>> {
    let all = ROBOTS.iter().chain([&TWICE]);
    let examinations = stream::iter(all).map(|planted| {
        let (python, node) = (python.to_owned(), node.to_owned());
        // It waits for processes and for nothing else.
        let examination = tokio::task::spawn_blocking(move || examine(planted, &python, &node));
        async move { Ok(judged(planted, &examination.await??)) }
    });
    examinations.buffered(AT_ONCE).try_collect().await
}

/// Whether the fault is named by its key and by no other, in its words and with its lines.
fn judged(planted: &PlantedFault, report: &Value) -> Check {
    let found = report["checks"].as_array();
    let wrong: Vec<&Value> = found
        .into_iter()
        .flatten()
        .filter(|check| check["holds"] != true)
        .collect();
    let mut named: Vec<&str> = wrong
        .iter()
        .filter_map(|check| check["key"].as_str())
        .collect();
    named.sort_unstable();
    named.dedup();
    let mut expected: Vec<&str> = match planted.key {
        Some(key) => vec![key],
        None if planted.name == TWICE.name => TOPICS.to_vec(),
        None => Vec::new(),
    };
    expected.sort_unstable();
    let says = |check: &&Value| {
        let text = check["text"].as_str();
        text.is_some_and(|text| text.contains(planted.says))
    };
    let lines = report["robot_toml"].as_str().unwrap_or_default();
    // A line may go on with more digits.
    let has = |line: &&str| lines.lines().any(|printed| printed.starts_with(line));
    let holds = found.is_some_and(|found| !found.is_empty())
        && named == expected
        && (wrong.is_empty() || wrong.iter().any(says))
        && planted.lines.iter().all(has);
    if !holds {
        eprintln!("{}: {report:#}", planted.name);
    }
    let what = planted.key.unwrap_or("nothing else");
    Check::so(format!("doctor: {}: {what} is wrong", planted.name), holds)
}

/// What the doctor finds on that robot.
fn examine(planted: &PlantedFault, python: &Path, node: &Path) -> anyhow::Result<Value> {
    let mut base = PythonRobot::start(python, planted.flags)?;
    if let Some((fault, value)) = planted.switched {
        base.switch(fault, value)?;
    }
    let folder = tempfile::tempdir()?;
    let file = folder.path().join("robot.toml");
    let data = folder.path().display();
    let head = format!("site = \"yard\"\nrobot = \"r\"\ndata_dir = \"{data}\"\n");
    std::fs::write(&file, head + &base.configuration(&planted.configuration))?;
    let move_it: &[&str] = if planted.moves { &["--move"] } else { &[] };
    let ended = Command::new(node)
        .args(["agent", "doctor", "--json"])
        .args(move_it)
        .arg("--config")
        .arg(&file)
        .output()?;
    let said = String::from_utf8_lossy(&ended.stdout).into_owned();
    serde_json::from_str(&said).with_context(|| String::from_utf8_lossy(&ended.stderr).into_owned())
}
