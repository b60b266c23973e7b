//! Scans of run files as they are sent to workers: with all that summaries told, so that a worker reads nothing but
//! messages. What comes is checked before it is used, because whoever knows the workers' token may send anything.

use std::collections::BTreeMap;
use std::ops::{Range, RangeInclusive};
use std::sync::Arc;

use arrow::datatypes::SchemaRef;
use arrow::ipc::reader::StreamReader;
use arrow::ipc::writer::StreamWriter;
use datafusion::error::{DataFusionError, Result};
use datafusion::execution::TaskContext;
use datafusion::physical_plan::ExecutionPlan;
use datafusion_proto::physical_plan::{PhysicalExtensionCodec, PhysicalProtoConverterExtension};
use echolake_recording::DefinitionDigests;
use object_store::path::Path;
use prost::Message;

use super::chunk::PieceKind;
use super::file::{Files, Piece};
use super::rows::{Head, Mapping};
use super::scan::{FileRead, McapExec, Scan};
use super::schema::{Layout, RawSchema};
use super::table::{LARGEST_SCHEMA, Parts, Source};
use super::target::EXTENSION;

/// Encodes scans of run files; decodes them where their files can be read.
#[derive(Debug)]
pub(crate) struct McapCodec {
    /// None in an engine, which sends scans and receives none.
    files: Option<Arc<Files>>,
}

impl McapCodec {
    /// A codec that encodes.
    pub(crate) fn encoder() -> Self {
        Self { files: None }
    }

    /// A codec whose scans read `files`.
    pub(crate) fn new(files: Arc<Files>) -> Self {
        Self { files: Some(files) }
    }
}

impl PhysicalExtensionCodec for McapCodec {
    fn try_decode(
        &self,
        bytes: &[u8],
        _: &[Arc<dyn ExecutionPlan>],
        _: &TaskContext,
        _: &dyn PhysicalProtoConverterExtension,
    ) -> Result<Arc<dyn ExecutionPlan>> {
        let files = self.files.as_ref().ok_or_else(|| DataFusionError::Plan("scans are not read here".to_owned()))?;
        let message = ScanMessage::decode(bytes).map_err(|e| wrong(&e.to_string()))?;
        Ok(Arc::new(message.into_plan(files)?))
    }

    fn try_encode(
        &self,
        node: Arc<dyn ExecutionPlan>,
        buffer: &mut Vec<u8>,
        _: &dyn PhysicalProtoConverterExtension,
    ) -> Result<()> {
        let Some(scan) = node.downcast_ref::<McapExec>() else {
            return Err(DataFusionError::NotImplemented(format!("`{}` is not sent to workers", node.name())));
        };
        ScanMessage::from_plan(scan)?.encode(buffer).map_err(|e| wrong(&e.to_string()))
    }
}

fn wrong(what: &str) -> DataFusionError {
    DataFusionError::Plan(format!("the scan of a run file is not as it is sent: {what}"))
}

/// A scan with its partitions.
#[derive(Clone, PartialEq, Message)]
struct ScanMessage {
    #[prost(string, tag = "1")]
    name: String,
    /// Messages as they are, without columns of their own.
    #[prost(bool, tag = "2")]
    is_raw: bool,
    #[prost(message, repeated, tag = "3")]
    sources: Vec<SourceMessage>,
    #[prost(message, repeated, tag = "4")]
    mappings: Vec<MappingMessage>,
    /// The columns that are asked for, as Arrow's stream format has them.
    #[prost(bytes = "vec", tag = "5")]
    schema: Vec<u8>,
    #[prost(uint64, repeated, tag = "6")]
    projection: Vec<u64>,
    #[prost(message, optional, tag = "7")]
    times: Option<TimesMessage>,
    #[prost(uint64, optional, tag = "8")]
    limit: Option<u64>,
    #[prost(message, repeated, tag = "9")]
    partitions: Vec<PartitionMessage>,
}

#[derive(Clone, PartialEq, Message)]
struct SourceMessage {
    #[prost(string, tag = "1")]
    path: String,
    /// Surface and run; empty for a file that is no run.
    #[prost(string, repeated, tag = "2")]
    run: Vec<String>,
    #[prost(uint32, repeated, tag = "3")]
    described: Vec<u32>,
    #[prost(message, repeated, tag = "4")]
    channels: Vec<ChannelMessage>,
    #[prost(message, repeated, tag = "5")]
    digests: Vec<DigestMessage>,
}

#[derive(Clone, PartialEq, Message)]
struct DigestMessage {
    /// The opcode of a schema or channel.
    #[prost(uint32, tag = "1")]
    code: u32,
    #[prost(uint32, tag = "2")]
    id: u32,
    #[prost(uint32, tag = "3")]
    digest: u32,
}

