//! Section IV of the paper, run again: tables (CSV) and plots (SVG) of its Fig. 5, 6 and 7.
//!
//! `cargo run --release -p tread-lab --no-default-features --bin paper [-- --json | --markdown]`
//!
//! Writes to `target/paper/`. With `--json` it prints one object with `checks`, with
//! `--markdown` tables; the process fails if one does not hold.

#![expect(clippy::print_stdout, reason = "a program that prints a report")]

mod svg;

use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::Context as _;
use nalgebra::Vector2;
use svg::{Curve, Plot};
use tread_control::friction::FrictionCurve;
use tread_control::geometry::Pose;
use tread_control::measured::WheelSpeeds;
use tread_control::plant::{Ground, Plant, PlantSpec, PlantState};
use tread_control::robot::RobotModel;
use tread_lab::paper::law::DesiredPoint;
use tread_lab::paper::reduced::Reduced;
use tread_lab::paper::{ClosedLoop, ClosedLoopState, Setting, Yi2007, Yi2007Config};
use tread_lab::report::{Check, checks_json, checks_markdown};

const STEP_S: f64 = 1.0e-3;
/// Steps between two lines of a table.
const EVERY: u32 = 100;
const DURATION_S: u32 = 120;
/// Lines of the tables of which the Markdown table has one: every 10 s.
const MARKDOWN_EVERY: usize = 100;

/// One line of the tables of Fig. 6 and 7.
struct Row {
    state: ClosedLoopState,
    point: [f64; 2],
    desired: [f64; 2],
    error: [f64; 2],
    lyapunov: f64,
}

/// One line of the table of Fig. 5.
struct CircleRow {
    time_s: f64,
    constrained: [f64; 2],
    free: [f64; 2],
}

fn main() -> anyhow::Result<ExitCode> {
    let is_asked = |flag: &str| std::env::args().skip(1).any(|argument| argument == flag);
    let (json, markdown) = (is_asked("--json"), is_asked("--markdown"));
    let target =
        std::env::var_os("CARGO_TARGET_DIR").map_or_else(|| "target".into(), PathBuf::from);
    let folder = target.join("paper");
    fs::create_dir_all(&folder).with_context(|| format!("cannot create `{}`", folder.display()))?;
    let (rows, lyapunov_rise) = track_circle()?;
    write_tracking(&folder, &rows)?;
    let circle = drive_circle()?;
    write_circle(&folder, &circle)?;
    let checks = checks(&rows, lyapunov_rise);
    let radii_m = [
        radius_m(&circle, |row| row.constrained),
        radius_m(&circle, |row| row.free),
    ];
    if json {
        let folder = folder.display().to_string();
        let checks = checks_json(&checks);
        println!(
            "{}",
            serde_json::json!({ "folder": folder, "checks": checks })
        );
    } else if markdown {
        print!("{}", markdown_of(&rows, radii_m, &checks));
    } else {
        println!("tables and plots are in `{}`", folder.display());
        println!(
            "Fig. 5 at 60 and 120 rpm: radius {:.3} m with S imposed, {:.3} m on the free base",
            radii_m[0], radii_m[1]
        );
        for check in &checks {
            println!(
                "{:44} {:>12}  goal {:20} {}",
                check.name,
                check.figure(6),
                check.goal,
                check.verdict()
            );
        }
    }
    Ok(if checks.iter().all(|check| check.holds) {
        ExitCode::SUCCESS
    } else {
        ExitCode::FAILURE
    })
}

/// The figures as tables: Fig. 5, a line of Fig. 6 and 7 every 10 s, and the checks.
fn markdown_of(rows: &[Row], radii_m: [f64; 2], checks: &[Check]) -> String {
    let [imposed_m, free_m] = radii_m;
    let mut text = format!(
        "| Fig. 5, 60 and 120 rpm | radius m |\n|---|---|\n| S imposed | {imposed_m:.3} |\n\
         | free base | {free_m:.3} |\n\n\
         | time s | \\|ε\\| m | V | forward m/s | lateral m/s | ζ | θ̂ |\n|---|---|---|---|---|---|---|\n"
    );
    for row in rows.iter().step_by(MARKDOWN_EVERY) {
        let (state, error_m) = (&row.state, row.error[0].hypot(row.error[1]));
        let _ = writeln!(
            text,
            "| {:.0} | {error_m:.4} | {:.4} | {:.4} | {:.4} | {:.4} | {:.4} |",
            state.time_s, row.lyapunov, state.forward_m_s, state.left_m_s, state.zeta, state.theta
        );
    }
    text.push('\n');
    text.push_str(&checks_markdown(checks));
    text
}

