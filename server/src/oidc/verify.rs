//! Validates ID tokens (OpenID Connect Core 1.0, section 3.1.3.7).
//!
//! | part | requirement |
//! |---|---|
//! | signature | by a key of the provider, with RSA, ECDSA or EdDSA; HMAC and `none` are refused |
//! | `iss` | the provider |
//! | `aud` | this client alone; `azp`, if present, too |
//! | `exp`, `iat` | not expired, not issued in the future, with a tolerance of [`LEEWAY`] |
//! | `nbf` | if present, not in the future, with the same tolerance (RFC 7519, section 4.1.5) |
//! | `nonce` | the one of this sign-in |
//! | `at_hash` | if present, the hash of the access token in the same answer |

use base64::Engine as _;
use base64::engine::general_purpose::URL_SAFE_NO_PAD;
use chrono::DateTime;
use jiff::{SignedDuration, Timestamp};
use openidconnect::core::{
    CoreGenderClaim, CoreJsonWebKey, CoreJweContentEncryptionAlgorithm, CoreJwsSigningAlgorithm,
};
use openidconnect::{
    AccessToken, AccessTokenHash, ClaimsVerificationError, ClientId, EmptyAdditionalClaims,
    IdTokenVerifier, IssuerUrl, JsonWebKeySet, Nonce,
};

use crate::identity::claims::{Claims, SUBJECT_MAX};

/// Maximum tolerated difference between the provider's clock and this server's.
pub const LEEWAY: SignedDuration = SignedDuration::from_secs(60);

/// An ID token that is not validated yet.
pub type IdToken = openidconnect::IdToken<
    EmptyAdditionalClaims,
    CoreGenderClaim,
    CoreJweContentEncryptionAlgorithm,
    CoreJwsSigningAlgorithm,
>;

/// Values against which an ID token is validated.
#[derive(Debug, Clone, Copy)]
pub struct ExpectedClaims<'expected> {
    /// Issuer identifier of the provider.
    pub issuer: &'expected IssuerUrl,
    /// Client identifier of this server.
    pub client_id: &'expected ClientId,
    /// Nonce of the sign-in.
    pub nonce: &'expected str,
    /// Access token in the same answer.
    pub access_token: &'expected AccessToken,
    /// Current time.
    pub now: Timestamp,
    /// Provider's public keys.
    pub keys: &'expected JsonWebKeySet<CoreJsonWebKey>,
}

