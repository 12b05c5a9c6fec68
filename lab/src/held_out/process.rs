//! The robot of `lab/ode/robot.cpp` as a plant: compiles it, starts it and speaks with it.

use std::fmt;
use std::io::{self, BufRead, BufReader, Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};

use serde::Serialize;
use tread_control::geometry::Pose;
use tread_control::measured::{BodyAcceleration, WheelSpeeds, WheelTorques};
use tread_control::robot::{GRAVITY_M_S2, RobotModel};

use crate::rough::drive::SimulatedPlant;
use crate::rough::gravity::gravity_m_s2;
use crate::rough::means::Means;
use crate::rough::plant::{State, Truth};
use crate::rough::sensors::SAMPLE_PERIOD;
use crate::rough::spec::Deviations;

/// Integration steps in a sample by default: steps of 0.5 ms.
pub const STEPS_PER_SAMPLE: u32 = 20;
/// Number of wheels: front left, rear left, front right, rear right.
pub const WHEELS: usize = 4;
/// Share of a wheel in what a robot has of all wheels.
const WHEEL_SHARE: f64 = 0.25;
/// Exit code of `lab/ode/build` if a tool is missing.
const MISSING: i32 = 3;
/// Longest answer that is read, in bytes.
const ANSWER_MAX: u64 = 4_096;
/// Numbers in a state line.
const STATE_NUMBERS: usize = 17 + WHEELS;
/// Numbers of a wheel in a wheels line.
const WHEEL_NUMBERS: usize = 6;

/// Why the simulator cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum OdeError {
    /// Compiler or library are not installed.
    #[error("ODE or its compiler is missing: apt-get install libode-dev g++")]
    Missing,
    /// Its source is not here.
    #[error("there is no lab/ode/robot.cpp here: run this inside the repository")]
    Elsewhere,
    /// The program does not compile.
    #[error("`lab/ode/robot.cpp` does not compile: {0}")]
    Build(String),
    /// A file or the process cannot be used.
    #[error("cannot {action}")]
    Io {
        /// What was tried.
        action: &'static str,
        /// Why it failed.
        #[source]
        source: io::Error,
    },
    /// The simulator refuses a command.
    #[error("the simulator refuses: {0}")]
    Refused(String),
    /// The simulator's answer is not what the protocol says.
    #[error("the simulator's answer to `{command}` is `{answer}`")]
    Answer {
        /// What it was asked.
        command: String,
        /// What it answered; empty if it ended.
        answer: String,
    },
}

fn io_error(action: &'static str) -> impl FnOnce(io::Error) -> OdeError {
    move |source| OdeError::Io { action, source }
}

/// Returns the folder of the simulator's source: in the crate that cargo runs, or below the present
/// folder.
fn source() -> Result<PathBuf, OdeError> {
    let of_cargo = std::env::var_os("CARGO_MANIFEST_DIR").map(PathBuf::from);
    let folders = of_cargo.into_iter().chain(["lab".into(), ".".into()]);
    let mut folders = folders.map(|folder| folder.join("ode"));
    folders
        .find(|folder| folder.join("robot.cpp").exists())
        .ok_or(OdeError::Elsewhere)
}

/// The compiled simulator.
#[derive(Debug, Clone)]
pub struct OdeProgram(PathBuf);

impl OdeProgram {
    /// Compiles the simulator into `folder`, unless it is there and newer than its source.
    ///
    /// # Errors
    /// [`OdeError::Missing`] if ODE is not installed, others if it cannot be compiled.
    pub fn build(folder: &Path) -> Result<Self, OdeError> {
        let source = source()?;
        let program = folder.join("held-out-robot");
        let time_of = |path: &Path| path.metadata().and_then(|found| found.modified());
        let changed = time_of(&source.join("robot.cpp")).map_err(io_error("read robot.cpp"))?;
        if time_of(&program).is_ok_and(|built| built > changed) {
            return Ok(Self(program));
        }
        // Several processes may compile at once.
        let unique = folder.join(format!("held-out-robot.{}", std::process::id()));
        let output = Command::new(source.join("build"))
            .arg(&unique)
            .output()
            .map_err(io_error("run lab/ode/build"))?;
        if output.status.code() == Some(MISSING) {
            return Err(OdeError::Missing);
        }
        if !output.status.success() {
            let said = String::from_utf8_lossy(&output.stderr);
            return Err(OdeError::Build(said.trim().to_owned()));
        }
        std::fs::rename(&unique, &program).map_err(io_error("rename the simulator"))?;
        Ok(Self(program))
    }
}

