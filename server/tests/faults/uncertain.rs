//! Commits of which nobody knows what became, and commits that nobody waits for: memory says what
//! the database says all the same.

use std::net::{IpAddr, Ipv4Addr};
use std::pin::Pin;
use std::time::Duration;

use tread_api::friction::CreateWithdrawal;
use tread_api::identity::{CreateToken, Role};
use tread_server::app::AppError;
use tread_server::app::identity::{CredentialKind, SignInError};
use tread_server::config::RetentionConfig;
use tread_server::connections::Purpose;

use crate::ground::{Ground, now, segment};
use crate::interposer::Interposer;

/// How long a commit may take in these tests, and how long one takes that is slower.
const COMMIT_MAX: Duration = Duration::from_millis(400);
const SLOW: Duration = Duration::from_secs(1);
/// When whoever asked goes away, long before a slow commit ends.
const GONE_AFTER: Duration = Duration::from_millis(200);
const PATIENCE: Duration = Duration::from_secs(15);
const LOOK_AGAIN: Duration = Duration::from_millis(20);
const HERE: IpAddr = IpAddr::V4(Ipv4Addr::LOCALHOST);

type Acting<'ground> = Pin<Box<dyn Future<Output = Result<(), AppError>> + Send + 'ground>>;
type Act = for<'ground> fn(&'ground Ground) -> Acting<'ground>;

/// What changes memory with the database.
const ACTS: [(&str, Act); 5] = [
    ("upload", |ground| {
        Box::pin(async { ground.upload(vec![segment(900)]).await.map(|_receipt| ()) })
    }),
    ("sums", |ground| {
        Box::pin(async { Ok(ground.app.write_sums().await?) })
    }),
    ("retention", |ground| {
        Box::pin(async {
            let config = RetentionConfig {
                segments_max: 5,
                ..RetentionConfig::default()
            };
            ground.app.remove_some(&config, 10).await.map(|_removed| ())
        })
    }),
    ("withdrawal", |ground| {
        Box::pin(async {
            let request = CreateWithdrawal {
                from: Some(now() - Duration::from_hours(40)),
                to: Some(now() - Duration::from_hours(40)),
                reason: "a test".to_owned(),
            };
            let named = (&ground.site, &ground.robot);
            ground.app.withdraw(named, request, "a test").await?;
            Ok(())
        })
    }),
    ("merging", |ground| Box::pin(ground.app.move_horizons())),
];

pub(crate) fn run(
    interposer: &Interposer,
    test: impl for<'test> FnOnce(&'test Interposer) -> Pin<Box<dyn Future<Output = ()> + 'test>>,
) {
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .enable_all()
        .build()
        .unwrap();
    runtime.block_on(test(interposer));
}

/// A site that was measured, for this act: what it does is the next commit.
async fn measured(commit_max: Duration, act: &str) -> Ground {
    let ground = Ground::prepare_with(commit_max).await;
    ground.upload((0..10).map(segment).collect()).await.unwrap();
    if act != "sums" {
        ground.app.write_sums().await.unwrap();
    }
    if act == "merging" {
        ground.app.clock().advance(Duration::from_hours(24 * 9));
    }
    ground
}

/// Waits until something is so.
pub(crate) async fn until(what: &str, is_so: impl AsyncFn() -> bool) {
    let waiting = async {
        while !is_so().await {
            tokio::time::sleep(LOOK_AGAIN).await;
        }
    };
    let came = tokio::time::timeout(PATIENCE, waiting).await;
    assert!(came.is_ok(), "not within {PATIENCE:?}: {what}");
}

/// What was removed counts once, also when it is sent again.
async fn check_removed(ground: &Ground) {
    let sent_again = ground.upload((0..5).map(segment).collect()).await.unwrap();
    assert_eq!((sent_again.committed, sent_again.duplicates), (0, 5));
}

pub(crate) fn unknown(interposer: &Interposer) -> Pin<Box<dyn Future<Output = ()> + '_>> {
    Box::pin(async {
        for (name, act) in ACTS {
            let ground = measured(COMMIT_MAX, name).await;
            interposer.slow_down(SLOW);
            let acted = act(&ground).await;
            assert!(
                matches!(acted, Err(AppError::Storage(_))),
                "{name}: {acted:?}"
            );
            assert_eq!(interposer.disarm(), 1, "{name}: nothing was slow");
            assert_eq!(ground.app.db().unknown_outcomes(), 1, "{name}");
            // Until memory was read again nothing changes it.
            let refused = ground.upload(vec![segment(901)]).await;
            assert!(refused.is_err(), "{name}: {refused:?}");
            // The commit took place after all, and memory shows it once it was read again.
            until("memory is read again", async || {
                ground.app.settle_outcomes().await.is_ok()
            })
            .await;
            if name != "retention" {
                let counted = ground.segments_counted().await;
                assert_eq!(counted, expected(name), "{name}: it was not written");
            }
            ground.check_map().await;
            if name == "retention" {
                check_removed(&ground).await;
            }
            ground.upload(vec![segment(902)]).await.unwrap();
            ground.check_map().await;
        }
    })
}

/// Segments on the map after an act.
fn expected(act: &str) -> u64 {
    match act {
        "upload" => 11,
        // Those of one hour of three.
        "withdrawal" => 6,
        _ => 10,
    }
}

pub(crate) fn dropped(interposer: &Interposer) -> Pin<Box<dyn Future<Output = ()> + '_>> {
    Box::pin(async {
        for (name, act) in ACTS {
            let ground = measured(PATIENCE, name).await;
            interposer.slow_down(SLOW);
            let acted = tokio::time::timeout(GONE_AFTER, act(&ground)).await;
            assert!(acted.is_err(), "{name}: {acted:?}");
            ground.app.db().await_commits().await.unwrap();
            assert_eq!(interposer.disarm(), 1, "{name}: nothing was slow");
            let counted = ground.segments_counted().await;
            assert_eq!(counted, expected(name), "{name}: it was not written");
            until("memory shows it", async || ground.is_map_right().await).await;
            if name == "retention" {
                check_removed(&ground).await;
            }
        }
    })
}

pub(crate) fn revoked(interposer: &Interposer) -> Pin<Box<dyn Future<Output = ()> + '_>> {
    Box::pin(async {
        for (commit_max, gone_after) in [(COMMIT_MAX, PATIENCE), (PATIENCE, GONE_AFTER)] {
            let ground = Ground::prepare_with(commit_max).await;
            let app = &ground.app;
            let request = CreateToken::of_role("desk", Role::Operator);
            let created = app.create_token(request, "a test").await.unwrap();
            let ask = async || {
                app.authenticate(HERE, &created.secret, CredentialKind::Token, Purpose::Other)
                    .await
            };
            let known = ask().await.unwrap();
            interposer.slow_down(SLOW);
            let revoking = app.revoke_token(created.token.id);
            let revoked = tokio::time::timeout(gone_after, revoking).await;
            assert!(!matches!(revoked, Ok(Ok(_))), "{revoked:?}");
            until("the commit has ended", async || {
                app.db().await_commits().await.is_ok()
            })
            .await;
            assert_eq!(interposer.disarm(), 1, "nothing was slow");
            // The clock stands, so nobody is looked up again because of the time.
            until("what it has open closes", async || {
                known.ended().is_cancelled()
            })
            .await;
            let refused = ask().await;
            assert!(matches!(refused, Err(SignInError::Revoked)), "{refused:?}");
        }
    })
}