/// Fig. 6 and 7: the law on the reduced model. Also the largest rise of V in a step.
fn track_circle() -> anyhow::Result<(Vec<Row>, f64)> {
    let law = Yi2007::new(Yi2007Config::section_iv())?;
    let start = ClosedLoopState::section_iv();
    let mut run = ClosedLoop::new(law, 5.0, DesiredPoint::section_iv, start)?;
    let mut rows = Vec::new();
    let (mut before, mut rise) = (run.lyapunov()?, f64::NEG_INFINITY);
    for step in 0..=DURATION_S * 1000 {
        if step > 0 {
            run.step(STEP_S)?;
            let now = run.lyapunov()?;
            rise = rise.max(now - before);
            before = now;
        }
        if step % EVERY == 0 {
            let state = *run.state();
            let point = law.point(state.pose);
            let desired = DesiredPoint::section_iv(state.time_s).position;
            rows.push(Row {
                state,
                point: [point.x_m, point.y_m],
                desired: [desired.x, desired.y],
                error: run.output()?.error.into(),
                lyapunov: before,
            });
        }
    }
    Ok((rows, rise))
}

/// Fig. 5: constant wheel speeds of 60 and 120 rpm, on the constrained and on the free base.
fn drive_circle() -> anyhow::Result<Vec<CircleRow>> {
    let rpm = std::f64::consts::TAU / 60.0;
    let wheels = WheelSpeeds {
        left_rad_s: 60.0 * rpm,
        right_rad_s: 120.0 * rpm,
    };
    let model = RobotModel::yi2007();
    let curve = FrictionCurve::with_stiffness(5.0)?;
    let reduced = Reduced::new(Setting { model, curve }, 0.167)?;
    let start_m_s = model.twist_from_wheel_speeds(wheels).linear_m_s;
    let spec = PlantSpec::default();
    let mut plant = Plant::new(model, spec, Pose::default())?;
    plant.set_state(PlantState {
        forward_m_s: start_m_s,
        wheel_speeds: wheels,
        ..PlantState::default()
    });
    let ground = Ground::uniform(curve);
    let mut pose = Pose::default();
    let mut eta = Vector2::new(start_m_s, 0.0);
    let mut rows = Vec::new();
    for step in 0..=20_000_u32 {
        if step % EVERY == 0 {
            let free = plant.state().pose;
            rows.push(CircleRow {
                time_s: f64::from(step) * STEP_S,
                constrained: [pose.x_m, pose.y_m],
                free: [free.x_m, free.y_m],
            });
        }
        plant.step(wheels, &ground, STEP_S);
        // Heun's method; the poles are below 100 per second.
        let first = reduced.rates_from_wheels(eta, wheels);
        let second = reduced.rates_from_wheels(eta + first.scale(STEP_S), wheels);
        let middle = eta + first.scale(0.5 * STEP_S);
        eta += (first + second).scale(0.5 * STEP_S);
        let turn_rad_s = reduced.velocity(middle).yaw_rate_rad_s;
        let (sin, cos) = (pose.heading_rad + 0.5 * STEP_S * turn_rad_s).sin_cos();
        pose.x_m += STEP_S * (middle[0] * cos - middle[1] * sin);
        pose.y_m += STEP_S * (middle[0] * sin + middle[1] * cos);
        pose.heading_rad += STEP_S * turn_rad_s;
    }
    Ok(rows)
}

/// Half of the widest extent in x after the start has died away: the circle's radius, metres.
fn radius_m(rows: &[CircleRow], place: fn(&CircleRow) -> [f64; 2]) -> f64 {
    let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
    for row in rows.iter().filter(|row| row.time_s > 5.0) {
        low = low.min(place(row)[0]);
        high = high.max(place(row)[0]);
    }
    0.5 * (high - low)
}

fn checks(rows: &[Row], lyapunov_rise: f64) -> Vec<Check> {
    let error_m = |time_s: usize| rows[time_s * 10].error[0].hypot(rows[time_s * 10].error[1]);
    let theta = rows[rows.len() - 1].state.theta;
    let at_40_m = error_m(40);
    vec![
        Check {
            name: "largest rise of V in a step".to_owned(),
            goal: "≤ 0 within rounding".to_owned(),
            value: Some(lyapunov_rise),
            holds: lyapunov_rise <= 1.0e-12,
        },
        Check {
            name: "θ̂ at the end (the truth is 0.2)".to_owned(),
            goal: "0.9747 ± 0.001".to_owned(),
            value: Some(theta),
            holds: (theta - 0.9747).abs() <= 0.001,
        },
        Check {
            name: "|ε| at 40 s, metres".to_owned(),
            goal: "0.067 ± 0.003".to_owned(),
            value: Some(at_40_m),
            holds: (at_40_m - 0.067).abs() <= 0.003,
        },
        Check {
            name: "|ε| at the start, metres".to_owned(),
            goal: "3.00 ± 0.01".to_owned(),
            value: Some(error_m(0)),
            holds: (error_m(0) - 3.0).abs() <= 0.01,
        },
    ]
}

