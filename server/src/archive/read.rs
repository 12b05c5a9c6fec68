//! Reads the row groups of a file that may contain selected rows, after it has verified their checksums.

use std::ops::Range;
use std::path::PathBuf;
use std::sync::Arc;

use parquet::data_type::Int64Type;
use parquet::file::metadata::{KeyValue, ParquetMetaData, ParquetMetaDataReader, RowGroupMetaData};
use parquet::file::properties::ReaderProperties;
use parquet::file::serialized_reader::SerializedRowGroupReader;
use tread_api::ids::{RobotId, SiteId, TerrainId};

use super::fault::{Fault, fault, guarded};
use super::rows::{Columns, Names, Values};
use super::source::{Source, Window};
use super::{
    ArchivedSegment, Budget, KeyRange, SearchResult, SegmentArchiveError, Selection, checksum,
    schema,
};

/// A row group: its keys, its bytes in the file, and their checksum.
#[derive(Debug, Clone)]
struct Group {
    keys: KeyRange,
    bytes: Range<u64>,
    sum: u32,
}

/// Rows of a row group: the index of the group, and the keys of the rows.
#[derive(Debug, Clone, Copy)]
struct Part {
    group: usize,
    keys: KeyRange,
}

/// A file whose footer was checked.
pub(super) struct OpenFile {
    path: PathBuf,
    source: Source,
    metadata: ParquetMetaData,
    groups: Vec<Group>,
    /// Last key of the file before, 0 if there was none.
    follows: i64,
}

impl OpenFile {
    /// Reads the footer of a file that contains these keys. `path` is shown in errors.
    pub(super) fn open(
        path: PathBuf,
        source: Source,
        keys: KeyRange,
    ) -> Result<Self, SegmentArchiveError> {
        guarded(&path.clone(), || {
            let footer = checksum::read_footer(&source)?;
            let metadata = ParquetMetaDataReader::decode_metadata(&footer.bytes)?;
            let about = metadata.file_metadata();
            let key_values = about.key_value_metadata().map_or(&[][..], Vec::as_slice);
            if value_of(key_values, schema::FORMAT_KEY) != Some(schema::FORMAT) {
                return Err(fault("it is not of this format"));
            }
            if about.schema() != &schema::columns()? {
                return Err(fault("it has other columns"));
            }
            let follows = value_of(key_values, schema::FOLLOWS_KEY);
            let follows = follows.and_then(|follows| follows.parse().ok());
            let groups = value_of(key_values, schema::ROW_GROUPS_KEY).unwrap_or_default();
            let counts = metadata.row_groups().iter();
            let counts: Vec<i64> = counts.map(RowGroupMetaData::num_rows).collect();
            let groups = groups_of(groups, &counts, keys, footer.begin);
            Ok(Self {
                path,
                groups: groups.ok_or_else(|| fault("its row groups do not have its keys"))?,
                source,
                follows: follows.ok_or_else(|| fault("it does not name the file before"))?,
                metadata,
            })
        })
    }

    /// Checks that no key of this file precedes `preceding`, the last key of the preceding file. Returns
    /// the last key that is missing between both files; `None` if there is no gap.
    pub(super) fn missing_before(
        &self,
        preceding: Option<i64>,
    ) -> Result<Option<i64>, SegmentArchiveError> {
        match preceding {
            Some(last) if last > self.follows => Err(SegmentArchiveError::Damaged {
                path: self.path.clone(),
                what: format!("it does not follow the measurement {last}"),
            }),
            Some(last) => Ok((last < self.follows).then_some(self.follows)),
            None => Ok(None),
        }
    }

    /// Checks the checksums of all rows.
    pub(super) fn check_rows(&self) -> Result<(), SegmentArchiveError> {
        for group in &self.groups {
            guarded(&self.path, || {
                checksum::read_checked(&self.source, group.bytes.clone(), group.sum).map(drop)
            })?;
        }
        Ok(())
    }

    /// Adds the selected measurements to those found. Returns whether the search goes on after this
    /// file; it ends at `limit` measurements, and when no rows are left to be searched.
    pub(super) fn read(
        &self,
        selection: &Selection,
        limit: usize,
        budget: &mut Budget,
        found: &mut SearchResult,
    ) -> Result<bool, SegmentArchiveError> {
        for (index, group) in self.groups.iter().enumerate() {
            let first = group.keys.first.max(selection.after.saturating_add(1));
            let last = group.keys.last.min(selection.before.saturating_sub(1));
            if first > last {
                continue;
            }
            let is_needed = guarded(&self.path, || self.may_contain(index, selection))?;
            if is_needed {
                if found.segments.len() >= limit
                    || budget.rows == 0
                    || budget.is_over(selection, found)
                {
                    return Ok(false);
                }
                let keys = KeyRange { first, last };
                budget.rows = budget.rows.saturating_sub(place(keys.count()));
                let needed = limit - found.segments.len();
                let part = Part { group: index, keys };
                let read = || self.read_part(part, selection, needed);
                let segments = guarded(&self.path, read)?;
                let is_full = segments.len() >= needed;
                found.segments.extend(segments);
                if let (true, Some(segment)) = (is_full, found.segments.last()) {
                    found.searched_to = segment.stored.id;
                    return Ok(false);
                }
            }
            found.searched_to = last;
        }
        Ok(true)
    }

