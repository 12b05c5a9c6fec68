use super::connections::ACQUIRE_TIMEOUT;
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
    db.write_uploads("db")
        .await
        .unwrap()
        .commit()
        .await
        .unwrap();
    assert_eq!(db.generation(), before + 1);
}
