//! Materials for simulations of rooms, in the formats of their programs.

use serde::{Deserialize, Serialize};
use serde_json::{Map, Value, json};

use crate::error::{Error, Result};

/// A row of view `materials`, whose columns say what they are.
#[allow(missing_docs, reason = "they are the view's columns")]
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MaterialBand {
    pub surface_id: String,
    pub full_scale_hz: f64,
    pub absorption: Option<f64>,
    pub absorption_u: Option<f64>,
    pub absorption_reason: Option<String>,
    pub scattering: Option<f64>,
    pub scattering_u: Option<f64>,
    pub scattering_reason: Option<String>,
    pub specular_loss: Option<f64>,
    pub specular_loss_u: Option<f64>,
    /// Computed from the relief.
    pub far_scattering: Option<f64>,
    pub far_scattering_u: Option<f64>,
    /// Computed from the relief by Kirchhoff's approximation.
    pub diffusion_normalised: Option<f64>,
    pub diffusion_normalised_u: Option<f64>,
    pub far_field_reason: Option<String>,
    /// Origin of the surface's signals, as `measured` or `simulated`.
    pub origin: String,
}

/// Format of a file of materials.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MaterialFormat {
    /// JSON: for each surface the arguments of pyroomacoustics' `Material`.
    Pyroomacoustics,
    /// JSON: the parts of CHORAS' input that have materials.
    Choras,
    /// All columns of [`MaterialBand`].
    Csv,
}

/// Formats rows, which are in the order of surfaces and frequencies. Returns the file's text and the surfaces that are
/// left out because a value is missing that the format needs. No value is made up for one that is missing.
///
/// # Errors
/// [`Error::Nothing`] if there are no rows or all surfaces are left out.
pub fn format_materials(rows: &[MaterialBand], format: MaterialFormat) -> Result<(Vec<u8>, Vec<String>)> {
    if format == MaterialFormat::Csv && !rows.is_empty() {
        let mut csv = csv::Writer::from_writer(Vec::new());
        let failed = |e: csv::Error| Error::damaged("materials", e);
        rows.iter().try_for_each(|row| csv.serialize(row)).map_err(failed)?;
        return Ok((csv.into_inner().map_err(|e| Error::damaged("materials", e.into_error()))?, Vec::new()));
    }
    // Octaves that the sweep does not have are in no surface's row of coefficients.
    let is_measured = |hz: f64| rows.iter().any(|row| row.full_scale_hz == hz && row.absorption.is_some());
    let measured: Vec<MaterialBand>;
    let rows = match format {
        MaterialFormat::Choras => {
            measured = rows.iter().filter(|row| is_measured(row.full_scale_hz)).cloned().collect();
            &measured
        }
        _ => rows,
    };
    let mut materials = Map::new();
    let mut omitted = Vec::new();
    for bands in rows.chunk_by(|a, b| a.surface_id == b.surface_id) {
        let Some(material) = surface_material(bands, format) else {
            omitted.push(bands[0].surface_id.clone());
            continue;
        };
        materials.insert(bands[0].surface_id.clone(), material);
    }
    if materials.is_empty() {
        let reason = "no surface has an absorption and a scattering; hint: `echolake sql \"select surface_id, \
                      absorption_reason, scattering_reason from materials\"`";
        return Err(Error::Nothing { reason: reason.into() });
    }
    let frequencies: Vec<f64> = rows
        .chunk_by(|a, b| a.surface_id == b.surface_id)
        .next()
        .unwrap_or_default()
        .iter()
        .map(|band| band.full_scale_hz)
        .collect();
    let file = match format {
        // Its absorption has no field for frequencies; they are those of its results. Origins are a field of ours.
        MaterialFormat::Choras => {
            let origins: Map<_, _> = rows
                .iter()
                .filter(|band| materials.contains_key(&band.surface_id))
                .map(|band| (band.surface_id.clone(), band.origin.as_str().into()))
                .collect();
            json!({
                "absorption_coefficients": materials,
                "results": [{ "frequencies": frequencies }],
                "origins": origins,
            })
        }
        _ => Value::Object(materials),
    };
    let text = serde_json::to_string_pretty(&file).map_err(|e| Error::damaged("materials", e))?;
    Ok((text.into_bytes(), omitted))
}

