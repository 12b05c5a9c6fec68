//! Files of the archive in a bucket of S3-compatible storage.
//!
//! Address and credentials come from the environment, by the names that all programs for S3 use
//! (`AWS_ENDPOINT_URL`, `AWS_REGION`, `AWS_ACCESS_KEY_ID`, `AWS_SECRET_ACCESS_KEY`, ...). The functions
//! wait for answers: call them on a blocking thread of the runtime.

use std::fs::File;
use std::io;
use std::ops::Range;
use std::os::unix::fs::FileExt as _;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use object_store::aws::{AmazonS3, AmazonS3Builder, AmazonS3ConfigKey, Checksum};
use object_store::list::{PaginatedListOptions, PaginatedListStore as _};
use object_store::path::Path;
use object_store::{
    ClientConfigKey, GetOptions, GetRange, ObjectStore as _, ObjectStoreExt as _, PutPayload,
    RetryConfig, WriteMultipart,
};
use tokio::runtime::Handle;

use super::SegmentArchiveError;
use super::fault::Fault;
use super::folder::Rename;
use super::location::BucketLocation;
use super::reason::reason;

/// Maximum time for a connection.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(5);
/// Maximum time for one request; a part of [`PART_BYTES`] on a line of 0.7 Mbit/s.
const REQUEST_TIMEOUT: Duration = Duration::from_mins(1);
/// Maximum number of repetitions of a request, and maximum time after which it is repeated.
const RETRIES_MAX: usize = 3;
const RETRY_TIMEOUT: Duration = Duration::from_secs(30);
/// Number of bytes of a part of an upload, the least by the rules of S3.
const PART_BYTES: usize = 5 * 1024 * 1024;
/// Maximum number of parts that are sent at the same time.
const PARTS_MAX: usize = 1;
/// Number of bytes at the end of an object that are read first; most footers are shorter.
const TAIL_BYTES: u64 = 128 * 1024;
/// Maximum number of names in the listing of a bucket.
const NAMES_MAX: usize = 1_000_000;

/// A bucket.
#[derive(Debug, Clone)]
pub(super) struct Bucket {
    pub(super) store: Arc<AmazonS3>,
    location: BucketLocation,
}

impl Bucket {
    /// Prepares access; makes no request.
    ///
    /// # Errors
    /// The environment has values that cannot be used.
    pub(super) fn open(location: BucketLocation) -> Result<Self, SegmentArchiveError> {
        Self::with(AmazonS3Builder::from_env(), location)
    }

    /// Prepares access with other settings than those of the environment.
    ///
    /// # Errors
    /// They cannot be used.
    pub(super) fn with(
        settings: AmazonS3Builder,
        location: BucketLocation,
    ) -> Result<Self, SegmentArchiveError> {
        // Fails if another part of the program was first, which is as good.
        let _first = rustls::crypto::ring::default_provider().install_default();
        let retry = RetryConfig {
            max_retries: RETRIES_MAX,
            retry_timeout: RETRY_TIMEOUT,
            ..RetryConfig::default()
        };
        // Not by options of their own, which would replace those of the environment.
        let timeout = |key: ClientConfigKey| AmazonS3ConfigKey::Client(key);
        let seconds = |time: Duration| format!("{} seconds", time.as_secs());
        let built = settings
            .with_config(
                timeout(ClientConfigKey::ConnectTimeout),
                seconds(CONNECT_TIMEOUT),
            )
            .with_config(timeout(ClientConfigKey::Timeout), seconds(REQUEST_TIMEOUT))
            .with_retry(retry)
            .with_checksum_algorithm(Checksum::SHA256)
            .with_bucket_name(&location.bucket)
            .build();
        let built = built.map_err(|cause| SegmentArchiveError::Settings {
            bucket: location.to_string(),
            reason: reason(&cause),
        })?;
        Ok(Self {
            store: Arc::new(built),
            location,
        })
    }

    /// Returns its location as text.
    pub(super) fn shown(&self) -> PathBuf {
        self.location.to_string().into()
    }

    fn path_of(&self, name: &str) -> Path {
        Path::from(self.location.prefix.as_str()).join(name)
    }

    fn failed(&self, cause: &object_store::Error) -> SegmentArchiveError {
        SegmentArchiveError::Bucket {
            bucket: self.location.to_string(),
            reason: reason(cause),
        }
    }

