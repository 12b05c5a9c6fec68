//! `tread-agent doctor` on robots of which it is known what is wrong.

use std::path::Path;
use std::process::Command;

use anyhow::Context;
use serde_json::Value;

use crate::python_robot::PythonRobot;
use tread_tests::report::Check;

/// A planted fault, and the key of `robot.toml` by which it must be named.
struct Planted {
    name: &'static str,
    flags: &'static [&'static str],
    /// A fault that is switched on, and its value.
    switched: Option<(&'static str, &'static str)>,
    key: Option<&'static str>,
}

const fn switched(
    name: &'static str,
    fault: (&'static str, &'static str),
    key: &'static str,
) -> Planted {
    Planted {
        name,
        flags: &[],
        switched: Some(fault),
        key: Some(key),
    }
}

const ROBOTS: [Planted; 7] = [
    Planted {
        name: "healthy",
        flags: &[],
        switched: None,
        key: None,
    },
    switched("swapped sides", ("swapped", "on"), "drive.ros2.joints.left"),
    switched(
        "one side inverted",
        ("inverted", "on"),
        "drive.ros2.joints.left_sign",
    ),
    Planted {
        name: "wrong radius",
        flags: &["--radius=0.1"],
        switched: None,
        key: Some("model.wheel_radius_m"),
    },
    switched("delayed odometry", ("delay", "0.15"), "drive.ros2.stamps"),
    switched(
        "missing effort",
        ("effortless", "on"),
        "drive.ros2.joints.effort",
    ),
    switched("wrong frame", ("frame", "on"), "drive.ros2.imu.frame"),
];

/// Examines each robot.
pub(crate) async fn measure(python: &Path, node: &Path) -> anyhow::Result<Vec<Check>> {
    let mut checks = Vec::new();
    for planted in &ROBOTS {
        let mut base = PythonRobot::start(python, planted.flags)?;
        if let Some((fault, value)) = planted.switched {
            base.switch(fault, value)?;
        }
        let found = examine(&base, node).await?;
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
        checks.push(Check::so(
            format!("doctor: {}: {what} is wrong", planted.name),
            holds,
        ));
    }
    Ok(checks)
}

async fn examine(base: &PythonRobot, node: &Path) -> anyhow::Result<Vec<Value>> {
    let folder = tempfile::tempdir()?;
    let file = folder.path().join("robot.toml");
    let data = folder.path().display();
    let head = format!("site = \"yard\"\nrobot = \"r\"\ndata_dir = \"{data}\"\n");
    std::fs::write(&file, head + &base.configuration())?;
    let mut doctor = Command::new(node);
    doctor
        .args(["agent", "doctor", "--move", "--json", "--config"])
        .arg(&file);
    let ended = tokio::task::spawn_blocking(move || doctor.output()).await??;
    let said = String::from_utf8_lossy(&ended.stdout).into_owned();
    let report: Value = serde_json::from_str(&said)
        .with_context(|| String::from_utf8_lossy(&ended.stderr).into_owned())?;
    let checks = report["checks"].as_array().context("a list of checks")?;
    Ok(checks.clone())
}
