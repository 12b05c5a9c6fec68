//! Sends alerts to webhooks: which addresses may be called, how a delivery is signed, and one
//! attempt with bounded times and sizes.
//!
//! ```text
//! URL ─► scheme, user info ─► resolve once ─► every address allowed? ─► connect to just these
//! ```
//!
//! Whoever may set up webhooks chooses a URL that the server calls from its own network. So nothing
//! but public addresses is called unless the configuration allows it, redirects are not followed,
//! and of the answer little more than the status is read. Which deliveries there are, and when one
//! is repeated, is decided in [`crate::app`].

mod address;
mod outgoing;
mod sender;
mod signature;

pub use self::address::{InvalidUrl, Rules, is_public};
pub use self::outgoing::OutgoingDelivery;
pub use self::sender::{
    ANSWER_MAX, Attempt, BODY_MAX, CONNECT_MAX, RESOLVE_MAX, Resolved, Resolver, Sender,
    SenderError, SystemResolver,
};
pub use self::signature::signature;