    /// Returns the names directly below the prefix of the bucket that begin with a text; others, which may
    /// be of any program, are not asked for.
    pub(super) fn names(&self, beginning: &str) -> Result<Vec<String>, SegmentArchiveError> {
        let prefix = self.path_of(beginning).to_string();
        let listing = async {
            let mut names = Vec::new();
            let mut page_token = None;
            loop {
                let options = PaginatedListOptions {
                    delimiter: Some("/".into()),
                    page_token,
                    ..PaginatedListOptions::default()
                };
                let page = self.store.list_paginated(Some(&prefix), options).await?;
                let objects = page.result.objects.iter();
                let found = objects.filter_map(|object| object.location.filename());
                names.extend(found.map(str::to_owned));
                page_token = page.page_token;
                if page_token.is_none() || names.len() >= NAMES_MAX {
                    return Ok(names);
                }
            }
        };
        wait(listing).map_err(|cause| self.failed(&cause))
    }

    /// Writes an object with a name and removes it.
    pub(super) fn probe(&self, name: &str) -> Result<(), SegmentArchiveError> {
        let path = self.path_of(name);
        let probing = async {
            self.store
                .put(&path, PutPayload::from_static(b"probe"))
                .await?;
            self.store.delete(&path).await
        };
        wait(probing).map_err(|cause| self.failed(&cause))
    }

    /// Stores a file as an object, which is there as a whole or not at all.
    pub(super) fn upload(&self, file: &File, name: &str) -> Result<(), SegmentArchiveError> {
        let path = self.path_of(name);
        let length = file
            .metadata()
            .map_err(|error| self.unreadable(error))?
            .len();
        let uploading = async {
            let upload = self.store.put_multipart(&path).await?;
            let mut upload = WriteMultipart::new_with_chunk_size(upload, PART_BYTES);
            let mut at = 0;
            while at < length {
                if let Err(cause) = upload.wait_for_capacity(PARTS_MAX).await {
                    // What was sent is of no use; the storage may remove it only by a rule of the bucket.
                    let _ = upload.abort().await;
                    return Err(cause);
                }
                let count = (length - at).min(PART_BYTES as u64);
                let mut part = vec![0; usize::try_from(count).unwrap_or(PART_BYTES)];
                if let Err(error) = file.read_exact_at(&mut part, at) {
                    let _ = upload.abort().await;
                    return Err(object_store::Error::Generic {
                        store: "S3",
                        source: Box::new(error),
                    });
                }
                upload.put(part.into());
                at += count;
            }
            upload.finish().await.map(|_done| ())
        };
        wait(uploading).map_err(|cause| self.failed(&cause))
    }

    fn unreadable(&self, error: io::Error) -> SegmentArchiveError {
        self.failed(&object_store::Error::Generic {
            store: "S3",
            source: Box::new(error),
        })
    }

    /// Gives an object another name.
    pub(super) fn rename(&self, names: Rename<'_>) -> Result<(), SegmentArchiveError> {
        let (from, to) = (self.path_of(names.from), self.path_of(names.to));
        wait(self.store.rename(&from, &to)).map_err(|cause| self.failed(&cause))
    }

    /// Opens an object and reads its end.
    pub(super) fn open_object(&self, name: &str) -> Result<Object, SegmentArchiveError> {
        let path = self.path_of(name);
        let options = GetOptions {
            range: Some(GetRange::Suffix(TAIL_BYTES)),
            ..GetOptions::default()
        };
        let reading = async {
            let found = self.store.get_opts(&path, options).await?;
            let length = found.meta.size;
            Ok((length, found.bytes().await?))
        };
        let (length, tail) = wait(reading).map_err(|cause| self.failed(&cause))?;
        Ok(Object {
            bucket: self.clone(),
            path,
            length,
            tail,
        })
    }
}

/// An object of the bucket.
#[derive(Debug)]
pub(super) struct Object {
    bucket: Bucket,
    path: Path,
    length: u64,
    tail: Bytes,
}

impl Object {
    pub(super) fn length(&self) -> u64 {
        self.length
    }

    /// Reads a range of bytes, which is within the object.
    pub(super) fn read(&self, range: Range<u64>) -> Result<Bytes, Fault> {
        let tail_at = self.length.saturating_sub(self.tail.len() as u64);
        let place = |at: u64| {
            at.checked_sub(tail_at)
                .and_then(|at| usize::try_from(at).ok())
        };
        if let (Some(begin), Some(end)) = (place(range.start), place(range.end)) {
            return Ok(self.tail.slice(begin..end));
        }
        let reading = self.bucket.store.get_range(&self.path, range);
        wait(reading).map_err(|cause| Fault::Storage(reason(&cause)))
    }
}

/// Waits for the answer to a request.
fn wait<T>(
    request: impl Future<Output = Result<T, object_store::Error>>,
) -> Result<T, object_store::Error> {
    match Handle::try_current() {
        Ok(runtime) => runtime.block_on(request),
        Err(cause) => Err(object_store::Error::Generic {
            store: "S3",
            source: Box::new(cause),
        }),
    }
}
