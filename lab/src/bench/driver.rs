//! Common interface of the compared tracking laws.

use tread_control::friction::FrictionCurve;
use tread_control::measured::{BodyAcceleration, Measured, WheelSpeeds};
use tread_control::reference::ReferenceSample;
use tread_control::robot::RobotModel;
use tread_control::tracking::{
    ThetaKnowledge, Tracker, TrackerConfig, TrackerError, TrackerOutput,
};

use crate::bench::Law;
use crate::bench::course::Course;
use crate::bench::kanayama::Kanayama;
use crate::bench::paper_law::{PaperLaw, desired};
use crate::bench::pursuit::Pursuit;

/// Input of a law in one tick.
#[derive(Debug, Clone, Copy)]
pub struct LawInput<'a> {
    /// Course that it follows.
    pub course: &'a Course,
    /// Time on the course, seconds.
    pub time_s: f64,
    /// Desired pose and motion now.
    pub reference: &'a ReferenceSample,
    /// Measured pose and motion.
    pub measured: &'a Measured,
    /// Known θ; only the shipped law uses it.
    pub knowledge: Option<ThetaKnowledge>,
    /// Acceleration at the centre of mass, as an accelerometer measures it; only the paper's law
    /// uses it.
    pub felt: BodyAcceleration,
}

/// A tracking law with its state.
#[derive(Debug, Clone, PartialEq)]
pub struct Driver(Kind);

#[derive(Debug, Clone, PartialEq)]
enum Kind {
    Kanayama(Kanayama),
    Pursuit(Pursuit),
    Paper(PaperLaw),
    Shipped(Box<Tracker>),
}

impl Driver {
    /// Creates a law in its initial state. The paper's law uses `curve`; if it cannot be
    /// constructed, the shipped law replaces it.
    ///
    /// # Errors
    /// [`TrackerError`] if the shipped law's configuration is out of range.
    pub fn new(
        model: RobotModel,
        config: TrackerConfig,
        curve: FrictionCurve,
        law: Law,
    ) -> Result<Self, TrackerError> {
        let mut tracker = Tracker::new(model, config)?;
        Ok(Self(match law {
            Law::Kanayama(gains) => Kind::Kanayama(Kanayama::new(model, gains)),
            Law::Pursuit(config) => Kind::Pursuit(Pursuit::new(model, config)),
            Law::Yi2007 => PaperLaw::new(model, curve)
                .map_or_else(|| Kind::Shipped(Box::new(tracker)), Kind::Paper),
            Law::Shipped(given) => {
                if let Some(known) = given {
                    tracker.warm_start(known);
                }
                Kind::Shipped(Box::new(tracker))
            }
        }))
    }

    /// Returns the wheel speeds to command, and the full output of the shipped law if it drives.
    pub fn step(
        &mut self,
        input: &LawInput<'_>,
        dt_s: f64,
    ) -> (WheelSpeeds, Option<TrackerOutput>) {
        let &LawInput {
            course,
            time_s,
            reference,
            measured,
            knowledge,
            felt,
        } = input;
        match &mut self.0 {
            Kind::Kanayama(law) => (law.step(reference, measured, dt_s), None),
            Kind::Pursuit(law) => (law.step(course, measured), None),
            Kind::Paper(law) => {
                let desired = desired(course, time_s);
                (law.step(&desired, measured, felt, dt_s), None)
            }
            Kind::Shipped(law) => {
                let output = law.step(reference, measured, knowledge, dt_s);
                (output.wheel_speeds, Some(output))
            }
        }
    }

    /// Sets whether the shipped law holds its adapted values, as it does while the gate reduces its
    /// command. Other laws ignore this.
    pub fn hold_adaptation(&mut self, held: bool) {
        if let Kind::Shipped(law) = &mut self.0 {
            law.hold_adaptation(held);
        }
    }

    /// Returns the distance of the law's control point ahead of the robot's centre, metres; 0 if
    /// the law controls the centre.
    pub fn point_forward_m(&self) -> f64 {
        match &self.0 {
            Kind::Paper(law) => law.point_forward_m(),
            Kind::Kanayama(_) | Kind::Pursuit(_) | Kind::Shipped(_) => 0.0,
        }
    }
}
