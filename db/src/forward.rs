//! The macro that makes the functions of an aggregate from a list of their parameters.

/// Defines a module's functions, each of which calls the function of the same name, in the module of
/// the same name, of the engine that the transaction belongs to. Both engines are compiled, so a
/// difference in parameters or results is an error of compilation.
macro_rules! forward {
    ($module:ident; $(fn $name:ident($($argument:ident: $type:ty),* $(,)?) -> $result:ty;)*) => {$(
        /// Calls the engine's function of this name, whose documentation is beside its SQL.
        ///
        /// # Errors
        /// The engine failed, or a stored value cannot be parsed.
        pub async fn $name(tx: &mut Tx, $($argument: $type),*) -> Result<$result, DbError> {
            let done = match tx {
                Tx::Sqlite(tx) => tread_store_sqlite::$module::$name(tx, $($argument),*).await?,
                // Boxed: such a future is large, and every caller would contain it, whatever the engine.
                Tx::Postgres(tx) => {
                    Box::pin(tread_store_postgres::$module::$name(tx, $($argument),*)).await?
                }
            };
            Ok(done)
        }
    )*};
}

pub(crate) use forward;
