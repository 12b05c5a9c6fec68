//! Queryable of a router for probes, by which a client checks that it still accepts connections.

use zenoh::{Session, Wait as _};

/// Key of the probe.
pub(super) const PROBE_KEY: &str = "tread/self/probe";

/// Declares the queryable of the probe. Blocks its thread.
pub(super) fn declare_probe(session: &Session) -> zenoh::Result<()> {
    session
        .declare_queryable(PROBE_KEY)
        .complete(true)
        .callback(|query| {
            // A full link drops the answer; the probe then counts as failed.
            let _ = query.reply(PROBE_KEY, [1_u8]).wait();
        })
        .background()
        .wait()
}
