//! Trials with each fault, and hours without one.

use tread_control::consistency::{Kind, Subject};
use tread_lab::report::Check;

use crate::generator::{Equipment, Fault, Make, Robot, STEP_S};

/// Goal: motion that shows a fault until it is named, in 95 % of the trials, seconds.
const NAMED_WITHIN_S: f64 = 1.0;

const USAGE: &str =
    "consistency [--json | --markdown] [--hours N] [--trials N] [--seed N] [--other]";
/// Maximum numbers of hours and trials.
const HOURS_MAX: u32 = 1_000;
const TRIALS_MAX: u32 = 10_000;
const SEED_MAX: u32 = 1_000_000;
/// Maximum motion that shows the fault in a trial, seconds.
const EXCITED_MAX_S: f64 = 15.0;
/// Maximum duration of a trial after the fault, seconds.
const TRIAL_MAX_S: f64 = 120.0;
/// Goals of most faults: exciting motion until something is reported, in half of the trials, seconds;
/// and the share of trials in which the fault is named.
const USUAL: Goals = Goals {
    noticed_p50_s: 1.0,
    named_share_min: 0.99,
};
/// Goals of faults of the wheels on a robot without odometry: slip is a possible explanation for a
/// while.
const WHEELS_ALONE: Goals = Goals {
    noticed_p50_s: 1.5,
    named_share_min: 0.98,
};
/// Goals of faults that noise of 2 cm at 10 Hz hides for a while, and that slip could explain.
const HIDDEN: Goals = Goals {
    noticed_p50_s: 4.0,
    named_share_min: 0.9,
};

/// Format of the output.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Output {
    /// Lines for a terminal.
    Lines,
    /// One object for programs.
    Json,
    /// A table for a page.
    Markdown,
}

/// Arguments of the command line.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Options {
    pub(crate) output: Output,
    pub(crate) hours: u32,
    pub(crate) trials: u32,
    /// The first seed of the trials and of the hours.
    pub(crate) seed: u32,
    /// Usual robots, or those on which no bound was chosen.
    pub(crate) make: Make,
}

impl Options {
    /// Reads the arguments of the command line.
    ///
    /// # Errors
    /// The usage line, if an argument is unknown or a number is out of range.
    pub(crate) fn from_arguments(
        mut arguments: impl Iterator<Item = String>,
    ) -> Result<Self, &'static str> {
        let mut options = Self {
            output: Output::Lines,
            hours: 10,
            trials: 100,
            seed: 0,
            make: Make::Usual,
        };
        while let Some(argument) = arguments.next() {
            let mut value = |most: u32| {
                let value = arguments.next().and_then(|value| value.parse().ok());
                value
                    .filter(|value| (1..=most).contains(value))
                    .ok_or(USAGE)
            };
            match argument.as_str() {
                "--json" => options.output = Output::Json,
                "--markdown" => options.output = Output::Markdown,
                "--hours" => options.hours = value(HOURS_MAX)?,
                "--trials" => options.trials = value(TRIALS_MAX)?,
                "--seed" => options.seed = value(SEED_MAX)?,
                "--other" => options.make = Make::Other,
                _ => return Err(USAGE),
            }
        }
        Ok(options)
    }
}

/// Maximum fraction of trials in which another channel is blamed.
const BLAMED_SHARE_MAX: f64 = 0.01;

/// Goals of one fault: median of the motion that shows the fault until anything is reported,
/// seconds, and minimum fraction of trials in which the fault is named.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Goals {
    pub(crate) noticed_p50_s: f64,
    pub(crate) named_share_min: f64,
}

/// A fault, the findings that name it correctly, and its goals.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Case {
    pub(crate) name: &'static str,
    pub(crate) fault: Fault,
    /// Subjects any of which names the fault.
    pub(crate) subjects: &'static [Subject],
    pub(crate) kind: Option<Kind>,
    pub(crate) has_odometry: bool,
    pub(crate) goals: Goals,
}

