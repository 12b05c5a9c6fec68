use std::net::Ipv4Addr;
use std::path::Path;
use std::sync::OnceLock;

use jiff::SignedDuration;
use rcgen::{CertificateParams, KeyPair};
use tread_api::enrolment::CreateJoinToken;
use tread_api::rights::Scope;

use super::*;
use crate::app::Dependencies;
use crate::authority::{Authorities, Authority};
use crate::clock::Clock;
use crate::db::Db;

fn start() -> Timestamp {
    "2026-06-01T12:00:00Z".parse().unwrap()
}

/// A server whose clock replaces the fleet's authority each time that it is read, once the switch is set.
async fn app(folder: &Path, authorities: &Arc<Authorities>, switch: &Arc<OnceLock<()>>) -> App {
    let (replaced, switch) = (Arc::clone(authorities), Arc::clone(switch));
    let clock = Clock::of_site(move || {
        if switch.get().is_some() {
            let signing = replaced.present().signing().fingerprint().to_owned();
            replaced.replace(&signing, start()).unwrap();
        }
        start()
    });
    App::new(Dependencies {
        enrolment: Some(EnrolmentService {
            authorities: Arc::clone(authorities),
            lifetime: SignedDuration::from_hours(24),
            port: 7447,
        }),
        ..Dependencies::on_database(Db::open(&folder.join("tread.db")).await.unwrap(), clock)
    })
}

#[tokio::test]
async fn no_certificate_of_an_authority_that_is_trusted_no_more_is_given() {
    let authority = Arc::new(Authority::generate("fleet", start()).unwrap());
    let authorities = Arc::new(Authorities::in_memory(authority));
    let switch = Arc::new(OnceLock::new());
    let folder = tempfile::tempdir().unwrap();
    let app = app(folder.path(), &authorities, &switch).await;
    let site = "yard".parse().unwrap();
    app.ensure_site(&site).await.unwrap();
    let request = CreateJoinToken {
        site,
        robot: None,
        valid_minutes: None,
    };
    let made = app.create_join_token(request, ("a test", &Scope::EVERYWHERE));
    let token = made.await.unwrap().secret;
    let request = CertificateParams::default().serialize_request(&KeyPair::generate().unwrap());
    let request = EnrolRobot {
        token,
        robot: Some("rover-1".parse().unwrap()),
        certificate_request: request.unwrap().pem().unwrap(),
    };

    switch.set(()).unwrap();
    let enrolled = app.enrol_robot(Ipv4Addr::LOCALHOST.into(), &request).await;
    assert!(
        matches!(enrolled, Err(EnrolError::Retired(_))),
        "{enrolled:?}"
    );
}
