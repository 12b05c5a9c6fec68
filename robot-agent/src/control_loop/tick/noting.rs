//! What a record holds of a tick: enough to run it again, and to see whether that gives the same.

use super::LoopCore;
use super::guard::Wanted;
use crate::control_loop::channels::Snapshot;
use crate::control_loop::segments::Moment;
use crate::drive::Feedback;
use crate::recording::frame::{TickFrame, TickInputs, TickOutputs};

impl LoopCore {
    /// Notes the tick that ends, if it is to be recorded.
    pub(super) fn note(
        &mut self,
        now: Moment,
        stop: bool,
        feedback: &Feedback,
        wanted: &Wanted,
        snapshot: &Snapshot,
    ) {
        let Some(notes) = &mut self.notes else {
            return;
        };
        let (stop_number, server_silence, view) = self.guard.looked_at();
        let judged = self.guard.judged();
        let mission = snapshot.mission;
        notes.tick(&TickFrame {
            number: self.ticks,
            inputs: TickInputs {
                now,
                judged,
                stop_requested: stop,
                commands: notes.commands(),
                feedback: *feedback,
                is_base_silent: self.is_base_silent,
                noise: self.stated_noise,
                battery: snapshot.battery,
                stop: stop_number,
                server_silence,
                view,
            },
            outputs: TickOutputs {
                wanted: wanted.wheels,
                command: self.command,
                pose: self.localisation.pose(),
                twist: self.localisation.twist(),
                theta_loop: self.theta_loop,
                theta: self
                    .estimate
                    .theta
                    .map(|theta| (theta.theta, theta.std_dev)),
                mission: mission.map(|mission| (mission.driven_m, mission.cross_track_m)),
                slip: snapshot.slip,
                segment: self.closed,
                mode: snapshot.mode,
                fault: snapshot.fault,
                gate: snapshot.gate.cause,
            },
        });
    }
}
