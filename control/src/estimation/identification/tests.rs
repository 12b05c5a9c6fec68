use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::physical::Robot;
use super::*;
use crate::measured::{BodyAcceleration, WheelSpeeds, WheelTorques};

pub(super) const SAMPLE_S: f64 = 0.01;

/// A robot that is as some values of the parameters say, without noise.
pub(super) struct Simulated {
    pub(super) robot: Robot<f64>,
    state: State<f64>,
    heading_rad: f64,
    acceleration_m_s2: [f64; 2],
    pub(super) is_specific_force: bool,
    /// Factor of all turns.
    pub(super) turn_ratio: f64,
    time_s: f64,
}

impl Simulated {
    pub(super) fn new(change: impl Fn(&mut parameters::Values)) -> Self {
        let mut values =
            parameters::prior(&EstimatorPrior::default(), &SensorNoise::default()).mean;
        change(&mut values);
        let values = std::array::from_fn(|place| values[place]);
        Self {
            robot: Robot::new(&values, &RobotModel::yi2007()),
            state: State::rolling(Twist::default()),
            heading_rad: 0.0,
            acceleration_m_s2: [0.0; 2],
            is_specific_force: false,
            turn_ratio: 1.0,
            time_s: 0.0,
        }
    }

    /// Wheel speeds that accelerate, and turn to both sides.
    fn wheels_rad_s(&self, time_s: f64) -> [f64; 2] {
        let mean = 7.0 * (time_s / 2.0).min(1.0) + 1.5 * (0.9 * time_s).sin();
        let half = self.turn_ratio * (2.0 * (0.5 * time_s).sin() + 0.8 * (2.3 * time_s).sin());
        [mean - half, mean + half]
    }

    pub(super) fn sample(&mut self) -> SensorSample {
        let [before, now, after] =
            [-0.5, 0.5, 1.5].map(|offset| self.wheels_rad_s(self.time_s + offset * SAMPLE_S));
        let rise = |side: usize| (after[side] - before[side]) / (2.0 * SAMPLE_S);
        let input = Input {
            wheels_rad_s: now,
            wheels_rad_s2: [rise(0), rise(1)],
            heading_rad: self.heading_rad,
            acceleration_m_s2: self.acceleration_m_s2,
            is_specific_force: self.is_specific_force,
            time_s: SAMPLE_S,
        };
        let output = self.robot.advance(&mut self.state, &input);
        self.time_s += SAMPLE_S;
        self.heading_rad += output.turn_rad_s * SAMPLE_S;
        self.acceleration_m_s2 = output.acceleration_m_s2;
        let [forward_m_s2, left_m_s2] = output.acceleration_m_s2;
        let [left_n_m, right_n_m] = output.torques_n_m;
        SensorSample {
            wheel_speeds: WheelSpeeds {
                left_rad_s: now[0],
                right_rad_s: now[1],
            },
            gyro_rad_s: output.turn_rad_s,
            is_specific_force: self.is_specific_force,
            acceleration: Some(BodyAcceleration {
                forward_m_s2,
                left_m_s2,
            }),
            body_speed_m_s: Some(output.forward_m_s),
            wheel_torques: Some(WheelTorques {
                left_n_m,
                right_n_m,
            }),
        }
    }
}

pub(super) fn identification() -> Identification {
    Identification::new(
        RobotModel::yi2007(),
        &SensorNoise::default(),
        &EstimatorPrior::default(),
    )
    .expect("the default prior is uncertain")
}

/// An identification that knows that no sensor is late.
fn with_known_delays() -> Identification {
    let mut identification = identification();
    for place in [index::GYRO_DELAY, index::ACCELEROMETER_DELAY] {
        identification.prior.std_devs[place] = 1.0e-5;
    }
    identification.prior.reset();
    identification
}

fn drive(identification: &mut Identification, robot: &mut Simulated, seconds: u32) {
    for _ in 0..seconds * 100 {
        identification.update(&robot.sample(), &SensorNoise::default(), SAMPLE_S);
    }
}

#[test]
fn a_robot_with_payload_on_bent_tyres_is_identified_on_any_ground() {
    for stiffness in [0.5_f64, 2.0, 8.0, 20.0] {
        let mut robot = Simulated::new(|values| {
            values[index::STIFFNESS] = stiffness.ln();
            values[index::MASS] = 1.25_f64.ln();
            values[index::PEAK] = 0.4_f64.ln();
            values[index::RELAXATION] = 0.05_f64.sqrt();
            values[index::SLOPE_X] = 0.05;
        });
        let mut identification = identification();
        drive(&mut identification, &mut robot, 30);
        let found = identification.identified().expect("θ is excited");
        let error = (found.theta * stiffness).ln();
        let own = found.own_ratio.hypot(found.robot_ratio);
        // At K 20 and a peak of 0.4 these turns slide nearly all the time.
        assert!(
            error.abs() < 0.15 || stiffness > 8.0,
            "K {stiffness}: {error}"
        );
        assert!(
            error.abs() < 1.96 * own.hypot(found.tyres_ratio),
            "K {stiffness}: {error}, {own}"
        );
    }
}

