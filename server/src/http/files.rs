//! Files of the lake, as they are: whole or in ranges, for viewers that read them from elsewhere.
//!
//! Which file it is comes from the snapshot; a request's text is only ever compared with the names in it.

use std::ops::Range;
use std::sync::Arc;

use axum::Router;
use axum::body::Body;
use axum::extract::rejection::PathRejection;
use axum::extract::{Path, State};
use axum::http::{HeaderMap, HeaderName, HeaderValue, Method, StatusCode, header};
use axum::response::{IntoResponse as _, Response};
use axum::routing::get;
use echolake_lake::Lake;
use futures::TryStreamExt as _;
use object_store::path::Path as StorePath;
use object_store::{GetOptions, GetRange, ObjectStore as _, ObjectStoreExt as _};
use serde::Deserialize;
use tower_http::cors::{Any, CorsLayer};

use super::catalogue::{self, Asked, Catalogue, View, text};
use super::guard;
use super::problem::Problem;
use crate::fault::Fault;
use crate::tokens::Scope;

/// A run's file.
pub(super) const RUN: &str = "/api/v1/runs/{run_id}/file.mcap";
/// A table's file.
pub(super) const TABLE: &str = "/api/v1/tables/{table}/{file}";

/// Viewers on other pages read run files, so whoever may ask for them may do so from anywhere: without credentials, and
/// told what ranges need. A page of elsewhere finds out no run's name here.
pub(super) fn for_viewers(catalogue: &Catalogue) -> Router {
    let cors = CorsLayer::new()
        .allow_origin(Any)
        .allow_methods([Method::GET, Method::HEAD])
        .allow_headers([header::RANGE, header::IF_RANGE, header::IF_NONE_MATCH, header::AUTHORIZATION])
        .expose_headers([header::ACCEPT_RANGES, header::CONTENT_LENGTH, header::CONTENT_RANGE, header::ETAG])
        .allow_private_network(true);
    // Here and not for all routes: a preflight must come to the layer.
    Router::new()
        .route(RUN, get(run))
        .method_not_allowed_fallback(super::wrong_method)
        .layer(cors)
        .with_state(catalogue.clone())
}

/// The files that only the server's own pages and programs read.
pub(super) fn for_own(catalogue: &Catalogue) -> Router {
    Router::new().route(TABLE, get(table)).with_state(catalogue.clone())
}

async fn run(
    State(catalogue): State<Catalogue>,
    path: Result<Path<String>, PathRejection>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    guard::client(catalogue.service(), &headers, Scope::Files)?;
    let Path(name) = path.map_err(|_| Fault::request("the path is not UTF-8"))?;
    let view = catalogue.view().await?;
    let run = catalogue::run(&view, &name)?;
    let etag = digest(&catalogue, &view, run.run.as_str()).await?;
    let stored = Stored {
        path: Lake::run_path(&run.surface, &run.run),
        etag: format!("\"{etag}\""),
        media_type: "application/octet-stream",
        // A page elsewhere may embed what it may read.
        policy: "cross-origin",
    };
    Ok(stored.answer(catalogue.lake(), &headers).await?)
}

async fn table(
    State(catalogue): State<Catalogue>,
    path: Result<Path<(String, String)>, PathRejection>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    guard::client(catalogue.service(), &headers, Scope::Files)?;
    let Path((table, name)) = path.map_err(|_| Fault::request("the path is not UTF-8"))?;
    let view = catalogue.view().await?;
    let files = view.snapshot.files(catalogue::table(&table)?);
    let found = files.iter().find(|file| file.path.filename() == Some(&name));
    let hint = "GET /api/v1/tables/{table} lists what there is";
    let file = found.ok_or(Fault::NotFound { what: format!("file `{name}` of table `{table}`"), hint })?;
    let stored = Stored {
        path: file.path.clone(),
        // Its name is a digest of what it was made of.
        etag: format!("\"{name}-{}\"", file.bytes),
        media_type: "application/vnd.apache.parquet",
        policy: "same-origin",
    };
    Ok(stored.answer(catalogue.lake(), &headers).await?)
}

#[derive(Deserialize)]
struct Digest {
    file_sha256: String,
}

// The digest that a run's row has of its file.
async fn digest(catalogue: &Catalogue, view: &Arc<View>, run: &str) -> Result<String, Fault> {
    let sql = "select file_sha256 from runs where run_id = $1";
    let rows: Vec<Digest> = Asked::of(catalogue, view).rows(sql, vec![text(run)]).await?;
    let hint = "GET /api/v1/runs lists what there is";
    rows.into_iter().next().map(|row| row.file_sha256).ok_or(Fault::NotFound { what: format!("run `{run}`"), hint })
}

/// A file of the lake's store that never changes.
struct Stored {
    path: StorePath,
    etag: String,
    media_type: &'static str,
    policy: &'static str,
}

