//! Long answers, packed for those who take it.

use std::io::{self, Read as _};

use axum::body::{Body, to_bytes};
use axum::http::{HeaderValue, header};
use axum::response::Response;
use bytes::Bytes;
use echolake_service::RequestFault;
use flate2::Compression;
use flate2::read::GzEncoder;

use super::content::ARROW;

/// Shorter answers fit a packet or two as they are.
const WORTH_PACKING: usize = 2000;
/// Of zlib's levels: a tenth larger than with 6, in a third of the time.
const LEVEL: Compression = Compression::new(3);

/// Packs an answer with status 200 if its client takes it packed and it gains by that.
///
/// # Errors
/// [`RequestFault::Internal`] if the answer breaks off.
pub(super) async fn pack_answer(response: Response, as_gzip: bool) -> Result<Response, RequestFault> {
    let (mut parts, body) = response.into_parts();
    let bytes = to_bytes(body, usize::MAX).await.map_err(RequestFault::defect("an answer broke off"))?;
    let packs = parts.headers.get(header::CONTENT_TYPE).is_some_and(is_packable);
    let packed = match packs && as_gzip && bytes.len() >= WORTH_PACKING {
        // What cannot be packed is sent as it is.
        true => pack_gzip(&bytes).ok(),
        false => None,
    };
    // That of what is sent is added.
    parts.headers.remove(header::CONTENT_LENGTH);
    if packed.is_some() {
        parts.headers.insert(header::CONTENT_ENCODING, HeaderValue::from_static("gzip"));
    }
    Ok(Response::from_parts(parts, Body::from(packed.unwrap_or(bytes))))
}

// Pictures and meshes are packed already.
fn is_packable(media_type: &HeaderValue) -> bool {
    ["application/json", "application/octet-stream", ARROW].contains(&media_type.to_str().unwrap_or_default())
}

fn pack_gzip(bytes: &[u8]) -> io::Result<Bytes> {
    let mut packed = Vec::new();
    GzEncoder::new(bytes, LEVEL).read_to_end(&mut packed)?;
    Ok(packed.into())
}

#[cfg(test)]
mod tests {
    use axum::response::IntoResponse as _;
    use flate2::read::GzDecoder;

    use super::*;
    use crate::catalogue::content::AnswerContent;

    #[tokio::test]
    async fn long_answers_are_packed_for_those_who_take_it() {
        let answer = |kind: &'static str, bytes: usize| AnswerContent::new(kind, vec![b'7'; bytes]).into_response();
        let packed = pack_answer(answer("application/json", 5000), true).await.expect("an answer");
        assert_eq!(packed.headers()[header::CONTENT_ENCODING], "gzip");
        let packed = to_bytes(packed.into_body(), usize::MAX).await.expect("bytes");
        assert!(packed.len() < 100);
        let mut plain = Vec::new();
        GzDecoder::new(&packed[..]).read_to_end(&mut plain).expect("gzip");
        assert_eq!(plain, vec![b'7'; 5000]);
        for (kind, bytes, as_gzip) in
            [("application/json", 5000, false), ("application/json", 9, true), ("image/png", 5000, true)]
        {
            let sent = pack_answer(answer(kind, bytes), as_gzip).await.expect("an answer");
            assert!(!sent.headers().contains_key(header::CONTENT_ENCODING), "{kind} {bytes}");
            assert_eq!(to_bytes(sent.into_body(), usize::MAX).await.expect("bytes").len(), bytes);
        }
    }
}
