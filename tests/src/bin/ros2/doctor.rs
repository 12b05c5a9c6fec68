//! `tread-agent doctor` on robots of which it is known what is wrong.

use std::path::Path;
use std::process::Command;

use anyhow::Context;
use futures_util::{StreamExt as _, TryStreamExt as _, stream};
use serde_json::Value;

use crate::python_robot::PythonRobot;
use tread_tests::report::Check;

/// Robots that are examined at once; each stands still or drives slowly most of the time.
const AT_ONCE: usize = 2;

/// A planted fault, and the key of `robot.toml` by which it must be named.
#[derive(Clone, Copy)]
struct Planted {
    name: &'static str,
    flags: &'static [&'static str],
    /// A fault that is switched on, and its value.
    switched: Option<(&'static str, &'static str)>,
    /// What `robot.toml` says of the joints beside their names.
    joints: &'static str,
    key: Option<&'static str>,
}

const HEALTHY: Planted = Planted {
    name: "healthy",
    flags: &[],
    switched: None,
    joints: "",
    key: None,
};

const fn switched(
    name: &'static str,
    fault: (&'static str, &'static str),
    key: &'static str,
) -> Planted {
    Planted {
        name,
        switched: Some(fault),
        key: Some(key),
        ..HEALTHY
    }
}

const ROBOTS: [Planted; 11] = [
    HEALTHY,
    switched("swapped sides", ("swapped", "on"), "drive.ros2.joints.left"),
    switched(
        "one side inverted",
        ("inverted", "on"),
        "drive.ros2.joints.left_sign",
    ),
    Planted {
        name: "wrong radius",
        flags: &["--radius=0.1"],
        key: Some("model.wheel_radius_m"),
        ..HEALTHY
    },
    switched("delayed odometry", ("delay", "0.15"), "drive.ros2.stamps"),
    switched(
        "missing effort",
        ("effortless", "on"),
        "drive.ros2.joints.effort",
    ),
    switched("wrong frame", ("frame", "on"), "drive.ros2.imu.frame"),
    // It tells amperes, of which each is 0.05 N·m.
    Planted {
        name: "right torque constant",
        switched: Some(("effort", "20")),
        joints: "effort = \"current\"\ntorque_constant_n_m_a = 0.05\n",
        ..HEALTHY
    },
    Planted {
        name: "torque constant ten times too great",
        switched: Some(("effort", "20")),
        joints: "effort = \"current\"\ntorque_constant_n_m_a = 0.5\n",
        key: Some("drive.ros2.joints.torque_constant_n_m_a"),
        ..HEALTHY
    },
    switched(
        "effort in another unit",
        ("effort", "0.1"),
        "drive.ros2.joints.effort",
    ),
    switched(
        "effort against the motion",
        ("effort", "-1"),
        "drive.ros2.joints.left_effort_sign",
    ),
];

/// Examines each robot, two at once.
pub(crate) async fn measure(python: &Path, node: &Path) -> anyhow::Result<Vec<Check>> {
    let examinations = stream::iter(&ROBOTS).map(|planted| {
        let (python, node) = (python.to_owned(), node.to_owned());
        // It waits for processes and for nothing else.
        let examination = tokio::task::spawn_blocking(move || examine(planted, &python, &node));
        async move { Ok(judged(planted, &examination.await??)) }
    });
    examinations.buffered(AT_ONCE).try_collect().await
}

fn judged(planted: &Planted, found: &[Value]) -> Check {
    let wrong: Vec<&Value> = found
        .iter()
        .filter(|check| check["holds"] != true)
        .collect();
    let named = wrong.iter().filter_map(|check| check["key"].as_str());
    let holds = match planted.key {
        None => wrong.is_empty(),
        Some(key) => named.into_iter().any(|named| named == key),
    };
    if !holds {
        eprintln!("{}: {found:#?}", planted.name);
    }
    let what = planted.key.unwrap_or("nothing");
    Check::so(format!("doctor: {}: {what} is wrong", planted.name), holds)
}

/// What the doctor finds on that robot.
fn examine(planted: &Planted, python: &Path, node: &Path) -> anyhow::Result<Vec<Value>> {
    let mut base = PythonRobot::start(python, planted.flags)?;
    if let Some((fault, value)) = planted.switched {
        base.switch(fault, value)?;
    }
    let folder = tempfile::tempdir()?;
    let file = folder.path().join("robot.toml");
    let data = folder.path().display();
    let head = format!("site = \"yard\"\nrobot = \"r\"\ndata_dir = \"{data}\"\n");
    std::fs::write(&file, head + &base.configuration(planted.joints))?;
    let ended = Command::new(node)
        .args(["agent", "doctor", "--move", "--json", "--config"])
        .arg(&file)
        .output()?;
    let said = String::from_utf8_lossy(&ended.stdout).into_owned();
    let report: Value = serde_json::from_str(&said)
        .with_context(|| String::from_utf8_lossy(&ended.stderr).into_owned())?;
    let checks = report["checks"].as_array().context("a list of checks")?;
    Ok(checks.clone())
}
