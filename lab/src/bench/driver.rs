//! A law with its memory, whichever it is.

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
use crate::bench::paper_law::PaperLaw;
use crate::bench::pursuit::Pursuit;

/// What a law sees in one tick.
#[derive(Debug, Clone, Copy)]
pub struct LawInput<'a> {
    /// What it follows.
    pub course: &'a Course,
    /// Time on the course, seconds.
    pub time_s: f64,
    /// Where the robot should be now.
    pub reference: &'a ReferenceSample,
    /// Where the robot is and how it moves.
    pub measured: &'a Measured,
    /// What is known of θ; only the shipped law uses it.
    pub knowledge: Option<ThetaKnowledge>,
    /// What an accelerometer at the centre of mass feels; only the paper's law uses it.
    pub felt: BodyAcceleration,
}

/// A law with its memory.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Driver(Kind);

#[derive(Debug, Clone, Copy, PartialEq)]
enum Kind {
    Kanayama(Kanayama),
    Pursuit(Pursuit),
    Paper(PaperLaw),
    Shipped(Tracker),
}

impl Driver {
    /// A law at rest. The paper's law is given the ground's curve; where that is none for it, the
    /// shipped law drives.
    ///
    /// # Errors
    /// [`TrackerError`] when the shipped law's configuration is out of range.
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
            Law::Yi2007 => PaperLaw::new(model, curve).map_or(Kind::Shipped(tracker), Kind::Paper),
            Law::Shipped(given) => {
                if let Some(known) = given {
                    tracker.warm_start(known);
                }
                Kind::Shipped(tracker)
            }
        }))
    }

    /// Wheel speeds to command; with the shipped law's own output, if it is that.
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
            Kind::Paper(law) => (law.step(course, time_s, measured, felt, dt_s), None),
            Kind::Shipped(law) => {
                let output = law.step(reference, measured, knowledge, dt_s);
                (output.wheel_speeds, Some(output))
            }
        }
    }

    /// Holds the shipped law's adaptation while the gate cuts its command.
    pub fn hold_adaptation(&mut self, held: bool) {
        if let Kind::Shipped(law) = &mut self.0 {
            law.hold_adaptation(held);
        }
    }

    /// How far ahead of the wheels' centre the point is that it leads, metres.
    pub fn point_forward_m(&self) -> f64 {
        match &self.0 {
            Kind::Paper(law) => law.point_forward_m(),
            Kind::Kanayama(_) | Kind::Pursuit(_) | Kind::Shipped(_) => 0.0,
        }
    }
}
