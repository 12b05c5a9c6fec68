//! A disk that hangs: whoever was let in before is let in, and threads do not pile up.

use std::net::{IpAddr, Ipv4Addr};
use std::pin::Pin;
use std::time::Duration;

use futures_util::future::join_all;
use tread_api::identity::{CreateToken, Role};
use tread_server::app::identity::CredentialKind;
use tread_server::connections::Purpose;

use crate::ground::Ground;
use crate::interposer::{Fault, Interposer};
use crate::uncertain::until;

const HERE: IpAddr = IpAddr::V4(Ipv4Addr::LOCALHOST);
/// Requests while the disk hangs, each after the time in which nobody is looked up again.
const REQUESTS: usize = 60;
const APART: Duration = Duration::from_secs(6);
/// Questions about the free space of the disk.
const QUESTIONS: usize = 20;
/// Threads that may come about: each reader, those that may hang beside them, and one that asks
/// about the disk.
const THREADS_MAX: usize = 4 + 4 + 1;

fn threads() -> usize {
    std::fs::read_dir("/proc/self/task").unwrap().count()
}

pub(crate) fn disk(interposer: &Interposer) -> Pin<Box<dyn Future<Output = ()> + '_>> {
    Box::pin(async {
        let ground = Ground::prepare().await;
        let app = &ground.app;
        let request = CreateToken::of_role("desk", Role::Operator);
        let created = app.create_token(request, "a test").await.unwrap();
        let ask = async || {
            app.authenticate(HERE, &created.secret, CredentialKind::Token, Purpose::Other)
                .await
        };
        ask().await.unwrap();
        // After a failure every connection is opened anew.
        interposer.arm(Fault::WriteIo, 1, false);
        assert!(app.db().probe_write().await.is_err());
        let before = threads();
        interposer.arm(Fault::Hang, 1, true);
        for _ in 0..REQUESTS {
            app.clock().advance(APART);
            ask().await.unwrap();
        }
        let asked = join_all((0..QUESTIONS).map(|_| app.db().disk())).await;
        assert!(asked.iter().all(Option::is_none), "{asked:?}");
        let more = threads() - before;
        assert!(interposer.disarm() > 0, "nothing hung");
        assert!(
            more <= THREADS_MAX,
            "{more} threads more while the disk hung"
        );
        until("the database works again", async || {
            app.db().probe_write().await.is_ok()
        })
        .await;
        until("the disk is known again", async || {
            app.db().disk().await.is_some()
        })
        .await;
        app.clock().advance(APART * 10);
        ask().await.unwrap();
    })
}
