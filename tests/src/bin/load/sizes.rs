//! What a segment takes on the way and on the disk, and a state on the way.

use std::path::Path;

use anyhow::Context as _;
use serde::Serialize;
use tread_api::wire;
use tread_api::wire::encoding::Encoding;
use tread_api::wire::ingest::Batch;
use tread_tests::database::FleetDatabase;
use tread_tests::fleet::Fleet;
use tread_tests::report::{Check, figure};

use crate::start_light_robots;

/// Robots, and uploads of each: four sums of each cell, as after a few rounds.
const ROBOTS: u32 = 20;
const UPLOADS: u64 = 64;
/// Segments of an upload.
const BATCH: usize = 100;

/// Bytes of one segment, or of one state.
#[derive(Debug, Serialize)]
pub(crate) struct Sizes {
    segments: u64,
    cbor: f64,
    json: f64,
    state: f64,
    database: f64,
    parquet: f64,
}

/// Uploads to a server of its own, and weighs what comes of it.
pub(crate) async fn measure(node: &Path) -> anyhow::Result<Sizes> {
    let mut fleet = Fleet::start_with(node).await;
    let mut robots = start_light_robots(&fleet, ROBOTS, false).await?;
    let before = stored_bytes(fleet.database()).await?;
    let (mut cbor, mut json, mut state) = (0, 0, 0);
    for robot in &mut robots {
        state += wire::encode(&robot.next_state())?.len();
        for _ in 0..UPLOADS {
            let batch = robot.next_batch(BATCH);
            cbor += encoded(Encoding::Cbor, &batch)?;
            json += encoded(Encoding::Json, &batch)?;
            robot.upload(&batch).await?;
        }
    }
    let segments = u64::from(ROBOTS) * UPLOADS * BATCH as u64;
    let path = format!("/v1/sites/{}/segments?format=parquet", fleet.site());
    let parquet = fleet.rest.bytes(&path).await.context("no export")?.len();
    drop(robots);
    // It stores its sums before it ends.
    fleet.stop_server().await?;
    let database = stored_bytes(fleet.database()).await? - before;
    let each = |bytes: usize, count: u64| figure(bytes as u64) / figure(count);
    Ok(Sizes {
        segments,
        cbor: each(cbor, segments),
        json: each(json, segments),
        state: each(state, u64::from(ROBOTS)),
        database: figure(database) / figure(segments),
        parquet: each(parquet, segments),
    })
}

/// Returns the size of an upload, bytes.
fn encoded(encoding: Encoding, batch: &Batch) -> anyhow::Result<usize> {
    let payload = wire::encode_as(encoding, batch);
    let payload = payload.map_err(|error| anyhow::anyhow!("cannot encode: {error}"))?;
    Ok(payload.len())
}

/// Returns the size of a database, bytes.
async fn stored_bytes(database: &FleetDatabase) -> anyhow::Result<u64> {
    if database.server().is_some() {
        let size = "SELECT pg_database_size(current_database())";
        let rows: Vec<(i64,)> = database.rows(size).await?;
        let (bytes,) = rows.first().context("PostgreSQL knows the size")?;
        return Ok(u64::try_from(*bytes)?);
    }
    let mut bytes = 0;
    for file in std::fs::read_dir(database.folder())? {
        let file = file?;
        if file.file_name().to_string_lossy().starts_with("tread.db") {
            bytes += file.metadata()?.len();
        }
    }
    Ok(bytes)
}

impl Sizes {
    pub(crate) fn checks(&self) -> Vec<Check> {
        vec![
            Check::shown("a segment of an upload in CBOR, bytes", self.cbor),
            Check::shown("a segment of an upload in JSON, bytes", self.json),
            Check::shown("a state, bytes", self.state),
            Check::shown(
                "a segment in the database, sums included, bytes",
                self.database,
            ),
            Check::shown("a segment in a Parquet export, bytes", self.parquet),
        ]
    }

    pub(crate) fn words(&self) -> String {
        format!("{} segments of {ROBOTS} robots\n", self.segments)
    }
}
