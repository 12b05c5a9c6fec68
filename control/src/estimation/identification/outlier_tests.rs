//! Blocks whose residuals are larger than those of others.

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use super::tests::{SAMPLE_S, Simulated, identification, with_noise, with_stiffness};
use super::*;

#[test]
fn a_jolt_does_not_make_it_forget() {
    let mut random = ChaCha8Rng::seed_from_u64(5);
    let mut robot = with_stiffness(4.0);
    let mut identification = identification();
    let drive = |identification: &mut Identification,
                 robot: &mut Simulated,
                 random: &mut ChaCha8Rng,
                 jolt_m_s2: f64,
                 samples: u32| {
        for tick in 0..samples {
            let mut sample = with_noise(robot.sample(), random);
            sample.wheel_torques = None;
            let sign = if tick % 20 < 10 { 1.0 } else { -1.0 };
            if let Some(acceleration) = &mut sample.acceleration {
                acceleration.forward_m_s2 += sign * jolt_m_s2;
                acceleration.left_m_s2 -= sign * jolt_m_s2;
            }
            identification.update(&sample, &SensorNoise::default(), SAMPLE_S);
        }
    };
    drive(&mut identification, &mut robot, &mut random, 0.0, 6_000);
    let before = identification.identified().expect("θ is excited");
    // As the chassis feels a stop within a moment.
    drive(&mut identification, &mut robot, &mut random, 3.0, 30);
    drive(&mut identification, &mut robot, &mut random, 0.0, 200);
    let after = identification
        .identified()
        .expect("one jolt is not the ground");
    assert!(
        after.own_ratio < 2.0 * before.own_ratio,
        "{} before, {} after",
        before.own_ratio,
        after.own_ratio
    );
    assert!((after.theta / before.theta).ln().abs() < 0.1);
}

#[test]
fn what_the_first_blocks_miss_is_no_scatter_of_measurements() {
    let mut random = ChaCha8Rng::seed_from_u64(11);
    let mut robot = Simulated::new(|values| {
        for (place, value) in [
            (index::STIFFNESS, 5.5_f64.ln()),
            (index::INERTIA, 0.2),
            (index::HEIGHT, 0.6),
            (index::RELAXATION, 0.011_f64.sqrt()),
            (index::CENTRE_FORWARD, 0.06),
            (index::MOTION_RESISTANCE, 0.03),
            (index::SHAPE, 0.05),
            (index::BEND, 0.0),
        ] {
            values[place] = value;
        }
    });
    let mut identification = identification();
    for _ in 0..2_000 {
        let mut sample = with_noise(robot.sample(), &mut random);
        sample.wheel_torques = None;
        identification.update(&sample, &SensorNoise::default(), SAMPLE_S);
    }
    let best = identification.best().expect("a hypothesis is left");
    let (variance, _) = best.variances(&identification.prior);
    let nominal = best.scale().nominal_variance();
    assert!(variance < 2.0 * nominal, "{variance}, nominal {nominal}");
}

#[test]
fn a_change_of_the_ground_that_is_not_detected_is_followed() {
    let mut random = ChaCha8Rng::seed_from_u64(12);
    let mut robot = with_stiffness(5.0);
    let mut identification = identification();
    let mut drive = |robot: &mut Simulated, seconds: u32| {
        for _ in 0..seconds * 100 {
            let mut sample = with_noise(robot.sample(), &mut random);
            sample.wheel_torques = None;
            identification.update(&sample, &SensorNoise::default(), SAMPLE_S);
        }
        let found = identification.identified().expect("θ is excited");
        let shared = found.robot_ratio.hypot(found.tyres_ratio);
        (found.theta.ln(), found.own_ratio.hypot(shared))
    };
    let (ln_theta, _) = drive(&mut robot, 60);
    assert!((ln_theta + 5.0_f64.ln()).abs() < 0.3, "{ln_theta}");
    robot.robot.stiffness = 1.0;
    robot.robot.per_peak_slip = robot.robot.peak.recip();
    let (ln_theta, std_dev) = drive(&mut robot, 15);
    assert!(ln_theta.abs() < 1.96 * std_dev, "{ln_theta}, {std_dev}");
    assert!(ln_theta.abs() < 0.3, "{ln_theta}");
}
