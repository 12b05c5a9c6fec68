//! Robots of the rough world that are loaded or unloaded while they stand.

#![cfg(feature = "agent")]

use std::time::Duration;

use tread_agent::testing::Bench;
use tread_control::geometry::Pose;
use tread_lab::parallel::in_parallel;
use tread_lab::random::Random;
use tread_lab::rough::drive::RoughDrive;
use tread_lab::rough::run::Course;
use tread_lab::rough::sensors::SensorSpec;
use tread_lab::rough::spec::{Deviations, MAKES};

/// Seeds on which nothing was chosen.
const FIRST_SEED: u64 = 7_500_000;
const ROBOTS: u64 = 8;

/// Whether a robot reports a change after it stood for ten seconds, in which its payload changed.
fn reports(seed: u64, change_ratio: f64) -> bool {
    let mut random = Random::new(seed);
    let model = random
        .one_of(&MAKES)
        .expect("makes")
        .model()
        .expect("a size");
    let deviations = Deviations {
        payload_ratio: 0.2,
        ..Deviations::drawn(&mut random)
    };
    let sensors = SensorSpec::drawn(&mut random, true);
    let noise = Random::new(seed ^ 0x10ad);
    let drive = RoughDrive::new(&model, deviations, sensors, Pose::default(), noise)
        .expect("a rectangle of wheels");
    let mut bench = Bench::with_drive(drive, model);
    for mission in [1, 2] {
        bench.run_for(Duration::from_secs(10));
        let mission = bench
            .begin(mission, &Course::Figure8.trajectory(), None)
            .expect("it knows where it is");
        for _ in 0..200 {
            bench.run_for(Duration::from_secs(1));
            if bench.end_of(mission).is_some() {
                break;
            }
        }
        bench
            .drive_mut()
            .load(&model, deviations.payload_ratio + change_ratio);
    }
    bench.reports_payload_change()
}

fn count(change_ratio: f64) -> usize {
    let seeds: Vec<u64> = (FIRST_SEED..FIRST_SEED + ROBOTS).collect();
    let reported = in_parallel(&seeds, |&seed| reports(seed, change_ratio));
    reported.into_iter().filter(|reported| *reported).count()
}

#[test]
fn a_fifth_of_the_mass_put_on_or_taken_off_is_reported_and_no_change_is_not() {
    let [none, loaded, unloaded] = [0.0, 0.2, -0.2].map(count);
    // Of 30 robots: 0, 28 and 28.
    let said = format!("of {ROBOTS}: {none} unchanged, {loaded} loaded, {unloaded} unloaded");
    eprintln!("{said}");
    assert_eq!(none, 0, "{said}");
    assert!(loaded >= 7 && unloaded >= 7, "{said}");
}
