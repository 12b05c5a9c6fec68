//! The shipped law on the free plant, beside laws written for comparison.

#[path = "../../control/tests/common/figure_8.rs"]
mod figure_8;

use std::f64::consts::PI;

use figure_8::figure_8;
use tread_control::friction::FrictionCurve;
use tread_control::geometry::Pose;
use tread_control::plan::Plan;
use tread_control::robot::RobotModel;
use tread_control::tracking::ThetaKnowledge;
use tread_lab::bench::{CrossTrack, KanayamaGains, Law, Scenario, cross_track, husky_like};

fn curve(stiffness: f64) -> FrictionCurve {
    FrictionCurve::with_stiffness(stiffness).expect("a positive stiffness")
}

fn figure_8_run(stiffness: f64, servo_lag_s: f64, loop_s: f64, law: Law) -> CrossTrack {
    let model = RobotModel::yi2007();
    let start = Pose {
        x_m: 0.0,
        y_m: 0.0,
        heading_rad: PI / 4.0,
    };
    let plan = Plan::new(&figure_8(), start, &model).expect("a path that can be driven");
    let scenario = Scenario {
        servo_lag_s,
        loop_s,
        ..Scenario::usual(curve(stiffness))
    };
    cross_track(&plan, model, &scenario, law).expect("a valid scenario")
}

#[test]
fn the_shipped_law_is_better_than_the_tuned_peer_and_much_better_with_theta() {
    for (stiffness, share) in [(0.5, 0.4), (2.0, 0.2), (5.0, 0.1), (20.0, 0.1)] {
        let theta = 1.0 / stiffness;
        let known = ThetaKnowledge {
            theta,
            std_dev: 0.02 * theta,
        };
        let peer = [4.0, 6.0, 8.0]
            .map(|heading_1_m| KanayamaGains {
                heading_1_m,
                ..KanayamaGains::tuned()
            })
            .map(|gains| figure_8_run(stiffness, 0.05, 0.02, Law::Kanayama(gains)).rms_m)
            .into_iter()
            .fold(f64::INFINITY, f64::min);
        let without = figure_8_run(stiffness, 0.05, 0.02, Law::Shipped(None)).rms_m;
        let with = figure_8_run(stiffness, 0.05, 0.02, Law::Shipped(Some(known))).rms_m;
        assert!(
            without <= 1.02 * peer,
            "K {stiffness}: {without} m, the peer {peer} m"
        );
        assert!(
            with <= share * peer,
            "K {stiffness}: {with} m, the peer {peer} m"
        );
    }
}

#[test]
fn every_loop_rate_and_other_lags_are_stable() {
    for loop_s in [0.05, 0.02, 0.01, 0.005] {
        for servo_lag_s in [0.0, 0.05, 0.1] {
            for stiffness in [1.0, 5.0, 20.0] {
                let found = figure_8_run(stiffness, servo_lag_s, loop_s, Law::Shipped(None));
                assert!(
                    found.most_m < 0.12,
                    "{loop_s} s, lag {servo_lag_s} s, K {stiffness}: {found:?}"
                );
            }
        }
    }
}

#[test]
fn a_theta_that_is_ten_times_wrong_does_not_throw_the_robot_off() {
    for stiffness in [1.0, 5.0, 20.0] {
        for factor in [0.1, 10.0] {
            let theta = factor / stiffness;
            let wrong = ThetaKnowledge {
                theta,
                std_dev: 0.05 * theta,
            };
            let found = figure_8_run(stiffness, 0.05, 0.01, Law::Shipped(Some(wrong)));
            assert!(
                found.rms_m < 0.2,
                "K {stiffness}, {factor} times: {found:?}"
            );
        }
    }
}

#[test]
fn a_robot_of_another_size_drives_as_well() {
    let model = husky_like();
    let start = Pose {
        x_m: 0.0,
        y_m: 0.0,
        heading_rad: PI / 4.0,
    };
    let plan = Plan::new(&figure_8(), start, &model).unwrap();
    for stiffness in [1.0, 5.0, 20.0] {
        let scenario = Scenario {
            loop_s: 0.01,
            ..Scenario::usual(curve(stiffness))
        };
        let found = cross_track(&plan, model, &scenario, Law::Shipped(None)).unwrap();
        assert!(
            found.rms_m < 0.03 && found.most_m < 0.1,
            "K {stiffness}: {found:?}"
        );
    }
}
