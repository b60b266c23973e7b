//! Other ways to write the same files: size, speed, and what a reader of one response fetches.

use std::time::Instant;

use anyhow::{Context as _, Result, ensure};
use bytes::Bytes;
use echolake_schema::tables::Table;
use parquet::basic::Compression;
use parquet::file::metadata::{PageIndexPolicy, ParquetMetaDataReader};
use parquet::file::properties::WriterPropertiesBuilder;

use super::super::report::BenchReport;
use super::IngestBenchArgs;
use super::parquet_files::{
    FileRows, LEVEL, NumberEncoding, StoredTableFile, builder_as, read_all, with_stored_pages, zstd_compression,
};

/// Page sizes that are compared.
const PAGES: [usize; 4] = [64 << 10, 128 << 10, 256 << 10, 1 << 20];

/// One way to write a file.
struct FileLayout {
    name: &'static str,
    numbers: NumberEncoding,
    compression: Compression,
}

pub(crate) fn measure_layouts(
    args: &IngestBenchArgs,
    files: &[StoredTableFile],
    report: &mut BenchReport,
) -> Result<()> {
    for table in [Table::Measurements, Table::Nce] {
        // Much of what is derived of the references is zero.
        let file = files.iter().rfind(|f| f.table == table && !f.of_reference).context("no file of a table")?;
        let rows = FileRows::read(file)?;
        report.group(format!("One file of `{}` in other layouts", table.name()));
        report.note(format!(
            "{:.1} MB of raw numbers; the best of {} repeats on one thread.",
            rows.raw as f64 / 1e6,
            args.repeats()
        ));
        compare_layouts(args, &file.bytes, &rows, report)?;
        compare_page_sizes(&file.bytes, &rows, report)?;
    }
    Ok(())
}

fn compare_layouts(args: &IngestBenchArgs, file: &Bytes, rows: &FileRows, report: &mut BenchReport) -> Result<()> {
    let layout = |name, numbers, compression| FileLayout { name, numbers, compression };
    let metadata = ParquetMetaDataReader::new().parse_and_finish(file)?;
    let candidates = [
        layout("as stored: byte stream split, zstd 1", NumberEncoding::AsStored, zstd_compression(LEVEL)),
        layout("byte stream split, zstd 3", NumberEncoding::AsStored, zstd_compression(3)),
        layout("byte stream split, snappy", NumberEncoding::AsStored, Compression::SNAPPY),
        layout("byte stream split, uncompressed", NumberEncoding::AsStored, Compression::UNCOMPRESSED),
        layout("plain, zstd 1", NumberEncoding::Plain, zstd_compression(LEVEL)),
        layout("dictionary, zstd 1", NumberEncoding::Dictionary, zstd_compression(LEVEL)),
    ];
    for FileLayout { name, numbers, compression } in candidates {
        let properties = with_stored_pages(builder_as(&metadata, numbers), &metadata);
        let properties = properties.set_compression(compression).build();
        let mut size = 0;
        let mut write = f64::INFINITY;
        let mut read = f64::INFINITY;
        for _ in 0..args.repeats() {
            let begun = Instant::now();
            let written = Bytes::from(rows.write(&properties)?);
            write = write.min(begun.elapsed().as_secs_f64());
            let begun = Instant::now();
            let back = read_all(&written)?;
            read = read.min(begun.elapsed().as_secs_f64());
            let expected: usize = rows.batches.iter().map(|b| b.num_rows()).sum();
            ensure!(back == expected, "{back} rows read back of {expected}");
            size = written.len();
        }
        let raw = rows.raw as f64;
        let ratio = 100.0 * size as f64 / raw;
        report.figure(format!("{name}: size of raw"), ratio, "%");
        report.figure(format!("{name}: write"), raw / 1e6 / write, "MB/s");
        report.figure(format!("{name}: read"), raw / 1e6 / read, "MB/s");
    }
    Ok(())
}

// What a reader that knows the file's indices fetches for one row of its first list column.
fn compare_page_sizes(file: &Bytes, rows: &FileRows, report: &mut BenchReport) -> Result<()> {
    let metadata = ParquetMetaDataReader::new().parse_and_finish(file)?;
    for bytes in PAGES {
        let limit = |builder: WriterPropertiesBuilder| builder.set_data_page_size_limit(bytes).build();
        let written = Bytes::from(rows.write(&limit(builder_as(&metadata, NumberEncoding::AsStored)))?);
        let (page, index) = point_lookup(&written)?;
        let ratio = 100.0 * written.len() as f64 / rows.raw as f64;
        let name = format!("pages of {} KiB", bytes >> 10);
        report.figure(format!("{name}: size of raw"), ratio, "%");
        report.figure(format!("{name}: fetched for one row"), page / 1024.0, "KiB");
        report.figure(format!("{name}: page index"), index / 1024.0, "KiB");
    }
    Ok(())
}

// Mean compressed size of a page of the first list column, and size of all page indices of the file.
fn point_lookup(file: &Bytes) -> Result<(f64, f64)> {
    let reader = ParquetMetaDataReader::new().with_page_index_policy(PageIndexPolicy::Required);
    let metadata = reader.parse_and_finish(file)?;
    let columns = metadata.file_metadata().schema_descr().columns();
    let list = columns.iter().position(|c| c.max_rep_level() > 0).context("no list column")?;
    let offsets = metadata.offset_index().context("no page index")?;
    let pages: Vec<_> = offsets
        .iter()
        .flat_map(|group| group[list].page_locations())
        .map(|p| f64::from(p.compressed_page_size))
        .collect();
    let indices = metadata
        .row_groups()
        .iter()
        .flat_map(|g| g.columns())
        .map(|c| f64::from(c.offset_index_length().unwrap_or(0)) + f64::from(c.column_index_length().unwrap_or(0)));
    Ok((pages.iter().sum::<f64>() / pages.len().max(1) as f64, indices.sum()))
}
