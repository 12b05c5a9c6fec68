//! A robot that joins while the fleet's authority is replaced, and a disk that takes its time.

use std::net::{IpAddr, Ipv4Addr};
use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;

use jiff::SignedDuration;
use rcgen::{CertificateParams, KeyPair};
use tread_api::enrolment::{CreateJoinToken, EnrolRobot, ReplaceAuthority};
use tread_api::rights::Scope;
use tread_server::app::enrolment::EnrolmentService;
use tread_server::app::{App, Dependencies};
use tread_server::authority::{Authorities, Authority};
use tread_server::clock::Clock;
use tread_server::db::Db;

use crate::ground::now;
use crate::interposer::Interposer;
use crate::uncertain::until;

const HERE: IpAddr = IpAddr::V4(Ipv4Addr::LOCALHOST);
/// How long the commit of the enrolment takes.
const SLOW: Duration = Duration::from_secs(1);

pub(crate) fn replaced(interposer: &Interposer) -> Pin<Box<dyn Future<Output = ()> + '_>> {
    Box::pin(async {
        let folder = tempfile::tempdir().unwrap();
        let authority = Arc::new(Authority::generate("fleet", now()).unwrap());
        let signing = authority.fingerprint().to_owned();
        let authorities = Arc::new(Authorities::in_memory(authority));
        let app = App::new(Dependencies {
            enrolment: Some(EnrolmentService {
                authorities: Arc::clone(&authorities),
                lifetime: SignedDuration::from_hours(24),
                port: 7447,
            }),
            ..Dependencies::on_database(
                Db::open(&folder.path().join("tread.db")).await.unwrap(),
                Clock::manual(now()),
            )
        });
        let site = "yard".parse().unwrap();
        app.ensure_site(&site).await.unwrap();
        let request = CreateJoinToken {
            site,
            robot: None,
            valid_minutes: None,
        };
        let made = app.create_join_token(request, ("a test", &Scope::EVERYWHERE));
        let made = made.await.unwrap();
        let key = KeyPair::generate().unwrap();
        let request = CertificateParams::default().serialize_request(&key);
        let request = EnrolRobot {
            token: made.secret,
            robot: Some("rover-1".parse().unwrap()),
            certificate_request: request.unwrap().pem().unwrap(),
        };

        interposer.slow_down(SLOW);
        let replacing = async {
            until("the enrolment is being committed", async || {
                interposer.fired() == 1
            })
            .await;
            let request = ReplaceAuthority { signing };
            app.replace_authority(&request, "a test").await.unwrap();
        };
        let (enrolled, ()) = tokio::join!(app.enrol_robot(HERE, &request), replacing);
        let certificate = enrolled.unwrap().certificate;
        interposer.disarm();
        let present = authorities.present();
        assert_eq!(certificate.authority, present.bundle_pem());
        let read = present.read_robot(&certificate.certificate, now()).unwrap();
        assert_eq!(read.issuer(), present.signing().fingerprint());
        assert!(!read.is_retired());
        let (joined, _) = (app.fleet_authority().await.unwrap(), folder);
        assert_eq!(joined.robots_to_join, 0, "{joined:?}");
    })
}
