//! Signatures of deliveries: HMAC-SHA256 over `timestamp.body`.

use std::fmt::Write as _;

use ring::hmac;

/// Returns the signature of a delivery, `v1=` and the HMAC in lower-case hex. `timestamp_s` is the
/// value of the timestamp header, seconds since 1970.
pub fn signature(secret: &str, timestamp_s: i64, body: &str) -> String {
    let key = hmac::Key::new(hmac::HMAC_SHA256, secret.as_bytes());
    let mut context = hmac::Context::with_key(&key);
    context.update(timestamp_s.to_string().as_bytes());
    context.update(b".");
    context.update(body.as_bytes());
    let mut text = "v1=".to_owned();
    for byte in context.sign().as_ref() {
        // Writing to a string cannot fail.
        let _ = write!(text, "{byte:02x}");
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_signature_is_what_others_compute_and_changes_with_secret_time_and_body() {
        // By Python: hmac.new(b"tread_w_1", b'1793000000.{"v":1}', "sha256").hexdigest()
        let signed = signature("tread_w_1", 1_793_000_000, "{\"v\":1}");
        assert_eq!(
            signed,
            "v1=31999cc0a0ceba270412a99501c281246622ecf14f2ae2263b4001556486efec"
        );
        for other in [
            signature("tread_w_2", 1_793_000_000, "{\"v\":1}"),
            signature("tread_w_1", 1_793_000_001, "{\"v\":1}"),
            signature("tread_w_1", 1_793_000_000, "{\"v\":2}"),
        ] {
            assert_ne!(signed, other);
        }
    }
}
