//! Every write path of the server, each as something that is prepared while all works, and an act
//! in which a call fails.

use std::collections::BTreeSet;
use std::pin::Pin;
use std::time::Duration;

use jiff::{SignedDuration, Timestamp};
use serde::de::DeserializeOwned;
use serde_json::{Value, json};
use tread_api::ids::{
    AlertId, BootId, ConfigurationId, DeliveryId, MissionId, OidcSubject, PersonId, SessionId,
    TokenId,
};
use tread_api::mission::{Cause, MissionState, Replacement};
use tread_api::webhook::{DeliveryState, NoticeEvent, Webhook};
use tread_server::app::AppError;
use tread_server::authority::Issued;
use tread_server::config::RetentionConfig;
use tread_server::db::alerts::AlertLocation;
use tread_server::db::audit::AuditRetention;
use tread_server::db::deferred_segments::{DeferredFilter, DeferredTimes, Origin};
use tread_server::db::enrolments::Renewal;
use tread_server::db::idempotency::StoredAnswer;
use tread_server::db::missions::{Facts, Transition};
use tread_server::db::restorations::Restoration;
use tread_server::db::robots::Introduction;
use tread_server::db::sessions::{NewSession, Owner, PeopleSessionFilter, SignedIn};
use tread_server::db::webhooks::{AgeLimit, NewDelivery, Outcome};
use tread_server::db::withdrawals::{Hours, WithdrawalRow};
use tread_server::db::{self, RecordKey};
use tread_server::identity::secret::{Fingerprint, Kind, Secret};
use tread_server::identity::subject::SubjectId;

use crate::ground::{Ground, boot, hello, mission, now, segment, uuid};

type Writing<'ground> = Pin<Box<dyn Future<Output = Result<(), AppError>> + Send + 'ground>>;
type Write = for<'ground> fn(&'ground Ground, u64) -> Writing<'ground>;

/// One way in which the server writes; the number names what is new.
pub(crate) struct WritePath {
    pub(crate) name: &'static str,
    pub(crate) prepare: Write,
    pub(crate) act: Write,
}

fn nothing(_ground: &Ground, _number: u64) -> Writing<'_> {
    Box::pin(async { Ok(()) })
}

/// What JSON says, as a type of the API.
fn of<T: DeserializeOwned>(value: Value) -> T {
    serde_json::from_value(value).unwrap()
}

fn fingerprint(kind: Kind, number: u64) -> Fingerprint {
    let mut random = [0; 32];
    random[..8].copy_from_slice(&number.to_le_bytes());
    Secret::from_random(kind, &random).fingerprint()
}

fn token(number: u64) -> TokenId {
    TokenId::from_uuid(uuid(number))
}

fn later() -> Timestamp {
    now() + SignedDuration::from_hours(24)
}

/// Runs of a robot's agent that are kept.
const RUNS_KEPT: u32 = 3;
/// Stops of a robot that are kept.
const STOPS_KEPT: u32 = 3;

const LONG_AGO: Timestamp = Timestamp::UNIX_EPOCH;

