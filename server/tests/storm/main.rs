//! Missions end whatever happens: a few seeded storms; `examples/mission_storm.rs` runs many.

#[cfg(test)]
#[path = "mod.rs"]
mod storm;

#[cfg(test)]
mod tests {
    use super::storm;

    #[tokio::test]
    async fn no_storm_leaves_a_mission_stuck_revived_or_doubled() {
        let mut missions = 0;
        for seed in 1..=10 {
            missions += storm::run(seed, 250).await.unwrap();
        }
        assert!(missions > 100, "only {missions} missions were asked for");
    }

    /// Stops that came to a robot in another order than they were asked for in.
    #[tokio::test]
    async fn a_stop_that_was_cleared_with_a_later_one_does_not_hold_missions_for_ever() {
        storm::run(7, 1_000).await.unwrap();
    }
}
