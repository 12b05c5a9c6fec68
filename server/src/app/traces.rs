//! Spans of missions, see [`tread_telemetry`].

use jiff::Timestamp;
use tread_api::mission::{Mission, MissionState};
use tread_api::wire::reply::{Answer, OfferReply};
use tread_api::wire::trace::TraceParent;
use tread_telemetry::{Place, Span, Telemetry};

use super::App;
use super::robot_link::Undelivered;

impl App {
    /// Returns the sender of traces, which does nothing unless it is configured.
    fn telemetry(&self) -> &Telemetry {
        &self.inner.telemetry
    }

    /// Sends the span of a new mission from its request to its commit.
    pub(super) fn trace_stored(&self, mission: &Mission) {
        if !self.telemetry().is_on() {
            return;
        }
        self.telemetry().send(Span {
            name: "store",
            place: Place::below(TraceParent::of_mission(mission.id)),
            began_at: mission.created_at,
            ended_at: self.clock().now(),
            attributes: attributes(mission),
            failure: None,
        });
    }

    /// Returns the place of the next offer of a mission in its trace; `None` without tracing.
    pub(super) fn trace_offer(&self, mission: &Mission) -> Option<Place> {
        let is_on = self.telemetry().is_on();
        is_on.then(|| Place::below(TraceParent::of_mission(mission.id)))
    }

    /// Sends the span of an offer that was answered, or was not.
    pub(super) fn trace_offered(
        &self,
        place: Option<Place>,
        mission: &Mission,
        began_at: Timestamp,
        answer: &Result<Answer<OfferReply>, Undelivered>,
    ) {
        let Some(place) = place else { return };
        let failure = match answer {
            Ok(answer) => match &answer.reply {
                OfferReply::Accepted { .. } => None,
                OfferReply::Refused(refusal) => Some(refusal.detail.clone()),
            },
            Err(undelivered) => Some(undelivered.to_string()),
        };
        self.telemetry().send(Span {
            name: "offer",
            place,
            began_at,
            ended_at: self.clock().now(),
            attributes: attributes(mission),
            failure,
        });
    }

    /// Sends the root span of a mission that has ended.
    pub(super) fn trace_mission(&self, mission: &Mission) {
        if !self.telemetry().is_on() {
            return;
        }
        let mut attributes = attributes(mission);
        attributes.push(("mission.state", mission.state.as_str().to_owned()));
        let failure = (mission.state != MissionState::Succeeded).then(|| {
            let reason = mission.reason.clone();
            reason.unwrap_or_else(|| mission.state.as_str().to_owned())
        });
        self.telemetry().send(Span {
            name: "mission",
            place: Place::Root(TraceParent::of_mission(mission.id)),
            began_at: mission.created_at,
            ended_at: mission.ended_at.unwrap_or_else(|| self.clock().now()),
            attributes,
            failure,
        });
    }

    /// Sends the spans that wait. Blocks for at most two seconds.
    pub fn finish_traces(&self) {
        self.telemetry().stop();
    }
}

fn attributes(mission: &Mission) -> Vec<(&'static str, String)> {
    vec![
        ("mission.id", mission.id.to_string()),
        ("mission.revision", mission.revision.to_string()),
        ("site.id", mission.site.to_string()),
        ("robot.id", mission.robot.to_string()),
    ]
}
