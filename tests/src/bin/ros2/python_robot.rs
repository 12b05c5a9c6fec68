//! The process of `tests/ros2/robot.py`.

use std::io::{BufRead as _, BufReader, Write as _};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Command, Stdio};

use anyhow::Context;
use tread_tests::ports::free_address;

/// What is known of it: it carries nothing, on tyres that rise straight.
const KNOWN: &str = "[estimation]\npayload_ratio = 0.0\ntyre_curvature = 0.0\n\
                     tyre_curvature_std_dev = 0.0\ntyre_mu_max = 10.0\ntyre_relaxation_m = 0.0\n\
                     tyre_relaxation_std_dev_m = 0.0\nrotor_ratio = 0.0\nrotor_std_dev_ratio = 0.0\n";

/// The robot's domain.
pub(crate) const DOMAIN: u32 = 7;

/// The robot's program, in this folder or one above it.
fn script() -> anyhow::Result<PathBuf> {
    let here = std::env::current_dir()?;
    here.ancestors()
        .map(|folder| folder.join("tests/ros2/robot.py"))
        .find(|script| script.is_file())
        .context("there is no tests/ros2/robot.py here: run this inside the repository")
}

/// A running robot; it ends when it is dropped.
#[derive(Debug)]
pub(crate) struct PythonRobot {
    child: Child,
    input: ChildStdin,
    endpoint: String,
}

impl PythonRobot {
    /// Starts a robot that is its own router, and waits until it speaks.
    pub(crate) fn start(python: &Path, flags: &[&str]) -> anyhow::Result<Self> {
        let endpoint = format!("tcp/{}", free_address());
        let script = script()?;
        let mut child = Command::new(python)
            .arg(&script)
            .args(["--router", "--endpoint", &endpoint])
            .arg(format!("--domain={DOMAIN}"))
            .args(flags)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .with_context(|| format!("cannot start {}", python.display()))?;
        let input = child.stdin.take().context("it has an input")?;
        let output = child.stdout.take().context("it has an output")?;
        let mut lines = BufReader::new(output).lines();
        let first = lines.next().context(
            "the robot ended at once: `pip install -r tests/ros2/requirements.txt` for the Python \
             that `--python` names",
        )??;
        anyhow::ensure!(first.contains("ready"), "the robot says `{first}`");
        // What it says further on is for people; a full pipe would stop it.
        std::thread::spawn(move || lines.for_each(drop));
        Ok(Self {
            child,
            input,
            endpoint,
        })
    }

    /// Where its bus is.
    pub(crate) fn endpoint(&self) -> &str {
        &self.endpoint
    }

    /// Switches a fault: `on`, `off`, or a figure.
    pub(crate) fn switch(&mut self, fault: &str, value: &str) -> anyhow::Result<()> {
        writeln!(self.input, "{fault} {value}")?;
        Ok(self.input.flush()?)
    }

    /// The `robot.toml` of an agent that drives it.
    pub(crate) fn configuration(&self, more: &Configuration) -> String {
        let Configuration {
            model,
            bus,
            joints,
            command,
            pose,
        } = more;
        format!(
            "{KNOWN}{model}[drive]\nkind = \"ros2\"\n[drive.ros2]\n\
             endpoint = \"{}\"\ndomain = {DOMAIN}\nbus = \"{bus}\"\n\
             namespace = \"/rover\"\n\
             [drive.ros2.joints]\n\
             left = [\"front_left_wheel\", \"rear_left_wheel\"]\n\
             right = [\"front_right_wheel\", \"rear_right_wheel\"]\n\
             {joints}\
             [drive.ros2.command]\n{command}\
             [drive.ros2.imu]\n\
             [drive.ros2.odometry]\ntopic = \"vio/odom\"\nmotion_of = \"ground\"\n\
             {pose}\
             [drive.ros2.battery]\n",
            self.endpoint
        )
    }
}

/// What a `robot.toml` says beside what every one says.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Configuration {
    /// Whole sections before all others.
    pub(crate) model: &'static str,
    /// How ROS 2 is spoken.
    pub(crate) bus: &'static str,
    /// Lines of the joints beside their names.
    pub(crate) joints: &'static str,
    /// Lines of the command.
    pub(crate) command: &'static str,
    /// The section of the pose, if it is read.
    pub(crate) pose: &'static str,
}

impl Configuration {
    /// Nothing more.
    pub(crate) const PLAIN: Self = Self {
        model: "",
        bus: "rmw_zenoh",
        joints: "",
        command: "",
        pose: "[drive.ros2.pose]\n",
    };
}

impl Drop for PythonRobot {
    fn drop(&mut self) {
        // Both fail only if it has ended already.
        _ = self.child.kill();
        _ = self.child.wait();
    }
}
