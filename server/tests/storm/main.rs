//! Missions end whatever happens: a few seeded storms; `examples/mission_storm.rs` runs many.

#[cfg(test)]
#[path = "mod.rs"]
mod storm;

#[cfg(test)]
mod tests {
    use super::storm;
    use super::storm::overtaking::{Wish, grant_before_the_offer};

    #[tokio::test]
    async fn no_storm_leaves_a_mission_stuck_revived_or_doubled() {
        let mut missions = 0;
        for seed in 1..=10 {
            missions += storm::run(seed, 250).await.unwrap();
        }
        assert!(missions > 100, "only {missions} missions were asked for");
    }

    #[tokio::test]
    async fn what_a_person_wants_is_not_overtaken_by_an_offer_that_was_decided_before() {
        for seed in [2, 11, 103, 153, 163] {
            storm::run(seed, 1_000).await.unwrap();
        }
        for wish in Wish::ALL {
            grant_before_the_offer(wish).await.unwrap();
        }
    }

    /// A robot stood for an operator under an earlier revision, and its report of that came late.
    #[tokio::test]
    async fn a_pause_that_was_reported_of_an_earlier_revision_can_be_resumed() {
        storm::run(362, 1_000).await.unwrap();
    }

    /// Stops that came to a robot in another order than they were asked for in.
    #[tokio::test]
    async fn a_stop_that_was_cleared_with_a_later_one_does_not_hold_missions_for_ever() {
        storm::run(7, 1_000).await.unwrap();
    }
}
