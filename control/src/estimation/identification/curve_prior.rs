//! Prior of the friction curve of a ground and the configured tyres.

use crate::estimation::TyrePrior;

/// Mean and standard deviation of ln `μ_p` on unknown tyres.
const LN_PEAK: (f64, f64) = (-0.6, 0.4);
/// Maximum mean of `μ_p`, that of rubber on dry asphalt. A curve that is valid beyond it has no known peak.
const PEAK_MAX: f64 = 1.1;
/// Mean and standard deviation of the bend a on unknown tyres.
const BEND: (f64, f64) = (0.3, 0.45);
/// Standard deviation of the bend that intervals assume on unknown tyres, wider than that of the estimate's
/// prior: a lumped `LuGre` contact has the bend 1, with n = 2.
const INTERVAL_BEND_STD_DEV: f64 = 0.6;

/// Prior of the friction curve: means and standard deviations of ln `μ_p` and of the bend, and the standard
/// deviation of the bend that intervals assume.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct CurvePrior {
    pub(super) peak: (f64, f64),
    pub(super) bend: (f64, f64),
    pub(super) interval_bend_std_dev: f64,
}

impl CurvePrior {
    /// Returns the prior of configured tyres.
    ///
    /// The ratio of the peak to the largest friction coefficient at which a curve is valid is that of unknown
    /// tyres, up to [`PEAK_MAX`]. The secant compliance `λ/μ = θ(1 + θκ μ + …)` of [`TyrePrior`] is
    /// `θ(1 + a μ/μ_p + …)` here, so that `a = θκ μ_p`. It is used where it is known better than that of unknown
    /// tyres, whose bend is the one that describes most of them.
    pub(super) fn of(tyres: &TyrePrior) -> Self {
        let unknown = TyrePrior::unknown();
        let limits = tyres
            .mu_max
            .filter(|mu_max| *mu_max <= PEAK_MAX)
            .zip(unknown.mu_max);
        let peak_ratio = limits.map_or(1.0, |(mu_max, usual)| mu_max / usual);
        let ln_peak = (LN_PEAK.0 + peak_ratio.ln()).min(PEAK_MAX.ln());
        let mut prior = Self {
            peak: (ln_peak, LN_PEAK.1),
            bend: BEND,
            interval_bend_std_dev: INTERVAL_BEND_STD_DEV,
        };
        if tyres.curvature_std_dev < unknown.curvature_std_dev {
            let peak = ln_peak.exp();
            prior.bend = (tyres.curvature * peak, tyres.curvature_std_dev * peak);
            prior.interval_bend_std_dev = prior.bend.1;
        }
        prior
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unknown_tyres_have_the_usual_prior_whatever_curvature_is_configured_for_them() {
        let unknown = TyrePrior::unknown();
        let usual = CurvePrior {
            peak: LN_PEAK,
            bend: BEND,
            interval_bend_std_dev: INTERVAL_BEND_STD_DEV,
        };
        assert_eq!(CurvePrior::of(&unknown), usual);
        let curvature_std_dev = 1.1;
        assert_eq!(
            CurvePrior::of(&TyrePrior {
                curvature_std_dev,
                ..unknown
            }),
            usual
        );
        for mu_max in [None, Some(10.0)] {
            assert_eq!(CurvePrior::of(&TyrePrior { mu_max, ..unknown }), usual);
        }
    }

    #[test]
    fn a_brush_has_the_bend_of_a_brush() {
        // A peak of 0.8 has θκ = 1/(3·0.8), and a = 1/3.
        let brush = TyrePrior {
            curvature: 1.0 / 2.4,
            curvature_std_dev: 0.1,
            mu_max: Some(0.8 * 0.25 / LN_PEAK.0.exp()),
            ..TyrePrior::unknown()
        };
        let prior = CurvePrior::of(&brush);
        assert!((prior.peak.0 - 0.8_f64.ln()).abs() < 1.0e-12, "{prior:?}");
        assert!((prior.bend.0 - 1.0 / 3.0).abs() < 1.0e-12, "{prior:?}");
        assert!((prior.bend.1 - 0.08).abs() < 1.0e-12, "{prior:?}");
        assert!(
            (prior.interval_bend_std_dev - 0.08).abs() < 1.0e-12,
            "{prior:?}"
        );
    }

    #[test]
    fn no_prior_has_a_peak_above_that_of_rubber_on_asphalt() {
        let prior = CurvePrior::of(&TyrePrior {
            mu_max: Some(1.0),
            ..TyrePrior::unknown()
        });
        assert_eq!(prior.peak.0.to_bits(), PEAK_MAX.ln().to_bits());
    }
}
