use tread_api::identity::Token;

use super::*;
use crate::identity::secret::{Kind, Secret};

fn time(second: i64) -> Timestamp {
    Timestamp::from_second(second).unwrap()
}

fn credential(expires_at: Timestamp) -> Credential {
    let token = Token {
        id: TokenId::from_uuid(uuid::Uuid::from_u128(7)),
        name: "desk".to_owned(),
        role: Some(Role::Operator),
        rights: Role::Operator.into(),
        sites: Scope::EVERYWHERE,
        created_at: time(0),
        created_by: "test".to_owned(),
        expires_at,
        revoked_at: None,
        last_used_at: None,
    };
    Credential::new(&token, None, expires_at, Duration::ZERO)
}

fn secret(byte: u8) -> Fingerprint {
    Secret::from_random(Kind::Session, &[byte; 32]).fingerprint()
}

#[test]
fn a_look_up_that_began_before_an_end_is_not_kept_after_it() {
    let known = CredentialCache::default();
    let generation = known.generation();
    known.end(|_| false);
    let late = known.insert(secret(1), credential(time(9)), generation, time(1));
    assert!(late.is_none());
    assert!(known.find(&secret(1), time(1)).is_none());
}

#[test]
fn a_credential_that_expires_or_is_ended_is_gone_and_its_requests_are_cancelled() {
    let known = CredentialCache::default();
    let keep = |byte| {
        let generation = known.generation();
        known
            .insert(secret(byte), credential(time(9)), generation, time(1))
            .unwrap()
    };
    let (first, second) = (keep(1), keep(2));
    assert!(known.find(&secret(1), time(8)).is_some());
    assert!(known.find(&secret(1), time(9)).is_none());
    assert!(first.ended().is_cancelled() && !second.ended().is_cancelled());
    known.end(|known| known.name == "desk");
    assert!(second.ended().is_cancelled());
    assert!(known.find(&secret(2), time(1)).is_none());
}

#[test]
fn what_is_no_longer_valid_ends_and_what_is_valid_is_known_without_being_shown() {
    let known = CredentialCache::default();
    let generation = known.generation();
    let gone = known.insert(secret(1), credential(time(9)), generation, time(1));
    let later = Duration::from_secs(1);
    let valid = || {
        let credential = credential(time(9));
        let mut valid = Valid::default();
        valid
            .token_ids
            .insert(TokenId::from_uuid(uuid::Uuid::from_u128(8)));
        valid.tokens.push((
            secret(2),
            Credential {
                subject: SubjectId::Token(TokenId::from_uuid(uuid::Uuid::from_u128(8))),
                ..credential
            },
        ));
        valid
    };
    assert!(known.any_gone(&valid(), later));
    known.read_again(valid(), generation + 1, later);
    assert!(
        known.find(&secret(1), time(1)).is_some(),
        "read in another generation"
    );
    known.read_again(valid(), generation, Duration::ZERO);
    assert!(
        known.find(&secret(1), time(1)).is_some(),
        "looked up after the reading began"
    );
    known.read_again(valid(), generation, later);
    assert!(gone.unwrap().ended().is_cancelled());
    assert!(known.find(&secret(1), time(1)).is_none());
    assert!(known.find(&secret(2), time(1)).is_some());
}

#[test]
fn who_is_known_is_looked_up_again_after_a_while() {
    let known = credential(time(9));
    let seconds = Duration::from_secs;
    assert!(known.is_fresh(seconds(4)) && !known.is_fresh(seconds(5)));
    known.checked(seconds(5));
    assert!(known.is_fresh(seconds(9)) && !known.is_fresh(seconds(10)));
}

#[test]
fn one_is_looked_up_again_at_a_time_and_less_often_while_that_fails() {
    let known = CredentialCache::default();
    let first = known.recheck(Duration::ZERO).unwrap();
    assert!(known.recheck(Duration::ZERO).is_none());
    first.succeeded();
    // A database that does not answer for an hour, asked every 100 ms.
    let asked = (0..36_000_u64).map(|tenth| Duration::from_millis(100 * tenth));
    let tries = asked.filter(|&now| known.recheck(now).is_some()).count();
    assert!((200..300).contains(&tries), "{tries}");
    let hour = Duration::from_hours(1) + BACK_OFF_MAX;
    known.recheck(hour).unwrap().succeeded();
    assert!(known.recheck(hour).is_some());
}

#[test]
fn whatever_name_is_given_the_tokens_stands_before_it() {
    let desk = credential(time(9));
    assert_eq!(desk.author(None), "desk");
    assert_eq!(desk.author(Some(" ")), "desk");
    assert_eq!(desk.author(Some("desk")), "desk");
    assert_eq!(desk.author(Some("admin")), "desk: admin");
}

#[test]
fn who_may_hold_alone_holds_by_its_own_name_alone() {
    let owner = |name: &str| -> OwnerId { name.parse().unwrap() };
    let operator = credential(time(9));
    assert!(operator.may_hold_as(&owner("desk")) && operator.may_hold_as(&owner("gate")));
    for (rights, own, others) in [
        (vec![Right::Hold], true, false),
        (vec![Right::ReleaseHold], true, true),
        (vec![Right::Drive], false, false),
    ] {
        let limited = Credential {
            rights: rights.into(),
            ..credential(time(9))
        };
        assert_eq!(limited.may_hold_as(&owner("desk")), own);
        assert_eq!(limited.may_hold_as(&owner("gate")), others);
    }
}

#[test]
fn a_use_is_noted_now_and_then() {
    let known = credential(time(9_999));
    let noted = (0..3_600)
        .filter(|&second| known.touch(time(second)))
        .count();
    assert_eq!(noted, 6);
}
