//! The files of a shared table. A stored file is handed out as it is if readers see all of its rows. Rows of a file that
//! they see in part, and a view's, are made on request: the answer of a query in the client's session, kept for a while.

use std::sync::Arc;
use std::time::{SystemTime, UNIX_EPOCH};

use axum::body::Body;
use axum::extract::{Path, State};
use axum::http::HeaderMap;
use axum::response::Response;
use bytes::Bytes;
use echolake_lake::DataFile;
use echolake_query::output::AnswerFormat;
use serde::Deserialize;
use serde_json::{Value, json};

use super::super::catalogue::SnapshotView;
use super::super::files::table_file_answer;
use super::super::format::FormatEncoder;
use super::super::manifest::origin;
use super::super::problem::ProblemResponse;
use super::super::ranges::{FileDescription, RangeAnswer};
use super::super::slices::SpooledSlice;
use super::SharingService;
use super::tables::SharedTable;
use crate::fault::RequestFault;
use crate::running::RunningQuery;
use crate::service::{QueryJob, QueryWork};
use crate::signed_address::{SigningKey, VALID};
use crate::tokens::TokenScope;

/// Beginning of the names of files that are made on request; those of stored files begin with a letter or a digit.
const MADE: &str = "~made";
/// The part of the name of one that has all rows.
const WHOLE: &str = "all";
const MEDIA_TYPE: &str = "application/vnd.apache.parquet";

/// The part of a table that is wanted.
pub(super) struct FileLimits {
    /// Rows that suffice.
    pub(super) rows: Option<u64>,
}

/// A file as it is listed.
struct ListedFile {
    name: String,
    bytes: u64,
    rows: Option<u64>,
}

/// A file that is made on request.
struct MadeFile {
    /// The version of the view that it is made of.
    version: String,
    /// Name of the stored file whose visible rows it has; None for all rows.
    of: Option<String>,
}

/// The path of a file; the door has read the rest of it.
#[derive(Deserialize)]
pub(super) struct FilePath {
    table: String,
    file: String,
}

impl SharingService {
    /// The lines of a table's files.
    ///
    /// # Errors
    /// Those of queries whose answers are shared.
    pub(super) async fn files(
        &self,
        view: &Arc<SnapshotView>,
        table: &SharedTable,
        limits: FileLimits,
        headers: &HeaderMap,
    ) -> Result<Vec<Value>, RequestFault> {
        let key = SigningKey::of_request(headers).ok_or(RequestFault::Internal)?;
        let end = SystemTime::now() + VALID;
        let millis = u64::try_from(end.duration_since(UNIX_EPOCH).unwrap_or_default().as_millis()).unwrap_or(u64::MAX);
        let (origin, client) = (origin(headers), self.catalogue.service().client(TokenScope::Sql)?);
        let listed = self.listed(view, table, limits).await?.into_iter().map(|file| {
            let address = key.sign(client.name(), &format!("{}/{}", table.name(), file.name), end);
            let stats = file.rows.map(|rows| json!({ "numRecords": rows }).to_string());
            json!({ "file": {
                "url": format!("{origin}{address}"),
                "id": file.name,
                "partitionValues": {},
                "size": file.bytes,
                "stats": stats,
                "expirationTimestamp": millis,
            } })
        });
        Ok(listed.collect())
    }

    async fn listed(
        &self,
        view: &Arc<SnapshotView>,
        table: &SharedTable,
        limits: FileLimits,
    ) -> Result<Vec<ListedFile>, RequestFault> {
        let Some(stored) = table.table else {
            let made = MadeFile { version: view.version.clone(), of: None };
            return Ok(vec![self.listed_made(view, table, made, None).await?]);
        };
        let mut listed = Vec::new();
        let mut rows = 0;
        for file in view.snapshot.files(stored) {
            if limits.rows.is_some_and(|wanted| rows >= wanted) {
                break;
            }
            rows += file.visible_rows();
            let name = file.path.filename().unwrap_or_default().to_owned();
            listed.push(match is_seen_whole(file) {
                true => ListedFile { name, bytes: file.bytes, rows: Some(file.rows) },
                false => {
                    let made = MadeFile { version: view.version.clone(), of: Some(name) };
                    self.listed_made(view, table, made, Some(file.visible_rows())).await?
                }
            });
        }
        Ok(listed)
    }

    async fn listed_made(
        &self,
        view: &Arc<SnapshotView>,
        table: &SharedTable,
        made: MadeFile,
        rows: Option<u64>,
    ) -> Result<ListedFile, RequestFault> {
        let bytes = self.make(view, table, &made).await?.bytes();
        Ok(ListedFile { name: made.name(bytes), bytes, rows })
    }