    fn row_group(&self, index: usize) -> Result<&RowGroupMetaData, Fault> {
        let group = self.metadata.row_groups().get(index);
        group.ok_or_else(|| fault("a row group is missing"))
    }

    /// Returns whether a row group may have selected rows, by the statistics of its columns.
    fn may_contain(&self, index: usize, selection: &Selection) -> Result<bool, Fault> {
        let group = self.row_group(index)?;
        let site = selection.site.as_ref().map(SiteId::as_str);
        let robot = selection.robot.as_ref().map(RobotId::as_str);
        let terrain = selection.terrain.as_ref().map(TerrainId::as_str);
        let one_of = |column, name: Option<&str>| {
            name.is_none_or(|name| is_within(group, column, [name].into_iter()))
        };
        let robots = selection.robots.as_ref();
        Ok(one_of(schema::SITE, site)
            && one_of(schema::ROBOT, robot)
            && one_of(schema::TERRAIN, terrain)
            && robots.is_none_or(|robots| {
                is_within(group, schema::ROBOT, robots.iter().map(RobotId::as_str))
            }))
    }

    /// Reads the selected rows of a part of a row group, at most `limit`.
    fn read_part(
        &self,
        part: Part,
        selection: &Selection,
        limit: usize,
    ) -> Result<Vec<ArchivedSegment>, Fault> {
        let Part { group: index, keys } = part;
        let about = self.groups.get(index);
        let about = about.ok_or_else(|| fault("a row group is missing"))?;
        let bytes = checksum::read_checked(&self.source, about.bytes.clone(), about.sum)?;
        let group = SerializedRowGroupReader::new(
            Arc::new(Window::new(about.bytes.start, bytes)),
            self.row_group(index)?,
            self.metadata.page_index_for_row_group(index),
            Arc::new(ReaderProperties::builder().build()),
        )?;
        let skipped = place(keys.first - about.keys.first);
        let rows = skipped..skipped + place(keys.count());
        let mut columns = Columns::new(&group, rows);
        let ids = columns.each::<Int64Type>()?;
        if !ids.iter().copied().eq(keys.first..=keys.last) {
            return Err(fault("its rows do not have its keys"));
        }
        let names = Names::read(&mut columns)?;
        let chosen: Vec<usize> = names.chosen(selection).into_iter().take(limit).collect();
        let Some((&first, &last)) = chosen.first().zip(chosen.last()) else {
            return Ok(Vec::new());
        };
        let values = Values::read(&mut columns, first..last + 1)?;
        let segment = |row: usize| names.segment(row, ids[row], &values);
        chosen.into_iter().map(segment).collect()
    }
}

fn value_of<'metadata>(metadata: &'metadata [KeyValue], key: &str) -> Option<&'metadata str> {
    let found = metadata.iter().find(|pair| pair.key == key);
    found.and_then(|pair| pair.value.as_deref())
}

/// Returns a number of rows; it is never negative.
fn place(count: i64) -> usize {
    usize::try_from(count).unwrap_or_default()
}

/// Returns the row groups of a file from their ends and checksums, and their numbers of rows; `None` if
/// they do not have the keys of the file.
fn groups_of(text: &str, counts: &[i64], keys: KeyRange, footer_at: u64) -> Option<Vec<Group>> {
    let mut groups = Vec::new();
    let (mut first, mut begin) = (keys.first, 0);
    let mut counts = counts.iter();
    for group in text.split(',') {
        let (end, sum) = group.split_once(' ')?;
        let (end, sum) = (end.parse().ok()?, u32::from_str_radix(sum, 16).ok()?);
        let next = first.checked_add(*counts.next().filter(|count| **count > 0)?)?;
        if !(begin < end && end <= footer_at) {
            return None;
        }
        groups.push(Group {
            keys: KeyRange {
                first,
                last: next - 1,
            },
            bytes: begin..end,
            sum,
        });
        (first, begin) = (next, end);
    }
    (counts.next().is_none() && first.checked_sub(1) == Some(keys.last)).then_some(groups)
}

/// Returns whether the statistics of a column of names allow one of some names.
fn is_within<'name>(
    group: &RowGroupMetaData,
    column: usize,
    mut names: impl Iterator<Item = &'name str>,
) -> bool {
    let Some(known) = group
        .columns()
        .get(column)
        .and_then(|column| column.statistics())
    else {
        return true;
    };
    match known.min_bytes_opt().zip(known.max_bytes_opt()) {
        Some((least, most)) => names.any(|name| (least..=most).contains(&name.as_bytes())),
        None => known.null_count_opt() != u64::try_from(group.num_rows()).ok(),
    }
}