const fn case(
    name: &'static str,
    fault: Fault,
    subjects: &'static [Subject],
    kind: Option<Kind>,
    has_odometry: bool,
    goals: Goals,
) -> Case {
    Case {
        name,
        fault,
        subjects,
        kind,
        has_odometry,
        goals,
    }
}

const GYRO: &[Subject] = &[Subject::Gyro];
const WHEELS: &[Subject] = &[Subject::Wheels];
const ODOMETRY: &[Subject] = &[Subject::Odometry];
const POSITION: &[Subject] = &[Subject::Position];
const FELT: &[Subject] = &[Subject::Accelerometer];

/// Every fault that is tried.
pub(crate) const CASES: &[Case] = &[
    case(
        "gyro frozen",
        Fault::GyroFrozen,
        GYRO,
        Some(Kind::Frozen),
        false,
        USUAL,
    ),
    case(
        "gyro inverted",
        Fault::GyroInverted,
        GYRO,
        None,
        false,
        USUAL,
    ),
    case(
        "gyro scaled by 1.5",
        Fault::GyroScaled(1.5),
        GYRO,
        None,
        false,
        USUAL,
    ),
    case(
        "gyro scaled by 1/1.5",
        Fault::GyroScaled(1.0 / 1.5),
        GYRO,
        None,
        false,
        USUAL,
    ),
    case(
        "gyro biased by 0.2 rad/s",
        Fault::GyroBiased(0.2),
        GYRO,
        None,
        false,
        USUAL,
    ),
    case(
        "gyro at its limit",
        Fault::GyroAtLimit,
        GYRO,
        None,
        true,
        USUAL,
    ),
    case(
        "wheel speeds frozen",
        Fault::WheelsFrozen,
        WHEELS,
        Some(Kind::Frozen),
        false,
        WHEELS_ALONE,
    ),
    case(
        "wheel speeds scaled by 1.5",
        Fault::WheelsScaled(1.5),
        WHEELS,
        None,
        false,
        HIDDEN,
    ),
    case(
        "wheel speeds scaled by 1/1.5",
        Fault::WheelsScaled(1.0 / 1.5),
        WHEELS,
        None,
        true,
        HIDDEN,
    ),
    case(
        "left encoder dead",
        Fault::LeftEncoderDead,
        WHEELS,
        None,
        false,
        WHEELS_ALONE,
    ),
    case(
        "left wheels locked",
        Fault::LeftWheelsLocked,
        &[Subject::LeftWheels],
        Some(Kind::Locked),
        false,
        USUAL,
    ),
    case(
        "odometry speed frozen",
        Fault::OdometryFrozen,
        ODOMETRY,
        Some(Kind::Frozen),
        true,
        USUAL,
    ),
    case(
        "odometry speed scaled by 1.5",
        Fault::OdometryScaled(1.5),
        ODOMETRY,
        None,
        true,
        USUAL,
    ),
    case(
        "odometry twist in the world frame",
        Fault::OdometryInWorldFrame,
        ODOMETRY,
        None,
        true,
        USUAL,
    ),
    case(
        "position frozen",
        Fault::PositionFrozen,
        POSITION,
        Some(Kind::Frozen),
        false,
        USUAL,
    ),
    case(
        "position jumps by 5 m",
        Fault::PositionJumps,
        POSITION,
        Some(Kind::Jumped),
        false,
        USUAL,
    ),
    case(
        "position rotated by 90°",
        Fault::PositionRotated,
        POSITION,
        Some(Kind::Jumped),
        false,
        USUAL,
    ),
    case(
        "position scaled by 1.5, with odometry",
        Fault::PositionScaled(1.5),
        POSITION,
        None,
        true,
        HIDDEN,
    ),
    case(
        "accelerometer frozen",
        Fault::AccelerometerFrozen,
        FELT,
        Some(Kind::Frozen),
        false,
        USUAL,
    ),
    case(
        "accelerometer inverted",
        Fault::AccelerometerInverted,
        FELT,
        None,
        false,
        HIDDEN,
    ),
    case(
        "accelerometer at its limit",
        Fault::AccelerometerAtLimit,
        FELT,
        None,
        false,
        USUAL,
    ),
    case(
        "all of one odometry frozen",
        Fault::EverythingFrozen,
        &[Subject::Position, Subject::Wheels],
        Some(Kind::Frozen),
        false,
        USUAL,
    ),
    case(
        "encoders of the base's own loop scaled by 1.5",
        Fault::EncodersOfTheBaseScaled(1.5),
        &[Subject::WheelsAndMotion],
        None,
        false,
        HIDDEN,
    ),
];

