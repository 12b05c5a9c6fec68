//! The map as a speed mask for Nav2: a YAML file for its map server and the picture that it names.
//!
//! The value of a cell, 1 to 100, is the speed that its filter allows, in hundredths of the highest
//! one: a filter of type 2 (absolute speed) with base 0 and that hundredth as its multiplier. The
//! picture is read in the mode `scale`, in which 0 (black) is 100 and 255 (white) is 0.
//!
//! The speed is the one from which a robot stops within a distance: `v² = 2·a·s`, where `a` comes
//! from the traction limit as the robots' own planner takes it. Where nothing is known the cautious traction limit
//! counts, so that unknown ground is slow, not free.

use tread_control::robot::RobotModel;

use crate::friction::Raster;
use crate::friction::index::KnownCell;

/// The media type of the picture.
pub const PGM_MEDIA_TYPE: &str = "image/x-portable-graymap";
/// The media type of the description.
pub const YAML_MEDIA_TYPE: &str = "application/yaml";
/// The picture's name in the description.
pub const IMAGE: &str = "speed.pgm";

/// How fast is fast.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SpeedScale {
    /// The speed of a hundred, metres per second.
    pub speed_max_m_s: f64,
    /// Within what distance a robot must be able to stop, metres.
    pub stopping_m: f64,
}

/// The speed from which a robot stops within the distance, metres per second.
fn speed_m_s(traction_limit_mu: f64, scale: SpeedScale) -> f64 {
    (2.0 * RobotModel::longitudinal_traction_m_s2(traction_limit_mu) * scale.stopping_m).sqrt()
}

/// The value of a cell: whole hundredths, rounded down, at least one (0 would be no limit at all).
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

/// The picture: binary PGM, the highest row first.
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

/// The description.
pub fn yaml(raster: &Raster, scale: SpeedScale) -> Vec<u8> {
    let corner = raster.corner();
    let multiplier = scale.speed_max_m_s / 100.0;
    let configuration = raster
        .configuration
        .map_or_else(|| "none".to_owned(), |id| id.to_string());
    let normalisation = raster.normalisation.as_deref().unwrap_or("none");
    // Names are people's; a line break in one must not begin a key.
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
            // As the map server reads it.
            let occupied = (255.0 - f64::from(grey)) / 255.0;
            assert!(((occupied * 100.0).round() - f64::from(value)).abs() < 1e-9);
        }
    }
}
