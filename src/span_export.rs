//! Spans of `serve` to a collector of OpenTelemetry, by OTLP over gRPC. Its standard variables say where and how:
//! `OTEL_EXPORTER_OTLP_ENDPOINT`, `OTEL_EXPORTER_OTLP_HEADERS`, `OTEL_SERVICE_NAME` and the like. Engines export
//! nothing: they connect to nobody.

use anyhow::Context as _;
use opentelemetry::global;
use opentelemetry::trace::TracerProvider as _;
use opentelemetry_otlp::{OTEL_EXPORTER_OTLP_ENDPOINT, OTEL_EXPORTER_OTLP_TRACES_ENDPOINT, SpanExporter};
use opentelemetry_sdk::Resource;
use opentelemetry_sdk::propagation::TraceContextPropagator;
use opentelemetry_sdk::trace::SdkTracerProvider;

use crate::logging::LogLayer;

const NAME: &str = "echolake";
/// The standard's variable of the name that traces show.
const NAME_VARIABLE: &str = "OTEL_SERVICE_NAME";

/// The export of this process's spans; dropping it sends what is left.
pub(crate) struct SpanExport(SdkTracerProvider);

impl SpanExport {
    /// Starts the export; None if no collector is named. To be called in tokio's runtime.
    ///
    /// # Errors
    /// A variable names no collector that can be reached by gRPC.
    pub fn start() -> anyhow::Result<Option<Self>> {
        let is_set = |name: &str| std::env::var(name).is_ok_and(|value| !value.is_empty());
        if !is_set(OTEL_EXPORTER_OTLP_ENDPOINT) && !is_set(OTEL_EXPORTER_OTLP_TRACES_ENDPOINT) {
            return Ok(None);
        }
        let exporter = SpanExporter::builder().with_tonic().build().context("spans cannot be exported")?;
        let mut resource = Resource::builder();
        if !is_set(NAME_VARIABLE) {
            resource = resource.with_service_name(NAME);
        }
        global::set_text_map_propagator(TraceContextPropagator::new());
        Ok(Some(Self(
            SdkTracerProvider::builder().with_resource(resource.build()).with_batch_exporter(exporter).build(),
        )))
    }

    /// Returns the layer of the log that exports spans.
    pub fn layer(&self) -> LogLayer {
        Box::new(tracing_opentelemetry::layer().with_tracer(self.0.tracer(NAME)))
    }
}

impl Drop for SpanExport {
    fn drop(&mut self) {
        if let Err(error) = self.0.shutdown() {
            tracing::warn!("spans were lost: {error}");
        }
    }
}
