//! The row of table `surfaces`.

use std::f64::consts::TAU;
use std::sync::{Arc, Mutex, PoisonError};

use arrow::record_batch::RecordBatch;
use echolake_dsp::far_field::FarFieldPlan;
use echolake_dsp::full_scale_octave::octave_around;
use echolake_dsp::height_field::HeightField;
use echolake_dsp::octave_filter::{BandWidth, OctaveBand};
use echolake_dsp::relief_coefficients::{ReliefCoefficients, estimate_coefficients};
use echolake_dsp::scattering::UncertainNumber;
use echolake_dsp::temperature::ReferenceAir;
use echolake_lake::ReferenceSurfaces;
use echolake_schema::tables::Table;
use echolake_schema::{ProjectName, Rig, SurfaceId, SurfaceRecord, SurfaceRole};

use super::RunKeys;
use crate::error::{Error, Result};

/// Frequencies of a band at which the far field is computed: of thirds of an octave.
const FAR_FIELD_FREQUENCIES: usize = 3;

/// Wave numbers of a band, rad/m, or why it has no coefficients.
type BandWaves = std::result::Result<Vec<f64>, &'static str>;
/// Coefficients of a band, or why it has none.
type BandCoefficients = std::result::Result<ReliefCoefficients, &'static str>;

/// Cache of the plan for far fields of the reliefs of a lake, most of which have the same size and number of cells.
#[derive(Default)]
pub(crate) struct FarFieldCache(Mutex<Option<Arc<FarFieldPlan>>>);

impl FarFieldCache {
    // Plans for these wave numbers of bands, unless the last relief was like this one.
    fn find_plan(&self, relief: &HeightField, bands: &[BandWaves]) -> Arc<FarFieldPlan> {
        let mut last = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        match last.as_ref().filter(|plan| plan.fits_field(relief)) {
            Some(plan) => plan.clone(),
            None => last.insert(Arc::new(FarFieldPlan::new(relief, bands.iter().flatten().cloned().collect()))).clone(),
        }
    }
}

/// Builds the row of a run's surface; references that it does not name default to the lake's.
pub(crate) fn surface_row(
    rig: &Rig,
    keys: &RunKeys,
    surface: &SurfaceRecord,
    references: &ReferenceSurfaces,
    origin: &str,
    heights_mm: &[f32],
    far_fields: &FarFieldCache,
) -> Result<RecordBatch> {
    let mesh = surface.mesh.as_ref();
    let relief = relief_stats(heights_mm).or(mesh.map(|m| [m.relief_mm[0] as f32, m.relief_mm[1] as f32, f32::NAN]));
    let known = |i: usize| [relief.map(|r| r[i]).filter(|x| x.is_finite())];
    let flat = surface.flat_reference.as_ref().unwrap_or(&references.flat);
    let foam = surface.foam_reference.as_ref().unwrap_or(&references.foam);
    let heights = HeightField::from_rows(rig.panel.size_mm, heights_mm.to_vec());
    let mut row = keys.begin_rows(Table::Surfaces, rig, 1);
    let far = match &heights {
        Some(heights) => compute_far_fields(heights, rig, far_fields)
            .map_err(|cause| Error::Kernel { file: keys.run.to_string(), cause })?,
        None => vec![Err("no heights of the relief"); rig.bands.centres_hz.len()],
    };
    for ((band, hz), far) in rig.band_names().iter().zip(&rig.bands.centres_hz).zip(far) {
        let phase = heights.as_ref().and_then(|heights| detail_phase(heights, rig, *hz));
        row.push_floats(&format!("detail_phase_{band}"), [phase]);
        let known = far.ok();
        let numbers = [
            ("diffusion_normalised", known.and_then(|far| far.diffusion_normalised.ok())),
            ("far_scattering", known.and_then(|far| far.scattering.ok())),
        ];
        for (name, number) in numbers {
            let uncertainty = number.and_then(|number: UncertainNumber| number.uncertainty);
            row.push_floats(&format!("{name}_{band}"), [number.map(|number| number.value as f32)]);
            row.push_floats(&format!("{name}_u_{band}"), [uncertainty.map(|u| u as f32)]);
        }
        row.fill_text(&format!("far_field_reason_{band}"), describe_gaps(&far).as_deref());
    }
    let row = row
        .fill_text("panel", keys.surface.panel())
        .push_ints("side", [keys.surface.side().map(i32::from)])
        .fill_text("typology", surface.typology.as_str())
        .fill_text("macrostructure", surface.macrostructure.as_deref())
        .fill_text("mesostructure", surface.mesostructure.as_deref())
        .fill_text("microstructure", surface.microstructure.as_deref())
        .fill_text("material", surface.material.as_deref())
        .fill_text("role", surface.role.map(SurfaceRole::name))
        .push_doubles("reflection_factor", [surface.reflection_factor])
        .fill_text("flat_reference", flat.as_str())
        .fill_text("foam_reference", foam.as_str())
        .fill_text("macro_reference", surface.macro_reference.as_ref().map(SurfaceId::as_str))
        .push_texts("parameters", [surface.parameters.to_string()])
        .fill_text("mesh_file", mesh.map(|m| m.file.as_str()))
        .push_longs("mesh_triangles", [mesh.map(|m| m.triangles as i64)])
        .push_flags("mesh_watertight", [mesh.map(|m| m.watertight)])
        .push_floats("relief_min_mm", known(0))
        .push_floats("relief_max_mm", known(1))
        .push_floats("relief_rms_mm", known(2))
        .push_floats("relief_area_ratio", [heights.as_ref().map(|heights| heights.area_ratio() as f32)])
        .fill_text("origin", origin)
        .fill_text("project", surface.project.as_ref().map(ProjectName::as_str))
        .finish()?;
    Ok(row)
}

