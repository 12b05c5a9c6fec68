//! Both engines do the same: each call is made on either, and the answers are compared.

use std::collections::BTreeSet;
use std::path::Path;

use jiff::Timestamp;
use serde::de::DeserializeOwned;
use serde_json::{Value, json};
use tread_api::ids::{RobotId, SiteId};
use tread_api::rights::Scope;
use tread_store::{Fingerprint, Issued, RecordKey, SubjectId};

use crate::testing::with_database;
use crate::{
    alerts, attendance, audit, deferred_segments, enrolments, geofences, history, idempotency,
    join_tokens, missions, restorations, robots, sessions, sites, stops, terrains, times, tokens,
    webhooks, withdrawals,
};

/// A transaction of each engine.
struct EnginePair {
    sqlite: tread_store_sqlite::Tx,
    postgres: crate::Tx,
}

/// Calls a function of both engines, compares the answers and returns them.
macro_rules! both {
    ($both:ident, $module:ident :: $function:ident ($($argument:expr),* $(,)?)) => {{
        let call = stringify!($module::$function($($argument),*));
        let sqlite = tread_store_sqlite::$module::$function(&mut $both.sqlite, $($argument),*).await;
        let postgres = $module::$function(&mut $both.postgres, $($argument),*).await;
        let sqlite = sqlite.unwrap_or_else(|error| panic!("SQLite, {call}: {error:?}"));
        let postgres = postgres.unwrap_or_else(|error| panic!("PostgreSQL, {call}: {error:?}"));
        assert_eq!(sqlite, postgres, "{call}");
        postgres
    }};
}

/// The same for lists that have no order.
macro_rules! both_in_any_order {
    ($both:ident, $module:ident :: $function:ident ($($argument:expr),* $(,)?)) => {{
        let call = stringify!($module::$function($($argument),*));
        let sqlite = tread_store_sqlite::$module::$function(&mut $both.sqlite, $($argument),*).await;
        let postgres = $module::$function(&mut $both.postgres, $($argument),*).await;
        let (mut sqlite, mut postgres) = (sqlite.unwrap(), postgres.unwrap());
        sqlite.sort_by_key(|one| format!("{one:?}"));
        postgres.sort_by_key(|one| format!("{one:?}"));
        assert_eq!(sqlite, postgres, "{call}");
    }};
}

/// The same for answers with a secret, which are not shown.
macro_rules! both_secret {
    ($both:ident, $module:ident :: $function:ident ($($argument:expr),* $(,)?)) => {{
        let sqlite = tread_store_sqlite::$module::$function(&mut $both.sqlite, $($argument),*).await;
        let postgres = $module::$function(&mut $both.postgres, $($argument),*).await;
        assert!(sqlite.unwrap() == postgres.unwrap(), stringify!($module::$function));
    }};
}

fn of<T: DeserializeOwned>(value: Value) -> T {
    serde_json::from_value(value).unwrap()
}

fn id<T: DeserializeOwned>(number: u8) -> T {
    of(json!(format!(
        "0192f0c1-2b3c-7d4e-8f50-6172839400{number:02x}"
    )))
}

fn at(second: i64) -> Timestamp {
    Timestamp::from_second(1_700_000_000 + second).unwrap()
}

fn scopes() -> [Scope; 4] {
    let scope = |names: &[&str]| Scope::from_names(names.iter().copied()).unwrap();
    [
        Scope::EVERYWHERE,
        scope(&["yard"]),
        scope(&["yard/rover-2", "field"]),
        scope(&["nowhere"]),
    ]
}

fn site(name: &str) -> SiteId {
    name.parse().unwrap()
}

fn robot(name: &str) -> RobotId {
    name.parse().unwrap()
}

