//! `materials`: one row per surface and band, with absorption and scattering for simulations of rooms at full scale.

use std::collections::HashMap;

use echolake_schema::Rig;

use super::column_note;

/// Share of the energy that a hard board reflects if its run does not tell, and the uncertainty of such a share.
const HARD_REFLECTION: f64 = 0.98;
const HARD_REFLECTION_U: f64 = 0.01;
/// Reliefs that are flatter, mm, send no sound beside the grid or out of the speaker's beam.
const FLAT_RMS_MM: f64 = 0.1;
/// Standard uncertainty of a scattering s by the near field, over the root of s (1 - s): root mean square of its
/// differences from the far field by the boundary-element method over eight reliefs.
const NEAR_FIELD_SCATTERING_U: f64 = 0.3;
/// Standard uncertainty of a scattering over which it is not given.
const GREATEST_SCATTERING_U: f64 = 0.25;

// 1.96 standard uncertainties hold 95 %. A board of MDF is the hard reference, over the same Flat.
pub(super) fn view_sql(rig: &Rig) -> String {
    let per_band = |column: &str| {
        let cases = rig.band_names().into_iter().map(|band| format!("WHEN '{band}' THEN s.{column}_{band}"));
        format!("CASE t.band {} END", cases.collect::<Vec<_>>().join(" "))
    };
    let hard = format!(
        "SELECT s.flat_reference, t.band, count(*) AS boards, avg(t.energy_over_flat) AS energy, \
         sqrt(avg(power(t.energy_over_flat * {LEVEL_U}, 2))) AS energy_u, \
         avg(coalesce(power(s.reflection_factor, 2), {HARD_REFLECTION})) AS reflection, \
         avg(CASE WHEN s.reflection_factor IS NULL THEN {HARD_REFLECTION_U} ELSE 0 END) AS reflection_u \
         FROM surfaces s JOIN surface_stats t ON t.run_id = s.run_id \
         WHERE s.material = 'MDF' GROUP BY s.flat_reference, t.band"
    );
    let near_field =
        |share: &str| format!("power({NEAR_FIELD_SCATTERING_U}, 2) * greatest({share} * (1 - {share}), 0)");
    // The loss has Flat's absorption in the place of the surface's.
    let of_flats_material = "CASE WHEN s.material = flat.material AND s.surface_id <> s.flat_reference THEN";
    // Energy that a relief absorbs cannot be distinguished from energy that it sends elsewhere, but it absorbs as Flat
    // does if it is of the same material.
    let is_level = format!("coalesce(s.surface_id = s.flat_reference OR s.relief_rms_mm < {FLAT_RMS_MM}, false)");
    let energy = format!(
        "CASE WHEN {is_level} THEN t.energy_over_flat WHEN s.material = flat.material THEN \
         CASE WHEN t.energy_over_flat IS NOT NULL THEN 1 END END"
    );
    let found = format!(
        "SELECT s.surface_id, s.run_id, s.origin, s.surface_id = s.flat_reference AS is_flat, \
         s.surface_id = s.foam_reference AS is_foam, t.band, t.band_hz, t.measurements, t.energy_over_flat, h.boards, \
         {is_level} AS is_level, 1 - h.reflection * ({energy}) / h.energy AS absorption, \
         h.reflection * ({energy}) / h.energy * sqrt(power(h.energy_u / h.energy, 2) + power(h.reflection_u, 2) + \
         CASE WHEN {is_level} AND s.surface_id <> s.flat_reference THEN power({LEVEL_U}, 2) ELSE 0 END) \
         AS absorption_u, least(greatest(t.scattering, 0), 1) AS scattering, \
         sqrt(power(t.scattering_u, 2) + {near_scattering}) AS scattering_u, \
         {of_flats_material} t.specular_loss END AS specular_loss, {of_flats_material} \
         sqrt(power(t.specular_loss_u, 2) + {near_loss}) END AS specular_loss_u, \
         {diffusion} AS diffusion_normalised, {diffusion_u} AS diffusion_normalised_u, {far} AS far_scattering, \
         {far_u} AS far_scattering_u, {far_reason} AS far_field_reason \
         FROM surfaces s JOIN surface_stats t ON t.run_id = s.run_id \
         LEFT JOIN surfaces flat ON flat.surface_id = s.flat_reference \
         LEFT JOIN ({hard}) h ON h.flat_reference = s.flat_reference AND h.band = t.band \
         WHERE t.band_hz IS NOT NULL",
        near_scattering = near_field("t.scattering"),
        near_loss = near_field("t.specular_loss"),
        diffusion = per_band("diffusion_normalised"),
        diffusion_u = per_band("diffusion_normalised_u"),
        far = per_band("far_scattering"),
        far_u = per_band("far_scattering_u"),
        far_reason = per_band("far_field_reason"),
    );
    let scale = format!("{:?}", rig.model_scale());
    let has_absorption = "NOT is_foam AND absorption >= -1.96 * absorption_u";
    let has_scattering = format!("NOT is_flat AND NOT is_foam AND scattering_u <= {GREATEST_SCATTERING_U}");
    format!(
        "SELECT surface_id, run_id, band, band_hz, band_hz / {scale} AS full_scale_hz, \
         CASE WHEN {has_absorption} THEN greatest(absorption, 0) END AS absorption, \
         CASE WHEN {has_absorption} THEN absorption_u END AS absorption_u, \
         CASE WHEN is_foam THEN 'the surface is its own Foam, which is estimated' \
         WHEN energy_over_flat IS NULL THEN 'Foam''s own reflection is not known' \
         WHEN boards IS NULL THEN 'no board of MDF was measured over the same Flat' \
         WHEN absorption IS NULL THEN 'what a relief of another material than Flat''s absorbs is not known' \
         WHEN NOT {has_absorption} THEN 'more energy than a board reflects' \
         WHEN NOT is_level THEN 'that of Flat, which is of the same material' END AS absorption_reason, \
         CASE WHEN is_flat THEN 0.0 WHEN {has_scattering} THEN scattering END AS scattering, \
         CASE WHEN {has_scattering} THEN scattering_u END AS scattering_u, \
         CASE WHEN is_flat THEN 'the surface is its own Flat: 0 by definition' \
         WHEN is_foam THEN 'the surface is its own Foam, which is estimated' \
         WHEN scattering IS NULL THEN 'Foam''s own reflection is not known' \
         WHEN scattering_u IS NULL THEN 'the grid has too few places' \
         WHEN NOT {has_scattering} THEN 'parts of the panel differ by more than the method can bear' \
         WHEN abs(scattering - specular_loss) > 1.96 * sqrt(power(scattering_u, 2) + power(specular_loss_u, 2)) \
         THEN 'the methods disagree' END AS scattering_reason, \
         specular_loss, specular_loss_u, far_scattering, far_scattering_u, diffusion_normalised, \
         diffusion_normalised_u, far_field_reason, measurements, origin FROM ({found})"
    )
}

