//! Writes a file under a temporary name.

use std::fs::{self, File, OpenOptions};
use std::os::unix::fs::OpenOptionsExt as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use jiff::Timestamp;
use parquet::data_type::{ByteArray, ByteArrayType, DataType, DoubleType, Int64Type};
use parquet::errors::ParquetError;
use parquet::file::metadata::KeyValue;
use parquet::file::writer::{SerializedFileWriter, SerializedRowGroupWriter};
use tread_api::friction::{Information, Segment};

use super::checksum::{self, ChecksumWriter};
use super::fault::guarded;
use super::source::Source;
use super::{ArchivedSegment, KeyRange, ROW_GROUP_ROWS, SegmentArchiveError, read_source, schema};
use crate::file_error::FileError;

/// Writes the measurements of one file.
pub struct Writer {
    keys: KeyRange,
    partial: Partial,
    file: SerializedFileWriter<ChecksumWriter>,
    /// Rows of the next row group.
    waiting: Vec<ArchivedSegment>,
    /// End and checksum of each row group.
    groups: Vec<String>,
}

/// A written file that does not have its name yet; it is removed unless it gets one.
#[derive(Debug)]
pub struct Finished {
    /// Keys of its measurements.
    pub(super) keys: KeyRange,
    file: File,
    partial: Partial,
}

/// The temporary file, which is removed if the work ends early.
#[derive(Debug)]
struct Partial {
    path: PathBuf,
    is_removed: bool,
}

impl Drop for Partial {
    fn drop(&mut self) {
        if !self.is_removed {
            // If it stays, the next start removes it.
            let _ = fs::remove_file(&self.path);
        }
    }
}

impl Finished {
    /// Returns the keys of its measurements.
    pub fn keys(&self) -> KeyRange {
        self.keys
    }

    /// Reads its measurements after a key from the disk, at most `limit`.
    ///
    /// # Errors
    /// It cannot be read or is damaged.
    pub fn read(
        &self,
        after: i64,
        limit: usize,
    ) -> Result<Vec<ArchivedSegment>, SegmentArchiveError> {
        let path = &self.partial.path;
        let file = self.file.try_clone();
        let source = Source::File(file.map_err(FileError::of("open", path))?);
        read_source(path.clone(), source, self.keys, after, limit)
    }

    pub(super) fn file(&self) -> &File {
        &self.file
    }

    pub(super) fn rename(&self, target: &Path) -> Result<(), FileError> {
        let path = &self.partial.path;
        fs::rename(path, target).map_err(FileError::of("rename", path))
    }
}

impl Writer {
    /// Begins a file at a path, which is gone at once if the file is only `uploaded`.
    pub(super) fn create(
        path: PathBuf,
        keys: KeyRange,
        follows: i64,
        uploaded: bool,
    ) -> Result<Self, SegmentArchiveError> {
        let mut options = OpenOptions::new();
        // Read again for the checksum of the footer.
        options.read(true).write(true);
        if uploaded {
            // In a folder that others may use, no file of theirs is followed or replaced.
            options.create_new(true);
        } else {
            options.create(true).truncate(true);
        }
        let opened = options.mode(0o600).open(&path);
        let file = opened.map_err(FileError::of("create", &path))?;
        if uploaded {
            fs::remove_file(&path).map_err(FileError::of("remove", &path))?;
        }
        let partial = Partial {
            path,
            is_removed: uploaded,
        };
        let written = |file| {
            let columns = Arc::new(schema::columns()?);
            let properties = Arc::new(schema::properties(follows, checksum::placeholder())?);
            SerializedFileWriter::new(ChecksumWriter::new(file), columns, properties)
        };
        let file = written(file).map_err(encoding(&partial.path))?;
        Ok(Self {
            keys,
            file,
            partial,
            waiting: Vec::new(),
            groups: Vec::new(),
        })
    }

    /// Returns the keys of the file.
    pub fn keys(&self) -> KeyRange {
        self.keys
    }

    /// Adds measurements, in the order of their keys.
    ///
    /// # Errors
    /// The disk is full or fails.
    pub fn add(&mut self, segments: Vec<ArchivedSegment>) -> Result<(), SegmentArchiveError> {
        self.waiting.extend(segments);
        while self.waiting.len() >= ROW_GROUP_ROWS {
            let later = self.waiting.split_off(ROW_GROUP_ROWS);
            let rows = std::mem::replace(&mut self.waiting, later);
            self.write_group(&rows)?;
        }
        Ok(())
    }

    /// Writes a row group to the disk; syncing each keeps the disk free for the database's commits.
    fn write_group(&mut self, rows: &[ArchivedSegment]) -> Result<(), SegmentArchiveError> {
        let failed = encoding(&self.partial.path);
        let mut written = || {
            let mut group = self.file.next_row_group()?;
            let columns = Columns {
                group: &mut group,
                rows,
            };
            columns.write()?;
            group.close()?;
            self.file.flush()?;
            let (end, sum) = self.file.inner_mut().take();
            self.groups.push(format!("{end} {sum:08x}"));
            Ok(self.file.inner().file().sync_data()?)
        };
        written().map_err(failed)
    }

    /// Writes the rest, and syncs the file.
    ///
    /// # Errors
    /// The disk is full or fails.
    pub fn finish(mut self) -> Result<Finished, SegmentArchiveError> {
        if !self.waiting.is_empty() {
            let rows = std::mem::take(&mut self.waiting);
            self.write_group(&rows)?;
        }
        let Self {
            keys,
            partial,
            mut file,
            groups,
            ..
        } = self;
        let key = schema::ROW_GROUPS_KEY.to_owned();
        file.append_key_value_metadata(KeyValue::new(key, groups.join(",")));
        let summed = file.into_inner().map_err(encoding(&partial.path))?;
        let file = summed.into_file();
        guarded(&partial.path, || checksum::seal_footer(&file))?;
        file.sync_all()
            .map_err(FileError::of("write", &partial.path))?;
        Ok(Finished {
            keys,
            file,
            partial,
        })
    }
}

