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

/// Rows between two wanted ones that are decoded rather than skipped by a reader of its own for each.
const NEAR_ROWS: usize = 32;

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
    let clusters = cluster_places(&metadata, places)?;
    let parts: Vec<Vec<_>> = clusters
        .iter()
        .map(|cluster| columns.iter().map(|column| (*column, cluster.byte_ranges(&metadata, *column))).collect())
        .collect();
    let ranges = parts.iter().flatten().flat_map(|(_, ranges)| ranges.iter().cloned()).collect();
    let mut fetched = reader.get_byte_ranges(ranges).await?.into_iter();
    let mut rows = Vec::with_capacity(clusters.len());
    for (cluster, parts) in clusters.into_iter().zip(parts) {
        let take_bytes = |(column, ranges): (usize, Vec<Range<u64>>)| {
            let starts = ranges.into_iter().map(|range| range.start);
            (column, Arc::new(FetchedColumn { parts: starts.zip(&mut fetched).collect() }))
        };
        let columns = parts.into_iter().map(take_bytes).collect();
        let pages = FetchedPages { metadata: &metadata, group: cluster.group, columns };
        let count = cluster.places.len();
        let selection = Some(cluster.into_selection());
        for batch in ParquetRecordBatchReader::try_new_with_row_groups(&levels, &pages, count, selection)? {
            rows.push(add_missing_columns(&batch?, wanted.schema())?);
        }
    }
    Ok(concat_batches(wanted.schema(), &rows)?)
}

/// Wanted rows of one group of rows that are near to each other.
struct RowCluster {
    group: usize,
    /// Counted from the group's first row.
    places: Vec<usize>,
}

impl RowCluster {
    // Where the pages of a column are that have the cluster's rows, and those between; all of the column if the file has
    // no index of its pages.
    fn byte_ranges(&self, metadata: &ParquetMetaData, column: usize) -> Vec<Range<u64>> {
        let (start, length) = metadata.row_group(self.group).column(column).byte_range();
        let whole = start..start + length;
        let (Some(pages), Some(first), Some(last)) =
            (page_locations(metadata, self.group, column), self.places.first(), self.places.last())
        else {
            return std::iter::once(whole).collect();
        };
        let page_of = |place: usize| {
            let before = pages.partition_point(|page| page.first_row_index <= place as i64);
            before.saturating_sub(1)
        };
        let offset_of = |page: usize| pages.get(page).map_or(whole.end, |page| page.offset as u64);
        let wanted = offset_of(page_of(*first))..offset_of(page_of(*last) + 1);
        // The values of a dictionary are before the first page.
        let dictionary = start..offset_of(0);
        [dictionary, wanted].into_iter().filter(|range| !range.is_empty()).collect()
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

fn cluster_places(metadata: &ParquetMetaData, places: &[usize]) -> ParquetResult<Vec<RowCluster>> {
    let mut groups = metadata.row_groups().iter().enumerate();
    let mut clusters: Vec<RowCluster> = Vec::new();
    let mut known: Range<usize> = 0..0;
    let mut group = 0;
    for place in places {
        while *place >= known.end {
            let absent = || ParquetError::General(format!("it has no row {place}"));
            let (number, described) = groups.next().ok_or_else(absent)?;
            group = number;
            known = known.end..known.end + usize::try_from(described.num_rows())?;
        }
        let place = place - known.start;
        match clusters.last_mut().filter(|cluster| cluster.group == group) {
            Some(cluster) if cluster.places.last().is_some_and(|last| place <= last + NEAR_ROWS) => {
                cluster.places.push(place);
            }
            _ => clusters.push(RowCluster { group, places: vec![place] }),
        }
    }
    Ok(clusters)
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
