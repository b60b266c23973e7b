//! Rows of a file by their places, decoded of the pages that have them: to prepare a scan for a single row takes longer
//! than to decode it.

use std::ops::Range;
use std::sync::Arc;

use arrow::compute::concat_batches;
use arrow::record_batch::RecordBatch;
use bytes::buf::Reader;
use bytes::{Buf as _, Bytes};
use datafusion::error::Result;
use echolake_lake::add_missing_columns;
use parquet::arrow::arrow_reader::{
    ArrowReaderOptions, ParquetRecordBatchReader, RowGroups, RowSelection, RowSelector,
};
use parquet::arrow::async_reader::AsyncFileReader;
use parquet::arrow::{ProjectionMask, parquet_to_arrow_field_levels};
use parquet::column::page::{PageIterator, PageReader};
use parquet::errors::{ParquetError, Result as ParquetResult};
use parquet::file::metadata::{PageIndexPolicy, ParquetMetaData, RowGroupMetaData};
use parquet::file::page_index::offset_index::PageLocation;
use parquet::file::reader::{ChunkReader, Length};
use parquet::file::serialized_reader::SerializedPageReader;

use crate::column_store::WantedColumns;

/// Mean distance of rows, in rows, from which on the reader skips what is between them: it decodes all of dense rows,
/// and so needs all of their pages. It takes rows for dense below 32, counted from the group's first one.
const SPARSE_ROWS: usize = 128;

/// Reads columns of the rows at some places of a file, which are in order and differ. Of other rows, only those in the
/// same pages are fetched.
///
/// # Errors
/// If the file cannot be read, has no such rows, or has columns of other types.
pub(crate) async fn read_placed_rows(
    mut reader: Box<dyn AsyncFileReader>,
    wanted: &WantedColumns,
    places: &[usize],
) -> Result<RecordBatch> {
    let options = ArrowReaderOptions::new().with_page_index_policy(PageIndexPolicy::Optional);
    let metadata = reader.get_metadata(Some(&options)).await?;
    let described = metadata.file_metadata().schema_descr();
    let names = wanted.schema().fields().iter().map(|field| field.name().as_str());
    let mask = ProjectionMask::columns(described, names);
    let levels = parquet_to_arrow_field_levels(described, mask.clone(), None)?;
    let columns: Vec<_> = (0..described.num_columns()).filter(|column| mask.leaf_included(*column)).collect();
    let groups = group_places(&metadata, places)?;
    let parts: Vec<Vec<_>> = groups
        .iter()
        .map(|rows| columns.iter().map(|column| (*column, rows.byte_ranges(&metadata, *column))).collect())
        .collect();
    let ranges = parts.iter().flatten().flat_map(|(_, ranges)| ranges.iter().cloned()).collect();
    let mut fetched = reader.get_byte_ranges(ranges).await?.into_iter();
    let mut rows = Vec::with_capacity(groups.len());
    for (wanted_rows, parts) in groups.into_iter().zip(parts) {
        let take_bytes = |(column, ranges): (usize, Vec<Range<u64>>)| {
            let starts = ranges.into_iter().map(|range| range.start);
            (column, Arc::new(FetchedColumn { parts: starts.zip(&mut fetched).collect() }))
        };
        let columns = parts.into_iter().map(take_bytes).collect();
        let pages = FetchedPages { metadata: &metadata, group: wanted_rows.group, columns };
        let count = wanted_rows.places.len();
        let selection = Some(wanted_rows.into_selection());
        for batch in ParquetRecordBatchReader::try_new_with_row_groups(&levels, &pages, count, selection)? {
            rows.push(add_missing_columns(&batch?, wanted.schema())?);
        }
    }
    Ok(concat_batches(wanted.schema(), &rows)?)
}

/// Wanted rows of one group of rows.
struct GroupRows {
    group: usize,
    /// Counted from the group's first row.
    places: Vec<usize>,
}

impl GroupRows {
    // Where the pages of a column are that have the rows, and those between dense ones; all of the column if the file
    // has no index of its pages.
    fn byte_ranges(&self, metadata: &ParquetMetaData, column: usize) -> Vec<Range<u64>> {
        let (start, length) = metadata.row_group(self.group).column(column).byte_range();
        let end = start + length;
        let Some(pages) = page_locations(metadata, self.group, column) else {
            return std::iter::once(start..end).collect();
        };
        let page_of = |place: &usize| pages.partition_point(|page| page.first_row_index <= *place as i64).max(1) - 1;
        let mut wanted: Vec<_> = self.places.iter().map(page_of).collect();
        wanted.dedup();
        let is_sparse = self.places.last().is_some_and(|last| last / SPARSE_ROWS > self.places.len());
        if let (false, Some(first), Some(last)) = (is_sparse, wanted.first(), wanted.last()) {
            wanted = (*first..=*last).collect();
        }
        let offset_of = |page: usize| pages.get(page).map_or(end, |page| page.offset as u64);
        // The values of a dictionary are before the first page.
        let dictionary = std::iter::once(start..offset_of(0)).filter(|range| !range.is_empty());
        dictionary.chain(wanted.into_iter().map(|page| offset_of(page)..offset_of(page + 1))).collect()
    }