/// Contacts of a robot with the ground.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, clap::ValueEnum)]
#[serde(rename_all = "snake_case")]
pub enum Contacts {
    /// ODE's own: force follows slip at once, and a sliding contact's force is against its sliding.
    #[default]
    Rigid,
    /// Tyres that deflect, with the drawn relaxation lengths. The deflection is that of a spring under
    /// the contact's force, so a sliding contact deflects no further.
    Elastic,
    /// As rigid ones, but longitudinal and lateral force have limits of their own: ODE's pyramid
    /// along the wheel. A tyre that slides sideways keeps its longitudinal stiffness, which no tyre
    /// does.
    Pyramid,
}

impl Contacts {
    /// All contacts.
    pub const ALL: [Self; 3] = [Self::Rigid, Self::Elastic, Self::Pyramid];

    /// Returns the name for reports.
    pub fn text(self) -> &'static str {
        match self {
            Self::Rigid => "rigid",
            Self::Elastic => "elastic",
            Self::Pyramid => "pyramid",
        }
    }

    fn is_cone(self) -> bool {
        self != Self::Pyramid
    }

    fn relaxation_m(self, drawn_m: f64) -> f64 {
        match self {
            Self::Elastic => drawn_m,
            Self::Rigid | Self::Pyramid => 0.0,
        }
    }
}

/// Robot to simulate.
#[derive(Debug, Clone, Copy)]
pub struct OdeRobot<'a> {
    /// Model of the agent.
    pub model: &'a RobotModel,
    /// Differences from that model. The curve's shape is not used: ODE has its own.
    pub deviations: Deviations,
    /// Pose of the centre of the wheels at the start.
    pub start: Pose,
    /// Contacts with the ground.
    pub contacts: Contacts,
    /// Integration steps in a sample; at least 10, since steps are at most 1 ms.
    pub steps_per_sample: u32,
}

impl OdeRobot<'_> {
    /// Returns the true mass, payload included.
    pub fn mass_kg(&self) -> f64 {
        self.model.mass_kg() * (1.0 + self.deviations.payload_ratio)
    }

    fn line(&self) -> String {
        let (model, spec, mass_kg) = (self.model, self.deviations, self.mass_kg());
        let radius_m = model.wheel_radius_m();
        let values = [
            (
                "step_s",
                SAMPLE_PERIOD.as_secs_f64() / f64::from(self.steps_per_sample),
            ),
            ("gravity_m_s2", GRAVITY_M_S2),
            ("mass_kg", mass_kg),
            (
                "yaw_inertia_kg_m2",
                mass_kg * model.yaw_inertia_kg_m2() / model.mass_kg() * spec.inertia_ratio,
            ),
            (
                "center_forward_m",
                spec.center_forward_ratio * model.wheelbase_m(),
            ),
            (
                "center_left_m",
                spec.center_left_ratio * model.track_width_m(),
            ),
            (
                "center_height_m",
                spec.center_height_ratio * model.track_width_m(),
            ),
            ("track_m", model.track_width_m()),
            ("wheelbase_m", model.wheelbase_m()),
            ("radius_left_m", spec.radius_ratio[0] * radius_m),
            ("radius_right_m", spec.radius_ratio[1] * radius_m),
            (
                "wheel_inertia_kg_m2",
                WHEEL_SHARE * spec.rotor_ratio * model.mass_kg() * radius_m.powi(2),
            ),
            ("stiffness", spec.curve.stiffness),
            ("mu_peak", spec.curve.mu_peak),
            ("is_cone", f64::from(u8::from(self.contacts.is_cone()))),
            (
                "relaxation_m",
                self.contacts.relaxation_m(spec.relaxation_m),
            ),
            ("slope_x_rad", spec.slope_rad[0]),
            ("slope_y_rad", spec.slope_rad[1]),
            ("gear_loss_ratio", spec.gear_loss_ratio),
            ("rolling_resistance_ratio", spec.rolling_resistance_ratio),
            ("servo_lag_s", spec.servo_lag_s),
            (
                "torque_limit_n_m",
                WHEEL_SHARE * spec.motor_limit_mu * mass_kg * GRAVITY_M_S2 * radius_m,
            ),
            ("x_m", self.start.x_m),
            ("y_m", self.start.y_m),
            ("heading_rad", self.start.heading_rad),
        ];
        let values = values.map(|(key, value)| format!("{key}={value}"));
        format!("robot {}", values.join(" "))
    }
}

