use std::sync::Arc;

use proptest::prelude::*;

use super::*;

const DAY: SignedDuration = SignedDuration::from_hours(24);

fn now() -> Timestamp {
    "2026-11-02T10:00:00Z".parse().unwrap()
}

fn name(enrolment: u32) -> RobotName {
    RobotName {
        site: "yard".parse().unwrap(),
        robot: "rover-1".parse().unwrap(),
        enrolment,
    }
}

fn trusting(authority: &Arc<Authority>) -> Trusted {
    Trusted::one(Arc::clone(authority))
}

fn request(key: &KeyPair) -> String {
    let params = CertificateParams::default();
    params.serialize_request(key).unwrap().pem().unwrap()
}

fn signed(authority: &Authority, key: &KeyPair) -> String {
    let request = RobotRequest::read(&request(key)).unwrap();
    let signed = authority.sign(&request, &name(3), now(), DAY).unwrap();
    assert_eq!(signed.expires_at, now() + DAY);
    signed.certificate
}

#[test]
fn a_certificate_names_its_robot_and_no_request_can_change_that() {
    let authority = Arc::new(Authority::generate("fleet", now()).unwrap());
    let key = KeyPair::generate().unwrap();
    let mut params = CertificateParams::new(vec!["e1.other.yard".to_owned()]).unwrap();
    params.distinguished_name = named("e1.other.yard");
    params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
    let greedy = params.serialize_request(&key).unwrap().pem().unwrap();
    let request = RobotRequest::read(&greedy).unwrap();
    let signed = authority.sign(&request, &name(3), now(), DAY).unwrap();
    let present = trusting(&authority)
        .read_robot(&signed.certificate, now())
        .unwrap();
    assert_eq!(*present.name(), name(3));
    let (_, parsed) = X509Certificate::from_der(&present.certificate).unwrap();
    assert!(!parsed.is_ca());
}

#[test]
fn a_renewal_needs_the_present_key_and_a_certificate_of_this_authority() {
    let authority = Arc::new(Authority::generate("fleet", now()).unwrap());
    let (old, new) = (KeyPair::generate().unwrap(), KeyPair::generate().unwrap());
    let (certificate, next) = (signed(&authority, &old), request(&new));
    let present = trusting(&authority)
        .read_robot(&certificate, now())
        .unwrap();
    let sign = |key: &KeyPair, message: &[u8]| rcgen::SigningKey::sign(key, message).unwrap();
    let message = renewal_message(&next);
    assert!(present.check_proof(&next, &sign(&old, &message)).is_ok());
    for wrong in [
        sign(&new, &message),
        sign(&old, next.as_bytes()),
        sign(&old, &renewal_message(&request(&old))),
        Vec::new(),
    ] {
        let checked = present.check_proof(&next, &wrong);
        assert!(matches!(checked, Err(CertificateError::Proof)));
    }
    let stranger = Arc::new(Authority::generate("fleet", now()).unwrap());
    let foreign = trusting(&stranger).read_robot(&certificate, now());
    assert!(matches!(foreign, Err(CertificateError::Foreign)));
}

#[test]
fn a_certificate_renews_for_a_while_after_its_end_and_then_no_more() {
    let authority = Arc::new(Authority::generate("fleet", now()).unwrap());
    let certificate = signed(&authority, &KeyPair::generate().unwrap());
    let end = now() + DAY;
    assert!(
        trusting(&authority)
            .read_robot(&certificate, end + RENEWAL_GRACE)
            .is_ok()
    );
    let late = end + RENEWAL_GRACE + SignedDuration::from_secs(1);
    let over = trusting(&authority).read_robot(&certificate, late);
    assert!(matches!(over, Err(CertificateError::Over)));
    let before = trusting(&authority).read_robot(&certificate, now() - DAY);
    assert!(matches!(before, Err(CertificateError::Foreign)));
}

#[test]
fn the_ports_own_certificate_does_not_count_as_a_robots() {
    let authority = Arc::new(Authority::generate("fleet", now()).unwrap());
    let port = authority.port_identity(&[], now()).unwrap();
    assert!(named_in(&port.chain[0]).is_err());
}

#[test]
fn requests_that_are_none_are_refused() {
    for text in ["", "-----BEGIN CERTIFICATE REQUEST-----", "nonsense"] {
        assert!(RobotRequest::read(text).is_err(), "`{text}`");
    }
    let mut bytes = request(&KeyPair::generate().unwrap()).into_bytes();
    // Within the base64 of the signature, which is last.
    let at = bytes.len() - 60;
    bytes[at] = if bytes[at] == b'A' { b'B' } else { b'A' };
    let broken = String::from_utf8(bytes).unwrap();
    assert!(RobotRequest::read(&broken).is_err());
    let other = KeyPair::generate_for(&rcgen::PKCS_ED25519).unwrap();
    let refused = RobotRequest::read(&request(&other));
    assert!(matches!(refused, Err(CertificateError::Algorithm)));
}

