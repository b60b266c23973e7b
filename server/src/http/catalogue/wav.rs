//! `GET /api/v1/surfaces/{surface_id}/pairs/{pair_id}/ir.wav`: an audible response, slowed down to full scale.

use axum::Extension;
use serde::Deserialize;
use utoipa::{IntoParams, ToSchema};

use super::super::extract::{BinaryContent, PathParams, QueryParams, WholeNumber};
use super::content::{AnswerContent, EndpointAnswer};
use super::pair::{PairPath, measurement, reflected};
use super::request::CatalogueRequest;
use crate::fault::RequestFault;

/// The panels are models of walls at a tenth of their size: the wavelengths are a tenth, too.
const SCALE: usize = 10;
/// IEEE floats, in WAVE's words.
const FLOATS: u16 = 3;
const SAMPLE_BYTES: u16 = 4;
/// From the file's beginning to its samples: RIFF, `fmt ` with an empty extension, `fact`, `data`.
const HEAD: usize = 58;

/// The signal and the pitch of a response that is heard.
#[derive(Default, Deserialize, IntoParams)]
#[serde(default, deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub(super) struct WavQuery {
    #[param(inline)]
    signal: WavSignal,
    #[param(inline)]
    slowdown: WholeNumber<1, 100, { SCALE }>,
}

#[derive(Clone, Copy, Default, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
#[schema(default = "reflected")]
enum WavSignal {
    #[default]
    Reflected,
    Measured,
}

impl WavSignal {
    fn name(self) -> &'static str {
        match self {
            Self::Reflected => "reflected",
            Self::Measured => "measured",
        }
    }
}

/// The response as 32-bit float WAV.
///
/// The rate in its header is the rig's divided by `slowdown`: 10 gives full scale.
#[utoipa::path(
    get,
    path = "/api/v1/surfaces/{surface_id}/pairs/{pair_id}/ir.wav",
    tag = "catalogue",
    params(PairPath, WavQuery),
    responses((status = 200, description = "OK", body = inline(BinaryContent), content_type = "audio/wav")),
    extensions(("x-sql" = json!(["as of pair"])))
)]
pub(super) async fn wav(
    Extension(request): Extension<CatalogueRequest>,
    PathParams(path): PathParams<PairPath>,
    QueryParams(query): QueryParams<WavQuery>,
) -> EndpointAnswer {
    let entry = request.surface(&path.surface_id).await?;
    let pair = request.pair(&path.pair_id)?;
    let measurement = measurement(&request, entry, pair).await?;
    let id = &entry.surface.surface_id;
    let samples = match query.signal {
        WavSignal::Measured => Some(measurement.ir),
        WavSignal::Reflected => {
            let [own, _] = reflected(&request, entry, pair).await?;
            own
        }
    };
    let hint = "its Foam is missing; ask for signal=measured";
    let what = || format!("pair {pair} of surface `{id}`");
    let samples = samples.ok_or_else(|| RequestFault::NoData { what: what(), data: "reflected response", hint })?;
    let rate_hz = request.catalogue.lake().rig().sweep.rate_hz.get() / query.slowdown.get() as f64;
    Ok(AnswerContent::new("audio/wav", file(&samples, rate_hz.round() as u32))
        .named(format!("{id}-{pair}-{}.wav", query.signal.name())))
}

fn file(samples: &[f32], rate_hz: u32) -> Vec<u8> {
    let data = samples.len() as u32 * u32::from(SAMPLE_BYTES);
    let mut file = Vec::with_capacity(HEAD + data as usize);
    file.extend(b"RIFF");
    file.extend((HEAD as u32 - 8 + data).to_le_bytes());
    file.extend(b"WAVEfmt ");
    file.extend(18_u32.to_le_bytes());
    file.extend(FLOATS.to_le_bytes());
    file.extend(1_u16.to_le_bytes());
    file.extend(rate_hz.to_le_bytes());
    file.extend((rate_hz * u32::from(SAMPLE_BYTES)).to_le_bytes());
    file.extend(SAMPLE_BYTES.to_le_bytes());
    file.extend((8 * SAMPLE_BYTES).to_le_bytes());
    file.extend(0_u16.to_le_bytes());
    file.extend(b"fact");
    file.extend(4_u32.to_le_bytes());
    file.extend((samples.len() as u32).to_le_bytes());
    file.extend(b"data");
    file.extend(data.to_le_bytes());
    samples.iter().for_each(|sample| file.extend(sample.to_le_bytes()));
    file
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_says_what_is_in_it() {
        let file = file(&[0.5, -0.25], 9600);
        assert_eq!(file.len(), HEAD + 8);
        let number = |at: usize| u32::from_le_bytes(file[at..at + 4].try_into().expect("four bytes"));
        assert_eq!((number(4) as usize, number(24), number(28)), (file.len() - 8, 9600, 38_400));
        assert_eq!((&file[50..54], number(54)), (b"data".as_slice(), 8));
        assert_eq!(file[HEAD..HEAD + 4], 0.5_f32.to_le_bytes());
    }
}