#[derive(Clone, PartialEq, Message)]
struct ChannelMessage {
    #[prost(uint32, tag = "1")]
    id: u32,
    #[prost(string, tag = "2")]
    topic: String,
    #[prost(uint64, tag = "3")]
    mapping: u64,
}

#[derive(Clone, PartialEq, Message)]
struct MappingMessage {
    #[prost(string, tag = "1")]
    name: String,
    #[prost(string, tag = "2")]
    encoding: String,
    #[prost(string, tag = "3")]
    messages: String,
    #[prost(bytes = "vec", tag = "4")]
    data: Vec<u8>,
    /// Places in the layout, plus one; 0 for a column that it lacks.
    #[prost(uint64, repeated, tag = "5")]
    columns: Vec<u64>,
}

#[derive(Clone, PartialEq, Message)]
struct TimesMessage {
    #[prost(sint64, tag = "1")]
    first: i64,
    #[prost(sint64, tag = "2")]
    last: i64,
}

#[derive(Clone, PartialEq, Message)]
struct PartitionMessage {
    #[prost(message, repeated, tag = "1")]
    reads: Vec<ReadMessage>,
}

#[derive(Clone, PartialEq, Message)]
struct ReadMessage {
    #[prost(uint64, tag = "1")]
    source: u64,
    #[prost(message, repeated, tag = "2")]
    pieces: Vec<PieceMessage>,
}

#[derive(Clone, PartialEq, Message)]
struct PieceMessage {
    #[prost(uint64, tag = "1")]
    start: u64,
    #[prost(uint64, tag = "2")]
    end: u64,
    #[prost(bool, tag = "3")]
    is_loose: bool,
}

impl ScanMessage {
    fn from_plan(plan: &McapExec) -> Result<Self> {
        let scan = plan.scan();
        let parts = &scan.parts;
        let mappings = parts.mappings.as_deref().unwrap_or_default();
        let partition =
            |reads: &Vec<FileRead>| PartitionMessage { reads: reads.iter().map(ReadMessage::from_read).collect() };
        Ok(Self {
            name: parts.name.clone(),
            is_raw: parts.mappings.is_none(),
            sources: parts.sources.iter().map(SourceMessage::from_source).collect(),
            mappings: mappings.iter().map(MappingMessage::from_mapping).collect(),
            schema: schema_bytes(&scan.schema)?,
            projection: scan.projection.iter().map(|place| *place as u64).collect(),
            times: scan.times.as_ref().map(|times| TimesMessage { first: *times.start(), last: *times.end() }),
            limit: scan.limit.map(|limit| limit as u64),
            partitions: plan.partitions().iter().map(partition).collect(),
        })
    }

    fn into_plan(self, files: &Arc<Files>) -> Result<McapExec> {
        let mappings = self.mappings.into_iter().map(MappingMessage::into_mapping).collect::<Result<Vec<_>>>()?;
        let own = mappings.iter().map(|mapping| mapping.columns.len()).max().unwrap_or(0);
        if mappings.iter().any(|mapping| mapping.columns.len() != own) || self.is_raw != mappings.is_empty() {
            return Err(wrong("its mappings have other columns"));
        }
        let heads = if self.is_raw { Head::OF_MESSAGES.to_vec() } else { Head::OF_COLUMNS.to_vec() };
        let schema = schema_of(&self.schema)?;
        let projection: Vec<_> = self.projection.iter().map(|place| *place as usize).collect();
        if projection.len() != schema.fields().len() || projection.iter().any(|place| *place >= heads.len() + own) {
            return Err(wrong("its columns are not there"));
        }
        let source = |message: SourceMessage| message.into_source(if self.is_raw { 1 } else { mappings.len() });
        let sources = self.sources.into_iter().map(source).collect::<Result<Vec<_>>>()?;
        let read = |message: ReadMessage| message.into_read(sources.len());
        let partition = |message: PartitionMessage| message.reads.into_iter().map(read).collect::<Result<Vec<_>>>();
        let partitions = self.partitions.into_iter().map(partition).collect::<Result<Vec<_>>>()?;
        let mappings = (!self.is_raw).then_some(mappings);
        let parts = Parts { name: self.name, files: files.clone(), heads, sources, mappings };
        let times = self.times.map(|times| RangeInclusive::new(times.first, times.last));
        let limit = self.limit.map(|limit| limit as usize);
        let scan = Scan { parts: Arc::new(parts), projection, schema, times, limit };
        Ok(McapExec::of_partitions(Arc::new(scan), partitions, 0))
    }
}

