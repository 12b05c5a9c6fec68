//! What a server notes and reads first when it opens a database.

use super::{App, AppError};
use crate::{build, db};

impl App {
    /// Stores the version of this server, unless the last one to open the database was the same.
    ///
    /// # Errors
    /// The database failed.
    pub async fn record_version(&self) -> Result<(), AppError> {
        let mut tx = self.db().write("start").await?;
        let now = self.clock().now();
        db::schema::record_version(&mut tx, build::VERSION, now).await?;
        Ok(tx.commit().await?)
    }

    /// Continues the clock after the newest time in the database, so that time does not go back
    /// over a restart either.
    ///
    /// # Errors
    /// The database failed.
    pub async fn continue_time(&self) -> Result<(), AppError> {
        let mut tx = self.db().read("start").await?;
        let newest = db::times::newest(&mut tx).await?;
        let newest_id = db::times::newest_id(&mut tx).await?;
        self.clock().continue_after(newest, newest_id);
        Ok(())
    }
}
