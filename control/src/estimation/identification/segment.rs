//! θ of single segments, for the friction map.

use super::{COST_SCALE, Identification, Identified, SHORT_BLOCK_S};

/// Standard deviations of ln K above which a segment gives no θ: from its own blocks, and in total.
const SEGMENT_OWN_STD_DEV_MAX: f64 = 0.5;
const SEGMENT_STD_DEV_MAX: f64 = 1.0;

impl Identification {
    /// Drops the last block of every hypothesis and the open one, which may contain samples of
    /// another ground.
    pub(in super::super) fn drop_last_block(&mut self) {
        self.solve_deferred();
        for hypothesis in &mut self.hypotheses {
            hypothesis.drop_last_block(&self.prior);
        }
        self.segment_s = (self.segment_s - std::mem::take(&mut self.last_block_s)).max(0.0);
        self.fit.drop_block();
        self.delays.drop_block();
        self.block_s = 0.0;
        self.is_moving = false;
        self.block_motion = super::BlockMotion::default();
    }

    /// Ends a segment and returns θ from its own blocks; None if its standard deviation is too
    /// large.
    ///
    /// θ is linearised in ln K about the ground's estimate, `θ = θ_g (1 − ln K + ln K_g)`: so the
    /// noise of short segments has mean zero and averages out in a weighted mean. The error of the
    /// tyres is that of the whole ground's estimate, but for the part from the tyres' prior, which
    /// depends on the slip of the segment.
    pub(in super::super) fn close_segment(&mut self) -> Option<Identified> {
        if self.block_s >= SHORT_BLOCK_S {
            self.end_block();
        }
        self.solve_deferred();
        let ground = self.identified();
        let duration_s = std::mem::take(&mut self.segment_s);
        self.last_block_s = 0.0;
        let least = self.least_cost();
        let (mut weights, mut mean, mut square) = (0.0, 0.0, 0.0);
        let (mut own, mut robot, mut tyres) = (0.0, 0.0, 0.0);
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
            robot += weight * segment.of_robot;
            tyres += weight * segment.of_tyres;
        }
        let ground = ground.filter(|_| is_known)?;
        mean /= weights;
        own /= weights;
        let of_prior = tyres / weights;
        // The disagreement of the hypotheses counts as uncertainty of the robot's parameters.
        let of_robot = robot / weights + (square / weights - mean * mean).max(0.0);
        let std_dev = (own + of_robot + of_prior).sqrt();
        if own.sqrt() > SEGMENT_OWN_STD_DEV_MAX || std_dev > SEGMENT_STD_DEV_MAX {
            return None;
        }
        let of_model = ground.tyres_ratio.powi(2) - ground.tyre_prior_ratio.powi(2);
        let theta = ground.theta * (1.0 - mean - ground.theta.ln());
        (theta > 0.0).then(|| Identified {
            theta,
            duration_s,
            own_ratio: own.sqrt(),
            robot_ratio: of_robot.sqrt(),
            tyres_ratio: (of_model.max(0.0) + of_prior).sqrt(),
            tyre_prior_ratio: of_prior.sqrt(),
        })
    }
}
