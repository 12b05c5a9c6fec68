//! Friction curves that differ from what the prior assumes.

use super::parameters::{Number, Values};
use super::physical::Robot;
use super::regimes::Regime;
use super::tests::{SAMPLE_S, Simulated, identification};
use super::*;
use crate::estimation::TyrePrior;

/// Drives for a minute, without torque sensors.
fn drive_without_torque(identification: &mut Identification, robot: &mut Simulated) {
    drive_without_torque_for(identification, robot, 6_000);
}

fn drive_without_torque_for(
    identification: &mut Identification,
    robot: &mut Simulated,
    samples: u32,
) {
    for _ in 0..samples {
        let sample = SensorSample {
            wheel_torques: None,
            ..robot.sample()
        };
        identification.update(&sample, &SensorNoise::default(), SAMPLE_S);
    }
}

/// ln(θ̂/θ) without torque sensors on ground of K 2, its standard deviation, and the estimate of the
/// parameter `place`. `change` sets the robot's parameters, from the mean of the prior on; `assume`
/// changes the estimator's prior.
fn identified_without_torque(
    place: usize,
    change: impl Fn(&mut Values),
    assume: impl Fn(&mut Prior),
) -> (f64, f64, f64) {
    let mut robot = Simulated::new(|values| {
        values[index::STIFFNESS] = 2.0_f64.ln();
        change(values);
    });
    let mut identification = identification();
    assume(&mut identification.prior);
    identification.prior.reset();
    identification.begin(&State::rolling(Twist::default()));
    drive_without_torque(&mut identification, &mut robot);
    let found = identification.identified().expect("θ is excited");
    let std_dev = found
        .own_ratio
        .hypot(found.robot_ratio)
        .hypot(found.tyres_ratio);
    let best = identification.best().expect("a hypothesis is left");
    ((found.theta * 2.0).ln(), std_dev, best.values()[place])
}

#[test]
fn slip_relaxation_length_and_motion_resistance_that_are_others_are_identified() {
    for (place, value, least) in [
        (index::PRACTICAL_SLIP, 1.0, 0.35),
        (index::RELAXATION_DECREASE, 1.0, 0.4),
        (index::MOTION_RESISTANCE, 0.04, 0.02),
    ] {
        let change = |values: &mut Values| values[place] = value;
        let (error, std_dev, found) = identified_without_torque(place, change, |_| ());
        assert!(
            error.abs() < 1.96 * std_dev,
            "parameter {place}: {error}, {std_dev}"
        );
        assert!(found > least, "parameter {place} is {value}, found {found}");
        // Fixed at the mean of its prior.
        let (assumed, ..) =
            identified_without_torque(place, change, |prior| prior.std_devs[place] = 1.0e-4);
        assert!(
            error.abs() < assumed.abs(),
            "parameter {place}: {error}, without it {assumed}"
        );
    }
}

/// ln(θ̂/θ) of a robot on ground of K 2 whose tyres are those of a brush with a peak of 0.9, and its standard
/// deviation, with an estimator that is configured for these `tyres`.
fn identified_on_a_brush(tyres: TyrePrior) -> (f64, f64) {
    let mut robot = Simulated::new(|values| {
        values[index::STIFFNESS] = 2.0_f64.ln();
        values[index::PEAK] = 0.9_f64.ln();
        values[index::BEND] = 1.0 / 3.0;
        values[index::SHAPE] = 1.0 / 3.0;
    });
    let prior = EstimatorPrior {
        tyres,
        ..EstimatorPrior::default()
    };
    let noise = SensorNoise::default();
    let mut identification =
        Identification::new(RobotModel::yi2007(), &noise, &prior).expect("the tyres are uncertain");
    for _ in 0..2_000 {
        let sample = SensorSample {
            wheel_torques: None,
            ..robot.sample()
        };
        identification.update(&sample, &noise, SAMPLE_S);
    }
    let found = identification.identified().expect("θ is excited");
    let std_dev = found
        .own_ratio
        .hypot(found.robot_ratio)
        .hypot(found.tyres_ratio);
    ((found.theta * 2.0).ln(), std_dev)
}

#[test]
fn tyres_that_are_configured_improve_the_estimate() {
    let unknown = TyrePrior::unknown();
    let (error, std_dev) = identified_on_a_brush(unknown);
    assert!(error.abs() < 1.96 * std_dev, "{error} {std_dev}");
    let (known_error, known_std_dev) = identified_on_a_brush(TyrePrior {
        curvature: 1.0 / 2.7,
        curvature_std_dev: 0.2,
        mu_max: Some(0.4),
        ..unknown
    });
    assert!(
        known_error.abs() < 1.96 * known_std_dev,
        "{known_error} {known_std_dev}"
    );
    assert!(
        known_error.abs() < 0.5 * error.abs(),
        "{known_error} {error}"
    );
}

