use super::*;
use crate::Db;
use crate::testing::with_database;

/// Takes the lock once the session before has ended.
async fn taken(options: &PgConnectOptions, address: &str) -> PgConnection {
    loop {
        match locked(options, address).await {
            Ok(locked) => return locked,
            Err(_) => sleep(ENDING_INTERVAL).await,
        }
    }
}

/// Time after which a standby of these tests takes over.
const SILENCE_MAX: Duration = Duration::from_secs(1);

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_standby_waits_for_a_server_that_answers_and_takes_over_from_one_that_ends() {
    let test = "a_standby_waits_for_a_server_that_answers";
    with_database(test, async |database| {
        let lock = DatabaseLock::take(&database.url).await.unwrap();
        let mut reasons = 0;
        let waiting = DatabaseLock::wait(&database.url, SILENCE_MAX, |reason| {
            assert!(matches!(reason, LockError::InUse { .. }), "{reason}");
            reasons += 1;
        });
        let waited = timeout(3 * SILENCE_MAX, waiting).await;
        assert!(
            waited.is_err(),
            "it has not taken over from a server that lives"
        );
        assert!(reasons > 3, "{reasons}");
        lock.release().await;
        let waiting = DatabaseLock::wait(&database.url, SILENCE_MAX, |_reason| {});
        timeout(SILENCE_MAX, waiting).await.unwrap().unwrap();
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_standby_takes_over_from_a_server_that_is_frozen_within_a_write() {
    let test = "a_standby_takes_over_from_a_server_that_is_frozen";
    with_database(test, async |database| {
        drop(Db::open(&database.url).await.unwrap());
        // Another process, which holds lock and turn to write and does nothing any more.
        let (options, address) = open::options_of(&database.url).unwrap();
        let frozen = options.application_name("tread-server frozen");
        let _lock = locked(&frozen, &address).await.unwrap();
        let mut write = connections::connect(&frozen).await.unwrap();
        sqlx::raw_sql(crate::begin::BEGIN_WRITE)
            .execute(&mut write)
            .await
            .unwrap();
        let begun = Instant::now();
        let waiting = DatabaseLock::wait(&database.url, SILENCE_MAX, |_reason| {});
        let _lock = timeout(4 * SILENCE_MAX, waiting).await.unwrap().unwrap();
        assert!(begun.elapsed() >= SILENCE_MAX / 2, "{:?}", begun.elapsed());
        let db = Db::open(&database.url).await.unwrap();
        db.claim(None).await.unwrap();
        db.probe_write().await.unwrap();
        let cut = sqlx::query("SELECT 1").execute(&mut write).await;
        assert!(cut.is_err(), "its session has ended");
        db.close().await;
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_standby_of_a_role_that_may_not_watch_waits_and_ends_nobody() {
    let test = "a_standby_of_a_role_that_may_not_watch";
    with_database(test, async |database| {
        let (options, address) = open::options_of(&database.url).unwrap();
        let mut by_owner = connections::connect(&options).await.unwrap();
        let created =
            "DROP ROLE IF EXISTS tread_limited; CREATE ROLE tread_limited LOGIN PASSWORD 'limited'";
        sqlx::raw_sql(created).execute(&mut by_owner).await.unwrap();
        let other = options.clone().application_name("tread-server other");
        let owner = locked(&other, &address).await.unwrap();
        let limited = options.username("tread_limited").password("limited");
        let mut watch = Watch::default();
        for _ in 0..3 {
            let attempt = watch.attempt(&limited, &address, Duration::ZERO).await;
            let Ok(Attempt::InUse(Some(session))) = attempt else {
                panic!("{attempt:?}");
            };
            assert_eq!((session.asked_at, session.since), (None, None));
        }
        assert!(watch.has_warned);
        drop(owner);
        let mut locked = loop {
            match watch.attempt(&limited, &address, Duration::ZERO).await {
                Ok(Attempt::Taken(locked)) => break locked,
                Ok(Attempt::InUse(_)) => sleep(ENDING_INTERVAL).await,
                attempt => panic!("{attempt:?}"),
            }
        };
        sqlx::raw_sql("SELECT 1")
            .execute(&mut locked)
            .await
            .unwrap();
        sqlx::Connection::close(locked).await.unwrap();
        let dropped = sqlx::raw_sql("DROP ROLE tread_limited");
        dropped.execute(&mut by_owner).await.unwrap();
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_server_that_was_taken_over_writes_no_more_and_notices() {
    let test = "a_server_that_was_taken_over_writes_no_more";
    with_database(test, async |database| {
        let old = Db::open(&database.url).await.unwrap();
        old.claim(None).await.unwrap();
        old.probe_write().await.unwrap();
        let new = Db::open(&database.url).await.unwrap();
        new.probe_write().await.unwrap();
        assert!(timeout(SILENCE_MAX, old.taken_over()).await.is_err());
        new.claim(None).await.unwrap();
        let refused = format!("{:?}", old.probe_write().await.unwrap_err());
        assert!(refused.contains("taken over"), "{refused}");
        timeout(SILENCE_MAX, old.taken_over()).await.unwrap();
        new.probe_write().await.unwrap();
        old.read("test").await.unwrap();
        old.close().await;
        new.close().await;
    })
    .await;
}

#[tokio::test]
async fn a_lost_session_of_the_same_server_does_not_keep_the_lock_and_that_of_another_does() {
    let test = "a_lost_session_of_the_same_server_does_not_keep_the_lock";
    with_database(test, async |database| {
        let (options, address) = open::options_of(&database.url).unwrap();
        let refused = |locked: &Result<PgConnection, LockError>| {
            assert!(matches!(locked, Err(LockError::InUse { .. })), "{locked:?}");
        };
        let other = options.clone().application_name("tread-server other");
        let others = locked(&other, &address).await.unwrap();
        refused(&locked_again(&options, &address, None).await);
        drop(others);
        let _lost = taken(&options, &address).await;
        // Its connection is open, as PostgreSQL sees one that was lost.
        let again = locked_again(&options, &address, None).await.unwrap();
        refused(&locked(&other, &address).await);
        // Nobody has it, but another server has claimed the database since.
        let db = Db::open(&database.url).await.unwrap();
        let own = db.claim(None).await.unwrap();
        let newer = Db::open(&database.url).await.unwrap();
        assert!(newer.claim(None).await.unwrap() > own);
        drop(again);
        refused(&locked_again(&options, &address, Some(own)).await);
        let newest = Some(own + 1);
        locked_again(&options, &address, newest).await.unwrap();
        db.close().await;
        newer.close().await;
    })
    .await;
}
