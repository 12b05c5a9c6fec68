//! Tests the coverage of the 95 % interval for robots with individual biases.

use tread_api::friction::{NORMAL_95, ROBOT_BIAS_RATIO};

use super::tests::{at_us, measured};
use super::weights::FrictionConfig;
use super::*;

/// Total number of visits over all runs of a fleet. `examples/map_report` repeats this with more.
const VISITS: u32 = 500_000;
/// Standard deviation of one visit's θ.
const VISIT_STD_DEV: f64 = 0.02;
const THETA: f64 = 0.2;
/// Seed of the random numbers, fixed so that failures are reproducible.
const SEED: u64 = 0x5EED_0001;

/// Normally distributed random numbers (splitmix64, Box–Muller transform).
pub(super) struct Normal(pub(super) u64);

impl Normal {
    fn uniform(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut mixed = self.0;
        mixed = (mixed ^ (mixed >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        let bits = u32::try_from((mixed ^ (mixed >> 31)) >> 32).unwrap();
        (f64::from(bits) + 0.5) / 4_294_967_296.0
    }

    pub(super) fn next(&mut self) -> f64 {
        let (left, right) = (self.uniform(), self.uniform());
        (-2.0 * left.ln()).sqrt() * (std::f64::consts::TAU * right).cos()
    }
}

/// Robots that measure one piece of ground.
#[derive(Clone, Copy)]
struct Fleet {
    robots: u32,
    /// Visits of each robot.
    visits: u32,
}

/// Returns the coverage of three intervals: of a fused cell, of a fused area, and of plain sums of
/// information.
fn coverage(Fleet { robots, visits }: Fleet) -> [f64; 3] {
    let mut normal = Normal(SEED ^ u64::from(robots) << 32 ^ u64::from(visits));
    let mut held = [0; 3];
    let runs = VISITS / (robots * visits);
    let config = FrictionConfig {
        robot_bias_ratio: ROBOT_BIAS_RATIO,
        ..FrictionConfig::default()
    };
    for _ in 0..runs {
        let mut seen = Vec::new();
        let (mut information, mut weighted) = (0.0, 0.0);
        for robot in 0..robots {
            let bias = 1.0 + ROBOT_BIAS_RATIO * normal.next();
            let mut sums: Option<Sums> = None;
            for visit in 0..visits {
                let theta = THETA * bias + VISIT_STD_DEV * normal.next();
                let pass = measured(theta, VISIT_STD_DEV, i64::from(visit));
                information += VISIT_STD_DEV.powi(-2);
                weighted += VISIT_STD_DEV.powi(-2) * theta;
                match &mut sums {
                    Some(sums) => sums.add(&pass),
                    None => sums = Some(pass),
                }
            }
            seen.extend(EpochMeasurement::of(robot, 0, &sums.unwrap()));
        }
        for (held, ground) in held.iter_mut().zip([Ground::Cell, Ground::Area]) {
            let fused = fuse(&mut seen.clone(), ground, &config, at_us(0)).unwrap();
            let (low, high) = fused.theta.interval_95();
            *held += u32::from((low..=high).contains(&THETA));
        }
        let off = (weighted / information - THETA).abs();
        held[2] += u32::from(off <= NORMAL_95 / information.sqrt());
    }
    held.map(|count| f64::from(count) / f64::from(runs))
}

#[test]
fn intervals_hold_the_truth_however_robots_and_visits_are_shared_out() {
    for (robots, visits) in [(1, 50), (3, 50), (10, 50), (50, 20)] {
        let shares = coverage(Fleet { robots, visits });
        let [cell, area, naive] = shares.map(|share| 100.0 * share);
        let said = format!(
            "{robots} robots x {visits} visits: cell {cell:.1} %, area {area:.1} %, \
             summed information {naive:.1} %"
        );
        eprintln!("{said}");
        assert!(cell >= 94.0 && area >= 94.0, "{said}");
        assert!(naive < 60.0, "the bias must matter here: {said}");
    }
}