fn detail_phase(heights: &HeightField, rig: &Rig, hz: f64) -> Option<f32> {
    let wavelength_mm = 1e3 * ReferenceAir::from_response(&rig.impulse_response).speed_of_sound() / hz;
    heights.detail_phase(wavelength_mm).map(|phase| phase as f32)
}

// Why a band lacks coefficients; None if it has both.
fn describe_gaps(far: &BandCoefficients) -> Option<String> {
    let far = match far {
        Ok(far) => far,
        Err(reason) => return Some((*reason).to_owned()),
    };
    match (far.scattering.err(), far.diffusion_normalised.err()) {
        (None, None) => None,
        (Some(both), Some(other)) if both == other => Some(both.to_string()),
        (scattering, diffusion) => {
            let gaps = [("scattering", scattering), ("diffusion", diffusion)];
            let gaps = gaps.into_iter().filter_map(|(name, gap)| Some(format!("{name}: {}", gap?)));
            Some(gaps.collect::<Vec<_>>().join("; "))
        }
    }
}

fn compute_far_fields(
    heights: &HeightField,
    rig: &Rig,
    cache: &FarFieldCache,
) -> std::result::Result<Vec<BandCoefficients>, echolake_dsp::Error> {
    let bands: Vec<_> = rig.bands.centres_hz.iter().map(|hz| far_wave_numbers(heights, rig, *hz)).collect();
    let mut found = estimate_coefficients(heights, &cache.find_plan(heights, &bands))?.into_iter();
    let of_band = |band: BandWaves| band.and_then(|_| found.next().ok_or("no wave numbers"));
    Ok(bands.into_iter().map(of_band).collect())
}

// Wave numbers over the octave around a band, rad/m: what is computed from a relief needs no sweep.
fn far_wave_numbers(heights: &HeightField, rig: &Rig, hz: f64) -> BandWaves {
    let speed_m_s = ReferenceAir::from_response(&rig.impulse_response).speed_of_sound();
    let OctaveBand { low_hz, high_hz, .. } =
        octave_around(rig, hz).unwrap_or_else(|_| OctaveBand::from_midband(hz, BandWidth::Octave));
    let at = |i: usize| low_hz * (high_hz / low_hz).powf((i as f64 + 0.5) / FAR_FIELD_FREQUENCIES as f64);
    if 1e3 * speed_m_s / high_hz <= 2.0 * heights.pitch_mm() {
        return Err("the cells of the heights are half a wavelength wide, or wider");
    }
    Ok((0..FAR_FIELD_FREQUENCIES).map(|i| TAU * at(i) / speed_m_s).collect())
}

// Minimum, maximum and root mean square height about the mean.
fn relief_stats(heights_mm: &[f32]) -> Option<[f32; 3]> {
    if heights_mm.is_empty() {
        return None;
    }
    let count = heights_mm.len() as f64;
    let mean = heights_mm.iter().map(|h| f64::from(*h)).sum::<f64>() / count;
    let square = heights_mm.iter().map(|h| (f64::from(*h) - mean).powi(2)).sum::<f64>() / count;
    let least = heights_mm.iter().copied().fold(f32::INFINITY, f32::min);
    let greatest = heights_mm.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    Some([least, greatest, square.sqrt() as f32])
}

#[cfg(test)]
mod tests {
    use super::*;

    // A groove of a fifth of its period has a root mean square of 0.4 of its depth, and lies within all wavelengths
    // that are longer than the period.
    #[test]
    fn details_are_told_where_cells_can_show_them() {
        let rig = Rig::paper();
        let grooves = |cells: usize| {
            let row = move |i: usize| if i.is_multiple_of(5) { -1.0f32 } else { 0.0 };
            HeightField::from_rows(585.0, (0..cells * cells).map(|i| row(i % cells)).collect()).expect("square")
        };
        let phase = detail_phase(&grooves(260), &rig, 10e3).expect("there");
        assert!((phase - 0.4 * (TAU * 10.0 / 343.2) as f32).abs() < 0.01, "{phase}");
        assert_eq!(detail_phase(&grooves(100), &rig, 40e3), None);
        assert_eq!(HeightField::from_rows(585.0, vec![0.0; 6]), None);
        let cache = FarFieldCache::default();
        for cells in [100, 260, 100] {
            let far = compute_far_fields(&grooves(cells), &rig, &cache).expect("coefficients");
            let lowest = far[0].expect("a band").scattering.expect("a number");
            assert!(lowest.value.abs() < 0.01 && lowest.uncertainty.is_some_and(|u| u < 0.05), "{far:?}");
            assert_eq!(far[4].is_ok(), cells == 260, "{:?}", far[4]);
            let again = compute_far_fields(&grooves(cells), &rig, &FarFieldCache::default()).expect("coefficients");
            assert_eq!(far, again);
        }
    }
}
