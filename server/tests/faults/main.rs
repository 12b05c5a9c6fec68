//! Storage that fails: every write path of the server, with every single failure of SQLite.
//!
//! Real SQLite in a process of its own, in which a library fails the n-th write, sync, read or
//! allocation that it makes, for every n until nothing fails any more. After each failure, and
//! without a restart, the same database must take the next write.

#[cfg(test)]
mod ground;
#[cfg(test)]
mod hanging;
#[cfg(test)]
mod interposer;
#[cfg(test)]
mod joining;
#[cfg(test)]
mod lasting;
#[cfg(test)]
mod paths;
#[cfg(test)]
mod statements;
#[cfg(test)]
mod uncertain;
#[cfg(test)]
mod watchdog;

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;
    use std::time::Duration;

    use tread_server::app::AppError;

    use crate::ground::Ground;
    use crate::hanging;
    use crate::interposer::{Fault, Interposer, run_with_faults};
    use crate::joining;
    use crate::paths::{PATHS, WritePath};
    use crate::statements;
    use crate::uncertain;

    /// How long a write may take, with a failure in it.
    const PATIENCE: Duration = Duration::from_secs(3);
    /// How long a connection may be lost whose thread does not answer.
    const GIVEN_UP_MAX: Duration = Duration::from_secs(40);
    /// Of the many allocations of a path the test fails each of the first ones, then every so
    /// many; all of them where the environment has [`EVERY`].
    const ALLOCATIONS_FIRST: u64 = 10;
    const ALLOCATIONS_STEP: u64 = 11;
    const EVERY: &str = "TREAD_EVERY_FAULT";
    /// Failures of one kind in one path; beyond it the path would never end.
    const FAILURES_MAX: u64 = 3_000;

    #[test]
    fn every_write_path_survives_any_single_storage_failure_and_goes_on() {
        let Some(interposer) = Interposer::loaded() else {
            run_with_faults(
                "tests::every_write_path_survives_any_single_storage_failure_and_goes_on",
            );
            return;
        };
        let executed = statements::record();
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(2)
            .enable_all()
            .build()
            .unwrap();
        let counts = runtime.block_on(fail_all(&interposer));
        eprintln!("failures survived, by kind: {counts:?}");
        for fault in Fault::ALL {
            // A library that never fails anything would prove nothing.
            let enough = PATHS.len() as u64;
            let survived = counts[&(fault as u64)].1;
            assert!(survived >= enough, "{fault:?}: {survived} of {enough}");
        }
        let missing = statements::not_in(&executed);
        assert!(
            missing.is_empty(),
            "no path runs these writes: {missing:#?}"
        );
    }

    async fn fail_all(interposer: &Interposer) -> BTreeMap<u64, (String, u64)> {
        let ground = Ground::prepare().await;
        let mut counts = BTreeMap::new();
        let mut number = 0;
        for path in PATHS {
            for fault in Fault::ALL {
                let survived = fail_each(&ground, path, fault, interposer, &mut number).await;
                let name = format!("{fault:?}");
                counts.entry(fault as u64).or_insert((name, 0)).1 += survived;
            }
        }
        ground.check().await;
        counts
    }

    /// Fails the first call of a path, then the second and so on, until none is left to fail.
    async fn fail_each(
        ground: &Ground,
        path: &WritePath,
        fault: Fault,
        interposer: &Interposer,
        number: &mut u64,
    ) -> u64 {
        let takes_every = fault != Fault::NoMemory || std::env::var_os(EVERY).is_some();
        let mut survived = 0;
        for nth in 1..FAILURES_MAX {
            if !takes_every && nth > ALLOCATIONS_FIRST && nth % ALLOCATIONS_STEP != 0 {
                continue;
            }
            let what = format!("path `{}`, {fault:?} {nth}", path.name);
            *number += 1;
            let prepared = (path.prepare)(ground, *number).await;
            prepared.unwrap_or_else(|error| panic!("{what}: cannot prepare: {error:?}"));
            interposer.arm(fault, nth, false);
            let acted = tokio::time::timeout(PATIENCE, (path.act)(ground, *number)).await;
            let fired = interposer.disarm();
            let has_failed = fired > 0;
            let is_memory = has_failed && fault == Fault::NoMemory;
            match acted {
                Ok(Ok(())) => {}
                Ok(Err(AppError::Storage(cause))) if has_failed && cause.failure().is_some() => {}
                // Without memory the library's thread ends. A row that is lost with it reads as none,
                // so the refusal may name another reason; nothing is stored by it.
                Ok(Err(_other)) if is_memory => {}
                Ok(Err(error)) => panic!("{what}, fired {fired}: {error:?}"),
                // It may never answer what is sent while it ends: requests and background work are
                // given up after a while.
                Err(_elapsed) => assert!(is_memory, "{what}: it hangs"),
            }
            if fired == 0 {
                return survived;
            }
            survived += 1;
            // The cause is gone, so the next write must succeed.
            if fault == Fault::NoMemory {
                // But where a thread of the library ended and does not answer, its connection is
                // given up first.
                let resuming = async { while ground.app.db().probe_write().await.is_err() {} };
                let resumed = tokio::time::timeout(GIVEN_UP_MAX, resuming).await;
                assert!(
                    resumed.is_ok(),
                    "{what}: does not go on in {GIVEN_UP_MAX:?}"
                );
            }
            let resumed = ground.app.db().probe_write().await;
            resumed.unwrap_or_else(|error| panic!("{what}: does not go on: {error:?}"));
            let read = ground.app.db().probe_tables().await;
            read.unwrap_or_else(|error| panic!("{what}: cannot be read: {error:?}"));
            // Nobody may know what became of it.
            let settled = ground.app.settle_outcomes().await;
            settled.unwrap_or_else(|error| panic!("{what}: memory cannot be read: {error:?}"));
        }
        panic!("path `{}` never ends with {fault:?}", path.name);
    }

    #[test]
    fn a_full_disk_stops_writes_alone_and_they_go_on_when_there_is_room() {
        let name = "tests::a_full_disk_stops_writes_alone_and_they_go_on_when_there_is_room";
        match Interposer::loaded() {
            Some(interposer) => crate::lasting::full_disk(&interposer),
            None => run_with_faults(name),
        }
    }

    #[test]
    fn the_watchdog_of_the_service_manager_is_fed_while_the_storage_fails() {
        crate::watchdog::fed();
    }

    #[test]
    fn after_a_commit_of_unknown_outcome_memory_says_what_the_database_says() {
        let name = "tests::after_a_commit_of_unknown_outcome_memory_says_what_the_database_says";
        match Interposer::loaded() {
            Some(interposer) => uncertain::run(&interposer, uncertain::unknown),
            None => run_with_faults(name),
        }
    }

    #[test]
    fn a_disk_that_hangs_locks_nobody_out_and_makes_no_threads_pile_up() {
        let name = "tests::a_disk_that_hangs_locks_nobody_out_and_makes_no_threads_pile_up";
        match Interposer::loaded() {
            Some(interposer) => uncertain::run(&interposer, hanging::disk),
            None => run_with_faults(name),
        }
    }

    #[test]
    fn memory_follows_a_commit_that_nobody_waits_for() {
        let name = "tests::memory_follows_a_commit_that_nobody_waits_for";
        match Interposer::loaded() {
            Some(interposer) => uncertain::run(&interposer, uncertain::dropped),
            None => run_with_faults(name),
        }
    }

    #[test]
    fn a_token_is_refused_after_its_revocation_whoever_waits_and_whatever_is_heard_of_the_commit() {
        let name = "tests::a_token_is_refused_after_its_revocation_whoever_waits_and_whatever_is_heard_of_the_commit";
        match Interposer::loaded() {
            Some(interposer) => uncertain::run(&interposer, uncertain::revoked),
            None => run_with_faults(name),
        }
    }

    #[test]
    fn a_robot_that_joins_while_the_authority_is_replaced_gets_a_certificate_that_counts() {
        let name = "tests::a_robot_that_joins_while_the_authority_is_replaced_gets_a_certificate_that_counts";
        match Interposer::loaded() {
            Some(interposer) => uncertain::run(&interposer, joining::replaced),
            None => run_with_faults(name),
        }
    }
}