#[test]
fn the_parts_of_the_variance_are_those_of_the_covariance_and_of_the_model() {
    let mut robot = Simulated::new(|_| ());
    let mut identification = identification();
    for _ in 0..6_000 {
        identification.update(&robot.sample(), &SensorNoise::default(), SAMPLE_S);
    }
    let found = identification.identified().expect("θ is excited");
    assert_eq!(identification.hypotheses.len(), 1);
    let best = identification.best().expect("a hypothesis is left");
    let parts = found.own_ratio.powi(2) + found.robot_ratio.powi(2) + found.tyres_ratio.powi(2);
    let model = MODEL_LN_THETA_STD_DEV.powi(2) + (MODEL_THETA_STD_DEVS[1] / found.theta).powi(2);
    let inflation = best.scale().bend_variance_inflation(&identification.prior);
    let (variance, _) = best.variances(&identification.prior);
    let whole = variance + model + inflation;
    assert!((parts - whole).abs() < 1.0e-9, "{parts} {whole}");
    let tyres = found.tyres_ratio.powi(2) - found.tyre_prior_ratio.powi(2);
    assert!(
        (tyres - model - inflation).abs() < 1.0e-9,
        "{found:?} {model}"
    );
    assert!(found.tyre_prior_ratio > 0.0);
}

#[test]
fn the_tyres_start_from_the_independent_initial_prior_on_each_ground_and_load() {
    for begin in [Identification::begin_ground, Identification::begin_load] {
        let mut robot = Simulated::new(|_| ());
        let mut identification = identification();
        for _ in 0..2_000 {
            identification.update(&robot.sample(), &SensorNoise::default(), SAMPLE_S);
        }
        begin(&mut identification);
        let prior = &identification.prior;
        let covariance = prior.information.try_inverse().expect("a covariance");
        for place in parameters::OF_TYRES {
            for other in 0..parameters::PARAMETERS {
                let expected = if other == place {
                    prior.std_devs[place].powi(2)
                } else {
                    0.0
                };
                let found = covariance[(place, other)];
                assert!(
                    (found - expected).abs() < 1.0e-9,
                    "{place} {other}: {found}"
                );
            }
        }
    }
}

/// Standard deviation of ln θ from the tyres' prior in a segment with gentle or sharp turns, after
/// one with the others.
fn tyre_prior_ratio_of_segment(is_sharp: bool) -> f64 {
    let mut robot = Simulated::new(|values| values[index::STIFFNESS] = 0.0);
    let mut identification = identification();
    for segment in 0..2 {
        robot.turn_ratio = if is_sharp == (segment == 1) { 1.5 } else { 0.2 };
        if segment == 1 {
            identification.close_segment();
        }
        for _ in 0..2_000 {
            identification.update(&robot.sample(), &SensorNoise::default(), SAMPLE_S);
        }
    }
    let found = identification.close_segment().expect("θ is excited");
    assert!(found.tyres_ratio >= found.tyre_prior_ratio);
    found.tyre_prior_ratio
}

#[test]
fn a_segment_with_much_slip_depends_more_on_the_tyres_than_one_with_little() {
    let (gentle, sharp) = (
        tyre_prior_ratio_of_segment(false),
        tyre_prior_ratio_of_segment(true),
    );
    assert!(sharp > 1.5 * gentle, "{sharp} {gentle}");
}

#[test]
fn segments_keep_the_limits_of_the_tyres_like_the_whole_ground() {
    // Beyond theoretical slip, which is the limit.
    let mut robot = Simulated::new(|values| {
        values[index::STIFFNESS] = 0.0;
        values[index::PRACTICAL_SLIP] = -0.6;
    });
    let mut identification = identification();
    let (mut sum, mut weights) = (0.0, 0.0);
    for segment in 0..8 {
        for _ in 0..1_000 {
            let sample = SensorSample {
                wheel_torques: None,
                ..robot.sample()
            };
            identification.update(&sample, &SensorNoise::default(), SAMPLE_S);
        }
        if let Some(found) = identification.close_segment().filter(|_| segment > 1) {
            let weight = found.own_ratio.powi(-2);
            sum += weight * found.theta;
            weights += weight;
        }
    }
    let ground = identification.identified().expect("θ is excited").theta;
    let best = identification.best().expect("a hypothesis is left");
    let practical_slip = best.values()[index::PRACTICAL_SLIP];
    assert!(practical_slip < 1.0e-6, "{practical_slip}");
    let ratio = sum / weights / ground;
    assert!((ratio - 1.0).abs() < 0.03, "{ratio}");
}

