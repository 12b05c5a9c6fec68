//! Normal equations at one time scale.

use super::parameters::{Prior, Values};
use super::regimes::Regime;
use super::scale::{BLOCK_DECAY, ChannelResidual, Residual, TimeScale};
use super::*;
use crate::estimation::{EstimatorPrior, SensorNoise};

/// Ends a block with one residual in each of ten comparisons.
fn end_block(scale: &mut TimeScale, prior: &Prior, value: f64) {
    for turn in 0..10 {
        let mut slopes = Values::zeros();
        slopes[index::STIFFNESS] = 0.3;
        slopes[index::MASS] = 0.1 * f64::from(turn % 3);
        let residual = Residual { value, slopes };
        let compared = ChannelResidual {
            residual,
            noise: Residual::none(),
            std_dev: 0.1,
            square_min: 0.3,
        };
        scale.add(0, &compared);
        scale.end_comparison();
    }
    let end = BlockEnd {
        regime: Regime::Straight,
        gyro_walk: RandomWalk::of_gyro(prior, 1.0),
    };
    scale.close_block(&prior.mean, &end, false);
    scale.solve_with_block(&prior.mean, prior);
}

#[test]
fn a_dropped_block_leaves_the_scores_of_all_others() {
    let prior = parameters::prior(&EstimatorPrior::default(), &SensorNoise::default());
    let mut scale = TimeScale::new(1);
    end_block(&mut scale, &prior, 0.2);
    let first = scale.scores;
    end_block(&mut scale, &prior, -0.1);
    let both = scale.scores;
    assert!(both.norm() > 1.01 * first.norm());
    // As a step of ln K and its restoration do.
    scale.scale_weights(0.2);
    scale.drop_last_block();
    scale.scale_weights(5.0);
    let kept = first * (1.0 - BLOCK_DECAY);
    assert!((scale.scores - kept).norm() < 1.0e-9 * kept.norm());
}

#[test]
fn a_segment_that_is_taken_keeps_its_last_block_in_the_ground() {
    let prior = parameters::prior(&EstimatorPrior::default(), &SensorNoise::default());
    let mut scale = TimeScale::new(1);
    end_block(&mut scale, &prior, 0.2);
    scale.take_segment();
    let before = scale.clone();
    scale.drop_last_block();
    assert_eq!(scale.scores, before.scores);
    assert_eq!(scale.ground, before.ground);
}

#[test]
fn cleared_equations_are_as_new_ones() {
    let prior = parameters::prior(&EstimatorPrior::default(), &SensorNoise::default());
    for length in [1, 4] {
        let new = TimeScale::new(length);
        let mut scale = new.clone();
        end_block(&mut scale, &prior, 0.2);
        end_block(&mut scale, &prior, -0.1);
        scale.take_segment();
        end_block(&mut scale, &prior, 0.3);
        assert_ne!(scale, new);
        scale.clear();
        assert_eq!(scale, new);
    }
}