#[test]
fn a_robot_that_stands_or_came_a_moment_ago_says_nothing() {
    let mut standing = identification();
    let sample = SensorSample {
        acceleration: Some(BodyAcceleration::default()),
        ..SensorSample::default()
    };
    for _ in 0..6_000 {
        standing.update(&sample, &SensorNoise::default(), SAMPLE_S);
    }
    assert_eq!(standing.identified(), None);
    let mut identification = identification();
    drive(&mut identification, &mut Simulated::new(|_| ()), 4);
    assert_eq!(identification.identified(), None);
}

#[test]
fn new_ground_forgets_its_friction_and_keeps_the_robots_mass() {
    let ground = |stiffness: f64| {
        move |values: &mut parameters::Values| {
            values[index::STIFFNESS] = stiffness.ln();
            values[index::MASS] = 1.3_f64.ln();
        }
    };
    let mut identification = identification();
    drive(&mut identification, &mut Simulated::new(ground(6.0)), 40);
    let mass_before = identification.prior.information[(index::MASS, index::MASS)];
    identification.begin_ground();
    assert_eq!(identification.identified(), None);
    let prior = &identification.prior;
    assert!(prior.information[(index::MASS, index::MASS)] > mass_before);
    assert!((prior.mean[index::MASS] - 1.3_f64.ln()).abs() < 0.05);
    assert!(prior.mean[index::STIFFNESS] < 2.0);
    drive(&mut identification, &mut Simulated::new(ground(1.0)), 30);
    let found = identification.identified().expect("θ is excited");
    assert!((found.theta - 1.0).abs() < 0.15, "{}", found.theta);
}

#[test]
fn a_gyro_that_froze_leads_to_no_theta_or_to_a_wide_interval() {
    let mut identification = identification();
    let mut robot = Simulated::new(|_| ());
    for tick in 0..4_000 {
        let mut sample = robot.sample();
        if tick > 500 {
            sample.gyro_rad_s = 0.3;
        }
        identification.update(&sample, &SensorNoise::default(), SAMPLE_S);
    }
    let prior = parameters::prior(&EstimatorPrior::default(), &SensorNoise::default());
    let truth = (-prior.mean[index::STIFFNESS]).exp();
    if let Some(found) = identification.identified() {
        let ratio = found
            .own_ratio
            .hypot(found.robot_ratio.hypot(found.tyres_ratio));
        let error = (found.theta / truth).ln();
        assert!(error.abs() < 1.96 * ratio, "{error} of {ratio}");
    }
}

#[test]
fn samples_that_stop_and_come_again_do_not_matter() {
    let mut identification = identification();
    let mut robot = Simulated::new(|values| values[index::STIFFNESS] = 2.0_f64.ln());
    for round in 0..6 {
        drive(&mut identification, &mut robot, 7);
        // The robot goes on, unseen.
        for _ in 0..50 * (round % 3) {
            robot.sample();
        }
        identification.interrupt();
    }
    let found = identification.identified().expect("θ is excited");
    assert!((found.theta - 0.5).abs() < 0.1, "{}", found.theta);
}

pub(super) fn with_stiffness(stiffness: f64) -> Simulated {
    Simulated::new(|values| {
        values[index::STIFFNESS] = stiffness.ln();
        values[index::MASS] = 1.2_f64.ln();
    })
}

#[test]
fn segments_hold_theta_and_their_mean_is_that_of_the_whole_ground() {
    let mut identification = identification();
    let mut robot = with_stiffness(3.0);
    drive(&mut identification, &mut robot, 10);
    identification.close_segment();
    let (mut information, mut weighted) = (0.0, 0.0);
    for seconds in [3, 7, 5, 12, 4, 9] {
        drive(&mut identification, &mut robot, seconds);
        let segment = identification.close_segment().expect("turns tell θ");
        assert!((segment.duration_s - f64::from(seconds)).abs() < 1.1);
        let error = (segment.theta * 3.0).ln();
        let ratio = segment.own_ratio.hypot(segment.robot_ratio);
        assert!(error.abs() < 2.0 * ratio, "{error} of {segment:?}");
        let weight = (segment.own_ratio * segment.theta).powi(-2);
        information += weight;
        weighted += weight * segment.theta;
    }
    let whole = identification.identified().expect("θ is excited");
    let difference = (weighted / information / whole.theta).ln();
    assert!(difference.abs() < 0.02, "{difference}");
    assert_eq!(identification.close_segment(), None, "it has no blocks");
}

