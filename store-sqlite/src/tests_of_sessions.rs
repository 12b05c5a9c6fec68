//! Sessions of a file, and those that an earlier version stored.

use jiff::Timestamp;
use sqlx::Connection as _;
use tread_api::identity::Person;
use tread_api::ids::{OidcSubject, PersonId};
use tread_store::Fingerprint;

use crate::sessions::{NewSession, Owner, PeopleSessionFilter, SignedIn, find, insert, list};
use crate::{Db, schema};

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn sessions_of_before_there_were_people_stay() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("tread.db");
    let mut old = schema::open_before(&path, 20_261_122_163_000).await;
    let (id, token) = (
        "0192f0c1-2b3c-7d4e-8f50-617283940a1b",
        "0192f0c1-2b3c-7d4e-8f50-617283940a1c",
    );
    for statement in [
        format!(
            "INSERT INTO tokens (id, name, role, lookup, hash, created_at_us, created_by, expires_at_us)
             VALUES ('{token}', 'desk', 'viewer', x'0101010101010101', zeroblob(32), 1, 'test', 9)"
        ),
        format!(
            "INSERT INTO sessions (id, token_id, lookup, hash, created_at_us, expires_at_us)
             VALUES ('{id}', '{token}', x'0202020202020202', zeroblob(32), 2, 8)"
        ),
    ] {
        sqlx::raw_sql(sqlx::AssertSqlSafe(statement))
            .execute(&mut old)
            .await
            .unwrap();
    }
    old.close().await.unwrap();
    let db = Db::open(&path).await.unwrap();
    let mut tx = db.read("db").await.unwrap();
    let kept = find(&mut tx, id.parse().unwrap()).await.unwrap().unwrap();
    assert_eq!(kept.owner, Owner::Token(token.parse().unwrap()));
    assert_eq!(kept.expires_at.as_microsecond(), 8);
    assert_eq!(kept.created_at.as_microsecond(), 2);
    drop(tx);
    db.close().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn somebody_whose_group_gives_nothing_any_more_is_listed_by_the_others() {
    let folder = tempfile::tempdir().unwrap();
    let db = Db::open(&folder.path().join("tread.db")).await.unwrap();
    let mut tx = db.write("test").await.unwrap();
    let issuer = "https://login.test";
    for (number, groups) in [
        (1, vec!["admins", "night"]),
        (2, vec!["night"]),
        (3, vec!["yard"]),
    ] {
        let subject = format!("person {number}");
        let id = PersonId::of(OidcSubject {
            issuer,
            subject: &subject,
        });
        let signed_in = SignedIn {
            person: Person {
                id,
                issuer: issuer.to_owned(),
                subject,
            },
            name: "anna".to_owned(),
            groups: groups.into_iter().map(str::to_owned).collect(),
        };
        let session = NewSession {
            id: format!("0192f0c1-2b3c-7d4e-8f50-61728394000{number}")
                .parse()
                .unwrap(),
            owner: Owner::Person(signed_in),
            fingerprint: Fingerprint::of(&number.to_string()),
            created_at: Timestamp::UNIX_EPOCH,
            expires_at: Timestamp::from_second(1_000).unwrap(),
        };
        insert(&mut tx, &session).await.unwrap();
    }
    // The group `night` was removed from the configuration.
    for (within, elsewhere, any, expected) in [
        (&["admins", "yard"][..], &[][..], true, &[3, 2, 1][..]),
        (&["yard"], &["admins"], false, &[3]),
        (&[], &["admins", "yard"], false, &[]),
    ] {
        let filter = PeopleSessionFilter {
            issuer,
            within,
            elsewhere,
            any,
            at: Timestamp::UNIX_EPOCH,
            before: None,
        };
        let kept = list(&mut tx, &filter, 10).await.unwrap();
        let listed = kept.iter().map(|kept| {
            let text = kept.id.to_string();
            text[text.len() - 1..].parse::<u8>().unwrap()
        });
        assert_eq!(listed.collect::<Vec<_>>(), expected, "{within:?}");
    }
    drop(tx);
    db.close().await;
}