/// Forces and slip of one wheel, means over the last sample.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WheelContact {
    /// Load, newtons.
    pub load_n: f64,
    /// Force of the ground on the wheel, `[forward, left]`, newtons.
    pub force_n: [f64; 2],
    /// Slip speed: the negative velocity of the contact point, `[forward, left]`, metres per second.
    pub slip_m_s: [f64; 2],
    /// Rim speed, metres per second.
    pub rim_m_s: f64,
}

impl WheelContact {
    /// Returns the slip `[forward, left]`.
    pub fn slip(&self) -> [f64; 2] {
        self.slip_m_s.map(|slip_m_s| slip_m_s / self.rim_m_s.abs())
    }

    /// Returns the friction coefficients `[forward, left]`.
    pub fn mu(&self) -> [f64; 2] {
        self.force_n.map(|force_n| force_n / self.load_n)
    }
}

/// A robot in a simulator's process, which ends with this value.
#[derive(Debug)]
pub struct OdePlant {
    child: Child,
    to: ChildStdin,
    from: BufReader<ChildStdout>,
    steps_per_sample: u32,
    torque_scale: [f64; 2],
    slope_rad: [f64; 2],
    truth: Truth,
    slip_over_peak: f64,
    failure: Option<String>,
}

impl OdePlant {
    /// Starts a process with a robot at rest.
    ///
    /// # Errors
    /// The process cannot be started, or refuses the robot.
    pub fn start(program: &OdeProgram, robot: &OdeRobot<'_>) -> Result<Self, OdeError> {
        let mut child = Command::new(&program.0)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .map_err(io_error("start the simulator"))?;
        let pipes = child.stdin.take().zip(child.stdout.take());
        let (to, from) = pipes.ok_or_else(|| OdeError::Refused("no pipes".to_owned()))?;
        let mut plant = Self {
            child,
            to,
            from: BufReader::new(from),
            steps_per_sample: robot.steps_per_sample,
            torque_scale: robot.deviations.torque_scale,
            slope_rad: robot.deviations.slope_rad,
            truth: Truth::default(),
            slip_over_peak: 0.0,
            failure: None,
        };
        plant.ask::<0>(format_args!("{}", robot.line()), "ready")?;
        Ok(plant)
    }

    /// Sends a command and returns the numbers of the answer, which must begin with `word`.
    fn ask<const COUNT: usize>(
        &mut self,
        command: fmt::Arguments<'_>,
        word: &str,
    ) -> Result<[f64; COUNT], OdeError> {
        let command = command.to_string();
        writeln!(self.to, "{command}").map_err(io_error("write to the simulator"))?;
        let mut answer = String::new();
        (&mut self.from)
            .take(ANSWER_MAX)
            .read_line(&mut answer)
            .map_err(io_error("read from the simulator"))?;
        if let Some(text) = answer.strip_prefix("error ") {
            return Err(OdeError::Refused(text.trim().to_owned()));
        }
        let numbers = answer
            .strip_prefix(word)
            .map(|rest| rest.split_whitespace().map(str::parse::<f64>));
        let numbers: Option<Vec<f64>> =
            numbers.and_then(|found| found.collect::<Result<_, _>>().ok());
        numbers
            .and_then(|numbers| numbers.try_into().ok())
            .ok_or_else(|| OdeError::Answer {
                command,
                answer: answer.trim().to_owned(),
            })
    }