#[test]
fn the_last_block_before_a_change_of_the_ground_counts_for_no_segment() {
    let theta = |seconds: u32, is_dropped: bool| {
        let mut identification = with_known_delays();
        let mut robot = with_stiffness(4.0);
        drive(&mut identification, &mut robot, 10);
        identification.close_segment();
        drive(&mut identification, &mut robot, 4);
        robot.robot.stiffness = 0.5;
        drive(&mut identification, &mut robot, seconds);
        if is_dropped {
            identification.drop_last_block();
        }
        let segment = identification.close_segment().expect("turns tell θ");
        assert!((segment.duration_s - f64::from(4 + seconds - u32::from(is_dropped))).abs() < 0.1);
        segment.theta
    };
    let (before, with, without) = (theta(0, false), theta(1, false), theta(1, true));
    let (of_block, left) = ((with / before).ln(), (without / before).ln());
    assert!(of_block > 0.02, "{of_block}: the block must matter");
    assert!(left.abs() < 0.1 * of_block, "{left} of {of_block}");
}

/// Noise of the default sensors.
pub(super) fn with_noise(sample: SensorSample, random: &mut impl RngExt) -> SensorSample {
    let noise = SensorNoise::default();
    // The sum of twelve uniform values has a variance of 1.
    let mut normal =
        |std_dev: f64| (0..12).map(|_| random.random::<f64>() - 0.5).sum::<f64>() * std_dev;
    SensorSample {
        gyro_rad_s: sample.gyro_rad_s + normal(noise.gyro_rad_s),
        acceleration: sample.acceleration.map(|acceleration| BodyAcceleration {
            forward_m_s2: acceleration.forward_m_s2 + normal(noise.accelerometer_m_s2),
            left_m_s2: acceleration.left_m_s2 + normal(noise.accelerometer_m_s2),
        }),
        body_speed_m_s: sample
            .body_speed_m_s
            .map(|speed| speed + normal(noise.body_speed_m_s)),
        ..sample
    }
}

#[test]
fn an_estimate_with_little_information_keeps_it_and_gets_more() {
    let mut estimates = 0;
    for seed in 0..8 {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let mut robot = Simulated::new(|values| {
            values[index::STIFFNESS] = 12.0_f64.ln();
            values[index::PEAK] = 0.35_f64.ln();
        });
        let mut identification = with_known_delays();
        for _ in 0..6_000 {
            let mut sample = with_noise(robot.sample(), &mut random);
            sample.wheel_torques = None;
            identification.update(&sample, &SensorNoise::default(), SAMPLE_S);
        }
        let Some(found) = identification.identified() else {
            continue;
        };
        let own = found.own_ratio.hypot(found.robot_ratio);
        let error = (found.theta * 12.0).ln();
        assert!(error.abs() < 1.96 * own, "seed {seed}: {error} of {own}");
        estimates += u32::from(own < 0.3);
    }
    // Turns slide most of the time, and only what all of them tell together is enough.
    assert!(estimates >= 7, "{estimates} of 8");
}

#[test]
fn the_variance_of_an_estimate_that_moved_far_is_that_of_the_blocks_that_are_left() {
    let mut moved = 0;
    for stiffness in [0.5_f64, 6.0, 18.4] {
        for seed in 0..4 {
            let mut random = ChaCha8Rng::seed_from_u64(seed);
            let mut robot = with_stiffness(stiffness);
            let mut identification = identification();
            for tick in 1..=1_500 {
                let mut sample = with_noise(robot.sample(), &mut random);
                sample.wheel_torques = None;
                identification.update(&sample, &SensorNoise::default(), SAMPLE_S);
                if tick % 100 != 50 || tick < 100 {
                    continue;
                }
                for hypothesis in &identification.hypotheses {
                    let prior = &identification.prior;
                    let (reported, _) = hypothesis.variances(prior);
                    let [left] = hypothesis
                        .variances_of(prior, &[parameters::ln_stiffness_gradient()])
                        .expect("the prior is proper");
                    let ratio = (reported / left).sqrt();
                    assert!(
                        ratio > 0.9,
                        "K {stiffness}, {tick}: {ratio} of what is left"
                    );
                    moved += u32::from(hypothesis.weight_factor() < 0.5);
                }
            }
        }
    }
    assert!(moved > 20, "{moved} far moves");
}

