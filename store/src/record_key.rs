/// Key of a record of an agent.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RecordKey {
    /// Key of the run of the agent.
    pub boot_pk: i64,
    /// Sequence number within that run.
    pub seq: i64,
}
