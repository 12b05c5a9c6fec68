//! Colours of the map: the colour map cividis over a fixed logarithmic range of θ, so that colours
//! are comparable over time. Colours do not show how uncertain a value is; hatching does, the denser
//! the more uncertain. The dashboard uses the same.

/// Lower end of the colour scale, θ; smaller values have the same colour.
pub const THETA_LOW: f64 = 0.05;
/// Upper end of the colour scale, θ; larger values have the same colour.
pub const THETA_HIGH: f64 = 2.0;
/// Relative standard deviations from which a value is hatched, and more densely.
pub const HATCHED: [f64; 3] = [0.1, 0.25, 0.5];

/// `[red, green, blue]`, 0 to 255.
pub type Rgb = [u8; 3];

#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "clamped to a byte"
)]
fn byte(value: f64) -> u8 {
    value.round().clamp(0.0, 255.0) as u8
}

/// Returns the colour at `share` of the scale, 0 to 1, by polynomials fitted to the published table
/// (d3-scale-chromatic, ISC).
pub fn cividis(share: f64) -> Rgb {
    let t = share.clamp(0.0, 1.0);
    let polynomial =
        |terms: [f64; 6]| byte(terms.iter().rev().fold(0.0, |sum, term| sum * t + term));
    [
        polynomial([-4.54, -35.34, 2_381.73, -6_402.7, 7_024.72, -2_710.57]),
        polynomial([32.49, 170.73, 52.82, -131.46, 176.58, -67.37]),
        polynomial([81.24, 442.36, -2_482.43, 6_167.24, -6_614.94, 2_475.67]),
    ]
}

/// Returns the position of `theta` on the logarithmic colour scale, clamped to 0 to 1.
pub fn share(theta: f64) -> f64 {
    ((theta / THETA_LOW).ln() / (THETA_HIGH / THETA_LOW).ln()).clamp(0.0, 1.0)
}

/// Returns the density of the hatching, 0 (none) to 3.
pub fn density(relative_std_dev: f64) -> usize {
    HATCHED
        .iter()
        .filter(|least| relative_std_dev >= **least)
        .count()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_colour_map_goes_from_dark_blue_to_yellow() {
        assert_eq!(cividis(0.0), [0, 32, 81]);
        assert_eq!(cividis(1.0), [253, 234, 69]);
    }

    #[test]
    fn the_range_is_fixed() {
        assert!(share(THETA_LOW).abs() < 1e-12 && (share(THETA_HIGH) - 1.0).abs() < 1e-12);
        assert!((share(1e-9)).abs() < 1e-12 && (share(1e9) - 1.0).abs() < 1e-12);
    }

    #[test]
    fn the_more_uncertain_a_value_the_denser_its_hatching() {
        let densities = [0.0, 0.09, 0.1, 0.25, 0.49, 0.5, 9.0].map(density);
        assert_eq!(densities, [0, 0, 1, 2, 2, 3, 3]);
    }
}
