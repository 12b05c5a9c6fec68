use std::io;

use super::*;
use crate::app::Dependencies;
use crate::app::identity::SESSION_LIFETIME_MAX;
use crate::clock::Clock;
use crate::config::oidc::SESSION_HOURS_RANGE;
use crate::db::Db;

/// What is logged.
#[derive(Debug, Clone, Default)]
struct Log(Arc<Mutex<Vec<u8>>>);

impl Log {
    fn text(&self) -> String {
        String::from_utf8(self.0.lock().unwrap().clone()).unwrap()
    }
}

impl io::Write for Log {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.lock().unwrap().write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

#[test]
fn a_person_is_signed_in_for_no_longer_than_a_token() {
    let most = i64::from(*SESSION_HOURS_RANGE.end());
    assert_eq!(SignedDuration::from_hours(most), SESSION_LIFETIME_MAX);
}

#[tokio::test]
async fn a_sign_in_that_is_sent_to_another_name_is_logged_once_with_both_names() {
    let folder = tempfile::tempdir().unwrap();
    let db = Db::open(&folder.path().join("tread.db")).await.unwrap();
    let clock = Clock::manual(Timestamp::UNIX_EPOCH);
    let config = r#"
        issuer = "https://login.example.org"
        client_id = "tread"
        public_url = "https://tread.example.org"
        [groups.admins]
        role = "admin"
    "#;
    let people = People::new(&toml::from_str(config).unwrap(), clock.clone()).unwrap();
    let app = App::new(Dependencies {
        people: Some(people),
        ..Dependencies::on_database(db, clock)
    });

    let log = Log::default();
    let writer = log.clone();
    let subscriber = tracing_subscriber::fmt()
        .with_writer(move || writer.clone())
        .with_ansi(false)
        .finish();
    let proxied = Provenance {
        host: Some("10.0.0.7:8420\u{1b}[31m"),
        ..Provenance::default()
    };
    tracing::subscriber::with_default(subscriber, || {
        for _ in 0..3 {
            let begun = app.begin_sign_in(&proxied).unwrap();
            assert_eq!(begun.location, "https://tread.example.org/");
        }
    });
    let text = log.text();
    assert_eq!(text.lines().count(), 1, "{text}");
    for wanted in ["ERROR", "`10.0.0.7:8420", "https://tread.example.org"] {
        assert!(text.contains(wanted), "{wanted}: {text}");
    }
    assert!(!text.contains('\u{1b}'), "{text}");
}
