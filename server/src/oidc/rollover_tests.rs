//! Tests key rollover: the provider signs with a key unknown to the server while several people
//! sign in.

use std::collections::BTreeMap;
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use base64::Engine as _;
use base64::engine::general_purpose::URL_SAFE_NO_PAD;
use openidconnect::JsonWebKeyId;
use openidconnect::core::{CoreJsonCurveType, CoreJsonWebKey};
use ring::signature::{Ed25519KeyPair, KeyPair as _};
use serde_json::{Value, json};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::Semaphore;

use super::verify::IdToken;
use super::*;
use crate::config::oidc::OidcConfig;
use crate::identity::pending::{PendingKey, SIGN_IN_RANDOM_BYTES};

/// Time for which a sign-in that has to wait is observed; a refusal would come at once.
const WATCHED: Duration = Duration::from_millis(300);

/// Signing key of the test provider.
pub(super) struct Signer {
    pair: Ed25519KeyPair,
    pub(super) public: CoreJsonWebKey,
}

impl Signer {
    pub(super) fn new(seed: u8, kid: &str) -> Self {
        let pair = Ed25519KeyPair::from_seed_unchecked(&[seed; 32]).unwrap();
        let public = pair.public_key().as_ref().to_vec();
        let kid = Some(JsonWebKeyId::new(kid.to_owned()));
        let public = CoreJsonWebKey::new_okp(public, CoreJsonCurveType::Ed25519, kid);
        Self { pair, public }
    }

    pub(super) fn sign(&self, header: &Value, claims: &Value) -> IdToken {
        let part = |value: &Value| URL_SAFE_NO_PAD.encode(value.to_string());
        let text = format!("{}.{}", part(header), part(claims));
        let signature = self.pair.sign(text.as_bytes());
        let signature = URL_SAFE_NO_PAD.encode(signature.as_ref());
        format!("{text}.{signature}").parse().unwrap()
    }
}

/// OpenID provider on the loopback whose answers the test sets.
struct Fake {
    listener: TcpListener,
    /// Number of the key that signs ID tokens; 0 if the token endpoint answers with malformed JSON.
    signs_by: AtomicUsize,
    /// Numbers of the published keys; `None` if requests for keys fail.
    tells: Mutex<Option<Vec<usize>>>,
    /// Permits for answering requests for the keys.
    answers: Semaphore,
    /// Number of requests for the keys.
    asked: AtomicUsize,
    clock: Clock,
}

impl Fake {
    async fn new() -> Self {
        Self {
            listener: TcpListener::bind("127.0.0.1:0").await.unwrap(),
            signs_by: AtomicUsize::new(1),
            tells: Mutex::new(Some(vec![1])),
            answers: Semaphore::new(Semaphore::MAX_PERMITS),
            asked: AtomicUsize::new(0),
            clock: Clock::manual("2027-01-15T08:00:00Z".parse().unwrap()),
        }
    }

    fn issuer(&self) -> String {
        format!("http://{}", self.listener.local_addr().unwrap())
    }

    fn signer(number: usize) -> Signer {
        Signer::new(u8::try_from(number).unwrap(), &number.to_string())
    }

    /// Returns the server's client of this provider.
    fn provider(&self) -> Provider {
        let config = OidcConfig {
            issuer: self.issuer(),
            client_id: "tread".to_owned(),
            client_secret_file: None,
            public_url: "http://127.0.0.1:8420".parse().unwrap(),
            scopes: vec!["openid".to_owned()],
            groups_claim: "groups".to_owned(),
            name_claim: None,
            label: "fake".to_owned(),
            ca: None,
            session_hours: 12,
            groups: BTreeMap::default(),
        };
        Provider::new(&config, self.clock.clone()).unwrap()
    }

    async fn serve(&self) {
        let mut serving = futures_util::stream::FuturesUnordered::new();
        loop {
            tokio::select! {
                accepted = self.listener.accept() => serving.push(self.answer(accepted.unwrap().0)),
                Some(()) = futures_util::StreamExt::next(&mut serving) => {}
            }
        }
    }