/// Error of validating an ID token.
#[derive(Debug, thiserror::Error)]
pub enum InvalidIdToken {
    /// The provider's answer has no ID token.
    #[error("there is no ID token in the answer")]
    Missing,
    /// The signature is wrong, or by an unknown key.
    #[error("the ID token's signature does not hold")]
    Signature(#[source] ClaimsVerificationError),
    /// A claim, such as issuer, audience, expiry or nonce, is missing or wrong.
    #[error("the ID token does not say what it must")]
    Claims(#[source] ClaimsVerificationError),
    /// The `at_hash` is not that of the access token.
    #[error("the ID token's `at_hash` is not that of the access token")]
    AccessToken,
    /// The authorised party (`azp`) is another client.
    #[error("the ID token's `azp` is another client")]
    Party,
    /// The subject is empty or longer than [`SUBJECT_MAX`].
    #[error("the ID token's `sub` is empty or too long")]
    Subject,
    /// The token is not valid yet (`nbf`).
    #[error("the ID token's `nbf` is yet to come, or is no number")]
    NotYetValid,
    /// The payload cannot be parsed.
    #[error("the ID token's claims do not read")]
    Unreadable,
}

const ALGORITHMS: [CoreJwsSigningAlgorithm; 9] = [
    CoreJwsSigningAlgorithm::RsaSsaPkcs1V15Sha256,
    CoreJwsSigningAlgorithm::RsaSsaPkcs1V15Sha384,
    CoreJwsSigningAlgorithm::RsaSsaPkcs1V15Sha512,
    CoreJwsSigningAlgorithm::RsaSsaPssSha256,
    CoreJwsSigningAlgorithm::RsaSsaPssSha384,
    CoreJwsSigningAlgorithm::RsaSsaPssSha512,
    CoreJwsSigningAlgorithm::EcdsaP256Sha256,
    CoreJwsSigningAlgorithm::EcdsaP384Sha384,
    CoreJwsSigningAlgorithm::EdDsa,
];

/// Validates an ID token. Returns its subject and all its claims.
///
/// # Errors
/// [`InvalidIdToken`] with the requirement that is not met.
pub fn claims(
    id_token: &IdToken,
    expected: &ExpectedClaims<'_>,
) -> Result<(String, Claims), InvalidIdToken> {
    let at = |time: Timestamp| {
        let time = DateTime::from_timestamp(time.as_second(), 0);
        time.unwrap_or(DateTime::UNIX_EPOCH)
    };
    let earliest = expected.now.saturating_sub(LEEWAY).unwrap_or(expected.now);
    let latest = expected.now.saturating_add(LEEWAY).unwrap_or(expected.now);
    let (earliest, latest) = (at(earliest), at(latest));
    let verifier = IdTokenVerifier::new_public_client(
        expected.client_id.clone(),
        expected.issuer.clone(),
        expected.keys.clone(),
    )
    .set_allowed_algs(ALGORITHMS)
    .set_time_fn(move || earliest)
    .set_issue_time_verifier_fn(move |issued| {
        if issued <= latest {
            Ok(())
        } else {
            Err(format!("it was issued at {issued}, which is yet to come"))
        }
    });
    let nonce = Nonce::new(expected.nonce.to_owned());
    let id_claims = id_token.claims(&verifier, &nonce).map_err(|error| {
        if matches!(error, ClaimsVerificationError::SignatureVerification(_)) {
            InvalidIdToken::Signature(error)
        } else {
            InvalidIdToken::Claims(error)
        }
    })?;
    if let Some(hash) = id_claims.access_token_hash() {
        let signed = id_token.signing_alg().ok();
        let key = id_token.signing_key(&verifier).ok();
        let own = signed.zip(key).and_then(|(algorithm, key)| {
            AccessTokenHash::from_token(expected.access_token, algorithm, key).ok()
        });
        if own.as_ref() != Some(hash) {
            return Err(InvalidIdToken::AccessToken);
        }
    }
    if let Some(party) = id_claims.authorized_party()
        && party != expected.client_id
    {
        return Err(InvalidIdToken::Party);
    }
    let subject = id_claims.subject().as_str();
    if subject.is_empty() || subject.chars().count() > SUBJECT_MAX {
        return Err(InvalidIdToken::Subject);
    }
    let claims = payload(id_token).ok_or(InvalidIdToken::Unreadable)?;
    // Until 2106, and from then on no token is refused for this.
    let latest_s = u32::try_from(latest.timestamp()).map_or(f64::INFINITY, f64::from);
    if !claims
        .get("nbf")
        .is_none_or(|from| from.as_f64().is_some_and(|from_s| from_s <= latest_s))
    {
        return Err(InvalidIdToken::NotYetValid);
    }
    Ok((subject.to_owned(), claims))
}

/// Parses all claims of an ID token from the signed bytes.
fn payload(id_token: &IdToken) -> Option<Claims> {
    let text = id_token.to_string();
    let payload = URL_SAFE_NO_PAD.decode(text.split('.').nth(1)?).ok()?;
    serde_json::from_slice(&payload).ok()
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::super::rollover_tests::Signer;
    use super::*;

    const NOW_S: i64 = 1_800_000_000;
    const ISSUER: &str = "https://login.test";

    fn good() -> Value {
        json!({"iss": ISSUER, "aud": "tread", "sub": "anna", "nonce": "n", "iat": NOW_S,
               "exp": NOW_S + 300, "groups": ["ops"]})
    }

    fn look(token: &IdToken, signer: &Signer) -> Result<(String, Claims), InvalidIdToken> {
        let keys = JsonWebKeySet::new(vec![signer.public.clone()]);
        claims(
            token,
            &ExpectedClaims {
                issuer: &IssuerUrl::new(ISSUER.to_owned()).unwrap(),
                client_id: &ClientId::new("tread".to_owned()),
                nonce: "n",
                access_token: &AccessToken::new("access".to_owned()),
                now: Timestamp::from_second(NOW_S).unwrap(),
                keys: &keys,
            },
        )
    }

    fn with(changes: &Value) -> Value {
        let mut claims = good();
        let fields = claims.as_object_mut().unwrap();
        for (name, value) in changes.as_object().unwrap() {
            fields.insert(name.clone(), value.clone());
        }
        claims
    }

    const HEADER: &str = r#"{"alg": "EdDSA", "kid": "1"}"#;

    fn header() -> Value {
        serde_json::from_str(HEADER).unwrap()
    }

    #[test]
    fn a_good_id_token_says_who_and_all_that_it_has() {
        let signer = Signer::new(1, "1");
        let (subject, claims) = look(&signer.sign(&header(), &good()), &signer).unwrap();
        assert_eq!(subject, "anna");
        assert_eq!(claims["groups"], json!(["ops"]));
        for fine in [
            with(&json!({"exp": NOW_S - 59, "iat": NOW_S - 400})),
            with(&json!({"iat": NOW_S + 60})),
            with(&json!({"azp": "tread"})),
            with(&json!({"nbf": NOW_S + 60})),
            with(&json!({"aud": ["tread"]})),
        ] {
            look(&signer.sign(&header(), &fine), &signer).unwrap();
        }
    }

    #[test]
    fn whatever_is_not_as_it_must_be_is_not_believed() {
        let signer = Signer::new(1, "1");
        for wrong in [
            json!({"iss": "https://login.test/"}),
            json!({"aud": "another"}),
            json!({"aud": ["tread", "another"]}),
            json!({"azp": "another"}),
            json!({"nonce": "m"}),
            json!({"nonce": null}),
            json!({"exp": NOW_S - 61}),
            json!({"iat": NOW_S + 61}),
            json!({"nbf": NOW_S + 61}),
            json!({"nbf": "now"}),
            json!({"at_hash": "AAAAAAAAAAAAAAAAAAAAAA"}),
            json!({"sub": ""}),
            json!({"sub": "x".repeat(SUBJECT_MAX + 1)}),
        ] {
            let token = signer.sign(&header(), &with(&wrong));
            assert!(look(&token, &signer).is_err(), "{wrong}");
        }
    }

    #[test]
    fn only_the_providers_own_signatures_count() {
        let (signer, other) = (Signer::new(1, "1"), Signer::new(2, "1"));
        let is_signature =
            |token: &IdToken| matches!(look(token, &signer), Err(InvalidIdToken::Signature(_)));
        assert!(is_signature(&other.sign(&header(), &good())));
        for header in [
            json!({"alg": "EdDSA", "kid": "2"}),
            json!({"alg": "HS256", "kid": "1"}),
            json!({"alg": "RS256", "kid": "1"}),
            json!({"alg": "none"}),
        ] {
            assert!(is_signature(&signer.sign(&header, &good())), "{header}");
        }
        let text = signer.sign(&header(), &good()).to_string();
        let mut parts: Vec<&str> = text.split('.').collect();
        let admin = URL_SAFE_NO_PAD.encode(with(&json!({"groups": ["admins"]})).to_string());
        parts[1] = &admin;
        assert!(is_signature(&parts.join(".").parse().unwrap()));
    }

    #[test]
    fn at_hash_is_that_of_the_access_token_that_came_along() {
        let signer = Signer::new(1, "1");
        let hash = |token: &str| {
            let token = AccessToken::new(token.to_owned());
            let algorithm = CoreJwsSigningAlgorithm::EdDsa;
            AccessTokenHash::from_token(&token, &algorithm, &signer.public).unwrap()
        };
        let token_of =
            |hash: AccessTokenHash| signer.sign(&header(), &with(&json!({"at_hash": hash})));
        look(&token_of(hash("access")), &signer).unwrap();
        let other = look(&token_of(hash("another")), &signer);
        assert!(matches!(other, Err(InvalidIdToken::AccessToken)));
    }
}
