use super::*;

fn filter() -> Localisation {
    Localisation::new(RobotModel::yi2007(), LocalisationNoise::default())
}

fn fix(x_m: f64, y_m: f64) -> PositionFix {
    PositionFix {
        pose: Pose {
            x_m,
            y_m,
            heading_rad: 0.0,
        },
        age_s: 0.0,
        noise: None,
    }
}

fn straight(speed_rad_s: f64) -> SensorSample {
    SensorSample {
        wheel_speeds: crate::measured::WheelSpeeds {
            left_rad_s: speed_rad_s,
            right_rad_s: speed_rad_s,
        },
        ..SensorSample::default()
    }
}

#[test]
fn nothing_is_known_before_the_first_fix() {
    let mut filter = filter();
    filter.predict(&SensorSample::default(), 0.01);
    assert!(filter.pose().is_none() && filter.fix_age_s().is_infinite());
    assert_eq!(filter.correct(&fix(1.0, 2.0)), FixOutcome::Started);
    assert!((filter.pose().unwrap().x_m - 1.0).abs() < 1.0e-12);
}

#[test]
fn a_fix_that_cannot_be_true_is_refused_until_it_insists() {
    let mut filter = filter();
    filter.correct(&fix(0.0, 0.0));
    for _ in 1..REFUSED_MAX {
        filter.predict(&SensorSample::default(), 0.05);
        assert_eq!(filter.correct(&fix(50.0, 0.0)), FixOutcome::Outlier);
        assert!(filter.pose().unwrap().x_m.abs() < 0.01);
    }
    filter.predict(&SensorSample::default(), 0.05);
    assert_eq!(filter.correct(&fix(50.0, 0.0)), FixOutcome::Restarted);
    assert!((filter.pose().unwrap().x_m - 50.0).abs() < 1.0e-9);
}

#[test]
fn after_a_silence_a_fix_is_believed_as_far_as_the_robot_can_have_come() {
    let speed_m_s = 0.5;
    let speed_rad_s = speed_m_s / RobotModel::yi2007().wheel_radius_m();
    let driven = |is_silence_known: bool, speed_rad_s: f64, jump_m: f64| {
        let mut filter = filter();
        filter.correct(&fix(0.0, 0.0));
        for _ in 0..20 {
            filter.predict(&straight(speed_rad_s), 0.05);
            let x_m = filter.pose().unwrap().x_m;
            filter.correct(&fix(x_m, 0.0));
        }
        let x_m = filter.pose().unwrap().x_m;
        if is_silence_known {
            filter.widen_without_measurements(1.5);
        }
        filter.predict(&straight(0.0), 0.2);
        filter.correct(&fix(x_m + jump_m, 0.0))
    };
    assert_eq!(driven(true, speed_rad_s, 0.3), FixOutcome::Fused);
    assert_eq!(driven(false, speed_rad_s, 0.3), FixOutcome::Outlier);
    assert_eq!(driven(true, speed_rad_s, 50.0), FixOutcome::Outlier);
    assert_eq!(driven(true, 0.0, 0.3), FixOutcome::Outlier);
}

#[test]
fn a_fix_weighs_by_its_own_standard_deviation() {
    let moved_by = |position_m: f64| {
        let mut filter = filter();
        filter.correct(&fix(0.0, 0.0));
        filter.predict(&SensorSample::default(), 0.05);
        let mut fix = fix(0.02, 0.0);
        fix.noise = Some(FixNoise {
            position_m,
            heading_rad: 0.01,
        });
        let outcome = filter.correct(&fix);
        (outcome, filter.pose().unwrap().x_m)
    };
    let (_, by_good) = moved_by(0.005);
    let (_, by_poor) = moved_by(0.1);
    assert!(by_good > 0.015 && by_poor < 0.001, "{by_good} {by_poor}");
    assert_eq!(moved_by(f64::NAN).0, FixOutcome::Invalid);
    assert_eq!(moved_by(0.0).0, FixOutcome::Invalid);
}

/// Drives straight for a second with fixes of this age, and returns the standard deviation of the position.
fn std_dev_with_fixes_of_age(age_s: f64) -> f64 {
    let mut filter = filter();
    for tick in 0..500 {
        filter.predict(&straight(6.0), 0.01);
        if tick % 10 == 0 {
            let ahead = filter.pose().unwrap_or_default();
            let mut fix = fix(ahead.x_m, ahead.y_m);
            fix.pose.x_m -= filter.twist().linear_m_s * age_s;
            fix.age_s = age_s;
            filter.correct(&fix);
        }
    }
    filter.position_std_dev_m()
}

#[test]
fn late_fixes_leave_a_less_certain_position() {
    let prompt_m = std_dev_with_fixes_of_age(0.0);
    let late_m = std_dev_with_fixes_of_age(0.2);
    let half_a_second_m = std_dev_with_fixes_of_age(0.5);
    assert!(late_m > 1.05 * prompt_m, "{late_m} {prompt_m}");
    assert!(half_a_second_m > 1.1 * late_m, "{half_a_second_m} {late_m}");
}

#[test]
fn a_fix_from_before_a_turn_agrees_with_the_filter_in_the_turn() {
    let mut filter = filter();
    filter.correct(&fix(0.0, 0.0));
    for _ in 0..100 {
        filter.predict(&straight(6.0), 0.01);
    }
    let before = filter.pose().unwrap();
    let mut turning = straight(6.0);
    turning.gyro_rad_s = 1.0;
    for _ in 0..20 {
        filter.predict(&turning, 0.01);
    }
    let predicted = filter.pose().unwrap();
    let outcome = filter.correct(&PositionFix {
        pose: before,
        age_s: 0.2,
        noise: None,
    });
    let corrected = filter.pose().unwrap();
    assert_eq!(outcome, FixOutcome::Fused);
    let moved_m = (corrected.x_m - predicted.x_m).hypot(corrected.y_m - predicted.y_m);
    assert!(moved_m < 1.0e-6, "{moved_m}");
}

#[test]
fn samples_that_are_no_numbers_are_counted_and_do_no_harm() {
    let mut filter = filter();
    filter.correct(&fix(0.0, 0.0));
    let mut sample = straight(f64::INFINITY);
    sample.gyro_rad_s = f64::NAN;
    filter.predict(&sample, 0.01);
    assert_eq!(filter.correct(&fix(f64::NAN, 0.0)), FixOutcome::Invalid);
    assert_eq!(filter.invalid(), 3);
    assert!(filter.pose().unwrap().is_finite());
    assert!((filter.fix_age_s() - 0.01).abs() < 1.0e-12);
}