    async fn answer(&self, mut stream: TcpStream) {
        let mut request = Vec::new();
        let mut byte = [0];
        while !request.ends_with(b"\r\n\r\n") {
            if stream.read(&mut byte).await.unwrap_or(0) == 0 {
                return;
            }
            request.push(byte[0]);
        }
        let head = String::from_utf8(request).unwrap().to_lowercase();
        let length = head
            .lines()
            .find_map(|line| line.strip_prefix("content-length: "));
        let mut body = vec![0; length.map_or(0, |length| length.parse().unwrap())];
        stream.read_exact(&mut body).await.unwrap();
        let issuer = self.issuer();
        let path = head.split(' ').nth(1).unwrap();
        let said = match path {
            "/.well-known/openid-configuration" => Some(json!({
                "issuer": issuer, "authorization_endpoint": format!("{issuer}/auth"),
                "token_endpoint": format!("{issuer}/token"), "jwks_uri": format!("{issuer}/jwks"),
                "response_types_supported": ["code"], "subject_types_supported": ["public"],
                "id_token_signing_alg_values_supported": ["EdDSA"],
            })),
            "/jwks" => {
                self.asked.fetch_add(1, Ordering::SeqCst);
                self.answers.acquire().await.unwrap().forget();
                let published = self.tells.lock().unwrap().clone();
                let key = |number| serde_json::to_value(Self::signer(number).public).unwrap();
                published.map(
                    |numbers| json!({"keys": numbers.into_iter().map(key).collect::<Vec<_>>()}),
                )
            }
            "/token" if self.signs_by.load(Ordering::SeqCst) == 0 => {
                Some(json!({"access_token": 7, "token_type": "Bearer"}))
            }
            "/token" => {
                // The test uses the nonce as the code, to identify the sign-in.
                let body = String::from_utf8(body).unwrap();
                let code = body.split('&').find_map(|pair| pair.strip_prefix("code="));
                let number = self.signs_by.load(Ordering::SeqCst);
                let now_s = self.clock.now().as_second();
                let claims = json!({"iss": issuer, "aud": "tread", "sub": "anna", "nonce": code,
                    "iat": now_s, "exp": now_s + 300, "groups": ["all"]});
                let header = json!({"alg": "EdDSA", "kid": number.to_string()});
                let id_token = Self::signer(number).sign(&header, &claims).to_string();
                Some(json!({"access_token": "a", "token_type": "Bearer", "id_token": id_token}))
            }
            other => panic!("{other}"),
        };
        let (status, said) = said.map_or(("500 Failed", String::new()), |said| {
            ("200 OK", said.to_string())
        });
        let length = said.len();
        let answer = format!(
            "HTTP/1.1 {status}\r\ncontent-type: application/json\r\ncontent-length: {length}\r\n\
             connection: close\r\n\r\n{said}"
        );
        stream.write_all(answer.as_bytes()).await.unwrap();
    }

    async fn signs_in(&self, provider: &Provider, number: u8) -> Result<String, ExchangeError> {
        let key = PendingKey::from_random(&[1; SIGN_IN_RANDOM_BYTES]);
        let pending = Pending::begin(&key, &[number; SIGN_IN_RANDOM_BYTES], self.clock.now());
        let there = provider.exchange(&pending.nonce, &pending).await?;
        Ok(there.subject)
    }

    async fn is_asked(&self, times: usize) {
        let asked = async {
            while self.asked.load(Ordering::SeqCst) < times {
                tokio::task::yield_now().await;
            }
        };
        let asked = tokio::time::timeout(Duration::from_secs(10), asked).await;
        asked.expect("the provider is asked for its keys");
    }

    fn rolls_over(&self, to: usize) {
        *self.tells.lock().unwrap() = Some(vec![to]);
        self.signs_by.store(to, Ordering::SeqCst);
    }
}

async fn with_fake<T>(fake: &Fake, test: impl Future<Output = T>) -> T {
    tokio::select! {
        () = fake.serve() => unreachable!("it serves for ever"),
        done = test => done,
    }
}

