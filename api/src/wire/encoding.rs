//! Encodings of payloads: JSON, and CBOR (RFC 8949) of the same types.
//!
//! JSON is read everywhere. CBOR takes fewer bytes and less processor time; a robot uses it only for
//! what the server's welcome names. The encoding of a zenoh payload names it.

use std::error::Error;

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

/// Encoding of a payload.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Encoding {
    /// JSON, which is read by every version.
    #[default]
    Json,
    /// CBOR.
    Cbor,
    /// Encoding that this version does not know, from a newer peer.
    #[serde(other)]
    Other,
}

/// Reason why a payload cannot be written or read.
pub type CodecError = Box<dyn Error + Send + Sync>;

/// A number that is not finite.
#[derive(Debug, thiserror::Error)]
#[error("a number is not finite")]
struct NotFinite;

impl Encoding {
    /// Media type, with which the encoding of a zenoh payload is set.
    pub fn media_type(self) -> &'static str {
        match self {
            Self::Json | Self::Other => "application/json",
            Self::Cbor => "application/cbor",
        }
    }

    /// Returns the encoding with a media type, of which parameters after `;` say nothing. Payloads
    /// without a known one are JSON.
    pub fn of_media_type(text: &str) -> Self {
        let essence = text.split(';').next().unwrap_or_default();
        if essence.trim().eq_ignore_ascii_case(Self::Cbor.media_type()) {
            Self::Cbor
        } else {
            Self::Json
        }
    }

    pub(super) fn write<T: Serialize>(self, value: &T) -> Result<Vec<u8>, CodecError> {
        match self {
            Self::Json | Self::Other => Ok(serde_json::to_vec(value)?),
            Self::Cbor => Ok(minicbor_serde::to_vec(value)?),
        }
    }

    pub(super) fn read<T: DeserializeOwned>(self, payload: &[u8]) -> Result<T, CodecError> {
        match self {
            Self::Json | Self::Other => Ok(serde_json::from_slice(payload)?),
            Self::Cbor => {
                // JSON has no such numbers, so no type of the API expects one.
                if !is_finite(payload) {
                    return Err(NotFinite.into());
                }
                Ok(minicbor_serde::from_slice(payload)?)
            }
        }
    }
}

