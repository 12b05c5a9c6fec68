//! Friction curves that differ from what the prior assumes.

use super::tests::{SAMPLE_S, Simulated, identification};
use super::*;

/// θ of a robot without torque sensors on ground of this K, and the tyres' part of its relative
/// variance beyond the error that all estimates share. The curve is `μ = Kσ/(1 + Kσ/μ_p)`, that of a
/// `LuGre` contact without length.
fn on_lugre_tyres(stiffness: f64) -> (Identified, f64) {
    let mut robot = Simulated::new(|values| {
        values[index::STIFFNESS] = stiffness.ln();
        values[index::SHAPE] = 0.5;
        values[index::BEND] = 1.0;
    });
    let mut identification = identification();
    for _ in 0..6_000 {
        let sample = SensorSample {
            wheel_torques: None,
            ..robot.sample()
        };
        identification.update(&sample, &SensorNoise::default(), SAMPLE_S);
    }
    let found = identification.identified().expect("θ is excited");
    let shared = MODEL_LN_THETA_STD_DEV.hypot(MODEL_THETA_STD_DEVS[0] / found.theta);
    (found, found.tyres_ratio.powi(2) - shared.powi(2))
}

#[test]
fn the_interval_contains_more_bent_tyres_where_the_drive_does_not_show_the_bend() {
    let mut last = 0.0;
    for stiffness in [0.7, 3.0] {
        let (found, of_bend) = on_lugre_tyres(stiffness);
        let error = (found.theta * stiffness).ln();
        let std_dev = found
            .own_ratio
            .hypot(found.robot_ratio)
            .hypot(found.tyres_ratio);
        assert!(
            error.abs() < 1.96 * std_dev,
            "K {stiffness}: {error}, {found:?}"
        );
        assert!(of_bend > last, "K {stiffness}: {of_bend}");
        last = of_bend;
    }
}
