use tread_store::timeouts::ACQUIRE_TIMEOUT;

use super::*;

#[test]
fn versions_compare_as_numbers() {
    assert!(is_new_enough("3.51.3") && is_new_enough("3.100.0") && is_new_enough("4.0.0"));
    assert!(!is_new_enough("3.51.2") && !is_new_enough("3.9.9") && !is_new_enough("?"));
}

#[tokio::test]
async fn a_missing_folder_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let error = Db::open(&folder.path().join("nowhere/tread.db"))
        .await
        .unwrap_err();
    assert!(error.to_string().contains("nowhere"), "{error}");
}

#[tokio::test]
async fn the_file_is_made_with_the_settings_that_keep_commits() {
    let folder = tempfile::tempdir().unwrap();
    let db = Db::open(&folder.path().join("tread.db")).await.unwrap();
    let mut tx = db.write("db").await.unwrap();
    let setting = async |tx: &mut Tx, name: &'static str| -> String {
        let row: (String,) = sqlx::query_as(name).fetch_one(&mut **tx).await.unwrap();
        row.0
    };
    let journal = setting(&mut tx, "SELECT journal_mode FROM pragma_journal_mode").await;
    assert_eq!(journal, "wal");
    let durable = "SELECT CAST(synchronous AS TEXT) FROM pragma_synchronous";
    assert_eq!(setting(&mut tx, durable).await, "2");
    let keys = "SELECT CAST(foreign_keys AS TEXT) FROM pragma_foreign_keys";
    assert_eq!(setting(&mut tx, keys).await, "1");
    drop(tx);
    let mut reading = db.read("db").await.unwrap();
    let refused = sqlx::query("DELETE FROM sites")
        .execute(&mut *reading)
        .await;
    assert!(refused.is_err(), "a reader wrote");
}

#[tokio::test]
async fn what_is_committed_counts_even_if_nobody_waits_for_it_and_uploads_never_do() {
    let folder = tempfile::tempdir().unwrap();
    let db = Db::open(&folder.path().join("some.db")).await.unwrap();
    let before = db.generation();
    drop(db.write("db").await.unwrap());
    let mut committing = Box::pin(db.write("db").await.unwrap().commit());
    assert!(futures_util::FutureExt::now_or_never(&mut committing).is_none());
    drop(committing);
    let counted = async {
        while db.generation() == before {
            tokio::task::yield_now().await;
        }
    };
    tokio::time::timeout(ACQUIRE_TIMEOUT, counted)
        .await
        .unwrap();
    assert_eq!(db.generation(), before + 1);
    db.write_uncounted("db")
        .await
        .unwrap()
        .commit()
        .await
        .unwrap();
    assert_eq!(db.generation(), before + 1);
}

/// Fills the log with so many MiB by commits.
async fn fill_log(db: &Db, mebibytes: usize) {
    for _ in 0..mebibytes {
        let mut tx = db.write_uncounted("db").await.unwrap();
        let blob = "INSERT INTO filling VALUES (randomblob(1048576))";
        sqlx::query(blob).execute(&mut *tx).await.unwrap();
        tx.commit().await.unwrap();
    }
}

async fn db_with_filling(folder: &Path) -> Db {
    let db = Db::open(&folder.join("tread.db")).await.unwrap();
    let mut tx = db.write_uncounted("db").await.unwrap();
    let table = sqlx::query("CREATE TABLE filling (bytes BLOB)");
    table.execute(&mut *tx).await.unwrap();
    tx.commit().await.unwrap();
    db
}

#[tokio::test]
async fn a_checkpoint_resets_a_large_log_so_that_it_does_not_grow() {
    let folder = tempfile::tempdir().unwrap();
    let db = db_with_filling(folder.path()).await;
    let log = folder.path().join("tread.db-wal");
    let mut sizes = Vec::new();
    for _ in 0..4 {
        fill_log(&db, 20).await;
        db.checkpoint().await.unwrap();
        sizes.push(std::fs::metadata(&log).unwrap().len());
    }
    assert!(sizes[0] >= 20 << 20, "{sizes:?}");
    assert!(sizes[3] < sizes[0] + (2 << 20), "{sizes:?}");
}

#[tokio::test]
async fn no_commit_checkpoints_the_log_that_a_long_reader_has_blocked() {
    let folder = tempfile::tempdir().unwrap();
    let db = db_with_filling(folder.path()).await;
    let mut reading = db.read("db").await.unwrap();
    let count = sqlx::query("SELECT count(*) FROM filling");
    count.execute(&mut *reading).await.unwrap();
    fill_log(&db, 80).await;
    db.checkpoint().await.unwrap();
    drop(reading);
    // The file grows by what is copied. This commit is the first after the reader has ended.
    let size = || {
        std::fs::metadata(folder.path().join("tread.db"))
            .unwrap()
            .len()
    };
    let before = size();
    fill_log(&db, 1).await;
    assert_eq!(size(), before, "the commit has checkpointed the log");
    db.checkpoint().await.unwrap();
    assert!(size() >= before + (80 << 20), "{before} {}", size());
}