/// Returns the mean of two samples, whose wheel speeds have the errors of a filter or an analogue
/// sensor: each sample has its own.
fn noisy(samples: [SensorSample; 2], std_dev_rad_s: f64, random: &mut impl RngExt) -> SensorSample {
    let [first, second] = samples;
    let mean = |of: fn(&SensorSample) -> f64| 0.5 * (of(&first) + of(&second));
    // The sum of twelve uniform values has a variance of 1.
    let mut noise = || (0..12).map(|_| random.random::<f64>() - 0.5).sum::<f64>() * std_dev_rad_s;
    SensorSample {
        wheel_speeds: WheelSpeeds {
            left_rad_s: mean(|of| of.wheel_speeds.left_rad_s) + noise(),
            right_rad_s: mean(|of| of.wheel_speeds.right_rad_s) + noise(),
        },
        gyro_rad_s: mean(|of| of.gyro_rad_s),
        acceleration: Some(BodyAcceleration {
            forward_m_s2: mean(|of| of.acceleration.map_or(0.0, |of| of.forward_m_s2)),
            left_m_s2: mean(|of| of.acceleration.map_or(0.0, |of| of.left_m_s2)),
        }),
        wheel_torques: Some(WheelTorques {
            left_n_m: mean(|of| of.wheel_torques.map_or(0.0, |of| of.left_n_m)),
            right_n_m: mean(|of| of.wheel_torques.map_or(0.0, |of| of.right_n_m)),
        }),
        ..second
    }
}

/// Returns ln of the estimated over the true θ after 40 s with white noise of the wheel speeds, and
/// its standard deviation; None without an estimate. `samples` are averaged in each of the
/// sensor's.
fn error_with_noise(
    stiffness: f64,
    (samples, std_dev_rad_s): (u16, f64),
    seed: u64,
) -> Option<(f64, f64)> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut robot = with_stiffness(stiffness);
    let mut identification = identification();
    for _ in 0..4_000 / samples {
        let first = robot.sample();
        let second = if samples == 2 { robot.sample() } else { first };
        let sample = noisy([first, second], std_dev_rad_s, &mut random);
        let time_s = f64::from(samples) * SAMPLE_S;
        identification.update(&sample, &SensorNoise::default(), time_s);
    }
    let found = identification.identified()?;
    let own = found.own_ratio.hypot(found.robot_ratio);
    Some(((found.theta * stiffness).ln(), own.hypot(found.tyres_ratio)))
}

#[test]
fn white_noise_of_the_wheel_speeds_is_not_taken_for_slip() {
    const SEEDS: u32 = 16;
    for (stiffness, bias_max) in [(1.0_f64, 0.02), (4.0, 0.06), (12.0, 0.08)] {
        for noise in [(1, 0.02), (1, 0.05), (2, 0.02)] {
            let case = format!("K {stiffness}, {noise:?}");
            let (mut sum, mut count, mut covered) = (0.0, 0, 0);
            for seed in 0..SEEDS {
                let Some((error, std_dev)) = error_with_noise(stiffness, noise, seed.into()) else {
                    continue;
                };
                sum += error;
                count += 1;
                covered += u32::from(error.abs() < 1.96 * std_dev);
            }
            assert!(count >= SEEDS - SEEDS / 8, "{case}: {count} estimates");
            assert_eq!(covered, count, "{case}: an interval without θ");
            let bias = sum / f64::from(count);
            assert!(bias.abs() < bias_max, "{case}: {bias}");
        }
    }
}

#[test]
fn starting_values_compete_for_longer_where_none_of_them_fits() {
    let remaining = |shaking_m_s2: f64| {
        let mut random = ChaCha8Rng::seed_from_u64(5);
        let mut robot = Simulated::new(|values| {
            values[index::STIFFNESS] = 18.4_f64.ln();
            values[index::PEAK] = 0.35_f64.ln();
        });
        let mut identification = identification();
        for tick in 0..650 {
            let mut sample = with_noise(robot.sample(), &mut random);
            let sign = if tick % 14 < 7 { 1.0 } else { -1.0 };
            if let Some(acceleration) = &mut sample.acceleration {
                acceleration.forward_m_s2 += sign * shaking_m_s2;
                acceleration.left_m_s2 -= sign * shaking_m_s2;
            }
            if let Some(torques) = &mut sample.wheel_torques {
                torques.left_n_m *= 1.0 + 0.3 * sign * shaking_m_s2;
            }
            identification.update(&sample, &SensorNoise::default(), SAMPLE_S);
        }
        let square = identification.residual_square();
        (identification.hypotheses.len(), square)
    };
    let (count, square) = remaining(0.0);
    assert!(count == 1 && square < 1.5, "{count} at {square}");
    let (count, square) = remaining(0.6);
    assert!(count > 1 && square > 9.0, "{count} at {square}");
}
