//! Traces of OpenTelemetry: the span of a request continues its client's trace, and what the request is forwarded with
//! names the span.

use axum::http::{HeaderMap, HeaderName, HeaderValue};
use opentelemetry::global;
use opentelemetry::propagation::{Extractor, Injector};
use tracing::Span;
use tracing_opentelemetry::OpenTelemetrySpanExt as _;

/// Headers of a request, as propagators read and write them.
struct TraceHeaders<'a>(&'a mut HeaderMap);

impl Extractor for TraceHeaders<'_> {
    fn get(&self, name: &str) -> Option<&str> {
        self.0.get(name)?.to_str().ok()
    }

    fn keys(&self) -> Vec<&str> {
        self.0.keys().map(HeaderName::as_str).collect()
    }
}

impl Injector for TraceHeaders<'_> {
    fn set(&mut self, name: &str, value: String) {
        if let (Ok(name), Ok(value)) = (HeaderName::try_from(name), HeaderValue::try_from(value)) {
            self.0.insert(name, value);
        }
    }
}

/// Makes a span part of the trace that the headers name, or of a new one, and names the span in the headers. Does
/// nothing if spans are not exported. To be called before the span is entered.
pub(crate) fn join_trace(span: &Span, headers: &mut HeaderMap) {
    let mut headers = TraceHeaders(headers);
    let parent = global::get_text_map_propagator(|propagator| propagator.extract(&headers));
    if span.set_parent(parent).is_ok() {
        let context = span.context();
        global::get_text_map_propagator(|propagator| propagator.inject_context(&context, &mut headers));
    }
}
