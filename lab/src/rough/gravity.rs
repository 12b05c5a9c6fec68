//! Gravity on a slope.

use tread_control::robot::GRAVITY_M_S2;

/// Returns the gravitational acceleration on a plane of these slopes in the frame of a robot with a
/// heading: forward, left, into the ground.
pub fn gravity_m_s2(slope_rad: [f64; 2], heading_rad: f64) -> [f64; 3] {
    let [x_rad, y_rad] = slope_rad;
    let (rise_x, rise_y) = (x_rad.tan(), y_rad.tan());
    let upright = (1.0 + rise_x.powi(2) + rise_y.powi(2)).sqrt().recip();
    let (sin, cos) = heading_rad.sin_cos();
    let down = [
        -rise_x * upright * GRAVITY_M_S2,
        -rise_y * upright * GRAVITY_M_S2,
    ];
    [
        cos * down[0] + sin * down[1],
        -sin * down[0] + cos * down[1],
        upright * GRAVITY_M_S2,
    ]
}