#[test]
fn the_authority_comes_back_from_its_folder_and_others_cannot_read_its_key() {
    use std::os::unix::fs::PermissionsExt as _;
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path().join("authority");
    let made = Arc::new(Authority::create(&folder, now()).unwrap());
    let again = Authority::create(&folder, now());
    assert!(matches!(again, Err(AuthorityError::Exists(_))));
    let key = folder.join(KEY_FILE);
    let rights = std::fs::metadata(&key).unwrap().permissions().mode();
    assert_eq!(rights & 0o777, 0o600);
    let certificate = signed(&made, &KeyPair::generate().unwrap());
    let loaded = Arc::new(Authority::load(&folder).unwrap());
    assert!(trusting(&loaded).read_robot(&certificate, now()).is_ok());
    let next = signed(&loaded, &KeyPair::generate().unwrap());
    assert!(trusting(&made).read_robot(&next, now()).is_ok());
    std::fs::set_permissions(&key, std::fs::Permissions::from_mode(0o640)).unwrap();
    assert!(matches!(
        Authority::load(&folder),
        Err(AuthorityError::Open(_))
    ));
    std::fs::remove_file(&key).unwrap();
    let missing = Authority::load(&folder);
    assert!(matches!(missing, Err(AuthorityError::Unreadable { .. })));
    let other = KeyPair::generate().unwrap().serialize_pem();
    std::fs::write(&key, other).unwrap();
    std::fs::set_permissions(&key, std::fs::Permissions::from_mode(0o600)).unwrap();
    assert!(matches!(
        Authority::load(&folder),
        Err(AuthorityError::Unusable { .. })
    ));
}

#[test]
fn during_a_rotation_certificates_of_both_count_and_afterwards_those_of_the_former_tell_their_name_only()
 {
    let former = Arc::new(Authority::generate("fleet", now()).unwrap());
    let authorities = Authorities::in_memory(Arc::clone(&former));
    let key = KeyPair::generate().unwrap();
    let of_former = signed(&former, &key);
    let before = authorities.present();
    let during = authorities.start("admin", now()).unwrap();
    let next = Arc::clone(during.signing());
    let of_next = signed(&next, &key);
    for (certificate, issuer) in [(&of_former, &former), (&of_next, &next)] {
        let read = during.read_robot(certificate, now()).unwrap();
        assert_eq!(read.issuer(), issuer.fingerprint());
        assert!(!read.is_retired());
        let der = CertificateDer::from_pem_slice(certificate.as_bytes()).unwrap();
        assert_eq!(during.issuer_of(&der, now()), Some(issuer.fingerprint()));
    }
    // Robots accept the port's certificate, whether they trust the former authority alone or both.
    assert_eq!(during.of_port().fingerprint(), former.fingerprint());
    let bundle = during.bundle_pem();
    assert_eq!(CertificateDer::pem_slice_iter(bundle.as_bytes()).count(), 2);
    assert_ne!(during.id(), before.id());
    let refused = authorities.finish(before.id());
    assert!(
        matches!(
            refused,
            Err(RotationError::Refused(RotationRefused::Other { .. }))
        ),
        "{refused:?}"
    );
    assert_eq!(authorities.present().id(), during.id());
    let after = authorities.finish(during.id()).unwrap();
    let refused = authorities.finish(during.id());
    assert!(matches!(
        refused,
        Err(RotationError::Refused(RotationRefused::None))
    ));
    assert_eq!(after.of_port().fingerprint(), next.fingerprint());
    let read = after.read_robot(&of_former, now()).unwrap();
    assert!(read.is_retired());
    assert_eq!(*read.name(), name(3));
    let der = CertificateDer::from_pem_slice(of_former.as_bytes()).unwrap();
    assert_eq!(after.issuer_of(&der, now()), None);
    assert!(!after.read_robot(&of_next, now()).unwrap().is_retired());
    assert_eq!(after.bundle_pem(), next.certificate_pem());
}

#[test]
fn a_replacement_trusts_nobody_of_before_in_a_rotation_or_not_and_names_whom_it_replaces() {
    for is_rotating in [false, true] {
        let former = Arc::new(Authority::generate("fleet", now()).unwrap());
        let authorities = Authorities::in_memory(Arc::clone(&former));
        if is_rotating {
            authorities.start("admin", now()).unwrap();
            let refused = authorities.replace(former.fingerprint(), now());
            assert!(
                matches!(
                    refused,
                    Err(RotationError::Refused(
                        RotationRefused::OtherAuthority { .. }
                    ))
                ),
                "{refused:?}"
            );
        }
        let before = authorities.present();
        let signing = before.signing().fingerprint().to_owned();
        let after = authorities.replace(&signing, now()).unwrap();
        assert_eq!(after.all().count(), 1);
        assert_eq!(after.of_port().fingerprint(), after.signing().fingerprint());
        let key = KeyPair::generate().unwrap();
        for one in before.all() {
            let of_before = signed(one, &key);
            assert!(after.read_robot(&of_before, now()).unwrap().is_retired());
            let der = CertificateDer::from_pem_slice(of_before.as_bytes()).unwrap();
            assert_eq!(after.issuer_of(&der, now()), None);
            assert!(!after.is_trusted(one.fingerprint()));
        }
        // A second caller with the outdated fingerprint does not replace the new authority.
        assert!(authorities.replace(&signing, now()).is_err());
        assert_eq!(authorities.present().id(), after.id());
    }
}

proptest! {
    #[test]
    fn a_name_reads_back_as_what_it_was_and_nothing_else_reads(
        site in "[a-z0-9-]{1,63}", robot in "[a-z0-9-]{1,63}", enrolment in 1_u32..,
        other in "[a-z0-9.+-]{0,20}",
    ) {
        let name = RobotName {
            site: site.parse().unwrap(),
            robot: robot.parse().unwrap(),
            enrolment,
        };
        prop_assert_eq!(RobotName::read(&name.text()), Some(name));
        if let Some(read) = RobotName::read(&other) {
            prop_assert_eq!(read.text(), other);
        }
    }
}