#[test]
fn a_robot_that_is_held_while_its_wheels_turn_has_finite_forces() {
    let prior = parameters::prior(&EstimatorPrior::default(), &SensorNoise::default());
    let mut values = prior.mean;
    for (place, value) in [
        (index::STIFFNESS, 20.0_f64.ln()),
        (index::RELAXATION, 0.005_f64.sqrt()),
        (index::PRACTICAL_SLIP, 1.0),
        (index::RELAXATION_DECREASE, 1.0),
    ] {
        values[place] = value;
    }
    let model = RobotModel::yi2007();
    let numbers = std::array::from_fn(|place| Number::parameter(values[place], place));
    let robot = Robot::new(&numbers, &model);
    let input = Input {
        wheels_rad_s: [1.0 / model.wheel_radius_m(); 2],
        wheels_rad_s2: [0.0; 2],
        heading_rad: 0.0,
        acceleration_m_s2: [0.0; 2],
        is_specific_force: false,
        time_s: SAMPLE_S,
    };
    let held = State::rolling(Twist::default()).constants();
    let mut state = held;
    for _ in 0..1_000 {
        let output = robot.advance(&mut state, &input);
        let torque = &output.torques_n_m[0];
        let is_finite =
            torque.value.is_finite() && torque.derivatives.iter().all(|d| d.is_finite());
        assert!(is_finite, "{torque:?}");
        // Something holds the robot.
        state.speed_m_s = held.speed_m_s;
        state.turn_rad_s = held.turn_rad_s;
    }
}

/// Speed relative to that of its rims of a robot that drives straight on K 1, after so many samples of 10 ms
/// from rolling without slip, and the torque of its left side over load and wheel radius.
fn drive_straight(change: impl Fn(&mut Values), samples: u32) -> (f64, f64) {
    let prior = parameters::prior(&EstimatorPrior::default(), &SensorNoise::default());
    let mut values = prior.mean;
    for (place, value) in [
        (index::STIFFNESS, 0.0),
        // A curve that is straight far beyond the slip of the drive.
        (index::PEAK, 1.0_f64.ln()),
        (index::SHAPE, 0.05),
        (index::BEND, 0.0),
        (index::PRACTICAL_SLIP, 0.0),
    ] {
        values[place] = value;
    }
    change(&mut values);
    let model = RobotModel::yi2007();
    let robot: Robot<f64> = Robot::new(&std::array::from_fn(|place| values[place]), &model);
    let input = Input {
        wheels_rad_s: [1.0 / model.wheel_radius_m(); 2],
        wheels_rad_s2: [0.0; 2],
        heading_rad: 0.0,
        acceleration_m_s2: [0.0; 2],
        is_specific_force: false,
        time_s: SAMPLE_S,
    };
    let mut state = State::rolling(Twist {
        linear_m_s: 1.0,
        angular_rad_s: 0.0,
    });
    let mut torque_n_m = 0.0;
    for _ in 0..samples {
        torque_n_m = robot.advance(&mut state, &input).torques_n_m[0];
    }
    let load_n_m = 0.5 * robot.mass_kg * crate::robot::GRAVITY_M_S2 * model.wheel_radius_m();
    (state.speed_m_s[0], torque_n_m / load_n_m)
}

/// The speed of that robot on a slope of 10 %.
fn speed_uphill(change: impl Fn(&mut Values), samples: u32) -> f64 {
    let uphill = |values: &mut Values| {
        values[index::SLOPE_X] = 0.1;
        change(values);
    };
    drive_straight(uphill, samples).0
}

#[test]
fn steady_slip_is_relative_to_the_rim_or_to_the_centre_of_the_wheel() {
    // The force of the slope over the load is K times slip.
    let slip = 0.1;
    for (practical, expected) in [(0.0, 1.0 - slip), (1.0, 1.0 / (1.0 + slip))] {
        for decrease in [0.0, 1.0] {
            let speed = speed_uphill(
                |values| {
                    values[index::PRACTICAL_SLIP] = practical;
                    values[index::RELAXATION_DECREASE] = decrease;
                },
                1_000,
            );
            assert!(
                (speed - expected).abs() < 1.0e-4,
                "practical slip {practical}: {speed} instead of {expected}"
            );
        }
    }
}