/// Result of one trial.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Trial {
    /// Motion that shows the fault until the first finding, seconds; `None` without one.
    pub(crate) noticed_s: Option<f64>,
    /// Motion that shows the fault until the right finding, seconds; `None` if it was not named.
    pub(crate) named_s: Option<f64>,
    /// First channel that was wrongly blamed.
    pub(crate) wrong: Option<Subject>,
}

/// Runs one trial: the fault begins while the robot drives, and the findings are compared with it.
pub(crate) fn trial(case: &Case, make: Make, seed: u64) -> Trial {
    let mut robot = Robot::new(
        seed,
        Equipment {
            has_odometry: case.has_odometry,
            has_accelerometer: true,
            meets_ice: false,
            make,
        },
    );
    let warm_s = 5.0 + 15.0 * robot.chance();
    while robot.time_s() < warm_s {
        robot.step();
    }
    robot.break_with(case.fault);
    let (mut excited_s, mut noticed_s, mut wrong) = (0.0, None, None);
    while excited_s < EXCITED_MAX_S && robot.time_s() < warm_s + TRIAL_MAX_S {
        robot.step();
        if robot.is_excited() {
            excited_s += STEP_S;
        }
        for found in robot.monitor.findings().iter() {
            noticed_s = noticed_s.or(Some(excited_s));
            if case.subjects.contains(&found.subject) {
                let is_right = case.kind.is_none_or(|kind| kind == found.kind);
                return Trial {
                    noticed_s,
                    named_s: Some(excited_s).filter(|_| is_right),
                    wrong,
                };
            }
            // Saying that two of them disagree blames nobody.
            let blames = !matches!(found.subject, Subject::WheelsAndMotion | Subject::Motion);
            if blames {
                wrong = wrong.or(Some(found.subject));
            }
        }
    }
    Trial {
        noticed_s,
        named_s: None,
        wrong,
    }
}

/// Findings on a robot without a fault.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct FaultlessRun {
    /// Number of findings that blame a channel.
    pub(crate) blamed: u32,
    /// Number of findings that wheels and motion disagree, off the ice.
    pub(crate) slip_off_ice: u32,
    /// Number of findings that wheels and motion disagree, on the ice.
    pub(crate) slip_on_ice: u32,
}

/// Drives without a fault.
pub(crate) fn quiet(seconds: f64, seed: u64, kit: Equipment) -> FaultlessRun {
    let mut robot = Robot::new(seed, kit);
    let mut quiet = FaultlessRun::default();
    let mut standing = [false; Subject::ALL.len()];
    while robot.time_s() < seconds {
        robot.step();
        let findings = robot.monitor.findings();
        for subject in Subject::ALL {
            let found = findings.about(subject);
            let was = std::mem::replace(&mut standing[subject as usize], found.is_some());
            if was || found.is_none() {
                continue;
            }
            match subject {
                Subject::WheelsAndMotion if robot.is_on_ice() => quiet.slip_on_ice += 1,
                Subject::WheelsAndMotion => quiet.slip_off_ice += 1,
                Subject::Wheels
                | Subject::Gyro
                | Subject::Accelerometer
                | Subject::Odometry
                | Subject::Position
                | Subject::LeftWheels
                | Subject::RightWheels
                | Subject::Motion => quiet.blamed += 1,
            }
        }
    }
    quiet
}