/// Relative standard uncertainty of an energy over Flat's by that of its level. The error of the estimate of Foam is
/// not in it: board and surface have it alike.
const LEVEL_U: &str = "coalesce(t.p90_mean_u_db, 0) * 0.2302585092994046";

pub(super) fn column_notes() -> HashMap<String, HashMap<String, String>> {
    let noted = [
        column_note(
            "full_scale_hz",
            "Hz",
            "Centre of the octave at full scale: a tenth of the model's frequency, or the same if the sweep ends at 20 \
             kHz or below",
        ),
        column_note(
            "absorption",
            "1",
            "1 less the reflected energy over an ideal reflector's, by a board of MDF over the same Flat; of the \
             model's material and at the grid's angles; Flat's for a relief; null if absorption_reason says why",
        ),
        column_note("absorption_u", "1", "Its standard uncertainty: noise, subtraction and air of surface and board"),
        column_note("absorption_reason", "", "Why there is no absorption; or whose it is"),
        column_note(
            "scattering",
            "1",
            "Scattering coefficient by correlation with Flat over the grid's places (Mommertz 2000), 0 to 1; null if \
             scattering_reason says why",
        ),
        column_note(
            "scattering_u",
            "1",
            "Its standard uncertainty: the panel's parts, and that the grid is in the near field",
        ),
        column_note(
            "scattering_reason",
            "",
            "Why there is no scattering; or that it differs from specular_loss by more than 1.96 times their \
             uncertainty",
        ),
        column_note(
            "specular_loss",
            "1",
            "The same by another method: the share of Flat's energy that is not mirrored, as in ISO 17497-1; null if \
             the surface's material is not Flat's, whose absorption it takes",
        ),
        column_note("specular_loss_u", "1", "Its standard uncertainty, from the same as scattering_u"),
        column_note(
            "far_scattering",
            "1",
            "Scattering coefficient for random incidence in the far field; computed from the relief, not measured",
        ),
        column_note("far_scattering_u", "1", "Its standard uncertainty"),
        column_note(
            "diffusion_normalised",
            "1",
            "Normalised diffusion of ISO 17497-2; computed from the relief by Kirchhoff's approximation",
        ),
        column_note("diffusion_normalised_u", "1", "Its standard uncertainty"),
        column_note("far_field_reason", "", "Why far_scattering or diffusion_normalised is missing"),
    ];
    noted.into_iter().collect()
}
