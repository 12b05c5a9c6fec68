//! The limits of speed and acceleration, on the whole loop with the simulated base.

use std::fmt::Write as _;
use std::time::Duration;

use tread_control::geometry::Pose;
use tread_control::measured::WheelSpeeds;
use tread_control::robot::RobotModel;

use super::tests::{Teleoperator, limit};
use crate::control_loop::channels::EndReason;
use crate::drive::SensorSample;
use crate::sim::scenario::{Scenario, ScenarioText};
use crate::testing::{Bench, PERIOD, site_of};

const START: Pose = Pose {
    x_m: 0.0,
    y_m: 0.0,
    heading_rad: 0.0,
};
/// At the limit of the robot, 1 m/s, with bends.
const FAST: &str = r#"{"waypoints":{"speed_m_s":1.0,
    "points":[{"x_m":0,"y_m":0},{"x_m":8,"y_m":0},{"x_m":14,"y_m":3},{"x_m":20,"y_m":0},{"x_m":26,"y_m":0}]}}"#;
const SECOND: Duration = Duration::from_secs(1);
/// How much faster the robot truly goes than it is commanded: its rolling radii are up to 2 % off, and
/// slip that ends lets it run on.
const DRIVEN_TOLERANCE: f64 = 1.03;
/// Rounding, m/s and rad/s.
const ROUNDING: f64 = 1.0e-9;

/// Two grounds in turn, so that slip comes and goes.
fn two_grounds() -> Scenario {
    let mut text = "site = \"bench\"\ncell_m = 1.0\nrobots = []\n".to_owned();
    for stripe in 0_u8..20 {
        let from = 4.0 * f64::from(stripe) - 10.0;
        let (to, stiffness) = (from + 4.0, if stripe % 2 == 0 { 5.0 } else { 0.7 });
        let _ = write!(
            text,
            r#"
[[terrains]]
id = "stripe-{stripe}"
class = "other"
polygon = [[{from}, -50.0], [{to}, -50.0], [{to}, 50.0], [{from}, 50.0]]
stiffness = {stiffness}
"#
        );
    }
    Scenario::parse(ScenarioText {
        file: "bench",
        text: &text,
    })
    .unwrap()
}

fn bench(seed: u64) -> Bench {
    let scenario = two_grounds();
    let mut bench = Bench::new(&scenario, START, seed).unwrap();
    bench.send_site(site_of(&scenario).unwrap()).unwrap();
    bench.run_for(SECOND);
    bench
}

/// Looks at every command beside the one before it.
struct Watch {
    at: Duration,
    linear_m_s: f64,
    angular_rad_s: f64,
    fastest_m_s: f64,
    fastest_driven_m_s: f64,
}

impl Watch {
    fn of(bench: &Bench) -> Self {
        let twist = RobotModel::yi2007().twist_from_wheel_speeds(bench.core.command());
        Self {
            at: bench.now,
            linear_m_s: twist.linear_m_s,
            angular_rad_s: twist.angular_rad_s,
            fastest_m_s: 0.0,
            fastest_driven_m_s: 0.0,
        }
    }

    /// The command of the tick that has just been.
    fn look(&mut self, bench: &Bench) {
        let model = RobotModel::yi2007();
        let limits = model.limits();
        let wheels = bench.core.command();
        let twist = model.twist_from_wheel_speeds(wheels);
        let at = bench.now;
        let dt_s = at.saturating_sub(self.at).as_secs_f64();
        assert!(
            twist.linear_m_s.abs() <= limits.linear_max_m_s + ROUNDING,
            "{twist:?} at {at:?}"
        );
        assert!(
            twist.angular_rad_s.abs() <= limits.angular_max_rad_s + ROUNDING,
            "{twist:?} at {at:?}"
        );
        assert!(wheels.magnitude_max_rad_s() <= limits.wheel_speed_max_rad_s + ROUNDING);
        for (before, after, most) in [
            (
                self.linear_m_s,
                twist.linear_m_s,
                limits.linear_acceleration_max_m_s2,
            ),
            (
                self.angular_rad_s,
                twist.angular_rad_s,
                model.angular_acceleration_max_rad_s2(),
            ),
        ] {
            assert!(
                after.abs() - before.abs() <= most * dt_s + ROUNDING,
                "from {before} to {after} in {dt_s} s at {at:?}"
            );
        }
        self.at = at;
        self.linear_m_s = twist.linear_m_s;
        self.angular_rad_s = twist.angular_rad_s;
        let driven_m_s = bench.drive.truth().twist().linear_m_s.abs();
        assert!(
            driven_m_s <= DRIVEN_TOLERANCE * limits.linear_max_m_s,
            "{driven_m_s} m/s driven at {at:?}"
        );
        self.fastest_m_s = self.fastest_m_s.max(twist.linear_m_s.abs());
        self.fastest_driven_m_s = self.fastest_driven_m_s.max(driven_m_s);
    }
}