#[tokio::test]
async fn whoever_signs_in_while_the_new_keys_are_asked_for_waits_for_them() {
    let fake = Fake::new().await;
    let provider = fake.provider();
    with_fake(&fake, async {
        provider.discover().await.unwrap();
        fake.rolls_over(2);
        fake.answers
            .forget_permits(fake.answers.available_permits());
        let first = fake.signs_in(&provider, 1);
        let second = async {
            fake.is_asked(2).await;
            let second = fake.signs_in(&provider, 2);
            tokio::pin!(second);
            let early = tokio::time::timeout(WATCHED, &mut second).await;
            assert!(early.is_err(), "not before the keys are there: {early:?}");
            fake.answers.add_permits(1);
            second.await
        };
        let (first, second) = tokio::join!(first, second);
        assert_eq!(
            (first.unwrap(), second.unwrap()),
            ("anna".into(), "anna".into())
        );
    })
    .await;
    // One request at the discovery, one for both sign-ins.
    assert_eq!(fake.asked.load(Ordering::SeqCst), 2);
}

#[tokio::test]
async fn the_provider_is_asked_for_its_keys_once_in_ten_seconds_and_not_blamed_on_the_person() {
    let fake = Fake::new().await;
    let provider = fake.provider();
    with_fake(&fake, async {
        provider.discover().await.unwrap();
        let is_refused = |refused: Result<String, ExchangeError>| {
            matches!(
                refused,
                Err(ExchangeError::Invalid(InvalidIdToken::Signature(_)))
            )
        };
        // The provider signs with a key that it does not publish.
        fake.signs_by.store(2, Ordering::SeqCst);
        for number in 1..5 {
            assert!(is_refused(fake.signs_in(&provider, number).await));
        }
        assert_eq!(fake.asked.load(Ordering::SeqCst), 2);
        fake.clock.advance(KEYS_REFRESH_INTERVAL);
        // A failed request for keys refuses nobody and is repeated soon.
        *fake.tells.lock().unwrap() = None;
        for number in 5..9 {
            let unanswered = fake.signs_in(&provider, number).await;
            assert!(matches!(unanswered, Err(ExchangeError::KeysUnknown)));
        }
        assert_eq!(fake.asked.load(Ordering::SeqCst), 3);
        fake.clock.advance(KEYS_RETRY_INTERVAL);
        fake.rolls_over(2);
        assert_eq!(fake.signs_in(&provider, 9).await.unwrap(), "anna");
        assert_eq!(fake.asked.load(Ordering::SeqCst), 4);
    })
    .await;
}

#[tokio::test]
async fn a_discovery_that_takes_long_does_not_bring_the_former_keys_back() {
    let fake = Fake::new().await;
    let provider = fake.provider();
    with_fake(&fake, async {
        provider.discover().await.unwrap();
        fake.answers
            .forget_permits(fake.answers.available_permits());
        let discovery = provider.discover();
        let sign_in = async {
            fake.is_asked(2).await;
            fake.signs_by.store(2, Ordering::SeqCst);
            let sign_in = fake.signs_in(&provider, 1);
            tokio::pin!(sign_in);
            let early = tokio::time::timeout(WATCHED, &mut sign_in).await;
            assert!(early.is_err(), "{early:?}");
            // The discovery gets the old key; the new one is published only then.
            fake.answers.add_permits(1);
            let rollover = async {
                fake.is_asked(3).await;
                fake.rolls_over(2);
                fake.answers.add_permits(1);
            };
            let (signed_in, ()) = tokio::join!(sign_in, rollover);
            signed_in
        };
        let (discovered, signed_in) = tokio::join!(discovery, sign_in);
        discovered.unwrap();
        assert_eq!(signed_in.unwrap(), "anna");
        assert_eq!(fake.signs_in(&provider, 2).await.unwrap(), "anna");
    })
    .await;
}

#[tokio::test]
async fn a_malformed_answer_of_the_provider_is_not_called_silence() {
    let fake = Fake::new().await;
    let provider = fake.provider();
    with_fake(&fake, async {
        provider.discover().await.unwrap();
        fake.signs_by.store(0, Ordering::SeqCst);
        let malformed = fake.signs_in(&provider, 1).await;
        assert!(
            matches!(malformed, Err(ExchangeError::Malformed(_))),
            "{malformed:?}"
        );
        fake.signs_by.store(1, Ordering::SeqCst);
        assert_eq!(fake.signs_in(&provider, 2).await.unwrap(), "anna");
    })
    .await;
}