    /// Simulates one sample with commanded wheel speeds.
    ///
    /// # Errors
    /// The simulation diverged, or its process ended.
    pub fn advance(&mut self, command: WheelSpeeds) -> Result<Means, OdeError> {
        let steps = self.steps_per_sample;
        let (left, right) = (command.left_rad_s, command.right_rad_s);
        let command = format_args!("drive {left} {right} {steps}");
        let numbers = self.ask::<STATE_NUMBERS>(command, "state")?;
        let [
            x_m,
            y_m,
            heading_rad,
            forward_m_s,
            left_m_s,
            yaw_rate_rad_s,
            ..,
        ] = numbers;
        let [.., tilt_rad, slip_over_peak, _, _, _, _] = numbers;
        let [gravity_forward, gravity_left, _] = gravity_m_s2(self.slope_rad, heading_rad);
        self.truth = Truth {
            state: State {
                pose: Pose {
                    x_m,
                    y_m,
                    heading_rad,
                },
                forward_m_s,
                left_m_s,
                yaw_rate_rad_s,
            },
            turned_rad: [numbers[13], numbers[14]],
            torque_scale: self.torque_scale,
            tilt_rad,
            gravity_m_s2: [gravity_forward, gravity_left],
        };
        self.slip_over_peak = slip_over_peak;
        Ok(Means {
            yaw_rate_rad_s: numbers[6],
            acceleration: BodyAcceleration {
                forward_m_s2: numbers[7],
                left_m_s2: numbers[8],
            },
            wheel_speeds: WheelSpeeds {
                left_rad_s: numbers[9],
                right_rad_s: numbers[10],
            },
            torques: WheelTorques {
                left_n_m: numbers[11],
                right_n_m: numbers[12],
            },
        })
    }

    /// Pulls the robot from now on by a force `[forward, left]`, newtons, which acts at the ground
    /// below the centre of mass.
    ///
    /// # Errors
    /// The process ended.
    pub fn pull(&mut self, force_n: [f64; 2]) -> Result<(), OdeError> {
        let [forward_n, left_n] = force_n;
        self.ask::<0>(format_args!("pull {forward_n} {left_n}"), "ok")?;
        Ok(())
    }

    /// Returns the contacts of the wheels: front left, rear left, front right, rear right.
    ///
    /// # Errors
    /// The process ended.
    pub fn contacts(&mut self) -> Result<[WheelContact; WHEELS], OdeError> {
        let numbers = self.ask::<{ WHEELS * WHEEL_NUMBERS }>(format_args!("wheels"), "wheels")?;
        Ok(std::array::from_fn(|wheel| {
            let of = |number: usize| numbers[wheel * WHEEL_NUMBERS + number];
            WheelContact {
                load_n: of(0),
                force_n: [of(1), of(2)],
                slip_m_s: [of(3), of(4)],
                rim_m_s: of(5),
            }
        }))
    }
}

impl SimulatedPlant for OdePlant {
    fn advance_sample(&mut self, command: WheelSpeeds) -> Means {
        if self.failure.is_none() {
            match self.advance(command) {
                Ok(means) => return means,
                Err(error) => self.failure = Some(error.to_string()),
            }
        }
        Means::default()
    }

    fn truth(&self) -> Truth {
        self.truth
    }

    fn slip_over_peak(&self) -> f64 {
        self.slip_over_peak
    }

    fn check(&self) -> anyhow::Result<()> {
        match &self.failure {
            None => Ok(()),
            Some(text) => Err(anyhow::anyhow!("{text}")),
        }
    }
}

impl Drop for OdePlant {
    fn drop(&mut self) {
        // It may have ended by itself.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
