//! Tracking behind the shipped localisation, where it once failed.
#![cfg(feature = "agent")]

use tread_control::geometry::{Point, Pose};
use tread_control::plan::Plan;
use tread_control::tracking::TrackerConfig;
use tread_control::trajectory::{CircleSpec, Direction, Trajectory};
use tread_lab::bench::Law;
use tread_lab::rough::spec::{MAKES, Make};
use tread_lab::rough::tracking::{Errors, Poses, ThetaSource, Trial, World, run};

/// Two thirds of a circle of 3 m at 0.6 m/s.
fn circle() -> Plan {
    let circle = Trajectory::Circle(CircleSpec {
        center: Point { x_m: 0.0, y_m: 3.0 },
        radius_m: 3.0,
        speed_m_s: 0.6,
        direction: Direction::CounterClockwise,
        turns: 0.67,
    });
    let model = MAKES[0].model().expect("the makes are robots");
    Plan::new(&circle, Pose::default(), &model).expect("the circle can be driven")
}

fn ours(make: Make, world: World, poses: Poses, stiffness: f64, seed: u64) -> Errors {
    run(&Trial {
        world,
        poses,
        make,
        stiffness,
        plan: &circle(),
        seed,
        law: Law::Shipped(None),
        config: TrackerConfig::default(),
        knowing: ThetaSource::Nothing,
    })
    .expect("robot, ground and gains are possible")
}

#[test]
fn a_large_robot_whose_wheels_scrub_beyond_the_peak_does_not_swing_about_its_path() {
    let warthog = MAKES[3];
    let found = ours(warthog, World::Own, Poses::Fine, 0.7, 1);
    assert!(found.rms_m < 5.0e-3, "{found:?}");
}

#[test]
fn positions_noisier_than_assumed_are_used_and_lose_no_robot() {
    for (make, seed) in MAKES.into_iter().zip(1..) {
        let found = ours(make, World::Rough, Poses::Coarse, 3.0, seed);
        assert!(found.localisation_rms_m < 0.03, "{}: {found:?}", make.name);
        assert!(found.rms_m < 0.04, "{}: {found:?}", make.name);
    }
}