    // The file, from those that are kept, or of the lake as it is now.
    async fn make(
        &self,
        view: &Arc<SnapshotView>,
        table: &SharedTable,
        made: &MadeFile,
    ) -> Result<Arc<SpooledSlice>, RequestFault> {
        let key = format!("{} {} {}", table.name(), made.version, made.of.as_deref().unwrap_or(WHOLE));
        let answer = async {
            if made.version != view.version {
                return Err(gone());
            }
            self.begin(table.select(&condition(view, table, made)?)).await
        };
        self.slices.spool().once(&key, answer).await
    }

    async fn begin(&self, sql: String) -> Result<RunningQuery<Bytes>, RequestFault> {
        let service = self.catalogue.service();
        let client = service.client(TokenScope::Sql)?;
        let job = QueryJob::of_http(Arc::new(service.session(&client)), QueryWork::Sql(sql));
        service.begin(job, |schema| FormatEncoder::new(AnswerFormat::Parquet, schema)).await
    }
}

/// Returns whether readers see all rows of a stored file, so that it may be handed out as it is.
fn is_seen_whole(file: &DataFile) -> bool {
    file.hidden.is_empty()
}

// The rows of the runs that readers see in a stored file are nowhere else: a condition on the runs selects them.
fn condition(view: &SnapshotView, table: &SharedTable, made: &MadeFile) -> Result<String, RequestFault> {
    let (Some(stored), Some(name)) = (table.table, &made.of) else { return Ok(String::new()) };
    let file = view.snapshot.files(stored).iter().find(|file| file.path.filename() == Some(name)).ok_or_else(gone)?;
    // Names of runs have letters, digits, `_` and `-` alone.
    let runs: Vec<_> = file.visible_parts().map(|(part, _)| format!("'{}'", part.run)).collect();
    Ok(format!(" where run_id in ({})", runs.join(", ")))
}

fn gone() -> RequestFault {
    RequestFault::Gone { what: "this file", hint: "ask for the table again, which has changed meanwhile" }
}

impl MadeFile {
    fn name(&self, bytes: u64) -> String {
        let of = self.of.as_deref().map_or(WHOLE, |name| name.strip_suffix(".parquet").unwrap_or(name));
        format!("{MADE}.{}.{bytes}.{of}.parquet", self.version)
    }

    // A name's file and its bytes.
    fn parse(name: &str) -> Option<(Self, u64)> {
        let mut parts = name.strip_prefix(MADE)?.strip_prefix('.')?.splitn(3, '.');
        let (version, bytes, of) = (parts.next()?.to_owned(), parts.next()?.parse().ok()?, parts.next()?);
        let of = if of.strip_suffix(".parquet")? == WHOLE { None } else { Some(of.to_owned()) };
        Some((Self { version, of }, bytes))
    }
}

/// A file, for whoever has its address.
pub(super) async fn file(
    State(sharing): State<SharingService>,
    Path(path): Path<FilePath>,
    headers: HeaderMap,
) -> Result<Response, ProblemResponse> {
    sharing.authorise()?;
    let table = SharedTable::by_name(&sharing.catalogue, &path.table)?;
    let Some((made, bytes)) = MadeFile::parse(&path.file) else {
        let stored = table.table.ok_or_else(gone)?;
        return Ok(table_file_answer(&sharing.catalogue, stored, &path.file, &headers).await?);
    };
    let view = sharing.catalogue.view().await?;
    let kept = sharing.make(&view, &table, &made).await?;
    if kept.bytes() != bytes {
        return Err(gone().into());
    }
    let described =
        FileDescription { etag: format!("\"{}\"", path.file), media_type: MEDIA_TYPE, policy: "same-origin" };
    Ok(match described.asked(&headers, bytes) {
        RangeAnswer::Answer(answer) => answer,
        RangeAnswer::Part(part) => described.part(&part, Body::from_stream(kept.read(part.range.clone()))),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_of_made_files_come_back() {
        for of in [None, Some("merged.ab12.parquet".to_owned())] {
            let made = MadeFile { version: "0123abcd".to_owned(), of: of.clone() };
            let (again, bytes) = MadeFile::parse(&made.name(77)).expect("a made file");
            assert_eq!((again.version.as_str(), again.of, bytes), ("0123abcd", of, 77));
        }
        for stored in
            ["flat.r1.ab.parquet", "made.r1.12.ab.parquet", "~made.x", "~made.a.b.all.parquet", "~made.a.1.all"]
        {
            assert!(MadeFile::parse(stored).is_none(), "{stored}");
        }
    }
}