fn write(file: &Path, text: &str) -> anyhow::Result<()> {
    fs::write(file, text).with_context(|| format!("cannot write `{}`", file.display()))
}

fn write_tracking(folder: &Path, rows: &[Row]) -> anyhow::Result<()> {
    let mut fig_6 =
        String::from("time_s,x_m,y_m,x_desired_m,y_desired_m,error_x_m,error_y_m,lyapunov\n");
    let mut fig_7 = String::from("time_s,forward_m_s,left_m_s,yaw_rate_rad_s,zeta,theta_hat\n");
    for row in rows {
        let state = &row.state;
        let ([x, y], [x_d, y_d], [e_x, e_y]) = (row.point, row.desired, row.error);
        let _ = writeln!(
            fig_6,
            "{:.1},{x:.6},{y:.6},{x_d:.6},{y_d:.6},{e_x:.6},{e_y:.6},{:.9}",
            state.time_s, row.lyapunov
        );
        let _ = writeln!(
            fig_7,
            "{:.1},{:.6},{:.6},{:.6},{:.6},{:.6}",
            state.time_s,
            state.forward_m_s,
            state.left_m_s,
            -state.left_m_s / Yi2007Config::section_iv().centre_forward_m,
            state.zeta,
            state.theta
        );
    }
    write(&folder.join("fig6_tracking.csv"), &fig_6)?;
    write(&folder.join("fig7_state.csv"), &fig_7)?;
    let curve = |name, pick: &dyn Fn(&Row) -> [f64; 2]| Curve {
        name,
        points: rows.iter().map(pick).collect(),
    };
    let timed =
        |name, pick: &dyn Fn(&Row) -> f64| curve(name, &|row: &Row| [row.state.time_s, pick(row)]);
    let plots = [
        (
            "fig6a_trajectory.svg",
            Plot {
                title: "Fig. 6(a): trajectory",
                x_label: "X, m",
                y_label: "Y, m",
                equal_scale: true,
                curves: vec![
                    curve("desired", &|row: &Row| row.desired),
                    curve("robot, point D", &|row: &Row| row.point),
                ],
            },
        ),
        (
            "fig6b_error.svg",
            Plot {
                title: "Fig. 6(b): tracking error",
                x_label: "time, s",
                y_label: "error, m",
                equal_scale: false,
                curves: vec![
                    timed("X", &|row: &Row| row.error[0]),
                    timed("Y", &|row: &Row| row.error[1]),
                ],
            },
        ),
        (
            "fig7a_velocity.svg",
            Plot {
                title: "Fig. 7(a): velocity in the body frame",
                x_label: "time, s",
                y_label: "m/s",
                equal_scale: false,
                curves: vec![
                    timed("forward", &|row: &Row| row.state.forward_m_s),
                    timed("left", &|row: &Row| row.state.left_m_s),
                ],
            },
        ),
        (
            "fig7b_theta.svg",
            Plot {
                title: "Fig. 7(b): friction parameter",
                x_label: "time, s",
                y_label: "θ",
                equal_scale: false,
                curves: vec![
                    timed("adapted", &|row: &Row| row.state.theta),
                    timed("true", &|_: &Row| 0.2),
                ],
            },
        ),
    ];
    for (name, plot) in &plots {
        write(&folder.join(name), &svg::render(plot))?;
    }
    Ok(())
}

fn write_circle(folder: &Path, rows: &[CircleRow]) -> anyhow::Result<()> {
    let mut table = String::from("time_s,x_constrained_m,y_constrained_m,x_free_m,y_free_m\n");
    for row in rows {
        let ([x, y], [free_x, free_y]) = (row.constrained, row.free);
        let _ = writeln!(
            table,
            "{:.1},{x:.6},{y:.6},{free_x:.6},{free_y:.6}",
            row.time_s
        );
    }
    write(&folder.join("fig5_circle.csv"), &table)?;
    let plot = Plot {
        title: "Fig. 5(b): 60 and 120 rpm, K = 5",
        x_label: "X, m",
        y_label: "Y, m",
        equal_scale: true,
        curves: vec![
            Curve {
                name: "reduced model, S imposed",
                points: rows.iter().map(|row| row.constrained).collect(),
            },
            Curve {
                name: "free four-wheel base",
                points: rows.iter().map(|row| row.free).collect(),
            },
        ],
    };
    write(&folder.join("fig5_circle.svg"), &svg::render(&plot))
}