impl SourceMessage {
    fn from_source(source: &Source) -> Self {
        let channel = |(id, (topic, mapping)): (&u16, &(String, usize))| ChannelMessage {
            id: u32::from(*id),
            topic: topic.clone(),
            mapping: *mapping as u64,
        };
        let digest = |((code, id), digest): (&(u8, u16), &u32)| DigestMessage {
            code: u32::from(*code),
            id: u32::from(*id),
            digest: *digest,
        };
        Self {
            path: source.path.to_string(),
            run: source.run.iter().flat_map(|(surface, run)| [surface.clone(), run.clone()]).collect(),
            described: source.described.iter().map(|id| u32::from(*id)).collect(),
            channels: source.channels.iter().map(channel).collect(),
            digests: source.digests.by_id.iter().map(digest).collect(),
        }
    }

    // With channels of so many mappings.
    fn into_source(self, mappings: usize) -> Result<Source> {
        let path = Path::parse(&self.path).map_err(|e| wrong(&e.to_string()))?;
        if !path.as_ref().ends_with(EXTENSION) {
            return Err(wrong("it reads what is no run file"));
        }
        let run = match <[String; 2]>::try_from(self.run) {
            Ok([surface, run]) => Some((surface, run)),
            Err(none) if none.is_empty() => None,
            Err(_) => return Err(wrong("a run has a surface and a name")),
        };
        let number = |id: u32| u16::try_from(id).map_err(|_| wrong("numbers of channels have 16 bits"));
        let described = self.described.into_iter().map(number).collect::<Result<_>>()?;
        let mut channels = BTreeMap::new();
        for channel in self.channels {
            if channel.mapping as usize >= mappings {
                return Err(wrong("a channel has no mapping"));
            }
            channels.insert(number(channel.id)?, (channel.topic, channel.mapping as usize));
        }
        let mut digests = DefinitionDigests::default();
        for DigestMessage { code, id, digest } in self.digests {
            let code = u8::try_from(code).map_err(|_| wrong("opcodes have 8 bits"))?;
            digests.by_id.insert((code, number(id)?), digest);
        }
        Ok(Source { run, path, described, digests, channels })
    }
}

impl MappingMessage {
    fn from_mapping(mapping: &Mapping) -> Self {
        let RawSchema { name, encoding, messages, data } = mapping.schema.as_ref().clone();
        let columns = mapping.columns.iter().map(|place| place.map_or(0, |place| place as u64 + 1)).collect();
        Self { name, encoding, messages, data, columns }
    }

    fn into_mapping(self) -> Result<Mapping> {
        let Self { name, encoding, messages, data, columns } = self;
        let schema = RawSchema { name, encoding, messages, data };
        if schema.data.len() > LARGEST_SCHEMA {
            return Err(wrong("a schema is too large"));
        }
        let layout = match Layout::is_known(&schema) {
            true => Layout::new(&schema).map_err(|what| wrong(&what))?,
            false => Layout::without_columns(),
        };
        let columns: Vec<_> = columns.into_iter().map(|place| (place as usize).checked_sub(1)).collect();
        if columns.iter().flatten().any(|place| *place >= layout.fields.len()) {
            return Err(wrong("a schema lacks a column"));
        }
        Ok(Mapping { schema: Arc::new(schema), layout: Arc::new(layout), columns })
    }
}

impl ReadMessage {
    fn from_read(read: &FileRead) -> Self {
        let piece = |piece: &Piece| PieceMessage {
            start: piece.range.start,
            end: piece.range.end,
            is_loose: piece.kind == PieceKind::Loose,
        };
        Self { source: read.source as u64, pieces: read.pieces.iter().map(piece).collect() }
    }

    // Of one of so many sources.
    fn into_read(self, sources: usize) -> Result<FileRead> {
        let pieces: Vec<_> = self.pieces.into_iter().map(PieceMessage::into_piece).collect();
        let is_ordered = pieces.windows(2).all(|pair| pair[0].range.end <= pair[1].range.start);
        let range = match (pieces.first(), pieces.last()) {
            (Some(first), Some(last)) => Range { start: first.range.start, end: last.range.end },
            _ => return Err(wrong("it reads no piece")),
        };
        if self.source as usize >= sources || !is_ordered || pieces.iter().any(|piece| piece.range.is_empty()) {
            return Err(wrong("its pieces are not in the order of a file"));
        }
        Ok(FileRead { source: self.source as usize, range, pieces })
    }
}

impl PieceMessage {
    fn into_piece(self) -> Piece {
        let kind = if self.is_loose { PieceKind::Loose } else { PieceKind::Chunk };
        let range = self.start..self.end;
        Piece { kind, range, times: (0, u64::MAX), channels: None, index: 0, plain: 0 }
    }
}

fn schema_bytes(schema: &SchemaRef) -> Result<Vec<u8>> {
    let mut writer = StreamWriter::try_new(Vec::new(), schema)?;
    writer.finish()?;
    Ok(writer.into_inner()?)
}

fn schema_of(bytes: &[u8]) -> Result<SchemaRef> {
    Ok(StreamReader::try_new(bytes, None)?.schema())
}
