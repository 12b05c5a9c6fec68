//! Spans of offers, see [`tread_telemetry`].

use tread_api::mission::PlanSummary;
use tread_api::wire::command::Offer;
use tread_api::wire::reply::CommandRefusal;
use tread_api::wire::trace::TraceParent;
use tread_telemetry::{Place, Span};

use super::Dispatcher;

impl Dispatcher {
    /// Decides on an offer, and sends a span of it below that of the server.
    pub(super) async fn traced_offer(
        &self,
        offer: Offer,
        parent: Option<TraceParent>,
    ) -> Result<PlanSummary, CommandRefusal> {
        let Some(parent) = parent.filter(|_| self.telemetry.is_on()) else {
            return self.offer(offer).await;
        };
        let (mission, began_at) = (offer.mission, self.clock.wall());
        self.telemetry.remember(mission, parent);
        let decided = self.offer(offer).await;
        self.telemetry.send(Span {
            name: "plan",
            place: Place::below(parent),
            began_at,
            ended_at: self.clock.wall(),
            attributes: vec![("mission.id", mission.to_string())],
            failure: decided.as_ref().err().map(|refusal| refusal.detail.clone()),
        });
        decided
    }
}
