//! Signatures of deliveries: HMAC-SHA256 over `timestamp.body`.

use std::fmt::Write as _;

use ring::hmac;

use super::outgoing::OutgoingDelivery;

/// Returns the signature of a delivery, `v1=` and the HMAC in lower-case hex.
pub fn signature(outgoing: &OutgoingDelivery) -> String {
    let key = hmac::Key::new(hmac::HMAC_SHA256, outgoing.secret.as_bytes());
    let mut context = hmac::Context::with_key(&key);
    context.update(outgoing.at.as_second().to_string().as_bytes());
    context.update(b".");
    context.update(outgoing.body.as_bytes());
    let mut text = "v1=".to_owned();
    for byte in context.sign().as_ref() {
        // Writing to a string cannot fail.
        let _ = write!(text, "{byte:02x}");
    }
    text
}

#[cfg(test)]
mod tests {
    use jiff::Timestamp;
    use tread_api::ids::DeliveryId;
    use uuid::Uuid;

    use super::*;

    #[test]
    fn a_signature_is_what_others_compute_and_changes_with_secret_time_and_body() {
        // By Python: hmac.new(b"tread_w_1", b'1793000000.{"v":1}', "sha256").hexdigest()
        let outgoing = OutgoingDelivery {
            id: DeliveryId::from_uuid(Uuid::nil()),
            url: String::new(),
            secret: "tread_w_1".to_owned(),
            body: "{\"v\":1}".to_owned(),
            at: Timestamp::from_second(1_793_000_000).unwrap(),
        };
        let signed = signature(&outgoing);
        assert_eq!(
            signed,
            "v1=31999cc0a0ceba270412a99501c281246622ecf14f2ae2263b4001556486efec"
        );
        for other in [
            OutgoingDelivery {
                secret: "tread_w_2".to_owned(),
                ..outgoing.clone()
            },
            OutgoingDelivery {
                at: Timestamp::from_second(1_793_000_001).unwrap(),
                ..outgoing.clone()
            },
            OutgoingDelivery {
                body: "{\"v\":2}".to_owned(),
                ..outgoing.clone()
            },
        ] {
            assert_ne!(signed, signature(&other));
        }
    }
}
