//! Parquet files of a training set: one row group per surface, reproducible byte for byte.

use arrow::datatypes::{DataType, SchemaRef};
use arrow::record_batch::RecordBatch;
use echolake_lake::{Lake, LakeSnapshot};
use echolake_schema::tables::LIST_CHILD;
use parquet::arrow::ArrowWriter;
use parquet::basic::{Compression, Encoding, ZstdLevel};
use parquet::file::properties::{EnabledStatistics, WriterProperties};
use parquet::schema::types::ColumnPath;

use super::measurements::RowBuilder;
use super::statistics::ColumnStatistics;
use super::{ExportJob, Plan, Shard, SplitPart, heights};
use crate::error::{Error, Result};
use crate::output::{HashedFile, PendingFolder, WrittenFile};

/// zstd's level: a training set is written once and read often.
const ZSTD_LEVEL: i32 = 3;
/// Size of a data page.
const PAGE_BYTES: usize = 256 * 1024;

/// A file that is being written.
struct ShardWriter<'a> {
    writer: ArrowWriter<HashedFile>,
    folder: &'a PendingFolder,
    name: &'a str,
}

impl<'a> ShardWriter<'a> {
    fn create(folder: &'a PendingFolder, name: &'a str, schema: &SchemaRef) -> Result<Self> {
        let file = folder.create_file(name)?;
        let writer = ArrowWriter::try_new(file, schema.clone(), Some(writer_properties(schema)));
        Ok(Self { writer: writer.map_err(|e| Error::write(&folder.final_path(name), e))?, folder, name })
    }

    fn write(&mut self, batch: &RecordBatch) -> Result<()> {
        self.writer.write(batch).map_err(|e| Error::write(&self.folder.final_path(self.name), e))
    }

    fn end_row_group(&mut self) -> Result<()> {
        self.writer.flush().map_err(|e| Error::write(&self.folder.final_path(self.name), e))
    }

    fn finish(self) -> Result<WrittenFile> {
        let file = self.writer.into_inner().map_err(|e| Error::write(&self.folder.final_path(self.name), e))?;
        file.finish()
    }
}

/// A file of measurements, the rows of each of its surfaces, and the statistics of all.
pub(super) struct WrittenShard {
    pub file: WrittenFile,
    pub surface_rows: Vec<u64>,
    pub statistics: ColumnStatistics,
    /// Measurements that are left out because they are rejected.
    pub rejected: u64,
}

/// Writes a file of measurements.
pub(super) async fn write_shard(job: &ExportJob, shard: &Shard) -> Result<WrittenShard> {
    let ExportJob { lake, snapshot, plan, folder } = job;
    let mut writer = ShardWriter::create(folder, &shard.name, plan.schema())?;
    let maker = RowBuilder { lake, snapshot, columns: &plan.columns, moves: &plan.moves, rejected: &plan.rejected };
    let mut surface_rows = Vec::with_capacity(shard.surfaces.len());
    let mut statistics = ColumnStatistics::default();
    let mut rejected = 0;
    for surface in &shard.surfaces {
        let mut rows = 0;
        for run in &surface.runs {
            let of_run = maker.read_rows(run).await?;
            rejected += of_run.rejected;
            for batch in maker.row_batches(surface, run, shard.part, &of_run)? {
                rows += batch.num_rows() as u64;
                statistics.add_batch(&batch);
                writer.write(&batch)?;
            }
        }
        writer.end_row_group()?;
        surface_rows.push(rows);
    }
    Ok(WrittenShard { file: writer.finish()?, surface_rows, statistics, rejected })
}

/// Writes the height maps of a part; returns the file, if there are any, and the number of surfaces that have them.
/// Adds the maps to `statistics`.
pub(super) async fn write_height_maps(
    lake: &Lake,
    snapshot: &LakeSnapshot,
    plan: &Plan,
    part: SplitPart,
    folder: &PendingFolder,
    statistics: &mut ColumnStatistics,
) -> Result<(Option<WrittenFile>, usize)> {
    let name = format!("heightmaps/{}.parquet", part.name());
    let symmetries = plan.moves.symmetry_names();
    let mut writer = None;
    let mut count = 0;
    for surface in plan.of_part(part) {
        let Some(batch) = heights::read_height_maps(lake, snapshot, surface, part, &symmetries).await? else {
            continue;
        };
        statistics.add_batch(&batch);
        if writer.is_none() {
            writer = Some(ShardWriter::create(folder, &name, &heights::height_map_schema()?)?);
        }
        if let Some(writer) = &mut writer {
            writer.write(&batch)?;
            writer.end_row_group()?;
        }
        count += 1;
    }
    Ok((writer.map(ShardWriter::finish).transpose()?, count))
}

// Samples do not repeat, so a dictionary only costs; byte stream split compresses them best.
fn writer_properties(schema: &SchemaRef) -> WriterProperties {
    let mut builder = WriterProperties::builder()
        .set_compression(Compression::ZSTD(ZstdLevel::try_new(ZSTD_LEVEL).unwrap_or_default()))
        .set_created_by(concat!("echolake ", env!("CARGO_PKG_VERSION")).to_owned())
        .set_data_page_size_limit(PAGE_BYTES)
        .set_max_row_group_row_count(None)
        .set_statistics_enabled(EnabledStatistics::Page);
    for field in schema.fields() {
        let name = field.name().clone();
        let column = match field.data_type() {
            DataType::FixedSizeList(..) => ColumnPath::new(vec![name, "list".into(), LIST_CHILD.into()]),
            DataType::Float32 => ColumnPath::new(vec![name]),
            _ => continue,
        };
        builder = builder
            .set_column_dictionary_enabled(column.clone(), false)
            .set_column_encoding(column.clone(), Encoding::BYTE_STREAM_SPLIT);
        if matches!(field.data_type(), DataType::FixedSizeList(..)) {
            builder = builder.set_column_statistics_enabled(column, EnabledStatistics::None);
        }
    }
    builder.build()
}
