//! Tracking error of the shipped law beside the tuned Kanayama tracker with integral action.
//!
//! `cargo run --release -p tread-control --example tracking [-- --json]`
//!
//! Free four-wheel plant, 50 ms wheel lag, 50 Hz, no noise, the same reference for all; cross-track
//! error after the first half of the path. Columns: the peer (with the best heading gain of 4, 6 and
//! 8 for each line), the shipped law without θ, and with the true θ at a 2 % deviation.

#![expect(clippy::print_stdout, reason = "a program that prints a table")]

use tread_control::bench::{KanayamaGains, Law, Scenario, cross_track};
use tread_control::friction::FrictionCurve;
use tread_control::geometry::{Point, Pose};
use tread_control::plan::Plan;
use tread_control::robot::RobotModel;
use tread_control::tracking::ThetaKnowledge;
use tread_control::trajectory::{CircleSpec, Direction, Trajectory, Waypoint, WaypointsSpec};

/// (4 sin 0.15t, 2 sin 0.3t) m, twice round.
fn figure_8() -> Trajectory {
    let points = (0..=80)
        .map(|index| {
            let angle_rad = f64::from(index) / 40.0 * std::f64::consts::TAU;
            Waypoint::from(Point {
                x_m: 4.0 * angle_rad.sin(),
                y_m: 2.0 * (2.0 * angle_rad).sin(),
            })
        })
        .collect();
    Trajectory::Waypoints(WaypointsSpec {
        points,
        speed_m_s: 0.7,
    })
}

fn circle() -> Trajectory {
    Trajectory::Circle(CircleSpec {
        center: Point::default(),
        radius_m: 6.0,
        speed_m_s: 0.6,
        direction: Direction::CounterClockwise,
        turns: 2.0,
    })
}

fn main() {
    let json = std::env::args().any(|argument| argument == "--json");
    let model = RobotModel::yi2007();
    let start_8 = Pose {
        x_m: 0.0,
        y_m: 0.0,
        heading_rad: std::f64::consts::FRAC_PI_4,
    };
    let start_circle = Pose {
        x_m: 6.0,
        y_m: 0.0,
        heading_rad: std::f64::consts::FRAC_PI_2,
    };
    let mut lines = Vec::new();
    for (name, trajectory, start) in [
        ("figure-8", figure_8(), start_8),
        ("circle", circle(), start_circle),
    ] {
        let plan = Plan::new(&trajectory, start, &model).expect("the trajectory can be driven");
        for stiffness in [0.5, 1.0, 2.0, 5.0, 20.0] {
            let curve = FrictionCurve::with_stiffness(stiffness).expect("stiffness is positive");
            let scenario = Scenario {
                curve,
                servo_lag_s: 0.05,
                loop_s: 0.02,
            };
            let rms_mm = |law| {
                let found = cross_track(&plan, start, model, &scenario, law);
                1.0e3 * found.expect("the lag is in range").rms_m
            };
            let peer = [4.0, 6.0, 8.0]
                .map(|heading_1_m| KanayamaGains {
                    heading_1_m,
                    ..KanayamaGains::tuned()
                })
                .map(|gains| rms_mm(Law::Kanayama(gains)))
                .into_iter()
                .fold(f64::INFINITY, f64::min);
            let known = ThetaKnowledge {
                theta: curve.theta(),
                std_dev: 0.02 * curve.theta(),
            };
            let (without, with) = (
                rms_mm(Law::Shipped(None)),
                rms_mm(Law::Shipped(Some(known))),
            );
            if json {
                lines.push(serde_json::json!({
                    "path": name, "stiffness": stiffness, "peer_rms_mm": peer,
                    "without_theta_rms_mm": without, "with_theta_rms_mm": with,
                }));
            } else {
                println!(
                    "{name:9} K {stiffness:4}: peer {peer:7.3} mm, without θ {without:7.3} mm \
                     ({:.2}), with θ {with:7.3} mm ({:.2})",
                    without / peer,
                    with / peer
                );
            }
        }
    }
    if json {
        println!("{}", serde_json::Value::Array(lines));
    }
}
