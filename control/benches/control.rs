//! Times of the parts of a tick, and of the plant.
//!
//! `cargo bench -p tread-control`; instruction counts: `cargo run --release -p tread-control
//! --example cost` says how.

mod workload;

use divan::Bencher;
use workload::{Robot, Walk};

fn main() {
    divan::main();
}

#[divan::bench]
fn tick(bencher: Bencher) {
    let mut robot = Robot::under_way(5.0);
    bencher.bench_local(move || {
        // The robot stands still in the simulation while its tick is repeated: the same work.
        robot.tick()
    });
}

#[divan::bench]
fn tick_within_a_fence_of_1000_corners(bencher: Bencher) {
    let mut robot = Robot::under_way(5.0).fenced();
    bencher.bench_local(move || robot.tick());
}

#[divan::bench]
fn tick_of_a_robot_that_is_identified(bencher: Bencher) {
    let mut robot = Robot::under_way(5.0).identified();
    bencher.bench_local(move || robot.tick());
}

#[divan::bench]
fn estimator_step(bencher: Bencher) {
    let mut robot = Robot::under_way(5.0);
    bencher.bench_local(move || robot.estimate());
}

#[divan::bench]
fn reference_sample(bencher: Bencher) {
    let mut walk = Walk::new();
    bencher.bench_local(move || walk.sample());
}

#[divan::bench(args = [0.5, 5.0, 20.0])]
fn plant_second(bencher: Bencher, stiffness: f64) {
    let mut robot = Robot::under_way(stiffness);
    bencher.bench_local(move || robot.plant_second());
}