// None if a band is missing that the format needs.
fn surface_material(bands: &[MaterialBand], format: MaterialFormat) -> Option<Value> {
    let absorption: Vec<f64> = bands.iter().filter_map(|band| band.absorption).collect();
    if format == MaterialFormat::Choras {
        let texts: Vec<String> = absorption.iter().map(|value| format!("{value:.3}")).collect();
        return (texts.len() == bands.len()).then(|| texts.join(", ").into());
    }
    let coefficients = |what: &str, value: fn(&MaterialBand) -> Option<f64>| {
        let known: Vec<_> = bands.iter().filter(|band| value(band).is_some()).collect();
        let origin = &bands[0].origin;
        let coeffs: Vec<_> = known.iter().map(|band| value(band)).collect();
        let center_freqs: Vec<_> = known.iter().map(|band| band.full_scale_hz).collect();
        let description = format!("{} {what} ({origin}, echolake)", bands[0].surface_id);
        (!known.is_empty())
            .then(|| json!({ "description": description, "coeffs": coeffs, "center_freqs": center_freqs }))
    };
    let absorption = coefficients("absorption over a hard surface", |band| band.absorption)?;
    let scattering = coefficients("scattering by correlation with Flat", |band| band.scattering)?;
    Some(json!({ "energy_absorption": absorption, "scattering": scattering }))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn band(surface: &str, full_scale_hz: f64, absorption: Option<f64>) -> MaterialBand {
        MaterialBand {
            surface_id: surface.into(),
            full_scale_hz,
            absorption,
            absorption_u: absorption.map(|_| 0.02),
            absorption_reason: absorption.is_none().then(|| "no board".into()),
            scattering: Some(0.5),
            scattering_u: Some(0.05),
            scattering_reason: None,
            specular_loss: Some(0.5),
            specular_loss_u: None,
            far_scattering: None,
            far_scattering_u: None,
            diffusion_normalised: None,
            diffusion_normalised_u: None,
            far_field_reason: None,
            origin: "simulated".into(),
        }
    }

    fn format_json(rows: &[MaterialBand], format: MaterialFormat) -> (Value, Vec<String>) {
        let (text, omitted) = format_materials(rows, format).expect("materials");
        (serde_json::from_slice(&text).expect("JSON"), omitted)
    }

    #[test]
    fn missing_values_stay_missing() {
        let rows = [
            band("a", 250.0, Some(0.1)),
            band("a", 500.0, None),
            band("b", 250.0, Some(0.2)),
            band("b", 500.0, Some(0.3)),
            band("c", 250.0, None),
            band("c", 500.0, None),
        ];
        let (room, omitted) = format_json(&rows, MaterialFormat::Pyroomacoustics);
        assert_eq!(omitted, ["c"]);
        assert_eq!(room["a"]["energy_absorption"]["center_freqs"], json!([250.0]));
        assert_eq!(room["a"]["scattering"]["coeffs"], json!([0.5, 0.5]));
        assert_eq!(room["b"]["energy_absorption"]["coeffs"], json!([0.2, 0.3]));
        let (choras, omitted) = format_json(&rows, MaterialFormat::Choras);
        assert_eq!(omitted, ["a", "c"]);
        assert_eq!(choras["absorption_coefficients"], json!({ "b": "0.200, 0.300" }));
        assert_eq!(choras["results"][0]["frequencies"], json!([250.0, 500.0]));
        assert_eq!(choras["origins"], json!({ "b": "simulated" }));
        let (csv, _) = format_materials(&rows, MaterialFormat::Csv).expect("materials");
        let text = String::from_utf8(csv).expect("text");
        assert!(text.contains("\na,500.0,,,no board,0.5,0.05,,0.5,,,,,,,simulated\n"), "{text}");
        for format in [MaterialFormat::Pyroomacoustics, MaterialFormat::Csv] {
            assert!(matches!(format_materials(&[], format), Err(Error::Nothing { .. })));
        }
        assert!(format_materials(&rows[4..], MaterialFormat::Choras).is_err());
    }
}