/// Runs a test on both engines, with the sites 1 (`yard`) and 2 (`field`, whose name has letters that a
/// collation of a language would sort otherwise), and the robots 1 to 3.
async fn with_both(test: &str, body: impl AsyncFnOnce(&mut EnginePair)) {
    with_database(test, async |database| {
        let file = std::env::temp_dir().join(format!("tread-parity-{}", uuid::Uuid::new_v4()));
        std::fs::create_dir(&file).unwrap();
        let sqlite = tread_store_sqlite::Db::open(Path::new(&file.join("tread.db"))).await.unwrap();
        let postgres = database.open().await;
        let mut both = EnginePair {
            sqlite: sqlite.write("db").await.unwrap(),
            postgres: postgres.write("db").await.unwrap(),
        };
        for (name, second) in [("yard", 0), ("field", 5), ("Zone_2", 9), ("a-b", 9), ("a_b", 9)] {
            let origin = (name == "yard").then(|| json!({"latitude_deg": 47.5, "longitude_deg": 8.25}));
            let Ok(id) = name.parse::<SiteId>() else { continue };
            let new = of(json!({
                "id": id, "name": format!("{name} Ä"), "grid": {"revision": 1, "cell_m": 0.1},
                "terrain_revision": 0, "origin": origin, "created_at": at(second),
            }));
            assert!(both!(both, sites::insert(&new)));
        }
        // Each robot says hello twice. Only PostgreSQL leaves gaps between the keys of what comes later.
        let hellos = [(1, "rover-1"), (1, "rover-2"), (2, "rover-1")];
        for (place, (site_pk, name)) in hellos.into_iter().cycle().take(6).enumerate() {
            let model = of(json!({
                "name": format!("{name} Ä"), "tyres": "rubber", "mass_kg": 50.0, "track_width_m": 0.6,
                "wheelbase_m": 0.5, "wheel_radius_m": 0.15, "yaw_inertia_kg_m2": 3.0,
                "limits": {
                    "linear_max_m_s": 2.0, "angular_max_rad_s": 1.5,
                    "linear_acceleration_max_m_s2": 1.0, "lateral_acceleration_max_m_s2": 1.0,
                    "linear_jerk_max_m_s3": 5.0, "wheel_speed_max_rad_s": 20.0,
                    "wheel_acceleration_max_rad_s2": 50.0,
                },
            }));
            let (id, capabilities) = (robot(name), of(json!({"pause": true})));
            let (boot, second) = if place < 3 { (1, 9) } else { (2, 3) };
            let hello = robots::Introduction {
                id: &id,
                boot: self::id(boot),
                agent_version: "1.0.0",
                model: &model,
                capabilities: &capabilities,
                at: at(second),
            };
            both!(both, robots::introduce(site_pk, hello, 500));
        }
        body(&mut both).await;
        drop(both);
        sqlite.close().await;
        postgres.close().await;
        std::fs::remove_dir_all(&file).unwrap();
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn sites_terrains_and_robots_are_the_same() {
    with_both("sites_terrains_and_robots_are_the_same", async |both| {
        let known = both!(both, sites::find(&site("yard"))).unwrap().site;
        assert!(!both!(both, sites::insert(&known)));
        for scope in scopes() {
            both!(both, sites::list(&scope, "", 10));
            both!(both, sites::list(&scope, "field", 1));
        }
        let row = both!(both, sites::find(&site("yard"))).unwrap();
        both!(both, sites::set_origin(row.pk, None));
        both!(both, sites::count_terrain_change(row.pk));
        both!(
            both,
            sites::set_horizons(
                1,
                tread_store::friction::Horizons {
                    days_before_h: 1_440,
                    months_before_h: 744,
                }
            )
        );
        both!(both, sites::find(&site("yard")));
        let polygon =
            json!([{"x_m": 0.0, "y_m": 0.0}, {"x_m": 9.5, "y_m": 0.0}, {"x_m": 0.0, "y_m": 9.0}]);
        for (name, revision, class) in [("mud", 1, "mud"), ("mud", 2, "mud"), ("grass", 1, "grass")]
        {
            let terrain = of(json!({
                "id": name, "revision": revision, "name": format!("Ä {revision}"), "class": class,
                "polygon": polygon, "layer": -revision, "updated_at": at(10 - revision),
            }));
            both!(both, terrains::put(1, &terrain));
        }
        both!(both, terrains::list(1));
        both!(both, terrains::find(1, &of(json!("mud"))));
        both!(both, terrains::count(1));
        both!(both, terrains::same_ground(1));
        both!(both, terrains::last_revision(1, &of(json!("mud"))));
        both!(both, terrains::last_revision(1, &of(json!("ice"))));
        assert!(both!(both, terrains::delete(1, &of(json!("grass")))));
        let fence = of(json!({"revision": 1, "keep_in": [polygon], "keep_out": []}));
        assert!(both!(both, geofences::insert(1, &fence, at(1))));
        assert!(!both!(both, geofences::insert(1, &fence, at(1))));
        both!(both, geofences::present(1));
        both!(both, geofences::present(2));

        let named = BTreeSet::from([robot("rover-2"), robot("other")]);
        for named in [None, Some(&named)] {
            both!(both, robots::list((1, named), "", false, 10));
            both!(both, robots::list((1, named), "rover-1", true, 1));
        }
        both!(both, robots::set_retired(2, Some(at(-9))));
        both!(both, robots::list((1, None), "", false, 10));
        both!(both, robots::find(1, &robot("rover-2")));
        both!(both, robots::set_retired(2, None));
        both!(both, robots::is_known(None, &robot("rover-2")));
        both!(
            both,
            robots::is_known(Some(&site("field")), &robot("rover-2"))
        );
        both!(both, robots::pk_of(&site("field"), &robot("rover-1")));
        both!(both, robots::rename(1, "Ä"));
        both!(both, robots::set_tags(1, &of(json!(["a", "b"]))));
        both!(both, robots::count_refused(1, 3, "why"));
        both!(both, robots::all(2));
        both!(both, robots::names());
        both!(both, robots::ids_by_key());
        both!(both, robots::of_site_by_key(1));
        let configurations = both!(both, robots::configurations_by_key());
        both!(both, robots::model_names());
        let configuration = configurations[&1];
        both!(both, robots::measured_configuration(1, configuration));
        both!(both, robots::record_measured(1, configuration));
        both!(both, robots::record_measured(1, configuration));
        both!(both, robots::measured_configuration(1, configuration));
        both!(both, robots::measured_count(1));
        for boot in 10..40 {
            let pk = both!(both, robots::boot_key(1, id(boot), 4));
            let key = RecordKey {
                boot_pk: pk,
                seq: 7,
            };
            assert!(!both!(both, history::has_report(key)));
            both!(both, history::record_report(key));
            assert!(both!(both, history::has_report(key)));
        }
        both!(both, robots::find_boot(1, id(10)));
        both!(both, robots::find_boot(1, id(39)));
        both!(both, attendance::set_present(1, true));
        both!(both, attendance::all("low"));
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn alerts_and_stops_are_the_same() {
    with_both("alerts_and_stops_are_the_same", async |both| {
        for (robot_pk, number, code) in [(1, 1, "low"), (2, 2, "low"), (3, 3, "hot"), (1, 4, "low")] {
            let report = of(json!({"code": code, "severity": "warning", "text": "Ä"}));
            both!(both, alerts::raise(robot_pk, id(number), &report, at(number.into())));
        }
        let location = alerts::AlertLocation {
            mission: Some(id(9)),
            place: Some(of(json!({"x_m": 1.5, "y_m": 0.1}))),
        };
        both!(both, alerts::locate(id(1), location));
        both!(both, alerts::acknowledge(id(1), at(-5)));
        both!(both, alerts::acknowledge(id(1), at(50)));
        both!(both, alerts::clear(2, &of(json!("low")), at(-5)));
        for scope in scopes() {
            for (raised, name) in [(false, None), (true, Some("yard"))] {
                let filter = alerts::AlertFilter {
                    site: name.map(site),
                    raised,
                    within: scope.clone(),
                    ..Default::default()
                };
                both!(both, alerts::list(&filter, 10));
            }
        }
        let filter = alerts::AlertFilter {
            robot: Some(robot("rover-1")),
            kind: Some(of(json!("low"))),
            before: Some(id(3)),
            ..Default::default()
        };
        both!(both, alerts::list(&filter, 10));
        both!(both, alerts::raised(10));
        both_in_any_order!(both, alerts::raised_about("low"));
        both!(both, alerts::raised_of(1));
        both!(both, alerts::find(id(2)));
        both!(both, attendance::all("low"));
        both!(both, alerts::prune(2, 1));
        both!(both, alerts::prune(2, 0));

        let stop = |number: u8, place: &str, name: &str, second: i64| {
            of::<tread_api::stop::Stop>(json!({
                "id": id::<String>(number), "site": place, "robot": name, "by": "anna's", "reason": "\"Ä\"",
                "requested_at": at(second), "confirmed_at": (number == 2).then(|| at(second)),
                "standstill_at": null, "unconfirmed": false, "clear_requested_by": null,
                "clear_requested_at": null, "cleared_at": null,
            }))
        };
        both!(both, stops::insert(&[stop(1, "yard", "rover-1", 5), stop(2, "field", "rover-1", 5)], 3));
        both!(both, stops::insert(&[stop(3, "yard", "rover-1", 7), stop(4, "yard", "nobody", 5)], 3));
        both!(both, stops::insert(&[stop(5, "yard", "rover-1", 6)], 3));
        both!(both, stops::insert(&[stop(6, "yard", "rover-1", 9), stop(7, "yard", "rover-2", 9)], 3));
        both!(both, stops::in_force());
        both!(both, stops::confirm(&[id(6), id(7)], at(1)));
        both!(both, stops::record_standstill(id(6), at(1)));
        both!(both, stops::unconfirm(id(7)));
        both!(both, stops::request_clear(id(6), "ben", at(2)));
        both!(both, stops::refuse_clear(id(6)));
        both!(both, stops::request_clear(id(6), "ben", at(20)));
        both!(both, stops::clear(id(6), at(3)));
        both!(both, stops::end(id(7), at(3)));
        both!(both, stops::adopt(1, &stop(3, "yard", "rover-1", 7), 2));
        both!(both, stops::adopt(2, &stop(3, "yard", "rover-1", 7), 2));
        both!(both, stops::adopt(2, &stop(8, "yard", "rover-2", 7), 1));
        for scope in scopes() {
            for (in_force, before) in [(false, None), (true, None), (false, Some(id(6)))] {
                let filter = stops::StopFilter {
                    in_force,
                    before,
                    within: scope.clone(),
                    ..Default::default()
                };
                both!(both, stops::list(&filter, 10));
            }
        }
        both!(both, stops::in_force_of(1));
        both!(both, stops::is_stopped(&site("yard"), &robot("rover-1")));
        both!(both, stops::find(id(3)));
        both!(both, times::newest());
        both!(both, times::newest_id());
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[expect(clippy::too_many_lines, reason = "one call after the other")]
async fn missions_and_restorations_are_the_same() {
    with_both("missions_and_restorations_are_the_same", async |both| {
        let trajectory = json!({"circle": {"center": {"x_m": 0.1, "y_m": 0.0}, "radius_m": 3.0,
            "speed_m_s": 0.6, "turns": 2.0}});
        let hash = id::<String>(77);
        let event = |from: Option<&str>, to: &str, second: i64| {
            of::<tread_api::mission::MissionEvent>(json!({"at": at(second), "actor": "server",
                "from": from, "to": to, "cause": "offered", "reason": "Ä"}))
        };
        for (number, robot_pk, priority) in [(1, 1, 0), (2, 1, 5), (3, 2, 0), (4, 3, -1)] {
            let mission: tread_api::mission::Mission = of(json!({
                "id": id::<String>(number), "site": "yard", "robot": "rover-1", "state": "queued",
                "reason": null, "cause": "requested", "pause_requested": number == 4, "revision": 1,
                "plan_hash": hash, "trajectory": trajectory, "replacement": null,
                "latest_start": at(100), "priority": priority, "link_policy": "continue",
                "lost_after_s": 2.5, "boot": null, "plan": null, "progress": null,
                "created_at": at(number.into()), "started_at": null, "ended_at": null,
            }));
            let inserted = missions::Inserted {
                state: mission.state,
                cause: mission.cause,
                reason: Some("Ä"),
            };
            let row = missions::MissionRow { robot_pk, mission };
            both!(both, missions::insert(&row, inserted));
            let second = (number == 3).then(|| event(Some("queued"), "offered", -5));
            both!(
                both,
                history::begin(id(number), &event(None, "queued", 1), second.as_ref())
            );
        }
        both!(
            both,
            history::add_event(id(1), &event(Some("queued"), "offered", -9))
        );
        both!(both, history::events(id(1), 10));
        both!(both, history::events(id(3), 10));
        both!(both, history::event_count(id(3)));
        both!(both, history::newest_step());
        both!(both, history::steps_after(2, 10));
        both_in_any_order!(both, missions::next_in_queues());
        both_in_any_order!(both, missions::overdue(at(101), 10));
        let queued = of(json!("queued"));
        let transition = missions::Transition {
            from: queued,
            to: of(json!("offered")),
            cause: of(json!("offered")),
            reason: None,
        };
        assert!(both!(both, missions::compare_and_set(id(2), transition)));
        assert!(!both!(both, missions::compare_and_set(id(2), transition)));
        let replacement = of(json!({"revision": 2, "plan_hash": hash,
            "trajectory": trajectory}));
        both!(both, missions::set_replacement(id(2), Some(&replacement)));
        let facts = missions::Facts {
            boot: Some(id(1)),
            plan: Some(of(
                json!({"length_m": 9.5, "duration_s": 0.1, "speed_peak_m_s": 1.0}),
            )),
            started_at: Some(at(-7)),
            ended_at: Some(at(-8)),
            ..Default::default()
        };
        both!(both, missions::add_facts(id(2), facts));
        both!(both, missions::set_silence(id(2), Some(at(3))));
        both!(both, missions::set_pause_requested(id(1), true));
        both_in_any_order!(both, missions::in_progress());
        both!(both, missions::open_of_robot(1));
        assert!(both!(both, missions::swap_content(id(2), 1, &replacement)));
        let driven = of(json!({"tolerance_m": 0.1, "points": []}));
        both!(both, missions::add_outcome(id(2), None, Some(&driven)));
        both!(both, missions::outcome(id(2)));
        both!(both, missions::outcome(id(77)));
        both!(both, missions::find(id(2)));
        for scope in scopes() {
            for (state, before, bytes_max) in
                [(None, Some(id(4)), 1 << 20), (Some(queued), None, 10)]
            {
                let filter = missions::MissionFilter {
                    state,
                    before,
                    within: scope.clone(),
                    ..Default::default()
                };
                both!(both, missions::list(&filter, 2, bytes_max));
            }
        }
        both_in_any_order!(both, missions::counts());

        let restoration = restorations::Restoration {
            restored_at: at(9),
            taken_at: at(8),
            version: "1.0.0".to_owned(),
        };
        both!(both, restorations::newest());
        both!(both, restorations::begin(&restoration));
        both!(both, restorations::newest());
        both!(both, restorations::enrolment_floor());
        both!(both, restorations::record_outcomes(1));
        both!(both, restorations::release(2));
        both!(both, restorations::release(2));
        both!(both, restorations::awaiting_count());
        both_in_any_order!(both, restorations::restricted());
        both!(both, geofences::present(1));
        let row = withdrawals::WithdrawalRow {
            pk: 0,
            robot_pk: 1,
            hours: withdrawals::Hours { from_h: 3, to_h: 9 },
            reason: "Ä".to_owned(),
            by: "anna".to_owned(),
            at: at(3),
        };
        both!(both, withdrawals::insert(&row));
        both!(both, withdrawals::insert(&row));
        both!(both, withdrawals::all());
        both!(both, withdrawals::count());
        both!(both, times::newest());
        both!(both, times::newest_id());
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[expect(clippy::too_many_lines, reason = "one call after the other")]
async fn identities_are_the_same() {
    with_both("identities_are_the_same", async |both| {
        let secret = |number: u8| Fingerprint::of(&number.to_string());
        for (number, scope) in (1..).zip(scopes()) {
            let role = (number != 3).then_some("admin");
            let token = of(json!({"id": id::<String>(number), "name": format!("desk {number}"), "role": role,
                "rights": if role.is_some() { json!([]) } else { json!(["read"]) },
                "sites": scope, "created_at": at(0), "created_by": "anna", "expires_at": at(99),
                "revoked_at": null, "last_used_at": null}));
            both!(both, tokens::insert(&token, &secret(number)));
        }
        both!(both, tokens::touch(id(2), at(5)));
        both!(both, tokens::touch(id(2), at(3)));
        for scope in scopes() {
            both!(both, tokens::list(&scope, None, 10));
            both!(both, tokens::list(&scope, Some(id(3)), 10));
            both!(both, tokens::valid_count_within(&scope, at(1)));
        }
        both!(both, tokens::find(id(3)));
        both!(both, tokens::by_lookup(&secret(2)));
        both!(both, tokens::valid_by_name("desk 1", at(1)));
        both!(both, tokens::valid_counts(at(1)));
        both_in_any_order!(both, tokens::all_valid(at(1)));

        let person = |name: &str, groups: &[&str]| {
            let person = of(json!({"id": id::<String>(9), "issuer": "https://id", "subject": name}));
            sessions::Owner::Person(sessions::SignedIn {
                person,
                name: name.to_owned(),
                groups: groups.iter().map(|group| (*group).to_owned()).collect(),
            })
        };
        let owners = [
            sessions::Owner::Token(id(1)),
            person("Ä", &["night", "admins"]),
            person("b", &["yard"]),
        ];
        for (number, owner) in (1..).zip(owners) {
            let session = sessions::NewSession {
                id: id(number),
                owner,
                fingerprint: secret(number),
                created_at: at(1),
                expires_at: at(50),
            };
            both!(both, sessions::insert(&session));
        }
        for (within, elsewhere, any) in [
            (&["admins", "yard"][..], &[][..], true),
            (&["yard"], &["admins"], false),
            (&[], &["yard"], true),
        ] {
            let filter = sessions::PeopleSessionFilter {
                issuer: "https://id",
                within,
                elsewhere,
                any,
                at: at(2),
                before: Some(id(4)),
            };
            both!(both, sessions::list(&filter, 10));
        }
        both!(both, sessions::touch(id(2), at(-3)));
        both!(both, sessions::by_lookup(&secret(2)));
        both!(both, sessions::find(id(1)));
        both!(both, sessions::count_of_people(at(2)));
        both!(both, sessions::surplus((None, Some(id(9))), 1));
        both!(both, sessions::surplus((Some(id(1)), None), 0));
        both!(both, sessions::delete(id(3)));
        both_in_any_order!(both, sessions::all_valid(at(2)));
        both!(both, tokens::revoke(id(1), at(-3)));
        both!(both, tokens::revoke(id(1), at(30)));
        both!(both, tokens::find(id(1)));
        both!(both, tokens::delete_ended(at(31), 10));
        both!(both, tokens::list(&Scope::EVERYWHERE, None, 10));
        both!(both, sessions::delete_expired(at(50)));
        both_in_any_order!(both, sessions::all_valid(at(2)));

        for (number, name) in [(1, None), (2, Some("rover-2")), (3, Some("rover-9"))] {
            let token = of(json!({"id": id::<String>(number), "site": "yard", "robot": name, "created_at": at(0),
                "created_by": "anna", "expires_at": at(9), "used_at": null, "used_by": null,
                "revoked_at": null}));
            both!(both, join_tokens::insert(&token, &secret(number)));
        }
        assert!(both!(both, join_tokens::consume(id(1), &robot("rover-1"), at(-1))));
        assert!(!both!(both, join_tokens::consume(id(1), &robot("rover-1"), at(1))));
        both!(both, join_tokens::revoke(id(2), at(-1)));
        for scope in scopes() {
            both!(both, join_tokens::list(&scope, Some(id(3)), 10));
            both!(both, join_tokens::valid_count_within(&scope, at(1)));
        }
        both!(both, join_tokens::valid_count(at(1)));
        both!(both, join_tokens::by_lookup(&secret(3)));
        both!(both, join_tokens::delete_ended(at(10), 2));
        both!(both, join_tokens::list(&Scope::EVERYWHERE, None, 10));
        let (yard, rover, issued) = (site("yard"), robot("rover-1"), Issued::one("f".to_owned()));
        for number in [1, 2] {
            let enrolment = of(json!({"site": "yard", "robot": "rover-1", "number": number,
                "enrolled_at": at(1), "join_token": id::<String>(1), "renewed_at": at(1),
                "expires_at": at(9), "revoked_at": null, "revoked_by": null, "authority": null}));
            both!(both, enrolments::revoke((&yard, &rover), "anna", at(-1)));
            both!(both, enrolments::insert(&enrolment, &issued));
        }
        let renewal = enrolments::Renewal {
            at: at(-2),
            expires_at: at(19),
            authority: "one",
            issued: &issued,
        };
        assert!(both!(both, enrolments::renew((&yard, &rover, 2), renewal)));
        assert!(!both!(both, enrolments::renew((&yard, &rover, 1), renewal)));
        both!(both, enrolments::record_authority((&yard, &rover, 2), "two"));
        both!(both, enrolments::accepted_certificates((&yard, &rover, 2)));
        both!(both, enrolments::accepted_certificates((&yard, &rover, 1)));
        let named = BTreeSet::from([robot("rover-2")]);
        both!(both, enrolments::list((&yard, None), "", 10));
        both!(both, enrolments::list((&yard, Some(&named)), "", 10));
        both!(both, enrolments::newest(&yard, &rover));
        both!(both, enrolments::all_newest());
        both!(both, enrolments::robot_count());
        both!(both, enrolments::delete_issued_certificates());
        both!(both, enrolments::accepted_certificates((&yard, &rover, 2)));
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn records_and_webhooks_are_the_same() {
    with_both("records_and_webhooks_are_the_same", async |both| {
        let entry = |second: i64, status: u16| {
            of::<tread_api::identity::AuditEntry>(json!({"id": 0, "at": at(second), "since": at(-1), "count": 2,
                "who": "Ä", "token": id::<String>(1), "role": "viewer", "address": "::1", "method": "PUT",
                "route": "/v1", "path": "/v1", "status": status, "request_id": "r", "what": {"b": 0.1, "a": [1]},
                "previous_hash": null, "hash": null}))
        };
        both!(both, audit::append(&[entry(5, 200), entry(3, 403)]));
        both!(both, audit::append(&[entry(4, 500)]));
        both!(both, audit::chain());
        for (refused, beyond, who) in [(false, None, None), (true, Some(2), Some("Ä")), (false, None, Some("b"))] {
            for order in ["newest", "oldest"] {
                let filter = audit::AuditFilter {
                    who: who.map(str::to_owned),
                    refused,
                    order: of(json!(order)),
                    beyond,
                };
                both!(both, audit::list(&filter, 10));
            }
        }
        let kept = audit::AuditRetention {
            since: at(0),
            newest_max: 1,
        };
        both!(both, audit::prune(kept, 10));
        both!(both, audit::chain());
        let owner = SubjectId::Token(id(1));
        let answer = idempotency::StoredAnswer {
            request_hash: id(7),
            answer: "Ä".to_owned(),
        };
        both!(both, idempotency::find((owner, "key"), id(7)));
        both!(both, idempotency::insert((owner, "key"), &answer, at(1)));
        both!(both, idempotency::find((owner, "key"), id(7)));
        both!(both, idempotency::delete_before(at(2), 10));
        both!(both, idempotency::find((owner, "key"), id(7)));

        for (number, kinds, places) in [
            (1, json!(null), json!(null)),
            (2, json!(["low"]), json!(["yard"])),
            (3, json!(["hot"]), json!(null)),
        ] {
            let webhook = of(json!({"id": id::<String>(number), "name": format!("hook {number}"),
                "url": "https://example.org", "kinds": kinds, "sites": places, "enabled": true,
                "created_at": at(0), "created_by": "anna", "pending": 0}));
            both!(both, webhooks::insert(&webhook, "secret"));
        }
        for (kind, name) in [("low", Some("yard")), ("low", Some("field")), ("hot", None)] {
            let place = name.map(site);
            both_secret!(both, webhooks::interested(&of(json!(kind)), place.as_ref()));
        }
        for (number, hook, event) in [(1, 1, "opened"), (2, 1, "ended"), (3, 2, "test"), (4, 1, "opened")] {
            let delivery = webhooks::NewDelivery {
                id: id(number),
                webhook: id(hook),
                alert: (event != "test").then(|| id(8)),
                event: of(json!(event)),
                kind: of(json!("low")),
                body: "{}".to_owned(),
                at: at(number.into()),
            };
            both!(both, webhooks::queue(&delivery));
            both!(both, webhooks::queue(&delivery));
        }
        let webhook = both!(both, webhooks::find(id(2))).unwrap();
        let settings = tread_api::webhook::WebhookSettings {
            enabled: false,
            ..webhook.settings()
        };
        assert!(both!(both, webhooks::replace(id(2), &settings)));
        both!(both, webhooks::set_secret(id(1), "other"));
        both!(both, webhooks::drop_oldest(id(1), 2, at(9)));
        both_secret!(both, webhooks::due(webhooks::DueTimes { now: at(9), latest: at(99) }));
        let outcome = webhooks::Outcome {
            webhook: id(1),
            id: id(2),
            state: of(json!("pending")),
            at: at(9),
            due_at: at(19),
            status: Some(503),
            detail: Some("Ä".to_owned()),
        };
        both!(both, webhooks::record_attempt(&outcome));
        both!(both, webhooks::deliveries(id(1), Some(id(9)), 10));
        both!(both, webhooks::has_older(at(4)));
        let limit = webhooks::AgeLimit {
            now: at(9),
            oldest: at(4),
        };
        both!(both, webhooks::abandon_oldest(limit));
        both!(both, webhooks::pending_count());
        both!(both, webhooks::list(Some(id(3)), 10));
        both!(both, webhooks::count());
        both!(both, webhooks::prune(id(1), 1));
        both!(both, webhooks::deliveries(id(1), None, 10));
        assert!(both!(both, webhooks::delete(id(1))));
        both!(both, webhooks::deliveries(id(1), None, 10));
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn deferred_segments_are_the_same() {
    with_both("deferred_segments_are_the_same", async |both| {
        let raw = serde_json::value::RawValue::from_string("{\"a\":0.1}".to_owned()).unwrap();
        let origin = |seq| deferred_segments::Origin {
            key: RecordKey { boot_pk: 1, seq },
            site_pk: 1,
            robot_pk: 1,
        };
        let times = deferred_segments::DeferredTimes {
            ended_at: at(1),
            received_at: at(2),
        };
        assert!(both!(both, deferred_segments::put(origin(4), times, &raw)));
        assert!(!both!(both, deferred_segments::put(origin(4), times, &raw)));
        both!(both, deferred_segments::count(1));
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn tables_columns_and_indexes_are_the_same() {
    with_both("tables_columns_and_indexes_are_the_same", async |both| {
        let columns: Vec<(String, String, bool)> = sqlx::query_as(
            "SELECT tables.name, columns.name, columns.\"notnull\" = 1 OR columns.pk > 0
             FROM sqlite_schema AS tables JOIN pragma_table_info(tables.name) AS columns
             WHERE tables.type = 'table' AND tables.name NOT LIKE 'sqlite_%'
                 AND tables.name <> '_sqlx_migrations'
             ORDER BY 1, 2",
        )
        .fetch_all(&mut *both.sqlite)
        .await
        .unwrap();
        let ours: Vec<(String, String, bool)> = sqlx::query_as(
            "SELECT CAST(table_name AS TEXT) COLLATE \"C\", CAST(column_name AS TEXT) COLLATE \"C\",
                 is_nullable = 'NO'
             FROM information_schema.columns JOIN pg_tables ON tablename = table_name
             WHERE table_schema = current_schema() AND schemaname = table_schema
                 AND table_name NOT IN
                     ('_sqlx_migrations', 'write_probe', 'segment_partitions', 'server_epoch')
             ORDER BY 1, 2",
        )
        .fetch_all(&mut *both.postgres)
        .await
        .unwrap();
        assert!(columns.len() > 250, "found only {} columns", columns.len());
        assert_eq!(ours, columns);
        let indexes: Vec<(String, bool, bool)> = sqlx::query_as(
            "SELECT indexes.name, indexes.\"unique\" = 1, indexes.partial = 1
             FROM sqlite_schema AS tables JOIN pragma_index_list(tables.name) AS indexes
             WHERE tables.type = 'table' AND indexes.origin = 'c'
             ORDER BY 1",
        )
        .fetch_all(&mut *both.sqlite)
        .await
        .unwrap();
        let ours: Vec<(String, bool, bool)> = sqlx::query_as(
            "SELECT CAST(relname AS TEXT) COLLATE \"C\", indisunique, indpred IS NOT NULL
             FROM pg_index JOIN pg_class ON pg_class.oid = indexrelid
             WHERE relnamespace = to_regnamespace(current_schema())
                 AND NOT EXISTS (SELECT 1 FROM pg_constraint WHERE conindid = indexrelid)
             ORDER BY 1",
        )
        .fetch_all(&mut *both.postgres)
        .await
        .unwrap();
        assert_eq!(ours, indexes);
    })
    .await;
}
