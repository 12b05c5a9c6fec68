//! What a router answers itself, so that a client can see whether it still takes connections.

use zenoh::{Session, Wait as _};

/// The key that the router answers itself on.
pub(super) const PROBE_KEY: &str = "tread/self/probe";

/// Declares what the look asks. Blocks its thread.
pub(super) fn declare_probe(session: &Session) -> zenoh::Result<()> {
    session
        .declare_queryable(PROBE_KEY)
        .complete(true)
        .callback(|query| {
            // A full link drops the answer; the look counts that as none.
            let _ = query.reply(PROBE_KEY, [1_u8]).wait();
        })
        .background()
        .wait()
}