pub(crate) const PATHS: &[WritePath] = &[
    WritePath {
        name: "site",
        prepare: nothing,
        act: |ground, number| {
            Box::pin(ground.write(async move |tx| {
                let site = of(json!({
                    "id": format!("site-{number}"), "name": "a site", "terrain_revision": 0,
                    "grid": {"revision": 1, "cell_m": 1.0}, "created_at": now(),
                }));
                db::sites::insert(tx, &site).await?;
                let row = db::sites::find(tx, &site.id).await?;
                let pk = row.map_or(0, |row| row.pk);
                let origin =
                    of(json!({"latitude_deg": 48.0, "longitude_deg": 11.0, "x_axis_deg": 90.0}));
                db::sites::set_origin(tx, pk, Some(origin)).await?;
                db::sites::count_terrain_change(tx, pk).await
            }))
        },
    },
    WritePath {
        name: "terrain",
        prepare: nothing,
        act: |ground, number| {
            Box::pin(ground.write(async move |tx| {
                let square = json!([{"x_m": -90, "y_m": -90}, {"x_m": 90, "y_m": -90}, {"x_m": 90, "y_m": 90},
                    {"x_m": -90, "y_m": 90}]);
                let terrain = of(json!({
                    "id": format!("lawn-{number}"), "revision": 1, "name": "a lawn", "class": "grass",
                    "polygon": square, "layer": 0, "updated_at": now(),
                }));
                db::terrains::put(tx, ground.site_pk, &terrain).await?;
                let geofence = of(json!({"revision": number, "keep_in": [square], "keep_out": []}));
                db::geofences::insert(tx, ground.site_pk, &geofence, now()).await?;
                db::terrains::delete(tx, ground.site_pk, &terrain.id).await.map(|_| ())
            }))
        },
    },
    WritePath {
        name: "robot",
        prepare: nothing,
        act: |ground, number| {
            Box::pin(ground.write(async move |tx| {
                let id = format!("rover-{number}").parse().unwrap();
                let hello = hello(&id, number);
                let introduction = Introduction {
                    id: &id,
                    boot: hello.boot,
                    agent_version: &hello.agent_version,
                    model: &hello.model,
                    capabilities: &hello.capabilities,
                    at: now(),
                };
                db::robots::introduce(tx, ground.site_pk, introduction, RUNS_KEPT).await?;
                db::robots::rename(tx, ground.robot_pk, &format!("rover {number}")).await?;
                let tags = BTreeSet::from([format!("tag-{number}").parse().unwrap()]);
                db::robots::set_tags(tx, ground.robot_pk, &tags).await?;
                db::robots::set_retired(tx, ground.robot_pk, Some(now())).await?;
                db::robots::set_retired(tx, ground.robot_pk, None).await?;
                db::robots::count_refused(tx, ground.robot_pk, 1, "a test").await?;
                db::attendance::set_present(tx, ground.robot_pk, true).await?;
                let other = BootId::from_uuid(uuid(number));
                db::robots::boot_key(tx, ground.robot_pk, other, RUNS_KEPT).await?;
                let configuration: ConfigurationId = of(json!(format!("{number:032x}")));
                db::robots::record_measured(tx, ground.robot_pk, configuration)
                    .await
                    .map(|_| ())
            }))
        },
    },
    WritePath {
        name: "restoration of a backup",
        prepare: nothing,
        act: |ground, number| {
            Box::pin(ground.write(async move |tx| {
                let version = format!("0.0.{number}");
                db::schema::record_version(tx, &version, now()).await?;
                let restoration = Restoration {
                    restored_at: now(),
                    taken_at: LONG_AGO,
                    version,
                };
                db::restorations::begin(tx, &restoration).await?;
                db::restorations::record_outcomes(tx, ground.robot_pk).await?;
                db::restorations::release(tx, ground.robot_pk)
                    .await
                    .map(|_| ())
            }))
        },
    },
    WritePath {
        name: "mission created once for a key",
        prepare: |ground, _number| Box::pin(end_missions(ground)),
        act: |ground, number| {
            Box::pin(async move {
                let request = mission(&ground.site, &ground.robot);
                let key = format!("key-{number}");
                let own = (SubjectId::Token(token(7)), &*key);
                ground.app.create_mission_once(own, request).await?;
                ground
                    .write(async |tx| db::idempotency::delete_before(tx, LONG_AGO, 10).await)
                    .await
            })
        },
    },
    WritePath {
        name: "mission cancelled",
        prepare: |ground, _number| {
            Box::pin(async move {
                end_missions(ground).await?;
                let request = mission(&ground.site, &ground.robot);
                ground.app.create_mission(request).await.map(|_| ())
            })
        },
        act: |ground, _number| {
            Box::pin(async move {
                for id in open_missions(ground).await? {
                    ground.app.cancel_mission(id).await?;
                }
                Ok(())
            })
        },
    },
    WritePath {
        name: "what becomes of a mission",
        prepare: nothing,
        act: |ground, number| {
            Box::pin(ground.write(async move |tx| {
                let id = ground.mission;
                let facts = Facts {
                    boot: Some(boot()),
                    plan: None,
                    progress: None,
                    started_at: Some(now()),
                    ended_at: None,
                };
                db::missions::add_facts(tx, id, facts).await?;
                let replacement = Replacement {
                    revision: 2,
                    plan_hash: of(json!(format!("{number:032x}"))),
                    trajectory: mission(&ground.site, &ground.robot).trajectory,
                };
                db::missions::set_pause_requested(tx, id, number % 2 == 0).await?;
                db::missions::set_replacement(tx, id, Some(&replacement)).await?;
                db::missions::swap_content(tx, id, 1, &replacement).await?;
                db::missions::set_silence(tx, id, Some(now())).await?;
                db::missions::add_outcome(tx, id, None, None).await?;
                let queued = MissionState::Queued;
                let transition = Transition {
                    from: queued,
                    to: queued,
                    cause: Cause::Returned,
                    reason: None,
                };
                db::missions::compare_and_set(tx, id, transition).await?;
                let event = of(json!({"at": now(), "actor": "server", "from": "queued",
                    "to": "queued", "cause": "recorded", "reason": "a test"}));
                db::history::add_event(tx, id, &event).await?;
                let boot_pk = db::robots::boot_key(tx, ground.robot_pk, boot(), RUNS_KEPT).await?;
                let seq = i64::try_from(number).unwrap_or_default();
                db::history::record_report(tx, RecordKey { boot_pk, seq }).await
            }))
        },
    },
    WritePath {
        name: "upload",
        prepare: |ground, _number| Box::pin(async move { Ok(ground.app.write_sums().await?) }),
        act: |ground, number| {
            Box::pin(async move {
                let records = vec![segment(10 * number), segment(10 * number + 1)];
                let receipt = ground.upload(records).await?;
                assert_eq!((receipt.committed, receipt.duplicates), (2, 0));
                Ok(())
            })
        },
    },
    WritePath {
        name: "sums of the map",
        prepare: |ground, number| {
            Box::pin(async move {
                // What the act stores is always the same number of sums.
                ground.app.write_sums().await?;
                let records = vec![segment(10 * number), segment(10 * number + 1)];
                ground.upload(records).await.map(|_| ())
            })
        },
        act: |ground, _number| Box::pin(async move { Ok(ground.app.write_sums().await?) }),
    },
    WritePath {
        name: "measurement that waits for its clock",
        prepare: nothing,
        act: |ground, number| {
            Box::pin(ground.write(async move |tx| {
                let boot_pk = db::robots::boot_key(tx, ground.robot_pk, boot(), RUNS_KEPT).await?;
                let seq = i64::try_from(10 * number + 5).unwrap_or_default();
                let origin = Origin {
                    key: RecordKey { boot_pk, seq },
                    site_pk: ground.site_pk,
                    robot_pk: ground.robot_pk,
                };
                let measurement = serde_json::value::RawValue::from_string("{}".to_owned());
                let times = DeferredTimes {
                    ended_at: later(),
                    received_at: later(),
                };
                db::deferred_segments::put(tx, origin, times, &measurement.unwrap()).await?;
                let filter = DeferredFilter {
                    boot_pk,
                    ended_until_us: 0,
                };
                db::deferred_segments::take(tx, filter, 10)
                    .await
                    .map(|_| ())
            }))
        },
    },
    WritePath {
        name: "archive mark",
        prepare: nothing,
        act: |ground, number| {
            Box::pin(async move {
                let mut tx = ground.app.db().write_uncounted("archive").await?;
                let last = i64::try_from(number).unwrap() + 1;
                db::archive_mark::set(&mut tx, 1..=last).await?;
                Ok(tx.commit().await?)
            })
        },
    },
    WritePath {
        name: "retention",
        prepare: |ground, number| {
            Box::pin(async move {
                let records = (0..2).map(|one| segment(10 * number + one)).collect();
                ground.upload(records).await?;
                ground.app.write_sums().await?;
                // Some of what the act removes first is not in the stored sums yet.
                let records = (2..6).map(|one| segment(10 * number + one)).collect();
                ground.upload(records).await.map(|_| ())
            })
        },
        act: |ground, _number| {
            Box::pin(async move {
                let config = RetentionConfig {
                    segments_max: 2,
                    ..RetentionConfig::default()
                };
                ground.app.remove_some(&config, 10).await.map(|_| ())
            })
        },
    },
    WritePath {
        name: "hours merged into days",
        prepare: |ground, number| {
            Box::pin(async move {
                let records = (0..4).map(|one| segment(10 * number + one)).collect();
                ground.upload(records).await?;
                ground.app.write_sums().await?;
                ground.app.clock().advance(Duration::from_hours(24));
                Ok(())
            })
        },
        act: |ground, _number| {
            Box::pin(async move {
                ground.app.move_horizons().await?;
                ground.app.merge_some(50).await.map(|_| ())
            })
        },
    },
    WritePath {
        name: "alert",
        prepare: nothing,
        act: |ground, number| {
            Box::pin(ground.write(async move |tx| {
                let id = AlertId::from_uuid(uuid(number));
                let report: tread_api::robot::AlertReport =
                    of(json!({"code": "test-alert", "severity": "warning", "text": "a test"}));
                db::alerts::raise(tx, ground.robot_pk, id, &report, now()).await?;
                let shown = of(json!({"x_m": 1.0, "y_m": 2.0}));
                let location = AlertLocation {
                    mission: Some(ground.mission),
                    place: Some(shown),
                };
                db::alerts::locate(tx, id, location).await?;
                db::alerts::acknowledge(tx, id, now()).await?;
                db::alerts::clear(tx, ground.robot_pk, &report.code, now()).await?;
                db::alerts::prune(tx, ground.robot_pk, 3).await
            }))
        },
    },
    WritePath {
        name: "webhook",
        prepare: nothing,
        act: |ground, number| {
            Box::pin(ground.write(async move |tx| {
                let webhook: Webhook = of(json!({
                    "id": uuid(number), "name": format!("webhook {number}"),
                    "url": "https://alerts.example.org/", "kinds": ["robot-lost"],
                    "sites": [ground.site], "enabled": true, "created_at": now(),
                    "created_by": "a test", "pending": 0,
                }));
                db::webhooks::insert(tx, &webhook, "a secret").await?;
                db::webhooks::replace(tx, webhook.id, &webhook.settings()).await?;
                db::webhooks::set_secret(tx, webhook.id, "another secret").await?;
                for one in 0..3 {
                    let delivery = NewDelivery {
                        id: DeliveryId::from_uuid(uuid(10 * number + one)),
                        webhook: webhook.id,
                        alert: None,
                        event: NoticeEvent::Test,
                        kind: of(json!("test")),
                        body: "{}".to_owned(),
                        at: now(),
                    };
                    db::webhooks::queue(tx, &delivery).await?;
                }
                db::webhooks::drop_oldest(tx, webhook.id, 2, now()).await?;
                let outcome = Outcome {
                    webhook: webhook.id,
                    id: DeliveryId::from_uuid(uuid(10 * number + 1)),
                    state: DeliveryState::Delivered,
                    at: now(),
                    due_at: now(),
                    status: Some(200),
                    detail: None,
                };
                db::webhooks::record_attempt(tx, &outcome).await?;
                let limit = AgeLimit {
                    now: now(),
                    oldest: later(),
                };
                db::webhooks::abandon_oldest(tx, limit).await?;
                db::webhooks::prune(tx, webhook.id, 1).await?;
                db::webhooks::delete(tx, webhook.id).await.map(|_| ())
            }))
        },
    },
    WritePath {
        name: "stop",
        prepare: nothing,
        act: |ground, number| {
            Box::pin(ground.write(async move |tx| {
                let stop: tread_api::stop::Stop = of(json!({
                    "id": uuid(number), "site": ground.site, "robot": ground.robot, "by": "a test",
                    "reason": "a test", "requested_at": now(), "confirmed_at": null,
                    "unconfirmed": false, "clear_requested_by": null, "clear_requested_at": null,
                    "cleared_at": null, "replaced_by": null,
                }));
                db::stops::insert(tx, std::slice::from_ref(&stop), STOPS_KEPT).await?;
                db::stops::adopt(tx, ground.robot_pk, &stop, STOPS_KEPT).await?;
                db::stops::confirm(tx, &[stop.id], now()).await?;
                db::stops::record_standstill(tx, stop.id, now()).await?;
                db::stops::unconfirm(tx, stop.id).await?;
                db::stops::request_clear(tx, stop.id, "a test", now()).await?;
                db::stops::refuse_clear(tx, stop.id).await?;
                db::stops::clear(tx, stop.id, now()).await?;
                db::stops::end(tx, stop.id, now()).await
            }))
        },
    },
    WritePath {
        name: "token and session",
        prepare: nothing,
        act: |ground, number| {
            Box::pin(ground.write(async move |tx| {
                let id = TokenId::from_uuid(uuid(number));
                let token = of(json!({
                    "id": id, "name": format!("token {number}"), "role": "viewer", "rights": ["stop", "read"], "sites": null,
                    "created_at": now(), "created_by": "a test", "expires_at": later(),
                    "revoked_at": null, "last_used_at": null,
                }));
                let kind = Kind::Token(Some(tread_api::identity::Role::Viewer));
                db::tokens::insert(tx, &token, &fingerprint(kind, number)).await?;
                let session = NewSession {
                    id: SessionId::from_uuid(uuid(number)),
                    owner: Owner::Token(id),
                    fingerprint: fingerprint(Kind::Session, number),
                    created_at: now(),
                    expires_at: later(),
                };
                db::sessions::insert(tx, &session).await?;
                db::sessions::delete_expired(tx, LONG_AGO).await?;
                db::sessions::surplus(tx, (Some(id), None), 20).await?;
                db::sessions::delete(tx, session.id).await?;
                db::tokens::touch(tx, id, now()).await?;
                db::tokens::revoke(tx, id, now()).await?;
                db::tokens::delete_ended(tx, LONG_AGO, 10).await
            }))
        },
    },
    WritePath {
        name: "session of a person",
        prepare: nothing,
        act: |ground, number| {
            Box::pin(ground.write(async move |tx| {
                let issuer = "https://login.test";
                let subject = format!("person {number}");
                let id = PersonId::of(OidcSubject {
                    issuer,
                    subject: &subject,
                });
                let signed_in = SignedIn {
                    person: of(json!({
                        "id": id, "issuer": issuer, "subject": subject,
                    })),
                    name: "anna".to_owned(),
                    groups: vec!["operators".to_owned()],
                };
                let session = NewSession {
                    id: SessionId::from_uuid(uuid(number)),
                    owner: Owner::Person(signed_in),
                    fingerprint: fingerprint(Kind::Session, number),
                    created_at: now(),
                    expires_at: later(),
                };
                let filter = PeopleSessionFilter {
                    issuer,
                    within: &["operators"],
                    elsewhere: &[],
                    any: false,
                    at: LONG_AGO,
                    before: None,
                };
                db::sessions::count_of_people(tx, LONG_AGO).await?;
                db::sessions::insert(tx, &session).await?;
                db::sessions::touch(tx, session.id, now()).await?;
                db::sessions::list(tx, &filter, 10).await?;
                db::sessions::find(tx, session.id).await?;
                db::sessions::delete(tx, session.id).await
            }))
        },
    },
    WritePath {
        name: "audit log",
        prepare: nothing,
        act: |ground, _number| {
            Box::pin(ground.write(async move |tx| {
                let entry = of(json!({
                    "id": 0, "at": now(), "since": null, "count": 1, "who": "a test", "token": null, "role": null,
                    "address": "127.0.0.1", "method": "GET", "route": "/", "path": "/",
                    "status": 200, "request_id": "1", "what": null,
                    "previous_hash": null, "hash": null,
                }));
                let entries = [entry];
                db::audit::append(tx, &entries).await?;
                db::audit::append(tx, &entries).await?;
                let kept = AuditRetention {
                    since: LONG_AGO,
                    newest_max: 1,
                };
                db::audit::prune(tx, kept, 10).await
            }))
        },
    },
    WritePath {
        name: "robot that joins",
        prepare: nothing,
        act: |ground, number| {
            Box::pin(ground.write(async move |tx| {
                let token: tread_api::enrolment::JoinToken = of(json!({
                    "id": uuid(number), "site": ground.site, "robot": null, "created_at": now(),
                    "created_by": "a test", "expires_at": later(), "used_at": null,
                    "used_by": null, "revoked_at": null,
                }));
                let secret = fingerprint(Kind::Join, number);
                db::join_tokens::insert(tx, &token, &secret).await?;
                db::join_tokens::consume(tx, token.id, &ground.robot, now()).await?;
                db::join_tokens::revoke(tx, token.id, now()).await?;
                db::join_tokens::delete_ended(tx, LONG_AGO, 10).await?;
                let enrolment = of(json!({
                    "site": ground.site, "robot": ground.robot, "number": number,
                    "enrolled_at": now(), "join_token": token.id, "renewed_at": now(),
                    "expires_at": later(), "revoked_at": null, "revoked_by": null,
                }));
                let issued = Issued::one(format!("certificate {number}"));
                db::enrolments::insert(tx, &enrolment, &issued).await?;
                let one = (&ground.site, &ground.robot, enrolment.number);
                let renewal = Renewal {
                    at: now(),
                    expires_at: later(),
                    authority: "former",
                    issued: &issued,
                };
                db::enrolments::renew(tx, one, renewal).await?;
                db::enrolments::delete_issued_certificates(tx).await?;
                db::enrolments::record_authority(tx, one, "next").await?;
                db::enrolments::revoke(tx, (&ground.site, &ground.robot), "a test", now()).await
            }))
        },
    },
    WritePath {
        name: "withdrawal",
        prepare: nothing,
        act: |ground, _number| {
            Box::pin(ground.write(async move |tx| {
                // Hours in which nothing was measured.
                let hours = Hours { from_h: 1, to_h: 2 };
                let row = WithdrawalRow {
                    pk: 0,
                    robot_pk: ground.robot_pk,
                    hours,
                    reason: "a test".to_owned(),
                    by: "a test".to_owned(),
                    at: now(),
                };
                db::withdrawals::insert(tx, &row).await?;
                db::sums::remove_hours(tx, ground.robot_pk, hours)
                    .await
                    .map(|_| ())
            }))
        },
    },
    WritePath {
        name: "idempotency key kept by itself",
        prepare: nothing,
        act: |ground, number| {
            Box::pin(ground.write(async move |tx| {
                let stored = StoredAnswer {
                    request_hash: uuid(number),
                    answer: "{}".to_owned(),
                };
                let key = format!("alone-{number}");
                db::idempotency::insert(tx, (SubjectId::Token(token(7)), &key), &stored, now())
                    .await
            }))
        },
    },
    WritePath {
        name: "log brought into the file",
        prepare: |ground, _number| Box::pin(async { Ok(ground.app.db().probe_write().await?) }),
        act: |ground, _number| Box::pin(async { Ok(ground.app.db().checkpoint().await?) }),
    },
];

async fn open_missions(ground: &Ground) -> Result<Vec<MissionId>, AppError> {
    let mut tx = ground.app.db().read("test").await?;
    let open = db::missions::open_of_robot(&mut tx, ground.robot_pk).await?;
    let others = open.into_iter().map(|one| one.id);
    Ok(others.filter(|id| *id != ground.mission).collect())
}

async fn end_missions(ground: &Ground) -> Result<(), AppError> {
    for id in open_missions(ground).await? {
        ground.app.cancel_mission(id).await?;
    }
    Ok(())
}
