//! Writes the map as a speed filter mask for Nav2: a YAML file for the map server and its PGM
//! image.
//!
//! The value of a cell, 1 to 100, is the speed limit in hundredths of the maximum speed: a costmap
//! filter of type 2 (absolute speed) with base 0 and a multiplier of a hundredth of the maximum
//! speed. The image has the mode `scale`, in which 0 (black) means 100 and 255 (white) means 0.
//!
//! The limit is the speed from which a robot stops within a distance `s`: `v² = 2·a·s`. The
//! deceleration `a` is computed from the traction limit as in the robots' planner. Cells without
//! measurements use the cautious traction limit, so unknown ground is slow.

use tread_control::robot::RobotModel;

use crate::friction::Raster;
use crate::friction::index::KnownCell;

/// Media type of the image.
pub const PGM_MEDIA_TYPE: &str = "image/x-portable-graymap";
/// Media type of the YAML file.
pub const YAML_MEDIA_TYPE: &str = "application/yaml";
/// File name of the image in the YAML file.
pub const IMAGE: &str = "speed.pgm";

/// Parameters of the speed limits.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SpeedScale {
    /// Speed of the value 100, the maximum, in metres per second.
    pub speed_max_m_s: f64,
    /// Distance within which a robot has to be able to stop, in metres.
    pub stopping_m: f64,
}

/// Returns the speed in metres per second from which a robot stops within `scale.stopping_m`.
fn speed_m_s(traction_limit_mu: f64, scale: SpeedScale) -> f64 {
    (2.0 * RobotModel::longitudinal_traction_m_s2(traction_limit_mu) * scale.stopping_m).sqrt()
}

/// Returns the value of a cell in hundredths of the maximum, rounded down, 1 to 100; 0 would mean
/// unlimited.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "1 to 100"
)]
fn value(speed_m_s: f64, scale: SpeedScale) -> u8 {
    (100.0 * speed_m_s / scale.speed_max_m_s)
        .floor()
        .clamp(1.0, 100.0) as u8
}

/// Returns the image as binary PGM (P5), the row with the largest y first.
pub fn pgm(raster: &Raster, scale: SpeedScale) -> Vec<u8> {
    let mut bytes = format!(
        "P5\n# tread speed mask of {}\n{} {}\n255\n",
        raster.site.id, raster.columns, raster.rows
    )
    .into_bytes();
    for row in raster.rows().rev() {
        bytes.extend(row.iter().map(|square| {
            let value = value(
                speed_m_s(KnownCell::traction_limit_mu(square.known().as_ref()), scale),
                scale,
            );
            255 - u8::try_from((u32::from(value) * 255 + 50) / 100).unwrap_or(u8::MAX)
        }));
    }
    bytes
}

/// Returns the YAML file.
pub fn yaml(raster: &Raster, scale: SpeedScale) -> Vec<u8> {
    let corner = raster.corner();
    let multiplier = scale.speed_max_m_s / 100.0;
    let configuration = raster
        .configuration
        .map_or_else(|| "none".to_owned(), |id| id.to_string());
    let normalisation = raster.normalisation.as_deref().unwrap_or("none");
    // Users choose these names; a line break in one must not start a YAML key.
    let normalisation: String = normalisation
        .chars()
        .filter(|letter| !letter.is_control())
        .collect();
    format!(
        "# Speed mask of site {site}, for robot model {configuration}, normalisation {normalisation}.\n\
         # Costmap filter info: type 2 (absolute speed), base 0.0, multiplier {multiplier}.\n\
         # From these speeds a robot stops within {stopping} m.\n\
         image: {IMAGE}\n\
         mode: scale\n\
         resolution: {resolution}\n\
         origin: [{x}, {y}, 0.0]\n\
         negate: 0\n\
         occupied_thresh: 1.0\n\
         free_thresh: 0.0\n",
        site = raster.site.id,
        stopping = scale.stopping_m,
        resolution = raster.size_m,
        x = corner.x_m,
        y = corner.y_m,
    )
    .into_bytes()
}

#[cfg(test)]
mod tests {
    use tread_control::robot::GRAVITY_M_S2;

    use super::*;

    #[test]
    fn slow_is_never_free_and_a_hundred_is_the_most() {
        let scale = SpeedScale {
            speed_max_m_s: 2.0,
            stopping_m: 1.0,
        };
        assert_eq!(value(0.001, scale), 1, "0 would lift the limit");
        assert_eq!(value(1.019, scale), 50, "rounded down");
        assert_eq!(value(9.0, scale), 100);
        let speed = speed_m_s(0.14, scale);
        assert!(
            (speed * speed / (2.0 * 0.58 * 0.14 * GRAVITY_M_S2) - 1.0).abs() < 1e-3,
            "{speed}"
        );
    }

    #[test]
    fn every_value_comes_back_out_of_its_grey() {
        for value in 1..=100_u8 {
            let grey = 255 - u8::try_from((u32::from(value) * 255 + 50) / 100).unwrap();
            // The conversion of Nav2's map server.
            let occupied = (255.0 - f64::from(grey)) / 255.0;
            assert!(((occupied * 100.0).round() - f64::from(value)).abs() < 1e-9);
        }
    }
}