fn percentile(sorted: &[f64], share: f64) -> f64 {
    #[expect(
        clippy::cast_precision_loss,
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "an index into what was counted"
    )]
    let index = ((sorted.len().saturating_sub(1)) as f64 * share).round() as usize;
    sorted.get(index).copied().unwrap_or(f64::INFINITY)
}

fn case_checks(case: &Case, options: &Options) -> Vec<Check> {
    let trials = options.trials;
    let results: Vec<Trial> = (options.seed..options.seed + trials)
        .map(|seed| trial(case, options.make, u64::from(seed)))
        .collect();
    let times = |of: fn(&Trial) -> Option<f64>| {
        let mut times: Vec<f64> = results.iter().filter_map(of).collect();
        times.sort_by(f64::total_cmp);
        times
    };
    let (noticed, named) = (times(|trial| trial.noticed_s), times(|trial| trial.named_s));
    let count = |is: fn(&Trial) -> bool| {
        let found = results.iter().filter(|trial| is(trial)).count();
        u32::try_from(found).map_or(f64::INFINITY, f64::from)
    };
    let identified = count(|trial| trial.named_s.is_some()) / f64::from(trials);
    let wrong = count(|trial| trial.wrong.is_some()) / f64::from(trials);
    let (name, goals) = (case.name, case.goals);
    vec![
        Check::of(
            format!("{name}: exciting motion until noticed, p50, s"),
            percentile(&noticed, 0.5),
        )
        .at_most(goals.noticed_p50_s),
        Check::of(
            format!("{name}: exciting motion until named, p50, s"),
            percentile(&named, 0.5),
        )
        .at_most(NAMED_WITHIN_S),
        Check::of(
            format!("{name}: exciting motion until named, p95, s"),
            percentile(&named, 0.95),
        )
        .at_most(NAMED_WITHIN_S),
        Check::of(
            format!("{name}: exciting motion until named, max, s"),
            percentile(&named, 1.0),
        )
        .at_most(EXCITED_MAX_S),
        Check::of(
            format!("{name}: share of trials in which it is named"),
            identified,
        )
        .at_least(goals.named_share_min),
        Check::of(
            format!("{name}: share of trials in which another channel is blamed"),
            wrong,
        )
        .at_most(BLAMED_SHARE_MAX),
    ]
}

/// Every check.
pub(crate) fn checks(options: &Options) -> Vec<Check> {
    let mut checks: Vec<Check> = CASES
        .iter()
        .flat_map(|case| case_checks(case, options))
        .collect();
    let mut all = FaultlessRun::default();
    let mut ice = 0;
    for hour in 0..options.hours {
        let kit = Equipment {
            has_odometry: hour % 2 == 1,
            has_accelerometer: hour % 4 < 3,
            meets_ice: true,
            make: options.make,
        };
        // Of other makes there are many in an hour.
        let robots: u32 = match options.make {
            Make::Usual => 1,
            Make::Other => 12,
        };
        for robot in 0..robots {
            let seed = u64::from(options.seed + 1_000 + hour * robots + robot);
            let found = quiet(3_600.0 / f64::from(robots), seed, kit);
            all.blamed += found.blamed;
            all.slip_off_ice += found.slip_off_ice;
            ice += found.slip_on_ice;
        }
    }
    let hours = options.hours;
    checks.push(
        Check::of(
            format!("channels blamed in {hours} h without a fault, ice included"),
            f64::from(all.blamed),
        )
        .at_most(0.0),
    );
    checks.push(
        Check::of(
            format!("wheels and motion said to disagree off the ice in {hours} h"),
            f64::from(all.slip_off_ice),
        )
        .at_most(0.0),
    );
    checks.push(
        Check::of(
            format!("slip on ice said to be a disagreement in {hours} h"),
            f64::from(ice),
        )
        .at_least(1.0),
    );
    checks
}