/// Returns whether all floating-point numbers of a CBOR payload are finite. What follows an item that
/// is not well-formed is not looked at, because reading ends there.
fn is_finite(mut payload: &[u8]) -> bool {
    const TEXT_OR_BYTES: [u8; 2] = [2, 3];
    while let Some((&initial, rest)) = payload.split_first() {
        let (major, info) = (initial >> 5, initial & 0x1f);
        // The argument of an item: in the initial byte, or in 1, 2, 4 or 8 bytes after it.
        let length = match info {
            24..=27 => 1 << (info - 24),
            _ => 0,
        };
        let Some((argument, rest)) = rest.split_at_checked(length) else {
            return true;
        };
        let value = argument
            .iter()
            .fold(0_u64, |value, &byte| (value << 8) | u64::from(byte));
        // Numbers that are not finite have an exponent of ones.
        let exponent: Option<u64> = match (major, length) {
            (7, 2) => Some(0x7c00),
            (7, 4) => Some(0x7f80_0000),
            (7, 8) => Some(0x7ff0_0000_0000_0000),
            _ => None,
        };
        if exponent.is_some_and(|exponent| value & exponent == exponent) {
            return false;
        }
        payload = rest;
        if TEXT_OR_BYTES.contains(&major) && info < 28 {
            let count = if length == 0 { u64::from(info) } else { value };
            let count = usize::try_from(count).unwrap_or(usize::MAX);
            let Some(rest) = payload.get(count..) else {
                return true;
            };
            payload = rest;
        }
    }
    true
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
    struct Body {
        name: String,
        numbers: Vec<f64>,
        short: f32,
        count: i64,
        #[serde(default, skip_serializing_if = "Option::is_none")]
        nested: Option<Box<Body>>,
    }

    fn body() -> impl Strategy<Value = Body> {
        let leaf = (
            ".{0,400}",
            prop::collection::vec(-1e300_f64..1e300, 0..30),
            -1e30_f32..1e30,
            any::<i64>(),
        )
            .prop_map(|(name, numbers, short, count)| Body {
                name,
                numbers,
                short,
                count,
                nested: None,
            });
        (leaf.clone(), prop::option::of(leaf)).prop_map(|(mut body, nested)| {
            body.nested = nested.map(Box::new);
            body
        })
    }

    proptest! {
        #[test]
        fn what_was_written_is_read_in_both_encodings(body in body()) {
            for encoding in [Encoding::Json, Encoding::Cbor] {
                let payload = encoding.write(&body).unwrap();
                prop_assert_eq!(&encoding.read::<Body>(&payload).unwrap(), &body);
            }
        }

        #[test]
        fn a_number_that_is_not_finite_is_refused_wherever_it_stands(
            body in body(),
            place in any::<prop::sample::Index>(),
            is_short in any::<bool>(),
            wrong in prop::sample::select(vec![f64::NAN, f64::INFINITY, f64::NEG_INFINITY]),
        ) {
            let mut body = body;
            if is_short || body.numbers.is_empty() {
                #[expect(clippy::cast_possible_truncation, reason = "not finite either way")]
                let short = wrong as f32;
                body.short = short;
            } else {
                let place = place.index(body.numbers.len());
                body.numbers[place] = wrong;
            }
            let payload = Encoding::Cbor.write(&body).unwrap();
            prop_assert!(Encoding::Cbor.read::<Body>(&payload).is_err());
        }

        #[test]
        fn no_payload_makes_the_reader_panic(payload in prop::collection::vec(any::<u8>(), 0..200)) {
            is_finite(&payload);
            let _ = Encoding::Cbor.read::<Body>(&payload);
        }
    }

    #[test]
    fn half_floats_that_are_not_finite_are_refused() {
        assert!(is_finite(&[0xf9, 0x3c, 0x00]), "1.0");
        assert!(!is_finite(&[0xf9, 0x7c, 0x00]), "infinity");
        assert!(!is_finite(&[0xf9, 0x7e, 0x00]), "NaN");
        assert!(!is_finite(&[0xf9, 0xfc, 0x00]), "-infinity");
    }

    #[test]
    fn numbers_in_the_shortest_form_of_other_encoders_are_read() {
        // 1.5 as a half, a single and a double float.
        let double = [0xfb, 0x3f, 0xf8, 0, 0, 0, 0, 0, 0];
        let payloads: [&[u8]; 3] = [&[0xf9, 0x3e, 0x00], &[0xfa, 0x3f, 0xc0, 0, 0], &double];
        for payload in payloads {
            let read = Encoding::Cbor.read::<f64>(payload).unwrap();
            assert_eq!(read.to_bits(), 1.5_f64.to_bits(), "{payload:x?}");
        }
    }

    #[test]
    fn deep_nesting_is_refused() {
        let payload = vec![0x81; 100_000];
        assert!(Encoding::Cbor.read::<Body>(&payload).is_err());
    }

    #[test]
    fn an_unknown_encoding_is_no_error_and_each_media_type_is_another() {
        let known: Vec<Encoding> = serde_json::from_str(r#"["json","cbor","zstd"]"#).unwrap();
        assert_eq!(known, [Encoding::Json, Encoding::Cbor, Encoding::Other]);
        for encoding in [Encoding::Json, Encoding::Cbor] {
            assert_eq!(Encoding::of_media_type(encoding.media_type()), encoding);
        }
        assert_eq!(
            Encoding::of_media_type("application/cbor;schema=report"),
            Encoding::Cbor
        );
        assert_eq!(Encoding::of_media_type("zenoh/bytes"), Encoding::Json);
    }
}
