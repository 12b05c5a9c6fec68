//! θ of the segments of the map.

use super::{COST_SCALE, Identification, Identified, SHORT_BLOCK_S};

/// Standard deviations of ln K beyond which a segment tells nothing: by its own blocks, and in all.
const SEGMENT_OWN_STD_DEV_MAX: f64 = 0.5;
const SEGMENT_STD_DEV_MAX: f64 = 1.0;

impl Identification {
    /// Drops the last block: it may be of another ground.
    pub(in super::super) fn drop_last_block(&mut self) {
        for hypothesis in &mut self.hypotheses {
            hypothesis.drop_last_block();
        }
        self.segment_s = (self.segment_s - std::mem::take(&mut self.last_block_s)).max(0.0);
        self.block_s = 0.0;
        self.is_moving = false;
    }

    /// Ends a segment of this ground, and gives θ of its own blocks; none where that tells nothing.
    /// θ is linear in ln K about that of the whole ground, so that the noise of short segments averages
    /// out in a weighted mean.
    pub(in super::super) fn close_segment(&mut self) -> Option<Identified> {
        if self.block_s >= SHORT_BLOCK_S {
            self.end_block();
        }
        let ground = self.identified();
        let duration_s = std::mem::take(&mut self.segment_s);
        self.last_block_s = 0.0;
        let least = self.least_cost();
        let (mut weights, mut mean, mut square, mut own, mut known) = (0.0, 0.0, 0.0, 0.0, 0.0);
        let mut is_known = true;
        for hypothesis in &mut self.hypotheses {
            let weight = (-(hypothesis.cost() - least) / COST_SCALE).exp();
            let Some(segment) = hypothesis.close_segment(&self.prior) else {
                is_known = false;
                continue;
            };
            weights += weight;
            mean += weight * segment.ln_stiffness;
            square += weight * segment.ln_stiffness.powi(2);
            own += weight * segment.own;
            known += weight * segment.known;
        }
        let ground = ground.filter(|_| is_known)?;
        mean /= weights;
        own /= weights;
        // What the hypotheses differ by is not known of the robot.
        let of_robot = known / weights + (square / weights - mean * mean).max(0.0);
        if own.sqrt() > SEGMENT_OWN_STD_DEV_MAX || (own + of_robot).sqrt() > SEGMENT_STD_DEV_MAX {
            return None;
        }
        let theta = ground.theta * (1.0 - mean - ground.theta.ln());
        (theta > 0.0).then(|| Identified {
            theta,
            duration_s,
            own_ratio: own.sqrt(),
            robot_ratio: of_robot.sqrt(),
            ..ground
        })
    }
}
