//! Files in a bucket of a server that is not ours.

use std::io::Write as _;
use tokio::time::Instant;

use object_store::ObjectStoreExt as _;
use object_store::aws::AmazonS3Builder;
use object_store::path::Path as Key;
use tread_samples::s3::S3Server;

use super::tests::everything;
use super::tests::samples::rows;
use super::*;

const BUCKET: &str = "fleet";

async fn create(server: &S3Server) {
    let url = format!("{}/{BUCKET}", server.endpoint());
    let made = reqwest::Client::new().put(url).send().await.unwrap();
    assert!(made.status().is_success());
}

fn open(server: &S3Server, prefix: &str) -> Bucket {
    let settings = AmazonS3Builder::new()
        .with_endpoint(server.endpoint())
        .with_allow_http(true)
        .with_region("us-east-1")
        .with_access_key_id("test")
        .with_secret_access_key("test");
    let location = BucketLocation {
        bucket: BUCKET.to_owned(),
        prefix: prefix.to_owned(),
    };
    Bucket::with(settings, location).unwrap()
}

fn archive(bucket: Bucket) -> SegmentArchive {
    SegmentArchive {
        storage: Storage::Bucket(bucket, std::env::temp_dir()),
        mark_file: None,
    }
}

fn write(archive: &SegmentArchive, rows: &[ArchivedSegment]) -> (KeyRange, Vec<PathBuf>) {
    let (first, last) = (rows[0].stored.id, rows[rows.len() - 1].stored.id);
    let mut writer = archive.begin(KeyRange { first, last }).unwrap();
    writer.add(rows.to_vec()).unwrap();
    let finished = writer.finish().unwrap();
    assert_eq!(finished.read(first - 1, usize::MAX).unwrap(), rows);
    (finished.keys(), archive.publish(&finished).unwrap())
}

/// Runs a test whose calls wait on a blocking thread, as the server does.
async fn with_bucket(test: &str, body: impl FnOnce(&mut S3Server, Bucket) + Send + 'static) {
    let _ = rustls::crypto::ring::default_provider().install_default();
    let Some(mut server) = S3Server::start(test) else {
        return;
    };
    create(&server).await;
    let bucket = open(&server, "north/1");
    let done = tokio::task::spawn_blocking(move || body(&mut server, bucket));
    done.await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_bucket_holds_the_same_files_as_a_folder() {
    with_bucket("a_bucket_holds_the_same_files_as_a_folder", |_, bucket| {
        let archive = archive(bucket);
        archive.check_present(None).unwrap();
        archive.check_writable().unwrap();
        assert_eq!(archive.list().unwrap(), Listing::default());
        // More than a row group, so that its parts are read from several places.
        let all = rows(1, 40 + i64::try_from(ROW_GROUP_ROWS).unwrap());
        let (one, two) = all.split_at(ROW_GROUP_ROWS + 10);
        for part in [one, two] {
            assert!(write(&archive, part).1.is_empty());
        }
        let mark = KeyRange {
            first: 1,
            last: all[all.len() - 1].stored.id,
        };
        assert_eq!(archive.list().unwrap().files.len(), 2);
        assert_eq!(archive.examine(Some(mark), true).unwrap(), 2);
        let found = archive
            .read(&everything(0, mark.last + 1), Some(mark), usize::MAX)
            .unwrap();
        assert!(found.segments == all);
        let folder = tempfile::tempdir().unwrap();
        let local = SegmentArchive::new(folder.path().to_owned().into(), None).unwrap();
        for part in [one, two] {
            let (keys, _) = write(&local, part);
            let here = std::fs::read(local.path_of(keys)).unwrap();
            let object = match &archive.storage {
                Storage::Bucket(bucket, _) => bucket.open_object(&keys.name()).unwrap(),
                Storage::Folder(_) => unreachable!(),
            };
            let there = object.read(0..object.length()).unwrap();
            assert!(here == there, "the same bytes");
        }
        let missing = KeyRange {
            first: 1,
            last: mark.last + 1,
        };
        assert!(matches!(
            archive.check_present(Some(missing)),
            Err(SegmentArchiveError::Missing { .. })
        ));
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_file_of_many_parts_is_uploaded_as_a_whole() {
    with_bucket("a_file_of_many_parts_is_uploaded", |_, bucket| {
        let mut file = tempfile::tempfile().unwrap();
        let pattern: Vec<u8> = (0_u32..5_000_000).flat_map(u32::to_le_bytes).collect();
        file.write_all(&pattern).unwrap();
        bucket.upload(&file, "big").unwrap();
        let object = bucket.open_object("big").unwrap();
        assert_eq!(object.length(), pattern.len() as u64);
        let read = object.read(0..object.length()).unwrap();
        assert!(read == pattern, "other bytes");
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_file_whose_keys_are_given_again_is_kept_under_another_name() {
    with_bucket("a_file_whose_keys_are_given_again", |server, bucket| {
        // What others put there, also under names that are no paths, is of no concern.
        for name in ["north//f", "north/1//f", "f", "north/1/notes.parquet"] {
            let url = format!("{}/{BUCKET}/{name}", server.endpoint());
            let put = reqwest::Client::new().put(url).body("other").send();
            let put = tokio::runtime::Handle::current().block_on(put).unwrap();
            assert!(put.status().is_success(), "{name}");
        }
        let archive = archive(bucket);
        write(&archive, &rows(1, 5));
        let (keys, superseded) = write(&archive, &rows(1, 7));
        assert_eq!(archive.list().unwrap().files, [keys]);
        let name = "s3://fleet/north/1/segments-0000000000000000001-0000000000000000005.parquet";
        assert_eq!(superseded, [PathBuf::from(format!("{name}.superseded"))]);
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn damage_and_absence_of_the_storage_are_distinguished_and_named() {
    with_bucket("damage_and_absence_of_the_storage", |server, bucket| {
        let runtime = tokio::runtime::Handle::current();
        let path = Key::from("north/1/segments-0000000000000000001-0000000000000000005.parquet");
        let store = bucket.clone();
        let archive = archive(bucket);
        let (keys, _) = write(&archive, &rows(1, 5));
        let whole = runtime.block_on(async {
            let found = store.store.get(&path).await.unwrap();
            found.bytes().await.unwrap()
        });
        for at in [0, 9, whole.len() / 2, whole.len() - 20, whole.len() - 1] {
            let mut damaged = whole.to_vec();
            damaged[at] ^= 4;
            runtime
                .block_on(store.store.put(&path, damaged.into()))
                .unwrap();
            match archive.read_file(keys, 0, 9) {
                Ok(found) => assert_eq!(found, rows(1, 5)),
                Err(error) => assert!(
                    matches!(error, SegmentArchiveError::Damaged { .. }),
                    "{error}"
                ),
            }
            assert!(
                archive.examine(Some(keys), true).is_err() || at < 4,
                "byte {at}"
            );
        }
        server.end();
        let began = Instant::now();
        let error = archive.list().unwrap_err();
        assert!(
            matches!(error, SegmentArchiveError::Bucket { .. }),
            "{error}"
        );
        assert!(error.to_string().contains("s3://fleet/north/1"), "{error}");
        assert!(began.elapsed().as_secs() < 60, "{:?}", began.elapsed());
        server.restart();
        let error = archive.list().unwrap_err().to_string();
        assert!(error.contains("NoSuchBucket"), "{error}");
    })
    .await;
}
