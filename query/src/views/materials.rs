//! `materials`: one row per surface and band, with absorption and scattering for simulations of rooms at full scale.

use std::collections::HashMap;

use echolake_functions::measured_octave;
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
/// Standard uncertainties of a scattering and of an absorption over which they are not given.
const GREATEST_SCATTERING_U: f64 = 0.25;
const GREATEST_ABSORPTION_U: f64 = 0.15;
/// Columns of what is computed from the relief.
const FAR_COLUMNS: [&str; 5] =
    ["far_scattering", "far_scattering_u", "diffusion_normalised", "diffusion_normalised_u", "far_field_reason"];

// 1.96 standard uncertainties hold 95 %. Hard surfaces are the reference, over the same Flat: those of that role, and
// boards of MDF.
pub(super) fn view_sql(rig: &Rig) -> String {
    let of_band = |value: &dyn Fn(&str, f64) -> Option<String>| {
        let bands = rig.band_names().into_iter().zip(&rig.bands.centres_hz);
        let cases = bands.filter_map(|(band, hz)| Some(format!("WHEN '{band}' THEN {}", value(&band, *hz)?)));
        let cases: Vec<_> = cases.collect();
        if cases.is_empty() {
            "CAST(NULL AS VARCHAR)".to_owned()
        } else {
            format!("CASE t.band {} END", cases.join(" "))
        }
    };
    let per_band = |column: &str| of_band(&|band, _| Some(format!("s.{column}_{band}")));
    let octave_gap = of_band(&|_, hz| {
        measured_octave(rig, hz).err().map(|gap| format!("'{}'", gap.to_string().replace('\'', "''")))
    });
    let with_repeats = |value: &str, u: &str| {
        format!("avg({value}) AS {value}, sqrt(avg({u} * {u}) + coalesce(var_samp({value}), 0) / count(*)) AS {u}")
    };
    let stats = format!(
        "SELECT surface_id, band, max(band_hz) AS band_hz, count(*) AS runs, \
         CAST(sum(measurements) AS BIGINT) AS measurements, avg(energy_over_flat) AS energy_over_flat, \
         sqrt(avg(power(p90_mean_u_db * {NATURAL_DB}, 2)) + coalesce(var_samp(energy_over_flat) / count(*) / \
         power(avg(energy_over_flat), 2), 0)) AS energy_relative_u, {}, {} \
         FROM surface_stats GROUP BY surface_id, band",
        with_repeats("scattering", "scattering_u"),
        with_repeats("specular_loss", "specular_loss_u")
    );
    let hard = format!(
        "SELECT s.flat_reference, t.band, count(*) AS boards, avg(t.energy_over_flat) AS energy, \
         sqrt(avg(power(t.energy_over_flat * t.energy_relative_u, 2))) AS energy_u, \
         avg(coalesce(power(s.reflection_factor, 2), {HARD_REFLECTION})) AS reflection, \
         avg(CASE WHEN s.reflection_factor IS NULL THEN {HARD_REFLECTION_U} ELSE 0 END) AS reflection_u \
         FROM surfaces s JOIN ({stats}) t ON t.surface_id = s.surface_id \
         WHERE coalesce(s.role = 'hard', s.material = 'MDF') AND t.energy_over_flat IS NOT NULL \
         GROUP BY s.flat_reference, t.band"
    );
    let near_field =
        |share: &str| format!("power({NEAR_FIELD_SCATTERING_U}, 2) * greatest({share} * (1 - {share}), 0)");
    // The loss has Flat's absorption in the place of the surface's.
    let of_flats_material = "CASE WHEN s.material = flat.material AND s.surface_id <> s.flat_reference THEN";
    // Energy that a relief absorbs cannot be distinguished from energy that it sends elsewhere, but it absorbs as Flat
    // does if it is of the same material: as much by area, at least by that of its plane, at most by its own.
    let is_level = format!(
        "coalesce(s.surface_id = s.flat_reference OR s.role IS NOT NULL OR s.relief_rms_mm < {FLAT_RMS_MM}, false)"
    );
    let energy = format!(
        "CASE WHEN {is_level} THEN t.energy_over_flat WHEN s.material = flat.material THEN \
         CASE WHEN t.energy_over_flat IS NOT NULL AND s.relief_area_ratio IS NOT NULL THEN 1 END END"
    );
    let assumption = format!(
        "CASE WHEN {is_level} THEN 0 ELSE \
         (s.relief_area_ratio - 1) / sqrt(3) * greatest(1 - h.reflection * ({energy}) / h.energy, 0) END"
    );
    let found = format!(
        "SELECT s.surface_id, s.run_id, s.origin, s.surface_id = s.flat_reference AS is_flat, \
         s.surface_id = s.foam_reference AS is_foam, t.band, t.band_hz, t.runs, t.measurements, \
         t.energy_over_flat, h.boards, \
         s.material = flat.material AS is_of_flats_material, {octave_gap} AS octave_gap, \
         {is_level} AS is_level, 1 - h.reflection * ({energy}) / h.energy AS absorption, \
         sqrt(power(h.reflection * ({energy}) / h.energy, 2) * (power(h.energy_u / h.energy, 2) + \
         power(h.reflection_u, 2) + \
         CASE WHEN {is_level} AND s.surface_id <> s.flat_reference THEN power(t.energy_relative_u, 2) ELSE 0 END) + \
         power({assumption}, 2)) AS absorption_u, least(greatest(t.scattering, 0), 1) AS scattering, \
         sqrt(power(t.scattering_u, 2) + {near_scattering}) AS scattering_u, \
         {of_flats_material} t.specular_loss END AS specular_loss, {of_flats_material} \
         sqrt(power(t.specular_loss_u, 2) + {near_loss}) END AS specular_loss_u, \
         {diffusion} AS diffusion_normalised, {diffusion_u} AS diffusion_normalised_u, {far} AS far_scattering, \
         {far_u} AS far_scattering_u, {far_reason} AS far_field_reason \
         FROM surfaces s JOIN ({stats}) t ON t.surface_id = s.surface_id \
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
    // Without a scale there is no octave to give the computed coefficients for.
    let (scale, [far, far_u, diffusion, diffusion_u, far_reason]) = match rig.known_scale() {
        Some(scale) => (format!("{scale:?}"), FAR_COLUMNS.map(str::to_owned)),
        None => {
            let null = |column| format!("CAST(NULL AS REAL) AS {column}");
            let [far, far_u, diffusion, diffusion_u, reason] = FAR_COLUMNS;
            let reason = format!("octave_gap AS {reason}");
            ("CAST(NULL AS DOUBLE)".to_owned(), [null(far), null(far_u), null(diffusion), null(diffusion_u), reason])
        }
    };
    let has_absorption = format!(
        "octave_gap IS NULL AND NOT is_foam AND absorption >= -1.96 * absorption_u AND \
         absorption_u <= {GREATEST_ABSORPTION_U}"
    );
    let has_scattering =
        format!("octave_gap IS NULL AND NOT is_flat AND NOT is_foam AND scattering_u <= {GREATEST_SCATTERING_U}");
    format!(
        "SELECT surface_id, run_id, band, band_hz, band_hz / {scale} AS full_scale_hz, \
         CASE WHEN {has_absorption} THEN greatest(absorption, 0) END AS absorption, \
         CASE WHEN {has_absorption} THEN absorption_u END AS absorption_u, \
         CASE WHEN octave_gap IS NOT NULL THEN octave_gap \
         WHEN is_foam THEN 'the surface is its own Foam, which is estimated' \
         WHEN energy_over_flat IS NULL THEN 'Foam''s own reflection is not known' \
         WHEN boards IS NULL THEN 'no hard surface was measured over the same Flat' \
         WHEN absorption IS NULL AND is_of_flats_material THEN 'the heights of the relief are not known' \
         WHEN absorption IS NULL THEN 'what a relief of another material than Flat''s absorbs is not known' \
         WHEN absorption_u IS NULL THEN 'the uncertainty of a level is not known' \
         WHEN absorption_u > {GREATEST_ABSORPTION_U} THEN 'how much more than Flat the relief absorbs is not known' \
         WHEN NOT coalesce({has_absorption}, false) THEN 'more energy than a hard surface reflects' \
         WHEN NOT is_level THEN 'that of Flat, which is of the same material; uncertain by the area of the relief' END \
         AS absorption_reason, \
         CASE WHEN octave_gap IS NOT NULL THEN NULL WHEN is_flat THEN 0.0 WHEN {has_scattering} THEN scattering END \
         AS scattering, CASE WHEN {has_scattering} THEN scattering_u END AS scattering_u, \
         CASE WHEN octave_gap IS NOT NULL THEN octave_gap \
         WHEN is_flat THEN 'the surface is its own Flat: 0 by definition' \
         WHEN is_foam THEN 'the surface is its own Foam, which is estimated' \
         WHEN scattering IS NULL THEN 'Foam''s own reflection is not known' \
         WHEN scattering_u IS NULL THEN 'the grid has too few places' \
         WHEN NOT {has_scattering} THEN 'parts of the panel differ by more than the method can bear' \
         WHEN abs(scattering - specular_loss) > 1.96 * sqrt(power(scattering_u, 2) + power(specular_loss_u, 2)) \
         THEN 'the methods disagree' END AS scattering_reason, \
         specular_loss, specular_loss_u, {far}, {far_u}, {diffusion}, {diffusion_u}, {far_reason}, runs, measurements, \
         origin FROM ({found})"
    )
}

/// Relative change of an energy by that of its level, 1/dB: ln(10) / 10. The error of the estimate of Foam is not in
/// uncertainties of absorption: hard surface and sample have it alike.
const NATURAL_DB: f64 = std::f64::consts::LN_10 / 10.0;

pub(super) fn column_notes() -> HashMap<String, HashMap<String, String>> {
    let noted = [
        column_note("band_hz", "Hz", "The same in the measurement"),
        column_note(
            "full_scale_hz",
            "Hz",
            "Centre of the octave at full scale: that of the band over the rig's scale; null if the rig does not say \
             it",
        ),
        column_note(
            "absorption",
            "1",
            "1 less the reflected energy over an ideal reflector's, in the octave of IEC 61260-1, by hard surfaces \
             over the same Flat; of the model's material and at the grid's angles; Flat's for a relief of its \
             material; null if absorption_reason says why",
        ),
        column_note(
            "absorption_u",
            "1",
            "Its standard uncertainty: noise, subtraction and air of both surfaces; of a relief, that it absorbs by \
             its own area",
        ),
        column_note("runs", "1", "Runs that the measured coefficients are means over"),
        column_note("measurements", "1", "Pairs of these runs"),
        column_note("absorption_reason", "", "Why there is no absorption; or whose it is"),
        column_note(
            "scattering",
            "1",
            "Scattering coefficient in the octave of IEC 61260-1, by correlation with Flat over the grid's places \
             (Mommertz 2000), 0 to 1; null if scattering_reason says why",
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
