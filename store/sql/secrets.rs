//! Rows of tokens, which contain the hash of a secret and never the secret.

pub use tread_store::secrets::TokenRow;

/// Defines look-ups of tokens: by identifier, and by the first bytes of the hash of the secret.
/// `$rows!` selects the columns of a token.
macro_rules! look_up_tokens {
    ($table:tt, $rows:ident, $what:tt, $id:ty, $token:ty) => {
        /// Returns a token by its identifier.
        pub async fn find(db: &mut Connection, id: $id) -> Result<Option<$token>, EngineError> {
            let id = id.to_string();
            let raw = $rows!("WHERE id = $1", id).fetch_optional(db).await?;
            raw.map(<$token>::try_from).transpose()
        }

        /// Returns the token whose hash has the same first bytes.
        pub async fn by_lookup(
            db: &mut Connection,
            fingerprint: &Fingerprint,
        ) -> Result<Option<TokenRow<$token>>, EngineError> {
            let lookup = fingerprint.lookup();
            let row = sqlx::query!(
                "SELECT id, hash FROM " + $table + " WHERE lookup = $1",
                lookup
            )
            .fetch_optional(&mut *db)
            .await?;
            let Some(row) = row else {
                return Ok(None);
            };
            let token = find(db, parse($what, &row.id)?).await?;
            Ok(token.map(|token| TokenRow {
                hash: row.hash,
                token,
            }))
        }
    };
}

pub(super) use look_up_tokens;