impl Stored {
    async fn answer(&self, lake: &Lake, headers: &HeaderMap) -> Result<Response, Fault> {
        let store = lake.store();
        let unread = |e: object_store::Error| match e {
            object_store::Error::NotFound { .. } => {
                Fault::NotFound { what: "this file".into(), hint: "it was removed meanwhile; ask again" }
            }
            other => {
                eprintln!("a file cannot be read: {other}");
                Fault::Unreadable
            }
        };
        let bytes = store.head(&self.path).await.map_err(unread)?.size;
        if catalogue::is_known(headers, &self.etag) {
            return Ok(self.with_headers(StatusCode::NOT_MODIFIED.into_response()));
        }
        let range = match self.wanted(headers, bytes) {
            Wanted::Whole => None,
            Wanted::Part(range) => Some(range),
            Wanted::Nothing => return Ok(self.nothing(bytes)),
        };
        let (status, part) = match &range {
            Some(range) => (StatusCode::PARTIAL_CONTENT, range.clone()),
            None => (StatusCode::OK, 0..bytes),
        };
        let body = match part.is_empty() {
            true => Body::empty(),
            false => {
                let options = GetOptions { range: Some(GetRange::Bounded(part.clone())), ..GetOptions::default() };
                let found = store.get_opts(&self.path, options).await.map_err(unread)?;
                Body::from_stream(found.into_stream().inspect_err(|e| eprintln!("a file broke off: {e}")))
            }
        };
        let mut response = self.with_headers((status, body).into_response());
        let out = response.headers_mut();
        out.insert(header::CONTENT_LENGTH, (part.end - part.start).into());
        if range.is_some() {
            insert(out, header::CONTENT_RANGE, &format!("bytes {}-{}/{bytes}", part.start, part.end - 1));
        }
        Ok(response)
    }

    fn nothing(&self, bytes: u64) -> Response {
        let mut response = Problem(Fault::Range { bytes }).into_response();
        insert(response.headers_mut(), header::CONTENT_RANGE, &format!("bytes */{bytes}"));
        insert(response.headers_mut(), POLICY, self.policy);
        response
    }

    fn with_headers(&self, mut response: Response) -> Response {
        let out = response.headers_mut();
        for (name, value) in [
            (header::CONTENT_TYPE, self.media_type),
            (header::ACCEPT_RANGES, "bytes"),
            (header::ETAG, &self.etag),
            // Ranges are of the file as it is.
            (header::CACHE_CONTROL, "private, no-cache, no-transform"),
            (POLICY, self.policy),
        ] {
            insert(out, name, value);
        }
        response
    }

    fn wanted(&self, headers: &HeaderMap, bytes: u64) -> Wanted {
        let text = |name: HeaderName| headers.get(name).and_then(|v| v.to_str().ok());
        // A range of what the file no longer is would be none of it.
        if text(header::IF_RANGE).is_some_and(|known| known != self.etag) {
            return Wanted::Whole;
        }
        text(header::RANGE).map_or(Wanted::Whole, |range| Wanted::of(range, bytes))
    }
}

const POLICY: HeaderName = HeaderName::from_static("cross-origin-resource-policy");

fn insert(headers: &mut HeaderMap, name: HeaderName, value: &str) {
    if let Ok(value) = HeaderValue::from_str(value) {
        headers.insert(name, value);
    }
}

/// What part of a file is wanted.
#[derive(Debug, PartialEq, Eq)]
enum Wanted {
    Whole,
    Part(Range<u64>),
    /// None that it has.
    Nothing,
}

impl Wanted {
    // RFC 9110, section 14: a header that makes no sense, and several ranges at once, are answered by the whole file.
    fn of(range: &str, bytes: u64) -> Self {
        let Some((first, last)) = range.strip_prefix("bytes=").and_then(|r| r.trim().split_once('-')) else {
            return Self::Whole;
        };
        let number = |text: &str| text.bytes().all(|b| b.is_ascii_digit()).then(|| text.parse::<u64>().ok()).flatten();
        let range = match (first.is_empty(), number(first), last.is_empty(), number(last)) {
            (true, _, false, Some(length)) => bytes.saturating_sub(length)..bytes,
            (false, Some(first), true, _) => first..bytes,
            (false, Some(first), false, Some(last)) if first <= last => first..last.saturating_add(1).min(bytes),
            _ => return Self::Whole,
        };
        if range.start >= range.end { Self::Nothing } else { Self::Part(range) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranges_are_as_the_standard_has_them() {
        for (range, expected) in [
            ("bytes=0-99", Wanted::Part(0..100)),
            ("bytes=990-", Wanted::Part(990..1000)),
            ("bytes=-10", Wanted::Part(990..1000)),
            ("bytes=-5000", Wanted::Part(0..1000)),
            ("bytes=500-5000", Wanted::Part(500..1000)),
            ("bytes=1000-", Wanted::Nothing),
            ("bytes=-0", Wanted::Nothing),
            ("bytes=5-4", Wanted::Whole),
            ("bytes=0-1,5-6", Wanted::Whole),
            ("bytes=a-b", Wanted::Whole),
            ("bytes=-", Wanted::Whole),
            ("bytes=+1-2", Wanted::Whole),
            ("lines=1-2", Wanted::Whole),
            ("bytes=0-18446744073709551615", Wanted::Part(0..1000)),
            ("bytes=99999999999999999999-", Wanted::Whole),
        ] {
            assert_eq!(Wanted::of(range, 1000), expected, "{range}");
        }
    }
}
