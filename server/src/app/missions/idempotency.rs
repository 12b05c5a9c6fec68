//! `Idempotency-Key`: the same request under the same key gets the same answer, also after a
//! restart of the server. A key belongs to the token or person that sends it.
//! An answer is stored in the same transaction as its mission, so neither exists without the other.
//! Keys are kept for [`KEPT`].

use std::collections::HashSet;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use jiff::SignedDuration;
use tread_api::mission::{CreateMission, Mission};
use uuid::Uuid;

use super::InsertedMission;
use crate::app::{App, AppError};
use crate::db;
use crate::db::idempotency::{OwnKey, StoredAnswer};
use crate::identity::subject::SubjectId;

/// Maximum length of a key, characters.
pub const KEY_LENGTH_MAX: usize = 200;
/// Time for which a key is kept.
pub const KEPT: Duration = Duration::from_hours(7 * 24);
/// Maximum number of old keys deleted with each new one.
const FORGET_MAX: u32 = 10;
/// Namespace of the UUIDs that are hashes of requests.
const REQUESTS: Uuid = Uuid::from_u128(0x2d6c_35ab_0f1e_4a8e_9f64_7a0c_9b5e_11d3);

/// The keys of requests that are being processed.
#[derive(Debug, Default)]
pub(in crate::app) struct InFlight {
    keys: Mutex<HashSet<(SubjectId, String)>>,
}

impl InFlight {
    fn lock(&self) -> MutexGuard<'_, HashSet<(SubjectId, String)>> {
        self.keys.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Marks a key as in use while its request is processed; dropping it ends that.
struct KeyReservation<'app> {
    in_flight: &'app InFlight,
    key: (SubjectId, String),
}

impl<'app> KeyReservation<'app> {
    fn of(in_flight: &'app InFlight, (owner, key): OwnKey<'_>) -> Option<Self> {
        let key = (owner, key.to_owned());
        let is_first = in_flight.lock().insert(key.clone());
        is_first.then_some(Self { in_flight, key })
    }
}

impl Drop for KeyReservation<'_> {
    fn drop(&mut self) {
        self.in_flight.lock().remove(&self.key);
    }
}

/// Outcome of a request with a key.
enum KeyedOutcome {
    /// The key has an answer from before.
    Before(Mission),
    /// The mission is stored.
    Now(InsertedMission),
}

impl App {
    /// Creates a mission, once per idempotency key of a token or person.
    ///
    /// # Errors
    /// [`AppError::KeyInFlight`] while a request with the same key is processed,
    /// [`AppError::KeyReused`] if the key was used for another request, and all errors of
    /// [`App::create_mission`].
    pub async fn create_mission_once(
        &self,
        key: OwnKey<'_>,
        request: CreateMission,
    ) -> Result<Mission, AppError> {
        let Some(_holding) = KeyReservation::of(self.keys_in_flight(), key) else {
            return Err(AppError::KeyInFlight);
        };
        let written = serde_json::to_vec(&request).unwrap_or_default();
        let request_hash = Uuid::new_v5(&REQUESTS, &written);
        let mut tx = self.db().read("missions").await?;
        let is_new = db::idempotency::find(&mut tx, key, request_hash)
            .await?
            .is_none();
        drop(tx);
        if is_new {
            self.check_new(&request).await?;
        }
        let robot = (request.site.clone(), request.robot.clone());
        let trajectory = request.trajectory.clone();
        let early_prior = async {
            if is_new {
                self.early_prior(&robot, &trajectory).await
            } else {
                None
            }
        };
        let storing = self.store_once(key, request_hash, request);
        let (prior, stored) = tokio::join!(early_prior, storing);
        Ok(match stored? {
            KeyedOutcome::Before(answer) => answer,
            KeyedOutcome::Now(enqueued) => self.enqueued(enqueued, prior),
        })
    }

    /// Stores a mission with the answer to its request, unless the key has one.
    async fn store_once(
        &self,
        key: OwnKey<'_>,
        request_hash: Uuid,
        request: CreateMission,
    ) -> Result<KeyedOutcome, AppError> {
        let mut tx = self.db().write_uncounted("missions").await?;
        if let Some(stored) = db::idempotency::find(&mut tx, key, request_hash).await? {
            if stored.request_hash != request_hash {
                return Err(AppError::KeyReused);
            }
            let corrupt = |_error| db::DbError::Corrupt {
                what: "answer",
                value: stored.answer.clone(),
            };
            let answer = serde_json::from_str(&stored.answer).map_err(corrupt)?;
            return Ok(KeyedOutcome::Before(answer));
        }
        let enqueued = self.enqueue(&mut tx, request).await?;
        let answer = serde_json::to_string(&enqueued.row.mission)
            .map_err(|_error| db::DbError::DoesNotFit("mission"))?;
        let stored = StoredAnswer {
            request_hash,
            answer,
        };
        let now = self.clock().now();
        db::idempotency::insert(&mut tx, key, &stored, now).await?;
        let kept = SignedDuration::try_from(KEPT).unwrap_or(SignedDuration::MAX);
        if let Ok(before) = now.checked_sub(kept) {
            db::idempotency::delete_before(&mut tx, before, FORGET_MAX).await?;
        }
        tx.commit().await?;
        Ok(KeyedOutcome::Now(enqueued))
    }
}
