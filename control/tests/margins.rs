//! Margins of the loop across the path, computed from its linear model.
//!
//! Heading and cross-track error in the distance domain, slip relaxation of yaw and of the course,
//! servo lag, delay of a sample and a half; the inner loop on the turn rate closed.

use nalgebra::Complex;
use tread_control::robot::{GRAVITY_M_S2, RobotModel};
use tread_control::tracking::{CrossGains, TrackerConfig};

/// What the loop meets.
#[derive(Clone, Copy)]
struct Plant {
    stiffness: f64,
    speed_m_s: f64,
    servo_lag_s: f64,
    loop_s: f64,
}

/// Phase margin, delay margin, and how much the gain may rise.
#[derive(Debug)]
struct Margins {
    phase_deg: f64,
    delay_s: f64,
    gain: f64,
}

fn open_loop(gains: CrossGains, plant: Plant, rate_rad_s: f64) -> Complex<f64> {
    let s = Complex::new(0.0, rate_rad_s);
    let one = Complex::new(1.0, 0.0);
    let model = RobotModel::yi2007();
    let shape = model.mass_kg() * (model.track_width_m().powi(2) + model.wheelbase_m().powi(2))
        / (4.0 * model.yaw_inertia_kg_m2());
    let v = plant.speed_m_s;
    let slip_pole = GRAVITY_M_S2 * plant.stiffness / v;
    let base = (-s * (1.5 * plant.loop_s)).exp()
        / ((s * plant.servo_lag_s + one) * (s / (slip_pole * shape) + one));
    let inner = base * (1.0 + gains.yaw_rate) / (one + base * gains.yaw_rate);
    let course = one / (s / slip_pole + one);
    let lateral = (one * (v * v * gains.cross_1_m2)) / (s * s)
        + (one * (v.powi(3) * gains.integral_1_m3)) / (s * s * s);
    inner * ((one * (v * gains.heading_1_m)) / s + course * lateral)
}

fn margins(gains: CrossGains, plant: Plant) -> Margins {
    let mut found = Margins {
        phase_deg: f64::INFINITY,
        delay_s: f64::INFINITY,
        gain: f64::INFINITY,
    };
    let mut before: Option<(f64, f64)> = None;
    for step in 0..20_000_u16 {
        let rate_rad_s = 10.0_f64.powf(-1.0 + 3.3 * f64::from(step) / 20_000.0);
        let value = open_loop(gains, plant, rate_rad_s);
        let mut phase = value.arg();
        // Three integrators at low rates: the phase starts at −270°.
        let near = before.map_or(-1.5 * std::f64::consts::PI, |(phase, _)| phase);
        phase += ((near - phase) / std::f64::consts::TAU).round() * std::f64::consts::TAU;
        let over = phase + std::f64::consts::PI;
        if let Some((phase_before, size_before)) = before {
            if size_before > 1.0 && value.norm() <= 1.0 {
                found.phase_deg = found.phase_deg.min(over.to_degrees());
                found.delay_s = found.delay_s.min(over / rate_rad_s);
            }
            if phase_before + std::f64::consts::PI > 0.0 && over <= 0.0 {
                found.gain = found.gain.min(value.norm().recip());
            }
        }
        before = Some((phase, value.norm()));
    }
    found
}

#[test]
fn the_loop_keeps_margins_from_slippery_to_firm_ground() {
    let config = TrackerConfig::default();
    for stiffness in [0.5, 1.0, 5.0, 20.0] {
        for speed_m_s in [0.3, 0.6, 0.85] {
            let plant = Plant {
                stiffness,
                speed_m_s,
                servo_lag_s: 0.05,
                loop_s: 0.02,
            };
            for gains in [config.quiet, config.noisy, config.steady] {
                let found = margins(gains, plant);
                assert!(
                    found.phase_deg > 20.0 && found.delay_s > 0.06 && found.gain > 1.7,
                    "K {stiffness}, {speed_m_s} m/s, {gains:?}: {found:?}"
                );
            }
        }
    }
}

#[test]
fn without_the_inner_loop_slippery_ground_leaves_no_margin() {
    let plant = Plant {
        stiffness: 0.5,
        speed_m_s: 0.85,
        servo_lag_s: 0.05,
        loop_s: 0.02,
    };
    let without = CrossGains {
        yaw_rate: 0.0,
        ..TrackerConfig::default().quiet
    };
    let found = margins(without, plant);
    assert!(found.phase_deg < 5.0, "{found:?}");
}