    fn into_selection(self) -> RowSelection {
        let mut end = 0;
        let selectors = self.places.into_iter().flat_map(|place| {
            let skipped = place - end;
            end = place + 1;
            [RowSelector::skip(skipped), RowSelector::select(1)]
        });
        RowSelection::from(selectors.filter(|selector| selector.row_count > 0).collect::<Vec<_>>())
    }
}

fn group_places(metadata: &ParquetMetaData, places: &[usize]) -> ParquetResult<Vec<GroupRows>> {
    let mut described = metadata.row_groups().iter().enumerate();
    let mut groups: Vec<GroupRows> = Vec::new();
    let mut known: Range<usize> = 0..0;
    for place in places {
        while *place >= known.end {
            let absent = || ParquetError::General(format!("it has no row {place}"));
            let (group, rows) = described.next().ok_or_else(absent)?;
            known = known.end..known.end + usize::try_from(rows.num_rows())?;
            if *place < known.end {
                groups.push(GroupRows { group, places: Vec::new() });
            }
        }
        if let Some(rows) = groups.last_mut() {
            rows.places.push(place - known.start);
        }
    }
    Ok(groups)
}

fn page_locations(metadata: &ParquetMetaData, group: usize, column: usize) -> Option<&Vec<PageLocation>> {
    let pages = metadata.offset_index()?.get(group)?.get(column)?.page_locations();
    Some(pages).filter(|pages| !pages.is_empty())
}

/// Pages of a group of rows.
struct FetchedPages<'a> {
    metadata: &'a ParquetMetaData,
    group: usize,
    /// By their columns.
    columns: Vec<(usize, Arc<FetchedColumn>)>,
}

impl RowGroups for FetchedPages<'_> {
    fn num_rows(&self) -> usize {
        usize::try_from(self.metadata.row_group(self.group).num_rows()).unwrap_or(0)
    }

    fn column_chunks(&self, column: usize) -> ParquetResult<Box<dyn PageIterator>> {
        let absent = || ParquetError::General(format!("column {column} was not fetched"));
        let (_, fetched) = self.columns.iter().find(|(known, _)| *known == column).ok_or_else(absent)?;
        let described = self.metadata.row_group(self.group).column(column);
        let pages = page_locations(self.metadata, self.group, column).cloned();
        let reader = SerializedPageReader::new(fetched.clone(), described, self.num_rows(), pages)?;
        Ok(Box::new(OneReader(Some(Box::new(reader)))))
    }

    fn row_groups(&self) -> Box<dyn Iterator<Item = &RowGroupMetaData> + '_> {
        Box::new(std::iter::once(self.metadata.row_group(self.group)))
    }

    fn metadata(&self) -> &ParquetMetaData {
        self.metadata
    }
}

/// The reader of the only column of that number.
struct OneReader(Option<Box<dyn PageReader>>);

impl Iterator for OneReader {
    type Item = ParquetResult<Box<dyn PageReader>>;

    fn next(&mut self) -> Option<Self::Item> {
        self.0.take().map(Ok)
    }
}

impl PageIterator for OneReader {}

/// Parts of a column, each with its place in the file.
struct FetchedColumn {
    parts: Vec<(u64, Bytes)>,
}

impl FetchedColumn {
    fn bytes_from(&self, start: u64) -> ParquetResult<Bytes> {
        let has_start = |(offset, bytes): &&(u64, Bytes)| (*offset..offset + bytes.len() as u64).contains(&start);
        let absent = || ParquetError::General(format!("byte {start} was not fetched"));
        let (offset, bytes) = self.parts.iter().find(has_start).ok_or_else(absent)?;
        Ok(bytes.slice((start - offset) as usize..))
    }
}

impl Length for FetchedColumn {
    fn len(&self) -> u64 {
        self.parts.iter().map(|(_, bytes)| bytes.len() as u64).sum()
    }
}

impl ChunkReader for FetchedColumn {
    type T = Reader<Bytes>;

    fn get_read(&self, start: u64) -> ParquetResult<Self::T> {
        Ok(self.bytes_from(start)?.reader())
    }

    fn get_bytes(&self, start: u64, length: usize) -> ParquetResult<Bytes> {
        let bytes = self.bytes_from(start)?;
        let short = || ParquetError::EOF(format!("{length} bytes from {start} were not fetched"));
        (length <= bytes.len()).then(|| bytes.slice(..length)).ok_or_else(short)
    }
}

#[cfg(test)]
mod tests;