fn encoding(path: &Path) -> impl FnOnce(ParquetError) -> SegmentArchiveError + use<> {
    let path = path.to_owned();
    move |cause| SegmentArchiveError::Encoding { path, cause }
}

/// Writes the columns of a row group one after the other.
struct Columns<'group, 'file> {
    group: &'group mut SerializedRowGroupWriter<'file, ChecksumWriter>,
    rows: &'group [ArchivedSegment],
}

fn ns(time: Timestamp) -> Result<i64, ParquetError> {
    i64::try_from(time.as_nanosecond()).map_err(|cause| ParquetError::External(Box::new(cause)))
}

fn text(name: &str) -> ByteArray {
    ByteArray::from(name)
}

impl Columns<'_, '_> {
    fn put<D: DataType>(
        &mut self,
        values: &[D::T],
        levels: Option<&[i16]>,
    ) -> Result<(), ParquetError> {
        let column = self.group.next_column()?;
        let mut column = column.ok_or_else(|| ParquetError::General("no column left".into()))?;
        column.typed::<D>().write_batch(values, levels, None)?;
        column.close()
    }

    fn each<D: DataType>(
        &mut self,
        of: impl Fn(&ArchivedSegment) -> D::T,
    ) -> Result<(), ParquetError> {
        let values: Vec<D::T> = self.rows.iter().map(of).collect();
        self.put::<D>(&values, None)
    }

    fn times(&mut self, of: impl Fn(&Segment) -> Timestamp) -> Result<(), ParquetError> {
        let times = self.rows.iter().map(|row| ns(of(&row.stored.segment)));
        let values = times.collect::<Result<Vec<i64>, ParquetError>>()?;
        self.put::<Int64Type>(&values, None)
    }

    fn some<D: DataType>(
        &mut self,
        of: impl Fn(&ArchivedSegment) -> Option<D::T>,
    ) -> Result<(), ParquetError> {
        let found: Vec<Option<D::T>> = self.rows.iter().map(of).collect();
        let levels: Vec<i16> = found
            .iter()
            .map(|value| i16::from(value.is_some()))
            .collect();
        let values: Vec<D::T> = found.into_iter().flatten().collect();
        self.put::<D>(&values, Some(&levels))
    }

    fn integers(&mut self, of: impl Fn(&Segment) -> i64) -> Result<(), ParquetError> {
        self.each::<Int64Type>(|row| of(&row.stored.segment))
    }

    fn numbers(&mut self, of: impl Fn(&Segment) -> f64) -> Result<(), ParquetError> {
        self.each::<DoubleType>(|row| of(&row.stored.segment))
    }

    fn some_numbers(&mut self, of: impl Fn(&Segment) -> Option<f64>) -> Result<(), ParquetError> {
        self.some::<DoubleType>(|row| of(&row.stored.segment))
    }

    fn pair(&mut self, of: impl Fn(&Segment) -> Option<Information>) -> Result<(), ParquetError> {
        self.some_numbers(|segment| of(segment).map(|pair| pair.information))?;
        self.some_numbers(|segment| of(segment).map(|pair| pair.weighted))
    }

    /// Writes all columns, in the order of the schema.
    fn write(mut self) -> Result<(), ParquetError> {
        let terrain = |row: &ArchivedSegment| row.stored.segment.terrain.clone();
        self.each::<Int64Type>(|row| row.stored.id)?;
        self.each::<ByteArrayType>(|row| text(row.site.as_str()))?;
        self.each::<ByteArrayType>(|row| text(row.stored.robot.as_str()))?;
        self.some::<ByteArrayType>(|row| terrain(row).map(|terrain| text(terrain.id.as_str())))?;
        self.some::<Int64Type>(|row| terrain(row).map(|terrain| terrain.revision.into()))?;
        self.each::<ByteArrayType>(|row| text(&row.stored.boot.to_string()))?;
        self.each::<Int64Type>(|row| row.stored.seq.cast_signed())?;
        self.each::<Int64Type>(|row| row.stored.received_at.as_microsecond())?;
        self.times(|segment| segment.started_at)?;
        self.times(|segment| segment.ended_at)?;
        self.each::<ByteArrayType>(|row| text(&row.stored.segment.configuration.to_string()))?;
        self.some::<ByteArrayType>(|row| {
            let mission = row.stored.segment.mission;
            mission.map(|mission| text(&mission.to_string()))
        })?;
        self.integers(|segment| segment.grid_revision.into())?;
        self.integers(|segment| segment.cell.ix.into())?;
        self.integers(|segment| segment.cell.iy.into())?;
        self.numbers(|segment| segment.theta.information)?;
        self.numbers(|segment| segment.theta.weighted)?;
        self.some_numbers(|segment| {
            segment
                .theta_errors
                .map(|errors| errors.independent_information)
        })?;
        self.some_numbers(|segment| segment.theta_errors.map(|errors| errors.robot_ratio))?;
        self.some_numbers(|segment| segment.theta_errors.map(|errors| errors.tyre_ratio))?;
        self.pair(|segment| segment.effective_track_ratio)?;
        self.pair(|segment| segment.rolling_resistance)?;
        self.some_numbers(|segment| segment.mu_peak_lower_bound)?;
        self.integers(|segment| segment.samples.into())?;
        self.numbers(|segment| segment.distance_m)?;
        self.numbers(|segment| segment.saturation_ratio)
    }
}