#[test]
fn slip_follows_faster_where_the_relaxation_length_decreases_with_it() {
    let speed = |decrease: f64| {
        speed_uphill(
            |values| {
                values[index::PRACTICAL_SLIP] = 0.0;
                values[index::RELAXATION] = 0.2_f64.sqrt();
                values[index::RELAXATION_DECREASE] = decrease;
            },
            20,
        )
    };
    // Less speed is lost until the contacts hold the robot.
    assert!(speed(1.0) > speed(0.0), "{} {}", speed(1.0), speed(0.0));
}

/// θ of a robot without torque sensors on ground of this K, and the variance by which its interval is
/// inflated for the bend. The curve is `μ = Kσ/(1 + Kσ/μ_p)`, that of a
/// lumped `LuGre` contact.
fn on_lugre_tyres(stiffness: f64) -> (Identified, f64) {
    let mut robot = Simulated::new(|values| {
        values[index::STIFFNESS] = stiffness.ln();
        values[index::SHAPE] = 0.5;
        values[index::BEND] = 1.0;
    });
    let mut identification = identification();
    drive_without_torque(&mut identification, &mut robot);
    let found = identification.identified().expect("θ is excited");
    let best = identification.best().expect("a hypothesis is left");
    (
        found,
        best.scale().bend_variance_inflation(&identification.prior),
    )
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

#[test]
fn motion_resistance_takes_slip_and_torque_and_rolling_resistance_torque_alone() {
    let drive = |place: usize| {
        let change = |values: &mut Values| {
            for lost in [
                index::RESISTANCE,
                index::MOTION_RESISTANCE,
                index::GEAR_LOSS,
            ] {
                values[lost] = 0.0;
            }
            values[place] = 0.05;
        };
        let (speed_m_s, torque) = drive_straight(change, 1_000);
        (1.0 - speed_m_s, torque)
    };
    for (place, slip) in [(index::MOTION_RESISTANCE, 0.05), (index::RESISTANCE, 0.0)] {
        let (found, torque) = drive(place);
        assert!((found - slip).abs() < 1.0e-4, "{place}: slip {found}");
        assert!((torque - 0.05).abs() < 1.0e-4, "{place}: torque {torque}");
    }
}

#[test]
fn tyres_that_are_softer_or_stiffer_to_the_side_are_identified() {
    for ratio in [0.6_f64, 1.3] {
        let (error, std_dev, found) = identified_without_torque(
            index::LATERAL_STIFFNESS,
            |values| values[index::LATERAL_STIFFNESS] = ratio.ln(),
            |_| {},
        );
        assert!((found - ratio.ln()).abs() < 0.05, "{}", found.exp());
        assert!(
            error.abs() < 1.96 * std_dev && error.abs() < 0.08,
            "{ratio}: {error}, {std_dev}"
        );
        // Taken for isotropic, they look like other ground.
        let (isotropic, _, _) = identified_without_torque(
            index::LATERAL_STIFFNESS,
            |values| values[index::LATERAL_STIFFNESS] = ratio.ln(),
            |prior| prior.std_devs[index::LATERAL_STIFFNESS] = 1.0e-4,
        );
        assert!(isotropic.abs() > 3.0 * error.abs(), "{ratio}: {isotropic}");
    }
}

/// Part of the standard deviation of ln θ that tyres share, after a minute in which K is by this ratio larger
/// whenever the robot enters a turn, as if forces in transients were others than in steady motion.
fn shared_with_entries_of(stiffness_ratio: f64) -> f64 {
    let of = |stiffness: f64| {
        Simulated::new(|values| {
            values[index::STIFFNESS] = stiffness.ln();
            // So far below the peak that the curve does not matter.
            values[index::PEAK] = 0.0;
        })
    };
    let (mut robot, mut ahead) = (of(2.0), of(2.0));
    let [usual, entering] = [of(2.0).robot, of(2.0 * stiffness_ratio).robot];
    let mut identification = identification();
    for _ in 0..60 {
        let mut motion = BlockMotion::default();
        for _ in 0..100 {
            let radius_m = identification.model.wheel_radius_m();
            let rates_rad_s = wheel_speeds_rad_s(&ahead.sample());
            motion.add(rates_rad_s.map(|rate| rate * radius_m));
        }
        robot.robot = if motion.regime() == Regime::TurnEntry {
            entering
        } else {
            usual
        };
        drive_without_torque_for(&mut identification, &mut robot, 100);
    }
    let found = identification.identified().expect("θ is excited");
    found.tyres_ratio
}

#[test]
fn turn_entries_that_contradict_all_else_widen_the_interval() {
    let [consistent, contradicting] = [1.0, 1.3].map(shared_with_entries_of);
    assert!(
        contradicting > 1.2 * consistent,
        "{contradicting} {consistent}"
    );
}