#[test]
fn a_mission_at_the_speed_limit_keeps_every_limit_whatever_disturbs_it() {
    for seed in [1, 2, 3] {
        let mut bench = bench(seed);
        let mission = bench
            .begin(1, &serde_json::from_str(FAST).unwrap(), None)
            .unwrap();
        let mut watch = Watch::of(&bench);
        let mut seq = 0;
        for tick in 0_u32..6_000 {
            match tick % 700 {
                // Somebody outside slows it and lets it go, and it makes up for that.
                300 => {
                    seq += 1;
                    limit(&bench, seq, 600_000, false, Some(0.3));
                }
                // No position for a while, then a correction.
                420..480 => bench.tick_without_position(),
                // The base is late, again and again.
                520..535 | 545..560 => bench.tick_unheard(),
                // Late ticks.
                600 | 620 => {
                    for _ in 0..12 {
                        bench.simulate();
                    }
                    bench.tick();
                }
                640 => bench.pause(mission, true).unwrap(),
                660 => bench.pause(mission, false).unwrap(),
                _ => bench.tick(),
            }
            watch.look(&bench);
            if !bench.ended.is_empty() {
                break;
            }
        }
        assert!(bench.end_of(mission).is_some(), "it did not end");
        assert!(watch.fastest_m_s > 0.95, "{} m/s", watch.fastest_m_s);
        assert!(watch.fastest_driven_m_s > 0.9);
    }
}

#[test]
fn a_base_that_falls_silent_is_not_speeded_up() {
    // In all phases of a mission: setting off, under way, in a bend.
    for drove in [3, 6, 9, 12, 20, 40, 80, 100] {
        let mut bench = bench(4);
        bench
            .begin(1, &serde_json::from_str(FAST).unwrap(), None)
            .unwrap();
        bench.run_for(drove * SECOND / 10);
        let mut watch = Watch::of(&bench);
        let silent_from = bench.now;
        let mut late = None;
        while bench.now < silent_from + SECOND {
            bench.tick_unheard();
            watch.look(&bench);
            let silent = bench.now.saturating_sub(silent_from);
            if silent > Duration::from_millis(110) {
                // Late: from here on it only slows down.
                let (linear_m_s, angular_rad_s) =
                    late.unwrap_or((watch.linear_m_s.abs(), watch.angular_rad_s.abs()));
                assert!(
                    watch.linear_m_s.abs() <= linear_m_s + ROUNDING,
                    "{silent:?}"
                );
                assert!(
                    watch.angular_rad_s.abs() <= angular_rad_s + ROUNDING,
                    "{silent:?}"
                );
                late = Some((watch.linear_m_s.abs(), watch.angular_rad_s.abs()));
            }
        }
        assert!(watch.linear_m_s.abs() <= 0.0, "it is commanded to rest");
    }
}

#[test]
fn teleoperation_keeps_every_limit_when_the_commands_reverse() {
    let mut bench = bench(5);
    let mut teleoperator = Teleoperator::acquire(&bench);
    let mut watch = Watch::of(&bench);
    for (linear_m_s, angular_rad_s) in [
        (1.0, 0.0),
        (1.0, 1.0),
        (-1.0, -1.0),
        (0.0, 2.0),
        (0.0, -2.0),
        (0.6, 0.5),
        (-0.6, 0.5),
    ] {
        for _ in 0..24 {
            teleoperator.say(&mut bench, linear_m_s, angular_rad_s, 10_000);
            for _ in 0..5 {
                bench.tick();
                watch.look(&bench);
            }
        }
    }
    // The teleoperator lets go.
    for _ in 0..150 {
        bench.tick();
        watch.look(&bench);
    }
    assert!(bench.is_standing());
    assert!(watch.fastest_m_s > 0.95);
    assert_eq!(PERIOD, Duration::from_millis(10));
}

#[test]
fn a_base_whose_feedback_is_frozen_ends_its_mission() {
    for frozen_at in [2, 4, 9] {
        let mut bench = bench(6);
        let mission = bench
            .begin(1, &serde_json::from_str(FAST).unwrap(), None)
            .unwrap();
        bench.run_for(frozen_at * SECOND);
        let model = RobotModel::yi2007();
        let truth = *bench.drive.truth();
        // Its odometry says for ever where it was then, and that it stands.
        let said = SensorSample {
            yaw_rate_rad_s: Some(0.0),
            wheel_speeds: Some(WheelSpeeds::default()),
            position: Some(truth.pose),
            ..SensorSample::default()
        };
        let mut watch = Watch::of(&bench);
        let frozen_from = bench.now;
        while bench.ended.is_empty() {
            bench.tick_frozen(said);
            watch.look(&bench);
            assert!(
                bench.now.saturating_sub(frozen_from) < 25 * SECOND,
                "still active at {:?}",
                bench.drive.truth().pose
            );
        }
        // The sensors contradict each other before the want of progress counts, which ends a mission
        // without them (`control/tests/progress.rs`).
        assert_eq!(bench.ended, [(mission, EndReason::SensorFault)]);
        let driven_m = bench
            .drive
            .truth()
            .pose
            .point()
            .distance_m(truth.pose.point());
        assert!(driven_m < 3.0, "it drove blind for {driven_m:.2} m");
        for _ in 0..200 {
            bench.tick_frozen(said);
        }
        let rests = model.twist_from_wheel_speeds(bench.core.command());
        assert!(rests.linear_m_s.abs() <= 0.0, "{rests:?}");
    }
}
